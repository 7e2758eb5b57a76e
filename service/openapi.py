"""What `/openapi.json` says about bodies, query strings and problems that FastAPI cannot see by itself."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from fastapi import FastAPI
from pydantic.json_schema import models_json_schema

from service.answers import NPZ
from service.errors import PROBLEM_JSON, PROBLEMS, ClientGone, UnknownModel
from service.payloads import JSON, MULTIPART, NPY, OCTET_STREAM
from service.schemas import MAX_TIMEOUT_S, DepthOptions, GraspOptions, GraspRequest, GraspResponse, Problem
from tesnet import formats

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
                    (DepthOptions, "validation"),
                    (GraspResponse, "validation"),
                    (Problem, "validation"),
                ],
                ref_template=REF,
            )
            document.setdefault("components", {}).setdefault("schemas", {}).update(models["$defs"])
            _drop_validation_errors(document)
            document["paths"]["/grasps"]["post"].update(_grasps(models["$defs"]["GraspOptions"]["properties"]))
            app.openapi_schema = document
        return app.openapi_schema

    app.openapi = openapi  # type: ignore[method-assign]  # the way FastAPI's documentation gives for extending it


def document_keys(app: FastAPI, open_paths: Collection[str]) -> None:
    """Make `app.openapi()` tell how a key is given, and which paths need none."""
    generate = app.openapi

    def openapi() -> dict[str, Any]:
        document = generate()
        document["components"]["securitySchemes"] = {
            "bearer": {"type": "http", "scheme": "bearer"},
            "key": {"type": "apiKey", "in": "header", "name": "X-API-Key"},
        }
        document["security"] = [{"bearer": []}, {"key": []}]
        for path in document["paths"].keys() & set(open_paths):
            for operation in document["paths"][path].values():
                operation["security"] = []
        return document

    app.openapi = openapi  # type: ignore[method-assign]  # as above


def _drop_validation_errors(document: dict[str, Any]) -> None:
    """FastAPI adds its own 422 to every route with a parameter in the path; any text is valid there."""
    for model in ("HTTPValidationError", "ValidationError"):
        document["components"]["schemas"].pop(model, None)
    for operations in document["paths"].values():
        for operation in operations.values():
            if "HTTPValidationError" in str(operation["responses"].get("422")):
                del operation["responses"]["422"]


def _grasps(options: dict[str, Any]) -> dict[str, Any]:
    """The operation object of `POST /grasps`."""
    return {
        "description": "Send points as JSON, as raw little-endian float32 triples, as a .npy array, or in a form as "
        "a cloud file or a depth image. Options go into the JSON body, the form or the query string, each value "
        "as URL-encoded JSON (`viewpoint=[0.3,0,0.6]`); plain words need no quotes; null means the default. Nothing "
        "found is a 200 with an empty list and a `reason`.",
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
                {"type": "number", "exclusiveMinimum": 0, "maximum": MAX_TIMEOUT_S},
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
                        "description": f"A .npy: {formats.NPY.what}, in metres; never unpickled.",
                    }
                },
                MULTIPART: {"schema": _form(), "encoding": {"options": {"contentType": JSON}}},
            },
        },
        "responses": {
            "200": {
                "description": "Grasps, best first.",
                "content": {
                    JSON: {"schema": {"$ref": REF.format(model="GraspResponse")}},
                    NPZ: {
                        "schema": {
                            "type": "string",
                            "format": "binary",
                            "description": "A .npz, for `Accept: application/x-npz`: arrays scores (M), poses "
                            "(M, 4, 4) in `frame_convention`, hand_poses and pregrasps (M, 4, 4), widths "
                            "(M), approach_points and contact_points (M, 3); and meta, the rest of the JSON as text.",
                        }
                    },
                },
            },
            **{
                str(row.status): _problem(row.when, retry=row.status in (429, 503))
                for kind, row in PROBLEMS.items()
                if kind not in (ClientGone, UnknownModel)
            },
        },
    }


def _form() -> dict[str, Any]:
    """The schema of a multipart body."""
    readers = "; ".join(f"{', '.join(entry.suffixes)} ({entry.what})" for entry in formats.FORMATS)
    files = {
        "cloud": f"A file of one of these formats: {readers}. Either this or `depth`.",
        "depth": "A depth image: 16-bit grey PNG, or a .npy of counts as whole numbers or of metres as floating "
        "point; 0 or NaN where there is no depth. `options` holds its camera.",
        "mask": "With `depth`: a grey PNG of 8 or 16 bits or a .npy of the same size; non-zero on the target, or "
        "labels.",
        "view_index": "A .npy of whole numbers: which `viewpoint` saw each point, from 0.",
        "normals": "A .npy of float32 or float64 (N, 3): outward normals of the points, zeros where there is none.",
    }
    return {
        "type": "object",
        "properties": {
            **{name: {"type": "string", "format": "binary", "description": text} for name, text in files.items()},
            "options": {"$ref": REF.format(model="DepthOptions")},
        },
        "oneOf": [{"required": ["cloud"]}, {"required": ["depth", "options"]}],
        "description": "Options go into the part `options`, a JSON object, or each into a part of its own name. The "
        "camera (`intrinsics`, `T_cloud_camera`, `depth_scale`) belongs to a depth image alone.",
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
