"""docs/api.md says of routes, bodies, options, answers and problems what the OpenAPI document says, and no more."""

from __future__ import annotations

import json
import re
import subprocess
from pathlib import Path
from typing import Any, get_args

import httpx
import numpy as np
import pytest
from PIL import Image

from service import schemas
from service.access import OPEN_PATHS
from service.answers import NPZ
from service.app import create_app
from service.errors import INTERNAL, PROBLEMS, ClientGone
from service.inference_protocol.tensors import OUTPUTS
from service.settings import Settings
from service.viewer import PAGE_PATHS
from tesnet.result import Reason
from tests.conftest import PATIENCE_S
from tests.depth_scene import box_on_table

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
SHOWN_URL = "http://127.0.0.1:8000"
OPTIONS = set(schemas.GraspOptions.model_fields)


def unused_factory() -> Any:
    raise AssertionError("the document needs no predictor")


DOCUMENT = create_app(Settings(), unused_factory).openapi()
POST = DOCUMENT["paths"]["/grasps"]["post"]
MODELS = DOCUMENT["components"]["schemas"]


def section(heading: str) -> str:
    """What stands below a heading, up to the next one of any level."""
    (text,) = re.findall(rf"^#+ {re.escape(heading)}\n(.*?)(?=^#|\Z)", PAGE, re.MULTILINE | re.DOTALL)
    return str(text)


def rows(heading: str) -> list[str]:
    """The rows of a section's table."""
    return re.findall(r"^\| `.*\|$", section(heading), re.MULTILINE)


def names(heading: str) -> list[str]:
    """The first column of a section's table."""
    return [line.split("`")[1] for line in rows(heading)]


def row(name: str, schema: dict[str, Any], required: bool) -> str:
    default = schema.get("default")
    shown = "required" if required else "" if default is None else f"`{default}`"
    return f"| `{name}` | {schema['description']} | {shown} |"


def expected_rows(model: str) -> list[str]:
    """The table of a component: requests with defaults, answers without."""
    properties: dict[str, Any] = MODELS[model]["properties"]
    if not issubclass(getattr(schemas, model), schemas.RequestPart):
        return [
            f"| `{name}` | {schema.get('description') or MODELS[schema['$ref'].rpartition('/')[2]]['description']} |"
            for name, schema in properties.items()
        ]
    shared = OPTIONS if model in ("GraspRequest", "DepthOptions") else set()
    required = MODELS[model].get("required", ())
    return [row(name, schema, name in required) for name, schema in properties.items() if name not in shared]


def test_the_routes_and_their_statuses_are_those_of_the_service() -> None:
    table = re.findall(r"^\| `(\w+) (/\S*)` \|.*\| ([\d, ]+) \|$", section("Routes"), re.MULTILINE)
    documented = {(method, path): statuses.split(", ") for method, path, statuses in table}
    assert documented == {
        (method.upper(), path): sorted(operation["responses"])
        for path, operations in DOCUMENT["paths"].items()
        for method, operation in operations.items()
    }


def test_every_route_or_address_in_the_text_exists() -> None:
    patterns = [re.sub(r"\{\w+\}", "[^/]+", path) for path in [*DOCUMENT["paths"], *OPEN_PATHS]]
    named = re.findall(r"`(?:(?:GET|POST) )?(/[\w/{}.-]+)[`?]", PAGE) + re.findall(rf"{SHOWN_URL}(/[\w/.-]+)", PAGE)
    for path in named:
        assert any(re.fullmatch(pattern, path) for pattern in patterns), path


def test_the_routes_without_a_key_are_those_that_never_answer_401() -> None:
    for path, operations in DOCUMENT["paths"].items():
        for operation in operations.values():
            assert ("401" in operation["responses"]) == (path not in OPEN_PATHS), path
    parts = {path for path in OPEN_PATHS if path.startswith("/docs/")} | PAGE_PATHS
    assert set(re.findall(r"`(/\S+)`", section("API keys"))) | parts == OPEN_PATHS


def test_the_bodies_and_answers_are_those_of_the_schema() -> None:
    assert names("Bodies") == list(POST["requestBody"]["content"])
    form = POST["requestBody"]["content"]["multipart/form-data"]["schema"]["properties"]
    assert names("Forms") == list(form)
    assert set(POST["responses"]["200"]["content"]) == {"application/json", NPZ}
    assert f"Accept: {NPZ}" in section("Arrays instead of JSON")


