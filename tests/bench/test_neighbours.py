import subprocess
import sys
import time
from pathlib import Path

from bench.neighbours import neighbours


def cpu_seconds(pid: int) -> int:
    """In hundredths."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return sum(int(field) for field in fields[11:13])


def test_neighbours_compute_without_pause_and_end_with_the_context() -> None:
    with neighbours(2) as processes:
        before = [cpu_seconds(process.pid) for process in processes]
        while any(cpu_seconds(process.pid) <= start for process, start in zip(processes, before, strict=True)):
            time.sleep(0.01)
        assert len({process.pid for process in processes}) == 2
    assert all(process.poll() is not None for process in processes)


def test_neighbours_end_when_who_started_them_is_killed() -> None:
    program = (
        "import os, signal\n"
        "from bench.neighbours import neighbours\n"
        "with neighbours(1) as started:\n"
        "    print(started[0].pid, flush=True)\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    killed = subprocess.run([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True, check=False)
    pid = int(killed.stdout)
    while Path(f"/proc/{pid}").exists():
        time.sleep(0.01)
