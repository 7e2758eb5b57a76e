from __future__ import annotations

import math
import os
from pathlib import Path

import pytest

from service import settings as settings_module
from service.settings import (
    MAX_THREADS,
    NETWORK_NAMES,
    InvalidSetting,
    Settings,
    cpu_quota,
    default_threads,
    load_settings,
    unknown_variables,
)
from tesnet import networks


def test_an_empty_environment_gives_the_documented_defaults() -> None:
    settings = load_settings({})
    assert (settings.host, settings.port, settings.device) == ("127.0.0.1", 8000, "auto")
    assert (settings.max_points, settings.max_body_bytes) == (1_000_000, 64 * 2**20)
    assert settings.request_timeout == 30
    assert 1 <= settings.num_threads <= (os.cpu_count() or 1)


def test_every_value_is_text_and_an_empty_one_means_the_default() -> None:
    settings = load_settings(
        {
            "GRASP_PORT": "0",
            "GRASP_WEIGHTS": "/models/a.safetensors",
            "GRASP_DEVICE": "CUDA:1",
            "GRASP_NUM_THREADS": "",
            "GRASP_MAX_BODY_MB": "0.5",
            "GRASP_MAX_BATCH": "8",
            "OTHER": "x",
        }
    )
    assert (settings.port, settings.device) == (0, "cuda:1")
    assert settings.weights == {"tesnet": Path("/models/a.safetensors")}
    assert settings.max_body_bytes == 2**19


@pytest.mark.parametrize(
    ("variable", "value", "word"),
    [
        ("GRASP_PORT", "65536", "65535"),
        ("GRASP_PORT", "http", "free"),
        ("GRASP_PORT", "tcp://10.0.0.1:8000", "Kubernetes"),
        ("GRASP_DEVICE", "gpu", "cuda"),
        ("GRASP_NUM_THREADS", "0", "cores"),
        ("GRASP_MAX_POINTS", "-1", "100,000,000"),
        ("GRASP_MAX_BODY_MB", "nan", "4096"),
        ("GRASP_QUEUE_SIZE", "2.5", "10,000"),
        ("GRASP_MAX_BATCH", "65", "together"),
        ("GRASP_MODELS", "tesnet,vgn", "pointnetgpd"),
        ("GRASP_MODELS", "gpd,gpd", "separated by commas"),
        ("GRASP_MODELS", ",", "heuristic"),
        ("GRASP_WEIGHTS", "gpd=a.safetensors", "only network"),
        ("GRASP_WEIGHTS", "tesnet=", "NAME=PATH"),
        ("GRASP_REQUEST_TIMEOUT", "0", "3600"),
        ("GRASP_DRAIN_TIMEOUT", "inf", "3600"),
        ("GRASP_CORS_ORIGINS", "robot.example", "https://"),
        ("GRASP_LOG_LEVEL", "loud", "debug"),
    ],
)
def test_an_invalid_value_names_variable_value_and_remedy(variable: str, value: str, word: str) -> None:
    with pytest.raises(InvalidSetting) as refused:
        load_settings({variable: value})
    assert refused.value.variable == variable
    assert str(refused.value).startswith(f"{variable} is {value!r}; expected: ")
    assert word in str(refused.value)


def test_threads_follow_the_quota_of_the_container(tmp_path: Path) -> None:
    assert cpu_quota(tmp_path) == math.inf
    (tmp_path / "cpu").mkdir()
    (tmp_path / "cpu" / "cpu.cfs_quota_us").write_text("-1\n")
    (tmp_path / "cpu" / "cpu.cfs_period_us").write_text("100000\n")
    assert cpu_quota(tmp_path) == math.inf
    (tmp_path / "cpu" / "cpu.cfs_quota_us").write_text("250000\n")
    assert cpu_quota(tmp_path) == 2.5
    (tmp_path / "cpu.max").write_text("50000 100000\n")
    assert cpu_quota(tmp_path) == 0.5
    (tmp_path / "cpu.max").write_text("max 100000\n")
    assert cpu_quota(tmp_path) == math.inf


@pytest.mark.parametrize("cores", [1, 2, 7, 8, 9, 64])
@pytest.mark.parametrize("quota", [0.1, 0.5, 1.0, 1.9, 3.5, 8.0, 20.0, math.inf])
@pytest.mark.parametrize("tells_affinity", [True, False])
def test_there_is_a_thread_for_each_whole_core_that_may_be_used_and_at_least_one(
    cores: int, quota: float, tells_affinity: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(settings_module, "cpu_quota", lambda: quota)
    if tells_affinity:
        monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)))
    else:
        monkeypatch.delattr(os, "sched_getaffinity")
        monkeypatch.setattr(os, "cpu_count", lambda: cores)
    whole = max(1, min(cores, MAX_THREADS, math.floor(min(quota, 1000))))
    assert default_threads() == Settings().num_threads == whole
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    if not tells_affinity:
        assert default_threads() == 1


LIMITS: dict[str, tuple[float | None, list[float], list[float]]] = {
    "port": (8000, [0, 65_535], [-1, 65_536]),
    "num_threads": (None, [1, 1024], [0, 1025]),
    "max_points": (1_000_000, [1, 100_000_000], [0, 100_000_001]),
    "max_body_mb": (64.0, [0.001, 4096], [0, 4096.5]),
    "max_held_mb": (512.0, [0.001, 1_048_576], [0, 1_048_577]),
    "queue_size": (32, [1, 10_000], [0, 10_001]),
    "max_batch": (1, [1, 64], [0, 65]),
    "client_places": (None, [1, 10_000], [0, 10_001]),
    "request_timeout": (30.0, [0.001, 3600], [0, 3600.5]),
    "drain_timeout": (25.0, [0, 3600], [-0.1, 3600.5]),
}
"""Of every number: its default, the least and the most that is taken, and what is one too little or too much."""


