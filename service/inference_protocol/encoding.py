"""A prediction -> the protocol's answer: JSON, and behind it the tensors that were asked for as bytes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray
from starlette.responses import Response

from service.inference_protocol.tensors import HEADER_LENGTH, OUTPUTS
from service.payloads import JSON, OCTET_STREAM


def encode(
    head: dict[str, str], arrays: Mapping[str, NDArray[np.float64]], meta: bytes, outputs: Mapping[str, bool]
) -> Response:
    """The answer.

    Args:
        head: names the network, and the request where it has a name.
        arrays: the grasps, by output.
        meta: the rest, as JSON.
        outputs: the wanted ones, each with whether it is to be binary.
    """
    tensors: list[dict[str, Any]] = []
    tail: list[bytes] = []
    for described in OUTPUTS:
        if described.name not in outputs:
            continue
        is_text = described.name == "meta"
        array = None if is_text else arrays[described.name]
        tensor: dict[str, Any] = {
            "name": described.name,
            "datatype": described.datatype,
            "shape": [1] if array is None else list(array.shape),
        }
        if outputs[described.name]:
            data = len(meta).to_bytes(4, "little") + meta if array is None else array.astype("<f8").tobytes()
            tensor["parameters"] = {"binary_data_size": len(data)}
            tail.append(data)
        else:
            tensor["data"] = [meta.decode()] if array is None else array.ravel().tolist()
        tensors.append(tensor)
    text = msgspec.json.encode(head | {"outputs": tensors})
    if not tail:
        return Response(text, media_type=JSON)
    return Response(b"".join([text, *tail]), media_type=OCTET_STREAM, headers={HEADER_LENGTH: str(len(text))})
