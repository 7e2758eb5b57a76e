from __future__ import annotations

import asyncio
import dataclasses
import gzip
import inspect
import json
import socket
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any
from urllib.parse import parse_qs, urlsplit

import httpx
import numpy as np
import pytest

import client
from client import session
from client.request import depth_request
from service.payloads import decoder_for
from service.schemas import MAX_TIMEOUT_S
from tesnet.geometry import CameraIntrinsics, Pose
from tests.client.conftest import Answering, Call, Peer, Reset, ScriptedServer, Stall, answering, model_document
from tests.conftest import PATIENCE_S

QUICK = {"retry": client.RetryPolicy(max_retries=2, first_delay=0.001)}
Points = np.ndarray[Any, np.dtype[np.float32]]
StartPeer = Callable[[Callable[[socket.socket], None]], Peer]
Refusing = Callable[..., Answering]


def test_a_grasp_request_and_its_reply(
    call: Call, server: ScriptedServer, points: Points, found: dict[str, Any]
) -> None:
    server.script = [answering(found)]
    reply = call(server.url, "grasps", points, up=(0, 0, 1), max_grasps=3, request_id="mine", timeout=200)
    assert reply.to_dict() == found
    (received,) = server.received
    assert (received.method, urlsplit(received.target).path) == ("POST", "/grasps")
    assert received.headers["content-type"] == "application/octet-stream"
    assert received.headers["x-request-id"] == "mine"
    assert 100 < float(received.headers["x-request-timeout"]) < 200
    np.testing.assert_array_equal(np.frombuffer(received.body, "<f4").reshape(-1, 3), points)
    query = parse_qs(urlsplit(received.target).query)
    assert {name: json.loads(value[0]) for name, value in query.items()} == {"up": [0, 0, 1], "max_grasps": 3}


def test_all_that_is_said_of_a_depth_image_is_sent(call: Call, server: ScriptedServer, found: dict[str, Any]) -> None:
    server.script = [answering(found)]
    depth = np.full((6, 8), 0.5)
    image: dict[str, Any] = {
        "mask": np.eye(6, 8, dtype=np.uint8),
        "T_cloud_camera": Pose.random(np.random.default_rng(0), reach=0.3).matrix,
        "depth_scale": 0.0005,
        "stride": 3,
    }
    camera = {"fx": 50.0, "fy": 60.0, "cx": 3.0, "cy": 2.5}
    options = {"seed": 4, "gripper": "rg2"}
    call(server.url, "grasps_from_depth", depth, intrinsics=camera, **image, **options, request_id="mine", timeout=200)
    (received,) = server.received
    expected = depth_request(depth, CameraIntrinsics(8, 6, **camera), options, **image)
    payloads = [
        decoder_for(kind)(bytearray(body), 1000)
        for kind, body in (
            (received.headers["content-type"], received.body),
            (expected.headers["Content-Type"], expected.content),
        )
    ]
    for sent, wanted in zip(*map(dataclasses.astuple, payloads), strict=True):
        np.testing.assert_equal(sent, wanted)
    assert received.headers["x-request-id"] == "mine"
    assert 100 < float(received.headers["x-request-timeout"]) < 200


def test_normals_and_views_are_sent_with_their_points(
    call: Call, server: ScriptedServer, points: Points, found: dict[str, Any]
) -> None:
    server.script = [answering(found)]
    normals, index = np.roll(points, 1, axis=1), np.arange(len(points)) % 2
    call(server.url, "grasps", points, normals=normals, view_index=index, viewpoint=[[0, 0, 1], [1, 0, 1]])
    (received,) = server.received
    payload = decoder_for(received.headers["content-type"])(bytearray(received.body), len(points))
    np.testing.assert_array_equal(payload.points, points)
    np.testing.assert_array_equal(payload.normals, normals)
    np.testing.assert_array_equal(payload.view_index, index)


