"""Where hands stand by what is learned: on both sides of a thing there is room for a finger."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from tesnet import centring, weights
from tesnet.candidates import CandidateConfig, at_rest, contact_places, generate
from tesnet.cloud import PreparedCloud
from tesnet.errors import WeightsError
from tesnet.geometry import PANDA, Gripper
from tesnet.hands import HANDS
from tesnet.predictor import GraspPredictor
from tesnet.query import GraspQuery
from tesnet.search import search
from tests.tesnet.scenes import UP, Array, ask, prepared, tabletop_query

CPU = torch.device("cpu")


def can(radius: float, seed: int = 0) -> PreparedCloud:
    """An upright cylinder, 0.1 m high, that a camera sees from +y and from above: its lid and the side before it."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(np.radians(10), np.radians(170), 6000)
    side = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), rng.uniform(0.006, 0.1, 6000)])
    spot = rng.uniform(-radius, radius, (6000, 2))
    spot = spot[np.hypot(*spot.T) < radius]
    points = np.concatenate([side, np.column_stack([spot, np.full(len(spot), 0.1)])])
    points += rng.normal(0, 0.0008, points.shape)
    return prepared(ask(points, viewpoints=[[0.0, 0.5, 0.6]], up=UP, support_height=0.0))


def beside_walls(cloud: PreparedCloud, radius: float, config: CandidateConfig, hand: Gripper = PANDA) -> Array:
    """(C,) metres between the nearer finger and the can, of hands that come from above; below 0 it hits."""
    query = ask(np.zeros((1, 3)), up=UP, support_height=0.0, gripper=hand, num_approach_points=256)
    searched = search(cloud, query, config)
    found = searched.candidates.select(searched.is_free)
    Ts = cloud.T_cloud_canonical.matrix @ found.Ts_canonical_grasp.double().numpy()
    across = np.abs(np.einsum("ni,ni->n", Ts[:, :2, 3], np.stack([-Ts[:, 1, 1], Ts[:, 0, 1]], axis=1)))
    over = (Ts[:, 2, 2] < -0.99) & (across < 0.01)
    off = np.abs(np.einsum("ni,ni->n", Ts[over, :2, 3], Ts[over, :2, 1]))
    room: Array = hand.max_width / 2 - radius - off
    return room


@pytest.mark.parametrize("radius", [0.02, 0.03, 0.036])
def test_fingers_pass_on_both_sides_of_a_can_whose_far_side_is_not_seen(radius: float) -> None:
    rooms = [
        np.concatenate([beside_walls(can(radius, seed), radius, CandidateConfig(centring=way)) for seed in range(3)])
        for way in (None, "1")
    ]
    by_rules, learned = (float(np.mean(room > 0)) for room in rooms)
    assert len(rooms[1]) > 30
    assert learned > 0.9
    assert learned >= by_rules


def bar(hand: Gripper, share: float, *, walls: bool) -> GraspQuery:
    """A bar along x, 6 cm high: its top and both its long sides, or its top alone, from straight above.

    It fills a share of the opening.
    """
    rng, width = np.random.default_rng(0), share * hand.max_width
    points = [
        np.column_stack([rng.uniform(-0.06, 0.06, 9000), rng.uniform(-width / 2, width / 2, 9000), np.full(9000, 0.06)])
    ]
    viewpoints = [[0.0, 0.0, 0.6]]
    if walls:
        viewpoints = [[0.0, 0.5, 0.5], [0.0, -0.5, 0.5]]
        for side in (-width / 2, width / 2):
            rise = rng.uniform(0.006, 0.06, 9000)
            points.append(np.column_stack([rng.uniform(-0.06, 0.06, 9000), np.full(9000, side), rise]))
    posted = np.concatenate(points)
    return ask(posted, viewpoints=viewpoints, up=UP, support_height=0.0, gripper=hand, num_approach_points=128)


@pytest.mark.parametrize("walls", [True, False])
@pytest.mark.parametrize("name", ["franka", "rg2", "robotiq_2f140"])
def test_what_fills_the_hand_stands_midway_where_both_its_ends_were_seen(name: str, walls: bool) -> None:
    """With 1 to 2 mm left beside each finger."""
    hand = HANDS[name].gripper
    query = bar(hand, 0.97, walls=walls)
    cloud = prepared(query)
    searched = search(cloud, query, CandidateConfig())
    found = searched.candidates.select(searched.is_free)
    Ts = cloud.T_cloud_canonical.matrix @ found.Ts_canonical_grasp.double().numpy()
    across = (np.abs(Ts[:, 1, 1]) > 0.99) & (Ts[:, 2, 2] < -0.99)
    assert across.sum() > 20
    assert (np.abs(Ts[across, 1, 3]) < 0.015 * hand.max_width).mean() > 0.9


