"""One grasp attempt in simulation, and what became of it; many of them, for labels.

Knows the hand and the table's objects; nothing of planners, rounds or rates.

The hand appears 5 cm behind the grasp, moves there at 0.1 m/s, closes, and retreats 0.1 m. Two executors judge it:
`edge` as the published harness does (contacts on the way push, any contact in the end counts), `strict` as a robot must
(a contact before closing is a failure, and both fingers must hold the same object).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from simharness.sim.hand import Hand, HandContact, Placement, placements
from simharness.sim.outcome_kinds import OutcomeKind
from simharness.sim.scene import settle
from simharness.sim.world import TIMESTEP, World
from tesnet.geometry import Pose

Executor = Literal["edge", "strict"]

PREGRASP_DISTANCE = 0.05
RETREAT_DISTANCE = 0.1
SPEED = 0.1
"""Metres, and metres a second."""

LARGEST_RETREAT_ANGLE_DEG = 60.0
"""Hands that point farther from straight down than this retreat upwards."""

TOUCHING = 0.001
"""Metres up to which a finger counts as holding a surface: pads rest on edges and leave slivers of air."""

_STEP_LENGTH = SPEED * TIMESTEP
_CLOSING_STEPS = 120
_STEPS_BETWEEN_CHECKS = 6
_STILL = 0.002
_STILL_CHECKS = 2
_STEPS_BETWEEN_LOOKS = 12
_STILL_DISTANCE = 0.0002
_STILL_ANGLE = np.deg2rad(0.3)
_ARRIVAL_STEPS = 12
_WAY_FRACTIONS = (0.0, 0.5, 0.25, 0.75, 0.125, 0.375, 0.625, 0.875)


@dataclass(frozen=True, slots=True)
class Grip:
    """What closing the fingers led to.

    Args:
        touched: ids of the objects that touch the hand.
        pinched: ids of those that touch both fingers.
        empty: the fingers met.
    """

    touched: frozenset[int]
    pinched: frozenset[int]
    empty: bool

    def held(self, executor: Executor) -> frozenset[int]:
        """Ids of the objects that count as held."""
        if self.empty:
            return frozenset()
        return self.touched if executor == "edge" else self.pinched


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of an attempt, and the evidence, which is left out when outcomes are compared.

    Args:
        kind: `success`, or how it failed.
        grasped: ids of the objects that were lifted and removed.
        contact_at_start: the hand touched something where it appeared.
        contact_on_way: it touched something between there and the grasp.
        lost: ids of objects that left the workspace otherwise, and were removed.
        first_contact: the deepest contact when the hand first touched something before closing, or None.
        closed: the grip before the retreat; None when the fingers were never closed.
    """

    kind: OutcomeKind
    grasped: tuple[int, ...]
    contact_at_start: bool
    contact_on_way: bool
    lost: tuple[int, ...] = ()
    first_contact: HandContact | None = field(default=None, compare=False)
    closed: Grip | None = field(default=None, compare=False)


@dataclass(frozen=True, slots=True)
class Labels:
    """Outcomes of one candidate.

    Args:
        strict: under the `strict` executor.
        edge: under the `edge` executor; None where it was not paid for.
    """

    strict: OutcomeKind
    edge: OutcomeKind | None


@dataclass(frozen=True, slots=True)
class _Lift:
    closed: Grip
    lifted: Grip

    def kind(self, executor: Executor) -> OutcomeKind:
        if self.lifted.held(executor) and self.closed.held(executor):
            return "success"
        return "drop" if self.closed.held(executor) else "slip"


_NOTHING = Grip(frozenset(), frozenset(), empty=True)


