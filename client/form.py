"""`multipart/form-data` (RFC 7578), as a pure function."""

from __future__ import annotations

import uuid
from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True, eq=False, slots=True)
class File:
    """One part of a form; without a file name it is a plain field."""

    name: str
    file_name: str | None
    content: bytes
    content_type: str = "application/octet-stream"


def encode_form(parts: Sequence[File]) -> tuple[str, bytes]:
    """The Content-Type and the body of a form."""
    boundary = uuid.uuid4().hex  # so long that no content holds it by chance
    pieces: list[bytes] = []
    for part in parts:
        file_name = f'; filename="{part.file_name}"' if part.file_name else ""
        head = (
            f'--{boundary}\r\nContent-Disposition: form-data; name="{part.name}"{file_name}\r\n'
            f"Content-Type: {part.content_type}\r\n\r\n"
        )
        pieces += [head.encode("ascii"), part.content, b"\r\n"]
    return f"multipart/form-data; boundary={boundary}", b"".join([*pieces, f"--{boundary}--\r\n".encode("ascii")])
