"""From a query to ranked grasps: owns the network, its device and the stage timings."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch

from tesnet import calibration, candidates, centring, cloud, collision, networks, notices, ranking, support, weights
from tesnet.errors import DeviceError, GaveUp, WeightsError
from tesnet.geometry import GraspSet, Pose
from tesnet.networks import Network
from tesnet.outline import Outline, outline
from tesnet.query import MAX_CANDIDATES, MAX_SEED, GraspQuery
from tesnet.result import REJECTIONS, GraspCounts, GraspResult, Reason
from tesnet.search import search
from tesnet.threads import Threads

GOOD_SCORE = 0.9
"""While the best score is lower, other candidates are searched for."""

FURTHER_SEARCHES = 4
"""At most so often, each time with four times as many approach points as the query names."""

MOST_SCORED = 10_000
"""Candidates in all further searches together, fewer where the hand may have fewer: who asks for many at once has had
them."""

_RANKINGS = 4
"""At most so often grasps are ranked, less those that turn out to hold posted points."""

_SEED_STEP = 0x9E3779B97F4A7C15
"""Between the seeds of one query's searches: queries whose seeds follow each other share none."""


GiveUp: TypeAlias = Callable[[], bool]
"""Whether nobody waits for a query's answer any more. It may take its time, as a caller does that has other work."""


@dataclass(frozen=True, slots=True)
class ModelInfo:
    """Which network answers.

    Args:
        name, version: of the weights; those of a network without weights never change.
        weights_sha256: of the file; None without one.
        card: data, seed and metrics of the training, as the weights' header tells them.
        configuration: network, preparation and candidates.
    """

    name: str
    version: str
    weights_sha256: str | None
    card: Mapping[str, Any]
    configuration: Mapping[str, Any]


