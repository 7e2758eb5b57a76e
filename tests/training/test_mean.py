"""The mean of weights: parameter by parameter, with measures and a calibration of its own."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from tesnet import networks, weights
from tesnet.networks import Network
from tesnet.predictor import configuration_of
from tests.training.synthetic import labelled_view, write
from training.__main__ import main
from training.evaluate import validate
from training.mean import mean
from training.views import LabelsError, load_views


def saved(path: Path, name: str, seed: int, epoch: int) -> Network:
    torch.manual_seed(seed)
    network = networks.build(name)
    header = weights.Header(name, "1", configuration_of(network), (1.0, 0.0), {"epoch": epoch})
    weights.save(path, network.state_dict(), header)
    return network


def test_each_parameter_is_the_mean_and_the_measures_are_its_own(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [tmp_path / "a.safetensors", tmp_path / "b.safetensors", tmp_path / "c.safetensors"]
    states = [saved(path, "tesnet", seed, seed + 5).state_dict() for seed, path in enumerate(files)]
    folder, out = write(tmp_path / "labels", [labelled_view(seed) for seed in range(3)]), tmp_path / "mean.safetensors"
    asked = ["mean", "--weights", *map(str, files), "--validation", str(folder), "--out", str(out), "--version", "7"]
    assert main(asked) == 0
    network, header = networks.load(out)
    for name, found in network.state_dict().items():
        torch.testing.assert_close(found, sum(state[name] for state in states) / 3)
    of_free, of_all = validate(network, list(load_views([folder], network.preparation)), 0)
    assert (header.network, header.version) == ("tesnet", "7")
    assert header.configuration == json.loads(json.dumps(configuration_of(network)))
    assert header.calibration == pytest.approx(of_free["calibration"])
    told = json.loads(capsys.readouterr().out)
    assert told == header.training
    assert told["validation"]["served_loss"] == pytest.approx(of_free["served_loss"])
    assert told["validation_with_blocked"]["auroc"] == pytest.approx(of_all["auroc"])
    assert [one["training"] for one in told["mean_of"]] == [{"epoch": 5}, {"epoch": 6}, {"epoch": 7}]
    assert [one["sha256"] for one in told["mean_of"]] == [weights.sha256(path) for path in files]


def test_settings_of_the_network_are_those_that_are_asked_for(tmp_path: Path) -> None:
    file, out = tmp_path / "a.safetensors", tmp_path / "mean.safetensors"
    saved(file, "tesnet", 0, 1)
    folder = write(tmp_path / "labels", [labelled_view(seed) for seed in range(3)])
    told = [mean([file], [folder], out, settings=settings) for settings in ({}, {"caution": 5.0, "mirrored": 9})]
    network, header = networks.load(out)
    assert (network.config.caution, network.config.mirrored) == (5.0, 9)
    plain = json.loads(json.dumps(configuration_of(networks.load(file)[0])["network"]))
    assert header.configuration["network"] == plain | {"caution": 5.0, "mirrored": 9}
    assert told[0]["validation"]["served_loss"] != told[1]["validation"]["served_loss"]


def test_weights_of_different_networks_have_no_mean(tmp_path: Path) -> None:
    saved(tmp_path / "a.safetensors", "tesnet", 0, 1)
    saved(tmp_path / "b.safetensors", "gpd", 0, 1)
    with pytest.raises(LabelsError, match=r"b\.safetensors holds another network than .*a\.safetensors"):
        mean([tmp_path / "a.safetensors", tmp_path / "b.safetensors"], [], tmp_path / "out.safetensors")
    assert not (tmp_path / "out.safetensors").exists()


def test_a_file_from_before_a_field_of_the_configuration_is_of_the_same_network(tmp_path: Path) -> None:
    older, newer, out = tmp_path / "a.safetensors", tmp_path / "b.safetensors", tmp_path / "mean.safetensors"
    state = saved(older, "tesnet", 0, 1).state_dict()
    saved(newer, "tesnet", 1, 2)
    configuration = configuration_of(networks.build("tesnet"))
    del configuration["network"]["second_look"]
    weights.save(older, state, weights.Header("tesnet", "1", configuration, (1.0, 0.0), {"epoch": 1}))
    folder = write(tmp_path / "labels", [labelled_view(seed) for seed in range(3)])
    told = mean([older, newer], [folder], out)
    assert [one["training"] for one in told["mean_of"]] == [{"epoch": 1}, {"epoch": 2}]
