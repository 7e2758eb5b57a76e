"""One clutter-removal round against any planner: observe, plan, execute the top grasp, until the table ends the round.

It knows neither HTTP nor files. Every random number comes from (run seed, round, observation), so a round is the same
in whichever process and after whatever other rounds it is played.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float64

from simharness.play.records import (
    FAILURES_IN_A_ROW,
    LOOKS_IN_A_ROW,
    OBJECTS_PER_ROUND,
    UNSURE,
    AttemptRecord,
    Latency,
    NoGraspRecord,
    RoundEnd,
    RoundRecord,
)
from simharness.play.settings import RunSettings
from simharness.sim.camera import PRESET_SENSOR, Observation, Stand, observe, together
from simharness.sim.execute import Outcome, attempt
from simharness.sim.hand import Hand
from simharness.sim.objects import ObjectModel
from simharness.sim.scene import Scene, make_scene, scales_for
from simharness.sim.sensors.catalogue import SENSORS
from simharness.sim.sensors.gaussian import DepthGaussian, GammaScale, PatchNoise
from simharness.sim.sensors.sensor import Sensor
from simharness.sim.world import World
from tesnet.geometry import PANDA, Gripper

_SCENE_STREAM, _CAMERA_STREAM, _REQUEST_STREAM = range(3)


@dataclass(frozen=True, eq=False, slots=True)
class Plan:
    """What a planner proposes for one observation, best first.

    Args:
        Ts_world_grasp: (M, 4, 4) poses of the TCP in the world.
        scores: (M,) probabilities of success.
        widths: (M,) openings to set, metres.
        latency_ms: how long the planner took; None when it did not have to think.
        response: what it said beside the grasps (`reason`, `counts`, `warnings`, `timings_ms` are read), or None.
    """

    Ts_world_grasp: Float64[np.ndarray, "grasps 4 4"]
    scores: Float64[np.ndarray, " grasps"]
    widths: Float64[np.ndarray, " grasps"]
    latency_ms: float | None
    response: Mapping[str, Any] | None = None

    def __post_init__(self) -> None:
        count = len(self.scores)
        for name, shape in (("Ts_world_grasp", (count, 4, 4)), ("scores", (count,)), ("widths", (count,))):
            array = np.array(getattr(self, name), dtype=np.float64).reshape(shape)
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    @classmethod
    def nothing(cls, reason: str) -> Plan:
        """No grasps, found without asking anybody."""
        return cls(np.empty((0, 4, 4)), np.empty(0), np.empty(0), None, {"reason": reason})

    def __len__(self) -> int:
        return len(self.scores)

    @property
    def reason(self) -> str:
        """Why there are no grasps."""
        return str((self.response or {}).get("reason") or "unknown")

    @property
    def counts(self) -> Mapping[str, Any]:
        """The response's account of points and candidates."""
        counts: Mapping[str, Any] = (self.response or {}).get("counts", {})
        return counts

    @property
    def warnings(self) -> tuple[str, ...]:
        """The response's."""
        return tuple((self.response or {}).get("warnings", ()))

    @property
    def latency(self) -> Latency | None:
        """Times of the request; None when there was none."""
        if self.latency_ms is None:
            return None
        return Latency(service=(self.response or {}).get("timings_ms", {}).get("total"), round_trip=self.latency_ms)


class GraspPlanner(Protocol):
    """Anything that turns an observation into grasps; a baseline swaps in by having this method."""

    def plan(self, observation: Observation, seed: int) -> Plan:
        """Grasps in the world, best first, repeatable for a seed."""
        ...


@dataclass(frozen=True, eq=False, slots=True)
class Observed:
    """The planner has answered; nothing has moved yet.

    Args:
        seed, round, observation: which observation this is.
        view: what the camera saw.
        plan: what the planner proposes.
        objects: ids and names of the bodies on the table.
        gripper: the hand.
    """

    seed: int
    round: int
    observation: int
    view: Observation
    plan: Plan
    objects: Mapping[int, str]
    gripper: Gripper = PANDA


@dataclass(frozen=True, eq=False, slots=True)
class Attempted:
    """A grasp was carried out.

    Args:
        record: how it went.
        before: the observation that it came from.
        outcome: what the executor says of it.
    """

    record: AttemptRecord
    before: Observed
    outcome: Outcome


Listener = Callable[["Observed | Attempted"], None]


def scene_rng(seed: int, round_number: int) -> np.random.Generator:
    """Random numbers of a round's scene: the same for every network, camera and executor."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(round_number, _SCENE_STREAM)))


def camera_rng(seed: int, round_number: int, observation: int) -> np.random.Generator:
    """Random numbers of an observation's camera pose and noise."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(round_number, _CAMERA_STREAM, observation)))


def request_seed(seed: int, round_number: int, observation: int) -> int:
    """The seed sent with an observation's request, 0 to 2^31 - 1."""
    sequence = np.random.SeedSequence(seed, spawn_key=(round_number, _REQUEST_STREAM, observation))
    return int(sequence.generate_state(1)[0] >> 1)


def camera_sensor(settings: RunSettings) -> Sensor:
    """The sensor of a run's camera: the one named or its preset's, with what the settings replace."""
    sensor = SENSORS[settings.sensor or PRESET_SENSOR[settings.camera]]
    if settings.dex_noise is not None:
        sensor = sensor.without(GammaScale).without(PatchNoise)
        sensor = replace(sensor, depth=SENSORS["dex"].depth + sensor.depth) if settings.dex_noise else sensor
    if settings.depth_noise_std is not None:
        sensor = sensor.without(DepthGaussian)
        sensor = sensor.with_part(DepthGaussian(settings.depth_noise_std)) if settings.depth_noise_std else sensor
    if settings.noise_std is not None:
        sensor = replace(sensor, point_sigma=settings.noise_std)
    return sensor