class GraspPredictor:
    """Answers queries, one or several at a time; make it with `GraspPredictor.load`.

    Args:
        network: in evaluation mode, on `device`.
        configuration: sections `network`, `preparation` and `candidates`, as in a weights file's header.
        calibration: (a, b) of score = sigmoid(a * logit + b).
        model: what to tell about it.
        device: where everything is computed.
        num_threads: CPU threads of the whole process while no other one keeps the cores busy; None for torch's number.
    """

    def __init__(
        self,
        network: Network,
        configuration: Mapping[str, Any],
        calibration: tuple[float, float],
        model: ModelInfo,
        device: torch.device,
        num_threads: int | None = None,
    ) -> None:
        self.model = model
        self.device = device
        self._threads = Threads(num_threads)
        self._network = network
        self._calibration = calibration
        self._preparation = cloud.PreparationConfig(**configuration["preparation"])
        self._candidates = candidates.CandidateConfig.stored(configuration["candidates"])
        if self._candidates.centring is not None:  # fail here, not at the first query
            centring.shipped(self._candidates.centring, device)

    @classmethod
    def load(cls, path: Path, device: str = "cpu", num_threads: int | None = None) -> GraspPredictor:
        """A predictor from a weights file.

        Args:
            path: a `.safetensors` file written by `python -m training fit`.
            device: `cpu`, `cuda`, `cuda:1` ... or `auto`: the GPU when there is one.
            num_threads: CPU threads of the whole process, of which one alone computes while other processes keep the
                cores busy (`tesnet.threads`); None for torch's number.

        Raises:
            WeightsError: the file is missing, corrupted or does not fit its network.
            DeviceError: this machine does not have the device.
        """
        chosen = named_device(device)
        network, header = networks.load(path)
        try:
            sections = {name: dict(header.configuration[name]) for name in ("network", "preparation", "candidates")}
            model = ModelInfo(header.network, header.version, weights.sha256(path), header.training or {}, sections)
            return cls(network.to(chosen), sections, header.calibration, model, chosen, num_threads)
        except (KeyError, TypeError, ValueError) as error:
            why = f"its configuration is not of this version ({error}); get matching weights"
            raise WeightsError(path, why) from error

    @classmethod
    def without_weights(cls, name: str, device: str = "cpu", num_threads: int | None = None) -> GraspPredictor:
        """A predictor whose network learns nothing, such as `heuristic`.

        Raises:
            ValueError: a network that is unknown or has weights.
            DeviceError: this machine does not have the device.
        """
        if not networks.is_weightless(name):
            raise ValueError(f"network {name!r} has weights; load them from a file")
        chosen = named_device(device)
        network = networks.build(name).eval()
        rules = candidates.CandidateConfig(centring=None)
        sections = configuration_of(network) | {"candidates": asdict(rules)}
        model = ModelInfo(name, "1", None, {}, sections)
        return cls(network.to(chosen), sections, (1.0, 0.0), model, chosen, num_threads)

    @property
    def preparation(self) -> cloud.PreparationConfig:
        """How clouds are prepared."""
        return self._preparation

    def warm_up(self) -> None:
        """Answers one made-up query, so that the first real one is not slow."""
        rng = np.random.default_rng(0)
        square = rng.uniform(-0.05, 0.05, (4000, 2))
        side = rng.choice([-1.0, 1.0], (4000, 1)) * 0.02
        points = np.where(rng.random((4000, 1)) < 0.5, np.hstack([square, side]), np.hstack([side, square]))
        self.predict(GraspQuery(points, viewpoints=np.array([0.3, 0.2, 0.6])))

    def predict(self, query: GraspQuery, give_up: GiveUp | None = None) -> GraspResult:
        """Ranked grasps for a query, in the frame of its points. Equal queries have equal answers.

        Args:
            query: what is asked.
            give_up: asked between stages, in this thread; true ends the prediction.

        Raises:
            GaveUp: as `give_up` asked.
        """
        return self.predict_batch([query], [give_up])[0]

    @torch.inference_mode()
    def predict_batch(
        self, queries: Sequence[GraspQuery], give_up: Sequence[GiveUp | None] | None = None
    ) -> list[GraspResult]:
        """The answer to each query, as `predict` gives it; their clouds are encoded in one pass.

        Scores may differ from those of `predict` by the rounding of float32. The time of the shared pass is divided
        among the answers in proportion to their prepared points.

        Args:
            queries: what is asked.
            give_up: of each query, as in `predict`; the first that is true ends the whole batch.

        Raises:
            GaveUp: as one of `give_up` asked.
        """
        patience = [None] * len(queries) if give_up is None else give_up
        begun = []
        for asked in zip(queries, patience, strict=True):
            with self._threads.working():
                begun.append(self._propose(*asked))
        with self._threads.working():
            features = iter(self._encode([item for item in begun if isinstance(item, _Proposal)]))
        answers = []
        for item in begun:
            with self._threads.working():
                answers.append(self._answer(item, next(features)) if isinstance(item, _Proposal) else item)
        return answers

    def _propose(self, query: GraspQuery, give_up: GiveUp | None) -> _Proposal | GraspResult:
        """A query's prepared cloud and the candidates that are free of collision; where there are none, its answer."""
        clock = _Clock(give_up)
        rejected = dict.fromkeys(REJECTIONS, 0)
        query, corrected = calibration.calibrated(query)
        query, plane, said = support.settled(query)
        notes = [
            *notices.of_query(query, knows_hands=self._network.knows_hands),
            *corrected,
            *said,
            *notices.of_support(query),
        ]

        clock.check()
        prepared = cloud.prepare(query, self._preparation, self.device, plane, clock.check)
        self._synchronise()
        clock.lap("prepare")
        if prepared is not None:
            notes += notices.of_cloud(prepared, query, self._preparation)
        if prepared is None or len(prepared) < cloud.MINIMUM_POINTS:
            count = 0 if prepared is None else len(prepared)
            outside = prepared is None and len(query.points) > 0 and (plane is None or query.workspace is not None)
            reason: Reason = "no_points_in_workspace" if outside else "too_few_points"
            return _nothing(query, reason, (count, 0, 0), rejected, notes, clock)
        notes += notices.of_target(prepared, query, self._preparation)

        edges = cache(partial(outline, prepared, query))
        found = self._search(prepared, query, edges, clock)
        self._synchronise()
        clock.lap("candidates")
        if len(found.free) == 0:
            reason = "all_in_collision" if found.count else "no_candidates"
            sizes = (len(prepared), found.count, 0)
            notes += notices.of_answer(0.0, prepared, query)
            return _nothing(query, reason, sizes, rejected | found.rejected, notes, clock)
        return _Proposal(query, prepared, edges, found, notes, clock)

    def _search(
        self, prepared: cloud.PreparedCloud, query: GraspQuery, edges: Callable[[], Outline], clock: _Clock
    ) -> _Free:
        found = search(prepared, query, self._candidates, edges, clock.check)
        return _Free(found.candidates.select(found.is_free), len(found.candidates), found.rejected)

    def _encode(self, proposals: Sequence[_Proposal]) -> list[Any]:
        """The features of each proposal's cloud, whose clock is told its share of the pass."""
        if not proposals:
            return []
        for proposal in proposals:
            proposal.clock.check()
        started = time.perf_counter()
        features = self._network.encode_batch([proposal.prepared for proposal in proposals])
        self._synchronise()
        milliseconds_per_point = 1e3 * (time.perf_counter() - started) / sum(len(p.prepared) for p in proposals)
        for proposal in proposals:
            proposal.clock.add("network", milliseconds_per_point * len(proposal.prepared))
        return features

    def _answer(self, proposal: _Proposal, features: Any) -> GraspResult:
        """The ranked grasps of the best search for a proposal."""
        query, prepared, clock = proposal.query, proposal.prepared, proposal.clock
        clock.start()
        clock.check()
        found, scores = self._best_search(proposal, features)
        posted = cloud.posted_points(query, prepared.T_cloud_canonical, self.device)
        found, scores, ranked = _ranked_clear(posted, found, scores, query, clock)
        last = {"min_score": ranked.below_min_score, "duplicates": ranked.duplicates}
        rejected = dict.fromkeys(REJECTIONS, 0) | found.rejected | last
        grasps = _grasps(query, prepared, found.free, scores, ranked.indices)
        clock.lap("rank")
        best = float(scores.max()) if len(scores) else 0.0
        return GraspResult(
            grasps=grasps,
            counts=_counts(query, (len(prepared), found.count, len(found.free), len(grasps)), rejected),
            reason=_why_nothing(found) if len(grasps) == 0 else None,
            warnings=(*proposal.notes, *notices.of_answer(best, prepared, query)),
            timings_ms=clock.laps_ms,
        )

    def _best_search(self, proposal: _Proposal, features: Any) -> tuple[_Free, torch.Tensor]:
        """The search that holds the best score, of the proposal's and, while that scores no candidate well, of others.

        With the scores (C,) of its free candidates.
        """
        query, prepared, clock = proposal.query, proposal.prepared, proposal.clock
        found, scores = proposal.found, self._scores(features, prepared, proposal.found, clock)
        clock.lap("network")
        for number in range(1, FURTHER_SEARCHES + 1):
            # Where a search yields few candidates it has tried every approach point.
            enough = number * query.most_candidates > MOST_SCORED * query.candidate_limit / MAX_CANDIDATES
            if float(scores.max()) >= GOOD_SCORE or 2 * found.count < query.most_candidates or enough:
                break
            other = self._search(prepared, _further(query, number), proposal.edges, clock)
            self._synchronise()
            clock.lap("candidates")
            if len(other.free):
                other_scores = self._scores(features, prepared, other, clock)
                if float(other_scores.max()) > float(scores.max()):
                    found, scores = other, other_scores
                clock.lap("network")
        return found, scores

    def _scores(self, features: Any, prepared: cloud.PreparedCloud, found: _Free, clock: _Clock) -> torch.Tensor:
        """(F,) of the free candidates, of which so many are scored together that the clock is looked at often."""
        a, b = self._calibration
        logits = []
        for rows in torch.arange(len(found.free), device=self.device).split(self._network.scored_at_once):
            clock.check()
            logits.append(self._network.score(features, prepared, found.free.select(rows)))
        scores = torch.sigmoid(a * torch.cat(logits) + b)
        self._synchronise()
        return scores

    def _synchronise(self) -> None:
        if self.device.type == "cuda":  # or a stage's work would be counted in a later one
            torch.cuda.synchronize(self.device)


