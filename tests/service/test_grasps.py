"""Bounded queue, deadlines, draining, clients that hang up: a real server whose predictor the test holds."""

from __future__ import annotations

import concurrent.futures
import gc
import logging
from collections.abc import Callable, Iterator
from typing import Any

import httpx
import pytest

from tests.conftest import PATIENCE_S
from tests.service.wire import POINTS, post, post_head

Serve = Callable[..., Any]
Eventually = Callable[[Callable[[], bool]], None]


@pytest.fixture
def pool() -> Iterator[concurrent.futures.ThreadPoolExecutor]:
    with concurrent.futures.ThreadPoolExecutor(8) as executor:
        yield executor


def test_health_answers_while_a_grasp_is_computed(serve: Serve, pool: concurrent.futures.ThreadPoolExecutor) -> None:
    server = serve()
    posted = pool.submit(post, server.url)
    assert server.predictor.entered.acquire(timeout=PATIENCE_S)
    for path in ("/health/live", "/health/ready", "/metrics", "/model"):
        assert httpx.get(server.url + path).status_code == 200
    assert not posted.done()
    server.predictor.gate.set()
    assert posted.result().status_code == 200


def test_a_full_queue_is_a_429_that_says_when_to_come_back(
    serve: Serve, pool: concurrent.futures.ThreadPoolExecutor, eventually: Eventually
) -> None:
    server = serve(queue_size=2)
    running = pool.submit(post, server.url)
    assert server.predictor.entered.acquire(timeout=PATIENCE_S)
    waiting = [pool.submit(post, server.url) for _ in range(2)]
    eventually(lambda: "grasp_queue_depth 2.0" in httpx.get(f"{server.url}/metrics").text)

    refused = post(server.url)

    assert refused.status_code == 429
    assert refused.json()["title"] == "The queue is full"
    assert int(refused.headers["Retry-After"]) >= 1
    server.predictor.gate.set()
    assert [answer.result().status_code for answer in (running, *waiting)] == [200] * 3
    assert post(server.url).status_code == 200


def test_a_deadline_that_passes_is_a_504_and_the_queued_query_is_never_predicted(
    serve: Serve, pool: concurrent.futures.ThreadPoolExecutor, eventually: Eventually
) -> None:
    server = serve(queue_size=1)
    running = pool.submit(post, server.url, seed=1)
    assert server.predictor.entered.acquire(timeout=PATIENCE_S)

    late = post(server.url, seed=2, X_Request_Timeout="0.9")

    assert late.status_code == 504
    assert late.headers["Content-Type"] == "application/problem+json"
    assert "0.9 s" in late.json()["detail"]
    next_one = pool.submit(post, server.url, seed=3)  # the place in the queue is free again
    eventually(lambda: "grasp_queue_depth 1.0" in httpx.get(f"{server.url}/metrics").text)
    server.predictor.gate.set()
    assert running.result().status_code == next_one.result().status_code == 200
    assert server.predictor.seeds == [1, 3]


def test_an_error_that_comes_after_the_deadline_leaves_no_line_of_asyncio_in_the_log(
    serve: Serve, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(logging.getLogger("service.request"), "disabled", True)  # its line would keep the fault alive
    server = serve()
    server.predictor.fault = RuntimeError("too late")
    seconds = 0.2
    while not server.predictor.entered.acquire(timeout=0.1):  # where even that is over before the prediction begins
        assert post(server.url, X_Request_Timeout=f"{seconds}").status_code == 504
        seconds *= 2
    server.predictor.gate.set()
    assert post(server.url).status_code == 500  # by now the first one's error is there
    server.predictor.fault = None
    assert post(server.url).status_code == 200
    gc.collect()
    assert "asyncio" not in {record.name for record in caplog.records}


def test_requests_that_wait_are_predicted_together(
    serve: Serve, pool: concurrent.futures.ThreadPoolExecutor, eventually: Eventually
) -> None:
    server = serve(max_batch=4)
    running = pool.submit(post, server.url)
    assert server.predictor.entered.acquire(timeout=PATIENCE_S)
    waiting = [pool.submit(post, server.url, seed=seed) for seed in (1, 2, 3)]
    eventually(lambda: "grasp_queue_depth 3.0" in httpx.get(f"{server.url}/metrics").text)
    server.predictor.gate.set()
    assert [answer.result().status_code for answer in (running, *waiting)] == [200] * 4
    assert server.predictor.batches == [1, 3]
    assert 'grasp_batch_size_bucket{le="2.0"} 1.0' in httpx.get(f"{server.url}/metrics").text


def test_the_default_deadline_is_a_setting(serve: Serve) -> None:
    assert post(serve(request_timeout=0.2).url).status_code == 504


def test_a_body_that_does_not_arrive_in_time_is_a_504(serve: Serve) -> None:
    with post_head(serve(request_timeout=0.2).url) as connection:
        assert connection.recv(4096).startswith(b"HTTP/1.1 504 ")


def test_a_client_that_hangs_up_frees_its_place_in_the_queue(
    serve: Serve, pool: concurrent.futures.ThreadPoolExecutor, eventually: Eventually
) -> None:
    server = serve(queue_size=1)
    running = pool.submit(post, server.url, seed=1)
    assert server.predictor.entered.acquire(timeout=PATIENCE_S)
    with post_head(server.url, "/grasps?seed=2") as connection:
        connection.sendall(POINTS)
        eventually(lambda: "grasp_queue_depth 1.0" in httpx.get(f"{server.url}/metrics").text)

    eventually(lambda: "grasp_queue_depth 0.0" in httpx.get(f"{server.url}/metrics").text)
    eventually(lambda: 'status="499"} 1.0' in httpx.get(f"{server.url}/metrics").text)
    server.predictor.gate.set()
    assert running.result().status_code == 200
    assert post(server.url, seed=3).status_code == 200
    assert server.predictor.seeds == [1, 3]


def test_a_client_that_hangs_up_in_the_middle_of_its_body_is_forgotten(serve: Serve, eventually: Eventually) -> None:
    server = serve()
    with post_head(server.url) as connection:
        connection.sendall(POINTS[:100])
        eventually(lambda: server.endpoint.active == 1)
    eventually(lambda: server.endpoint.active == 0)
    eventually(lambda: 'status="499"} 1.0' in httpx.get(f"{server.url}/metrics").text)


def test_draining_refuses_what_is_new_and_finishes_what_was_taken(
    serve: Serve, pool: concurrent.futures.ThreadPoolExecutor
) -> None:
    server = serve()
    running = pool.submit(post, server.url)
    assert server.predictor.entered.acquire(timeout=PATIENCE_S)

    server.endpoint.drain()

    refused = post(server.url)
    assert (refused.status_code, refused.headers["Retry-After"]) == (503, "1")
    ready = httpx.get(f"{server.url}/health/ready")
    assert (ready.status_code, ready.headers["Content-Type"]) == (503, "application/problem+json")
    assert httpx.get(f"{server.url}/health/live").status_code == 200
    server.predictor.gate.set()
    assert running.result().status_code == 200


def test_a_fault_of_the_predictor_is_a_500_that_tells_no_details_and_the_next_request_is_served(serve: Serve) -> None:
    server = serve()
    server.predictor.gate.set()
    server.predictor.fault = RuntimeError("secret of line 42")
    answer = post(server.url)
    assert answer.status_code == 500
    assert answer.headers["Content-Type"] == "application/problem+json"
    assert answer.headers["X-Request-ID"] == answer.json()["request_id"]
    assert "secret" not in answer.text
    server.predictor.fault = None
    assert post(server.url).status_code == 200
