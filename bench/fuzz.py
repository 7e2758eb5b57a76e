"""Hostile requests against the service: `python -m bench.fuzz --requests 2000`.

Half of them are made by schemathesis from the live server's own OpenAPI document, valid and invalid ones; the others
are `bench.hostile`'s. A status of 500 or more other than 503 and 504, an answer that does not come, and memory that
does not come back are findings, told one by one; the command ends with 1 then.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from dataclasses import dataclass, field
from itertools import islice
from typing import Any

import httpx
import hypothesis
import schemathesis
from hypothesis import strategies as st
from schemathesis import GenerationMode
from schemathesis.core.result import Ok

from bench.hostile import corpus
from bench.serve import memory_mb, running_service
from client import GraspClient
from simharness.play.server import free_port

ANSWER_WITHIN_S = 60.0
ALLOWED_FAILURES = (503, 504)
FUZZED_METHODS = ("GET", "POST")

Case = schemathesis.Case[Any]


@dataclass
class Findings:
    """How many answers of each status there were, and what was wrong."""

    statuses: Counter[int] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)

    def answer(self, what: str, status: int) -> None:
        """Count an answer, and note one that should not be."""
        self.statuses[status] += 1
        if status >= 500 and status not in ALLOWED_FAILURES:
            self.wrong.append(f"{status}: {what}")


def attack(url: str, requests: int, seed: int) -> Findings:
    """Send so many hostile requests, one after the other."""
    findings = Findings()
    _from_document(url, requests // 2, seed, findings)
    with httpx.Client(base_url=url, timeout=ANSWER_WITHIN_S) as client:
        for hostile in islice(corpus(seed), requests - sum(findings.statuses.values())):
            what = f"POST {hostile.path} {hostile.headers} {hostile.body[:200]!r}"
            try:
                answer = client.post(hostile.path, content=hostile.body, headers=hostile.headers)
            except httpx.HTTPError as error:
                findings.wrong.append(f"{type(error).__name__}: {what}")
            else:
                findings.answer(what, answer.status_code)
    return findings


def _from_document(url: str, requests: int, seed: int, findings: Findings) -> None:
    """Requests that follow the server's OpenAPI document, and such that break it."""
    for media_type in ("application/octet-stream", "application/x-npy"):
        schemathesis.openapi.media_type(media_type, st.binary(max_size=1200))
    schema = schemathesis.openapi.from_url(f"{url}/openapi.json")
    operations = [found.ok() for found in schema.get_all_operations() if isinstance(found, Ok)]
    operations = [operation for operation in operations if operation.method.upper() in FUZZED_METHODS]
    modes = (GenerationMode.POSITIVE, GenerationMode.NEGATIVE)
    each = max(1, requests // (len(operations) * len(modes)))
    for operation in operations:
        for mode in modes:
            _cases(operation.as_strategy(generation_mode=mode), each, seed, findings)


def _cases(strategy: st.SearchStrategy[Case], count: int, seed: int, findings: Findings) -> None:
    @hypothesis.seed(seed)
    @hypothesis.settings(
        max_examples=count,
        phases=[hypothesis.Phase.generate],
        database=None,
        deadline=None,
        suppress_health_check=list(hypothesis.HealthCheck),
    )
    @hypothesis.given(case=strategy)
    def send(case: Case) -> None:
        answer = case.call(timeout=ANSWER_WITHIN_S)
        findings.answer(case.as_curl_command(), answer.status_code)

    try:
        send()
    except hypothesis.errors.Unsatisfiable:  # a GET without parameters has no invalid form
        return


def main() -> int:
    """Start a service, attack it, compare its memory."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--requests", type=int, default=2000, help="how many (default 2000)")
    parser.add_argument("--seed", type=int, default=0, help="of the requests (default 0)")
    parser.add_argument("--memory-growth-mb", type=float, default=50.0, help="finding above this growth (default 50)")
    arguments = parser.parse_args()

    port = free_port()
    url = f"http://127.0.0.1:{port}"
    with running_service(port, threads=1) as process, GraspClient(url) as client:
        client.wait_until_ready(120)
        attack(url, max(50, arguments.requests // 10), arguments.seed + 1)  # what is allocated once
        before = memory_mb(process.pid, "VmRSS")
        findings = attack(url, arguments.requests, arguments.seed)
        after, highest = memory_mb(process.pid, "VmRSS"), memory_mb(process.pid, "VmHWM")
        client.wait_until_ready(5)
    if after - before > arguments.memory_growth_mb:
        findings.wrong.append(f"memory: {before:.0f} MB before, {after:.0f} MB after")
    print(
        f"{sum(findings.statuses.values())} requests, seed {arguments.seed}: {dict(sorted(findings.statuses.items()))}"
    )
    print(f"memory {before:.0f} MB before, {after:.0f} MB after, {highest:.0f} MB at its highest")
    print("\n".join(findings.wrong) or "nothing wrong found")
    return 1 if findings.wrong else 0


if __name__ == "__main__":
    sys.exit(main())
