"""`python -m tests.regenerate_golden`: print how answers differ from the stored ones, then store them.

With `--check` nothing is stored. The clouds are stored with the answers, so that they never change by themselves; what
is asked about them is in `CASES`. A case or a cloud that is new is added, and one that is gone is dropped.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tesnet import weights
from tesnet.geometry import PANDA, Box
from tesnet.hands import HANDS
from tesnet.predictor import GraspPredictor
from tesnet.result import REJECTIONS
from tests.tesnet import scenes
from tests.tesnet.raycast import OVERHEAD, TABLE, THINGS, Bowl, Slab, around, cast

GOLDEN = Path(__file__).parent / "tesnet" / "data" / "golden.npz"

GRID = 5e-5
"""Metres to which the coordinates of a stored cloud are rounded."""

Arrays = dict[str, NDArray[Any]]
"""Of the golden file: `weights_sha256`; `CLOUD/points` in steps of the grid; `CASE/...` as `answer` has them."""


class Case(NamedTuple):
    """A cloud's name and the options of a query about it."""

    cloud: str
    options: Mapping[str, Any]


def _of_boxes() -> NDArray[np.float64]:
    return scenes.tabletop(5, count=20_000)


def _with_table() -> NDArray[np.float64]:
    """The boxes and cylinders on the table that they stand on, as far as it is not hidden."""
    rng = np.random.default_rng(6)
    seen = cast((TABLE, *THINGS), scenes.CAMERA[None], rng, noise=0.0005).points
    near = np.abs(seen[:, :2]).max(axis=1) < 0.25
    kept: NDArray[np.float64] = seen[near & ((seen[:, 2] > 0.01) | (rng.random(len(seen)) < 0.3))]
    return kept


def _of_a_card() -> NDArray[np.float64]:
    """A box 12.5 mm high: too low for pairs as deep as `min_depth`."""
    points, normals = scenes.box_surface((0.05, 0.07, 0.0125), 20_000, np.random.default_rng(0))
    return scenes.seen_from(points + 0.00625 * scenes.UP, normals, scenes.CAMERA)


def _from_above() -> NDArray[np.float64]:
    """A box and a bowl, each seen from straight above: of the box no wall."""
    things = (Slab((-0.05, 0.0, 0.0), (0.05, 0.04, 0.06)), Bowl((0.06, 0.0, 0.0), 0.035, 0.004))
    seen = cast((TABLE, *things), OVERHEAD, np.random.default_rng(0), noise=0.0003).points
    kept: NDArray[np.float64] = seen[np.abs(seen[:, :2]).max(axis=1) < 0.13]
    return kept


RING = around(3)
"""Where the three cameras of `_from_three_sides` stand."""


def _from_three_sides() -> NDArray[np.float64]:
    return cast(THINGS, RING, np.random.default_rng(1)).points[::2]


CLOUDS: Mapping[str, Callable[[], NDArray[np.float64]]] = MappingProxyType(
    {
        "boxes": _of_boxes,
        "table": _with_table,
        "card": _of_a_card,
        "above": _from_above,
        "three sides": _from_three_sides,
    }
)
"""How each cloud was made; the stored one is what counts."""

_SEEN = {"viewpoints": scenes.CAMERA, "up": scenes.UP, "support_height": 0.0}
_LIFTED = _SEEN | {"support_height": -0.05}

CASES: Mapping[str, Case] = MappingProxyType(
    {
        "plain": Case("boxes", _SEEN),
        "nothing known": Case("boxes", {}),
        "workspace": Case(
            "boxes", _SEEN | {"workspace": Box(np.array([-0.04, -0.2, 0.0]), np.array([0.1, 0.08, 0.2]))}
        ),
        "listed hand": Case("boxes", _LIFTED | {"gripper": HANDS["robotiq_2f85"].gripper}),
        "sizes": Case(
            "boxes",
            _LIFTED | {"gripper": PANDA.with_sizes({"max_width": 0.06, "palm_breadth": 0.1, "finger_depth": 0.06})},
        ),
        "unseen": Case("boxes", _SEEN | {"unseen": "occupied"}),
        "shallow": Case("card", _SEEN),
        "outline": Case("above", {"viewpoints": OVERHEAD, "up": scenes.UP, "support_height": 0.0}),
        "viewpoints": Case("three sides", {"viewpoints": RING, "up": scenes.UP, "support_height": 0.0}),
        "up auto": Case("table", {"viewpoints": scenes.CAMERA, "up": "auto"}),
        "support auto": Case("table", {"viewpoints": scenes.CAMERA, "up": scenes.UP, "support_height": "auto"}),
    }
)


