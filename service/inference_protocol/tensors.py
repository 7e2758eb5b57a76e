"""The names of the Open Inference Protocol, which every part of this package speaks: header, input and outputs."""

from __future__ import annotations

from service import schemas

HEADER_LENGTH = "Inference-Header-Content-Length"
INPUT = schemas.TensorMetadata(name="points", datatype="FP32", shape=[-1, 3])
INPUTS = [
    INPUT,
    schemas.TensorMetadata(name="view_index", datatype="INT32", shape=[-1]),
    schemas.TensorMetadata(name="normals", datatype="FP32", shape=[-1, 3]),
]
"""What may be sent. The model describes itself by the first alone: clients take for needed what it names."""
OUTPUTS = [
    schemas.TensorMetadata(name=name, datatype=datatype, shape=shape)
    for name, datatype, shape in (
        ("scores", "FP64", [-1]),
        ("poses", "FP64", [-1, 4, 4]),
        ("hand_poses", "FP64", [-1, 4, 4]),
        ("pregrasps", "FP64", [-1, 4, 4]),
        ("widths", "FP64", [-1]),
        ("approach_points", "FP64", [-1, 3]),
        ("contact_points", "FP64", [-1, 3]),
        ("meta", "BYTES", [1]),
    )
]

BINARY_OUTPUT = "binary_data_output"
"""The parameter that asks for every output as bytes."""