@pytest.mark.parametrize("name", ["franka", "rg2", "wsg50"])
def test_what_is_told_of_each_slice_is_what_each_pose_by_itself_has_there(name: str) -> None:
    hand = HANDS[name].gripper
    query = tabletop_query(max_candidates=40, gripper=hand)
    cloud = prepared(query)
    found = at_rest(cloud, generate(cloud, query, CandidateConfig())[0])
    seen = centring.seen_between(cloud, found).numpy()
    assert seen.shape == (len(found), centring.SEEN)
    near = contact_places(cloud, found).numpy()
    points, normals = cloud.points.double().numpy(), cloud.normals.double().numpy()
    compared = 0
    for row, T in enumerate(found.Ts_canonical_grasp.double().numpy()):
        local = (points - T[:3, 3]) @ T[:3, :3]
        slices = (near[row] - local[:, 1]) / (hand.max_width / 40) + 6
        margin = np.min(
            [
                hand.finger_breadth / 2 + 0.003 - np.abs(local[:, 0]),
                hand.tip_offset - local[:, 2],
                local[:, 2] - hand.palm_front,
            ],
            axis=0,
        )
        told = seen[row, : 6 * centring.BINS].reshape(centring.BINS, 6)
        for number in range(centring.BINS):
            here = (np.floor(slices) == number) & (margin > 0)
            doubtful = (np.abs(margin) < 1e-5) | (np.abs(slices - slices.round()) < 1e-3)
            if (doubtful & (slices > number - 1) & (slices < number + 2)).any():
                continue
            assert told[number, 0] == pytest.approx(min(here.sum(), 10) / 10)
            if here.any():
                compared += 1
                behind = (hand.tip_offset - local[here, 2]) / 0.05
                expected = [
                    (normals[here] @ T[:3, 1]).mean(), (normals[here] @ T[:3, 2]).mean(), behind.mean(),
                    np.abs(local[here, 0]).mean() / 0.02, 1 / (1 + behind.min()),
                ]  # fmt: skip
                np.testing.assert_allclose(told[number, 1:], expected, atol=2e-4)
            else:
                assert (told[number] == 0).all()
    assert compared > 100


def test_what_is_told_of_the_hand_is_its_sizes_and_where_it_stands() -> None:
    query = tabletop_query(1, max_candidates=20)
    cloud = prepared(query)
    found = generate(cloud, query, CandidateConfig())[0]
    told = centring.seen_between(cloud, found)[:, -centring.BY_HAND :]
    assert cloud.up is not None
    assert cloud.support_height is not None
    poses = found.Ts_canonical_grasp
    torch.testing.assert_close(told[:, 0], contact_places(cloud, found) / PANDA.max_width)
    torch.testing.assert_close(told[:, 1], -(poses[:, :3, 2] @ cloud.up))
    height = (poses[:, :3, 3] @ cloud.up - cloud.support_height) / 0.1
    torch.testing.assert_close(told[:, 2], height.clamp(-1, 4))
    assert (told[:, 3] == 1).all()
    torch.testing.assert_close(told[:, 4:7].norm(dim=1), torch.ones(len(found)))
    sizes = torch.tensor([PANDA.max_width, PANDA.finger_breadth, PANDA.tip_offset - PANDA.palm_front])
    torch.testing.assert_close(told[:, 7:], sizes.expand(len(found), 3))


def told_of(probable: list[float], middle: float) -> centring.Centring:
    """A network that says the same of everything: the log odds of all places but those named are -9."""
    network = centring.Centring(4).eval()
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.zero_()
        bias = network.get_parameter("layers.4.bias")
        bias[:-1] = -9.0
        bias[:-1][torch.isin(centring.PLACES, torch.tensor(probable))] = 9.0
        bias[-1] = middle / 10
    return network


@pytest.mark.parametrize(
    ("probable", "middle", "place"),
    [
        ([-20.5], -5.0, -20.5),
        ([-20.5, -19.5, -18.5], -19.5, -19.5),  # within what passes, the middle
        ([-38.5, -10.5], -12.0, -10.5),  # of what passes alike, what is nearest to the middle
    ],
)
def test_a_hand_stands_where_it_passes_and_in_the_middle_where_it_has_room(
    probable: list[float], middle: float, place: float
) -> None:
    found = told_of(probable, middle).place(torch.zeros(2, centring.SEEN))
    torch.testing.assert_close(found, torch.full((2,), place), atol=0.5, rtol=0)


def test_headers_from_before_it_was_there_go_by_rules() -> None:
    assert CandidateConfig().centring == "1"
    assert CandidateConfig.stored({"centred": True}).centring is None
    assert GraspPredictor.without_weights("heuristic").model.configuration["candidates"]["centring"] is None


def test_a_file_of_something_else_or_another_version_is_refused(tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match="holds network 'tesnet', not 'centring'"):
        centring.load(weights.default_weights())
    short = tmp_path / "short.safetensors"
    weights.save(short, {}, weights.Header(centring.NAME, "1", {"hidden": 4}))
    with pytest.raises(WeightsError, match="lacks"):
        centring.load(short)
    with pytest.raises(WeightsError, match="is version 1, and version 99 is wanted"):
        centring.shipped("99", CPU)
    network, version = centring.load(weights.default_weights(centring.NAME))
    assert version == "1"
    assert not network.training
    assert centring.shipped("1", CPU) is centring.shipped("1", CPU)
