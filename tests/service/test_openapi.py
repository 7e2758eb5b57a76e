"""What `/openapi.json` and `/docs` tell a reader who has nothing else."""

from __future__ import annotations

import re
from typing import Any

import httpx

from service.schemas import DepthOptions, GraspOptions, GraspRequest
from tesnet import formats


def test_the_documentation_covers_bodies_options_and_problems(http: httpx.Client) -> None:
    page = http.get("/docs").text
    loaded = re.findall(r'(?:src|href)="([^"]+)"', page)
    assert any("swagger" in address for address in loaded)
    for address in loaded:  # from this service, so that the page works where there is no other network
        assert http.get(address).status_code == 200, address
    document = http.get("/openapi.json").json()
    post = document["paths"]["/grasps"]["post"]
    assert set(post["requestBody"]["content"]) == {
        "application/json",
        "application/octet-stream",
        "application/x-npy",
        "multipart/form-data",
    }
    assert set(post["responses"]["200"]["content"]) == {"application/json", "application/x-npz"}
    form = post["requestBody"]["content"]["multipart/form-data"]["schema"]["properties"]
    assert set(form) == {"cloud", "depth", "mask", "view_index", "normals", "options"}
    assert all(suffix in form["cloud"]["description"] for suffix in formats.SUFFIXES)
    assert set(document["components"]["schemas"]["DepthOptions"]["properties"]) == set(DepthOptions.model_fields)
    assert set(post["responses"]) == {"200", "400", "401", "406", "413", "415", "422", "429", "503", "504"}
    assert all(
        "application/problem+json" in response["content"]
        for status, response in post["responses"].items()
        if status != "200"
    )
    query = {parameter["name"] for parameter in post["parameters"] if parameter["in"] == "query"}
    assert query == set(GraspOptions.model_fields)
    assert set(document["components"]["schemas"]["GraspRequest"]["properties"]) == set(GraspRequest.model_fields)
    references = set(_references(document))
    assert references
    for reference in references:
        assert reference.rpartition("/")[2] in document["components"]["schemas"]


def _references(node: Any) -> list[str]:
    if isinstance(node, dict):
        here = [node["$ref"]] if isinstance(node.get("$ref"), str) else []
        return here + [ref for value in node.values() for ref in _references(value)]
    return [ref for value in node for ref in _references(value)] if isinstance(node, list) else []
