from __future__ import annotations

import dataclasses
import functools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from tesnet import candidates, cloud, visibility
from tesnet.candidates import Candidates, at_rest
from tesnet.geometry import Pose
from tesnet.hands import HANDS
from tesnet.networks import encode
from tesnet.networks.around_hand import PROBES_IN_FINGERS, probes
from tesnet.networks.low_things import unevenness
from tesnet.networks.rims import poor_pinch
from tesnet.networks.second_look import seen_by_fingers
from tesnet.networks.tesnet import (
    CloudFeatures,
    TesNet,
    TesNetConfig,
    _candidate_inputs,
    _depth_behind_probes,
    _probe_inputs,
    edge_features,
    point_inputs,
)
from tesnet.networks.told import TOLD_INPUTS
from tesnet.points import points_in_grasp_frames
from tests.tesnet.scenes import (
    CAMERA,
    UP,
    ask,
    box_surface,
    fresh_network,
    moved_cloud,
    prepared,
    seen_from,
    tabletop,
    tabletop_query,
    told_network,
)


@functools.cache
def example() -> tuple[cloud.PreparedCloud, Candidates]:
    query = tabletop_query(max_candidates=150)
    ready = prepared(query)
    return ready, candidates.generate(ready, query, candidates.CandidateConfig())[0]


@functools.cache
def features() -> CloudFeatures:
    with torch.inference_mode():
        return fresh_network().encode_batch([example()[0]])[0]


@torch.inference_mode()
def score(found: Candidates, mirror: torch.Tensor | None = None) -> torch.Tensor:
    return fresh_network().score(features(), example()[0], found, mirror)


def test_there_is_a_feature_for_every_point_and_a_logit_for_every_candidate() -> None:
    ready, found = example()
    assert features().points.shape == (len(ready), 64)
    assert features().context.shape == (32,)
    logits = score(found)
    assert logits.shape == (len(found),)
    assert torch.isfinite(logits).all()
    assert len(logits.unique()) > len(found) // 2


def test_a_batch_of_candidates_is_scored_as_one_by_one() -> None:
    _, found = example()
    few = found.select(torch.arange(0, len(found), 10))
    alone = torch.cat([score(few.select(torch.tensor([i]))) for i in range(len(few))])
    torch.testing.assert_close(score(few), alone, atol=1e-5, rtol=0)


def test_no_candidates_have_no_scores() -> None:
    assert score(example()[1].select(torch.zeros(0, dtype=torch.long))).shape == (0,)


