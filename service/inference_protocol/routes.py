"""The routes under `/v2`, in front of the endpoint that answers `POST /grasps` too."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from fastapi import APIRouter, Depends, Request, Response

from service import schemas
from service.answers import answer_arrays, answer_meta
from service.batching import PredictionWorker
from service.errors import (
    INFERENCE_PROTOCOL,
    Invalid,
    NotReady,
    Unauthorized,
    UnknownContentType,
    UnknownModel,
    shortened,
)
from service.grasps import Asked, GraspEndpoint, Reader, check_hand, refuse_compressed
from service.inference_protocol.decoding import decode
from service.inference_protocol.documentation import INFER_PROBLEMS, INFER_REQUEST, INFER_RESPONSES
from service.inference_protocol.encoding import encode
from service.inference_protocol.tensors import HEADER_LENGTH, INPUT, OUTPUTS
from service.openapi import problems
from service.payloads import JSON, OCTET_STREAM, build_query, media_type
from service.settings import Settings, service_version
from tesnet.result import GraspResult

if TYPE_CHECKING:
    from tesnet.predictor import ModelInfo


def inference_protocol(settings: Settings, worker: PredictionWorker, endpoint: GraspEndpoint) -> APIRouter:
    """The routes under `/v2`.

    Args:
        settings: the limits.
        worker: knows the network.
        endpoint: answers, with the same queue, deadlines and limits as `POST /grasps`.
    """
    router = APIRouter(prefix=INFERENCE_PROTOCOL, tags=["inference protocol"])
    model_problems = problems(NotReady, Unauthorized, UnknownModel)

    def of_path(model: str, version: str | None) -> ModelInfo:
        for loaded in worker.models:
            if model == loaded.name and version in (None, loaded.version):
                return loaded
        what = shortened(model if version is None else f"{model}, version {version}")
        names = "; ".join(f"{loaded.name}, version {loaded.version}" for loaded in worker.models)
        raise UnknownModel(f"{what} is not loaded; loaded: {names}.")

    @router.get("", summary="Server metadata", responses=problems(Unauthorized))
    async def server() -> schemas.ServerMetadata:
        return schemas.ServerMetadata(name="tes-net", version=service_version(), extensions=["binary_tensor_data"])

    @router.head("/health/live", include_in_schema=False)
    @router.get("/health/live", summary="Does the process work?", responses=problems(NotReady))
    async def live() -> dict[str, bool]:
        worker.check_live()
        return {"live": True}

    @router.head("/health/ready", include_in_schema=False)
    @router.get("/health/ready", summary="Does the service take requests?", responses=problems(NotReady))
    async def ready() -> dict[str, bool]:
        endpoint.check_ready()
        return {"ready": True}

    def add_model(path: str, version_of: Callable[..., str | None]) -> None:
        @router.get(path, summary="Model metadata", responses=model_problems)
        async def describe(model: str, version: str | None = Depends(version_of)) -> schemas.ModelMetadata:
            loaded = of_path(model, version)
            return schemas.ModelMetadata(
                name=model, versions=[loaded.version], platform="pytorch", inputs=[INPUT], outputs=OUTPUTS
            )

        @router.get(f"{path}/ready", summary="Does the model take requests?", responses=model_problems)
        async def model_ready(model: str, version: str | None = Depends(version_of)) -> dict[str, bool]:
            of_path(model, version)
            endpoint.check_ready()
            return {"ready": True}

        @router.post(
            f"{path}/infer",
            summary="Grasps for a point cloud",
            response_class=Response,
            responses=INFER_RESPONSES | problems(*INFER_PROBLEMS),
            openapi_extra=INFER_REQUEST,
        )
        async def infer(request: Request, model: str, version: str | None = Depends(version_of)) -> Response:
            def reader_of(request: Request) -> Reader:
                return _reader(request, settings, of_path(model, version))

            return await endpoint.answer(request, reader_of)

    add_model("/models/{model}", _no_version)
    add_model("/models/{model}/versions/{version}", _version_of_path)
    return router


def _no_version() -> None:
    """Any version of the network."""


def _version_of_path(version: str) -> str:
    """The version that the path names."""
    return version


def _reader(request: Request, settings: Settings, model: ModelInfo) -> Reader:
    """Reads the bodies of `infer`, once the head of the request is known to be right."""
    refuse_compressed(request)
    given = request.headers.get("content-type", JSON)  # which Triton's client leaves out
    if media_type(given) not in (JSON, OCTET_STREAM):
        raise UnknownContentType(f"Content-Type {shortened(given)} is not supported; send {JSON} or {OCTET_STREAM}.")
    if request.scope["query_string"]:
        raise Invalid("query string", "has no meaning here; options go into `parameters` of the body")
    head_length = request.headers.get(HEADER_LENGTH)
    if head_length is not None and not re.fullmatch(r"\d{1,10}", head_length):
        raise Invalid(HEADER_LENGTH, f"is {shortened(head_length)}; give the bytes of the JSON at the body's beginning")
    request_id = request.state.record.request_id

    def read(body: bytearray) -> Asked:
        asked = decode(body, None if head_length is None else int(head_length), settings.max_points)
        if asked.options.model not in (None, model.name):
            raise Invalid(
                "model", f"is {shortened(asked.options.model)}, but the path names {model.name}; leave it out"
            )
        options = asked.options.model_copy(update={"model": model.name})
        query = build_query(asked.payload, options, settings.max_points)
        check_hand(query, model)

        def write(result: GraspResult, timings_ms: Mapping[str, float]) -> Response:
            arrays = answer_arrays(result, options)
            meta = answer_meta(result, model, timings_ms, request_id)
            head = {"model_name": model.name, "model_version": model.version}
            return encode(head | ({"id": asked.identity} if asked.identity else {}), arrays, meta, asked.outputs)

        return Asked(query, write, asked.timeout)

    return read
