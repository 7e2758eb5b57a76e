"""GraspClient and AsyncGraspClient: two thin hands that perform what `conversation.py` decides."""

from __future__ import annotations

import asyncio
import random
import time
import uuid
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import TYPE_CHECKING, Any, TypeVar
from urllib.parse import urlsplit

import httpx
from numpy.typing import ArrayLike

from client.conversation import (
    PROBE_TIMEOUT,
    ConnectionLost,
    Conversation,
    Outcome,
    Send,
    Step,
    TimedOut,
    Wait,
    ask,
    await_ready,
    look,
)
from client.errors import InvalidArgument
from client.reply import Answer, GraspReply, ModelReply, grasp_reply, model_reply
from client.request import (
    DEFAULT_DEPTH_SCALE,
    GraspOptions,
    Intrinsics,
    Request,
    depth_request,
    header_value,
    points_request,
)
from client.retry import RetryPolicy
from service.schemas import MAX_TIMEOUT_S

if TYPE_CHECKING:
    from typing_extensions import Self, Unpack

    from tesnet.geometry import CameraIntrinsics, Pose

T = TypeVar("T")

DEFAULT_TIMEOUT = 30.0

_DIRECT: Mapping[str, None] = dict.fromkeys(("all://127.0.0.1", "all://localhost", "all://[::1]"))
"""httpx's patterns of what no proxy that the environment names could reach for us: this machine itself."""


class _Plans:
    """What both clients know: where the service is, and which conversation each method holds with it."""

    def __init__(
        self,
        base_url: str,
        *,
        timeout: float,
        retry: RetryPolicy | None,
        api_key: str | None,
        headers: Mapping[str, str] | None,
    ) -> None:
        parts = urlsplit(base_url)
        if parts.scheme not in ("http", "https") or not parts.hostname:
            raise InvalidArgument("base_url", f"is {base_url!r}; give one like http://127.0.0.1:8000")
        self._base_url = base_url.rstrip("/")
        self._timeout = _checked_timeout(timeout)
        self._policy = retry or RetryPolicy()
        self._rng = random.Random()
        self._headers = {name: header_value(f"headers[{name!r}]", value) for name, value in (headers or {}).items()}
        if api_key is not None:
            self._headers["X-API-Key"] = header_value("api_key", api_key)

    def _ask(self, request: Request, parse: Callable[[Answer], T], timeout: float | None) -> Conversation[T]:
        seconds = self._timeout if timeout is None else _checked_timeout(timeout)
        return ask(request, parse, timeout=seconds, policy=self._policy, clock=time.monotonic, rng=self._rng)

    def _grasps(
        self, points: ArrayLike, options: Mapping[str, Any], request_id: str | None, timeout: float | None
    ) -> Conversation[GraspReply]:
        return self._ask(points_request(points, options, request_id or uuid.uuid4().hex), grasp_reply, timeout)

    def _grasps_from_depth(
        self,
        depth: ArrayLike | bytes,
        intrinsics: Intrinsics | CameraIntrinsics,
        options: Mapping[str, Any],
        image: Mapping[str, Any],
        request_id: str | None,
        timeout: float | None,
    ) -> Conversation[GraspReply]:
        request = depth_request(depth, intrinsics, options, request_id=request_id or uuid.uuid4().hex, **image)
        return self._ask(request, grasp_reply, timeout)

    def _model(self, timeout: float | None) -> Conversation[ModelReply]:
        return self._ask(Request("GET", "/model", headers={"Accept": "application/json"}), model_reply, timeout)

    def _http_arguments(self, step: Send) -> dict[str, Any]:
        """The arguments of httpx for a step."""
        return {
            "method": step.request.method,
            "url": self._base_url + step.request.target,
            "content": step.request.content,
            "headers": {**self._headers, **step.request.headers},
            "extensions": {"timeout": _TimeLeft(step.timeout)},
        }


