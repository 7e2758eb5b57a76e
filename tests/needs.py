"""What tests need beyond Python packages: programs and system libraries, each with the Debian package that brings it.

`@pytest.mark.needs("chromium")` leaves a test out where its need is missing; `tests/conftest.py` carries that out.
`python tests/needs.py` prints the packages that are missing here. The standard library alone: this runs before anything
is installed.
"""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache

COMPILER = "g++"


@dataclass(frozen=True, slots=True)
class Part:
    """One program, header or shared library.

    Args:
        name: as it is looked for.
        package: Debian's package that holds it.
        is_there: looks for a name.
    """

    name: str
    package: str
    is_there: Callable[[str], bool]

    @property
    def missing(self) -> bool:
        """Whether it is not there."""
        return not self.is_there(self.name)


def _is_program(name: str) -> bool:
    return shutil.which(name) is not None


@cache
def _is_header(name: str) -> bool:
    """Whether the C++ compiler finds a header; no compiler finds none."""
    command = [COMPILER, "-x", "c++", "-fsyntax-only", "-include", name, "/dev/null"]
    return _is_program(COMPILER) and not subprocess.run(command, capture_output=True, check=False).returncode


@cache
def _is_library(name: str) -> bool:
    try:
        ctypes.CDLL(name)
    except OSError:
        return False
    return True


def _program(name: str, package: str = "") -> Part:
    return Part(name, package or name, _is_program)


NEEDS: Mapping[str, tuple[Part, ...]] = {
    "chromium": (_program("chromium"),),
    "curl": (_program("curl"),),
    "g++": (_program(COMPILER),),
    "git": (_program("git"),),
    "jq": (_program("jq"),),
    "libcurl": (Part("curl/curl.h", "libcurl4-openssl-dev", _is_header),),
    "node": (_program("node", "nodejs"),),
    "nlohmann-json": (Part("nlohmann/json.hpp", "nlohmann-json3-dev", _is_header),),
    "open3d": (
        Part("libEGL.so.1", "libegl1", _is_library),
        Part("libGL.so.1", "libgl1", _is_library),
        Part("libgomp.so.1", "libgomp1", _is_library),
        Part("libusb-1.0.so.0", "libusb-1.0-0", _is_library),
        Part("libX11.so.6", "libx11-6", _is_library),
    ),
    "rustc": (_program("rustc"),),
}
"""By the name that a test gives: what must all be there."""


def missing(names: Iterable[str]) -> list[Part]:
    """What of these needs is not there; an unknown name is a KeyError."""
    return [part for name in names for part in NEEDS[name] if part.missing]


def packages(parts: Iterable[Part]) -> list[str]:
    """The Debian packages that bring them, each once."""
    return sorted({part.package for part in parts})


if __name__ == "__main__":
    sys.stdout.write(" ".join(packages(missing(NEEDS))) + "\n")