def test_the_options_and_their_defaults_are_those_of_the_schema() -> None:
    parameters = [parameter for parameter in POST["parameters"] if parameter["in"] == "query"]
    assert rows("Options") == [
        row(
            parameter["name"],
            {**parameter["content"]["application/json"]["schema"], "description": parameter["description"]},
            parameter["required"],
        )
        for parameter in parameters
    ]


@pytest.mark.parametrize("model", sorted(set(MODELS) - {"GraspOptions"}))
def test_a_table_has_the_fields_and_defaults_of_its_component(model: str) -> None:
    assert rows(model) == expected_rows(model)


def test_the_reasons_are_those_of_the_service() -> None:
    assert names("When nothing is found") == list(get_args(Reason))


def test_the_tensors_are_those_of_the_service() -> None:
    assert rows("Open Inference Protocol") == [
        f"| `{output.name}` | {output.datatype} | {output.shape} |" for output in OUTPUTS
    ]
    arrays = names("Arrays instead of JSON")
    assert arrays == [output.name for output in OUTPUTS]


def test_the_problems_are_those_of_the_service(service_url: str) -> None:
    told = {(row.status, row.slug, row.when) for kind, row in PROBLEMS.items() if kind is not ClientGone}
    told.add((INTERNAL.status, INTERNAL.slug, INTERNAL.when))
    for when, problem in (
        ("No such path", httpx.get(f"{service_url}/nothing").json()),
        ("The path takes another method", httpx.post(f"{service_url}/model").json()),
    ):
        told.add((problem["status"], problem["type"].rpartition(":")[2], when))
    table = r"^\| (\d{3}) \| `urn:tes-net:problem:([\w-]+)` \| (.*) \|$"
    documented = re.findall(table, section("Errors"), re.MULTILINE)
    assert sorted((int(status), slug, when) for status, slug, when in documented) == sorted(told)


def test_the_headers_of_the_schema_are_in_the_table() -> None:
    documented = set(names("Headers"))
    declared = {parameter["name"] for parameter in POST["parameters"] if parameter["in"] == "header"}
    for response in POST["responses"].values():
        declared |= set(response.get("headers", {}))
    others = {
        "Accept",
        "Authorization",
        "Content-Type",
        "Inference-Header-Content-Length",
        "WWW-Authenticate",
        "X-API-Key",
    }
    assert documented == declared | others


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Where the page's commands run: with the examples, and with the two images that it names."""
    view = box_on_table()
    Image.fromarray(view.counts).save(tmp_path / "depth.png")
    Image.fromarray(255 * view.mask.astype(np.uint8)).save(tmp_path / "mask.png")
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    return tmp_path


def assert_is_part(shown: Any, real: Any, where: str = "$") -> None:
    """Every field that is shown is in the real answer: words and whole numbers agree, lists by their first elements.

    Whole numbers may differ a little and others at will, because they hang on how a processor rounds; so may ids.
    """
    if isinstance(shown, dict):
        assert set(shown) <= set(real), where
        for name in set(shown) - {"request_id"}:
            assert_is_part(shown[name], real[name], f"{where}.{name}")
    elif isinstance(shown, list) and shown:
        assert_is_part(shown[0], real[0], f"{where}[0]")
    elif isinstance(shown, (str, int)):
        assert real == (shown if isinstance(shown, str) else pytest.approx(shown, rel=0.02, abs=2)), where
    else:
        assert type(shown) is type(real), where


@pytest.mark.needs("curl")
@pytest.mark.parametrize(("command", "shown"), re.findall(r"```sh\n(.*?)```\n+(?:```json\n(.*?)```)?", PAGE, re.DOTALL))
def test_the_commands_answer_what_is_shown(command: str, shown: str, service_url: str, folder: Path) -> None:
    ended = subprocess.run(
        ["bash", "-ec", command.replace(SHOWN_URL, service_url)],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    if shown:
        assert_is_part(json.loads(shown), json.loads(ended.stdout))
    else:
        assert '"status":4' not in ended.stdout
    for file in folder.glob("*.npz"):
        assert set(np.load(file).files) == set(names("Arrays instead of JSON"))
