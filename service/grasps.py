"""A request for grasps, from admission to answer, within its deadline.

Decoding, predicting and the encoding of long answers happen in threads, so that the event loop goes on. What the bytes
of a body mean is the business of a `ReaderFactory`: `GraspEndpoint.reader` for `POST /grasps`.
"""

from __future__ import annotations

import asyncio
import math
import re
import time
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

import anyio
from starlette.requests import Request
from starlette.responses import Response

from service.answers import encoder_for
from service.batching import PredictionWorker
from service.errors import (
    ClientGone,
    DeadlineExceeded,
    Invalid,
    NotReady,
    UnknownContentType,
    shortened,
)
from service.intake import announced_bytes, read_body
from service.metrics import Metrics
from service.middleware import RequestRecord
from service.payloads import OCTET_STREAM, build_query, decoder_for, merged, parse_options, parse_query_string
from service.schemas import MAX_TIMEOUT_S, GraspOptions
from service.settings import Settings
from service.turns import Answer, Job
from tesnet.geometry import PANDA
from tesnet.query import GraspQuery
from tesnet.result import GraspResult

if TYPE_CHECKING:
    from tesnet.predictor import ModelInfo

SMALL_BODY = 2**20
"""Bytes up to which a body is decoded in a lane where no large one is before it, and up to which a request may be so
cheap that it has a spare place in the queue."""
SMALL_ANSWER = 50
"""Grasps that are encoded on the event loop: under a millisecond."""

_SECONDS = re.compile(r"(\d{1,10}(\.\d{0,20})?|\.\d{1,20})([eE][+-]?\d{1,2})?")
_ANY_HAND = "tesnet"
"""The network that takes other hands."""

Result = TypeVar("Result")

Writer = Callable[[GraspResult, Mapping[str, float]], Response]
"""result, milliseconds by stage -> the answer."""


@dataclass(frozen=True, eq=False, slots=True)
class Asked:
    """A decoded body: the query, what writes its answer, and in how many seconds it must have been begun."""

    query: GraspQuery
    write: Writer
    timeout: float = math.inf


Reader = Callable[[bytearray], Asked]
"""body -> what it asks. Runs in a thread; raises what `service.errors` knows."""
ReaderFactory = Callable[[Request], Reader]
"""The head of a request -> the reader of its body, or an error before the body is read."""


