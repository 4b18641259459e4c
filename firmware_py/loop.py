"""The 100 Hz loop: pacing, drain -> cycle -> send, lateness. The only reader of a clock in the controller.

Cycles start on multiples of the period of the monotonic clock. A cycle that starts late by whole periods skips them;
it never bursts. After such a stall the loop drains once more, so that what the peers sent meanwhile is not missed.
Under SCHED_FIFO the cycle's work is rehearsed until shortly before each deadline: after 10 ms of sleep the caches hold
other people's code, and what the cycle itself would wait for is fetched before there is anything to be late for.
"""

import json
import os
import signal
import time
from collections.abc import Callable
from types import FrameType
from typing import Any, NamedTuple

from firmware_py.bus import Bus, Heard
from firmware_py.core import conditions as c
from firmware_py.core.signals import MODE_FAULT, MODE_MANUAL
from firmware_py.errors import UserError
from firmware_py.histogram import Histogram
from firmware_py.node import ControllerNode
from firmware_py.rates import RateWatch
from firmware_py.realtime import Outcome
from firmware_py.reasons import TEXT

PERIOD_NS = 10_000_000

SPIN_NS = 200_000
"""Busy wait before each deadline, under SCHED_FIFO only: without it the scheduler takes the CPU from who burns it."""

REHEARSED_NS = 600_000
"""So long before the spin the loop wakes to rehearse. The first rehearsal fetches code and data and takes twice as long
as those after it; these take the place of the spin, whose time would be burned anyhow, for as long as one more fits in:
what a busy neighbour of the CPU takes from the caches meanwhile is fetched again. Whoever is late rehearses less."""

REHEARSAL_MARGIN_NS = 50_000
"""A rehearsal begins only where the longest of late would end so long before the deadline."""

FIRST_KEPT = 0.997
AGAIN_KEPT = 0.99
"""By so much a cycle the longest first rehearsal of late is forgotten, half of it in 2.3 s, and the longest of those
after it, half in 0.7 s: when they take longer than the first, the machine was away, and that is over."""

REGATHER_S = 0.001
"""After a stall, so long is given to peers that stalled with us before their silence is judged."""

LATE_NS = 1_000_000
"""A cycle that starts later than this counts as late: a tenth of the period."""

LISTEN_NS = 150_000_000
"""Before the first frame is sent, the bus is listened to for so long: longer than a controller's timeout."""

STATUS_CYCLES = 20
ENDING_CYCLES = 30
"""After the end of the manoeuvre so many cycles more tell the vehicle that nothing is to be followed."""

STOPPING_CYCLES = 1500
"""A stop that takes longer than this (15 s) is given up: the vehicle's watchdog takes over."""


class Clock:
    """The loop's time: the monotonic clock, or the same in slow motion.

    In slow motion by N a second of the loop lasts N seconds. Nothing of the loop, the law or the timeouts changes with
    it: all of them know this time only.
    """

    def __init__(self, slow_motion: int = 1) -> None:
        self.slow_motion = slow_motion
        self.now_ns: Callable[[], int] = time.monotonic_ns if slow_motion == 1 else self._slow_ns

    def _slow_ns(self) -> int:
        return time.monotonic_ns() // self.slow_motion

    def sleep(self, duration_s: float) -> None:
        """Sleep for so long of this time, s."""
        time.sleep(duration_s * self.slow_motion)


class Pace:
    """Waits for deadlines: sleeps, rehearses, spins.

    `rehearse` is the work that the deadline is for, without any effect; None for none of it, and it must not raise. One
    begins only where what is left is more than the longest one of late: the first that is longer may be late, once. Of
    the first before a deadline, which has the caches to fill, and of those after it the longest is kept apart.
    """

    def __init__(self, clock: Clock, spin_ns: int = 0, rehearse: Callable[[], None] | None = None) -> None:
        self._clock = clock
        self._spin_ns = spin_ns
        self._rehearse = rehearse
        self._longest_ns = [0.5 * REHEARSED_NS, 0.25 * REHEARSED_NS]
        self.rehearsal = Histogram()
        self.rehearsals = 0

    def wait_until(self, deadline_ns: int) -> int:
        """Return the time of waking, never before the deadline."""
        clock = self._clock
        ahead_ns = self._spin_ns + (REHEARSED_NS if self._rehearse is not None else 0)
        rest_ns = deadline_ns - ahead_ns - clock.now_ns()
        if rest_ns > 0:
            clock.sleep(rest_ns * 1e-9)
        now_ns = clock.now_ns()
        if self._rehearse is not None:
            now_ns = self._rehearsed(self._rehearse, now_ns, deadline_ns)
        while now_ns < deadline_ns:
            now_ns = clock.now_ns()
        return now_ns

    def _rehearsed(self, rehearse: Callable[[], None], now_ns: int, deadline_ns: int) -> int:
        """Rehearse for as long as there is time for one more; return the time."""
        longest_ns = self._longest_ns
        longest_ns[0] *= FIRST_KEPT
        longest_ns[1] *= AGAIN_KEPT
        again = 0
        while now_ns + longest_ns[again] + REHEARSAL_MARGIN_NS < deadline_ns:
            rehearse()
            begun_ns, now_ns = now_ns, self._clock.now_ns()
            self.rehearsal.add(now_ns - begun_ns)
            self.rehearsals += 1
            took_ns = float(now_ns - begun_ns)
            if now_ns > deadline_ns:
                # A machine that is too slow for it is left alone for some time; one that was away during a later one,
                # which takes less than the first, for a short time only.
                known_late_ns = 2.0 * (REHEARSED_NS + self._spin_ns)
                took_ns = known_late_ns if again else max(took_ns, known_late_ns)
            longest_ns[again] = max(longest_ns[again], took_ns)
            again = 1
        return now_ns


