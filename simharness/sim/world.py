"""A typed layer over one PyBullet simulation: bodies, contacts, constraints, snapshots, images.

The only file that imports pybullet; it knows neither grasps nor scenes. Poses are those of a body's base frame (for a
URDF: the base link's centre of mass, which Bullet makes the body's origin).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, final

import numpy as np
import pybullet as bullet
import pybullet_data
from numpy.typing import ArrayLike, NDArray

from simharness.errors import LoadError
from tesnet.geometry import Pose

TIMESTEP = 1.0 / 240.0
"""Seconds a step of physics takes."""

GRAVITY = 9.81
SOLVER_ITERATIONS = 100
SOLVER_RESIDUAL = 1e-5
"""Iterations end early once no constraint's velocity changes by more than the root of this (3 mm/s)."""


BASE_LINK = -1
"""Bullet's index of a body's base."""

_IDENTITY_XYZW = (0.0, 0.0, 0.0, 1.0)
_ORIGIN = (0.0, 0.0, 0.0)


def data_path() -> Path:
    """The folder of models inside the pybullet package."""
    return Path(pybullet_data.getDataPath())


@dataclass(frozen=True, slots=True)
class Contact:
    """One contact point between two bodies.

    Args:
        link: link of the body asked about; -1 is its base.
        other: the other body.
        other_link: that body's link.
        distance: metres between the surfaces, negative when they overlap.
        position: on the other body's surface, metres in the world.
    """

    link: int
    other: int
    other_link: int
    distance: float
    position: tuple[float, float, float]


