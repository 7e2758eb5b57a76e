"""Bounded queue, deadlines, draining, clients that hang up: a real server whose predictor the test holds."""

from __future__ import annotations

import concurrent.futures
import gc
import logging
import threading
import tracemalloc
from collections.abc import Callable, Iterator
from typing import Any

import httpx
import pytest

from service import payloads
from service.batching import PredictionWorker
from service.grasps import SMALL_BODY
from tests.conftest import PATIENCE_S
from tests.service.wire import OCTETS, POINTS, connect, post, post_head, status_of

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


def test_both_time_outs_of_a_request_count_from_its_arrival(serve: Serve, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not from when its body had come or was decoded: then they would lie less than 90 s apart, or more."""
    times: list[tuple[float, float]] = []
    submit = PredictionWorker.submit

    def noted(worker: PredictionWorker, query: Any, deadline: float, begin_by: float, client: Any) -> Any:
        times.append((deadline, begin_by))
        return submit(worker, query, deadline, begin_by, client)

    monkeypatch.setattr(PredictionWorker, "submit", noted)
    server = serve()
    server.predictor.gate.set()
    points = {"name": "points", "datatype": "FP32", "shape": [2, 3], "data": [0.0] * 6}
    answer = httpx.post(
        f"{server.url}/v2/models/tesnet/infer",
        json={"inputs": [points], "parameters": {"timeout": 200_000_000}},
        headers={"X-Request-Timeout": "290"},
        timeout=PATIENCE_S,
    )
    assert answer.status_code == 200
    ((deadline, begin_by),) = times
    assert deadline - begin_by == pytest.approx(90, abs=1e-7)


def test_a_body_that_does_not_arrive_in_time_is_a_504(serve: Serve) -> None:
    with post_head(serve(request_timeout=0.2).url) as connection:
        assert status_of(connection) == 504


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


def test_what_waits_holds_its_cloud_and_not_its_body(
    serve: Serve, pool: concurrent.futures.ThreadPoolExecutor, eventually: Eventually
) -> None:
    server = serve()
    body = b'{"points": [[0, 0, 1], [0, 0.1, 1]]' + b" " * 4_000_000 + b"}"
    json = {"Content-Type": "application/json"}
    tracemalloc.start()
    try:
        asked = [pool.submit(httpx.post, f"{server.url}/grasps", content=body, headers=json) for _ in range(6)]
        eventually(lambda: "grasp_queue_depth 5.0" in httpx.get(f"{server.url}/metrics").text)
        assert server.memory.held == 6 * 24
        in_service = tracemalloc.take_snapshot().filter_traces([tracemalloc.Filter(True, "*/service/intake.py")])
        assert sum(trace.size for trace in in_service.traces) < 4_000_000
    finally:
        tracemalloc.stop()
    server.predictor.gate.set()
    assert [answer.result().status_code for answer in asked] == [200] * 6
    eventually(lambda: server.memory.held == 0)


def post_cloud(url: str, points: int) -> httpx.Response:
    return httpx.post(f"{url}/grasps", content=bytes(12 * points), headers=OCTETS, timeout=PATIENCE_S)


def test_clouds_that_wait_are_limited_together_whatever_their_bodies_were(
    serve: Serve, pool: concurrent.futures.ThreadPoolExecutor, eventually: Eventually
) -> None:
    server = serve(max_held_mb=0.25)
    asked = [pool.submit(post_cloud, server.url, 10_000) for _ in range(8)]
    eventually(lambda: sum(answer.done() for answer in asked) == 6)
    assert server.memory.held == 2 * 120_000
    server.predictor.gate.set()
    assert sorted(answer.result().status_code for answer in asked) == [200] * 2 + [429] * 6


def test_a_small_body_is_decoded_beside_large_ones(
    serve: Serve, pool: concurrent.futures.ThreadPoolExecutor, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The large bodies are held in their decoder, so nothing here depends on how long they take."""
    server = serve()
    server.predictor.gate.set()
    gate, entered = threading.Event(), threading.Semaphore(0)
    decode = payloads._DECODERS["application/octet-stream"]

    def held(body: bytearray, max_points: int) -> payloads.Payload:
        if len(body) > SMALL_BODY:
            entered.release()
            assert gate.wait(PATIENCE_S)
        return decode(body, max_points)

    monkeypatch.setitem(payloads._DECODERS, "application/octet-stream", held)
    asked = [pool.submit(post_cloud, server.url, 100_000) for _ in range(3)]
    assert entered.acquire(timeout=PATIENCE_S)
    assert post(server.url).status_code == 200
    gate.set()
    assert [answer.result().status_code for answer in asked] == [200] * 3


def test_a_prediction_whose_client_has_gone_or_whose_deadline_passed_is_given_up(
    serve: Serve, eventually: Eventually
) -> None:
    server = serve()
    with post_head(server.url, "/grasps?seed=1") as connection:
        connection.sendall(POINTS)
        assert server.predictor.entered.acquire(timeout=PATIENCE_S)
    eventually(lambda: 'status="499"} 1.0' in httpx.get(f"{server.url}/metrics").text)
    server.predictor.gate.set()
    eventually(lambda: server.predictor.given_up == [1])
    server.predictor.gate.clear()
    assert post(server.url, seed=2, X_Request_Timeout="0.2").status_code == 504
    server.predictor.gate.set()
    eventually(lambda: server.predictor.given_up == [1, 2])


def test_one_key_cannot_take_all_places(
    serve: Serve, pool: concurrent.futures.ThreadPoolExecutor, eventually: Eventually
) -> None:
    server = serve(queue_size=4, api_keys="one,other", client_places=2)
    running = pool.submit(post, server.url, X_API_Key="one")
    assert server.predictor.entered.acquire(timeout=PATIENCE_S)
    waiting = [pool.submit(post, server.url, X_API_Key="one") for _ in range(2)]
    eventually(lambda: server.endpoint._worker.depth == 2)
    refused = post(server.url, X_API_Key="one")
    assert (refused.status_code, "of yours" in refused.json()["detail"]) == (429, True)
    other = pool.submit(post, server.url, X_API_Key="other")
    eventually(lambda: server.endpoint._worker.depth == 3)
    server.predictor.gate.set()
    assert [answer.result().status_code for answer in (running, *waiting, other)] == [200] * 4


def test_one_address_behind_a_trusted_proxy_cannot_take_all_places(
    serve: Serve, pool: concurrent.futures.ThreadPoolExecutor, eventually: Eventually
) -> None:
    server = serve(queue_size=4, trusted_proxies="127.0.0.1", client_places=1)
    running = pool.submit(post, server.url, X_Forwarded_For="10.1.1.1")
    assert server.predictor.entered.acquire(timeout=PATIENCE_S)
    waiting = pool.submit(post, server.url, X_Forwarded_For="10.1.1.1")
    eventually(lambda: server.endpoint._worker.depth == 1)
    refused = post(server.url, X_Forwarded_For="10.1.1.1")
    assert (refused.status_code, "of yours" in refused.json()["detail"]) == (429, True)
    other = pool.submit(post, server.url, X_Forwarded_For="10.1.1.2")
    eventually(lambda: server.endpoint._worker.depth == 2)
    server.predictor.gate.set()
    assert [answer.result().status_code for answer in (running, waiting, other)] == [200] * 3


def test_without_trusted_proxies_an_address_means_nothing(
    serve: Serve, pool: concurrent.futures.ThreadPoolExecutor, eventually: Eventually
) -> None:
    server = serve(queue_size=4, client_places=1)
    asked = [pool.submit(post, server.url, X_Forwarded_For="10.1.1.1") for _ in range(4)]
    assert server.predictor.entered.acquire(timeout=PATIENCE_S)
    eventually(lambda: server.endpoint._worker.depth == 3)
    server.predictor.gate.set()
    assert [answer.result().status_code for answer in asked] == [200] * 4


def test_a_lone_client_is_never_told_that_the_queue_is_full(serve: Serve) -> None:
    """One request after the other on one connection, some of them sent before the answer to the last one came."""
    server = serve(queue_size=1)
    server.predictor.gate.set()
    request = (
        b"POST /grasps HTTP/1.1\r\nHost: test\r\nContent-Type: application/octet-stream\r\n"
        b"X-Request-Timeout: 5\r\nContent-Length: %d\r\n\r\n" % len(POINTS)
    ) + POINTS
    with connect(server.url) as connection:
        received = b""
        for burst in (1, 1, 1, 20, 1, 20):
            connection.sendall(request * burst)
            wanted = received.count(b"HTTP/1.1 ") + burst
            while received.count(b"HTTP/1.1 ") < wanted or not received.endswith(b"}"):
                received += connection.recv(65_536)
    assert received.count(b"HTTP/1.1 200 ") == received.count(b"HTTP/1.1 ")
