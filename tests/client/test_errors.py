"""Errors that can be sent from one process to another, and have a class a status."""

from __future__ import annotations

import pickle
from typing import TYPE_CHECKING

import pytest

import client

if TYPE_CHECKING:
    pass


@pytest.mark.parametrize("error", [client.InvalidArgument("points", "bad"), client.UnexpectedResponse("odd", 200)])
def test_errors_survive_the_way_back_from_a_worker_process(error: Exception) -> None:
    same = pickle.loads(pickle.dumps(error))
    assert type(same) is type(error)
    assert (str(same), vars(same)) == (str(error), vars(error))
