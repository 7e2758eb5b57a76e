"""How many replicas Ray Serve runs, and what the service's settings are in one of them. Knows nothing of Ray itself."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from service.settings import InvalidSetting, Settings, load_settings


class Replicas(BaseModel):
    """How many of the service Ray Serve runs, and each one's share of a machine."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    min_replicas: int = Field(default=1, ge=1, le=1000, description="Replicas that are always there, 1 to 1000.")
    max_replicas: int = Field(
        default=1, ge=1, le=1000, description="Replicas under load, from --min-replicas (the default) to 1000."
    )
    target_ongoing_requests: float = Field(
        default=2.0, gt=0, le=1000, description="Requests a replica should have; more of them add replicas."
    )
    downscale_delay: float = Field(
        default=120.0, ge=0, le=86400, description="Seconds of less load before replicas are taken away, 0 to 86400."
    )
    cpus: float = Field(default=1.0, gt=0, le=1024, description="CPU cores of a replica, more than 0.")
    gpus: float = Field(
        default=0.0, ge=0, le=64, description="GPUs of a replica: 0, a share such as 0.25, or a whole number."
    )

    @field_validator("gpus")
    @classmethod
    def _share_or_whole(cls, gpus: float) -> float:
        if gpus > 1 and gpus != int(gpus):
            raise ValueError("a share of a GPU is less than 1")
        return gpus

    @model_validator(mode="after")
    def _fits(self) -> Replicas:
        if self.max_replicas < self.min_replicas:
            raise ValueError(
                f"is {self.max_replicas}, less than --min-replicas, {self.min_replicas}; give at least that"
            )
        return self


def replicas_from(options: Mapping[str, Any]) -> Replicas:
    """The replicas that the command line asks for.

    Raises:
        InvalidSetting: an option is out of range.
    """
    given = {name: value for name, value in options.items() if value is not None}
    if "max_replicas" not in given and "min_replicas" in given:
        given["max_replicas"] = given["min_replicas"]
    try:
        return Replicas.model_validate(given)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        if not first["loc"]:
            raise InvalidSetting("--max-replicas", first["msg"].removeprefix("Value error, ")) from None
        field = str(first["loc"][0])
        remedy = Replicas.model_fields[field].description
        raise InvalidSetting(option_name(field), f"is {first['input']}; expected: {remedy}") from None


def replica_settings(environment: Mapping[str, str], replicas: Replicas) -> Settings:
    """The settings, where unset fitted to a replica's share of its machine: its cores, and a GPU only if it has one.

    Raises:
        InvalidSetting: a `GRASP_*` variable cannot be used.
    """
    settings = load_settings(environment)
    fitted: dict[str, Any] = {}
    if "num_threads" not in settings.model_fields_set:
        fitted["num_threads"] = max(1, int(replicas.cpus))
    if settings.device == "auto" and not replicas.gpus:
        fitted["device"] = "cpu"
    return settings.model_copy(update=fitted)


def option_name(field: str) -> str:
    """The command line's option for a field of `Replicas`."""
    return f"--{field.replace('_', '-')}"
