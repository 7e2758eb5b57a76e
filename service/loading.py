"""How a process that serves gets its predictor: from the settings, in the thread that will own it."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from service.batching import Predictor, PredictorFactory
    from service.settings import Settings


def predictor_factory(settings: Settings) -> PredictorFactory:
    """Loads the network that the settings name, when it is called; torch is loaded then and not before."""

    def make() -> Predictor:
        from tesnet.predictor import GraspPredictor  # noqa: PLC0415 - loads torch, while the port answers already
        from tesnet.weights import default_weights  # noqa: PLC0415 - the same

        weights = settings.weights or default_weights(settings.models)
        return GraspPredictor.load(weights, device=settings.device, num_threads=settings.num_threads)

    return make
