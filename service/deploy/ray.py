"""The service as a Ray Serve application: replicas of the same FastAPI app behind Serve's proxy.

`python -m service.deploy.ray` starts it and stays until SIGTERM; `application` is what `serve run` and Serve's
configuration files name. Settings are the `GRASP_*` variables of the process that builds the application; every
replica gets the same.
"""

from __future__ import annotations

from service.__main__ import exit_on_signals

if __name__ == "__main__":
    exit_on_signals()  # before anything slow is loaded: PID 1 of a container hears no signal without a handler

import argparse
import logging
import math
import os
import signal
import sys
import threading
import time
from collections.abc import AsyncIterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, asynccontextmanager, suppress
from types import FrameType
from typing import TYPE_CHECKING, Any

import anyio.to_thread
import httpx
from starlette.datastructures import Headers, MutableHeaders
from starlette.middleware import Middleware
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.deploy.replicas import Replicas, option_name, replica_settings, replicas_from
from service.errors import PROBLEM_JSON, NotReady, problem_response
from service.logs import configure_logging
from service.memory import Memory
from service.middleware import RequestRecord, request_id_of
from service.protocol import KEEP_ALIVE_SECONDS
from service.settings import InvalidSetting, Settings, load_settings, service_version

if TYPE_CHECKING:
    from fastapi import FastAPI
    from ray.serve import Application

log = logging.getLogger("service")

LOCAL = "local"
"""The address of a cluster that is started for the command, on this machine alone, and ends with it."""

NAME = "grasps"
"""Of the application and its one deployment."""

READY_WITHIN_S = 300.0
POLL_S = 0.1

LOGS = "/tmp/ray/session_latest/logs/serve"  # noqa: S108 - where Ray writes them

TRIES_TO_START = 3
"""Starts of a replica that fail, for instance over missing weights, before the application counts as failed."""

SPARE_REQUESTS = 16
"""Requests that a replica is given beyond those that wait or are computed: those it decodes, refuses, or answers."""


def application(replicas: Replicas) -> Application:
    """The application for `serve.run`; a replica takes requests when its network is loaded and warm.

    A full replica answers 429 itself, as everywhere. Serve's own limits lie just beyond, for the moments in which there
    is no replica to ask: its answer is 503 with `Retry-After`.

    Raises:
        InvalidSetting: a `GRASP_*` variable cannot be used.
    """
    from ray import serve  # noqa: PLC0415 - takes seconds to load, which `--help` need not wait for

    settings = replica_settings(os.environ, replicas)

    def build() -> FastAPI:
        return replica_app(settings)

    requests = settings.queue_size + settings.max_batch + SPARE_REQUESTS
    number: dict[str, Any] = {"num_replicas": replicas.min_replicas}
    if replicas.max_replicas > replicas.min_replicas:
        scaling = replicas.model_dump(include={"min_replicas", "max_replicas", "target_ongoing_requests"})
        number = {"autoscaling_config": {**scaling, "downscale_delay_s": replicas.downscale_delay}}
    deploy = serve.deployment(
        name=NAME,
        max_ongoing_requests=requests,
        max_queued_requests=requests,
        backpressure_config={"status_code": 503, "retry_after_s": 1},
        graceful_shutdown_timeout_s=settings.drain_timeout,
        max_constructor_retry_count=TRIES_TO_START,
        ray_actor_options={"num_cpus": replicas.cpus, "num_gpus": replicas.gpus},
        **number,
    )
    return deploy(serve.ingress(build)()).bind()


def replica_app(settings: Settings) -> FastAPI:
    """The service's app, whose start waits for the network: Serve sends requests to a replica that has started."""
    from service.app import create_app  # noqa: PLC0415 - needed in replicas only
    from service.loading import predictor_factory  # noqa: PLC0415 - the same

    configure_logging(settings.log_level)
    loaded: Future[None] = Future()
    app = create_app(
        settings, predictor_factory(settings), on_ready=lambda: loaded.set_result(None), on_failure=loaded.set_exception
    )
    app.add_middleware(_IdFromProxy)
    lifespan = app.router.lifespan_context

    @asynccontextmanager
    async def lifespan_of_replica(app: FastAPI) -> AsyncIterator[Any]:
        async with lifespan(app) as state:
            await anyio.to_thread.run_sync(loaded.result)
            yield state

    app.router.lifespan_context = lifespan_of_replica
    return app


class _IdFromProxy:
    """Leaves `X-Request-ID` to Serve's proxy, which adds the request's to every answer: twice would be a list.

    Args:
        app: the application inside.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""

        async def sending(message: Message) -> None:
            if message["type"] == "http.response.start":
                del MutableHeaders(scope=message)["X-Request-ID"]
            await send(message)

        await self._app(scope, receive, sending)


def proxy_middlewares() -> list[Middleware]:
    """What Serve's proxies of a cluster that serves nothing else put around themselves; `_connect` names it to them."""
    return [Middleware(_AroundProxy)]


