from __future__ import annotations

from dataclasses import replace
from functools import partial

import pytest

from tesnet import weights
from tesnet.errors import GaveUp
from tesnet.predictor import GraspPredictor
from tesnet.several import GraspPredictors
from tests.tesnet.scenes import tabletop_query


@pytest.fixture(scope="module")
def each() -> tuple[GraspPredictor, GraspPredictor]:
    return GraspPredictor.load(weights.default_weights()), GraspPredictor.without_weights("heuristic")


def test_a_mixed_batch_is_answered_by_the_network_that_each_query_names(
    each: tuple[GraspPredictor, GraspPredictor],
) -> None:
    several = GraspPredictors(each)
    several.warm_up()
    query = tabletop_query(max_candidates=200)
    names = ["heuristic", "tesnet", None, "heuristic"]
    answers = several.predict_batch([replace(query, model=name, seed=seed) for seed, name in enumerate(names)])
    for seed, (name, answer) in enumerate(zip(names, answers, strict=True)):
        alone = each[1] if name == "heuristic" else each[0]
        expected = alone.predict(replace(query, seed=seed)).grasps
        assert answer.grasps.scores == pytest.approx(expected.scores, abs=1e-5)
        assert answer.grasps.contact_points == pytest.approx(expected.contact_points)
    assert answers[0].grasps.scores[0] != answers[1].grasps.scores[0]


def test_each_query_keeps_its_own_patience_whichever_network_answers(
    each: tuple[GraspPredictor, GraspPredictor],
) -> None:
    query = tabletop_query(max_candidates=200)
    names = ("heuristic", "tesnet", "heuristic", "tesnet")
    asked = [0] * len(names)

    def patient(place: int) -> bool:
        asked[place] += 1
        return False

    queries = [replace(query, model=name) for name in names]
    GraspPredictors(each).predict_batch(queries, [partial(patient, place) for place in range(len(names))])
    assert min(asked) > 0
    for place in range(len(names)):
        patience = [None] * len(names)
        with pytest.raises(GaveUp):
            GraspPredictors(each).predict_batch(queries, [*patience[:place], lambda: True, *patience[place + 1 :]])


def test_the_networks_are_named_in_order_and_a_network_without_weights_has_no_checksum(
    each: tuple[GraspPredictor, GraspPredictor],
) -> None:
    several = GraspPredictors(each)
    assert [(model.name, model.weights_sha256 is None) for model in several.models] == [
        ("tesnet", False),
        ("heuristic", True),
    ]
    assert several.device == each[0].device


def test_a_query_for_a_network_that_is_not_there_is_an_error(each: tuple[GraspPredictor, GraspPredictor]) -> None:
    with pytest.raises(KeyError):
        GraspPredictors(each).predict_batch([tabletop_query(model="gpd")])


def test_a_network_with_weights_is_not_answered_without_them() -> None:
    with pytest.raises(ValueError, match="'edgegrasp' has weights; load them from a file"):
        GraspPredictor.without_weights("edgegrasp")