class GraspEndpoint:
    """Answers requests for grasps, and knows how many it is answering.

    Args:
        settings: the limits.
        worker: predicts.
        metrics: counts.
    """

    def __init__(self, settings: Settings, worker: PredictionWorker, metrics: Metrics) -> None:
        self._settings = settings
        self._worker = worker
        self._metrics = metrics
        self._small_lane = ThreadPoolExecutor(1, thread_name_prefix="codec of small bodies")
        self._large_lane = ThreadPoolExecutor(1, thread_name_prefix="codec of large bodies")
        self._draining = False
        self._active = 0
        self._closed = False

    @property
    def ready(self) -> bool:
        """Whether requests are taken."""
        return self._worker.state == "ready" and not self._draining

    @property
    def active(self) -> int:
        """Requests being answered."""
        return self._active

    @property
    def closed(self) -> bool:
        """Whether `close` saw every prediction end."""
        return self._closed

    def close(self, timeout: float) -> None:
        """Refuse what waits, and give a prediction that runs `timeout` seconds to end."""
        for lane in (self._small_lane, self._large_lane):
            lane.shutdown(wait=False, cancel_futures=True)
        self._closed = self._worker.stop(timeout)

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

    async def answer(self, request: Request, reader_of: ReaderFactory) -> Response:
        """Decode, predict, encode, within the request's deadline.

        Raises:
            ServiceError, InvalidQuery: see the table in `service.errors`.
        """
        with self._admitted(request) as deadline:
            return await self._answer(request, request.state.record, reader_of(request), deadline)

    async def answer_points(self, request: Request) -> Response:
        """The points of a body of `POST /grasps` as little-endian float32 triples, admitted and limited like one.

        Raises:
            ServiceError, InvalidQuery: see the table in `service.errors`.
        """
        with self._admitted(request):
            asked, _ = await self._read(request, self.reader(request))
            points = asked.query.points + asked.query.offset
            return Response(points.astype("<f4").tobytes(), media_type=OCTET_STREAM)

    @contextmanager
    def _admitted(self, request: Request) -> Iterator[float]:
        """The deadline of a request that is taken, within which the block ends."""
        self.check_ready()
        announced = announced_bytes(request)
        self._worker.check_room(self._client(request), may_be_cheap=announced is None or announced <= SMALL_BODY)
        timeout = self._timeout(request)
        deadline = request.state.record.arrived + timeout
        self._active += 1
        try:
            with anyio.fail_after(max(0.0, deadline - time.perf_counter())):
                yield deadline
        except TimeoutError:
            record = request.state.record
            if not record.body_complete:
                raise DeadlineExceeded(
                    f"Only {record.bytes_in} bytes of the body had come after {timeout:g} s; send it faster, or set a "
                    f"larger X-Request-Timeout (at most {MAX_TIMEOUT_S:g})."
                ) from None
            raise DeadlineExceeded(
                f"No answer within {timeout:g} s; send fewer points, lower max_candidates, or set a larger "
                f"X-Request-Timeout (at most {MAX_TIMEOUT_S:g})."
            ) from None
        finally:
            self._active -= 1

    async def _answer(self, request: Request, record: RequestRecord, read: Reader, deadline: float) -> Response:
        asked, received = await self._read(request, read)
        decoded = time.perf_counter()
        query = asked.query
        record.fields.update(points=len(query.points), model=query.model or self._worker.models[0].name)
        answer = await self._predict(request, query, deadline, record.arrived + asked.timeout)
        result = answer.result
        predicted = time.perf_counter()
        timings = {
            "decode": 1e3 * (decoded - received),
            "queue": answer.queue_ms,
            **result.timings_ms,
            "total": 1e3 * (predicted - received),
        }
        record.fields.update(
            candidates=result.counts.candidates,
            returned=result.counts.returned,
            reason=result.reason,
            batch_size=answer.batch_size,
            timings_ms={stage: round(milliseconds, 3) for stage, milliseconds in timings.items()},
        )
        write = partial(asked.write, result, timings)
        response = write() if len(result.grasps) <= SMALL_ANSWER else await _in_thread(self._small_lane, write)
        self._metrics.prediction(
            record.fields["model"], len(query.points), timings | {"encode": 1e3 * (time.perf_counter() - predicted)}
        )
        return response

    async def _read(self, request: Request, read: Reader) -> tuple[Asked, float]:
        """What the body asks, and when its last byte came. The body itself is forgotten then: only its cloud waits."""
        share = request.state.record.share
        body = await read_body(request, self._settings.max_body_bytes, share)
        received = time.perf_counter()
        self._worker.check_room(self._client(request), may_be_cheap=len(body) <= SMALL_BODY)  # it may have filled
        lane = self._small_lane if len(body) <= SMALL_BODY else self._large_lane
        asked = await _in_thread(lane, partial(read, body))
        share.resize(asked.query.nbytes)
        return asked, received

    def _client(self, request: Request) -> Hashable:
        """Whose a request is: its API key's, else its address's where that can be believed; None for anybody's."""
        key: bytes | None = request.state.record.key
        if key is not None or not self._settings.trusted_proxies or request.client is None:
            return key
        return request.client.host

    def reader(self, request: Request) -> Reader:
        """Reads the bodies of `POST /grasps`.

        Raises:
            UnknownContentType, NotAcceptable, Invalid: what the head alone shows to be wrong.
        """
        refuse_compressed(request)
        decode = decoder_for(request.headers.get("content-type", ""))
        encoder = encoder_for(request.headers.getlist("accept"))
        url_options = parse_query_string(request.scope["query_string"])
        parse_options(url_options)  # refuse a bad one before the body is read
        request_id = request.state.record.request_id

        def read(body: bytearray) -> Asked:
            payload = decode(body, self._settings.max_points)
            options = parse_options(merged(url_options, payload.options), self._settings.max_points)
            model = chosen_model(options, self._worker.models)
            query = build_query(payload, options, self._settings.max_points)
            check_hand(query, model)

            def write(result: GraspResult, timings_ms: Mapping[str, float]) -> Response:
                content = encoder.encode(result, options, model, timings_ms, request_id)
                return Response(content, media_type=encoder.content_type, headers={"Vary": "Accept"})

            return Asked(query, write)

        return read

    async def _predict(self, request: Request, query: GraspQuery, deadline: float, begin_by: float) -> Answer:
        """Queue the query and wait for its answer, or for the client to hang up."""
        job = self._worker.submit(query, deadline, begin_by, self._client(request))
        answer = asyncio.wrap_future(job.future)
        answer.add_done_callback(_retrieve)  # an error that comes too late is the log's no more than the client's
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

    def _timeout(self, request: Request) -> float:
        """Seconds that the client gives, or the default.

        Raises:
            Invalid: not a number of seconds.
        """
        given = request.headers.get("x-request-timeout")
        if given is None:
            return self._settings.request_timeout
        seconds = float(given) if _SECONDS.fullmatch(given) else math.nan
        if not 0 < seconds <= MAX_TIMEOUT_S:
            raise Invalid(
                "X-Request-Timeout", f"is {shortened(given)}; give seconds, more than 0 and at most {MAX_TIMEOUT_S:g}"
            )
        return seconds


async def _in_thread(lane: ThreadPoolExecutor, work: Callable[[], Result]) -> Result:
    """The result of work in a lane. Who stops waiting leaves it to end there, or never to begin."""
    return await asyncio.wrap_future(lane.submit(work))


def refuse_compressed(request: Request) -> None:
    """Raise `UnknownContentType` for a body that would have to be expanded."""
    encoding = request.headers.get("content-encoding", "").strip().lower()
    if encoding not in ("", "identity"):
        raise UnknownContentType(
            f"Content-Encoding {shortened(encoding)} is not supported; send the body uncompressed."
        )


def chosen_model(options: GraspOptions, loaded: Sequence[ModelInfo]) -> ModelInfo:
    """The network that the options name, or else the first of the loaded ones.

    Raises:
        Invalid: it is not loaded; names those that are.
    """
    if options.model is None:
        return loaded[0]
    for model in loaded:
        if model.name == options.model:
            return model
    names = ", ".join(model.name for model in loaded)
    raise Invalid("model", f"is {shortened(options.model)}, which is not loaded; loaded: {names}")


def check_hand(query: GraspQuery, model: ModelInfo) -> None:
    """Refuse another hand than the Panda's for a network that knows no other.

    Raises:
        Invalid: names the network that does.
    """
    if query.gripper != PANDA and model.name != _ANY_HAND:
        raise Invalid("gripper", f"is another hand, but {model.name} knows the Franka hand alone; ask {_ANY_HAND}")


def _retrieve(answer: asyncio.Future[Answer]) -> None:
    """Look at an answer's error, so that asyncio does not report one that nobody waits for any more."""
    if not answer.cancelled():
        answer.exception()


async def _hung_up(request: Request) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass
