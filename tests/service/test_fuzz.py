"""A short run of `python -m bench.fuzz`, which sends thousands."""

from __future__ import annotations

import httpx

from bench.fuzz import attack


def test_no_hostile_request_fails_the_service_or_hangs(service_url: str) -> None:
    findings = attack(service_url, requests=60, seed=0)
    assert findings.wrong == []
    assert sum(findings.statuses.values()) >= 60
    assert findings.statuses[400] > 5
    assert httpx.get(f"{service_url}/health/ready").status_code == 200
