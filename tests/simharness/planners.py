"""Planners that need no service."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from simharness.play.round import (
    Plan,
)
from simharness.sim.camera import Observation


class TopDown:
    """Grasps the highest thing from above, across its shorter side."""

    def __init__(self) -> None:
        self.seeds: list[int] = []

    def plan(self, observation: Observation, seed: int) -> Plan:
        self.seeds.append(seed)
        points = observation.points_world.astype(np.float64)
        top = points[points[:, 2].argmax()]
        near = points[np.linalg.norm(points[:, :2] - top[:2], axis=1) < 0.03]
        _, axes = np.linalg.eigh(np.cov((near - near.mean(axis=0))[:, :2].T))
        y, z = np.array([*axes[:, 0], 0.0]), np.array([0.0, 0.0, -1.0])
        pose = np.eye(4)
        pose[:3, :3] = np.stack([np.cross(y, z), y, z], axis=1)
        pose[:3, 3] = [*near.mean(axis=0)[:2], max(top[2] - 0.03, 0.064)]
        response = {"counts": {"points": len(points)}, "timings_ms": {"total": 1.0}}
        return Plan(pose[None], np.array([0.5]), np.array([0.08]), 2.0, response)


class Scripted:
    """Says in turn what it was given: a reason for no grasp, or a score (None is 0.5) of a grasp in empty air."""

    def __init__(self, script: Iterable[str | float | None]) -> None:
        self._script = iter(script)
        self.seen: list[Observation] = []

    def plan(self, observation: Observation, seed: int) -> Plan:
        self.seen.append(observation)
        said = next(self._script)
        if isinstance(said, str):
            return Plan.nothing(said)
        air = np.diag([1.0, -1.0, -1.0, 1.0])
        air[:3, 3] = [0.15, 0.15, 0.6]
        return Plan(air[None], np.array([0.5 if said is None else said]), np.array([0.08]), 2.0)


class Alternating:
    """Grasps air and an object in turn."""

    def __init__(self) -> None:
        self._air, self._good, self._asked = Scripted([None] * 50), TopDown(), 0

    def plan(self, observation: Observation, seed: int) -> Plan:
        self._asked += 1
        return (self._air if self._asked % 2 else self._good).plan(observation, seed)