class _Clock:
    """Milliseconds by stage; a lap ends where the next one begins.

    Args:
        give_up: whether nobody waits any more for what is timed.
    """

    def __init__(self, give_up: GiveUp | None) -> None:
        self._give_up = give_up
        self.laps_ms = dict.fromkeys(("prepare", "candidates", "network", "rank"), 0.0)
        self.start()

    def start(self) -> None:
        self._last = time.perf_counter()

    def check(self) -> None:
        """Raise `GaveUp` where nobody waits any more. The time that asking takes is no stage's."""
        if self._give_up is None:
            return
        asked = time.perf_counter()
        if self._give_up():
            raise GaveUp
        self._last += time.perf_counter() - asked

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.add(name, 1e3 * (now - self._last))
        self._last = now

    def add(self, name: str, milliseconds: float) -> None:
        self.laps_ms[name] += milliseconds


@dataclass(frozen=True, eq=False, slots=True)
class _Free:
    """What a search found that meets nothing.

    Args:
        free: candidates without collision.
        count: candidates in all.
        rejected: pairs or candidates dropped, by step.
    """

    free: candidates.Candidates
    count: int
    rejected: dict[str, int]

    def only(self, clear: torch.Tensor) -> _Free:
        """What is left when of the free candidates only those of the mask (F,) are free after all."""
        blocked = int((~clear).sum())
        rejected = self.rejected | {"collision": self.rejected["collision"] + blocked}
        return _Free(self.free.select(clear), self.count, rejected)


