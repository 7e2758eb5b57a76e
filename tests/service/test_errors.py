"""The table of problems, and what the router refuses."""

from __future__ import annotations

import httpx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.errors import PROBLEMS, ServiceError, shortened
from tests.service.wire import problem_of


@pytest.mark.parametrize("path", ["/", "/grasp", "/grasps/", "/health", "/v2/repository/index"])
def test_another_path_is_a_404(http: httpx.Client, path: str) -> None:
    problem_of(http.get(path), 404, "/docs")


def test_another_method_is_a_405_that_names_the_right_one(http: httpx.Client) -> None:
    answer = http.get("/grasps")
    problem_of(answer, 405, "POST")
    assert answer.headers["Allow"] == "POST"
    problem_of(http.post("/health/live"), 405, "GET")
    problem_of(http.request("BREW", "/grasps"), 405)


def _kinds(base: type[Exception]) -> set[type[Exception]]:
    return {kind for child in base.__subclasses__() for kind in (child, *_kinds(child))}


def test_whatever_the_service_refuses_a_request_for_has_a_row_of_its_own() -> None:
    public = {kind for kind in _kinds(ServiceError) if not kind.__name__.startswith("_")}
    assert public <= set(PROBLEMS)
    assert all(400 <= PROBLEMS[kind].status < 600 for kind in public)


@given(st.text(max_size=400), st.integers(4, 100))
def test_what_a_client_sent_is_short_and_printable_in_a_message(text: str, limit: int) -> None:
    shown = shortened(text, limit)
    assert len(shown) <= limit
    assert shown.isprintable()
    if text.isprintable() and len(text) <= limit:
        assert shown == text