def round_scene(
    world: World, settings: RunSettings, objects: Sequence[ObjectModel], seed: int, round_number: int
) -> Scene:
    """Makes the scene of a round in an empty world."""
    return make_scene(
        world,
        settings.scene,
        objects,
        scene_rng(seed, round_number),
        num_objects=OBJECTS_PER_ROUND,
        scale_range=scales_for(settings.scene, settings.hand.gripper),
    )


def play_round(
    settings: RunSettings,
    objects: Sequence[ObjectModel],
    planner: GraspPlanner,
    seed: int,
    round_number: int,
    listener: Listener | None = None,
    *,
    segmentation: bool = False,
) -> RoundRecord:
    """Play one round in a world of its own.

    Args:
        settings: of the run.
        objects: the object set.
        planner: who proposes the grasps.
        seed: the run seed.
        round_number: from 0.
        listener: is told of every observation and attempt as it happens.
        segmentation: whether the listener wants body ids in the images; they take time and change no result.

    Raises:
        RunBroken: the planner failed.
    """
    with World() as world:
        scene = round_scene(world, settings, objects, seed, round_number)
        names = {placed.body_id: placed.name for placed in scene.placed}
        present = tuple(names[body] for body in world.objects)
        table = _Table(settings, world, names, seed, round_number, listener, segmentation=segmentation)
        ended = table.clear(planner)
        return RoundRecord(seed, round_number, present, ended, tuple(table.attempts), tuple(table.no_grasps))


class _Table:
    """A round under way."""

    def __init__(
        self,
        settings: RunSettings,
        world: World,
        names: Mapping[int, str],
        seed: int,
        round_number: int,
        listener: Listener | None,
        *,
        segmentation: bool,
    ) -> None:
        self._settings = settings
        self._world = world
        self._hand = Hand(world, settings.hand)
        self._names = names
        self._seed = seed
        self._round = round_number
        self._tell: Listener = listener or (lambda _event: None)
        self._segmentation = segmentation
        self._sensor = camera_sensor(settings)
        self._stand = Stand(settings.polar_deg, settings.distance)
        self.attempts: list[AttemptRecord] = []
        self.no_grasps: list[NoGraspRecord] = []

    def clear(self, planner: GraspPlanner) -> RoundEnd:
        """Play until the round is over."""
        failures = observation = 0
        looks: list[Observation] = []  # since the last attempt: nothing has moved
        while self._world.objects:
            looks.append(self._look(observation))
            observed = self._ask(planner, observation, looks)
            observation += 1
            plan = observed.plan
            is_last = len(looks) == LOOKS_IN_A_ROW
            if not len(plan) or (self._is_unsure(plan) and not is_last):
                reason = UNSURE if len(plan) else plan.reason
                self.no_grasps.append(NoGraspRecord(observed.observation, reason, plan.counts, plan.latency))
                if is_last:
                    return "no_grasps"
                continue
            looks.clear()
            failures = 0 if self._attempt(observed).success else failures + 1
            if failures == FAILURES_IN_A_ROW:
                return "two_failures"
        return "empty"

    def _look(self, observation: int) -> Observation:
        return observe(
            self._world,
            self._settings.camera,
            camera_rng(self._seed, self._round, observation),
            self._sensor,
            stand=self._stand,
            table_in_view=self._settings.shows_table,
            voxel_size=self._settings.voxel_size,
            segmentation=self._segmentation,
        )

    def _is_unsure(self, plan: Plan) -> bool:
        least = self._settings.look_again_below
        return least is not None and bool(plan.scores[0] < least)

    def _ask(self, planner: GraspPlanner, observation: int, looks: Sequence[Observation]) -> Observed:
        view = looks[-1] if self._settings.look_again_below is None else together(looks)
        plan = planner.plan(view, request_seed(self._seed, self._round, observation))
        present = {body: self._names[body] for body in self._world.objects}
        observed = Observed(self._seed, self._round, observation, view, plan, present, self._hand.gripper)
        self._tell(observed)
        return observed

    def _attempt(self, observed: Observed) -> AttemptRecord:
        plan = observed.plan
        outcome = attempt(
            self._world, self._hand, plan.Ts_world_grasp[0], float(plan.widths[0]), self._settings.executor
        )
        record = AttemptRecord(
            seed=self._seed,
            round=self._round,
            attempt=len(self.attempts),
            observation=observed.observation,
            request_seed=request_seed(self._seed, self._round, observed.observation),
            viewpoints=tuple(tuple(viewpoint) for viewpoint in np.asarray(observed.view.viewpoints).tolist()),
            T_world_grasp=plan.Ts_world_grasp[0],
            width=float(plan.widths[0]),
            score=float(plan.scores[0]),
            outcome=outcome.kind,
            grasped=tuple(self._names[body] for body in outcome.grasped),
            objects=tuple(observed.objects.values()),
            contact_at_start=outcome.contact_at_start,
            contact_on_way=outcome.contact_on_way,
            counts=plan.counts,
            latency=plan.latency,
            warnings=plan.warnings,
        )
        self.attempts.append(record)
        self._tell(Attempted(record, observed, outcome))
        return record
