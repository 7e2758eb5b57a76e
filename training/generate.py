"""Simulated labels: scenes are made, observed and prepared as the service does it, and candidates are really tried.

Each scene is one job and one file, so a run that is stopped goes on where it was (`--resume`). Which scenes there are
in the end depends neither on the number of workers nor on their speed.
"""

from __future__ import annotations

import json
import math
import os
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from simharness.play.crew import Done, Emit, Work, crew
from simharness.sim.execute import label_strict, snapshot_of
from simharness.sim.hand import Hand
from simharness.sim.objects import ObjectModel, load_object_set
from simharness.sim.outcome_kinds import OUTCOME_KINDS
from simharness.sim.scene import Variety, describe, make_scene, scales_for
from simharness.sim.world import World
from tesnet import candidates, cloud, networks
from tesnet.networks import Network
from tesnet.search import search
from tesnet.whole_file import write_whole
from training.hands import drawn_hand
from training.viewing import Camera, Viewing, draw_viewing
from training.views import LabelledView, LabelsError, count_outcomes, number_of, save_scene, scene_files

_HEAR_S = 1.0
_HANDS_STREAM = 1_000_000
"""Beside the numbers of views: what is drawn of hands changes nothing else."""


@dataclass(frozen=True, slots=True)
class GenerateConfig:
    """What is generated.

    Args:
        scene: `packed` or `pile`.
        objects: names of object sets, joined with commas; each scene takes one of them.
        exclude: a list of objects that no scene may hold.
        seed: scene i of a seed is the same whatever else is asked for.
        views: camera views of each scene.
        labels_per_view: at most this many candidates of a view are tried.
        colliding_share: the part of them drawn from candidates that collide with the observed cloud; None draws from
            all candidates alike.
        mine: weights of a network; half of the candidates that do not collide are then drawn from the quarter that it
            scores best, where its mistakes become failed attempts.
        camera: preset, or `any` (`training.viewing`).
        sensor: its name, or `random` for a new one each view; None is the camera's own.
        gripper: name of the hand, or `random` for a new one each scene.
        model: the network whose preparation the clouds get; that of `mine` where there is one.
        scale: limits of the objects' scale for the Panda; None is the protocol's.
        mass: limits in kilograms; None is the protocol's one.
        friction: limits of the objects' coefficient; None is the protocol's one.
        things: at most this many objects stand on a table, every number alike; None draws up to five, five more often.
    """

    scene: Literal["packed", "pile"]
    objects: str
    exclude: Path | None = None
    seed: int = 0
    views: int = 2
    labels_per_view: int = 320
    colliding_share: float | None = 0.7
    mine: Path | None = None
    camera: Camera = "random"
    sensor: str | None = None
    gripper: str = "franka"
    model: str = "tesnet"
    scale: tuple[float, float] | None = None
    mass: tuple[float, float] | None = None
    friction: tuple[float, float] | None = None
    things: int | None = None


def generate(
    config: GenerateConfig, labels: int, workers: int, out: Path, resume: bool = False, ray: str | None = None
) -> dict[str, Any]:
    """Writes scenes to `out`, in their order, until they hold `labels` labels; returns and stores the account of them.

    Workers that have nothing else to do make scenes ahead; those after the one that reaches `labels` are not written.

    Args:
        config: what is generated.
        labels: how many.
        workers: how many scenes are made at a time.
        out: folder for the scenes.
        resume: whether to go on with what `out` holds.
        ray: address of a Ray cluster that makes the scenes; None for processes on this machine.

    Raises:
        LabelsError: `out` holds scenes and `resume` is not set, or scenes of another configuration.
        SimError: there is no such cluster, or a worker failed.
    """
    out.mkdir(parents=True, exist_ok=True)
    settings = {key: _plain(value) for key, value in asdict(config).items()}
    _claim(out, settings, resume)
    object_sets(config)  # fail here, not in a worker
    done = {number_of(path) for path in out.glob("scene_*.npz")}
    counts = np.zeros(len(OUTCOME_KINDS), dtype=np.int64)
    for path in scene_files([out]) if done else []:
        with np.load(path, allow_pickle=False) as stored:
            counts += stored["counts"]
    started, fresh, busy_s = time.monotonic(), 0, 0.0
    pending = (number for number in range(10**9) if number not in done)
    with crew(_Scenes(config), workers, ray) as makers, tqdm(total=labels, unit="label") as progress:
        progress.update(int(counts.sum()))
        given: deque[int] = deque()
        made: dict[int, _Made] = {}
        while counts.sum() < labels:
            while len(given) < 2 * workers:
                given.append(next(pending))
                makers.give(given[-1])
            while given[0] not in made:
                heard = makers.hear(_HEAR_S)
                made |= {message.job: message.result for message in heard if isinstance(message, Done)}
            number = given.popleft()
            scene = made.pop(number)
            write_whole(out / _file_name(number), scene.content)
            counts += scene.counts
            fresh += int(scene.counts.sum())
            busy_s += scene.seconds
            progress.update(int(scene.counts.sum()))
            progress.set_postfix(success=f"{counts[0] / max(1, counts.sum()):.3f}")
    account = {
        "settings": settings,
        "labels": int(counts.sum()),
        "scenes": len(list(out.glob("scene_*.npz"))),
        "outcomes": dict(zip(OUTCOME_KINDS, counts.tolist(), strict=True)),
        "this_run": {
            "labels": fresh,
            "seconds": round(time.monotonic() - started, 1),
            "labels_per_cpu_second": round(fresh / max(busy_s, 1e-9), 1),
        },
    }
    (out / "account.json").write_text(json.dumps(account, indent=2) + "\n")
    return account