@pytest.mark.parametrize("field", LIMITS)
def test_every_number_is_taken_from_its_least_to_its_most_and_has_its_default(field: str) -> None:
    default, taken, refused = LIMITS[field]
    variable = f"GRASP_{field.upper()}"
    if field != "num_threads":
        assert getattr(load_settings({}), field) == default
    for value in taken:
        assert getattr(load_settings({variable: str(value)}), field) == value
    for value in refused:
        with pytest.raises(InvalidSetting, match=variable):
            load_settings({variable: str(value)})


def test_every_number_has_its_limits_here() -> None:
    numbers = {
        name
        for name, field in Settings.model_fields.items()
        if field.annotation in (int, float) or field.annotation == (int | None)
    }
    assert numbers == set(LIMITS)


def test_keys_and_origins_are_lists_and_keys_are_never_shown() -> None:
    settings = load_settings({"GRASP_API_KEYS": "first, second", "GRASP_CORS_ORIGINS": "https://robot.example,*"})
    assert [key.get_secret_value() for key in settings.api_keys] == ["first", "second"]
    assert "first" not in repr(settings)
    assert settings.cors_origins == ("https://robot.example", "*")
    assert load_settings({"GRASP_API_KEYS": ""}) == load_settings({})
    for wrong in ("hush,", "hush hush", "h\u00fcsh"):
        with pytest.raises(InvalidSetting, match="GRASP_API_KEYS") as refused:
            load_settings({"GRASP_API_KEYS": wrong})
        assert wrong not in str(refused.value)


def test_unknown_variables_come_with_the_closest_known_name() -> None:
    found = unknown_variables({"GRASP_MAX_POINT": "1", "GRASP_PORT": "1", "GRASP_ZZZZZZZZZ": "1", "PATH": "/"})
    assert found == {"GRASP_MAX_POINT": "GRASP_MAX_POINTS", "GRASP_ZZZZZZZZZ": None}


def test_several_networks_have_their_weights_by_name() -> None:
    names = {"GRASP_MODELS": "TESNET, edgegrasp,heuristic"}
    assert load_settings(names).models == ("tesnet", "edgegrasp", "heuristic")
    assert load_settings(names).weights == {}
    assert load_settings({"GRASP_MODELS": "heuristic,gpd,tesnet"}).models == ("tesnet", "heuristic", "gpd")
    assert load_settings({"GRASP_MODELS": "heuristic,gpd"}).models == ("heuristic", "gpd")
    one = load_settings(names | {"GRASP_WEIGHTS": "edgegrasp=/a=b/edge.safetensors"})
    assert one.weights == {"edgegrasp": Path("/a=b/edge.safetensors")}
    two = load_settings(names | {"GRASP_WEIGHTS": "edgegrasp=e.safetensors, tesnet=t.safetensors"})
    assert two.weights == {"edgegrasp": Path("e.safetensors"), "tesnet": Path("t.safetensors")}
    with pytest.raises(InvalidSetting, match=r"GRASP_WEIGHTS is 'a\.safetensors'; expected: .* NAME=PATH for each"):
        load_settings(names | {"GRASP_WEIGHTS": "a.safetensors"})


def test_a_path_with_an_equals_sign_is_a_path() -> None:
    assert load_settings({"GRASP_WEIGHTS": "/run=3/a.safetensors"}).weights == {"tesnet": Path("/run=3/a.safetensors")}


def test_the_networks_are_those_of_the_library() -> None:
    assert set(NETWORK_NAMES) == set(networks.NETWORKS)


@pytest.mark.parametrize("queue_size", [1, 2, 7, 32])
@pytest.mark.parametrize("client_places", [None, 3])
@pytest.mark.parametrize(
    ("told_apart_by", "are_known"),
    [
        ({}, False),
        ({"GRASP_API_KEYS": "one"}, False),  # everybody's
        ({"GRASP_API_KEYS": "one,other"}, True),
        ({"GRASP_TRUSTED_PROXIES": "10.0.0.0/8"}, True),
        ({"GRASP_API_KEYS": "one", "GRASP_TRUSTED_PROXIES": "10.0.0.1"}, True),
    ],
)
def test_a_client_that_is_known_has_half_of_the_places_unless_told(
    queue_size: int, client_places: int | None, told_apart_by: dict[str, str], are_known: bool
) -> None:
    given = {"GRASP_QUEUE_SIZE": str(queue_size), **told_apart_by}
    given |= {} if client_places is None else {"GRASP_CLIENT_PLACES": str(client_places)}
    expected = client_places or max(1, queue_size // 2)
    assert load_settings(given).places_of_a_client == (expected if are_known else None)


def test_mebibytes_are_told_in_bytes() -> None:
    settings = load_settings({"GRASP_MAX_BODY_MB": "1.5", "GRASP_MAX_HELD_MB": "3"})
    assert (settings.max_body_bytes, settings.max_held_bytes) == (3 * 2**19, 3 * 2**20)
