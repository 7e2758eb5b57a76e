"""How many replicas, and the settings of one: values only, no Ray."""

from __future__ import annotations

import pytest

from service.deploy.replicas import Replicas, replica_settings, replicas_from
from service.settings import InvalidSetting


def test_one_number_of_replicas_is_a_fixed_one() -> None:
    replicas = replicas_from({"min_replicas": 3, "max_replicas": None})
    assert (replicas.min_replicas, replicas.max_replicas) == (3, 3)
    assert replicas_from({}) == Replicas()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"min_replicas": 0}, "--min-replicas is 0; expected: .* 1 to 1000"),
        ({"min_replicas": 4, "max_replicas": 2}, "--max-replicas is 2, less than --min-replicas, 4"),
        ({"cpus": 0.0}, "--cpus is 0.0; expected: .* more than 0"),
        ({"gpus": -1.0}, "--gpus is -1.0"),
        ({"gpus": 1.5}, "--gpus is 1.5; expected: .* or a whole number"),
        ({"target_ongoing_requests": float("nan")}, "--target-ongoing-requests is nan"),
        ({"downscale_delay": -1.0}, "--downscale-delay is -1.0; expected: Seconds"),
    ],
)
def test_an_option_that_cannot_be_used_is_named_with_its_remedy(options: dict[str, float], words: str) -> None:
    with pytest.raises(InvalidSetting, match=words):
        replicas_from(options)


def test_a_replica_uses_its_share_of_the_machine_unless_it_is_told_otherwise() -> None:
    settings = replica_settings({}, Replicas(cpus=2.5))
    assert (settings.num_threads, settings.device) == (2, "cpu")
    assert replica_settings({}, Replicas(cpus=0.5)).num_threads == 1
    assert replica_settings({}, Replicas(gpus=0.25)).device == "auto"
    told = replica_settings({"GRASP_NUM_THREADS": "3", "GRASP_DEVICE": "cuda:1"}, Replicas())
    assert (told.num_threads, told.device) == (3, "cuda:1")