def answer(case: Case, points: NDArray[np.float32], predictor: GraspPredictor) -> Arrays:
    """What the predictor answers about a case's cloud."""
    query = scenes.ask(points, **{"max_grasps": 20, "max_candidates": 1000, **case.options})
    result = predictor.predict(query)
    counts = result.counts
    return {
        "counts": np.array([counts.prepared_points, counts.candidates, counts.collision_free, counts.returned]),
        "rejected": np.array([counts.rejected[name] for name in REJECTIONS]),
        "scores": result.grasps.scores,
        "Ts_cloud_grasp": result.grasps.Ts_cloud_grasp,
        "widths": result.grasps.widths,
        "approach_points": result.grasps.approach_points,
        "contact_points": result.grasps.contact_points,
    }


def shipped_predictor() -> GraspPredictor:
    """Of the default network."""
    return GraspPredictor.load(weights.default_weights())


def points_of(arrays: Arrays, cloud: str) -> NDArray[np.float32]:
    """(N, 3) metres of a stored cloud."""
    return (arrays[f"{cloud}/points"] * GRID).astype(np.float32)


def answers(stored_arrays: Arrays) -> Arrays:
    """The stored clouds, made where they are not stored yet, and what the shipped weights answer about them now."""
    predictor = shipped_predictor()
    found: Arrays = {"weights_sha256": np.array(predictor.model.weights_sha256)}
    for name, make in CLOUDS.items():
        key = f"{name}/points"
        found[key] = stored_arrays[key] if key in stored_arrays else np.rint(make() / GRID).astype(np.int16)
    for name, case in CASES.items():
        answered = answer(case, points_of(found, case.cloud), predictor)
        found |= {f"{name}/{field}": values for field, values in answered.items()}
    return found


def stored() -> Arrays:
    """What was answered when the golden file was written."""
    with np.load(GOLDEN, allow_pickle=False) as file:
        return dict(file)


def differences(before: Arrays, after: Arrays) -> list[str]:
    """One line for each array that differs."""
    lines = [f"{name}: dropped" for name in before if name not in after]
    for name in after:
        if name not in before or before[name].shape != after[name].shape:
            lines.append(f"{name}: shape {before[name].shape if name in before else None} -> {after[name].shape}")
        elif not np.array_equal(before[name], after[name]):
            if after[name].dtype.kind == "f":
                gap = float(np.abs(before[name] - after[name]).max())
                lines.append(
                    f"{name}: differs by up to {gap:.3g}; first {before[name].flat[0]:.6f} -> {after[name].flat[0]:.6f}"
                )
            else:
                lines.append(f"{name}: {before[name]} -> {after[name]}")
    return lines


def main(arguments: Sequence[str] | None = None) -> int:
    """Returns 0; with `--check` 1 when something differs."""
    parser = argparse.ArgumentParser(prog="python -m tests.regenerate_golden", description=__doc__)
    parser.add_argument("--check", action="store_true", help="store nothing")
    options = parser.parse_args(arguments)
    before = stored() if GOLDEN.exists() else {}
    after = answers(before)
    lines = differences(before, after)
    sys.stdout.write("\n".join(lines or ["nothing differs"]) + "\n")
    if lines and not options.check:
        GOLDEN.parent.mkdir(exist_ok=True)
        np.savez_compressed(GOLDEN, allow_pickle=False, **after)
    return int(bool(lines) and options.check)


if __name__ == "__main__":
    sys.exit(main())
