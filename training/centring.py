"""The network that centres hands: samples of walls that are known, from the archive's scenes, and the fit to them.

Where a thing's walls lie between two fingers needs no simulation: rays tell. So every scene of the archive, seen again
from its cameras and from others, gives candidates by the hundred whose hand passes at some places and not at others.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, l1_loss

from simharness.sim.objects import ObjectModel
from simharness.sim.scene import restore_scene
from simharness.sim.world import World
from tesnet import centring, weights
from tesnet.candidates import CandidateConfig, Candidates, at_rest, contact_places, generate
from tesnet.cloud import PreparationConfig, PreparedCloud
from training.archive import SceneFile, for_each_scene
from training.parts import ArchivedScene
from training.samples import descend, read_samples, write_samples
from training.viewing import MoreViews

Floats = NDArray[np.float32]

_MORE_VIEWS = MoreViews(1, "any", "random")
_CANDIDATES = 100
"""Of each view."""

_ACROSS, _DEEP = 7, 12
"""Rays of each candidate: so many across a finger's breadth, so many between palm and tips."""

_SAME_WALL = 0.012
"""The contact point's wall is met no farther from it than this."""

EPOCHS = 16

CLEARANCE = 0.5
"""A hand passes where this is left beside each finger, in the places' unit."""

_WITHHELD = 0.15
"""Of the samples so many are shown without what `up` tells."""


def learn_centring(
    archive: Path,
    objects: str,
    samples: Path,
    out: Path,
    *,
    scenes: int | None = None,
    workers: int = 1,
    epochs: int = EPOCHS,
    seed: int = 0,
    version: str = "0",
) -> dict[str, Any]:
    """Draws samples from an archive's scenes and fits a network to them; see `sample` and `fit`."""
    drawn = sample(archive, objects, samples, workers, scenes=scenes, seed=seed)
    return drawn | fit(samples, out, epochs=epochs, seed=seed, version=version)


def sample(
    archive: Path, objects: str, out: Path, workers: int = 1, *, scenes: int | None = None, seed: int = 0
) -> dict[str, Any]:
    """Writes what is seen and where the walls are, of candidates in an archive's scenes, as files in `out`.

    Files already there are left alone, so that a stopped run goes on.

    Args:
        archive: folder of `labels_*.npz`.
        objects: the object sets that the scenes were made of, joined with commas.
        out: folder for the files.
        workers: processes.
        scenes: so many, drawn from the whole archive; None for all.
        seed: of the draw, of new cameras and of the candidates.

    Raises:
        LabelsError: no archive, or objects that the sets do not hold.
        SimError: a worker failed.
    """
    make = partial(_sample_scene, seed=seed)
    return {"scenes": for_each_scene(archive, objects, make, out, "walls", workers, scenes=scenes, seed=seed)}


def _sample_scene(job: SceneFile, models: Mapping[str, ObjectModel], *, seed: int) -> None:
    found = list(_of_scene(job.scene, models, seed))
    seen = np.concatenate([np.zeros((0, centring.SEEN), np.float32), *(part for part, _ in found)])
    walls = np.concatenate([np.zeros((0, 2), np.float32), *(part for _, part in found)])
    write_samples(job.path, seen=seen.astype(np.float16), walls=walls)


def _of_scene(scene: ArchivedScene, models: Mapping[str, ObjectModel], seed: int) -> Iterator[tuple[Floats, Floats]]:
    """What is seen (C, SEEN) and where the walls are (C, 2), of each view of a scene."""
    if not scene.views:
        return
    rng = np.random.default_rng([seed, *(crc32(view.outcomes.tobytes()) for view in scene.views)])
    hand = scene.views[0].gripper
    with World() as world:
        restore_scene(world, scene.description, models)
        for viewing in [view.viewing for view in scene.views] + _MORE_VIEWS.draw(rng):
            looked = viewing.look(world, int(rng.integers(2**31)), hand, PreparationConfig())
            if looked is None:
                continue
            query, prepared = looked
            found, _ = generate(prepared, query, CandidateConfig())
            some = found.select(torch.from_numpy(rng.permutation(len(found))[:_CANDIDATES]))
            resting = at_rest(prepared, some)
            walls = _walls(world, prepared, resting)
            known = np.isfinite(walls).all(axis=1)
            yield centring.seen_between(prepared, resting).numpy()[known], walls[known]


