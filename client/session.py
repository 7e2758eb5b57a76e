"""GraspClient and AsyncGraspClient: two thin hands that perform what `conversation.py` decides."""

from __future__ import annotations

import asyncio
import math
import random
import time
import uuid
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import TYPE_CHECKING, Any, TypeVar
from urllib.parse import urlsplit

import httpx
from numpy.typing import ArrayLike

from client.answer_body import AnswerBody, UnusableBody
from client.conversation import (
    PROBE_TIMEOUT,
    ConnectionLost,
    Conversation,
    Outcome,
    Send,
    Step,
    TimedOut,
    Unusable,
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
from client.transport import DeadlineTransport, TimeLeft, proxy_for, tls_context
from service.schemas import MAX_TIMEOUT_S

if TYPE_CHECKING:
    from typing_extensions import Self, Unpack

    from tesnet.geometry import CameraIntrinsics, Pose

T = TypeVar("T")

DEFAULT_TIMEOUT = 30.0

DEFAULT_MAX_ANSWER_MB = 64.0
"""Many times what a thousand grasps take."""


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
        max_answer_mb: float,
    ) -> None:
        self._url = _checked_url(base_url)
        self._base_url = base_url.rstrip("/")
        if not 0 < max_answer_mb < math.inf:
            raise InvalidArgument("max_answer_mb", f"is {max_answer_mb:g}; give more than 0 and a finite number")
        self._max_answer = int(max_answer_mb * 2**20)
        self._timeout = _checked_timeout(timeout)
        self._policy = retry or RetryPolicy()
        self._rng = random.Random()
        self._headers = {"Accept-Encoding": "gzip"}
        self._headers |= {name: header_value(f"headers[{name!r}]", value) for name, value in (headers or {}).items()}
        if api_key is not None:
            self._headers["X-API-Key"] = header_value("api_key", api_key)

    def _ask(self, request: Request, parse: Callable[[Answer], T], timeout: float | None) -> Conversation[T]:
        seconds = self._timeout if timeout is None else _checked_timeout(timeout)
        return ask(request, parse, timeout=seconds, policy=self._policy, clock=time.monotonic, rng=self._rng)

    def _grasps(
        self,
        points: ArrayLike,
        options: Mapping[str, Any],
        beside: Mapping[str, ArrayLike | None],
        request_id: str | None,
        timeout: float | None,
    ) -> Conversation[GraspReply]:
        request = points_request(points, options, request_id or uuid.uuid4().hex, **beside)
        return self._ask(request, grasp_reply, timeout)

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

    def _http_arguments(self, step: Send, end: float) -> dict[str, Any]:
        """The arguments of httpx for a step that ends at a moment of `time.monotonic`."""
        return {
            "method": step.request.method,
            "url": self._base_url + step.request.target,
            "content": step.request.content,
            "headers": {**self._headers, **step.request.headers},
            "extensions": {"timeout": TimeLeft(end)},
        }

    def _body(self, response: httpx.Response) -> AnswerBody:
        return AnswerBody(response.headers.get("Content-Encoding", ""), self._max_answer)


