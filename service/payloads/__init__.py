"""Request bodies and query strings -> points and options. One decoder a format; knows no routes.

Nothing is allocated or expanded before its size is checked. Decoders run off the event loop; those for big bodies give
the interpreter's lock back every few milliseconds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

from python_multipart.multipart import parse_options_header

from service.errors import Undecodable, UnknownContentType, shortened
from service.payloads.grasp_query import build_query
from service.payloads.json_body import decode_json
from service.payloads.multipart_body import decode_multipart
from service.payloads.npy_body import decode_npy
from service.payloads.octets_body import decode_octet_stream
from service.payloads.options import merged, parse_options, parse_query_string
from service.payloads.payload import Payload, RawOptions, most_rows

__all__ = [
    "CONTENT_TYPES",
    "JSON",
    "MULTIPART",
    "NPY",
    "OCTET_STREAM",
    "Decoder",
    "Payload",
    "RawOptions",
    "build_query",
    "decoder_for",
    "media_type",
    "merged",
    "most_rows",
    "parse_options",
    "parse_query_string",
]

JSON = "application/json"
OCTET_STREAM = "application/octet-stream"
NPY = "application/x-npy"
MULTIPART = "multipart/form-data"

Decoder = Callable[[bytearray, int], Payload]
"""body, most points -> payload. Raises 400s, 413s and 422s of the table in `service.errors`."""

_DECODERS: Mapping[str, Decoder] = {JSON: decode_json, OCTET_STREAM: decode_octet_stream, NPY: decode_npy}

CONTENT_TYPES = (*_DECODERS, MULTIPART)


def media_type(content_type: str) -> str:
    """What a `Content-Type` header names, without its parameters."""
    kind, _ = parse_options_header(content_type)
    return kind.decode("latin-1").strip().lower()


def decoder_for(content_type: str) -> Decoder:
    """The decoder for a body of this content type.

    Raises:
        UnknownContentType: there is none.
        Undecodable: a multipart body without a boundary.
    """
    name = media_type(content_type)
    if name == MULTIPART:
        _, parameters = parse_options_header(content_type)
        boundary = parameters.get(b"boundary", b"")
        if not 1 <= len(boundary) <= 70:  # RFC 2046, 5.1.1
            raise Undecodable(f"The Content-Type {MULTIPART} has no boundary of 1 to 70 characters; give one.")
        return partial(decode_multipart, boundary)
    if name not in _DECODERS:
        what = f"Content-Type {shortened(content_type)} is not supported" if content_type else "Content-Type is missing"
        raise UnknownContentType(f"{what}; send one of {', '.join(CONTENT_TYPES)}.")
    return _DECODERS[name]
