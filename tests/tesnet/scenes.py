"""Clouds that tests look at: a table with boxes and cylinders as one camera sees them, made from a seed."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from tesnet import cloud
from tesnet.candidates import Candidates, wide_open
from tesnet.geometry import PANDA, Box, Pose
from tesnet.networks.tesnet import TesNet, TesNetConfig
from tesnet.points import nearest_neighbours
from tesnet.predictor import GraspPredictor, ModelInfo, configuration_of
from tesnet.query import GraspQuery

Array = NDArray[np.float64]

UP = np.array([0.0, 0.0, 1.0])
SUPPORT_HEIGHT = 0.0
CAMERA = np.array([0.45, -0.2, 0.5])
WORKSPACE = Box(np.array([-0.15, -0.15, 0.005]), np.array([0.15, 0.15, 0.3]))
CPU = torch.device("cpu")


def box_surface(size: tuple[float, float, float], count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Points (count, 3) and outward normals on a box about the origin."""
    half = np.array(size) / 2
    areas = np.repeat([half[1] * half[2], half[0] * half[2], half[0] * half[1]], 2)
    face = rng.choice(6, count, p=areas / areas.sum())
    axis, side = face // 2, np.where(face % 2, 1.0, -1.0)
    points = rng.uniform(-half, half, (count, 3))
    rows = np.arange(count)
    points[rows, axis] = side * half[axis]
    normals = np.zeros((count, 3))
    normals[rows, axis] = side
    return points, normals


