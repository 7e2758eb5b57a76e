"""API keys and cross-origin requests, as a server with such settings answers."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from service.access import DOCS_FILES, OPEN_PATHS
from service.app import create_app
from service.inference_protocol.tensors import HEADER_LENGTH
from service.settings import load_settings
from service.viewer import PAGE_PATHS

Serve = Callable[..., Any]

ROOT = Path(__file__).parents[2]

BODY = np.zeros((20, 3), np.float32).tobytes()
OCTETS = {"Content-Type": "application/octet-stream"}
GOOD = [
    {"Authorization": "Bearer second-key"},
    {"authorization": "bearer first-key"},
    {"X-API-Key": "first-key"},
    {"X-API-Key": "first-key", "Authorization": "Basic cHJveHk6cGFzcw=="},
    {"X-API-Key": "first-key", "Authorization": "Bearer of-a-proxy"},
    {"X-API-Key": "of-a-proxy", "Authorization": "Bearer first-key"},
]
BAD: list[dict[str, Any]] = [
    {},
    {"Authorization": "Bearer"},
    {"Authorization": "Bearer first-ke"},
    {"Authorization": "Bearer first-key2"},
    {"Authorization": "Basic first-key"},
    {"Authorization": "first-key"},
    {"X-API-Key": ""},
    {"X-API-Key": "first-key,second-key"},
    {"X-API-Key": b"f\xff"},
    {"X-API-Key": "first-ke", "Authorization": "Bearer second-ke"},
]


def settings(**environment: str) -> dict[str, Any]:
    chosen = load_settings(environment)
    return {name: getattr(chosen, name) for name in chosen.model_fields_set}


@pytest.fixture
def guarded(serve: Serve) -> str:
    server = serve(**settings(GRASP_API_KEYS="first-key,second-key"))
    server.predictor.gate.set()
    return str(server.url)


def test_a_key_opens_and_nothing_else_does(guarded: str) -> None:
    for headers in GOOD:
        assert httpx.post(f"{guarded}/grasps", content=BODY, headers={**OCTETS, **headers}).status_code == 200
    for refused_headers in BAD:
        refused = httpx.post(f"{guarded}/grasps", content=BODY, headers={**OCTETS, **refused_headers})
        assert refused.status_code == 401
        assert refused.headers["Content-Type"] == "application/problem+json"
        assert refused.headers["WWW-Authenticate"].startswith("Bearer ")
        assert refused.json()["request_id"] == refused.headers["X-Request-ID"]
        assert "-key" not in refused.text


def test_every_other_route_needs_a_key_too(guarded: str) -> None:
    app = create_app(load_settings({}), lambda: pytest.fail("is not started"))
    static = {f"{DOCS_FILES}/{name}" for name in ("swagger-ui-bundle.js", "swagger-ui.css", "favicon.png")}
    pages = {"/docs", "/docs/oauth2-redirect", "/openapi.json", "/viewer/points"} | PAGE_PATHS | static
    paths = pages | {re.sub(r"\{\w+\}", "tesnet", path) for path in app.openapi()["paths"]}
    assert paths >= OPEN_PATHS
    for path in paths:
        status = httpx.get(f"{guarded}{path}").status_code
        assert (status == 200) if path in OPEN_PATHS else (status == 401), path


def test_the_open_routes_are_those_that_the_interface_says_are_open() -> None:
    """Beneath a page that is open lie its files, and nothing that answers about clouds or models."""
    section = (ROOT / "docs" / "api.md").read_text().split("## API keys")[1]
    (sentence,) = re.findall(r"every route wants one of them, but for (.*?), whose page", section, re.DOTALL)
    said = set(re.findall(r"`(/[^`]*)`", sentence))
    static = {f"{DOCS_FILES}/{name}" for name in ("swagger-ui-bundle.js", "swagger-ui.css", "favicon.png")}
    of_pages = static | {"/docs/oauth2-redirect"} | {path for path in PAGE_PATHS if re.search(r"\.\w+$", path)}
    assert said | of_pages == OPEN_PATHS
    assert not said & of_pages


def test_the_reference_tells_how_a_key_is_given() -> None:
    open_document = create_app(load_settings({}), lambda: pytest.fail("is not started")).openapi()
    assert "security" not in open_document
    app = create_app(load_settings({"GRASP_API_KEYS": "k"}), lambda: pytest.fail("is not started"))
    document = app.openapi()
    assert [list(way) for way in document["security"]] == [["bearer"], ["key"]]
    assert set(document["components"]["securitySchemes"]) == {"bearer", "key"}
    for path, operations in document["paths"].items():
        for operation in operations.values():
            assert (operation.get("security") == []) == (path in OPEN_PATHS), path


def test_browsers_are_not_let_in_unless_configured(serve: Serve, guarded: str) -> None:
    page = {"Origin": "https://robot.example"}
    preflight = {**page, "Access-Control-Request-Method": "POST", "Access-Control-Request-Headers": "X-API-Key"}
    for answer in (
        httpx.get(f"{guarded}/health/live", headers=page),
        httpx.options(f"{guarded}/grasps", headers=preflight),
    ):
        assert not any(name.startswith("access-control-") for name in answer.headers)

    url = serve(**settings(GRASP_API_KEYS="k", GRASP_CORS_ORIGINS="https://robot.example")).url
    allowed = httpx.options(f"{url}/grasps", headers=preflight)
    assert allowed.status_code == 200
    assert allowed.headers["Access-Control-Allow-Origin"] == "https://robot.example"
    assert httpx.get(f"{url}/model", headers={**page, "X-API-Key": "k"}).headers["Access-Control-Allow-Origin"]
    other = httpx.get(f"{url}/model", headers={"Origin": "https://evil.example", "X-API-Key": "k"})
    assert "Access-Control-Allow-Origin" not in other.headers


def test_a_page_may_send_and_read_every_header_that_the_documentation_names(serve: Serve) -> None:
    url = serve(**settings(GRASP_API_KEYS="k", GRASP_CORS_ORIGINS="https://robot.example")).url
    page = {"Origin": "https://robot.example"}
    document = httpx.get(f"{url}/openapi.json").json()
    operations = [operation for path in document["paths"].values() for operation in path.values()]
    parameters = [parameter for operation in operations for parameter in operation.get("parameters", ())]
    answers = [answer for operation in operations for answer in operation["responses"].values()]
    sent = {parameter["name"] for parameter in parameters if parameter["in"] == "header"}
    assert sent >= {"X-Request-ID", "X-Request-Timeout"}
    sent |= {"Authorization", "X-API-Key", "Accept", "Content-Type", HEADER_LENGTH}
    preflight = {**page, "Access-Control-Request-Method": "POST"}
    for name in (*sent, "X-Other"):
        asked = httpx.options(f"{url}/grasps", headers={**preflight, "Access-Control-Request-Headers": name})
        assert (asked.status_code == 200) == (name in sent), name
    read = {"X-Request-ID", HEADER_LENGTH}.union(*(answer.get("headers", ()) for answer in answers))
    shown = httpx.get(f"{url}/model", headers={**page, "X-API-Key": "k"}).headers["Access-Control-Expose-Headers"]
    assert read == set(shown.split(", "))