class GraspClient(_Plans):
    """The grasp service, for synchronous code. A context manager; safe to share between threads.

    Args:
        base_url: where the service is, such as `http://127.0.0.1:8000`; a path prefix is kept.
        timeout: seconds that a call may take in all, with its retries and the waits between them.
        retry: when to try again. Grasping is a pure computation, so trying a lost connection again is safe.
        api_key: one of the service's `GRASP_API_KEYS`, where it has any.
        headers: sent with every request, for instance the credentials that a proxy before the service wants.
        transport: replaces the network, for tests and special transports.

    Raises:
        InvalidArgument: a URL that is not http or https, a timeout that is not positive, an impossible key or header.

    Every method raises the errors drawn in `client.errors`. Proxies that the environment names (`HTTPS_PROXY`, ...) are
    used, except for services on this machine.
    """

    def __init__(
        self,
        base_url: str,
        *,
        timeout: float = DEFAULT_TIMEOUT,
        retry: RetryPolicy | None = None,
        api_key: str | None = None,
        headers: Mapping[str, str] | None = None,
        transport: httpx.BaseTransport | None = None,
    ) -> None:
        super().__init__(base_url, timeout=timeout, retry=retry, api_key=api_key, headers=headers)
        self._http = httpx.Client(transport=transport, mounts=_DIRECT)

    def grasps(
        self,
        points: ArrayLike,
        *,
        request_id: str | None = None,
        timeout: float | None = None,
        **options: Unpack[GraspOptions],
    ) -> GraspReply:
        """Ranked grasps on a cloud of points (N, 3), metres, best first, in the frame of the points.

        Args:
            points: (N, 3) real numbers; sent as float32.
            request_id: names the request in the service's log; made up where absent.
            timeout: seconds in all, instead of the client's own.
            options: see `GraspOptions`; those absent or None get the service's defaults.
        """
        return self._perform(self._grasps(points, options, request_id, timeout))

    def grasps_from_depth(
        self,
        depth: ArrayLike | bytes,
        *,
        intrinsics: Intrinsics | CameraIntrinsics,
        mask: ArrayLike | bytes | None = None,
        T_cloud_camera: Pose | ArrayLike | None = None,
        depth_scale: float = DEFAULT_DEPTH_SCALE,
        request_id: str | None = None,
        timeout: float | None = None,
        **options: Unpack[GraspOptions],
    ) -> GraspReply:
        """Ranked grasps on what a depth image shows, best first.

        Args:
            depth: (height, width): whole numbers are counts of `depth_scale` metres, others are metres, rounded to it;
                0, NaN and infinities are no depth. Or the bytes of a 16-bit grey PNG.
            intrinsics: the camera, in pixels.
            mask: (height, width), not zero on what is to be grasped; or the bytes of an 8-bit grey PNG.
            T_cloud_camera: camera pose, 4 x 4; camera axes are +x right, +y down, +z forward. Without it the grasps are
                in the frame of the camera.
            depth_scale: metres per count.
            request_id: names the request in the service's log; made up where absent.
            timeout: seconds in all, instead of the client's own.
            options: see `GraspOptions`; the default viewpoint is the camera's.
        """
        image = {"mask": mask, "T_cloud_camera": T_cloud_camera, "depth_scale": depth_scale}
        return self._perform(self._grasps_from_depth(depth, intrinsics, options, image, request_id, timeout))

    def model(self, *, timeout: float | None = None) -> ModelReply:
        """The networks that the service has loaded, the gripper, the frames and the limits."""
        return self._perform(self._model(timeout))

    def live(self) -> bool:
        """Whether the service's process answers."""
        return self._perform(look("/health/live", timeout=PROBE_TIMEOUT))

    def ready(self) -> bool:
        """Whether the service takes grasp requests: weights loaded and warm, not draining."""
        return self._perform(look("/health/ready", timeout=PROBE_TIMEOUT))

    def wait_until_ready(self, timeout: float) -> None:
        """Return once the service is ready; `ServiceTimeout` after `timeout` seconds."""
        self._perform(await_ready(timeout=_checked_timeout(timeout), clock=time.monotonic))

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _perform(self, conversation: Conversation[T]) -> T:
        outcome: Outcome = None
        while True:
            try:
                step = conversation.send(outcome)
            except StopIteration as end:
                result: T = end.value
                return result
            outcome = self._do(step)

    def _do(self, step: Step) -> Outcome:
        if isinstance(step, Wait):
            time.sleep(step.seconds)
            return None
        end = time.monotonic() + step.timeout
        try:
            with self._http.stream(**self._http_arguments(step)) as response:
                chunks = []
                for chunk in response.iter_bytes():
                    chunks.append(chunk)
                    if time.monotonic() > end:
                        return TimedOut()
                return _answer(response, chunks)
        except httpx.RequestError as error:
            return _failure(error, self._base_url)