class RunResult(NamedTuple):
    """How the loop ended: the reason's code, whether the manoeuvre was completed, and the figures."""

    reason: int
    completed: bool
    final: dict[str, Any]


class Loop:
    """Runs a controller node on a bus until the manoeuvre is over or a signal asks for the end."""

    def __init__(
        self,
        node: ControllerNode,
        bus: Bus,
        rates: RateWatch,
        *,
        realtime: Outcome,
        once: bool,
        status_fd: int | None,
        clock: Clock | None = None,
        rehearses: bool = True,
    ) -> None:
        self._clock = clock or Clock()
        self._node = node
        self._bus = bus
        self._rates = rates
        punctual = realtime.fifo and self._clock.slow_motion == 1
        # A single CPU belongs to the others until the deadline.
        rehearse = node.rehearse if rehearses and punctual and len(os.sched_getaffinity(0)) > 1 else None
        self._pace = Pace(self._clock, SPIN_NS if punctual else 0, rehearse)
        self._realtime = realtime
        self._once = once
        self._status_fd = status_fd
        self._wake = Histogram()
        self._step = Histogram()
        self._longest_stall = 0
        self._late_cycles = 0
        self._signalled = False
        self._stopping_cycles = 0
        self._reason = c.WAITING_FOR_REPORTS
        self._completed = False

    def run(self) -> RunResult:
        """Run to the end; returns after the car has been told to stand and to follow nothing more."""
        handlers = {number: signal.signal(number, self._ask_to_end) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            self._listen_first()
            self._cycles()
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)
        return RunResult(reason=self._reason, completed=self._completed, final=self._final())

    def _ask_to_end(self, _number: int, _frame: FrameType | None) -> None:
        self._signalled = True

    def _listen_first(self) -> None:
        """Refuse a bus on which another controller already sends: two senders would fight over the car."""
        end_ns = self._clock.now_ns() + LISTEN_NS
        while self._clock.now_ns() < end_ns and not self._signalled:
            for arbitration_id, data in self._bus.drain():
                self._node.mailbox.put(self._clock.now_ns(), arbitration_id, data)
            if self._node.mailbox.second_controller:
                raise UserError(f"another controller already sends on {self._bus.description}; stop it first")
            self._clock.sleep(0.002)

    def _cycles(self) -> None:
        node = self._node
        bus = self._bus
        clock = self._clock
        deadline_ns = (clock.now_ns() // PERIOD_NS + 2) * PERIOD_NS
        ending = 0
        while ending < ENDING_CYCLES:
            wake_ns = self._wait_until(deadline_ns)
            late_ns = wake_ns - deadline_ns
            overruns = late_ns // PERIOD_NS
            deadline_ns += (overruns + 1) * PERIOD_NS

            frames = bus.drain()
            if overruns:
                self._longest_stall = max(self._longest_stall, overruns)
                clock.sleep(REGATHER_S)
                frames += bus.drain()
            frames = self._rates.sift(frames, 1 + overruns, holding=not node.is_driving)
            bus.send(node.cycle(wake_ns, frames, overruns, bus.send_failed))

            step_ns = clock.now_ns() - wake_ns
            if late_ns > LATE_NS:
                self._late_cycles += 1
            self._wake.add(late_ns)
            self._step.add(step_ns)
            node.health.add(late_ns, step_ns)
            ending = self._ending(ending)
            if node.cycles % STATUS_CYCLES == 0:
                self._write_status()

    def _wait_until(self, deadline_ns: int) -> int:
        """Sleep, and under SCHED_FIFO rehearse and spin; return the time of waking, never before the deadline."""
        return self._pace.wait_until(deadline_ns)

    def _ending(self, ending: int) -> int:
        """Return how many cycles the end has lasted; 0 while the loop is to go on."""
        node = self._node
        seen = node.seen()
        if seen.mode == MODE_MANUAL and seen.reason == c.COMPLETE:
            self._completed = True
        if self._signalled or (self._once and self._completed):
            # Once is once: a start that is pressed again finds the stop button held.
            node.stop_requested = True
        if not self._completed or seen.mode == MODE_FAULT:
            self._reason = seen.reason
        else:
            self._reason = c.COMPLETE
        over = (self._once and (self._completed or seen.mode == MODE_FAULT)) or self._signalled
        if not over:
            return 0
        self._stopping_cycles += 1
        if node.is_driving and not self._bus.is_listening_only and self._stopping_cycles < STOPPING_CYCLES:
            # Stopping: the end begins when the car stands.
            return 0
        return ending + 1

    def _write_status(self) -> None:
        """Write one line for whoever watches; a reader that does not keep up misses lines, the loop does not wait."""
        if self._status_fd is None:
            return
        seen = self._node.seen()
        line = json.dumps(
            {
                **seen._asdict(),
                "reason_text": TEXT[seen.reason],
                "held_reports": list(self._rates.held.values()),
                "wake_late_p99_us": self._wake.quantile_us(0.99),
                "overruns": self._node.overruns,
                "late_cycles": self._late_cycles,
            }
        )
        try:
            os.write(self._status_fd, line.encode() + b"\n")
        except BlockingIOError:
            return
        except OSError:
            self._status_fd = None

    def _final(self) -> dict[str, Any]:
        node = self._node
        mailbox = node.mailbox
        seen = node.seen()
        return {
            "mode": seen.mode,
            "leg": seen.leg,
            "reason": self._reason,
            "reason_text": TEXT[self._reason],
            "completed": self._completed,
            "cycles": node.cycles,
            "overruns": node.overruns,
            "late_cycles": self._late_cycles,
            "longest_stall_cycles": self._longest_stall,
            "wake_p50_us": self._wake.quantile_us(0.5),
            "wake_p99_us": self._wake.quantile_us(0.99),
            "wake_p999_us": self._wake.quantile_us(0.999),
            "wake_max_us": self._wake.max_us,
            "step_p50_us": self._step.quantile_us(0.5),
            "step_p99_us": self._step.quantile_us(0.99),
            "rehearsals": self._pace.rehearsals,
            "failed_rehearsals": node.failed_rehearsals,
            "rehearsal_p50_us": self._pace.rehearsal.quantile_us(0.5),
            "scheduler": "SCHED_FIFO" if self._realtime.fifo else "SCHED_OTHER",
            "realtime": self._realtime.steps,
            "listen_only": self._bus.is_listening_only,
            "frames_sent": self._bus.sent,
            "frames_received": mailbox.received,
            "frames_lost": mailbox.lost,
            "frames_rejected": mailbox.rejected_crc + mailbox.rejected_counter + mailbox.rejected_length,
            "frames_foreign": mailbox.foreign + self._bus.foreign,
            "error_frames": self._bus.error_frames,
            "drains_cut": self._bus.drains_cut,
            "receive_failed": self._bus.receive_failed,
            "send_failed": self._bus.send_failed,
            "held_reports": list(self._rates.held.values()),
            "internal_errors": list(node.internal_errors),
        }


def listen(bus: Bus, duration_s: float, take: Callable[[int, int, list[Heard]], bool]) -> None:
    """Wake on the cycle's grid and hand over (wake-up time ns, lateness ns, frames), until `take` says it is enough."""
    deadline_ns = (time.monotonic_ns() // PERIOD_NS + 2) * PERIOD_NS
    end_ns = deadline_ns + round(duration_s * 1e9)
    while deadline_ns < end_ns:
        time.sleep(max(deadline_ns - time.monotonic_ns(), 0) * 1e-9)
        wake_ns = time.monotonic_ns()
        late_ns = wake_ns - deadline_ns
        deadline_ns += (late_ns // PERIOD_NS + 1) * PERIOD_NS
        if take(wake_ns, late_ns, bus.hear()):
            return


def clock_resolution_ns() -> int:
    """Return the resolution of the clock that paces the loop."""
    return max(round(time.get_clock_info("monotonic").resolution * 1e9), 1)


def status_writer(enabled: bool) -> int | None:
    """Return standard output as a descriptor that never blocks, or None.

    A terminal is opened anew, so that whoever shares it does not find it changed.
    """
    if not enabled:
        return None
    if os.isatty(1):
        return os.open(os.ttyname(1), os.O_WRONLY | os.O_NONBLOCK | os.O_NOCTTY)
    os.set_blocking(1, False)
    return 1
