"""What `/openapi.json` says of `POST /v2/models/{model}/infer` that FastAPI cannot see by itself."""

from __future__ import annotations

from typing import Any

from service.errors import (
    DeadlineExceeded,
    Invalid,
    NotReady,
    QueueFull,
    TooLarge,
    Unauthorized,
    Undecodable,
    UnknownContentType,
    UnknownModel,
)
from service.inference_protocol.tensors import BINARY_OUTPUT, HEADER_LENGTH
from service.payloads import JSON, OCTET_STREAM

_TENSORS = {"type": "array", "items": {"type": "object"}}
INFER_REQUEST: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "content": {
            JSON: {
                "schema": {
                    "type": "object",
                    "required": ["inputs"],
                    "properties": {
                        "id": {"type": "string", "description": "Comes back in the answer."},
                        "parameters": {
                            "type": "object",
                            "description": "Options, as in `POST /grasps`; a string holds JSON or a plain word. "
                            f"`{BINARY_OUTPUT}`: send every output as bytes.",
                        },
                        "inputs": {
                            **_TENSORS,
                            "description": "`points` FP32 [-1, 3]; beside it, if wanted, `view_index` INT32 [-1] and "
                            "`normals` FP32 [-1, 3].",
                        },
                        "outputs": {**_TENSORS, "description": "The wanted ones; all where none is named."},
                    },
                },
                "example": {
                    "parameters": {"up": "[0, 0, 1]"},
                    "inputs": [{"name": "points", "datatype": "FP32", "shape": [1, 3], "data": [0.01, 0.02, 0.51]}],
                },
            },
            OCTET_STREAM: {
                "schema": {
                    "type": "string",
                    "format": "binary",
                    "description": f"The JSON, of `{HEADER_LENGTH}` bytes, and the input's bytes behind it.",
                }
            },
        },
    }
}
INFER_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The outputs, as JSON or with bytes behind it.",
        "content": {JSON: {"schema": {"type": "object"}}, OCTET_STREAM: {"schema": {"type": "string"}}},
    }
}
INFER_PROBLEMS = (
    Undecodable,
    Unauthorized,
    UnknownModel,
    TooLarge,
    UnknownContentType,
    Invalid,
    QueueFull,
    NotReady,
    DeadlineExceeded,
)