@pytest.mark.parametrize("timeout", [0.0, -1.0, MAX_TIMEOUT_S * 1.01, float("nan")])
def test_a_time_out_that_no_request_may_have_is_refused_for_the_client_and_for_a_call(
    call: Call, server: ScriptedServer, timeout: float
) -> None:
    server.script = [answering(model_document())]
    with pytest.raises(client.InvalidArgument, match="timeout"):
        call(server.url, "model", timeout=timeout)
    with pytest.raises(client.InvalidArgument, match="timeout"):
        call(server.url, "model", client={"timeout": timeout})
    assert server.received == []
    call(server.url, "model", timeout=MAX_TIMEOUT_S)


def test_headers_of_the_caller_replace_none_that_a_request_needs(
    call: Call, server: ScriptedServer, points: Points, found: dict[str, Any]
) -> None:
    server.script = [answering(found)]
    headers = {"Content-Type": "text/plain", "Accept": "text/html", "X-Request-ID": "other", "X-Robot": "7"}
    call(server.url, "grasps", points, client={"headers": headers}, request_id="mine")
    (received,) = server.received
    told = {name: received.headers[name] for name in ("content-type", "accept", "x-request-id", "x-robot")}
    assert told == {
        "content-type": "application/octet-stream",
        "accept": "application/json",
        "x-request-id": "mine",
        "x-robot": "7",
    }


def test_a_request_id_is_made_up_and_kept_over_retries(
    call: Call, server: ScriptedServer, points: Points, found: dict[str, Any]
) -> None:
    server.script = [Reset(), answering(found)]
    call(server.url, "grasps", points, client=QUICK)
    first, second = (received.headers["x-request-id"] for received in server.received)
    assert first == second
    assert len(first) == 32


def test_an_api_key_is_sent_with_every_request(call: Call, server: ScriptedServer) -> None:
    server.script = [answering(model_document())]
    call(server.url, "model", client={"api_key": "s3cret"})
    assert server.received[0].headers["x-api-key"] == "s3cret"
    with pytest.raises(client.InvalidArgument, match="api_key"):
        call(server.url, "model", client={"api_key": "two\nlines"})


def test_a_path_prefix_and_headers_are_kept(call: Call, server: ScriptedServer) -> None:
    server.script = [answering(model_document())]
    call(f"{server.url}/robot/7/", "model", client={"headers": {"Authorization": "Bearer key"}})
    assert server.received[0].target == "/robot/7/model"
    assert server.received[0].headers["authorization"] == "Bearer key"


