"""How a process that serves gets its predictors: from the settings, in the thread that will own them."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from service.batching import Predictor, PredictorFactory
    from service.settings import NetworkName, Settings
    from tesnet.predictor import GraspPredictor


def predictor_factory(settings: Settings) -> PredictorFactory:
    """Loads the networks that the settings name, when it is called; torch is loaded then and not before.

    What it makes raises `WeightsError` for weights that are missing, damaged or another network's.
    """

    def make() -> Predictor:
        from tesnet.several import GraspPredictors  # noqa: PLC0415 - loads torch, while the port answers already

        return GraspPredictors([_load(name, settings) for name in settings.models])

    return make


def _load(name: NetworkName, settings: Settings) -> GraspPredictor:
    from tesnet.errors import WeightsError  # noqa: PLC0415 - in `make` torch is wanted
    from tesnet.networks import is_weightless  # noqa: PLC0415 - the same
    from tesnet.predictor import GraspPredictor  # noqa: PLC0415 - the same
    from tesnet.weights import default_weights  # noqa: PLC0415 - the same

    path = settings.weights.get(name)
    if path is None and is_weightless(name):
        return GraspPredictor.without_weights(name, settings.device, settings.num_threads)
    path = path or default_weights(name)
    predictor = GraspPredictor.load(path, settings.device, settings.num_threads)
    if predictor.model.name != name:
        raise WeightsError(path, f"holds {predictor.model.name}, not {name}; name it so in GRASP_MODELS")
    return predictor
