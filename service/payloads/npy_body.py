"""`application/x-npy`: a .npy array, as `tesnet.formats` reads it."""

from __future__ import annotations

from service.payloads.payload import Payload, cloud_payload, file_of, refuse_empty
from tesnet.formats import NPY


def decode_npy(body: bytearray, max_points: int) -> Payload:
    """A .npy array (N, 3) or (H, W, 3) of float32 or float64."""
    refuse_empty(body)
    return cloud_payload(file_of(body, NPY.read, max_points).points)
