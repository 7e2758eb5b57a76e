from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
HEAVY = {
    "torch",
    "fastapi",
    "starlette",
    "uvicorn",
    "pybullet",
    "open3d",
    "trimesh",
    "scipy",
    "safetensors",
    "matplotlib",
}
ALLOWED_SERVICE = {"service", "service.schemas"}
ALLOWED_TESNET = ("tesnet.formats", "tesnet.geometry", "tesnet.hands", "tesnet.query", "tesnet.result", "tesnet.errors")


def test_the_client_pulls_in_nothing_heavy_and_of_the_service_the_wire_alone() -> None:
    program = "import json, sys, client, client.__main__; print(json.dumps(sorted(sys.modules)))"
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=ROOT, check=True)
    modules = set(json.loads(run.stdout))
    assert {"client", "numpy", "httpx", "pydantic"} <= modules
    assert not {name.split(".")[0] for name in modules} & (HEAVY | {"lzf", "PIL", "jaxtyping"})
    assert {name for name in modules if name.split(".")[0] == "service"} <= ALLOWED_SERVICE
    ours = {name for name in modules if name.startswith("tesnet.")}
    assert all(name.startswith(ALLOWED_TESNET) for name in ours), sorted(ours)
