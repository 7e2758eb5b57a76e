from __future__ import annotations

import subprocess
import sys


def test_the_wire_format_needs_neither_torch_nor_a_web_framework() -> None:
    script = (
        "import sys, service.schemas\n"
        "heavy = {'torch', 'fastapi', 'starlette', 'uvicorn', 'msgspec', 'prometheus_client', 'safetensors'}\n"
        "print(*sorted(heavy & set(sys.modules)))"
    )
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert ended.stdout.strip() == ""
