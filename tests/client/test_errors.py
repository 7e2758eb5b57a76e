"""Errors that can be sent from one process to another, and have a class a status."""

from __future__ import annotations

import pickle

import pytest

import client
from client.errors import problem_class

CLASSES: list[type[client.ProblemError]] = [
    client.ProblemError,
    client.BadRequest,
    client.Unauthorized,
    client.PayloadTooLarge,
    client.UnsupportedMediaType,
    client.InvalidRequest,
    client.Overloaded,
    client.ServiceFault,
    client.DeadlineExceeded,
]


@pytest.mark.parametrize(
    "error",
    [
        client.InvalidArgument("points", "bad"),
        client.UnexpectedResponse("odd", 200),
        client.ServiceUnreachable("gone"),
        client.ServiceTimeout("late"),
        *(one(429, "Busy", "Queue full.", "r-1", {"limit": 4}, 2.5) for one in CLASSES),
        *(one(503, "Busy", "Queue full.") for one in CLASSES),
    ],
)
def test_errors_survive_the_way_back_from_a_worker_process(error: Exception) -> None:
    same = pickle.loads(pickle.dumps(error))
    assert type(same) is type(error)
    assert (str(same), vars(same)) == (str(error), vars(error))


def test_a_problem_has_every_field_under_its_name() -> None:
    error = client.Overloaded(429, "Busy", "Queue full.", "r-1", {"limit": 4}, 2.5)
    assert str(error) == "429 Busy: Queue full. (request r-1)"
    assert vars(error) == {
        "status": 429,
        "title": "Busy",
        "detail": "Queue full.",
        "request_id": "r-1",
        "problem": {"limit": 4},
        "retry_after": 2.5,
    }
    assert str(client.Overloaded(429, "Busy", "Queue full.")) == "429 Busy: Queue full."


def test_every_status_has_the_class_that_the_table_names() -> None:
    named = {
        400: client.BadRequest,
        401: client.Unauthorized,
        413: client.PayloadTooLarge,
        415: client.UnsupportedMediaType,
        422: client.InvalidRequest,
        429: client.Overloaded,
        503: client.Overloaded,
        504: client.DeadlineExceeded,
    }
    for status in range(400, 600):
        assert problem_class(status) is named.get(status, client.ServiceFault if status >= 500 else client.ProblemError)
