"""How a scene is looked at: cameras, sensor, what is shown of the table. The same value gives the same cloud again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, cast, get_args

import numpy as np
import torch

from simharness.sim.camera import PRESET_SENSOR, Observation, Preset, Stand, observe_from, sample_camera
from simharness.sim.protocol import query_about
from simharness.sim.scene import WORKSPACE
from simharness.sim.sensors.calibration import Calibration
from simharness.sim.sensors.catalogue import D435, SENSORS, SensorName, random_sensor
from simharness.sim.sensors.sensor import Sensor
from simharness.sim.sensors.stereo import Stereo
from simharness.sim.world import World
from tesnet import cloud
from tesnet.calibration import calibrated
from tesnet.geometry import Gripper, Pose
from tesnet.query import GraspQuery

Camera = Preset | Literal["any"]
"""A preset, or one to four views from any place that a camera may have."""

RANDOM, RANDOM_POSE = "random", "random-pose"
"""Sensors that are drawn for each view; those of the latter do not stand quite where they are believed to."""

_WRONG_POSE = Calibration(translation=0.008, rotation_deg=1.5)

Shows = Literal["box", "table", "open"]
"""The cloud that is asked about: cropped to the workspace, as the protocol has it; all that is seen, with the workspace
named; or that without a workspace."""
SHOWS: tuple[Shows, ...] = get_args(Shows)

_SHARES_OF_SHOWS = (0.5, 0.35, 0.15)
_SHARES_OF_COUNTS = (0.55, 0.15, 0.15, 0.15)
_MOST_POLAR_DEG = 80.0
_DISTANCES = (0.35, 1.2)
_NEAREST_LONG_FOCUS = 0.5
_LONG_FOCUS = D435.focal_length * 1.5
_MIDDLE = (WORKSPACE.minimum + WORKSPACE.maximum) / 2
_HALF_TURN = Pose(np.diag([-1.0, -1.0, 1.0]), np.array([2 * _MIDDLE[0], 2 * _MIDDLE[1], 0.0]))
"""About the vertical through the middle of the table, T_world_world: preset `random` stands on one side of it."""


@dataclass(frozen=True, eq=False, slots=True)
class Viewing:
    """How a scene is looked at.

    Args:
        cameras: T_world_camera of each view; several are fused into one cloud.
        sensor: name in `SENSORS`, or `random` or `random-pose`: then it is drawn from `seed`.
        seed: of the sensor and its noise.
        shows: what is asked about.
    """

    cameras: tuple[Pose, ...]
    sensor: str
    seed: int
    shows: Shows = "box"

    def describe(self) -> dict[str, Any]:
        """As plain JSON values."""
        cameras = [camera.matrix.tolist() for camera in self.cameras]
        return {"cameras": cameras, "sensor": self.sensor, "seed": self.seed, "shows": self.shows}

    @classmethod
    def described(cls, values: Mapping[str, Any]) -> Viewing:
        """From what `describe` gave."""
        cameras = tuple(Pose.from_matrix(matrix) for matrix in values["cameras"])
        return cls(cameras, values["sensor"], values["seed"], values["shows"])

    def observe(self, world: World) -> Observation:
        """What is seen of a world."""
        rng = np.random.default_rng(self.seed)
        sensor = sensor_of(self.sensor, rng)
        return observe_from(world, self.cameras, rng, sensor, table_in_view=self.shows != "box")

    def query(self, observation: Observation, seed: int, gripper: Gripper) -> GraspQuery:
        """What is asked about an observation; where the table is shown, it is asked to calibrate, and that is done."""
        query = query_about(observation, seed, gripper, calibrate=self.shows != "box")
        if self.shows == "open":
            query = replace(query, workspace=None)
        return calibrated(query)[0]

    def look(
        self, world: World, seed: int, gripper: Gripper, preparation: cloud.PreparationConfig
    ) -> tuple[GraspQuery, cloud.PreparedCloud] | None:
        """What is asked about a world, and its prepared cloud; None where that has too few points for any grasp."""
        query = self.query(self.observe(world), seed, gripper)
        prepared = cloud.prepare(query, preparation, torch.device("cpu"))
        return None if prepared is None or len(prepared) < cloud.MINIMUM_POINTS else (query, prepared)


@dataclass(frozen=True, slots=True)
class MoreViews:
    """New looks at a scene whose labels are there.

    Args:
        count: so many.
        camera: a preset, or `any`.
        sensor: as `draw_viewing` takes it.
    """

    count: int = 0
    camera: Camera = "random"
    sensor: str | None = None

    def draw(self, rng: np.random.Generator) -> list[Viewing]:
        """Ways to look at one scene."""
        return [draw_viewing(self.camera, self.sensor, rng) for _ in range(self.count)]


def draw_viewing(camera: Camera, sensor: str | None, rng: np.random.Generator) -> Viewing:
    """A way to look at a scene.

    `any` has one view in 0.55 of the cases, up to four otherwise, each 0 to 80 degrees from straight above and 0.35 to
    1.2 m from the middle of the table (sensors of long focus from 0.5 m), and shows the table in a half of them; with
    `random-pose` always, for who fears a wrong pose asks to calibrate.

    Args:
        camera: a preset or `any`.
        sensor: its name, `random` or `random-pose`; None is the preset's own (of `any` that of the protocol).
        rng: source of all that is random about it.
    """
    seed = int(rng.integers(2**32))
    if camera != "any":
        name = PRESET_SENSOR[camera] if sensor is None else sensor
        return Viewing(sample_camera(camera, rng), name, seed, "table" if name == RANDOM_POSE else "box")
    name = PRESET_SENSOR["random"] if sensor is None else sensor
    drawn = sensor_of(name, np.random.default_rng(seed))
    count = int(rng.choice(len(_SHARES_OF_COUNTS), p=_SHARES_OF_COUNTS)) + 1
    shares = np.array(_SHARES_OF_SHOWS)
    shares[0] *= name != RANDOM_POSE
    shows = SHOWS[int(rng.choice(len(SHOWS), p=shares / shares.sum()))]
    return Viewing(tuple(_anywhere(drawn, rng) for _ in range(count)), name, seed, shows)


def sensor_of(name: str, rng: np.random.Generator) -> Sensor:
    """A sensor by its name; nothing is drawn unless it is `random` or `random-pose`."""
    if name not in (RANDOM, RANDOM_POSE):
        return SENSORS[cast(SensorName, name)]
    drawn = random_sensor(rng)
    return replace(drawn, calibration=_WRONG_POSE) if name == RANDOM_POSE else drawn


def viewings_of(description: Mapping[str, Any]) -> list[Viewing]:
    """How the labelled views of a described scene were taken."""
    return [Viewing.described(values) for values in description["views"]]


def _anywhere(sensor: Sensor, rng: np.random.Generator) -> Pose:
    """T_world_camera; azimuths are 0 to 360 degrees."""
    long_focus = any(isinstance(part, Stereo) and part.focal_length > _LONG_FOCUS for part in sensor.depth)
    nearest = _NEAREST_LONG_FOCUS if long_focus else _DISTANCES[0]
    polar_deg, distance = rng.uniform(0.0, _MOST_POLAR_DEG), rng.uniform(nearest, _DISTANCES[1])
    (camera,) = sample_camera("random", rng, Stand(polar_deg=float(polar_deg), distance=float(distance)))
    return _HALF_TURN @ camera if rng.uniform() < 0.5 else camera
