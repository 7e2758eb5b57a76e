"""What the centring network learns from: walls that rays meet, and which places of a hand's middle they leave."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from simharness.sim.world import World
from tesnet import centring as learned
from tesnet.candidates import CandidateConfig, at_rest, generate
from tesnet.geometry import PANDA, Pose
from tests.tesnet.scenes import UP, ask, prepared
from training import centring
from training.archive import pack
from training.generate import GenerateConfig
from training.generate import generate as make_labels
from training.views import LabelsError


@pytest.mark.sim
def test_walls_are_those_of_the_thing_that_the_contact_point_is_on(tmp_path: Path) -> None:
    """A cube of 5 cm, seen from one side: its far wall too, in eightieths of the opening from the contact point."""
    mesh = tmp_path / "cube.urdf"
    size = '<geometry><box size="0.05 0.05 0.05"/></geometry>'
    mesh.write_text(
        f'<robot name="cube"><link name="cube"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" '
        f'ixz="0" iyz="0"/></inertial><visual>{size}</visual><collision>{size}</collision></link></robot>'
    )
    rng = np.random.default_rng(0)
    top = np.column_stack([rng.uniform(-0.025, 0.025, (4000, 2)), np.full(4000, 0.05)])
    front = np.column_stack([rng.uniform(-0.025, 0.025, 4000), np.full(4000, 0.025), rng.uniform(0.01, 0.05, 4000)])
    query = ask(np.concatenate([top, front]), viewpoints=[[0.0, 0.5, 0.5]], up=UP, support_height=0.0)
    cloud = prepared(query)
    found = at_rest(cloud, generate(cloud, query, CandidateConfig())[0])
    with World() as world:
        world.load_object(mesh, Pose(np.eye(3), np.array([0.0, 0.0, 0.025])), scale=1.0, mass=0.5, friction=1.0)
        walls = centring._walls(world, cloud, found)
    poses = cloud.T_cloud_canonical.matrix @ found.Ts_canonical_grasp.double().numpy()
    straight = (np.abs(poses[:, 1, 1]) > 0.999) & (poses[:, 2, 2] < -0.999)
    assert straight.sum() > 20
    near, far = walls[straight].T * PANDA.max_width / 80
    np.testing.assert_allclose(near, 0.0, atol=0.002)
    np.testing.assert_allclose(far, -0.05, atol=0.003)


@pytest.mark.sim
def test_samples_are_drawn_once_and_a_network_is_fitted_to_them(tmp_path: Path) -> None:
    config = GenerateConfig("packed", "procedural-train", seed=5, labels_per_view=8)
    make_labels(config, labels=30, workers=1, out=tmp_path / "labels")
    pack([tmp_path / "labels"], tmp_path / "archive")
    out = tmp_path / "centring.safetensors"
    asked = (tmp_path / "archive", "procedural-train", tmp_path / "samples", out)
    told = centring.learn_centring(*asked, epochs=1, version="7")
    files = sorted((tmp_path / "samples").iterdir())
    assert len(files) == told["scenes"] > 1
    with np.load(files[0]) as stored:
        assert stored["seen"].shape == (len(stored["walls"]), learned.SEEN)
        assert np.isfinite(stored["walls"]).all()
        assert (stored["walls"][:, 0] >= stored["walls"][:, 1]).all()
    before = [file.stat().st_mtime_ns for file in files]
    again = centring.learn_centring(*asked, epochs=1, version="7")
    assert again == told
    assert [file.stat().st_mtime_ns for file in files] == before
    network, version = learned.load(out)
    assert version == "7"
    assert told["samples"] + told["held_out"]["count"] == sum(len(np.load(file)["walls"]) for file in files)
    assert network.place(torch.zeros(1, learned.SEEN)).isfinite().all()


def write_samples(folder: Path, scenes: int = 40, each: int = 400) -> None:
    """Things of a width that the first number tells, whose near wall is at the contact point."""
    folder.mkdir()
    rng = np.random.default_rng(0)
    for number in range(scenes):
        width = rng.uniform(20, 90, each)
        seen = rng.normal(0, 0.01, (each, learned.SEEN))
        seen[:, 0] = width / 50
        walls = np.column_stack([np.zeros(each), -width])
        np.savez(folder / f"walls_{number:07d}.npz", seen=seen.astype(np.float16), walls=walls.astype(np.float32))


def test_the_fit_finds_where_hands_pass(tmp_path: Path) -> None:
    write_samples(tmp_path / "samples")
    told = centring.fit(tmp_path / "samples", tmp_path / "c.safetensors", epochs=12)
    assert told["held_out"]["count"] == 800
    assert told["held_out"]["passes"] > 0.97
    network, _ = learned.load(tmp_path / "c.safetensors")
    seen = torch.zeros(3, learned.SEEN)
    seen[:, 0] = torch.tensor([40.0, 70.0, 88.0]) / 50
    torch.testing.assert_close(network.place(seen)[:2], torch.tensor([-20.0, -35.0]), atol=10.0, rtol=0)
    passes, _ = network(seen)
    assert float(passes[0].max()) > 1
    assert float(passes[2].max()) < min(0.0, float(passes[1].max()))  # what is wider than the hand passes nowhere


@pytest.mark.parametrize(
    ("near", "far", "first", "last"), [(0.0, -70.0, -39.5, -30.5), (5.0, -60.0, -34.5, -20.5), (0.0, -81.0, None, None)]
)
def test_a_hand_passes_where_both_fingers_are_beside_the_walls(
    near: float, far: float, first: float | None, last: float | None
) -> None:
    passes = centring._passes(torch.tensor([[near, far]]), learned.PLACES, centring.CLEARANCE)[0]
    found = learned.PLACES[passes].tolist()
    assert (found[0], found[-1]) == (first, last) if found else first is None


def test_without_samples_there_is_nothing_to_fit(tmp_path: Path) -> None:
    with pytest.raises(LabelsError, match="holds no walls"):
        centring.fit(tmp_path, tmp_path / "c.safetensors")
