"""`POST /grasps`, from admission to answer. The event loop only waits: decoding and predicting happen in threads."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import anyio
import anyio.to_thread
from starlette.requests import Request
from starlette.responses import Response

from service.answers import encoder_for
from service.batching import Answer, Job, PredictionWorker
from service.errors import (
    ClientGone,
    DeadlineExceeded,
    Invalid,
    NotReady,
    UnknownContentType,
    shortened,
)
from service.intake import Intake
from service.metrics import Metrics
from service.middleware import RequestRecord
from service.payloads import (
    Decoder,
    RawOptions,
    build_query,
    decoder_for,
    merged,
    parse_options,
    parse_query_string,
)
from service.schemas import GraspOptions
from service.settings import Settings
from tesnet.query import GraspQuery

MAX_TIMEOUT_S = 3600.0
DECODER_THREADS = 2
BODIES_IN_MEMORY = 4
"""Bodies of the largest size that may be read or decoded at once; smaller ones accordingly more."""
SMALL_ANSWER = 50
"""Grasps that are encoded on the event loop: under a millisecond."""

Result = TypeVar("Result")


class GraspEndpoint:
    """Answers `POST /grasps`, and knows how many it is answering.

    Args:
        settings: the limits.
        worker: predicts.
        metrics: counts.
    """

    def __init__(self, settings: Settings, worker: PredictionWorker, metrics: Metrics) -> None:
        self._settings = settings
        self._worker = worker
        self._metrics = metrics
        self._intake = Intake(settings.max_body_bytes, BODIES_IN_MEMORY * settings.max_body_bytes)
        self._threads: anyio.CapacityLimiter | None = None
        self._draining = False
        self._active = 0

    @property
    def ready(self) -> bool:
        """Whether requests are taken."""
        return self._worker.state == "ready" and not self._draining

    @property
    def active(self) -> int:
        """Requests being answered."""
        return self._active

    def drain(self) -> None:
        """Take no more requests; those being answered go on."""
        self._draining = True

    def check_ready(self) -> None:
        """Whether requests are taken.

        Raises:
            NotReady: says why not.
        """
        if self._draining:
            raise NotReady(
                "The service is about to end; repeat the request, another instance may take it.", retry_after=1
            )
        self._worker.check_ready()

    async def answer(self, request: Request) -> Response:
        """Decode, predict, encode, within the request's deadline.

        Raises:
            ServiceError, InvalidQuery: see the table in `service.errors`.
        """
        self.check_ready()
        self._worker.check_room()
        record: RequestRecord = request.state.record
        timeout = self._timeout(request)
        self._active += 1
        try:
            with anyio.fail_after(max(0.0, record.arrived + timeout - time.perf_counter())):
                return await self._answer(request, record)
        except TimeoutError:
            raise DeadlineExceeded(
                f"No answer within {timeout:g} s; send fewer points, lower max_candidates, or set a larger "
                f"X-Request-Timeout (at most {MAX_TIMEOUT_S:g})."
            ) from None
        finally:
            self._active -= 1

    async def _answer(self, request: Request, record: RequestRecord) -> Response:
        decode = decoder_of(request)
        encoder = encoder_for(request.headers.getlist("accept"))
        url_options = parse_query_string(request.scope["query_string"])
        parse_options(url_options)  # refuse a bad one before the body is read
        async with self._intake.body(request) as body:
            received = time.perf_counter()
            query, options = await self._in_thread(partial(self._decode, decode, body, url_options))
        decoded = time.perf_counter()
        record.fields["points"] = len(query.points)
        answer = await self._predict(request, query)
        result = answer.result
        timings = {
            "decode": 1e3 * (decoded - received),
            "queue": answer.queue_ms,
            **result.timings_ms,
            "total": 1e3 * (time.perf_counter() - received),
        }
        self._metrics.prediction(len(query.points), timings)
        record.fields.update(
            candidates=result.counts.candidates,
            returned=result.counts.returned,
            reason=result.reason,
            timings_ms={stage: round(milliseconds, 3) for stage, milliseconds in timings.items()},
        )
        encode = partial(encoder.encode, result, options, self._worker.model, timings, record.request_id)
        body_out = encode() if len(result.grasps) <= SMALL_ANSWER else await self._in_thread(encode)
        return Response(body_out, media_type=encoder.content_type, headers={"Vary": "Accept"})

    def _decode(self, decode: Decoder, body: bytearray, url_options: RawOptions) -> tuple[GraspQuery, GraspOptions]:
        payload = decode(body, self._settings.max_points)
        options = parse_options(merged(url_options, payload.options), self._settings.max_points)
        loaded = self._worker.model.name
        if options.model != loaded:
            raise Invalid("model", f"is {shortened(options.model)}, which is not loaded; loaded: {loaded}")
        return build_query(payload, options), options

    async def _predict(self, request: Request, query: GraspQuery) -> Answer:
        """Queue the query and wait for its answer, or for the client to hang up."""
        job = self._worker.submit(query)
        answer = asyncio.wrap_future(job.future)
        gone = asyncio.ensure_future(_hung_up(request))
        either: set[asyncio.Future[Any]] = {answer, gone}
        try:
            await asyncio.wait(either, return_when=asyncio.FIRST_COMPLETED)
            if answer.done():
                return answer.result()
            raise ClientGone("The client closed the connection while its request waited.")
        finally:
            gone.cancel()
            self._release(job)

    def _release(self, job: Job) -> None:
        if not job.future.done():
            self._worker.cancel(job)

    async def _in_thread(self, work: Callable[[], Result]) -> Result:
        if self._threads is None:
            self._threads = anyio.CapacityLimiter(DECODER_THREADS)
        return await anyio.to_thread.run_sync(work, abandon_on_cancel=True, limiter=self._threads)

    def _timeout(self, request: Request) -> float:
        """Seconds that the client gives, or the default.

        Raises:
            Invalid: not a number of seconds.
        """
        given = request.headers.get("x-request-timeout")
        if given is None:
            return self._settings.request_timeout
        try:
            seconds = float(given)
        except ValueError:
            seconds = math.nan
        if not 0 < seconds <= MAX_TIMEOUT_S:
            raise Invalid(
                "X-Request-Timeout", f"is {shortened(given)}; give seconds, more than 0 and at most {MAX_TIMEOUT_S:g}"
            )
        return seconds


def decoder_of(request: Request) -> Decoder:
    """The decoder for the request's body.

    Raises:
        UnknownContentType: there is none.
        Undecodable: a form without a boundary.
    """
    encoding = request.headers.get("content-encoding", "identity").strip().lower()
    if encoding != "identity":
        raise UnknownContentType(
            f"Content-Encoding {shortened(encoding)} is not supported; send the body uncompressed."
        )
    return decoder_for(request.headers.get("content-type", ""))


async def _hung_up(request: Request) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass
