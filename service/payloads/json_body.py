"""`application/json`: `{"points": [[x, y, z], ...], ...options}`, decoded piece by piece."""

from __future__ import annotations

from service.errors import Invalid
from service.payloads.json_object import Span, members
from service.payloads.json_points import points_of_json
from service.payloads.options import BESIDE_POINTS, option_texts, unknown_option
from service.payloads.payload import Payload, most_rows, refuse_empty
from service.payloads.per_point import per_point
from service.schemas import GraspOptions

_NAMES = ("points", *BESIDE_POINTS, *GraspOptions.model_fields)


def decode_json(body: bytearray, max_points: int) -> Payload:
    """`{"points": [[x, y, z], ...], ...options}`, and `view_index` and `normals` of the points."""
    refuse_empty(body)
    values = members(Span.of(body), "body", _NAMES, unknown_option)
    points = values.pop("points", None)
    arrays = {name: values.pop(name) for name in BESIDE_POINTS if name in values}
    options = option_texts(values, max_points)
    if points is None:
        raise Invalid("points", "is missing; give [[x, y, z], ...] in metres")
    given = {name: span for name, span in arrays.items() if bytes(span.view) != b"null"}
    return Payload(points_of_json(points, most_rows(max_points)), options, **per_point(given, max_points))