def cylinder_surface(radius: float, height: float, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Points (count, 3) and outward normals on the side and the top of an upright cylinder about the origin."""
    angle = rng.uniform(0, 2 * np.pi, count)
    around = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
    on_top = rng.random(count) < radius / (radius + 2 * height)
    side = around * radius + np.outer(rng.uniform(-height / 2, height / 2, count), UP)
    top = around * radius * np.sqrt(rng.random((count, 1))) + height / 2 * UP
    return np.where(on_top[:, None], top, side), np.where(on_top[:, None], UP, around)


def seen_from(points: Array, normals: Array, camera: Array) -> Array:
    """The points whose surface faces the camera and that nothing nearer hides, on an image of 2 mm pixels."""
    T_camera_world = Pose.look_at(camera, np.zeros(3), UP).inverse()
    facing = ((camera - points) * normals).sum(axis=1) > 0
    local = T_camera_world.apply(points[facing])
    pixels = np.floor(local[:, :2] / local[:, 2:] * 350).astype(int)
    _, pixel = np.unique(pixels, axis=0, return_inverse=True)
    nearest = np.full(pixel.max() + 1, np.inf)
    np.minimum.at(nearest, pixel.ravel(), local[:, 2])
    seen: Array = points[facing][local[:, 2] < nearest[pixel.ravel()] + 0.006]
    return seen


def tabletop(seed: int = 0, count: int = 40_000, noise: float = 0.0005) -> Array:
    """Points (N, 3) of three boxes and two cylinders standing on the plane z = 0, as `CAMERA` sees them."""
    rng = np.random.default_rng(seed)
    places = np.array([[0.0, 0.0], [0.09, 0.05], [-0.09, 0.06], [0.02, -0.1], [-0.08, -0.08]])
    surfaces = []
    for index, (x, y) in enumerate(places + rng.uniform(-0.01, 0.01, places.shape)):
        height = rng.uniform(0.05, 0.11)
        if index % 2:
            points, normals = cylinder_surface(rng.uniform(0.015, 0.03), height, count // 5, rng)
        else:
            size = (rng.uniform(0.025, 0.06), rng.uniform(0.025, 0.06), height)
            points, normals = box_surface(size, count // 5, rng)
        turn = Pose.from_quaternion([0, 0, *rng.normal(size=2)], [x, y, height / 2])
        surfaces.append((turn.apply(points), turn.rotate(normals)))
    points, normals = (np.concatenate(parts) for parts in zip(*surfaces, strict=True))
    seen = seen_from(points, normals, CAMERA)
    return seen + rng.normal(0, noise, seen.shape)


def ask(points: Any, **options: Any) -> GraspQuery:
    """A query about points of any number type."""
    return GraspQuery(points, **options)


def tabletop_query(seed: int = 0, **options: Any) -> GraspQuery:
    """A query about `tabletop(seed)` with everything a careful caller gives."""
    given = {"points": tabletop(seed), "viewpoints": CAMERA, "up": UP, "support_height": SUPPORT_HEIGHT}
    return ask(**{**given, **options})


def moved_query(query: GraspQuery, motion: Pose) -> GraspQuery:
    """The same question about the same scene, everything moved along (a workspace, which has axes, is not)."""
    assert query.workspace is None
    assert query.approach is None
    options: dict[str, Any] = {}
    if query.viewpoints is not None:
        options["viewpoints"] = motion.apply(query.viewpoints)
    if query.up is not None:
        options["up"] = motion.rotate(query.up)
        if isinstance(query.support_height, float):
            options["support_height"] = query.support_height + float(motion.translation @ options["up"])
    names = ("max_grasps", "min_score", "separation_translation", "separation_rotation_deg", "num_approach_points")
    options |= {name: getattr(query, name) for name in (*names, "max_candidates", "unseen", "seed")}
    return ask(motion.apply(query.points), **options)


def prepared(query: GraspQuery, **changes: Any) -> cloud.PreparedCloud:
    """The prepared cloud of a query that has one."""
    found = cloud.prepare(query, cloud.PreparationConfig(**changes), CPU)
    assert found is not None
    return found


def open_hands(poses: torch.Tensor) -> Candidates:
    """Wide open Panda hands at TCP poses (C, 4, 4), of no particular pair of points."""
    nowhere = torch.zeros(len(poses), dtype=torch.long)
    return Candidates(nowhere, nowhere, poses, wide_open(poses, PANDA), PANDA)


def bare_cloud(points: Array, viewpoints: Array = CAMERA[None], **fields: Any) -> cloud.PreparedCloud:
    """A prepared cloud of exactly these points (P, 3), in a frame of their own; normals face the first viewpoint."""
    positions = torch.from_numpy(np.asarray(points)).float()
    cameras = torch.from_numpy(np.asarray(viewpoints)).float()
    directions = torch.nn.functional.normalize(cameras[0] - positions, dim=1)
    given: dict[str, Any] = {
        "points": positions,
        "normals": directions,
        "neighbours": nearest_neighbours(positions, 16),
        "spectrum": torch.full((len(positions), 2), 0.1),
        "view_directions": directions,
        "viewpoints": cameras,
        "up": None,
        "support_height": None,
        "sides": torch.zeros(0, 4),
        "T_cloud_canonical": Pose.identity(),
    }
    return cloud.PreparedCloud(**{**given, **fields})


def moved_cloud(ready: cloud.PreparedCloud, motion: Pose) -> cloud.PreparedCloud:
    """A prepared cloud, moved in its frame with all that belongs to it."""
    turn, shift = torch.tensor(motion.rotation), torch.tensor(motion.translation)

    def rotate(directions: torch.Tensor) -> torch.Tensor:
        return (directions.double() @ turn.T).float()

    def move(points: torch.Tensor) -> torch.Tensor:
        return (points.double() @ turn.T + shift).float()

    up = None if ready.up is None else rotate(ready.up)
    normals = rotate(ready.sides[:, :3])
    height = ready.support_height
    return replace(
        ready,
        points=move(ready.points),
        normals=rotate(ready.normals),
        view_directions=rotate(ready.view_directions),
        viewpoints=move(ready.viewpoints),
        up=up,
        support_height=None if height is None or up is None else height + float(shift @ up.double()),
        sides=torch.cat([normals, ready.sides[:, 3:] + (normals.double() @ shift).float()[:, None]], dim=1),
        T_cloud_canonical=ready.T_cloud_canonical @ motion.inverse(),
    )


def fresh_network(seed: int = 0) -> TesNet:
    """TES-Net with untrained parameters, always the same for a seed."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return TesNet(TesNetConfig()).eval()


def told_network(seed: int = 0) -> TesNet:
    """`fresh_network` that is told the hand and the noise, and heeds them."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        network = TesNet(TesNetConfig(told=True)).eval()
        torch.nn.init.normal_(network.told.layer.weight, std=0.3)
    return network


def fresh_predictor(seed: int = 0, calibration: tuple[float, float] = (1.0, 0.0)) -> GraspPredictor:
    """A predictor with `fresh_network(seed)`."""
    network = fresh_network(seed)
    configuration = configuration_of(network)
    model = ModelInfo("tesnet", "0", "0" * 64, {}, configuration)
    return GraspPredictor(network, configuration, calibration, model, CPU)