@final
class World:
    """One simulation of its own, without a window; a context manager that ends it.

    Two worlds share nothing, and one that was just made always behaves the same, whatever ran in the process before:
    the same calls give the same bits.
    """

    def __init__(self) -> None:
        self._client: int = bullet.connect(bullet.DIRECT)
        bullet.setGravity(0, 0, -GRAVITY, physicsClientId=self._client)
        bullet.setPhysicsEngineParameter(
            fixedTimeStep=TIMESTEP,
            numSolverIterations=SOLVER_ITERATIONS,
            solverResidualThreshold=SOLVER_RESIDUAL,
            minimumSolverIslandSize=1,
            deterministicOverlappingPairs=1,
            physicsClientId=self._client,
        )
        self._objects: list[int] = []
        self._before_step: list[Callable[[], None]] = []

    def __enter__(self) -> World:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the simulation; a second call does nothing."""
        if self._client >= 0:
            bullet.disconnect(physicsClientId=self._client)
            self._client = -1

    # Bodies

    @property
    def objects(self) -> tuple[int, ...]:
        """Ids of the graspable bodies, in the order they were added."""
        return tuple(self._objects)

    def load_urdf(self, path: Path | str, T_world_body: Pose, *, scale: float = 1.0) -> int:
        """Add the body a URDF describes; its id.

        Raises:
            LoadError: a file that does not exist or that Bullet refuses.
        """
        if not Path(path).is_file():
            raise LoadError(path, "no such file; give the path of a URDF")
        try:
            body = bullet.loadURDF(
                str(path),
                basePosition=T_world_body.translation.tolist(),
                baseOrientation=T_world_body.quaternion_xyzw.tolist(),
                globalScaling=scale,
                physicsClientId=self._client,
            )
        except bullet.error as error:
            raise LoadError(path, f"Bullet refuses it ({error}); check its XML and that its meshes exist") from error
        return int(body)

    def load_object(
        self, path: Path | str, T_world_body: Pose, *, scale: float = 1.0, mass: float, friction: float
    ) -> int:
        """Add a graspable body from a URDF with this mass (kg; inertia from its collision shape) and friction; its id.

        Raises:
            LoadError: a file that does not exist or that Bullet refuses.
        """
        body = self.load_urdf(path, T_world_body, scale=scale)
        for link in range(BASE_LINK, self.num_joints(body)):
            self.set_dynamics(body, link, lateralFriction=friction)
        self.set_dynamics(body, BASE_LINK, mass=mass)
        self._objects.append(body)
        return body

    def add_static_box(
        self,
        half_extents: Sequence[float],
        position: Sequence[float],
        *,
        colour: Sequence[float],
        friction: float = 1.0,
    ) -> int:
        """Add an immovable axis-aligned box (metres, colour RGBA in 0-1); its id."""
        collision = bullet.createCollisionShape(
            bullet.GEOM_BOX, halfExtents=list(half_extents), physicsClientId=self._client
        )
        visual = bullet.createVisualShape(
            bullet.GEOM_BOX, halfExtents=list(half_extents), rgbaColor=list(colour), physicsClientId=self._client
        )
        body = bullet.createMultiBody(0.0, collision, visual, list(position), physicsClientId=self._client)
        self.set_dynamics(body, BASE_LINK, lateralFriction=friction)
        return int(body)

    def remove(self, body: int) -> None:
        """Take a body out of the world."""
        bullet.removeBody(body, physicsClientId=self._client)
        if body in self._objects:
            self._objects.remove(body)

    def num_joints(self, body: int) -> int:
        """How many joints (and links beside the base) a body has."""
        return int(bullet.getNumJoints(body, physicsClientId=self._client))

    def set_dynamics(self, body: int, link: int, **properties: float) -> None:
        """Change physical properties of a link, by Bullet's names (`mass`, `lateralFriction`, ...)."""
        bullet.changeDynamics(body, link, physicsClientId=self._client, **properties)

    def pose(self, body: int) -> Pose:
        """T_world_body."""
        position, quaternion_xyzw = bullet.getBasePositionAndOrientation(body, physicsClientId=self._client)
        return Pose.from_quaternion(quaternion_xyzw, position)

    def position(self, body: int) -> tuple[float, float, float]:
        """Origin of a body in the world, metres."""
        x, y, z = bullet.getBasePositionAndOrientation(body, physicsClientId=self._client)[0]
        return x, y, z

    def set_pose(self, body: int, position: Sequence[float], quaternion_xyzw: Sequence[float]) -> None:
        """Put a body somewhere, at rest."""
        bullet.resetBasePositionAndOrientation(body, position, quaternion_xyzw, physicsClientId=self._client)

    def speed(self, body: int) -> float:
        """Speed of a body's origin, m/s."""
        linear, _ = bullet.getBaseVelocity(body, physicsClientId=self._client)
        return float(np.hypot(np.hypot(linear[0], linear[1]), linear[2]))

    # Joints and constraints

    def joint(self, body: int, name: str) -> int:
        """Index of a joint, which is also that of the link behind it.

        Raises:
            KeyError: no joint of that name.
        """
        for index in range(self.num_joints(body)):
            if bullet.getJointInfo(body, index, physicsClientId=self._client)[1].decode() == name:
                return index
        raise KeyError(name)

    def reset_joint(self, body: int, joint: int, position: float) -> None:
        """Put a joint at a position, at rest."""
        bullet.resetJointState(body, joint, position, 0.0, physicsClientId=self._client)

    def joint_position(self, body: int, joint: int) -> float:
        """Where a joint is (metres or radians)."""
        return float(bullet.getJointState(body, joint, physicsClientId=self._client)[0])

    def joint_speed(self, body: int, joint: int) -> float:
        """How fast a joint moves (metres or radians a second)."""
        return float(bullet.getJointState(body, joint, physicsClientId=self._client)[1])

    def drive_joint_to(self, body: int, joint: int, position: float, *, force: float, speed: float) -> None:
        """Let a motor hold a position, with at most this force (N) and speed (m/s)."""
        bullet.setJointMotorControl2(
            body,
            joint,
            bullet.POSITION_CONTROL,
            targetPosition=position,
            force=force,
            maxVelocity=speed,
            physicsClientId=self._client,
        )

    def drive_joint_at(self, body: int, joint: int, velocity: float, *, force: float) -> None:
        """Let a motor hold a velocity (m/s), with at most this force (N)."""
        bullet.setJointMotorControl2(
            body, joint, bullet.VELOCITY_CONTROL, targetVelocity=velocity, force=force, physicsClientId=self._client
        )

    def hold(self, body: int, *, force: float) -> int:
        """A constraint that keeps a body's base at a pose in the world (`move_hold`) with at most this force (N)."""
        position, quaternion_xyzw = bullet.getBasePositionAndOrientation(body, physicsClientId=self._client)
        constraint = bullet.createConstraint(
            body,
            BASE_LINK,
            -1,
            -1,
            bullet.JOINT_FIXED,
            _ORIGIN,
            _ORIGIN,
            position,
            _IDENTITY_XYZW,
            quaternion_xyzw,
            physicsClientId=self._client,
        )
        bullet.changeConstraint(constraint, maxForce=force, physicsClientId=self._client)
        return int(constraint)

    def move_hold(self, constraint: int, position: Sequence[float], quaternion_xyzw: Sequence[float]) -> None:
        """Set the pose that `hold` keeps."""
        bullet.changeConstraint(constraint, position, quaternion_xyzw, physicsClientId=self._client)

    def mirror_joints(self, body: int, joint: int, other: int, *, axis: Sequence[float], force: float) -> int:
        """Keep two joints of one body at equal positions with at most this force (N)."""
        constraint = bullet.createConstraint(
            body,
            joint,
            body,
            other,
            bullet.JOINT_GEAR,
            axis,
            _ORIGIN,
            _ORIGIN,
            physicsClientId=self._client,
        )
        bullet.changeConstraint(constraint, gearRatio=-1, erp=0.1, maxForce=force, physicsClientId=self._client)
        return int(constraint)

    # Physics

    def step(self, steps: int = 1) -> None:
        """Advance physics by this many steps of `TIMESTEP`."""
        for _ in range(steps):
            for prepare in self._before_step:
                prepare()
            bullet.stepSimulation(physicsClientId=self._client)

    def before_every_step(self, prepare: Callable[[], None]) -> None:
        """Have something done before every step from now on, such as moving a joint as another one moves."""
        self._before_step.append(prepare)

    def find_contacts(self) -> None:
        """Look for contacts where everything is now, without moving anything."""
        bullet.performCollisionDetection(physicsClientId=self._client)

    def contacts(self, body: int, *, within: float = 0.0) -> list[Contact]:
        """Contacts of a body found by the last `step` or `find_contacts`.

        Args:
            body: whose contacts.
            within: metres; Bullet also keeps points where surfaces are merely near, those farther apart are dropped.
        """
        points: Any = bullet.getContactPoints(body, physicsClientId=self._client)
        return [
            Contact(link=point[3], other=point[2], other_link=point[4], distance=point[8], position=point[6])
            for point in points
            if point[8] <= within
        ]

    def distance(self, body: int, other: int, *, limit: float) -> float | None:
        """Smallest distance between two bodies in metres, negative when they overlap; None beyond `limit`."""
        points: Any = bullet.getClosestPoints(body, other, limit, physicsClientId=self._client)
        return min((point[8] for point in points), default=None)

    def first_hits(
        self, starts: NDArray[np.float64], ends: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """What rays meet first: the bodies (R,), -1 for none, and after which part (R,) of the way.

        Args:
            starts: (R, 3) metres.
            ends: (R, 3) metres.
        """
        most = bullet.MAX_RAY_INTERSECTION_BATCH_SIZE - 1
        hits: list[Any] = []
        for first in range(0, len(starts), most):
            some = slice(first, first + most)
            hits += bullet.rayTestBatch(starts[some].tolist(), ends[some].tolist(), physicsClientId=self._client)
        return np.array([hit[0] for hit in hits], dtype=np.int64), np.array([hit[2] for hit in hits])

    def save(self) -> int:
        """Remember the state of every body in memory; an id for `restore`."""
        return int(bullet.saveState(physicsClientId=self._client))

    def restore(self, state: int) -> None:
        """Go back to a remembered state; the world must hold the same bodies as then."""
        bullet.restoreState(state, physicsClientId=self._client)

    def forget(self, state: int) -> None:
        """Free a remembered state."""
        bullet.removeState(state, physicsClientId=self._client)

    # Images

    def render(
        self, view: ArrayLike, projection: ArrayLike, width: int, height: int, *, segmentation: bool
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.int32]]:
        """Colour (H, W, 3), depth buffer (H, W) in 0-1 and body ids (H, W; -1 where nothing is) by the CPU renderer.

        Args:
            view: (4, 4) OpenGL view matrix.
            projection: (4, 4) OpenGL projection matrix.
            width: pixels.
            height: pixels.
            segmentation: whether body ids are wanted; without them the third array is all -1.
        """
        flags = 0 if segmentation else bullet.ER_NO_SEGMENTATION_MASK
        _, _, colour, depth, bodies = bullet.getCameraImage(
            width,
            height,
            viewMatrix=np.asarray(view, dtype=np.float64).flatten(order="F").tolist(),
            projectionMatrix=np.asarray(projection, dtype=np.float64).flatten(order="F").tolist(),
            shadow=0,
            renderer=bullet.ER_TINY_RENDERER,
            flags=flags,
            physicsClientId=self._client,
        )
        size = (height, width)
        ids = np.asarray(bodies, dtype=np.int32).reshape(size) if segmentation else np.full(size, -1, dtype=np.int32)
        return (
            np.asarray(colour, dtype=np.uint8).reshape(height, width, 4)[:, :, :3].copy(),
            np.asarray(depth, dtype=np.float32).reshape(size),
            ids,
        )
