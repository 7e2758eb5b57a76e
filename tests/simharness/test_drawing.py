"""Lines and words: one drawing, two files."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree as ET

from PIL import Image

from simharness.drawing import Drawing, Line, Words

RED, GREEN = "#dc2626", "#16a34a"
DRAWING = Drawing(40, 30, [Line([(10, 15), (30, 15)], RED, 10), Words(20, 28, "<a & b>", colour=GREEN)])


def test_both_files_show_a_thick_line_where_it_is(tmp_path: Path) -> None:
    line = ET.fromstring(DRAWING.svg()).find(".//{*}polyline")
    assert line is not None
    assert (line.get("points"), line.get("stroke"), line.get("stroke-width")) == ("10.0,15.0 30.0,15.0", RED, "10")
    DRAWING.save_png(tmp_path / "drawing.png")
    with Image.open(tmp_path / "drawing.png") as image:
        assert image.size == (80, 60)
        red = tuple(bytes.fromhex(RED[1:]))
        for x, y, inside in ((40, 30, True), (24, 22, True), (40, 16, False), (14, 30, False), (66, 30, False)):
            assert (image.getpixel((x, y)) == red) == inside, (x, y)


def test_words_are_written_in_their_colour_and_cannot_break_the_file(tmp_path: Path) -> None:
    words = ET.fromstring(DRAWING.svg()).find(".//{*}text")
    assert words is not None
    assert (words.text, words.get("fill"), words.get("text-anchor")) == ("<a & b>", GREEN, "middle")
    DRAWING.save_png(tmp_path / "drawing.png")
    with Image.open(tmp_path / "drawing.png") as image:
        assert tuple(bytes.fromhex(GREEN[1:])) in {colour for _, colour in image.getcolors(1 << 24) or []}