@dataclass(frozen=True, eq=False, slots=True)
class _Proposal:
    """A query whose candidates are to be scored.

    Args:
        query: what is asked.
        prepared: its cloud.
        edges: finds its outline, once.
        found: at least one candidate without collision.
        notes: warnings for the answer.
        clock: the time of its stages.
    """

    query: GraspQuery
    prepared: cloud.PreparedCloud
    edges: Callable[[], Outline]
    found: _Free
    notes: list[str]
    clock: _Clock


def _ranked(found: _Free, scores: torch.Tensor, query: GraspQuery) -> ranking.Ranking:
    """The ranking of a search's free candidates, whose scores are (F,)."""
    return ranking.rank(
        scores,
        found.free.Ts_canonical_grasp,
        max_grasps=query.max_grasps,
        min_score=query.min_score,
        separation_translation=query.separation_translation,
        separation_rotation_deg=query.separation_rotation_deg,
    )


def _ranked_clear(
    posted: torch.Tensor, found: _Free, scores: torch.Tensor, query: GraspQuery, clock: _Clock
) -> tuple[_Free, torch.Tensor, ranking.Ranking]:
    """The ranking of grasps that hold none of the posted points (N, 3), and the search and scores that are left.

    Grasps are held against the points as they come to be ranked; from the `_RANKINGS`th time on, all of them.
    """
    for number in itertools.count(1):
        ranked = _ranked(found, scores, query)
        asked = (ranked.indices if number < _RANKINGS else torch.arange(len(scores))).to(scores.device)
        held = collision.holds(posted, found.free.select(asked), clock.check)
        if not bool(held.any()):
            break
        clear = torch.ones(len(scores), dtype=torch.bool, device=scores.device)
        clear[asked[held]] = False
        found, scores = found.only(clear), scores[clear]
    return found, scores, ranked


def _why_nothing(found: _Free) -> Reason:
    """Why a search whose candidates have been scored yields no grasp."""
    return "below_min_score" if len(found.free) else "all_in_collision"


def _further(query: GraspQuery, number: int) -> GraspQuery:
    """The query, for its further search of this number."""
    count = candidates.more_approach_points(query.num_approach_points)
    return query.but(num_approach_points=count, seed=(query.seed + number * _SEED_STEP) % (MAX_SEED + 1))


def configuration_of(network: Network) -> dict[str, dict[str, Any]]:
    """The configuration that the header of a newly trained network's weights carries, with today's candidates."""
    return {
        "network": asdict(network.config),
        "preparation": asdict(network.preparation),
        "candidates": asdict(candidates.CandidateConfig()),
    }


def named_device(name: str) -> torch.device:
    """The device that `auto`, `cpu`, `cuda` or `cuda:N` names; raises DeviceError where this machine lacks it."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
    except RuntimeError:
        raise DeviceError(f"device {name!r} is unknown; choose auto, cpu or cuda") from None
    if device.type not in ("cpu", "cuda"):
        raise DeviceError(f"device {name!r} is not supported; choose auto, cpu or cuda")
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise DeviceError(f"device {name!r}: torch sees {torch.cuda.device_count()} GPUs here; choose cpu or auto")
    return device


def _nothing(
    query: GraspQuery,
    reason: Reason,
    sizes: tuple[int, int, int],
    rejected: dict[str, int],
    notes: list[str],
    clock: _Clock,
) -> GraspResult:
    counts = _counts(query, (*sizes, 0), rejected)
    return GraspResult(GraspSet.empty(query.gripper), counts, reason, tuple(notes), clock.laps_ms)


def _counts(query: GraspQuery, sizes: tuple[int, int, int, int], rejected: dict[str, int]) -> GraspCounts:
    return GraspCounts(len(query.points), *sizes, rejected, query.ignored_points)


def _grasps(
    query: GraspQuery,
    prepared: cloud.PreparedCloud,
    free: candidates.Candidates,
    scores: torch.Tensor,
    indices: torch.Tensor,
) -> GraspSet:
    """The candidates at the indices (M,), back in the frame of the caller."""
    chosen = free.select(indices.to(scores.device))
    to_cloud = Pose(np.eye(3), query.offset) @ prepared.T_cloud_canonical
    return GraspSet(
        scores=scores[indices.to(scores.device)].cpu().double().numpy(),
        Ts_cloud_grasp=to_cloud.matrix @ chosen.Ts_canonical_grasp.cpu().double().numpy(),
        widths=chosen.openings(),
        approach_points=to_cloud.apply(prepared.points[chosen.approach].cpu().numpy()),
        contact_points=to_cloud.apply(prepared.points[chosen.contact].cpu().numpy()),
        gripper=query.gripper,
    )