def _walls(world: World, prepared: PreparedCloud, candidates: Candidates) -> Floats:
    """(C, 2) where the thing that the contact point is on begins and ends between the fingers, from the contact point.

    In the places' unit; NaN where no thing is met near it.
    """
    hand = candidates.gripper
    near = contact_places(prepared, candidates).double().numpy()
    Ts = prepared.T_cloud_canonical.matrix @ candidates.Ts_canonical_grasp.double().numpy()
    half, far = hand.finger_breadth / 2, hand.max_width * 1.2
    x, z = np.meshgrid(np.linspace(-half, half, _ACROSS), np.linspace(hand.palm_front, hand.tip_offset, _DEEP))
    walls = np.full((len(Ts), 2), np.nan, dtype=np.float32)
    for row, T in enumerate(Ts):
        ends = [
            np.stack([x.ravel(), np.full(x.size, y), z.ravel()], axis=1) @ T[:3, :3].T + T[:3, 3] for y in (far, -far)
        ]
        body, way = world.first_hits(ends[0], ends[1])
        y = far - 2 * far * way
        is_thing = np.isin(body, world.objects)
        if not is_thing.any():
            continue
        first = np.where(is_thing, np.abs(y - near[row]), np.inf).argmin()
        if abs(y[first] - near[row]) > _SAME_WALL:
            continue
        other, back = world.first_hits(ends[1], ends[0])
        behind = other == body[first]
        if not behind.any():
            continue
        walls[row] = y[body == body[first]].max() - near[row], (2 * far * back[behind] - far).min() - near[row]
    return walls / np.float32(centring.place_unit(hand))


def fit(samples: Path, out: Path, *, epochs: int = EPOCHS, seed: int = 0, version: str = "0") -> dict[str, Any]:
    """Fits a network to all samples in a folder, writes it to `out` and returns how often hands pass, held out.

    Things that do not fit into the hand teach where it does not pass; how often it passes is told of the others.

    Args:
        samples: folder of `sample`.
        out: the weights file.
        epochs: passes over the samples.
        seed: of initial values, order and what is withheld.
        version: that the weights' header carries.

    Raises:
        LabelsError: the folder holds no samples.
    """
    known = read_samples(samples, "walls")
    seen, walls = known.columns["seen"], known.columns["walls"]
    torch.manual_seed(seed)
    network = centring.Centring()
    train, test = known.train, known.held_out
    network.mean = seen[train].float().mean(dim=0)
    network.spread = seen[train].float().std(dim=0) + 0.05

    def loss_of(rows: Tensor) -> Tensor:
        shown = seen[rows].float()
        withheld = torch.rand(len(shown)) < _WITHHELD
        shown[withheld, -centring.BY_HAND + 1 : -centring.BY_HAND + 4] = 0.0
        return _loss(network, shown, walls[rows])

    optimiser = torch.optim.AdamW(network.parameters(), lr=1e-3, weight_decay=1e-3)
    descend(train, loss_of, optimiser, partial(torch.optim.lr_scheduler.CosineAnnealingLR, optimiser), epochs)
    network.eval()
    measures = _measures(network, seen[test].float(), walls[test])
    card = {"samples": len(train), "seed": seed, "epochs": epochs, "held_out": measures}
    header = weights.Header(centring.NAME, version, {"hidden": network.hidden}, training=card)
    weights.save(out, network.state_dict(), header)
    return card


def _fits(walls: Tensor) -> Tensor:
    return walls[:, 0] - walls[:, 1] < 2 * (centring.OPENING - CLEARANCE)


def _passes(walls: Tensor, places: Tensor, clearance: float = 0.0) -> Tensor:
    near, far = walls[:, :1], walls[:, 1:]
    return (near - places <= centring.OPENING - clearance) & (places - far <= centring.OPENING - clearance)


def _loss(network: centring.Centring, seen: Tensor, walls: Tensor) -> Tensor:
    logits, middle = network(seen)
    passes, fits = _passes(walls, centring.PLACES, CLEARANCE), _fits(walls)
    astray = l1_loss(middle[fits], walls[fits].mean(dim=1), reduction="sum") / fits.sum().clamp(min=1)
    return 4 * binary_cross_entropy_with_logits(logits, passes.float()) + astray / 5


def _measures(network: centring.Centring, seen: Tensor, walls: Tensor) -> dict[str, float]:
    with torch.inference_mode():
        chosen = network.place(seen)[:, None]
    fits = _fits(walls)
    passes, wide = _passes(walls, chosen)[:, 0][fits], (walls[:, 0] - walls[:, 1] > 1.5 * centring.OPENING)[fits]
    shares = {"passes": passes, "passes_over_3_4": passes[wide]}
    return {"count": len(seen)} | {name: round(float(of.float().mean()), 4) for name, of in shares.items() if len(of)}
