"""Real-time set-up of a process, step by step, each tried and its outcome told; nothing here is fatal by itself."""

import ctypes
import gc
import os
import resource
from typing import NamedTuple

from firmware_py.errors import UserError

PRIORITY = 80
"""SCHED_FIFO priority of the controller: above the emulator's, below the kernel's own threads."""

LATENCY_FILE = "/dev/cpu_dma_latency"

_PR_SET_TIMERSLACK = 29
_MCL_CURRENT_FUTURE_ONFAULT = 1 | 2 | 4


class Outcome(NamedTuple):
    """What the set-up got: one line for people, the facts, and every step's outcome in words, in the order taken.

    `latency_fd` must stay open as long as the process wants short wake-ups; None where the kernel refused it.
    """

    line: str
    fifo: bool
    memory_locked: bool
    steps: dict[str, str]
    latency_fd: int | None


def set_up(policy: str, cpu: int | None = None, priority: int = PRIORITY) -> Outcome:
    """Make this process as punctual as it may be; what is loaded and warm by now stays so.

    In order: timer slack, CPU affinity (where `cpu` is given), locked memory, short CPU sleep states, frozen garbage
    collector, SCHED_FIFO last and not inherited by children. `policy` is "auto" (take what is permitted), "off" (normal
    priority) or "required" (UserError without SCHED_FIFO). A `cpu` that this process may not use is a UserError.
    """
    steps = {"timer_slack": _timer_slack(), "cpu": _affinity(cpu)}
    may = policy != "off"
    not_locked = _lock_memory() if may else "not asked"
    steps["memory"] = f"not locked: {not_locked}" if not_locked else "locked"
    latency_fd, steps["cpu_dma_latency"] = _short_sleep_states() if may else (None, "not asked")
    gc.collect()
    gc.freeze()
    gc.disable()
    steps["gc"] = "frozen"
    refused = _fifo(priority) if may else "as asked"
    steps["scheduler"] = f"normal priority: {refused}" if refused else f"SCHED_FIFO {priority}"
    if refused and policy == "required":
        raise UserError(
            f"--realtime required: no SCHED_FIFO ({refused}); grant CAP_SYS_NICE or an rtprio limit of {priority}, "
            "or say --realtime auto where a late cycle does no harm"
        )
    if policy == "off":
        line = "normal priority as asked, gc frozen"
    elif refused:
        line = f"normal priority: {refused}; jitter will be worse; see README, real time"
    else:
        line = f"SCHED_FIFO {priority}, {'memory not locked' if not_locked else 'memory locked'}, gc frozen"
    return Outcome(line, not refused, not not_locked, steps, latency_fd)


def _timer_slack() -> str:
    """Ask for 1 ns of timer slack instead of 50 us; free for everyone."""
    try:
        refused = ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)
    except (OSError, AttributeError):
        refused = -1
    return "as the kernel has it" if refused else "1 ns"


def _affinity(cpu: int | None) -> str:
    """Stay on one CPU where that is asked for."""
    if cpu is None:
        return "any"
    try:
        os.sched_setaffinity(0, {cpu})
    except (OSError, AttributeError, OverflowError, ValueError):
        usable = ", ".join(map(str, sorted(os.sched_getaffinity(0)))) if hasattr(os, "sched_getaffinity") else "any"
        raise UserError(f"--cpu {cpu}: this process cannot run there; the CPUs it may use are {usable}") from None
    return str(cpu)


def _lock_memory() -> str:
    """Lock memory as it is touched, only where the limit allows all of it: else later allocations would fail.

    Returns why not, or nothing.
    """
    soft, _hard = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    if soft != resource.RLIM_INFINITY and os.geteuid() != 0:
        return f"RLIMIT_MEMLOCK is {soft >> 10} KiB, must be unlimited"
    try:
        if ctypes.CDLL(None, use_errno=True).mlockall(_MCL_CURRENT_FUTURE_ONFAULT) == 0:
            return ""
        return os.strerror(ctypes.get_errno())
    except (OSError, AttributeError) as error:
        return str(error)


def _short_sleep_states() -> tuple[int | None, str]:
    """Forbid the CPUs to sleep so deeply that waking takes long; holds as long as the file is open."""
    try:
        fd = os.open(LATENCY_FILE, os.O_WRONLY | os.O_CLOEXEC)
    except OSError as error:
        return None, f"not held: {error.strerror}"
    try:
        os.write(fd, (0).to_bytes(4, "little"))
    except OSError as error:
        os.close(fd)
        return None, f"not held: {error.strerror}"
    return fd, "0 us held"


def _fifo(priority: int) -> str:
    """Take SCHED_FIFO; return why not, or nothing."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except PermissionError:
        return "no CAP_SYS_NICE"
    except (OSError, AttributeError) as error:
        return str(error)
    return ""
