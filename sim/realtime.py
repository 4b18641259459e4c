"""Make the emulator's process punctual: tries what is permitted and says in one line what it got."""

import ctypes
import gc
import os
import resource

from sim.errors import UserError

PRIORITY = 70
"""SCHED_FIFO priority of the emulator: below the controller's."""

_PR_SET_TIMERSLACK = 29  # linux/prctl.h
_MCL_CURRENT_FUTURE_ONFAULT = 1 | 2 | 4  # asm-generic/mman.h


def set_up(policy: str) -> str:
    """Freeze the garbage collector, ask for fine timers, lock memory, take SCHED_FIFO; return what came of it.

    `policy`: "auto" takes what is permitted, "off" stays at normal priority, "required" is a UserError without
    SCHED_FIFO. SCHED_FIFO comes last and does not pass to children.
    """
    gc.collect()
    gc.freeze()
    gc.disable()
    _c_call("prctl", _PR_SET_TIMERSLACK, 1, 0, 0, 0)
    if policy == "off":
        return "normal priority as asked"
    may_lock = os.geteuid() == 0 or resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY
    is_locked = may_lock and _c_call("mlockall", _MCL_CURRENT_FUTURE_ONFAULT)
    memory = "memory locked" if is_locked else "memory not locked"
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(PRIORITY))
    except (OSError, AttributeError) as error:
        why = "no CAP_SYS_NICE" if isinstance(error, PermissionError) else str(error)
        if policy == "required":
            raise UserError(
                f"--realtime required: no SCHED_FIFO ({why}); grant CAP_SYS_NICE or an rtprio limit"
            ) from None
        return f"normal priority ({why}), {memory}"
    return f"SCHED_FIFO {PRIORITY}, {memory}"


def _c_call(name: str, *arguments: int) -> bool:
    try:
        return bool(getattr(ctypes.CDLL(None), name)(*arguments) == 0)
    except (OSError, AttributeError):
        return False
