"""`GET /viewer`: a page that shows a cloud and its ranked grasps. It is a client of `POST /grasps` like any other.

Everything that it loads lies in this folder, so it works where no other network does.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from string import Template

from fastapi import APIRouter, Request, Response

from service.grasps import GraspEndpoint
from tesnet import formats

ADDRESS = "/viewer"

_FILES: Mapping[str, tuple[str, str]] = {
    ADDRESS: ("index.html", "text/html; charset=utf-8"),
    f"{ADDRESS}/viewer.js": ("viewer.js", "text/javascript; charset=utf-8"),
    f"{ADDRESS}/scene.js": ("scene.js", "text/javascript; charset=utf-8"),
    f"{ADDRESS}/viewer.css": ("viewer.css", "text/css; charset=utf-8"),
    f"{ADDRESS}/example.npy": ("example.npy", "application/x-npy"),
}

PAGE_PATHS = frozenset(_FILES)
"""What the page consists of."""

_HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' data:; frame-ancestors 'none'; base-uri 'none'",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-cache",
}


def viewer(endpoint: GraspEndpoint) -> APIRouter:
    """The page, its parts, and `POST /viewer/points`, which gives it the points of any body that `/grasps` takes."""
    router = APIRouter(tags=["viewer"])
    folder = Path(__file__).parent
    for address, (name, media_type) in _FILES.items():
        content = _with_formats((folder / name).read_bytes()) if address == ADDRESS else (folder / name).read_bytes()
        router.add_api_route(
            address,
            _sender(content, media_type),
            methods=["GET"],
            response_class=Response,
            summary="A page that shows a cloud and its grasps",
            include_in_schema=address == ADDRESS,
        )

    @router.post(f"{ADDRESS}/points", include_in_schema=False)
    async def points(request: Request) -> Response:
        return await endpoint.answer_points(request)

    return router


def _with_formats(page: bytes) -> bytes:
    """The page, told which files the service reads."""
    text = Template(page.decode()).substitute(listed=formats.LISTED, suffixes=",".join(formats.SUFFIXES))
    return text.encode()


def _sender(content: bytes, media_type: str) -> Callable[[], Awaitable[Response]]:
    async def send() -> Response:
        return Response(content, media_type=media_type, headers=_HEADERS)

    return send
