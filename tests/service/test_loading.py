"""What a process loads, and when."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from service.loading import predictor_factory
from service.settings import Settings, load_settings
from tesnet import networks, weights
from tesnet.errors import WeightsError
from tesnet.predictor import configuration_of
from tests.conftest import PATIENCE_S


def test_the_network_and_torch_are_loaded_when_the_factory_is_called_and_not_before() -> None:
    script = (
        "import sys; from service.settings import Settings; from service.loading import predictor_factory; "
        "make = predictor_factory(Settings(device='cpu', num_threads=1)); assert 'torch' not in sys.modules; "
        "print(make().models[0].name)"
    )
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=PATIENCE_S, check=True)
    assert ran.stdout.strip() == "tesnet"


def test_the_weights_are_those_that_the_settings_name(tmp_path: Path) -> None:
    missing = tmp_path / "none.safetensors"
    make = predictor_factory(Settings(device="cpu", weights={"tesnet": missing}))
    with pytest.raises(WeightsError, match=r"none\.safetensors"):
        make()


def test_weights_of_another_network_are_refused(tmp_path: Path) -> None:
    network = networks.build("edgegrasp")
    path = tmp_path / "mine.safetensors"
    weights.save(path, network.state_dict(), weights.Header("edgegrasp", "3", configuration_of(network)))
    with pytest.raises(WeightsError, match="holds edgegrasp, not tesnet; name it so in GRASP_MODELS"):
        predictor_factory(load_settings({"GRASP_WEIGHTS": str(path), "GRASP_DEVICE": "cpu"}))()
    settings = load_settings(
        {"GRASP_MODELS": "heuristic,edgegrasp", "GRASP_WEIGHTS": f"edgegrasp={path}", "GRASP_DEVICE": "cpu"}
    )
    made = predictor_factory(settings)()
    assert [(model.name, model.version) for model in made.models] == [("heuristic", "1"), ("edgegrasp", "3")]


def test_a_file_of_a_network_without_parameters_decides_its_candidates(tmp_path: Path) -> None:
    configuration = configuration_of(networks.build("heuristic"))
    configuration["candidates"] |= {"centred": False, "max_depth": 0.021}
    path = tmp_path / "other.safetensors"
    weights.save(path, {}, weights.Header("heuristic", "7", configuration))
    settings = load_settings({"GRASP_MODELS": "heuristic", "GRASP_WEIGHTS": f"heuristic={path}", "GRASP_DEVICE": "cpu"})
    (made,) = predictor_factory(settings)().models
    assert (made.version, made.weights_sha256) == ("7", weights.sha256(path))
    assert made.configuration["candidates"]["max_depth"] == 0.021