def test_a_service_on_this_machine_is_asked_past_the_environments_proxy(
    call: Call, server: ScriptedServer, closed_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("HTTP_PROXY", "http_proxy", "ALL_PROXY", "all_proxy"):
        monkeypatch.setenv(name, "nonsense://" + closed_url)
    for name in ("NO_PROXY", "no_proxy"):
        monkeypatch.delenv(name, raising=False)
    server.script = [answering({"status": "ready"})]
    assert call(server.url, "ready") is True
    assert call(server.url.replace("127.0.0.1", "localhost"), "ready") is True
    assert [received.target for received in server.received] == ["/health/ready"] * 2


def test_a_proxy_that_is_told_is_asked_for_a_service_on_this_machine(
    call: Call, server: ScriptedServer, closed_url: str
) -> None:
    server.script = [answering({"status": "ready"})]
    assert call(closed_url, "ready", client={"proxy": server.url}) is True
    assert [received.target for received in server.received] == [f"{closed_url}/health/ready"]
    with pytest.raises(client.InvalidArgument, match="proxy"):
        call(closed_url, "ready", client={"proxy": "nonsense"})


def test_the_environments_proxy_is_asked_for_other_machines(
    call: Call, server: ScriptedServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("http_proxy", server.url)
    monkeypatch.delenv("no_proxy", raising=False)
    monkeypatch.delenv("NO_PROXY", raising=False)
    server.script = [answering({"status": "ready"})]
    assert call("http://robot.invalid", "ready") is True
    assert [received.target for received in server.received] == ["http://robot.invalid/health/ready"]


def test_the_model_says_what_is_loaded(call: Call, server: ScriptedServer) -> None:
    server.script = [answering(model_document())]
    model = call(server.url, "model")
    assert [network.name for network in model.models] == ["tesnet"]
    assert model.limits.max_points == 1000
    assert model.frame_conventions == ("panda", "graspnet")
    assert model.to_dict() == model_document()


@pytest.mark.parametrize("lost", [1, 2])
def test_a_lost_connection_is_tried_again(
    call: Call, server: ScriptedServer, points: Points, found: dict[str, Any], lost: int
) -> None:
    server.script = [*(Reset() for _ in range(lost)), answering(found)]
    assert len(call(server.url, "grasps", points, client=QUICK)) == 3
    assert len(server.received) == lost + 1
    assert len({received.body for received in server.received}) == 1


def test_a_connection_lost_on_every_try_is_unreachable(call: Call, server: ScriptedServer, points: Points) -> None:
    server.script = [Reset()]
    with pytest.raises(client.ServiceUnreachable, match=f"cannot reach {server.url}"):
        call(server.url, "grasps", points, client=QUICK)
    assert len(server.received) == 3


def test_a_refused_connection_is_unreachable(call: Call, closed_url: str, points: Points) -> None:
    with pytest.raises(client.ServiceUnreachable, match="is the service running"):
        call(closed_url, "grasps", points, client=QUICK)


@pytest.mark.parametrize("status", [429, 503])
def test_an_overloaded_service_is_asked_again(
    call: Call, server: ScriptedServer, points: Points, found: dict[str, Any], refusing: Refusing, status: int
) -> None:
    server.script = [refusing(status, "0"), refusing(status), answering(found)]
    assert len(call(server.url, "grasps", points, client=QUICK)) == 3
    assert len(server.received) == 3


def test_a_service_that_stays_overloaded_is_an_error_with_its_wait(
    call: Call, server: ScriptedServer, points: Points, refusing: Refusing
) -> None:
    server.script = [refusing(503, "0")]
    with pytest.raises(client.Overloaded) as caught:
        call(server.url, "grasps", points, client=QUICK)
    assert (caught.value.status, caught.value.retry_after) == (503, 0)
    assert len(server.received) == 3


def test_a_wait_longer_than_the_time_left_is_not_begun(
    call: Call, server: ScriptedServer, points: Points, refusing: Refusing
) -> None:
    server.script = [refusing(429, "4")]
    with pytest.raises(client.Overloaded) as caught:
        call(server.url, "grasps", points, timeout=3)
    assert caught.value.retry_after == 4
    assert len(server.received) == 1


@pytest.mark.parametrize("status", [400, 401, 404, 413, 415, 422, 500, 504])
def test_other_refusals_are_not_tried_again(
    call: Call, server: ScriptedServer, points: Points, refusing: Refusing, status: int
) -> None:
    server.script = [refusing(status)]
    with pytest.raises(client.ProblemError, match=r"A detail\. \(request r-1\)") as caught:
        call(server.url, "grasps", points, client=QUICK)
    assert caught.value.status == status
    assert len(server.received) == 1


@pytest.mark.parametrize("status", [500, 502])
def test_a_proxy_that_lost_the_service_is_asked_again(
    call: Call, server: ScriptedServer, points: Points, found: dict[str, Any], status: int
) -> None:
    lost = Answering(status, b"Internal Server Error", {"Content-Type": "text/plain"})
    server.script = [lost, answering(found)]
    assert len(call(server.url, "grasps", points, client=QUICK)) == 3
    server.script = [lost]
    with pytest.raises(client.ServiceUnreachable, match=f"status {status} without a problem document"):
        call(server.url, "grasps", points, client=QUICK)


HEAD = b"HTTP/1.1 200 OK\r\nContent-Type: application/json\r\n"
READY = b'{"status": "ready"}'
DRIPS = {
    "in the head": HEAD + b"X: " + b"x" * 100 + b"\r\nContent-Length: 19\r\n\r\n" + READY,
    "in the body": HEAD + b"Content-Length: 119\r\n\r\n" + b" " * 100 + READY,
    "in chunks": HEAD
    + b"Transfer-Encoding: chunked\r\n\r\n"
    + b"1\r\n \r\n" * 30
    + b"13\r\n"
    + READY
    + b"\r\n0\r\n\r\n",
    "of provisional answers": b"HTTP/1.1 102 Processing\r\n\r\n" * 5 + HEAD + b"Content-Length: 19\r\n\r\n" + READY,
}


@pytest.mark.parametrize("drip", DRIPS)
def test_a_peer_that_drips_gets_no_more_than_the_time_out(call: Call, start_peer: StartPeer, drip: str) -> None:
    sent = 0

    def behave(connection: socket.socket) -> None:
        nonlocal sent
        connection.recv(65536)
        for byte in DRIPS[drip]:  # each well within the time-out
            connection.sendall(bytes([byte]))
            sent += 1
            time.sleep(0.05)

    peer = start_peer(behave)
    with pytest.raises(client.ServiceTimeout, match=r"within 0\.5 s"):
        call(peer.url, "model", client=QUICK, timeout=0.5)
    assert peer.hung_up.acquire(timeout=PATIENCE_S)
    assert sent < len(DRIPS[drip]) / 2
    assert peer.connections == 1


def test_a_peer_that_reads_slowly_gets_no_more_than_the_time_out(call: Call, start_peer: StartPeer) -> None:
    over = threading.Event()

    left = 12_000_000

    def behave(connection: socket.socket) -> None:  # 1 MB a second
        nonlocal left
        while left > 0 and not over.wait(0.02):
            left -= len(connection.recv(20_000))
        connection.sendall(HEAD + b"Content-Length: 19\r\n\r\n" + READY)

    peer = start_peer(behave)
    with pytest.raises(client.ServiceTimeout, match=r"within 0\.5 s"):
        call(peer.url, "grasps", np.zeros((1_000_000, 3), np.float32), client=QUICK, timeout=0.5)
    assert left > 0
    over.set()
    assert peer.connections == 1


@pytest.mark.parametrize("packed", [False, True])
def test_an_answer_without_end_is_refused_at_the_limit(call: Call, start_peer: StartPeer, packed: bool) -> None:
    pack = zlib.compressobj(9, zlib.DEFLATED, 16 + zlib.MAX_WBITS)
    sent = 0

    def behave(connection: socket.socket) -> None:
        nonlocal sent
        connection.recv(65536)
        connection.sendall(HEAD + b"Content-Encoding: gzip\r\n\r\n" if packed else HEAD + b"\r\n")
        while True:
            chunk = bytes(2**20)
            connection.sendall(pack.compress(chunk) + pack.flush(zlib.Z_SYNC_FLUSH) if packed else chunk)
            sent += 1

    peer = start_peer(behave)
    with pytest.raises(client.UnexpectedResponse, match="over 2 MB; raise `max_answer_mb`") as caught:
        call(peer.url, "model", client={"max_answer_mb": 2})
    assert caught.value.status == 200
    assert peer.hung_up.acquire(timeout=PATIENCE_S)
    assert peer.connections == 1


def test_a_packed_answer_is_unpacked(call: Call, server: ScriptedServer) -> None:
    packed = gzip.compress(json.dumps(model_document()).encode())
    server.script = [Answering(200, packed, {"Content-Type": "application/json", "Content-Encoding": "gzip"})]
    assert call(server.url, "model").to_dict() == model_document()
    assert server.received[0].headers["accept-encoding"] == "gzip"


def test_redirections_are_not_followed(call: Call, server: ScriptedServer) -> None:
    server.script = [Answering(307, b"", {"Location": "/model"})]
    with pytest.raises(client.UnexpectedResponse):
        call(server.url, "model")
    assert len(server.received) == 1


@pytest.mark.parametrize("first", [b"", b"{"])
def test_a_silent_service_is_a_timeout_and_not_tried_again(
    call: Call, server: ScriptedServer, points: Points, first: bytes
) -> None:
    server.script = [Stall(first)]
    with pytest.raises(client.ServiceTimeout, match=r"within 0\.2 s; raise `timeout`"):
        call(server.url, "grasps", points, client=QUICK, timeout=0.2)
    assert len(server.received) <= 1


@pytest.mark.parametrize(
    "wire", [Answering(200, b"<html>"), Answering(302, b"", {"Location": "/"}), Answering(404, b"x")]
)
def test_another_server_is_an_unexpected_response(
    call: Call, server: ScriptedServer, points: Points, wire: Answering
) -> None:
    server.script = [wire]
    with pytest.raises(client.UnexpectedResponse, match="check the URL") as caught:
        call(server.url, "grasps", points)
    assert caught.value.status == wire.status


def test_bad_points_and_options_are_refused_before_anything_is_sent(call: Call, server: ScriptedServer) -> None:
    with pytest.raises(client.InvalidArgument, match="points: have shape"):
        call(server.url, "grasps", np.zeros((3, 4)))
    with pytest.raises(TypeError, match="unknown option 'top_k'"):
        call(server.url, "grasps", np.zeros((3, 3)), top_k=1)
    assert server.received == []


@pytest.mark.parametrize(
    "url",
    [
        "127.0.0.1:8000",
        "ftp://host",
        "http://",
        "",
        "http://[::1",
        "http://host:70000",
        "http://a..b",
        "http://host\n",
        "http://host?x=1",
        "http://host/#grasps",
        "http://host/path?",
    ],
)
def test_a_url_that_is_none_is_refused(call: Call, url: str) -> None:
    with pytest.raises(client.InvalidArgument, match=r"base_url: .*give one like http://"):
        call(url, "live")


@pytest.mark.parametrize("size", [0, -1, float("nan"), float("inf")])
def test_a_size_that_is_none_is_refused(call: Call, closed_url: str, size: float) -> None:
    with pytest.raises(client.InvalidArgument, match="max_answer_mb"):
        call(closed_url, "live", client={"max_answer_mb": size})


@pytest.mark.parametrize("timeout", [0, -1, float("nan"), float("inf")])
def test_a_timeout_that_is_none_is_refused(call: Call, closed_url: str, timeout: float) -> None:
    with pytest.raises(client.InvalidArgument, match="timeout"):
        call(closed_url, "grasps", np.zeros((1, 3)), timeout=timeout)
    with pytest.raises(client.InvalidArgument, match="timeout"):
        call(closed_url, "live", client={"timeout": timeout})


@pytest.mark.parametrize("probe", ["live", "ready"])
def test_health_is_a_yes_or_no(
    call: Call, server: ScriptedServer, closed_url: str, refusing: Refusing, probe: str
) -> None:
    server.script = [answering({"status": probe}), refusing(503), Reset()]
    assert call(server.url, probe) is True
    assert call(server.url, probe) is False
    assert call(server.url, probe) is False
    assert call(closed_url, probe) is False
    assert {received.target for received in server.received} == {f"/health/{probe}"}


def test_waiting_ends_when_the_service_is_ready(call: Call, server: ScriptedServer, refusing: Refusing) -> None:
    server.script = [Reset(), refusing(503), answering({"status": "ready"})]
    assert call(server.url, "wait_until_ready", 30) is None
    assert len(server.received) == 3


def test_waiting_in_vain_ends(call: Call, closed_url: str) -> None:
    with pytest.raises(client.ServiceTimeout, match=r"not ready after 0\.3 s: "):
        call(closed_url, "wait_until_ready", 0.3)


def test_one_async_client_serves_many_requests_at_once(
    server: ScriptedServer, points: Points, found: dict[str, Any]
) -> None:
    server.script = [answering(found)]

    async def go() -> list[client.GraspReply]:
        async with client.AsyncGraspClient(server.url) as opened:
            return await asyncio.gather(*(opened.grasps(points, seed=seed) for seed in range(8)))

    assert [len(reply) for reply in asyncio.run(go())] == [3] * 8
    assert len({received.target for received in server.received}) == 8


def test_an_answer_that_drips_through_another_transport_ends_with_the_time_too(
    found: dict[str, Any], points: Points, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Which keeps no time of its own, as one for tests."""
    now = 50.0
    monkeypatch.setattr(session, "time", SimpleNamespace(monotonic=lambda: now, sleep=time.sleep))
    body = json.dumps(found).encode()

    class Dripping(httpx.SyncByteStream):
        def __iter__(self) -> Iterator[bytes]:
            nonlocal now
            for byte in body:
                now += 0.01
                yield bytes([byte])

    transport = httpx.MockTransport(lambda _: httpx.Response(200, stream=Dripping()))
    for seconds, arrives in ((0.01 * len(body) + 1, True), (0.01 * len(body) - 1, False)):
        with client.GraspClient("http://robot.invalid", transport=transport) as opened:
            if arrives:
                assert len(opened.grasps(points, timeout=seconds)) == 3
            else:
                with pytest.raises(client.ServiceTimeout):
                    opened.grasps(points, timeout=seconds)


def test_the_clients_own_time_is_that_of_a_call_without_one(
    call: Call, server: ScriptedServer, points: Points, found: dict[str, Any]
) -> None:
    server.script = [answering(found)]
    call(server.url, "grasps", points, client={"timeout": 300.0})
    call(server.url, "grasps", points, client={"timeout": 300.0}, timeout=100.0)
    told = [float(received.headers["x-request-timeout"]) for received in server.received]
    assert 200 < told[0] < 300
    assert 50 < told[1] < 100


@pytest.mark.parametrize("size", [0.5, 1.0, 1.5])
def test_an_answer_may_be_of_so_many_megabytes_and_no_byte_more(
    call: Call, server: ScriptedServer, size: float
) -> None:
    whole = json.dumps(model_document()).encode()
    limit = int(size * 2**20)
    server.script = [Answering(200, whole + b" " * (limit - len(whole)), {"Content-Type": "application/json"})]
    assert call(server.url, "model", client={"max_answer_mb": size}).to_dict() == model_document()
    server.script = [Answering(200, whole + b" " * (limit + 1 - len(whole)), {"Content-Type": "application/json"})]
    with pytest.raises(client.UnexpectedResponse, match=f"over {size:g} MB"):
        call(server.url, "model", client={"max_answer_mb": size})


def test_the_transport_can_be_replaced(points: Points, found: dict[str, Any]) -> None:
    transport = httpx.MockTransport(lambda _: httpx.Response(200, json=found))
    with client.GraspClient("http://robot.invalid", transport=transport) as opened:
        assert len(opened.grasps(points)) == 3


@pytest.mark.parametrize("kind", [client.GraspClient, client.AsyncGraspClient])
def test_both_clients_have_the_defaults_that_they_tell(kind: type) -> None:
    def defaults(method: Any) -> dict[str, Any]:
        found = inspect.signature(method).parameters.values()
        return {one.name: one.default for one in found if one.default is not inspect.Parameter.empty}

    nothing = dict.fromkeys(("retry", "api_key", "headers", "proxy", "transport"))
    assert defaults(kind) == {"timeout": 30.0, "max_answer_mb": 64.0, **nothing}
    of_call = dict.fromkeys(("request_id", "timeout"))
    assert defaults(getattr(kind, "grasps")) == {"view_index": None, "normals": None, **of_call}  # noqa: B009
    of_image = {"mask": None, "T_cloud_camera": None, "depth_scale": 0.001, "stride": 1}
    assert defaults(getattr(kind, "grasps_from_depth")) == {**of_image, **of_call}  # noqa: B009


def test_every_request_has_an_id_of_its_own_unless_one_is_given(
    call: Call, server: ScriptedServer, points: Points, found: dict[str, Any]
) -> None:
    server.script = [answering(found)]
    camera = {"fx": 50.0, "fy": 50.0, "cx": 1.0, "cy": 1.0}
    for _ in range(2):
        call(server.url, "grasps", points)
        call(server.url, "grasps_from_depth", np.ones((4, 4)), intrinsics=camera)
    ids = [received.headers["x-request-id"] for received in server.received]
    assert len(set(ids)) == 4
    assert {len(name) for name in ids} == {32}
