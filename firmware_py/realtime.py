"""Real-time set-up of a process, step by step, each tried and its outcome told; nothing here is fatal by itself."""

import ctypes
import gc
import os
import resource
from typing import NamedTuple

from firmware_py.errors import UserError

PRIORITY = 80
"""SCHED_FIFO priority of the controller: above the emulator's, below the kernel's own threads."""

_PR_SET_TIMERSLACK = 29
_MCL_CURRENT_FUTURE_ONFAULT = 1 | 2 | 4


class Outcome(NamedTuple):
    """What the set-up got: one line for people, and the facts."""

    line: str
    fifo: bool
    memory_locked: bool


def set_up(policy: str, priority: int = PRIORITY) -> Outcome:
    """Make this process as punctual as it may be: timer slack, locked memory, frozen garbage collector, SCHED_FIFO.

    `policy` is "auto" (take what is permitted), "off" (normal priority) or "required" (UserError without SCHED_FIFO).
    SCHED_FIFO comes last and is not inherited by children.
    """
    _timer_slack()
    gc.collect()
    gc.freeze()
    gc.disable()
    if policy == "off":
        return Outcome("normal priority as asked, gc frozen", fifo=False, memory_locked=False)
    locked = _lock_memory()
    refused = _fifo(priority)
    if refused and policy == "required":
        raise UserError(f"--realtime required: no SCHED_FIFO ({refused}); grant CAP_SYS_NICE or an rtprio limit")
    parts = [f"normal priority: {refused}; jitter will be worse, see README, real time"]
    if not refused:
        parts = [f"SCHED_FIFO {priority}"]
    parts.append("memory locked" if locked else "memory not locked")
    parts.append("gc frozen")
    return Outcome(", ".join(parts), fifo=not refused, memory_locked=locked)


def _timer_slack() -> None:
    """Ask for 1 ns of timer slack instead of 50 us; free for everyone."""
    try:
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)
    except (OSError, AttributeError):
        return


def _lock_memory() -> bool:
    """Lock memory as it is touched, only where the limit allows all of it: else later allocations would fail."""
    soft, _hard = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    if soft != resource.RLIM_INFINITY and os.geteuid() != 0:
        return False
    try:
        return bool(ctypes.CDLL(None, use_errno=True).mlockall(_MCL_CURRENT_FUTURE_ONFAULT) == 0)
    except (OSError, AttributeError):
        return False


def _fifo(priority: int) -> str:
    """Take SCHED_FIFO; return why not, or nothing."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except PermissionError:
        return "no CAP_SYS_NICE"
    except (OSError, AttributeError) as error:
        return str(error)
    return ""
