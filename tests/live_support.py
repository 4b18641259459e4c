"""For runs in wall-clock time on a machine that is not theirs alone.

A machine may be away for longer than a message's timeout: another guest of its host runs, or other real-time processes.
The car then stops, as it must, and the run says nothing of what a test asks. A witness on each CPU, more urgent than
all of ours, tells that from a process of ours that is late by its own doing: a test is run again only where it failed
and the witnesses were away.
"""

from __future__ import annotations

import contextlib
import functools
import os
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import Any, TypeVar

ATTEMPTS = 3
AWAY_S = 0.05
"""Half the shortest timeout on the bus."""

_WITNESS = """
import os, signal, sys, time
os.sched_setaffinity(0, {int(sys.argv[1])})
try:
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(95))
except OSError:
    pass  # then it is no more urgent than ours, which have no priority here either
ended = []
signal.signal(signal.SIGTERM, lambda *_: ended.append(1))
print("there", flush=True)
longest_s, last_s = 0.0, time.monotonic()
while not ended and os.getppid() == int(sys.argv[2]):
    time.sleep(0.005)
    now_s = time.monotonic()
    longest_s, last_s = max(longest_s, now_s - last_s), now_s
print(longest_s)
"""


class Witnesses:
    """A process on each CPU that looks at the clock every 5 ms; `away_s` is the longest that one of them was away."""

    def __enter__(self) -> Witnesses:
        self.away_s = 0.0
        self._processes = [
            subprocess.Popen(
                [sys.executable, "-S", "-c", _WITNESS, str(cpu), str(os.getpid())], stdout=subprocess.PIPE, text=True
            )
            for cpu in sorted(os.sched_getaffinity(0))
        ]
        for process in self._processes:
            assert process.stdout is not None
            assert process.stdout.readline() == "there\n"
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        for process in self._processes:
            process.terminate()
        for process in self._processes:
            said, _ = process.communicate(timeout=20.0)
            self.away_s = max(self.away_s, float(said))


Test = TypeVar("Test", bound=Callable[..., None])


def again_where_the_machine_was_away(test: Test) -> Test:
    """Run a test that has failed once more where a CPU was away for AWAY_S meanwhile; at most ATTEMPTS times in all."""

    @functools.wraps(test)
    def run(*arguments: Any, **named: Any) -> None:
        for attempt in range(1, ATTEMPTS + 1):
            witnesses = Witnesses()
            try:
                with witnesses:
                    return test(*arguments, **named)
            except AssertionError as failure:
                if attempt == ATTEMPTS or witnesses.away_s < AWAY_S:
                    raise
                warnings.warn(f"the machine was away for {witnesses.away_s:.3f} s: {failure}", stacklevel=2)
        return None

    return run  # type: ignore[return-value]


@contextlib.contextmanager
def before_ordinary_work(priority: int = 60) -> Iterator[None]:
    """Run this process before ordinary ones, where that is permitted: a sender that must not pause for 100 ms."""
    changed = False
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
        changed = True
    try:
        yield
    finally:
        if changed:
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
