"""`python -m tests.regenerate_golden`: print how answers differ from the stored ones, then store them.

With `--check` nothing is stored. The small cloud is stored with the answers, so that it never changes by itself.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tesnet import weights
from tesnet.predictor import GraspPredictor
from tesnet.query import GraspQuery
from tests.tesnet import scenes

GOLDEN = Path(__file__).parent / "tesnet" / "data" / "golden.npz"

Arrays = dict[str, NDArray[Any]]


def predict(points: NDArray[np.float32]) -> Arrays:
    """What the shipped weights answer about the stored cloud."""
    predictor = GraspPredictor.load(weights.default_weights())
    query = GraspQuery(
        points, viewpoints=scenes.CAMERA, up=scenes.UP, support_height=scenes.SUPPORT_HEIGHT, max_grasps=20
    )
    result = predictor.predict(query)
    counts = result.counts
    return {
        "points": points,
        "weights_sha256": np.array(predictor.model.weights_sha256),
        "counts": np.array([counts.prepared_points, counts.candidates, counts.collision_free, counts.returned]),
        "scores": result.grasps.scores,
        "Ts_cloud_grasp": result.grasps.Ts_cloud_grasp,
        "approach_points": result.grasps.approach_points,
        "contact_points": result.grasps.contact_points,
    }


def stored() -> Arrays:
    """What was answered when the golden file was written."""
    with np.load(GOLDEN, allow_pickle=False) as file:
        return dict(file)


def differences(before: Arrays, after: Arrays) -> list[str]:
    """One line for each array that differs."""
    lines = []
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
    points = before.get("points", scenes.tabletop(5, count=20_000).astype(np.float32))
    after = predict(points)
    lines = differences(before, after)
    sys.stdout.write("\n".join(lines or ["nothing differs"]) + "\n")
    if lines and not options.check:
        GOLDEN.parent.mkdir(exist_ok=True)
        np.savez_compressed(GOLDEN, allow_pickle=False, **after)
    return int(bool(lines) and options.check)


if __name__ == "__main__":
    sys.exit(main())
