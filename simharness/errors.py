"""Everything the harness raises on purpose.

::

    SimError
    +-- LoadError         a URDF or mesh that Bullet cannot load; `path` names it
    +-- ObjectSetError    an object set that is unknown, empty or broken
    +-- UsageError        an option, a folder or a recorded run that cannot be used
        +-- MissingExtra  what was asked for needs a library of another extra of pyproject.toml
    +-- RunBroken         the service or a worker process failed in mid-run; what was done is kept

Messages give the value, the limit and the remedy.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class SimError(Exception):
    """Base class of this package's errors."""


class LoadError(SimError):
    """A body's description cannot be loaded.

    Args:
        path: the URDF.
        why: what is wrong with it and what to do.
    """

    def __init__(self, path: Path | str, why: str) -> None:
        super().__init__(f"{path}: {why}")
        self.path = Path(path)
        self.why = why


class ObjectSetError(SimError):
    """A set of objects cannot be used.

    Args:
        value: what was asked for.
        limit: what is wrong with it.
        remedy: what to do instead.
    """

    def __init__(self, value: str, limit: str, remedy: str) -> None:
        super().__init__(f"{value}: {limit}; {remedy}")
        self.value = value
        self.limit = limit
        self.remedy = remedy


class UsageError(SimError):
    """The command asks for something that cannot be done."""


class MissingExtra(UsageError):
    """A library that only some runs need is not installed, or cannot be loaded.

    Args:
        what: what needs it, as the beginning of a sentence.
        extra: the extra of pyproject.toml that brings it.
        why: what its import said.
    """

    def __init__(self, what: str, extra: str, why: str) -> None:
        super().__init__(
            f"{what} the extra `{extra}`: {why}; pip install -e '.[{extra}]', or, where a shared object is missing, "
            "the system package that holds it"
        )
        self.extra = extra


@contextmanager
def from_extra(extra: str, what: str) -> Iterator[None]:
    """Around the import of a library that only some runs need.

    Args:
        extra: the extra of pyproject.toml that brings the library.
        what: what needs it, as the beginning of a sentence: "camera multi3 needs".

    Raises:
        MissingExtra: the import failed, or a system library that it loads is missing.
    """
    try:
        yield
    except (ImportError, OSError) as error:
        raise MissingExtra(what, extra, str(error)) from error


class RunBroken(SimError):
    """Something outside the command failed while a run was under way."""