def test_scores_follow_their_candidates_in_another_order() -> None:
    _, found = example()
    order = torch.randperm(len(found), generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(score(found.select(order)), score(found)[order], atol=1e-5, rtol=0)


def test_a_region_holds_the_points_that_a_loop_finds_there() -> None:
    ready, found = example()
    network = fresh_network()
    for region, points in ((network.closing, ready.points), (network.around, features().patches.points)):
        members = region.members(points, found)
        index, totals = members.index, members.total
        assert index.shape == (len(found), region.count)
        breadth, length, behind, ahead = region.region
        for row in range(0, len(found), 12):
            T = found.Ts_canonical_grasp[row].double().numpy()
            local = (points.double().numpy() - T[:3, 3]) @ T[:3, :3]
            slack = np.min(
                [breadth - abs(local[:, 0]), length - abs(local[:, 1]), local[:, 2] + behind, ahead - local[:, 2]],
                axis=0,
            )
            certain, possible = (set(np.flatnonzero(slack > limit).tolist()) for limit in (1e-6, -1e-6))
            count = min(region.count, int(totals[row]))
            chosen = index[row, :count].tolist()
            assert len(certain) <= int(totals[row]) <= len(possible)
            assert len(chosen) == len(set(chosen)) == count
            assert set(chosen) <= possible
            assert set(index[row, count:].tolist()) <= {chosen[0]}


def test_a_region_pools_what_its_layers_make_of_points_in_the_grasp_frame() -> None:
    """The layers as written, in a loop: position, normal and facing in the grasp frame, mirrored where asked for."""
    ready, found = example()
    region, encoded = fresh_network().closing, features().points
    sign = torch.where(torch.arange(len(found)) % 2 == 0, 1.0, -1.0)
    with torch.inference_mode():
        members = region.members(ready.points, found)
        index, totals = members.index, members.total
        shift = torch.linspace(-1, 1, len(found))[:, None].expand(-1, region.features.out_features)
        pooled = region(encoded, ready, members, found.Ts_canonical_grasp, sign, shift)
        for row in range(0, len(found), 15):
            chosen = index[row, : min(region.count, int(totals[row]))]
            T = found.Ts_canonical_grasp[row]
            mirror = torch.tensor([float(sign[row]), 1.0, 1.0])
            position = (ready.points[chosen] - T[:3, 3]) @ T[:3, :3] * mirror / 0.02
            normal = ready.normals[chosen] @ T[:3, :3] * mirror
            facing = (ready.normals * ready.view_directions).sum(dim=1, keepdim=True)[chosen]
            hidden = region.geometry(torch.cat([position, normal, facing], 1)) + region.features(encoded[chosen])
            hidden = hidden + shift[row]
            expected = torch.relu(region.update(torch.relu(hidden))).amax(dim=0)
            torch.testing.assert_close(pooled[row], expected, atol=1e-4, rtol=1e-4)


def test_an_empty_region_pools_to_nothing() -> None:
    ready, found = example()
    away = found.Ts_canonical_grasp.clone()
    away[:, :3, 3] += 10
    with torch.inference_mode():
        closing = fresh_network().closing
        members = closing.members(ready.points, replace(found, Ts_canonical_grasp=away))
        pooled = closing(features().points, ready, members, away, torch.ones(len(found)))
    assert not members.total.any()
    assert not pooled.any()


def reflected(ready: cloud.PreparedCloud, centre: torch.Tensor, across: torch.Tensor) -> cloud.PreparedCloud:
    """A cloud without sides, reflected in the plane through `centre` (3,) perpendicular to `across` (3,)."""
    assert ready.up is not None
    assert ready.support_height is not None
    up = reflect(ready.up, across)
    return replace(
        ready,
        points=reflect(ready.points - centre, across) + centre,
        normals=reflect(ready.normals, across),
        view_directions=reflect(ready.view_directions, across),
        viewpoints=reflect(ready.viewpoints - centre, across) + centre,
        up=up,
        support_height=ready.support_height + float(centre @ (up - ready.up)),
    )


def reflect(directions: torch.Tensor, across: torch.Tensor) -> torch.Tensor:
    """Directions (..., 3) with their part along the unit vector `across` (3,) turned about."""
    return directions - 2 * (directions @ across)[..., None] * across


def test_the_mirror_option_changes_scores_and_one_leaves_them() -> None:
    _, found = example()
    one = torch.ones(len(found))
    torch.testing.assert_close(score(found, one), score(found))
    assert (score(found, -one) - score(found)).abs().median() > 1e-3


def test_a_mirrored_candidate_sees_what_it_would_see_of_the_reflected_scene() -> None:
    """The twin reflects cloud, normals, lines of sight, viewpoint, up and table in each hand's own plane."""
    ready, found = example()
    few = found.select(torch.arange(0, len(found), 5))
    totals, one = torch.zeros(len(few), 2), torch.ones(len(few))
    pairs, hidden = [], []
    for row in range(len(few)):
        single = few.select(torch.tensor([row]))
        pose = single.Ts_canonical_grasp
        twin = reflected(ready, pose[0, :3, 3], pose[0, :3, 0])
        pairs.append(_candidate_inputs(twin, single, totals[:1], one[:1]))
        hidden.append(_depth_behind_probes(twin, single, one[:1]).clamp(-0.04, 0.06))
    seen = [_candidate_inputs(ready, few, totals, sign * one) for sign in (-1, 1)]
    torch.testing.assert_close(seen[0], torch.cat(pairs), atol=1e-4, rtol=0)
    assert ((seen[0] - seen[1]).abs() > 1e-3).any(dim=1).all()
    # The pixels of what was seen lie otherwise in the reflected scene.
    mirrored, plain = (_depth_behind_probes(ready, few, sign * one).clamp(-0.04, 0.06) for sign in (-1, 1))
    assert (mirrored - torch.cat(hidden)).abs().mean() < 0.3 * (plain - torch.cat(hidden)).abs().mean()


def test_depths_behind_what_was_seen_are_told_coarsely_and_finely() -> None:
    behind = torch.tensor([[-torch.inf, -0.041, -0.001, 0.0, 0.004, 0.02, 0.061, torch.inf]])
    coarse, fine = _probe_inputs(behind).split(8, dim=1)
    torch.testing.assert_close(coarse, torch.tensor([[-2.0, -2.0, -0.05, 0.0, 0.2, 1.0, 3.0, 3.0]]))
    torch.testing.assert_close(fine, torch.tensor([[-1.0, -1.0, -0.2, 0.0, 0.8, 1.0, 1.0, 1.0]]))


@torch.inference_mode()
def test_caution_takes_log_odds_by_the_part_of_the_fingers_that_no_camera_saw_but_not_in_training() -> None:
    ready, found = example()
    careful = TesNet(replace(fresh_network().config, caution=8.0))
    careful.load_state_dict(fresh_network().state_dict())
    poses = at_rest(ready, found).Ts_canonical_grasp
    finger = probes(found.gripper).of(at_rest(ready, found))[:, :PROBES_IN_FINGERS]
    hand = found.gripper.parts
    for one in finger[0]:  # every one of them does stand in a finger, and none in the palm
        assert min(abs(one[0]), hand[0].breadth.full / 2) == abs(one[0])
        assert abs(one[1]) > found.gripper.max_width / 2
        assert hand[0].back <= one[2] <= hand[0].front
    places = finger @ poses[:, :3, :3].transpose(1, 2) + poses[:, None, :3, 3]
    share = visibility.hidden(ready, places).float().mean(dim=1)
    assert (share == 0).any()
    assert (share > 0.2).any()
    expected = score(found) - 8.0 * share
    torch.testing.assert_close(careful.eval().score(features(), ready, found), expected, atol=1e-5, rtol=0)
    torch.testing.assert_close(careful.train().score(features(), ready, found), score(found), atol=1e-5, rtol=0)


def assert_costs(
    plain: TesNet, config: TesNetConfig, lost: torch.Tensor, ready: cloud.PreparedCloud, found: Candidates
) -> None:
    """With a configuration candidates lose so many log odds (C,), mirrored or not, but not in training."""
    costly = TesNet(config)
    both, of_both = (TesNet(replace(net.config, mirrored=len(found))) for net in (plain, costly))
    for net in (costly, both, of_both):
        net.load_state_dict(plain.state_dict())
    seen = plain.encode_batch([ready])[0]
    assert (lost > 1).any()
    assert (lost == 0).any()
    without = plain.score(seen, ready, found)
    torch.testing.assert_close(costly.eval().score(seen, ready, found), without - lost, atol=1e-5, rtol=0)
    mirrored = both.eval().score(seen, ready, found)
    torch.testing.assert_close(of_both.eval().score(seen, ready, found), mirrored - lost, atol=1e-5, rtol=0)
    torch.testing.assert_close(costly.train().score(seen, ready, found), without, atol=1e-5, rtol=0)


@torch.inference_mode()
def test_uneven_low_things_cost_log_odds_in_both_mirrored_forms_but_not_in_training() -> None:
    rng, boxes = np.random.default_rng(0), []
    for height, side in ((0.012, -0.02), (0.02, 0.02)):
        points, normals = box_surface((0.06, 0.038, height), 20_000, rng)
        boxes.append(seen_from(points + np.array([0.0, side, height / 2]), normals, CAMERA))
    query = ask(np.concatenate(boxes), up=UP, support_height=0.0, max_candidates=200)
    ready = prepared(query)
    found = candidates.generate(ready, query, candidates.CandidateConfig())[0]
    plain = fresh_network()
    lost = 4.0 * unevenness(ready, found, plain.closing.members(ready.points, found).index)
    assert_costs(plain, replace(plain.config, evenness=4.0), lost, ready, found)


@torch.inference_mode()
def test_rims_cost_log_odds_in_both_mirrored_forms_but_not_in_training() -> None:
    rim = np.random.default_rng(0).uniform(0, 2 * np.pi, 40_000), np.random.default_rng(1).uniform(0, 1, 40_000)
    radius, height = 0.03 + 0.03 * rim[1], 0.06 * rim[1] ** 2  # the inside of a bowl
    outward = np.stack([np.cos(rim[0]), np.sin(rim[0])], axis=1)
    points = np.column_stack([radius[:, None] * outward, height])
    normals = np.column_stack([-0.7 * outward, np.full(len(points), 0.7)])
    outside = np.column_stack([(radius[:, None] + 0.008) * outward, height]), np.column_stack([outward, 0 * height])
    shell = np.concatenate([seen_from(points, normals, CAMERA), seen_from(*outside, CAMERA)])
    query = ask(shell, up=UP, support_height=-0.01, max_candidates=400, gripper=HANDS["rg2"].gripper)
    ready = prepared(query)
    found = candidates.generate(ready, query, candidates.CandidateConfig())[0]
    plain, rest = told_network(), candidates.at_rest(ready, found)
    lost = 4.0 * poor_pinch(ready, rest, plain.closing.members(ready.points, rest).index)
    assert_costs(plain, replace(plain.config, rims=4.0), lost, ready, found)


@pytest.mark.parametrize("network", [fresh_network, told_network])
def test_the_best_candidates_are_scored_in_both_mirrored_forms_but_not_in_training(network: Any) -> None:
    ready, found = example()
    both = TesNet(replace(network().config, mirrored=20))
    both.load_state_dict(network().state_dict())
    one = torch.ones(len(found))
    with torch.inference_mode():
        seen = network().encode_batch([ready])[0]
        plain, reflected = (network().score(seen, ready, found, sign * one) for sign in (1, -1))
        expected = plain.clone()
        best = plain.argsort(descending=True)[:20]
        expected[best] = (plain + reflected)[best] / 2
        torch.testing.assert_close(both.eval().score(seen, ready, found), expected, atol=1e-5, rtol=0)
        torch.testing.assert_close(both.eval().score(seen, ready, found, -one), reflected, atol=1e-5, rtol=0)
        few = found.select(best[:3])
        torch.testing.assert_close(both.score(seen, ready, few), expected[best[:3]], atol=1e-5, rtol=0)
        torch.testing.assert_close(both.train().score(seen, ready, found), plain, atol=1e-5, rtol=0)


def test_the_best_candidates_are_looked_at_again_but_not_in_training() -> None:
    ready, found = example()
    torch.manual_seed(0)
    twice = TesNet(replace(fresh_network().config, second_look=20))
    twice.load_state_dict(fresh_network().state_dict(), strict=False)
    torch.nn.init.normal_(twice.second_look.change.weight)
    with torch.inference_mode():
        expected, seen = score(found).clone(), features()
        best = expected.argsort(descending=True)[:20]
        expected[best] = twice.eval().second_look(
            seen_by_fingers(ready, at_rest(ready, found.select(best))), expected[best]
        )
        assert (expected[best] - score(found)[best]).abs().max() > 0.1
        torch.testing.assert_close(twice.score(seen, ready, found), expected, atol=1e-4, rtol=0)
        one = torch.ones(len(found))
        torch.testing.assert_close(twice.score(seen, ready, found, one), score(found), atol=1e-5, rtol=0)
        doubted = replace(ready, pose_in_doubt=True)
        torch.testing.assert_close(twice.score(seen, doubted, found), score(found), atol=1e-5, rtol=0)
        torch.testing.assert_close(twice.train().score(seen, ready, found), score(found), atol=1e-5, rtol=0)


@pytest.mark.parametrize(("name", "again"), [("robotiq_2f140", True), ("hand_e", True), ("rg2", False), ("rg6", False)])
def test_hands_whose_tips_swing_far_are_looked_at_once(name: str, again: bool) -> None:
    query = tabletop_query(max_candidates=60, gripper=HANDS[name].gripper)
    ready = prepared(query)
    found = candidates.generate(ready, query, candidates.CandidateConfig())[0]
    torch.manual_seed(0)
    twice = TesNet(replace(fresh_network().config, second_look=20)).eval()
    twice.load_state_dict(fresh_network().state_dict(), strict=False)
    torch.nn.init.normal_(twice.second_look.change.weight)
    with torch.inference_mode():
        once, now = (net.score(net.encode_batch([ready])[0], ready, found) for net in (fresh_network(), twice))
    assert ((once - now).abs().max() > 0.1) == again


def test_sides_of_the_workspace_count_where_the_hand_comes_near_them() -> None:
    ready, found = example()
    network = fresh_network()
    tcp = found.Ts_canonical_grasp[0, :3, 3]

    @torch.inference_mode()
    def with_side(distance: float) -> torch.Tensor:
        """Logits beside a plane across x, so far from the first candidate's TCP."""
        bounded = replace(ready, sides=torch.tensor([[1.0, 0.0, 0.0, float(tcp[0]) + distance]]))
        return network.score(features(), bounded, found)

    torch.testing.assert_close(with_side(1.0), score(found), atol=1e-5, rtol=0)
    assert (with_side(0.01) - score(found))[0].abs() > 1e-4


@torch.inference_mode()
def told_score(network: TesNet, found: Candidates, ready: cloud.PreparedCloud | None = None) -> torch.Tensor:
    ready = ready or example()[0]
    return network.score(features(), ready, found)


def opened_by_degrees(name: str) -> Candidates:
    """The example's candidates for a known hand, each open by another width."""
    _, found = example()
    hand = HANDS[name].gripper
    return replace(found, gripper=hand, widths=torch.linspace(0.4, 1.0, len(found)) * hand.max_width)


@pytest.mark.parametrize("name", ["franka", "rg2"])
def test_a_network_that_is_told_scores_at_first_as_one_that_is_not(name: str) -> None:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = TesNet(TesNetConfig(told=True)).eval()
    found = opened_by_degrees(name)
    assert torch.equal(told_score(network, found), told_score(fresh_network(), found))


def test_a_network_that_is_told_of_doubt_scores_otherwise_where_there_is_any() -> None:
    ready, found = example()
    network = told_network()
    doubting = TesNet(replace(network.config, doubt=True)).eval()
    state = network.state_dict()
    layer = state["told.layer.weight"]
    doubting.load_state_dict({**state, "told.layer.weight": torch.cat([layer, 0.1 * layer.abs()[:, :1] + 0.05], dim=1)})
    doubted = replace(ready, pose_in_doubt=True)
    assert torch.equal(told_score(doubting, found), told_score(network, found))
    assert torch.equal(told_score(network, found, doubted), told_score(network, found))
    change = (told_score(doubting, found, doubted) - told_score(doubting, found)).abs()
    assert float((change > 1e-4).float().mean()) > 0.5


@pytest.mark.parametrize("number", range(TOLD_INPUTS))
def test_each_number_that_is_told_moves_scores_once_it_has_a_weight(number: int) -> None:
    network = told_network()
    network.told.layer.weight.data[:, [other for other in range(TOLD_INPUTS) if other != number]] = 0
    found = opened_by_degrees("rg2")
    change = (told_score(network, found) - told_score(fresh_network(), found)).abs()
    assert float((change > 1e-6).float().mean()) > 0.5


def test_a_hand_and_its_opening_change_what_is_looked_at() -> None:
    _, found = example()
    narrower = replace(found, widths=found.widths * 0.5)
    other = replace(found, gripper=HANDS["robotiq_2f140"].gripper)
    assert (score(narrower) - score(found)).abs().median() > 1e-4
    assert (score(other) - score(found)).abs().median() > 1e-4


def test_a_region_of_a_narrower_opening_holds_what_lies_nearer_the_middle() -> None:
    ready, found = example()
    region = fresh_network().closing
    half = replace(found, widths=found.widths / 2)
    _, y, _ = points_in_grasp_frames(ready.points, found.Ts_canonical_grasp)
    members = region.members(ready.points, half)
    there = (members.total > 0).nonzero()[:, 0]
    assert len(there) > len(found) // 2
    assert float(y[there[:, None], members.index[there]].abs().max()) <= 0.025 + 1e-6
    assert (members.total <= region.members(ready.points, found).total).all()


def test_told_scores_do_not_change_with_a_rigid_motion_or_in_smaller_batches() -> None:
    ready, _ = example()
    network, found = told_network(), opened_by_degrees("rg2")
    motion = Pose.random(np.random.default_rng(4), reach=0.3)
    poses = torch.tensor(motion.matrix @ found.Ts_canonical_grasp.double().numpy()).float()
    before = told_score(network, found)
    moved = moved_cloud(ready, motion)
    with torch.inference_mode():
        after = network.score(encode(network, moved), moved, replace(found, Ts_canonical_grasp=poses))
    assert ((after - before).abs() > 1e-3).float().mean() < 0.1
    few = torch.arange(0, len(found), 7)
    torch.testing.assert_close(told_score(network, found.select(few)), before[few], atol=1e-4, rtol=0)


def test_point_pair_features_are_distances_and_cosines() -> None:
    ready, _ = example()
    edges = edge_features(ready.points, ready.normals, ready.neighbours)
    assert edges.shape == (len(ready), 16, 4)
    for point in range(0, len(ready), 300):
        other = int(ready.neighbours[point, 5])
        p, q, n, m = (x.double().numpy() for x in (*ready.points[[point, other]], *ready.normals[[point, other]]))
        distance = np.linalg.norm(q - p)
        expected = [distance / 0.02, n @ (q - p) / distance, m @ (q - p) / distance, n @ m]
        np.testing.assert_allclose(edges[point, 5], expected, atol=1e-5)
    assert (edges[:, :, 1:].abs() <= 1 + 1e-5).all()


@pytest.mark.parametrize(("options", "known"), [({}, 0), ({"up": [0, 0, 1]}, 1)])
def test_what_the_caller_does_not_know_is_zero(options: dict[str, Any], known: int) -> None:
    inputs = point_inputs(prepared(ask(tabletop(0), viewpoints=CAMERA, up=options.get("up"))))
    assert inputs.shape[1] == 7
    assert (inputs[:, 4] == known).all()  # whether up is known
    assert (inputs[:, 5:] == 0).all()  # height and whether it is known
    assert bool((inputs[:, 3] == 0).all()) == (known == 0)


@pytest.mark.parametrize("name", ["rg2", "robotiq_2f140"])
def test_a_hand_that_swings_is_scored_as_one_that_slides_where_its_fingers_rest(name: str) -> None:
    ready, found = example()
    swings = HANDS[name].gripper
    arrives = replace(found, gripper=swings, widths=torch.full((len(found),), 0.9 * swings.max_width))
    rests = candidates.at_rest(ready, arrives)
    slides = dataclasses.replace(swings, name=None, linkage_length=None, linkage_offset=0.0)
    assert (rests.Ts_canonical_grasp - arrives.Ts_canonical_grasp).abs().max() > 0.01
    assert torch.equal(score(arrives), score(replace(rests, gripper=slides)))
    assert not torch.equal(score(arrives), score(replace(arrives, gripper=slides)))