def attempt(world: World, hand: Hand, T_world_grasp: NDArray[np.float64], width: float, executor: Executor) -> Outcome:
    """Execute one grasp; afterwards grasped objects are gone, the scene has settled and the hand is parked.

    Args:
        world: holds a settled scene.
        hand: this world's.
        T_world_grasp: (4, 4) TCP pose.
        width: opening to approach with, metres.
        executor: which rules apply.
    """
    grasp = placements(np.asarray(T_world_grasp, dtype=np.float64)[None], [width], hand.gripper)[0]
    at_start = hand.deepest_contact() if _touches(world, hand, grasp, PREGRASP_DISTANCE) else None
    if executor == "strict" and at_start is not None:
        return _finish(world, hand, "pregrasp", at_start, None)
    on_way = _approach(world, hand, grasp, stop_at_contact=executor == "strict")
    if executor == "strict" and on_way is not None:
        return _finish(world, hand, "approach", None, on_way)
    lift = _close_and_lift(world, hand, grasp, executor, full_retreat=True)
    kind = lift.kind(executor)
    grasped: frozenset[int] = lift.lifted.held(executor) if kind == "success" else frozenset()
    return _finish(world, hand, kind, at_start, on_way, lift.closed, grasped)


def label_strict(
    world: World,
    hand: Hand,
    Ts_world_grasp: Float[np.ndarray, "candidates 4 4"],
    widths: Float[np.ndarray, " candidates"],
    snapshot: int,
) -> list[OutcomeKind]:
    """What `attempt` with the `strict` executor would make of each candidate in the same scene.

    Contacts before closing are found by placing the hand, without physics; closing and retreat are those of `attempt`.

    Args:
        world: holds a settled scene.
        hand: this world's, parked.
        Ts_world_grasp: (K, 4, 4) TCP poses.
        widths: (K,) metres.
        snapshot: state of this scene from `world.save()`; the world is left in it.
    """
    return [labels.strict for labels in label_candidates(world, hand, Ts_world_grasp, widths, snapshot, edge=False)]


def label_candidates(
    world: World,
    hand: Hand,
    Ts_world_grasp: Float[np.ndarray, "candidates 4 4"],
    widths: Float[np.ndarray, " candidates"],
    snapshot: int,
    *,
    edge: bool,
) -> list[Labels]:
    """`label_strict`, with outcomes under the `edge` executor where `edge` asks for them.

    An `edge` label needs the physics of the approach where the approach touches something, which costs about as much as
    an attempt.
    """
    world.restore(snapshot)
    labels = []
    for grasp in placements(np.asarray(Ts_world_grasp, dtype=np.float64), widths.tolist(), hand.gripper):
        failure = _first_contact(world, hand, grasp)
        if failure is not None and not edge:
            labels.append(Labels(failure, None))
            continue
        world.restore(snapshot)
        if failure is None:
            hand.place_behind(grasp, 0.0)
        else:
            _approach(world, hand, grasp, stop_at_contact=False)
        lift = _close_and_lift(world, hand, grasp, "edge" if edge else "strict", full_retreat=False)
        labels.append(Labels(failure or lift.kind("strict"), lift.kind("edge") if edge else None))
        world.restore(snapshot)
    hand.park()
    return labels


@contextmanager
def snapshot_of(world: World) -> Iterator[int]:
    """A remembered state for `label_strict`, freed at the end."""
    state = world.save()
    try:
        yield state
    finally:
        world.forget(state)


def _touches(world: World, hand: Hand, grasp: Placement, behind: float) -> bool:
    hand.place_behind(grasp, behind)
    world.find_contacts()
    return hand.touches_anything()


def _first_contact(world: World, hand: Hand, grasp: Placement) -> Literal["pregrasp", "approach"] | None:
    """Where the hand would first touch something, found without physics; None when it reaches the grasp freely."""
    if _touches(world, hand, grasp, PREGRASP_DISTANCE):
        return "pregrasp"
    if any(_touches(world, hand, grasp, fraction * PREGRASP_DISTANCE) for fraction in _WAY_FRACTIONS):
        return "approach"
    return None


