"""What holds for every network of the registry, and what a rigid motion of the scene changes in each of them."""

from __future__ import annotations

import functools
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tesnet import candidates, cloud, networks, weights
from tesnet.candidates import Candidates
from tesnet.geometry import Pose
from tesnet.predictor import GraspPredictor, configuration_of
from tests.tesnet.scenes import moved_cloud, prepared, tabletop_query

LEARNED = [name for name in networks.NETWORKS if name != "heuristic"]
INVARIANT = ["tesnet", "pointnetgpd", "gpd", "heuristic"]
"""By construction. The others change with a rotation unless training teaches them not to, but with no translation."""


@functools.cache
def built(name: str) -> networks.Network:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return networks.build(name).eval()


@functools.cache
def example(name: str, scene: int = 0) -> tuple[cloud.PreparedCloud, Candidates]:
    query = tabletop_query(scene, max_candidates=120)
    ready = prepared(query, **asdict(built(name).preparation))
    return ready, candidates.generate(ready, query, candidates.CandidateConfig())[0]


@torch.inference_mode()
def score(name: str, ready: cloud.PreparedCloud, found: Candidates, mirror: torch.Tensor | None = None) -> torch.Tensor:
    network = built(name)
    return network.score(networks.encode(network, ready), ready, found, mirror)


def moved(ready: cloud.PreparedCloud, found: Candidates, motion: Pose) -> tuple[cloud.PreparedCloud, Candidates]:
    """The scene and the same candidates of it, moved."""
    poses = torch.tensor(motion.matrix @ found.Ts_canonical_grasp.double().numpy()).float()
    return moved_cloud(ready, motion), replace(found, Ts_canonical_grasp=poses)


@pytest.fixture(params=networks.NETWORKS)
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def test_there_is_a_finite_logit_for_every_candidate(name: str) -> None:
    ready, found = example(name)
    logits = score(name, ready, found)
    assert logits.shape == (len(found),)
    assert torch.isfinite(logits).all()
    assert len(logits.unique()) > len(found) // 2


def test_no_candidates_have_no_scores(name: str) -> None:
    ready, found = example(name)
    assert score(name, ready, found.select(torch.zeros(0, dtype=torch.long))).shape == (0,)


def test_a_candidate_scores_the_same_whichever_others_are_asked_about(name: str) -> None:
    ready, found = example(name)
    order = torch.randperm(len(found), generator=torch.Generator().manual_seed(0))[:25]
    torch.testing.assert_close(
        score(name, ready, found.select(order)), score(name, ready, found)[order], atol=1e-4, rtol=0
    )


def test_clouds_encoded_together_score_as_each_by_itself(name: str) -> None:
    network = built(name)
    examples = [example(name, scene) for scene in range(3)]
    with torch.inference_mode():
        encoded = network.encode_batch([ready for ready, _ in examples])
        together = [network.score(one, *scene) for one, scene in zip(encoded, examples, strict=True)]
    for logits, scene in zip(together, examples, strict=True):
        torch.testing.assert_close(logits, score(name, *scene), atol=1e-4, rtol=0)


@pytest.mark.parametrize("name", INVARIANT)
def test_scores_do_not_change_with_a_rigid_motion_where_that_is_built_in(name: str) -> None:
    ready, found = example(name)
    change = (
        score(name, *moved(ready, found, Pose.random(np.random.default_rng(1), reach=0.5))) - score(name, ready, found)
    ).abs()
    # Rounding lets a point enter or leave the region of a few candidates, or another pixel of an image.
    assert (change > 1e-3).float().mean() < 0.25
    turned = moved_cloud(ready, Pose.from_quaternion([0.5, 0.5, 0.5, 0.5], np.zeros(3)))
    assert (score(name, turned, found) - score(name, ready, found)).abs().mean() > 1e-3  # the scene without the hands


@pytest.mark.parametrize("name", sorted(set(networks.NETWORKS) - set(INVARIANT)))
def test_scores_of_the_others_change_with_a_rotation_and_not_with_a_translation(name: str) -> None:
    ready, found = example(name)
    before = score(name, ready, found)
    along = Pose(np.eye(3), np.array([0.3, -0.2, 0.1]))
    change = (score(name, *moved(ready, found, along)) - before).abs()
    assert (change > 1e-3).float().mean() < 0.1
    turned = Pose.from_quaternion([0.5, 0.5, 0.5, 0.5], np.zeros(3))
    assert (score(name, *moved(ready, found, turned)) - before).abs().mean() > 1e-3


@pytest.mark.parametrize("name", ["pointnetgpd", "gpd"])
def test_the_mirror_option_shows_the_scene_reflected_in_the_hands_plane(name: str) -> None:
    """Reflecting the scene in each hand's own plane changes the sign of x in its grasp frame, and nothing else."""
    ready, found = example(name)
    for row in range(0, len(found), 40):
        one = found.select(torch.tensor([row]))
        pose = one.Ts_canonical_grasp[0].double()
        across = pose[:3, 0]
        flip = torch.eye(3, dtype=torch.float64) - 2 * across[:, None] * across
        centre = pose[:3, 3]

        def reflect(points: torch.Tensor) -> torch.Tensor:
            return ((points.double() - centre) @ flip + centre).float()  # noqa: B023  used at once

        reflected = replace(
            ready,
            points=reflect(ready.points),
            normals=(ready.normals.double() @ flip).float(),
            view_directions=(ready.view_directions.double() @ flip).float(),
            viewpoints=reflect(ready.viewpoints),
        )
        asked = score(name, ready, one, -torch.ones(1))
        torch.testing.assert_close(asked, score(name, reflected, one), atol=0.02, rtol=0)
        torch.testing.assert_close(score(name, ready, one, torch.ones(1)), score(name, ready, one))


@pytest.mark.parametrize("name", LEARNED)
def test_every_parameter_is_used(name: str) -> None:
    network = networks.build(name)
    ready, found = example(name)
    network.score(networks.encode(network, ready), ready, found).square().sum().backward()
    assert [key for key, parameter in network.named_parameters() if parameter.grad is None] == []  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", LEARNED)
def test_weights_travel_with_the_preparation_that_their_network_wants(name: str, tmp_path: Path) -> None:
    network = built(name)
    path = tmp_path / f"{name}.safetensors"
    weights.save(path, network.state_dict(), weights.Header(name, "1", configuration_of(network)))
    again, header = networks.load(path)
    assert type(again) is type(network)
    assert again.config == network.config
    assert header.configuration["preparation"] == asdict(network.preparation)
    assert len(GraspPredictor.load(path).predict(tabletop_query()).grasps) > 0
