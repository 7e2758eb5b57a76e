"""Environment variables -> Settings. The environment is an argument: what starts a process reads its own.

Of the machine it asks how many cores the process may use, which is how many threads it has unless told otherwise.
"""

from __future__ import annotations

import difflib
import ipaddress
import math
import os
import re
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, SecretStr, ValidationError, ValidationInfo, field_validator

from service.schemas import MAX_TIMEOUT_S

PREFIX = "GRASP_"
NetworkName = Literal[
    "tesnet", "tesnet-paper", "tesnet-euclidean", "gatv2", "edgegrasp", "pointnetgpd", "gpd", "heuristic"
]
NETWORK_NAMES = get_args(NetworkName)
"""Those of `tesnet.networks`, which loads torch."""

MAX_THREADS = 8
"""More threads than this do not make one cloud of usual size any faster."""


class InvalidSetting(Exception):
    """An environment variable that cannot be used.

    Args:
        variable: its name.
        why: the value and the remedy.
    """

    def __init__(self, variable: str, why: str) -> None:
        super().__init__(f"{variable} {why}")
        self.variable = variable


def default_threads() -> int:
    """Cores that this process may use, at most `MAX_THREADS`."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, int(min(cores, MAX_THREADS, cpu_quota())))


def cpu_quota(groups: Path = Path("/sys/fs/cgroup")) -> float:
    """Cores' worth of time that the container may use, infinite without a limit.

    More threads than that are all stopped for the rest of every tenth of a second once its time is used up.
    """
    for paths in (["cpu.max"], ["cpu/cpu.cfs_quota_us", "cpu/cpu.cfs_period_us"]):
        try:
            quota, period = " ".join((groups / path).read_text(encoding="ascii") for path in paths).split()
        except (OSError, ValueError):  # another version of control groups, or none
            continue
        return math.inf if quota in ("max", "-1") else int(quota) / int(period)
    return math.inf


class Settings(BaseModel):
    """How the service runs. Every field is read from `GRASP_<FIELD>`, the name in capitals."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    host: str = Field(
        default="127.0.0.1", min_length=1, description="Address to listen on; 0.0.0.0 for every interface."
    )
    port: int = Field(default=8000, ge=0, le=65535, description="TCP port, 0 to 65535; 0 picks a free one.")
    models: tuple[NetworkName, ...] = Field(
        default_factory=lambda: ("tesnet",),
        min_length=1,
        description=f"Networks to load, separated by commas, of {', '.join(NETWORK_NAMES)}. Requests without `model` "
        "are answered by tesnet or, where it is not loaded, by the first. Default: tesnet.",
    )
    weights: Mapping[NetworkName, Path] = Field(
        default_factory=dict,
        description="Weights file (.safetensors) of the only network, or NAME=PATH for each, separated by commas. "
        "Default: the files that are installed with the package.",
    )
    device: str = Field(
        default="auto", pattern=r"^(auto|cpu|cuda(:\d+)?)$", description="Compute device: auto, cpu, cuda or cuda:N."
    )
    num_threads: int = Field(
        default_factory=default_threads,
        ge=1,
        le=1024,
        description=f"CPU threads of the predictor. Default: the cores it may use, at most {MAX_THREADS}.",
    )
    max_points: int = Field(
        default=1_000_000, ge=1, le=100_000_000, description="Points in a request, 1 to 100,000,000."
    )
    max_body_mb: float = Field(
        default=64.0, gt=0, le=4096, description="MiB in a request's body, more than 0, at most 4096."
    )
    max_held_mb: float = Field(
        default=512.0,
        gt=0,
        le=1_048_576,
        description="MiB held for all requests together: bodies, clouds that wait, answers on their way; more than "
        "0. A lone request is always taken.",
    )
    queue_size: int = Field(
        default=32, ge=1, le=10_000, description="Requests that may wait for the predictor, 1 to 10,000."
    )
    max_batch: int = Field(
        default=1,
        ge=1,
        le=64,
        description="Waiting requests predicted together, 1 to 64; more than 1 does not pay on a CPU.",
    )
    client_places: int | None = Field(
        default=None,
        ge=1,
        le=10_000,
        description="Requests of one client that may wait, 1 to 10,000, where clients are known: by their API key, of "
        "which there is more than one, or behind trusted proxies by their address. Default: half of GRASP_QUEUE_SIZE.",
    )
    trusted_proxies: tuple[str, ...] = Field(
        default=(),
        description="Addresses or networks of proxies, separated by commas (10.0.0.0/8), whose X-Forwarded-For tells "
        "whose a request is. Default: none, and addresses mean nothing.",
    )
    request_timeout: float = Field(
        default=30.0,
        gt=0,
        le=MAX_TIMEOUT_S,
        description=f"Seconds to answer a request without X-Request-Timeout, at most {MAX_TIMEOUT_S:g}.",
    )
    drain_timeout: float = Field(
        default=25.0,
        ge=0,
        le=3600,
        description="Seconds to finish accepted requests after SIGTERM, 0 to 3600; the process ends at most 5 s later.",
    )
    api_keys: tuple[SecretStr, ...] = Field(
        default=(),
        description="Keys, separated by commas, one of which a request must bring as `Authorization: Bearer KEY` or "
        "`X-API-Key: KEY`; printable ASCII without spaces. Default: none, everybody is answered.",
    )
    cors_origins: tuple[str, ...] = Field(
        default=(),
        description="Origins of web pages, separated by commas, whose scripts may ask (https://robot.example), or *. "
        "Default: none.",
    )
    log_level: Literal["debug", "info", "warning", "error"] = Field(
        default="info", description="Least level of a log line: debug, info, warning or error."
    )

    @field_validator("log_level", "device", mode="before")
    @classmethod
    def _lower_case(cls, value: object) -> object:
        return value.strip().lower() if isinstance(value, str) else value

    @field_validator("models", mode="before")
    @classmethod
    def _names(cls, value: object) -> object:
        return [part.strip().lower() for part in value.split(",")] if isinstance(value, str) else value

    @field_validator("models")
    @classmethod
    def _default_first(cls, names: tuple[NetworkName, ...]) -> tuple[NetworkName, ...]:
        if len(set(names)) < len(names):
            raise ValueError("a network twice")
        return tuple(sorted(names, key=lambda name: name != "tesnet"))

    @field_validator("weights", mode="before")
    @classmethod
    def _by_network(cls, value: object, info: ValidationInfo) -> object:
        """A path alone is that of the only network."""
        models = info.data.get("models", ())
        if isinstance(value, str | Path) and not _names_network(str(value)):
            if len(models) > 1:
                raise ValueError("whose weights?")
            return dict.fromkeys(models, value)
        if isinstance(value, str):
            return dict(_named_path(part) for part in value.split(","))
        return value

    @field_validator("weights")
    @classmethod
    def _of_loaded(cls, paths: Mapping[NetworkName, Path], info: ValidationInfo) -> Mapping[NetworkName, Path]:
        if not paths.keys() <= set(info.data.get("models", ())):
            raise ValueError("weights of a network that is not loaded")
        return paths

    @field_validator("api_keys", "cors_origins", "trusted_proxies", mode="before")
    @classmethod
    def _split(cls, value: object) -> object:
        return [part.strip() for part in value.split(",")] if isinstance(value, str) else value

    @field_validator("api_keys")
    @classmethod
    def _printable(cls, keys: tuple[SecretStr, ...]) -> tuple[SecretStr, ...]:
        if not all(re.fullmatch(r"[!-~]+", key.get_secret_value()) for key in keys):
            raise ValueError("not printable")
        return keys

    @field_validator("cors_origins")
    @classmethod
    def _origins(cls, origins: tuple[str, ...]) -> tuple[str, ...]:
        if not all(re.fullmatch(r"\*|https?://[^/\s]+", origin) for origin in origins):
            raise ValueError("no origin")
        return origins

    @field_validator("trusted_proxies")
    @classmethod
    def _networks(cls, proxies: tuple[str, ...]) -> tuple[str, ...]:
        for proxy in proxies:
            ipaddress.ip_network(proxy)
        return proxies

    @property
    def places_of_a_client(self) -> int | None:
        """Requests of one client that may wait; None where clients are not told apart."""
        if len(self.api_keys) < 2 and not self.trusted_proxies:
            return None
        return self.client_places or max(1, self.queue_size // 2)

    @property
    def max_held_bytes(self) -> int:
        """Bytes held for all requests together."""
        return int(self.max_held_mb * 2**20)

    @property
    def max_body_bytes(self) -> int:
        """Bytes in a request's body."""
        return int(self.max_body_mb * 2**20)


def _names_network(text: str) -> bool:
    return text.partition("=")[0].strip().lower() in NETWORK_NAMES


def _named_path(text: str) -> tuple[str, str]:
    name, _, path = text.partition("=")
    if not path.strip():
        raise ValueError("no path")
    return name.strip().lower(), path.strip()


def load_settings(environment: Mapping[str, str]) -> Settings:
    """Settings of this process.

    Raises:
        InvalidSetting: names the variable, its value and the remedy.
    """
    values = {
        field: environment[variable]
        for variable, field in variables().items()
        if environment.get(variable, "") != ""  # an empty variable is how compose files and manifests say "default"
    }
    try:
        return Settings.model_validate(values)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        field = str(first["loc"][0])
        remedy = Settings.model_fields[field].description
        hint = ""
        if field == "port" and "://" in values[field]:
            hint = (
                " Kubernetes sets this variable for a Service named `grasp`: give the Service another name, or set "
                "enableServiceLinks: false."
            )
        value = "not usable" if field == "api_keys" else repr(values[field])  # a secret stays out of logs
        raise InvalidSetting(f"{PREFIX}{field.upper()}", f"is {value}; expected: {remedy}{hint}") from None


def variables() -> dict[str, str]:
    """Names of the environment variables, each with its field."""
    return {f"{PREFIX}{name.upper()}": name for name in Settings.model_fields}


def unknown_variables(environment: Mapping[str, str]) -> dict[str, str | None]:
    """`GRASP_*` variables that mean nothing, each with the closest known name."""
    known = variables()
    unknown = [name for name in environment if name.startswith(PREFIX) and name not in known]
    return {name: next(iter(difflib.get_close_matches(name, known, 1)), None) for name in sorted(unknown)}


def service_version() -> str:
    """Version of the installed package."""
    try:
        return version("tes-net")
    except PackageNotFoundError:  # run from a checkout that was not installed
        return "0+unknown"
