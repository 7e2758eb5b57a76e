"""`application/octet-stream`: little-endian float32 x, y, z triples."""

from __future__ import annotations

import numpy as np

from service.errors import Undecodable
from service.payloads.payload import Payload, check_count, cloud_payload, most_rows, refuse_empty


def decode_octet_stream(body: bytearray, max_points: int) -> Payload:
    """Little-endian float32 x, y, z triples."""
    refuse_empty(body)
    if len(body) % 12:
        raise Undecodable(
            f"The body has {len(body)} bytes, not a multiple of 12; send x, y, z of a point as little-endian float32."
        )
    check_count(len(body) // 12, most_rows(max_points))
    return cloud_payload(np.frombuffer(body, "<f4").reshape(-1, 3))