class _AroundProxy:
    """Makes what Serve's proxy says in its own words what the service says.

    A request id that is unfit for a log is replaced before anybody sees it. A 404 for an application that is not there
    (any more), and a 503 while no replica takes a request, become the problem that asks to come back.

    Args:
        app: the proxy.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        headers = MutableHeaders(scope=scope)
        record = RequestRecord(
            request_id_of(headers.get("X-Request-ID")), time.perf_counter(), Memory(math.inf).share()
        )
        headers["X-Request-ID"] = record.request_id
        refused = False

        async def sending(message: Message) -> None:
            nonlocal refused
            if message["type"] == "http.response.start" and message["status"] in (
                httpx.codes.NOT_FOUND,
                httpx.codes.SERVICE_UNAVAILABLE,
            ):
                refused = Headers(raw=message["headers"]).get("Content-Type") != PROBLEM_JSON
                if refused:
                    why = "No replica takes requests: they start, end or are all busy; repeat the request after 1 s."
                    answer = problem_response(NotReady(why, retry_after=1), {**scope, "state": {"record": record}})
                    answer.headers["X-Request-ID"] = record.request_id
                    await answer(scope, receive, send)
            if not refused:
                await send(message)

        await self._app(scope, receive, sending)


def main() -> int:
    """Serve until SIGTERM or SIGINT, then finish what was accepted; the process's exit code.

    0: ended as asked. 1: the application did not start. 2: a setting or the command line is wrong.
    """
    options = vars(_parser().parse_args())
    address = options.pop("address")
    try:
        replicas = replicas_from(options)
        settings = load_settings(os.environ)
        configure_logging(settings.log_level)
        ending = _Ending()
        # In the main thread Ray would take SIGTERM for itself; a cluster ends with the thread that began it.
        with ThreadPoolExecutor(1, "ray") as ray_thread, ExitStack() as stack:
            ray_thread.submit(_connect, address, ending).result()
            stack.callback(lambda: ray_thread.submit(_disconnect).result())
            ending.listen()
            return ray_thread.submit(_run, settings, replicas, ending, own_cluster=address == LOCAL).result()
    except InvalidSetting as error:
        return _fail(str(error), 2)


def check_room(replicas: Replicas) -> None:
    """Whether the cluster, which will not grow, has room for the replicas that are always there.

    Raises:
        InvalidSetting: they would wait for ever.
    """
    import ray  # noqa: PLC0415 - the cluster is there now

    there = ray.cluster_resources()
    for resource, share in (("CPU", replicas.cpus), ("GPU", replicas.gpus)):
        needed, present = replicas.min_replicas * share, there.get(resource, 0.0)
        if needed > present:
            raise InvalidSetting(
                "--min-replicas",
                f"is {replicas.min_replicas} of {share:g} {resource} each, {needed:g} in all, and this machine has "
                f"{present:g}; give fewer, lower --{resource.lower()}s, or the --address of a larger cluster",
            )


class _Ending:
    """What SIGTERM and SIGINT do: until `in_order` they end the process; then the first sets `asked`, a second ends it.

    Nothing is raised in the thread that works, which may be anywhere in Ray.
    """

    def __init__(self) -> None:
        self.asked = threading.Event()
        self._in_order = False
        self._heard = False
        self.listen()

    def listen(self) -> None:
        """Hear signals. Once more after `ray.init`, whose C++ puts a handler in front that prints a stack."""
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._hear)

    def in_order(self) -> None:
        """From now on there is something to bring to an end."""
        self._in_order = True

    def _hear(self, number: int, _: FrameType | None) -> None:
        signal.alarm(0)  # the handler of Ray's C++, where it heard the signal first, aborts the process after 3 s
        if not self._in_order:
            os._exit(0)
        if self._heard:
            os._exit(128 + number)
        self._heard = True
        self.asked.set()


def _run(settings: Settings, replicas: Replicas, ending: _Ending, *, own_cluster: bool) -> int:
    if ending.asked.is_set():
        return 0
    if own_cluster:
        check_room(replicas)
    import ray  # noqa: PLC0415 - the cluster is there now
    from ray import serve  # noqa: PLC0415 - the same

    url = f"http://{settings.host}:{settings.port}"
    try:
        # Serve waits a minute for its proxy and no longer, while on a busy machine all is well and merely slow.
        with suppress(TimeoutError):
            serve.start(
                proxy_location="EveryNode",
                http_options={"host": settings.host, "port": settings.port, "keep_alive_timeout_s": KEEP_ALIVE_SECONDS},
            )
        ending.in_order()
        try:
            with suppress(TimeoutError):
                target = serve.RunTarget(application(replicas), name=NAME)
                serve.run_many([target], wait_for_applications_running=False)
            _await_running(ending.asked)
            _await_ready(url, ending.asked)
            if not ending.asked.is_set():
                fields = {"url": url, "ray": ray.get_runtime_context().gcs_address, "pid": os.getpid()}
                log.info("ready", extra={"fields": {**fields, **replicas.model_dump()}})
            ending.asked.wait()
        finally:
            serve.delete(NAME)
        log.info("stopped")
    except (RuntimeError, TimeoutError) as error:
        return _fail(str(error), 1)
    finally:
        if own_cluster:
            serve.shutdown()
    return 0


def _await_running(asked: threading.Event) -> None:
    """Returns when the replicas run, for which a cluster may have to grow first, or the end is asked for.

    Raises:
        RuntimeError: they cannot be started.
    """
    from ray import serve  # noqa: PLC0415 - the cluster is there now

    while not asked.wait(POLL_S):
        there = serve.status().applications[NAME]
        if there.status == "DEPLOY_FAILED":
            raise RuntimeError(there.message)
        if there.status == "RUNNING":
            return


def _await_ready(url: str, asked: threading.Event) -> None:
    """Returns when the proxy answers for a replica, or the end is asked for.

    Raises:
        TimeoutError: it does not.
    """
    deadline = time.monotonic() + READY_WITHIN_S
    with httpx.Client(base_url=url, timeout=10.0, trust_env=False) as http:
        while not asked.wait(POLL_S):
            with suppress(httpx.TransportError):
                if http.get("/health/ready").status_code == httpx.codes.OK:
                    return
            if time.monotonic() > deadline:
                raise TimeoutError(f"{url} was not ready after {READY_WITHIN_S:.0f} s; Serve's logs are in {LOGS}")


def _connect(address: str, ending: _Ending) -> None:
    """Connect to a Ray cluster; one that is started here listens on loopback alone, but for Serve's replicas.

    Raises:
        InvalidSetting: there is no cluster at the address, or one that is started here would obey everybody.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    if address == LOCAL:
        os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")  # to Ray this means: one machine, 127.0.0.1
        # A proxy that is slow to start on a busy machine is replaced after three of these, and never gets there.
        os.environ.setdefault("RAY_SERVE_PROXY_READY_CHECK_TIMEOUT_S", "60")
        os.environ.setdefault("RAY_SERVE_HTTP_PROXY_CALLBACK_IMPORT_PATH", "service.deploy.ray:proxy_middlewares")
        mode = os.environ.get("RAY_AUTH_MODE", "token")  # which is what Ray takes for a cluster of its own
        if mode.lower() != "token":
            raise InvalidSetting(
                "RAY_AUTH_MODE",
                f"is {mode!r}; Serve's replicas listen on every interface, and whoever reaches them could run programs "
                "here: leave it unset, or `token`",
            )
    import ray  # noqa: PLC0415 - reads the environment when it is loaded

    if address == LOCAL:
        ending.in_order()  # the agents of a cluster whose starter just dies live on for a minute
    try:
        ray.init(address=address, include_dashboard=False if address == LOCAL else None)
    except (ConnectionError, ValueError) as error:
        raise InvalidSetting("--address", f"is {address!r}, where no cluster answers: {error}") from error


def _disconnect() -> None:
    """Leave the cluster; one that was started here ends."""
    import ray  # noqa: PLC0415 - loaded by now

    ray.shutdown()


def _fail(message: str, code: int) -> int:
    sys.stdout.flush()
    print(f"python -m service.deploy.ray: {message}", file=sys.stderr)
    return code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m service.deploy.ray",
        description="The grasp service as replicas on Ray Serve. Settings are the GRASP_* variables that "
        "`python -m service --help` lists; every replica gets the same.",
        epilog="SIGTERM finishes accepted requests and exits with 0.",
    )
    for name, field in Replicas.model_fields.items():
        default = "" if name == "max_replicas" else f" Default: {field.default}."
        kind = int if field.annotation is int else float
        parser.add_argument(option_name(name), type=kind, metavar="N", help=f"{field.description}{default}")
    parser.add_argument(
        "--address", default=LOCAL, help=f"a running Ray cluster, or `{LOCAL}` for one of this machine (default)"
    )
    parser.add_argument("--version", action="version", version=f"tes-net {service_version()}")
    return parser


if __name__ == "__main__":
    sys.exit(main())
