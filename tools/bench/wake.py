"""Lateness of wake-ups: the loop's waiting and cyclictest in turns, idle and with two processes that burn the CPU."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator

from sim.errors import UserError

HOGS = 2
GRACE_S = 30.0
# Ends by itself if this process is killed: then its parent is another one.
_HOG = "import os, sys\nwhile os.getppid() == int(sys.argv[1]):\n    for _ in range(100000): pass"
_HISTOGRAM_US = 200_000
_CYCLICTEST = ["cyclictest", "-m", "-p", "90", "-i", "10000", "-q", "-h", str(_HISTOGRAM_US)]


def why_no_cyclictest() -> str:
    """Return why the floor cannot be measured here, or nothing."""
    if shutil.which("cyclictest") is None:
        return "cyclictest is not installed (Debian: apt-get install rt-tests)"
    done = _cyclictest(0.1)
    return "" if done.returncode == 0 else f"cyclictest: {_last_line(done.stderr or done.stdout)}"


def cyclictest_late_us(seconds: float) -> list[float]:
    """Return the lateness of each of cyclictest's wake-ups, us. Raises UserError where it fails."""
    done = _cyclictest(seconds)
    return _late_us(done.returncode, done.stdout, done.stderr)


def _late_us(status: int, output: str, errors: str) -> list[float]:
    """Return the lateness of each wake-up from cyclictest's histogram; what is beyond its end counts as its end."""
    late: list[float] = []
    for line in output.splitlines():
        words = line.split()
        if len(words) == 2 and words[0].isdigit() and words[1].isdigit():
            late += [float(words[0])] * int(words[1])
        elif line.startswith("# Histogram Overflows:"):
            late += [float(_HISTOGRAM_US)] * int(words[-1])
    if status != 0 or not late:
        raise UserError(f"cyclictest: {_last_line(errors or output)}")
    return late


def _cyclictest(seconds: float) -> subprocess.CompletedProcess[str]:
    command = [*_CYCLICTEST, "-l", str(max(round(seconds * 100), 1))]
    return subprocess.run(command, capture_output=True, text=True, timeout=seconds + GRACE_S, check=False)


class Beside:
    """cyclictest beside something that lasts as long as it lasts; `late_us` ends it and returns what it saw."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(_CYCLICTEST, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)

    def late_us(self) -> list[float]:
        """Return the lateness of each wake-up, us. Raises UserError where cyclictest failed."""
        self._process.send_signal(signal.SIGINT)
        output, errors = self._process.communicate(timeout=GRACE_S)
        return _late_us(self._process.returncode, output, errors)

    def close(self) -> None:
        """Leave nothing behind."""
        if self._process.poll() is None:
            self._process.kill()
        self._process.communicate()


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
