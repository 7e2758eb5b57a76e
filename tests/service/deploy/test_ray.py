"""Options, settings and app of a Ray Serve replica; no cluster here, see tests/test_ray_cluster.py."""

from __future__ import annotations

import asyncio
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import httpx
import pytest
from starlette.datastructures import Headers
from starlette.responses import PlainTextResponse, Response
from starlette.types import ASGIApp, Receive, Scope, Send

from service.deploy.ray import application, proxy_middlewares, replica_app
from service.deploy.replicas import Replicas
from service.errors import PROBLEM_JSON
from service.schemas import REQUEST_ID
from service.settings import Settings
from tesnet.errors import TesnetError
from tests.conftest import PATIENCE_S, hears, running_service


def test_a_replica_has_started_when_its_network_is_warm() -> None:
    async def go() -> tuple[int, list[str]]:
        app = replica_app(Settings(device="cpu", num_threads=1))
        transport = httpx.ASGITransport(app)
        async with (
            app.router.lifespan_context(app),
            httpx.AsyncClient(transport=transport, base_url="http://r") as http,
        ):
            answer = await http.get("/health/ready")
            return answer.status_code, answer.headers.get_list("X-Request-ID")

    # Serve's proxy adds the id itself.
    assert asyncio.run(go()) == (200, [])


def through_the_proxy(inside: ASGIApp, **headers: str) -> httpx.Response:
    """The answer to a request through what Serve's proxies put around themselves."""

    async def go() -> httpx.Response:
        app = inside
        for middleware in proxy_middlewares():
            app = middleware.cls(app, *middleware.args, **middleware.kwargs)
        async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://r") as http:
            return await http.post("/grasps", headers=headers)

    return asyncio.run(go())


@pytest.mark.parametrize("status", [404, 503])
def test_where_the_proxy_has_no_replica_to_ask_it_answers_the_problem_that_asks_to_come_back(status: int) -> None:
    answer = through_the_proxy(PlainTextResponse("said by Serve", status), **{"X-Request-ID": "a-1"})
    assert (answer.status_code, answer.headers["Retry-After"]) == (503, "1")
    assert answer.headers["Content-Type"] == PROBLEM_JSON
    assert answer.json()["type"] == "urn:tes-net:problem:not-ready"
    assert answer.headers.get_list("X-Request-ID") == [answer.json()["request_id"]] == ["a-1"]


@pytest.mark.parametrize(("status", "kind"), [(200, "application/json"), (404, PROBLEM_JSON), (500, "text/plain")])
def test_the_proxy_passes_on_what_replicas_answer_and_that_it_lost_one(status: int, kind: str) -> None:
    answer = through_the_proxy(Response(b"{}", status, media_type=kind))
    assert (answer.status_code, answer.content) == (status, b"{}")


@pytest.mark.parametrize(("given", "kept"), [("robot-7/42", True), ("bad%20id|x", False), ("", False)])
def test_the_proxy_replaces_a_request_id_that_is_unfit_for_a_log(given: str, kept: bool) -> None:
    seen: list[str] = []

    async def inside(scope: Scope, receive: Receive, send: Send) -> None:
        seen.extend(Headers(scope=scope).getlist("X-Request-ID"))
        await Response()(scope, receive, send)

    through_the_proxy(inside, **{"X-Request-ID": given})
    (one,) = seen
    assert re.fullmatch(REQUEST_ID, one)
    assert (one == given) is kept


def test_a_cluster_that_would_obey_everybody_is_not_started() -> None:
    ended = subprocess.run(
        [sys.executable, "-m", "service.deploy.ray"],
        env={**os.environ, "RAY_AUTH_MODE": "disabled"},
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert ended.returncode == 2
    assert "RAY_AUTH_MODE is 'disabled'; " in ended.stderr
    assert "leave it unset, or `token`" in ended.stderr


def test_sigterm_before_ray_is_loaded_ends_the_command_with_0() -> None:
    with running_service([sys.executable, "-m", "service.deploy.ray"], {}) as command:
        while not hears(command.process.pid, signal.SIGTERM):
            assert command.process.poll() is None
            time.sleep(0.001)
        command.process.terminate()
        assert command.process.wait(PATIENCE_S) == 0


@pytest.mark.filterwarnings("ignore:Using extra keyword arguments on `Field`")  # Ray does, where it is loaded
def test_fewer_replicas_are_as_far_off_as_the_option_says() -> None:
    bound: Any = application(Replicas(max_replicas=3, downscale_delay=7))._bound_deployment
    assert bound._deployment_config.autoscaling_config.downscale_delay_s == 7


def test_a_replica_without_weights_does_not_start(tmp_path: Path) -> None:
    async def go() -> None:
        app = replica_app(Settings(device="cpu", weights={"tesnet": tmp_path / "none.safetensors"}))
        async with app.router.lifespan_context(app):
            raise AssertionError("started")

    with pytest.raises(TesnetError, match=r"none\.safetensors"):
        asyncio.run(go())


def test_the_command_says_what_it_cannot_use_before_it_starts_a_cluster() -> None:
    command = [sys.executable, "-m", "service.deploy.ray"]
    helped = subprocess.run([*command, "--help"], capture_output=True, text=True, timeout=PATIENCE_S, check=True)
    for option in (
        "--min-replicas",
        "--max-replicas",
        "--target-ongoing-requests",
        "--cpus",
        "--gpus",
        "--downscale-delay",
        "--address",
    ):
        assert option in helped.stdout
    for arguments, words in ((["--cpus", "0"], "--cpus is 0.0"), (["--address", "nowhere"], "--address is 'nowhere'")):
        ended = subprocess.run([*command, *arguments], capture_output=True, text=True, timeout=PATIENCE_S, check=False)
        assert ended.returncode == 2
        assert words in ended.stderr
        assert "Traceback" not in ended.stderr
