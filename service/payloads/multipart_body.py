"""`multipart/form-data`: a cloud file, or a depth image with an optional mask; and options."""

from __future__ import annotations

from collections.abc import Mapping

from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header

from service.errors import Invalid, Undecodable, shortened
from service.payloads.depth_image import decode_depth
from service.payloads.json_object import Span, members
from service.payloads.options import BESIDE_POINTS, check_length, json_text, merged, option_texts, unknown_option
from service.payloads.payload import BesidePoints, Payload, RawOptions, cloud_payload, file_of, refuse_empty
from service.payloads.per_point import per_point
from service.schemas import DepthCamera, DepthOptions
from tesnet import formats

FILES = ("cloud", "depth", "mask", *BESIDE_POINTS)
PARTS = frozenset((*FILES, "options", *DepthOptions.model_fields))
"""Each option may also be a part of its own."""

_STEP = 1 << 16
"""Bytes that the parser is given in one go."""
_MAX_HEADER_BYTES = 4096


def decode_multipart(boundary: bytes, body: bytearray, max_points: int) -> Payload:
    """The cloud of a form, or its depth image. Options stand in the part `options`, a JSON object, or in their own."""
    refuse_empty(body)
    spans = _split(boundary, body)
    options = _part_options(spans, max_points)
    parts = {name: span.view for name, span in spans.items()}
    camera = {name: options.pop(name) for name in DepthCamera.model_fields if name in options}
    given = [name for name in ("cloud", "depth") if name in parts]
    if len(given) != 1:
        what = "is missing" if not given else "is given beside `depth`"
        raise Invalid(
            "cloud", f"{what}; send one file, `cloud` ({formats.LISTED}) or `depth` (16-bit grey PNG or .npy)"
        )
    beside = per_point(spans, max_points)
    if "depth" in parts:
        return decode_depth(parts["depth"], parts.get("mask"), camera, options, max_points, **beside)
    if "mask" in parts:
        raise Invalid("mask", "belongs to a depth image; with a cloud give `target`")
    if camera:
        raise Invalid(next(iter(camera)), "belongs to a depth image; send a file `depth`, or leave it out")
    return _decode_cloud(parts["cloud"], options, beside, max_points)


def _decode_cloud(file: memoryview, options: RawOptions, beside: BesidePoints, max_points: int) -> Payload:
    """The points of a file, whose first bytes tell its format; what it is called does not matter."""
    refuse_empty(file, "file `cloud`")
    found = formats.format_of(file)
    if found is None:
        raise Undecodable(formats.why_of_none(file, "file `cloud`"))
    cloud = file_of(file, found.read, max_points)
    if cloud.normals is not None and "normals" not in beside:
        beside = {**beside, "normals": cloud.normals}
    return cloud_payload(cloud.points, options, beside, cloud.viewpoint)


def _part_options(parts: Mapping[str, Span], max_points: int) -> dict[str, bytes]:
    options: Mapping[str, bytes] = {}
    if "options" in parts:
        values = members(parts["options"], "options", DepthOptions.model_fields, unknown_option)
        options = option_texts(values, max_points)
    own = {name: part for name, part in parts.items() if name not in (*FILES, "options")}
    for name, part in own.items():
        check_length(name, part, max_points)
    alone = {name: json_text(name, bytes(part)) for name, part in own.items()}
    return dict(merged(options, alone))


# --------------------------------------------------------------------------------------------------------------- parts


def _split(boundary: bytes, body: bytearray) -> dict[str, Span]:
    """The parts by name, without a copy.

    Raises:
        Undecodable: cut off, or no form.
        Invalid: an unknown part, or one that is given twice.
    """
    form = _Form(body)
    parser = MultipartParser(
        boundary,
        {
            "on_part_begin": form.begin_part,
            "on_header_field": form.add_header_name,
            "on_header_value": form.add_header_value,
            "on_header_end": form.end_header,
            "on_headers_finished": form.check_name,
            "on_part_data": form.add_content,
            "on_part_end": form.end_part,
            "on_end": form.end,
        },
    )
    try:
        for start in range(0, len(body), _STEP):
            form.offset = start
            parser.write(bytes(memoryview(body)[start : start + _STEP]))
    except FormParserError as error:
        raise Undecodable(f"The form cannot be read: {shortened(str(error))}.") from None
    if not form.complete:
        raise Undecodable("The form does not end with its boundary; it was cut off, or the boundary is another one.")
    return form.parts


class _Form:
    """What the parser calls: gathers names, and where each part's content lies in the body."""

    def __init__(self, body: bytearray) -> None:
        self.parts: dict[str, Span] = {}
        self.complete = False
        self.offset = 0
        """Of what the parser is at, in the body."""
        self._body = body
        self.begin_part()

    def begin_part(self) -> None:
        self._header_name = bytearray()
        self._header_value = bytearray()
        self._name = ""
        self._start: int | None = None
        self._end = 0

    def add_header_name(self, data: bytes, start: int, end: int) -> None:
        self._header_name += self._bounded(self._header_name, data[start:end])

    def add_header_value(self, data: bytes, start: int, end: int) -> None:
        self._header_value += self._bounded(self._header_value, data[start:end])

    @staticmethod
    def _bounded(before: bytearray, more: bytes) -> bytes:
        """What a header goes on with: byte for byte is how it is read, so a long one would take long."""
        if len(before) + len(more) > _MAX_HEADER_BYTES:
            raise Undecodable(f"A header of the form has more than {_MAX_HEADER_BYTES} bytes; shorten it.")
        return more

    def end_header(self) -> None:
        if self._header_name.lower() == b"content-disposition":
            _, parameters = parse_options_header(bytes(self._header_value))
            self._name = parameters.get(b"name", b"").decode("utf-8", "replace")
        self._header_name.clear()
        self._header_value.clear()

    def check_name(self) -> None:
        if not self._name:
            raise Undecodable("A part of the form has no name in a Content-Disposition header.")
        if self._name in self.parts:
            raise Invalid(shortened(self._name), "is given twice in the form; give it once")
        if self._name not in PARTS:
            raise unknown_option(self._name)

    def add_content(self, _: bytes, start: int, end: int) -> None:
        if self._start is None:
            self._start = self.offset + start
        self._end = self.offset + end

    def end_part(self) -> None:
        self.parts[self._name] = Span(self._body, self._start or 0, self._end)

    def end(self) -> None:
        self.complete = True