def _plain(value: Any) -> Any:
    """A setting as JSON gives it back."""
    if isinstance(value, tuple):
        return list(value)
    return str(value) if isinstance(value, Path) else value


def _claim(out: Path, settings: dict[str, Any], resume: bool) -> None:
    """Binds the folder to one configuration."""
    path = out / "settings.json"
    if not path.exists():
        path.write_text(json.dumps(settings, indent=2) + "\n")
        return
    if not resume:
        raise LabelsError(f"{out} already holds scenes; add --resume to go on, or choose another folder")
    stored = json.loads(path.read_text())
    different = sorted(key for key in settings if stored.get(key) != settings[key])
    if different:
        raise LabelsError(
            f"{out} was made with other settings ({', '.join(f'{key}: {stored.get(key)!r}' for key in different)}); "
            "use the same ones, or another folder"
        )


def object_sets(config: GenerateConfig) -> list[tuple[ObjectModel, ...]]:
    """The object sets that scenes are made of, one per name in `config.objects`."""
    return [load_object_set(name, config.scene, exclude=config.exclude) for name in config.objects.split(",")]


@dataclass(frozen=True, eq=False, slots=True)
class _Made:
    """A labelled scene: its file's content, the counts of its outcomes, and the CPU seconds it took."""

    content: bytes
    counts: np.ndarray[Any, np.dtype[np.int64]]
    seconds: float


@dataclass(frozen=True, slots=True)
class _Scenes:
    """What a worker needs to make any scene."""

    config: GenerateConfig

    def name(self, job: int) -> str:
        """A scene in words."""
        return f"scene {job}"

    @contextmanager
    def begin(self) -> Iterator[Work[int]]:
        """The object sets, and what makes scenes of them."""
        os.nice(10)
        torch.set_num_threads(1)
        sets = object_sets(self.config)
        judge = Judge.of(self.config)

        def make(number: int, _: Emit) -> _Made:
            started = time.process_time()
            description, views = label_scene(self.config, sets, number, judge)
            counts = count_outcomes(view.outcomes.numpy() for view in views)
            with TemporaryDirectory(prefix="scene-") as folder:
                path = Path(folder) / _file_name(number)
                save_scene(path, description, views, judge.preparation)
                return _Made(path.read_bytes(), counts, time.process_time() - started)

        yield make


def _file_name(number: int) -> str:
    return f"scene_{number:07d}.npz"


@dataclass(frozen=True, eq=False, slots=True)
class Judge:
    """What clouds are prepared for, and what may say which candidates are worth trying.

    Args:
        preparation: of the clouds.
        network: that mines; None draws at random.
    """

    preparation: cloud.PreparationConfig
    network: Network | None = None

    @classmethod
    def of(cls, config: GenerateConfig) -> Judge:
        """That of a configuration."""
        if config.mine is None:
            return cls(networks.NETWORKS[config.model][0].preparation)
        network, header = networks.load(config.mine)
        return cls(cloud.PreparationConfig(**header.configuration["preparation"]), network)


