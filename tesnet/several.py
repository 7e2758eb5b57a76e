"""Several networks behind one door: each query is answered by the one that it names."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from tesnet.predictor import GiveUp, GraspPredictor, ModelInfo
from tesnet.query import GraspQuery
from tesnet.result import GraspResult


class GraspPredictors:
    """Predictors of networks of different names, which take turns.

    Args:
        predictors: at least one, all on one device; the first answers queries that name no network.
    """

    def __init__(self, predictors: Sequence[GraspPredictor]) -> None:
        self._predictors = {predictor.model.name: predictor for predictor in predictors}
        assert len(self._predictors) == len(predictors) > 0

    @property
    def models(self) -> tuple[ModelInfo, ...]:
        """The networks, the default one first."""
        return tuple(predictor.model for predictor in self._predictors.values())

    @property
    def device(self) -> torch.device:
        """Where everything is computed."""
        return next(iter(self._predictors.values())).device

    def warm_up(self) -> None:
        """Answers one made-up query with every network."""
        for predictor in self._predictors.values():
            predictor.warm_up()

    def predict_batch(
        self, queries: Sequence[GraspQuery], give_up: Sequence[GiveUp | None] | None = None
    ) -> list[GraspResult]:
        """The answer to each query, those of one network predicted together; `give_up` as in `GraspPredictor`.

        Raises:
            GaveUp: as one of `give_up` asked.
            KeyError: a query names a network that is not among `models`.
        """
        patience = [None] * len(queries) if give_up is None else give_up
        default = self.models[0].name
        named = [query.model or default for query in queries]
        answers: dict[int, GraspResult] = {}
        for name in dict.fromkeys(named):
            mine = [index for index, other in enumerate(named) if other == name]
            results = self._predictors[name].predict_batch(
                [queries[index] for index in mine], [patience[index] for index in mine]
            )
            answers |= zip(mine, results, strict=True)
        return [answers[index] for index in range(len(queries))]