class GraspClient(_Plans):
    """The grasp service, for synchronous code. A context manager; safe to share between threads.

    Args:
        base_url: where the service is, such as `http://127.0.0.1:8000`; a path prefix is kept.
        timeout: seconds that a call may take in all, with its retries and the waits between them.
        retry: when to try again. Grasping is a pure computation, so trying a lost connection again is safe.
        api_key: one of the service's `GRASP_API_KEYS`, where it has any.
        headers: sent with every request, for instance the credentials that a proxy before the service wants.
        max_answer_mb: largest answer, unpacked, MB of 2^20 bytes; a larger one is an `UnexpectedResponse`.
        proxy: URL of the proxy to go through; without it the one that the environment names (`HTTPS_PROXY`, ...), but
            none to a service on this machine.
        transport: replaces the network, for tests and special transports.

    Raises:
        InvalidArgument: a URL that is not http or https, a time-out or size that is not positive, an impossible key,
            header or proxy.

    Every method raises the errors drawn in `client.errors`, and no others. The time-out is kept whatever the service
    does, but looking its name up takes as long as the system lets it.
    """

    def __init__(
        self,
        base_url: str,
        *,
        timeout: float = DEFAULT_TIMEOUT,
        retry: RetryPolicy | None = None,
        api_key: str | None = None,
        headers: Mapping[str, str] | None = None,
        max_answer_mb: float = DEFAULT_MAX_ANSWER_MB,
        proxy: str | None = None,
        transport: httpx.BaseTransport | None = None,
    ) -> None:
        super().__init__(
            base_url, timeout=timeout, retry=retry, api_key=api_key, headers=headers, max_answer_mb=max_answer_mb
        )
        if transport is None:
            through = proxy_for(self._url, proxy)
            transport = DeadlineTransport(through, tls_context(self._url, through))
        self._http = httpx.Client(transport=transport, trust_env=False)

    def grasps(
        self,
        points: ArrayLike,
        *,
        view_index: ArrayLike | None = None,
        normals: ArrayLike | None = None,
        request_id: str | None = None,
        timeout: float | None = None,
        **options: Unpack[GraspOptions],
    ) -> GraspReply:
        """Ranked grasps on a cloud of points (N, 3), metres, best first, in the frame of the points.

        Args:
            points: (N, 3) or, of an image, (H, W, 3) real numbers; sent as float32, or as float64 where they are far
                from the origin. Rows with NaN or an infinity are no points.
            view_index: (N,) which position of the option `viewpoint` saw each point, from 0.
            normals: (N, 3) outward, zeros where there is none; they turn those that the service computes.
            request_id: names the request in the service's log; made up where absent.
            timeout: seconds in all, instead of the client's own.
            options: see `GraspOptions`; those absent or None get the service's defaults.
        """
        beside = {"view_index": view_index, "normals": normals}
        return self._perform(self._grasps(points, options, beside, request_id, timeout))

    def grasps_from_depth(
        self,
        depth: ArrayLike | bytes,
        *,
        intrinsics: Intrinsics | CameraIntrinsics,
        mask: ArrayLike | bytes | None = None,
        T_cloud_camera: Pose | ArrayLike | None = None,
        depth_scale: float = DEFAULT_DEPTH_SCALE,
        stride: int = 1,
        request_id: str | None = None,
        timeout: float | None = None,
        **options: Unpack[GraspOptions],
    ) -> GraspReply:
        """Ranked grasps on what a depth image shows, best first.

        Args:
            depth: (height, width): whole numbers are counts of `depth_scale` metres, others are metres, rounded to it;
                0, NaN and infinities are no depth. Or the bytes of a 16-bit grey PNG or of a .npy.
            intrinsics: the camera, in pixels.
            mask: (height, width), not zero on what is to be grasped, or labels for the option `target`; or the bytes
                of a grey PNG of 8 or 16 bits or of a .npy.
            T_cloud_camera: camera pose, 4 x 4, of three decimals or more; camera axes are +x right, +y down, +z
                forward. Without it the grasps are in the frame of the camera.
            depth_scale: metres per count.
            stride: every so many-th row and column is used.
            request_id: names the request in the service's log; made up where absent.
            timeout: seconds in all, instead of the client's own.
            options: see `GraspOptions`; the default viewpoint is the camera's.
        """
        image = {"mask": mask, "T_cloud_camera": T_cloud_camera, "depth_scale": depth_scale, "stride": stride}
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
            with self._http.stream(**self._http_arguments(step, end)) as response:
                return self._read(response, end)
        except httpx.RequestError as error:
            return _failure(error, self._base_url)

    def _read(self, response: httpx.Response, end: float) -> Outcome:
        assert isinstance(response.stream, httpx.SyncByteStream)
        try:
            body = self._body(response)
            for chunk in response.stream:  # packed, where `iter_bytes` would unpack without a limit
                body.add(chunk)
                if time.monotonic() > end:
                    return TimedOut()
            return _answer(response, body)
        except UnusableBody as error:
            return Unusable(str(error), response.status_code)


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
        max_answer_mb: float = DEFAULT_MAX_ANSWER_MB,
        proxy: str | None = None,
        transport: httpx.AsyncBaseTransport | None = None,
    ) -> None:
        super().__init__(
            base_url, timeout=timeout, retry=retry, api_key=api_key, headers=headers, max_answer_mb=max_answer_mb
        )
        if transport is None:
            through = proxy_for(self._url, proxy)
            transport = httpx.AsyncHTTPTransport(verify=tls_context(self._url, through), proxy=through)
        self._http = httpx.AsyncClient(transport=transport, trust_env=False)

    async def grasps(
        self,
        points: ArrayLike,
        *,
        view_index: ArrayLike | None = None,
        normals: ArrayLike | None = None,
        request_id: str | None = None,
        timeout: float | None = None,
        **options: Unpack[GraspOptions],
    ) -> GraspReply:
        """As `GraspClient.grasps`."""
        beside = {"view_index": view_index, "normals": normals}
        return await self._perform(self._grasps(points, options, beside, request_id, timeout))

    async def grasps_from_depth(
        self,
        depth: ArrayLike | bytes,
        *,
        intrinsics: Intrinsics | CameraIntrinsics,
        mask: ArrayLike | bytes | None = None,
        T_cloud_camera: Pose | ArrayLike | None = None,
        depth_scale: float = DEFAULT_DEPTH_SCALE,
        stride: int = 1,
        request_id: str | None = None,
        timeout: float | None = None,
        **options: Unpack[GraspOptions],
    ) -> GraspReply:
        """As `GraspClient.grasps_from_depth`."""
        image = {"mask": mask, "T_cloud_camera": T_cloud_camera, "depth_scale": depth_scale, "stride": stride}
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
        try:
            return await asyncio.wait_for(self._exchange(step), step.timeout)
        except asyncio.TimeoutError:
            return TimedOut()
        except httpx.RequestError as error:
            return _failure(error, self._base_url)

    async def _exchange(self, step: Send) -> Outcome:
        async with self._http.stream(**self._http_arguments(step, time.monotonic() + step.timeout)) as response:
            assert isinstance(response.stream, httpx.AsyncByteStream)
            try:
                body = self._body(response)
                async for chunk in response.stream:  # packed, where `aiter_bytes` would unpack without a limit
                    body.add(chunk)
                return _answer(response, body)
            except UnusableBody as error:
                return Unusable(str(error), response.status_code)


