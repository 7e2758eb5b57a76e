"""What a process loads, and when."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from service.loading import predictor_factory
from service.settings import Settings
from tesnet.errors import WeightsError
from tests.conftest import PATIENCE_S


def test_the_network_and_torch_are_loaded_when_the_factory_is_called_and_not_before() -> None:
    script = (
        "import sys; from service.settings import Settings; from service.loading import predictor_factory; "
        "make = predictor_factory(Settings(device='cpu', num_threads=1)); assert 'torch' not in sys.modules; "
        "print(make().model.name)"
    )
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=PATIENCE_S, check=True)
    assert ran.stdout.strip() == "tesnet"


def test_the_weights_are_those_that_the_settings_name(tmp_path: Path) -> None:
    missing = tmp_path / "none.safetensors"
    make = predictor_factory(Settings(device="cpu", weights=missing))
    with pytest.raises(WeightsError, match=r"none\.safetensors"):
        make()