class AsyncGraspClient(_Plans):
    """The grasp service, for asyncio: `GraspClient` with methods that are awaited. Share it within one event loop."""

    def __init__(
        self,
        base_url: str,
        *,
        timeout: float = DEFAULT_TIMEOUT,
        retry: RetryPolicy | None = None,
        api_key: str | None = None,
        headers: Mapping[str, str] | None = None,
        transport: httpx.AsyncBaseTransport | None = None,
    ) -> None:
        super().__init__(base_url, timeout=timeout, retry=retry, api_key=api_key, headers=headers)
        self._http = httpx.AsyncClient(transport=transport, mounts=_DIRECT)

    async def grasps(
        self,
        points: ArrayLike,
        *,
        request_id: str | None = None,
        timeout: float | None = None,
        **options: Unpack[GraspOptions],
    ) -> GraspReply:
        """As `GraspClient.grasps`."""
        return await self._perform(self._grasps(points, options, request_id, timeout))

    async def grasps_from_depth(
        self,
        depth: ArrayLike | bytes,
        *,
        intrinsics: Intrinsics | CameraIntrinsics,
        mask: ArrayLike | bytes | None = None,
        T_cloud_camera: Pose | ArrayLike | None = None,
        depth_scale: float = DEFAULT_DEPTH_SCALE,
        request_id: str | None = None,
        timeout: float | None = None,
        **options: Unpack[GraspOptions],
    ) -> GraspReply:
        """As `GraspClient.grasps_from_depth`."""
        image = {"mask": mask, "T_cloud_camera": T_cloud_camera, "depth_scale": depth_scale}
        return await self._perform(self._grasps_from_depth(depth, intrinsics, options, image, request_id, timeout))

    async def model(self, *, timeout: float | None = None) -> ModelReply:
        """As `GraspClient.model`."""
        return await self._perform(self._model(timeout))

    async def live(self) -> bool:
        """As `GraspClient.live`."""
        return await self._perform(look("/health/live", timeout=PROBE_TIMEOUT))

    async def ready(self) -> bool:
        """As `GraspClient.ready`."""
        return await self._perform(look("/health/ready", timeout=PROBE_TIMEOUT))

    async def wait_until_ready(self, timeout: float) -> None:
        """As `GraspClient.wait_until_ready`."""
        await self._perform(await_ready(timeout=_checked_timeout(timeout), clock=time.monotonic))

    async def close(self) -> None:
        """Close the connections."""
        await self._http.aclose()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    async def _perform(self, conversation: Conversation[T]) -> T:
        outcome: Outcome = None
        while True:
            try:
                step = conversation.send(outcome)
            except StopIteration as end:
                result: T = end.value
                return result
            outcome = await self._do(step)

    async def _do(self, step: Step) -> Outcome:
        if isinstance(step, Wait):
            await asyncio.sleep(step.seconds)
            return None
        end = time.monotonic() + step.timeout
        try:
            async with self._http.stream(**self._http_arguments(step)) as response:
                chunks = []
                async for chunk in response.aiter_bytes():
                    chunks.append(chunk)
                    if time.monotonic() > end:
                        return TimedOut()
                return _answer(response, chunks)
        except httpx.RequestError as error:
            return _failure(error, self._base_url)


class _TimeLeft(dict[str, float]):
    """httpx's timeout extension, whose entries are the time left when they are looked up.

    httpx gives each phase of a request (pool, connect, write, read) a timeout of its own; looked up late, they add up
    to one deadline.
    """

    def __init__(self, seconds: float) -> None:
        super().__init__(dict.fromkeys(("pool", "connect", "write", "read"), seconds))
        self._end = time.monotonic() + seconds

    def get(self, key: str, default: Any = None) -> Any:
        return max(self._end - time.monotonic(), 0.001) if key in self else default


def _checked_timeout(timeout: float) -> float:
    if not 0 < timeout <= MAX_TIMEOUT_S:
        raise InvalidArgument("timeout", f"is {timeout:g} s; give more than 0 and at most {MAX_TIMEOUT_S:g}")
    return timeout


def _answer(response: httpx.Response, chunks: list[bytes]) -> Answer:
    return Answer(
        response.status_code, {name.lower(): value for name, value in response.headers.items()}, b"".join(chunks)
    )


def _failure(error: httpx.RequestError, base_url: str) -> Outcome:
    if isinstance(error, httpx.TimeoutException):
        return TimedOut()
    return ConnectionLost(f"cannot reach {base_url}: {str(error) or type(error).__name__}")
