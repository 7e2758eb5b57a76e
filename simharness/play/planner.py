"""The harness as the service's client: an observation becomes a request, the answer a plan.

It knows the service through `client` alone.
"""

from __future__ import annotations

import json
import time
from types import TracebackType
from typing import TYPE_CHECKING, Any

import httpx

from client import GraspClient, GraspClientError
from simharness.errors import RunBroken, UsageError
from simharness.play.records import ModelRecord
from simharness.play.round import Plan
from simharness.sim.camera import Observation
from simharness.sim.protocol import query_about
from tesnet.query import GraspQuery

if TYPE_CHECKING:
    from typing_extensions import Self

DEFAULT_HAND = "franka"
REQUEST_TIMEOUT_S = 60.0


class HttpPlanner:
    """Plans grasps by asking a running service. A context manager that closes the connections.

    Args:
        url: where the service is.
        model: the network to ask for.
        max_grasps: grasps wanted for each observation.
        transport: replaces the network, for tests.
        gripper: name of the hand to ask for.
        calibrate: whether the service shall calibrate by the table in view.
        min_score: the least score of a grasp; None takes every one.

    Raises:
        UsageError: a URL that is not http or https.
    """

    def __init__(
        self,
        url: str,
        model: str,
        max_grasps: int,
        transport: httpx.BaseTransport | None = None,
        *,
        gripper: str = DEFAULT_HAND,
        calibrate: bool = False,
        min_score: float | None = None,
    ) -> None:
        try:
            self._client = GraspClient(url, timeout=REQUEST_TIMEOUT_S, transport=transport)
        except GraspClientError as error:
            raise UsageError(f"--url: {error}") from error
        self._url = url
        self._model = model
        self._max_grasps = max_grasps
        self._calibrate = calibrate
        self._always: dict[str, Any] = {"min_score": min_score}
        if gripper != DEFAULT_HAND:  # older services know no hand by name
            self._always["gripper"] = gripper

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._client.close()

    def plan(self, observation: Observation, seed: int) -> Plan:
        """Grasps in the world, best first; no request is made for a cloud without points.

        Raises:
            RunBroken: the service does not answer, or refuses what the harness sends.
        """
        if not len(observation.points_world):
            return Plan.nothing("no_points_in_workspace")
        start = time.perf_counter()
        options = _options(query_about(observation, seed, calibrate=self._calibrate)) | self._always
        try:
            reply = self._client.grasps(
                observation.points_world,
                **options,
                max_grasps=self._max_grasps,
                model=self._model,
            )
        except GraspClientError as error:
            raise RunBroken(f"the service at {self._url} gave no answer: {error}") from error
        latency_ms = 1000 * (time.perf_counter() - start)
        response = {key: value for key, value in reply.to_dict().items() if key != "grasps"}
        return Plan(reply.poses, reply.scores, reply.widths, latency_ms, response)

    def model(self) -> tuple[ModelRecord, dict[str, Any]]:
        """The network that answers, and the whole of the service's `/model` document.

        Raises:
            RunBroken: the service does not answer.
            UsageError: it has no network of that name.
        """
        try:
            document: dict[str, Any] = json.loads(self._client.model().text)
        except GraspClientError as error:
            raise RunBroken(f"the service at {self._url} gave no answer: {error}") from error
        networks = {entry["name"]: entry for entry in document["models"]}
        if self._model not in networks:
            raise UsageError(
                f"--model {self._model}: the service at {self._url} has {', '.join(networks)}; name one of these"
            )
        entry = networks[self._model]
        return ModelRecord(entry["name"], entry["version"], entry["weights_sha256"]), document


def _options(query: GraspQuery) -> dict[str, Any]:
    """What a query of the protocol tells of its cloud, by the names of the wire."""
    box = query.workspace
    return {
        "calibrate": query.calibrate or None,  # older services do not know it
        "viewpoint": query.viewpoints,
        "up": query.up,
        "support_height": query.support_height,
        "workspace": None if box is None else {"min": box.minimum, "max": box.maximum},
        "seed": query.seed,
    }