def label_scene(
    config: GenerateConfig, sets: Sequence[tuple[ObjectModel, ...]], number: int, judge: Judge
) -> tuple[dict[str, Any], list[LabelledView]]:
    """Makes scene `number`, observes it from `config.views` cameras and tries candidates of each view.

    Hand, cameras and noise derive from the seed, the scene's number and the view's own; the description tells them, so
    that a view can be rendered again.
    """
    rng = _rng(config, number)
    models = sets[int(rng.integers(len(sets)))]
    known = drawn_hand(config.gripper, _rng(config, number, _HANDS_STREAM))
    with World() as world:
        hand = Hand(world, known)
        scene = make_scene(
            world,
            config.scene,
            models,
            rng,
            num_objects=_number_of_things(config, rng),
            scale_range=scales_for(config.scene, known.gripper, config.scale),
            variety=Variety(config.mass, config.friction),
        )
        description = describe(scene) | {"seed": config.seed, "number": number, "views": []}
        views: list[LabelledView] = []
        for number_of_view in range(config.views if scene.placed else 0):
            rng = _rng(config, number, number_of_view)
            viewing = draw_viewing(config.camera, config.sensor, rng)
            view = _label_view(world, hand, viewing, config, rng, judge)
            if view is not None:
                views.append(view)
                description["views"].append(viewing.describe())
        return description, views


def _number_of_things(config: GenerateConfig, rng: np.random.Generator) -> int:
    if config.things is not None:
        return int(rng.integers(config.things)) + 1
    return int(rng.choice([1, 2, 3, 4, 5, 5]))  # fewer too: a table that is being cleared holds fewer and fewer


def _rng(config: GenerateConfig, *numbers: int) -> np.random.Generator:
    return np.random.default_rng([config.seed, 0 if config.scene == "packed" else 1, *numbers])


def _label_view(
    world: World,
    hand: Hand,
    viewing: Viewing,
    config: GenerateConfig,
    rng: np.random.Generator,
    judge: Judge,
) -> LabelledView | None:
    looked = viewing.look(world, int(rng.integers(2**31)), hand.gripper, judge.preparation)
    if looked is None:
        return None
    query, prepared = looked
    searched = search(prepared, query, candidates.CandidateConfig())
    found, free = searched.candidates, searched.is_free
    chosen = _choose(prepared, found, free, config, rng, judge.network)
    if len(chosen) == 0:
        return None
    which = torch.from_numpy(chosen)
    picked = found.select(which)
    Ts_world_grasp = prepared.T_cloud_canonical.matrix @ picked.Ts_canonical_grasp.double().numpy()
    with snapshot_of(world) as snapshot:
        kinds = label_strict(world, hand, Ts_world_grasp, picked.openings(), snapshot)
    return LabelledView(
        cloud=prepared,
        poses=picked.Ts_canonical_grasp,
        widths=picked.widths,
        approach=picked.approach,
        contact=picked.contact,
        outcomes=torch.tensor([OUTCOME_KINDS.index(kind) for kind in kinds], dtype=torch.uint8),
        collision_free=free[which],
        scene=config.scene,
        gripper=hand.gripper,
        sensor=viewing.sensor,
    )


def _choose(
    prepared: cloud.PreparedCloud,
    found: candidates.Candidates,
    free: torch.Tensor,
    config: GenerateConfig,
    rng: np.random.Generator,
    network: Network | None,
) -> NDArray[np.int64]:
    """Indices of the candidates to try, in order: free ones and some that collide with the observed cloud."""
    if config.colliding_share is None:
        return np.sort(rng.permutation(len(found))[: config.labels_per_view])
    clear, colliding = (np.flatnonzero(mask.numpy()) for mask in (free, ~free))
    chosen_colliding = rng.permutation(colliding)[: round(config.labels_per_view * config.colliding_share)]
    num_clear = config.labels_per_view - len(chosen_colliding)
    mined = np.empty(0, dtype=np.int64)
    if network is not None and len(clear):
        with torch.inference_mode():
            logits = network.score(networks.encode(network, prepared), prepared, found.select(free))
        best = clear[logits.argsort(descending=True)[: math.ceil(len(clear) / 4)].numpy()]
        mined = rng.permutation(best)[: num_clear // 2]
    others = rng.permutation(np.setdiff1d(clear, mined))[: num_clear - len(mined)]
    return np.sort(np.concatenate([mined, others, chosen_colliding]))
