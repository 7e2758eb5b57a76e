"""What `/openapi.json` says about bodies, query strings and problems that FastAPI cannot see by itself."""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI
from pydantic.json_schema import models_json_schema

from service.errors import PROBLEM_JSON, PROBLEMS, ClientGone, UnknownModel
from service.payloads import JSON, NPY, OCTET_STREAM
from service.schemas import GraspOptions, GraspRequest, GraspResponse, Problem

REF = "#/components/schemas/{model}"

EXAMPLE_POINTS = [[0.01, 0.02, 0.51], [0.012, 0.02, 0.51], [0.014, 0.021, 0.509]]


def problems(*kinds: type[Exception]) -> dict[int | str, dict[str, Any]]:
    """The `responses` of a route that answers these kinds of problems, for FastAPI."""
    return {PROBLEMS[kind].status: _problem(PROBLEMS[kind].when) for kind in kinds}


def document_grasps(app: FastAPI) -> None:
    """Make `app.openapi()` describe `POST /grasps` in full."""
    generate = app.openapi

    def openapi() -> dict[str, Any]:
        if app.openapi_schema is None:
            document = generate()
            _, models = models_json_schema(
                [
                    (GraspRequest, "validation"),
                    (GraspOptions, "validation"),
                    (GraspResponse, "validation"),
                    (Problem, "validation"),
                ],
                ref_template=REF,
            )
            document.setdefault("components", {}).setdefault("schemas", {}).update(models["$defs"])
            document["paths"]["/grasps"]["post"].update(_grasps(models["$defs"]["GraspOptions"]["properties"]))
            app.openapi_schema = document
        return app.openapi_schema

    app.openapi = openapi  # type: ignore[method-assign]  # the way FastAPI's documentation gives for extending it


def _grasps(options: dict[str, Any]) -> dict[str, Any]:
    """The operation object of `POST /grasps`."""
    return {
        "description": "Send points as JSON, as raw little-endian float32 triples, or as a .npy array. Options go into "
        "the JSON body or into the query string, each value as URL-encoded JSON (`viewpoint=[0.3,0,0.6]`); plain words "
        "need no quotes; null means the default. Nothing found is a 200 with an empty list and a `reason`.",
        "parameters": [
            {
                "name": name,
                "in": "query",
                "required": False,
                "description": schema.get("description", ""),
                "content": {JSON: {"schema": {key: value for key, value in schema.items() if key != "description"}}},
            }
            for name, schema in options.items()
        ]
        + [
            _header(
                "X-Request-ID",
                "Names the request in answers and logs; made up when missing.",
                {"type": "string", "maxLength": 128},
            ),
            _header(
                "X-Request-Timeout",
                "Seconds after which the answer is worthless to the client: a 504 then. Default 30.",
                {"type": "number", "exclusiveMinimum": 0, "maximum": 3600},
            ),
        ],
        "requestBody": {
            "required": True,
            "content": {
                JSON: {
                    "schema": {"$ref": REF.format(model="GraspRequest")},
                    "example": {"points": EXAMPLE_POINTS, "up": [0, 0, 1]},
                },
                OCTET_STREAM: {
                    "schema": {
                        "type": "string",
                        "format": "binary",
                        "description": "Little-endian float32 x, y, z triples in metres, 12 bytes a point.",
                    }
                },
                NPY: {
                    "schema": {
                        "type": "string",
                        "format": "binary",
                        "description": "A .npy array (N, 3) of float32 or float64 in metres; never unpickled.",
                    }
                },
            },
        },
        "responses": {
            "200": {
                "description": "Grasps, best first.",
                "content": {JSON: {"schema": {"$ref": REF.format(model="GraspResponse")}}},
            },
            **{
                str(row.status): _problem(row.when, retry=row.status in (429, 503))
                for kind, row in PROBLEMS.items()
                if kind not in (ClientGone, UnknownModel)
            },
        },
    }


def _header(name: str, description: str, schema: dict[str, Any]) -> dict[str, Any]:
    return {"name": name, "in": "header", "required": False, "description": description, "schema": schema}


def _problem(description: str, retry: bool = False) -> dict[str, Any]:
    response: dict[str, Any] = {
        "description": description,
        "content": {PROBLEM_JSON: {"schema": {"$ref": REF.format(model="Problem")}}},
    }
    if retry:
        response["headers"] = {"Retry-After": {"description": "Seconds to wait.", "schema": {"type": "integer"}}}
    return response
