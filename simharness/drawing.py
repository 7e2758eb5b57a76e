"""Lines and words on white, as an SVG and as a PNG file that show the same.

Knows nothing of what is drawn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Literal

from PIL import Image, ImageDraw, ImageFont

COLOURS = ("#2563eb", "#16a34a", "#ca8a04", "#7c3aed", "#dc2626", "#0891b2", "#be185d", "#475569", "#65a30d")
INK, SOFT, GRID = "#0f172a", "#64748b", "#e2e8f0"
_PIXELS = 2
"""Of the PNG, for each of the drawing's units."""

Anchor = Literal["start", "middle", "end"]
_ANCHORS = {"start": "ls", "middle": "ms", "end": "rs"}


@dataclass(frozen=True, slots=True)
class Line:
    """Straight pieces from point to point, `width` thick; y points down."""

    points: Sequence[tuple[float, float]]
    colour: str
    width: float = 1.0


@dataclass(frozen=True, slots=True)
class Words:
    """A line of text whose baseline begins, has its middle or ends at a point."""

    x: float
    y: float
    text: str
    size: int = 11
    colour: str = SOFT
    anchor: Anchor = "middle"


@dataclass(frozen=True, slots=True)
class Drawing:
    """Lines and words on white, in units of a pixel of the SVG file."""

    width: int
    height: int
    shapes: Sequence[Line | Words]

    def svg(self) -> str:
        """The text of an SVG file."""
        size = f'width="{self.width}" height="{self.height}"'
        head = f'<svg xmlns="http://www.w3.org/2000/svg" {size} font-family="system-ui, sans-serif">'
        return "\n".join([head, f'<rect {size} fill="#ffffff"/>', *map(_svg, self.shapes), "</svg>"]) + "\n"

    def save_png(self, path: Path) -> None:
        """Writes a PNG file."""
        image = Image.new("RGB", (self.width * _PIXELS, self.height * _PIXELS), "#ffffff")
        canvas = ImageDraw.Draw(image)
        for shape in self.shapes:
            _paint(canvas, shape)
        image.save(path)


def _svg(shape: Line | Words) -> str:
    if isinstance(shape, Line):
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in shape.points)
        return f'<polyline points="{points}" stroke="{shape.colour}" stroke-width="{shape.width:g}" fill="none"/>'
    place = f'x="{shape.x:.1f}" y="{shape.y:.1f}" font-size="{shape.size}" text-anchor="{shape.anchor}"'
    return f'<text {place} fill="{shape.colour}">{escape(shape.text)}</text>'


def _paint(canvas: ImageDraw.ImageDraw, shape: Line | Words) -> None:
    if isinstance(shape, Line):
        points = [(x * _PIXELS, y * _PIXELS) for x, y in shape.points]
        canvas.line(points, fill=shape.colour, width=round(shape.width * _PIXELS), joint="curve")
    else:
        font = ImageFont.load_default(shape.size * _PIXELS)
        place = (shape.x * _PIXELS, shape.y * _PIXELS)
        canvas.text(place, shape.text, fill=shape.colour, font=font, anchor=_ANCHORS[shape.anchor])
