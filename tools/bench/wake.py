"""Lateness of wake-ups: the loop's waiting and cyclictest in turns, idle and with two processes that burn the CPU."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator

from sim.errors import UserError

HOGS = 2
GRACE_S = 30.0
# Ends by itself if this process is killed: then its parent is another one.
_HOG = "import os, sys\nwhile os.getppid() == int(sys.argv[1]):\n    for _ in range(100000): pass"
_HISTOGRAM_US = 200_000


def why_no_cyclictest() -> str:
    """Return why the floor cannot be measured here, or nothing."""
    if shutil.which("cyclictest") is None:
        return "cyclictest is not installed (Debian: apt-get install rt-tests)"
    done = _cyclictest(0.1)
    return "" if done.returncode == 0 else f"cyclictest: {_last_line(done.stderr or done.stdout)}"


def cyclictest_late_us(seconds: float) -> list[float]:
    """Return the lateness of each of cyclictest's wake-ups, us. Raises UserError where it fails."""
    done = _cyclictest(seconds)
    late: list[float] = []
    for line in done.stdout.splitlines():
        words = line.split()
        if len(words) == 2 and words[0].isdigit() and words[1].isdigit():
            late += [float(words[0])] * int(words[1])
    if done.returncode != 0 or not late:
        raise UserError(f"cyclictest: {_last_line(done.stderr or done.stdout)}")
    return late


def _cyclictest(seconds: float) -> subprocess.CompletedProcess[str]:
    loops = max(round(seconds * 100), 1)
    command = ["cyclictest", "-m", "-p", "90", "-i", "10000", "-l", str(loops), "-q", "-h", str(_HISTOGRAM_US)]
    return subprocess.run(command, capture_output=True, text=True, timeout=seconds + GRACE_S, check=False)


def _last_line(text: str) -> str:
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1] if lines else "gave no figures"


def loop_late_us(policy: str, seconds: float) -> tuple[list[float], str]:
    """Return the lateness of each of the loop's wake-ups, us, and why it got no SCHED_FIFO, or nothing."""
    command = [sys.executable, "-P", "-m", "tools.bench.pacer", policy, str(seconds)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=seconds + GRACE_S, check=False)
    if done.returncode != 0:
        raise UserError(f"the process that waits like the loop failed: {_last_line(done.stderr)}")
    report = json.loads(done.stdout)
    return [late_ns * 1e-3 for late_ns in report["late_ns"]], "" if report["fifo"] else report["line"]


@contextlib.contextmanager
def hogs(count: int = HOGS) -> Iterator[list[int]]:
    """Burn the CPU in so many processes of normal priority; yields their ids, and ends just these."""
    running: list[subprocess.Popen[bytes]] = []
    try:
        for _ in range(count):
            command = [sys.executable, "-S", "-c", _HOG, str(os.getpid())]
            running.append(subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL))
        yield [process.pid for process in running]
    finally:
        for process in running:
            process.kill()
        for process in running:
            process.wait()
