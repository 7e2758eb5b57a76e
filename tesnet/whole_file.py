"""Files that appear whole or not at all. It knows nothing of what is written, and needs the standard library alone."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO


@contextmanager
def whole_file(path: Path) -> Iterator[BinaryIO]:
    """A binary file that takes the place of `path` in one step when the block ends well.

    Readers see the old file or all of the new one, even after a power cut; a block that fails, or a process that is
    stopped, leaves the old one. Until then the content lies beside it, under a hidden name of its own, so that several
    processes may write the same file.

    Raises:
        OSError: the folder does not exist or cannot be written.
    """
    draft = path.with_name(f".{path.name}.{secrets.token_hex(8)}")
    try:
        with draft.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)


def write_whole(path: Path, content: bytes) -> None:
    """Write a file as `whole_file` does.

    Raises:
        OSError: the folder does not exist or cannot be written.
    """
    with whole_file(path) as file:
        file.write(content)