def _approach(world: World, hand: Hand, grasp: Placement, *, stop_at_contact: bool) -> HandContact | None:
    """Move from the start pose to the grasp in physics; what the hand touched first on the way."""
    hand.place_behind(grasp, PREGRASP_DISTANCE)
    hand.hold_open(grasp.width)
    first: HandContact | None = None
    steps = round(PREGRASP_DISTANCE / _STEP_LENGTH)
    for step in range(1, steps + _ARRIVAL_STEPS + 1):
        hand.carry_to(grasp, behind=max(0.0, PREGRASP_DISTANCE - step * _STEP_LENGTH))
        world.step()
        first = first or hand.deepest_contact()
        if first is not None and stop_at_contact:
            break
    return first


def _close_and_lift(world: World, hand: Hand, grasp: Placement, executor: Executor, *, full_retreat: bool) -> _Lift:
    """Close where the hand is, then retreat, as long as there is anything that the executor could count as held.

    Args:
        world: holds the hand at the grasp.
        hand: this world's, open.
        grasp: where the hand is.
        executor: whose idea of holding decides whether to go on.
        full_retreat: go all the way; else stop as soon as an object hangs in the hand, touches nothing but the hand and
            no longer moves in it, because nothing will change any more.
    """
    hand.close()
    still = 0
    for _ in range(_CLOSING_STEPS // _STEPS_BETWEEN_CHECKS):
        world.step(_STEPS_BETWEEN_CHECKS)
        if hand.width <= hand.empty_width:
            return _Lift(_NOTHING, _NOTHING)
        still = still + 1 if hand.finger_speed < _STILL else 0
        if still == _STILL_CHECKS:
            break
    closed = _grip(world, hand)
    if not closed.held(executor):
        return _Lift(closed, _NOTHING)
    upwards = -grasp.z[2] < np.cos(np.deg2rad(LARGEST_RETREAT_ANGLE_DEG))
    hanging: dict[int, Pose] = {}
    for step in range(1, round(RETREAT_DISTANCE / _STEP_LENGTH) + 1):
        travelled = step * _STEP_LENGTH
        hand.carry_to(grasp, behind=0.0 if upwards else travelled, above=travelled if upwards else 0.0)
        world.step()
        if step % _STEPS_BETWEEN_CHECKS == 0 and hand.width <= hand.empty_width:
            return _Lift(closed, _NOTHING)
        if not full_retreat and step % _STEPS_BETWEEN_LOOKS == 0:
            before, hanging = hanging, _hanging(world, hand)
            if before.keys() == hanging.keys() and any(_still(before[body], hanging[body]) for body in hanging):
                break
    return _Lift(closed, _grip(world, hand))


def _grip(world: World, hand: Hand) -> Grip:
    touched, pinched = hand.touched(within=TOUCHING)
    objects = frozenset(world.objects)
    return Grip(objects & touched, objects & pinched, empty=hand.width <= hand.empty_width)


def _hanging(world: World, hand: Hand) -> dict[int, Pose]:
    """Poses T_grasp_body of the objects between the fingers; empty when one of them still touches something else."""
    touched, pinched = hand.touched(within=TOUCHING)
    if touched != pinched or any(
        contact.other != hand.body for body in touched for contact in world.contacts(body, within=TOUCHING)
    ):
        return {}
    T_grasp_world = hand.T_world_grasp.inverse()
    return {body: T_grasp_world @ world.pose(body) for body in sorted(pinched)}


def _still(before: Pose, now: Pose) -> bool:
    # For small angles the Frobenius norm of a difference of rotations is sqrt(2) times the angle between them.
    turned = np.linalg.norm(now.rotation - before.rotation) / np.sqrt(2)
    moved = np.linalg.norm(now.translation - before.translation)
    return bool(moved < _STILL_DISTANCE and turned < _STILL_ANGLE)


def _finish(
    world: World,
    hand: Hand,
    kind: OutcomeKind,
    at_start: HandContact | None,
    on_way: HandContact | None,
    closed: Grip | None = None,
    grasped: frozenset[int] = frozenset(),
) -> Outcome:
    for body in sorted(grasped):
        world.remove(body)
    hand.park()
    lost = settle(world)
    touching = (at_start is not None, on_way is not None)
    return Outcome(kind, tuple(sorted(grasped)), *touching, lost, at_start or on_way, closed)
