"""`create_app`: routes and lifespan, nothing else."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

import anyio.to_thread
import msgspec
from fastapi import FastAPI, Request, Response
from fastapi_offline import FastAPIOffline
from prometheus_client import CONTENT_TYPE_LATEST
from starlette.exceptions import HTTPException
from starlette.middleware.cors import CORSMiddleware

from service import schemas
from service.access import DOCS_FILES, OPEN_PATHS, AccessMiddleware
from service.batching import PredictionWorker, PredictorFactory
from service.errors import NotReady, ServiceError, Unauthorized, problem_response
from service.grasps import GraspEndpoint
from service.hands import described, described_known
from service.inference_protocol import inference_protocol
from service.memory import Memory
from service.metrics import Metrics
from service.middleware import RequestMiddleware
from service.openapi import document_grasps, document_keys, problems
from service.payloads import CONTENT_TYPES
from service.settings import Settings, service_version
from service.viewer import viewer
from tesnet.errors import InvalidQuery, TooManyPoints, UnreadableFile
from tesnet.geometry import FRAME_CONVENTIONS, PANDA
from tesnet.hands import HANDS
from tesnet.query import MAX_APPROACH_POINTS, MAX_CANDIDATES, MAX_CANDIDATES_OF_LARGE_HANDS, MAX_GRASPS

DESCRIPTION = """Point cloud in, ranked SE(3) grasps out. Lengths are metres; poses are in the frame of the request's
points. In the default `panda` convention a grasp's origin is the TCP, +z is the direction of travel and +y the closing
direction."""

STOP_SECONDS = 2.0
"""For a prediction that still runs when the application ends; its thread is left behind after that."""


def create_app(
    settings: Settings,
    predictor_factory: PredictorFactory,
    on_ready: Callable[[], None] = lambda: None,
    on_failure: Callable[[BaseException], None] = lambda _: None,
) -> FastAPI:
    """The application, loading its predictor when its lifespan starts. `app.state` has its `endpoint` and its
    `memory`.

    Args:
        settings: limits and defaults.
        predictor_factory: makes the predictor, in the thread that will own it.
        on_ready: called in that thread when requests are taken.
        on_failure: called there with the exception when the predictor cannot be made.
    """
    metrics = Metrics()
    memory = Memory(settings.max_held_bytes)
    worker = PredictionWorker(
        predictor_factory,
        settings.queue_size,
        settings.max_batch,
        metrics.batch,
        on_ready,
        on_failure,
        settings.places_of_a_client,
    )
    endpoint = GraspEndpoint(settings, worker, metrics)
    metrics.watch(
        queue_depth=lambda: worker.depth,
        active=lambda: endpoint.active,
        is_ready=lambda: endpoint.ready,
        held_bytes=lambda: memory.held,
    )

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        worker.start()
        yield
        await anyio.to_thread.run_sync(endpoint.close, STOP_SECONDS)

    app = FastAPIOffline(  # its reference page loads nothing from elsewhere
        title="TES-Net grasp service",
        version=service_version(),
        description=DESCRIPTION,
        lifespan=lifespan,
        redoc_url=None,
        static_url=DOCS_FILES,
        redirect_slashes=False,
    )
    app.state.endpoint = endpoint
    app.state.memory = memory
    if settings.api_keys:
        app.add_middleware(AccessMiddleware, keys=[key.get_secret_value() for key in settings.api_keys])
    if settings.cors_origins:  # outside: a browser asks for permission without a key
        app.add_middleware(
            CORSMiddleware,
            allow_origins=settings.cors_origins,
            allow_methods=["GET", "POST"],
            allow_headers=[
                "Accept",
                "Inference-Header-Content-Length",
                "Authorization",
                "Content-Type",
                "X-API-Key",
                "X-Request-ID",
                "X-Request-Timeout",
            ],
            expose_headers=["Inference-Header-Content-Length", "Retry-After", "X-Request-ID"],
        )
    app.add_middleware(RequestMiddleware, metrics=metrics, memory=memory)
    for kind in (ServiceError, InvalidQuery, TooManyPoints, UnreadableFile, HTTPException):
        app.add_exception_handler(kind, _answer_problem)

    @app.post(
        "/grasps", tags=["grasps"], summary="Grasps for a point cloud", response_class=Response, include_in_schema=True
    )
    async def grasps(request: Request) -> Response:
        return await endpoint.answer(request, endpoint.reader)

    @app.head("/health/live", include_in_schema=False)
    @app.get("/health/live", tags=["health"], summary="Does the process work?", responses=problems(NotReady))
    async def live() -> schemas.Health:
        worker.check_live()
        return schemas.Health(status="live")

    @app.head("/health/ready", include_in_schema=False)
    @app.get("/health/ready", tags=["health"], summary="Does the service take requests?", responses=problems(NotReady))
    async def ready() -> schemas.Health:
        endpoint.check_ready()
        return schemas.Health(status="ready")

    @app.get(
        "/model", tags=["model"], summary="Networks, frames and limits", responses=problems(NotReady, Unauthorized)
    )
    async def model() -> schemas.ModelResponse:
        return _describe(settings, worker)

    @app.get(
        "/metrics",
        tags=["health"],
        summary="Prometheus metrics",
        response_class=Response,
        responses=problems(Unauthorized),
    )
    async def metrics_text() -> Response:
        return Response(metrics.text(), media_type=CONTENT_TYPE_LATEST)

    app.include_router(inference_protocol(settings, worker, endpoint))
    app.include_router(viewer(endpoint))
    document_grasps(app)
    if settings.api_keys:
        document_keys(app, OPEN_PATHS)
    return app


def _describe(settings: Settings, worker: PredictionWorker) -> schemas.ModelResponse:
    return schemas.ModelResponse(
        models=[
            schemas.NetworkOut(
                name=info.name,
                version=info.version,
                weights_sha256=info.weights_sha256,
                card=msgspec.to_builtins(info.card),
                configuration=msgspec.to_builtins(info.configuration),
            )
            for info in worker.models
        ],
        gripper=schemas.GripperOut(**described(PANDA)),
        hands=[schemas.HandOut(**described_known(hand)) for hand in HANDS.values()],
        frame_conventions=list(FRAME_CONVENTIONS),
        content_types=list(CONTENT_TYPES),
        limits=schemas.LimitsOut(
            max_points=settings.max_points,
            max_body_bytes=settings.max_body_bytes,
            max_grasps=MAX_GRASPS,
            max_approach_points=MAX_APPROACH_POINTS,
            max_candidates=MAX_CANDIDATES,
            max_candidates_of_large_hands=MAX_CANDIDATES_OF_LARGE_HANDS,
            queue_size=settings.queue_size,
            max_timeout_s=schemas.MAX_TIMEOUT_S,
        ),
        device=worker.device,
    )


async def _answer_problem(request: Request, error: Exception) -> Response:
    return problem_response(error, request.scope)
