"""The manifests, against Kubernetes' own schemas and against the service that they start."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import kubernetes_validate
import pytest
import yaml

from service.settings import Settings, load_settings

DEPLOY = Path(__file__).resolve().parents[3] / "service" / "deploy"
KUBERNETES = DEPLOY / "kubernetes"
KSERVE = DEPLOY / "kserve" / "inference-service.yaml"
MANIFESTS = sorted(path.name for path in KUBERNETES.glob("*.yaml") if path.name != "kustomization.yaml")
VERSIONS = ("1.27", "1.37")
"""The oldest and the newest that the manifests are checked for."""
PREDICTOR_FIELDS = {"minReplicas", "maxReplicas"}
"""What KServe adds to a pod's fields in `spec.predictor`."""


def read(path: Path) -> dict[str, Any]:
    (document,) = yaml.safe_load_all(path.read_text(encoding="utf-8"))
    assert isinstance(document, dict)
    return document


def pods() -> dict[str, dict[str, Any]]:
    predictor = read(KSERVE)["spec"]["predictor"]
    return {
        "deployment": read(KUBERNETES / "deployment.yaml")["spec"]["template"]["spec"],
        "kserve": {name: value for name, value in predictor.items() if name not in PREDICTOR_FIELDS},
    }


@pytest.fixture(params=["deployment", "kserve"])
def pod(request: pytest.FixtureRequest) -> dict[str, Any]:
    """The pod of a manifest."""
    return pods()[request.param]


@pytest.fixture
def container(pod: dict[str, Any]) -> dict[str, Any]:
    """The pod's one container."""
    (only,) = pod["containers"]
    assert isinstance(only, dict)
    return only


def environment(container: dict[str, Any]) -> dict[str, str]:
    return {entry["name"]: entry["value"] for entry in container["env"]}


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("name", MANIFESTS)
def test_a_manifest_fits_kubernetes_schema_strictly(name: str, version: str) -> None:
    assert kubernetes_validate.validate(read(KUBERNETES / name), version, strict=True) == version


@pytest.mark.parametrize("version", VERSIONS)
def test_the_predictor_of_kserve_is_a_pod_that_fits_kubernetes_schema(version: str) -> None:
    document = {"apiVersion": "v1", "kind": "Pod", "metadata": {"name": "predictor"}, "spec": pods()["kserve"]}
    assert kubernetes_validate.validate(document, version, strict=True) == version


def test_a_misspelt_field_would_be_found() -> None:
    document = read(KUBERNETES / "deployment.yaml")
    document["spec"]["template"]["spec"]["terminationGracePeriod"] = 45
    with pytest.raises(kubernetes_validate.ValidationError, match="terminationGracePeriod"):
        kubernetes_validate.validate(document, VERSIONS[-1], strict=True)


def test_kustomize_applies_every_manifest() -> None:
    assert sorted(read(KUBERNETES / "kustomization.yaml")["resources"]) == MANIFESTS


def test_all_of_them_mean_the_same_pods() -> None:
    deployment, service, scaler, budget = (
        read(KUBERNETES / f"{name}.yaml") for name in ("deployment", "service", "autoscaler", "disruption-budget")
    )
    labels = deployment["spec"]["template"]["metadata"]["labels"]
    for selector in (deployment["spec"]["selector"]["matchLabels"], service["spec"]["selector"]):
        assert selector.items() <= labels.items()
    assert budget["spec"]["selector"]["matchLabels"].items() <= labels.items()
    assert scaler["spec"]["scaleTargetRef"]["name"] == deployment["metadata"]["name"]
    ports = {port["name"] for port in deployment["spec"]["template"]["spec"]["containers"][0]["ports"]}
    assert service["spec"]["ports"][0]["targetPort"] in ports


def test_the_services_name_sets_none_of_its_settings() -> None:
    name = read(KUBERNETES / "service.yaml")["metadata"]["name"]
    assert f"{name.upper().replace('-', '_')}_PORT" != "GRASP_PORT"


def test_every_setting_is_known_and_the_port_is_the_containers(container: dict[str, Any]) -> None:
    variables = environment(container)
    assert {name.removeprefix("GRASP_").lower() for name in variables} <= set(Settings.model_fields)
    settings = load_settings(variables)
    assert settings.host == "0.0.0.0"
    assert [settings.port] == [port["containerPort"] for port in container["ports"]]
    assert settings.num_threads == int(container["resources"]["requests"]["cpu"])


def test_the_pod_outlives_the_drain(pod: dict[str, Any], container: dict[str, Any]) -> None:
    drain = load_settings(environment(container)).drain_timeout
    command, seconds = container["lifecycle"]["preStop"]["exec"]["command"]
    assert command == "sleep"
    assert pod["terminationGracePeriodSeconds"] >= int(seconds) + drain + 5


def test_the_container_has_no_rights_and_writes_nothing(pod: dict[str, Any], container: dict[str, Any]) -> None:
    assert pod["securityContext"]["runAsNonRoot"] is True
    dockerfile = (DEPLOY.parents[1] / "Dockerfile").read_text(encoding="utf-8")
    assert f"USER {pod['securityContext']['runAsUser']}\n" in dockerfile
    assert container["securityContext"] == {
        "allowPrivilegeEscalation": False,
        "readOnlyRootFilesystem": True,
        "capabilities": {"drop": ["ALL"]},
    }
    assert pod["automountServiceAccountToken"] is False


def probes(container: dict[str, Any]) -> Iterator[tuple[str, str]]:
    for name in ("startupProbe", "readinessProbe", "livenessProbe"):
        yield name, container[name]["httpGet"]["path"]


def test_probes_ask_routes_that_answer(service_url: str) -> None:
    (container,) = pods()["deployment"]["containers"]
    for name, path in probes(container):
        assert path == ("/health/live" if name == "livenessProbe" else "/health/ready")
        assert httpx.get(service_url + path).status_code == 200


def test_the_autoscaler_asks_for_a_metric_that_the_service_exports(service_url: str) -> None:
    (metric,) = read(KUBERNETES / "autoscaler.yaml")["spec"]["metrics"]
    name = metric["pods"]["metric"]["name"]
    assert re.search(rf"^{name} \d", httpx.get(f"{service_url}/metrics").text, re.MULTILINE)
