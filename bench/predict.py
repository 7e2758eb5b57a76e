"""Speed of the predictor alone, stage by stage: `python -m bench.predict --threads 2`.

With `--neighbours N` also beside as many busy processes, and how many times longer that takes.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
import torch

from bench.neighbours import neighbours
from bench.scene import SUPPORT_HEIGHT, UP, WORKSPACE_MAXIMUM, WORKSPACE_MINIMUM, Scene, five_objects
from bench.table import processor, table
from tesnet.geometry import Box
from tesnet.predictor import GraspPredictor
from tesnet.query import GraspQuery
from tesnet.result import GraspResult
from tesnet.weights import default_weights

STAGES = ("prepare", "candidates", "network", "rank")


def query(scene: Scene, max_candidates: int, num_approach_points: int) -> GraspQuery:
    """What the harness would ask of this scene."""
    return GraspQuery(
        points=scene.points_world,
        viewpoints=scene.viewpoint_world,
        up=np.array(UP),
        workspace=Box(np.array(WORKSPACE_MINIMUM), np.array(WORKSPACE_MAXIMUM)),
        support_height=SUPPORT_HEIGHT,
        max_candidates=max_candidates,
        num_approach_points=num_approach_points,
    )


def measure(
    predictor: GraspPredictor, asked: GraspQuery, runs: int, batch: int = 1
) -> tuple[GraspResult, dict[str, list[float]]]:
    """The answer, and milliseconds a cloud of every run by stage; `total` is a cloud's share of the whole call."""
    samples: dict[str, list[float]] = defaultdict(list)
    together = [asked] * batch
    result = predictor.predict_batch(together)[0]
    for _ in range(runs):
        start = time.perf_counter()
        result = predictor.predict_batch(together)[0]
        total = (time.perf_counter() - start) * 1e3 / batch
        for stage in STAGES:
            samples[stage].append(result.timings_ms[stage])
        samples["total"].append(total)
    return result, samples


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--threads", type=int, default=2, help="CPU threads of the predictor")
    parser.add_argument("--device", default="cpu", help="cpu, cuda or auto")
    parser.add_argument("--runs", type=int, default=50, help="measured runs, after one that is not")
    parser.add_argument("--points", type=int, default=20_000, help="points in the cloud")
    parser.add_argument("--candidates", type=int, default=1_500, help="most candidates")
    parser.add_argument("--approach-points", type=int, default=32, help="approach points")
    parser.add_argument("--batch", type=int, default=1, help="clouds predicted together; times are a cloud's share")
    parser.add_argument("--neighbours", type=int, default=0, help="busy processes to measure beside as well")
    parser.add_argument("--weights", type=Path, help="weights file instead of the one that is installed")
    arguments = parser.parse_args()

    weights = arguments.weights or default_weights()
    predictor = GraspPredictor.load(weights, device=arguments.device, num_threads=arguments.threads)
    predictor.warm_up()
    asked = query(five_objects(arguments.points), arguments.candidates, arguments.approach_points)
    result, samples = measure(predictor, asked, arguments.runs, arguments.batch)

    counts = result.counts
    print(f"{processor()}, device {arguments.device}, {arguments.threads} threads, torch {torch.__version__}")
    print(
        f"{counts.points} points, {counts.prepared_points} prepared, {counts.candidates} candidates, "
        f"{counts.collision_free} free of collision, {counts.returned} returned; {arguments.runs} runs\n"
    )
    print(table(samples))
    if arguments.neighbours:
        with neighbours(arguments.neighbours):
            _, beside = measure(predictor, asked, arguments.runs, arguments.batch)
        print(f"\nbeside {arguments.neighbours} busy processes\n\n{table(beside)}\n")
        times = np.percentile(beside["total"], [50, 95]) / np.percentile(samples["total"], [50, 95])
        print(f"beside / alone: median {times[0]:.2f}, p95 {times[1]:.2f}")


if __name__ == "__main__":
    main()