def _checked_url(base_url: str) -> httpx.URL:
    example = "give one like http://127.0.0.1:8000"
    try:
        url = httpx.URL(base_url)
        url.host.encode("idna")  # as the resolver does
        urlsplit(base_url).port  # noqa: B018 - a ValueError where it is over 65535, which httpx lets pass
    except (httpx.InvalidURL, ValueError) as error:
        raise InvalidArgument("base_url", f"is {base_url!r}, which is no URL ({error}); {example}") from None
    if url.scheme not in ("http", "https") or not url.host:
        raise InvalidArgument("base_url", f"is {base_url!r}; {example}")
    if "?" in base_url or "#" in base_url:
        raise InvalidArgument(
            "base_url", f"is {base_url!r}; what is asked is put after it, so {example}, without ? or #"
        )
    return url


def _checked_timeout(timeout: float) -> float:
    if not 0 < timeout <= MAX_TIMEOUT_S:
        raise InvalidArgument("timeout", f"is {timeout:g} s; give more than 0 and at most {MAX_TIMEOUT_S:g}")
    return timeout


def _answer(response: httpx.Response, body: AnswerBody) -> Answer:
    headers = {name.lower(): value for name, value in response.headers.items()}
    return Answer(response.status_code, headers, body.content())


def _failure(error: httpx.RequestError, base_url: str) -> Outcome:
    if isinstance(error, httpx.TimeoutException):
        return TimedOut()
    return ConnectionLost(f"cannot reach {base_url}: {str(error) or type(error).__name__}")
