"""One run in real time: car and controller as processes on a bus, this process as their operator and witness."""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from firmware_py.reasons import TEXT
from sim.errors import UserError
from tools.bus_log import NoLog
from tools.figures import PathTable, project
from tools.operator_station import ACTIVE, COMPLETE, FAULT, MANUAL, NO_REASON, Station, exchange
from tools.processes import STATUS_USER_ERROR, Child
from tools.progress import Moment, Progress

if TYPE_CHECKING:
    import can

START_LIMIT_S = 30.0
"""From start of the processes to a car that drives; slow machines need seconds to load Python alone."""
BLOCKED_LIMIT_S = 4.0
"""A reason not to start that does not go away by itself is waited for no longer than this."""
PASSING_REASONS = {"WaitingForReports", "WaitingForOperator", "PoseSettling", "VehicleNotReady", NO_REASON}
DRIVE_LIMIT_S = 180.0
STANDSTILL_LIMIT_S = 15.0
FAULT_LIMIT_S = 20.0
END_LIMIT_S = 5.0
NOTICE_S = 1.0
NOTEWORTHY_STALL_MS = 50.0
"""Half the shortest timeout: a longer stall of one of the processes may be why the controller stopped."""
LISTEN_S = 0.02
PRIORITY = 10
"""Below the car's and the controller's: this process must only keep its heartbeat within the timeout."""


class LiveOutcome(NamedTuple):
    """How a run ended. `why` is None where both processes did their job; `interrupted` by Ctrl-C or a signal."""

    controller: dict[str, Any]
    why: str | None
    interrupted: bool


class LiveRun:
    """Starts the processes, presses start, watches, and leaves none of them behind."""

    def __init__(
        self,
        *,
        bus: can.BusABC,
        station: Station,
        log: NoLog,
        progress: Progress,
        path: PathTable,
        realtime: str | None,
    ) -> None:
        self._bus = bus
        self._station = station
        self._log = log
        self._progress = progress
        self._path = path
        self._realtime = realtime
        self._interrupts = 0
        self._next_listen_s = 0.0
        self._shown_report: dict[str, Any] = {}
        self._place: tuple[float | None, float | None] = (None, None)
        self._witness = _Witness(station)
        self._controller: Child
        self._emulator: Child

    def run(self, controller_arguments: list[str], emulator_arguments: list[str], folder: Path) -> LiveOutcome:
        """Run to the end. Raises UserError where a process refused to start because of a user's mistake."""
        with contextlib.ExitStack() as stack:
            stack.enter_context(self._signals())
            self._emulator = Child("plant emulator", "sim", emulator_arguments)
            stack.callback(self._emulator.close)
            self._controller = Child("controller", "firmware_py", controller_arguments)
            stack.callback(self._controller.close)
            stack.enter_context(_first_among_ordinary(self._realtime))
            why = self._drive()
            self._end()
            self._progress.close()
            for child in (self._controller, self._emulator):
                if child.status == STATUS_USER_ERROR:
                    raise UserError(child.last_complaint() or child.how_it_ended())
            self._controller.write_complaints(folder / "controller.txt")
            self._emulator.write_complaints(folder / "emulator.txt")
            if why is None:
                why = self._unclean_end() or self._log.failed
        final = {**self._witness.figures(), **(self._controller.final or {})}
        return LiveOutcome(final, why, interrupted=self._interrupts > 0)

    # ------------------------------------------------------------------------------------------------ the run itself

    def _drive(self) -> str | None:
        """Keep the station going until the manoeuvre is over; return what went wrong, if anything."""
        station = self._station
        begun_s = time.monotonic()
        active_s = fault_s = blocked_s = None
        while True:
            self._pump()
            now_s = time.monotonic()
            station.press_start_when_ready(time.monotonic_ns())
            if station.mode == ACTIVE and active_s is None:
                active_s = now_s
            if station.mode == FAULT and fault_s is None:
                fault_s = now_s
            if self._interrupts:
                return self._stop_by_operator(driving=active_s is not None)
            if self._emulator.ended():
                return self._emulator_gone()
            if self._controller.ended():
                return self._controller_gone()
            if active_s is None:
                blocked = station.mode == MANUAL and station.reason not in PASSING_REASONS
                blocked_s = (blocked_s or now_s) if blocked else None
                if now_s - begun_s > START_LIMIT_S or now_s - (blocked_s or now_s) > BLOCKED_LIMIT_S:
                    return f"the car did not start: {station.reason_text}"
            if active_s is not None and now_s - active_s > DRIVE_LIMIT_S:
                return f"the test was not over after {DRIVE_LIMIT_S:.0f} s"
            if fault_s is not None and now_s - fault_s > FAULT_LIMIT_S:
                return f"the controller stopped and did not end: {station.reason_text}"

    def _pump(self) -> None:
        """Do one turn of everything that must not wait: heartbeat, frames, reports, progress."""
        frames = exchange(self._bus, self._station)
        self._log.add(frames)
        self._witness.add(frames)
        now_s = time.monotonic()
        if now_s >= self._next_listen_s:
            self._next_listen_s = now_s + LISTEN_S
            self._log.write_due(time.time())
            self._emulator.listen()
            self._controller.listen()
            leg = self._leg()
            if self._progress.due(now_s, leg):
                self._progress.show(now_s, self._moment(leg))

    def _pump_until(self, done: Callable[[], bool], limit_s: float) -> bool:
        """Go on until `done` or the limit or a second Ctrl-C; return whether it was done."""
        end_s = time.monotonic() + limit_s
        while not done():
            if time.monotonic() > end_s or self._interrupts > 1:
                return False
            self._pump()
        return True

    def _stands(self) -> bool:
        silent = self._station.is_silent("VEH_LongRpt", time.monotonic_ns())
        return silent or self._station.standstill

    # -------------------------------------------------------------------------------------------- how it may go wrong

    def _stop_by_operator(self, *, driving: bool) -> str:
        if not driving:
            return "interrupted before the car drove"
        leg = self._station.leg
        self._station.stop, self._station.start = True, False
        stopped = self._pump_until(lambda: self._controller.ended() or self._stands(), STANDSTILL_LIMIT_S)
        how = "the operator's stop brought the car to standstill" if stopped else "the car was not seen to stop"
        return f"interrupted in leg {leg}: {how}"

    def _emulator_gone(self) -> str:
        self._pump_until(self._controller.ended, NOTICE_S)
        return self._emulator.how_it_ended()

    def _controller_gone(self) -> str | None:
        controller, station = self._controller, self._station
        if controller.status == 0:
            completed = (controller.final or {}).get("completed")
            return None if completed else f"the controller ended early: {station.reason_text}"
        if controller.status == STATUS_USER_ERROR:
            return controller.last_complaint()
        if controller.final is None or "reason" not in controller.final:
            # It died: the vehicle's own watchdog brakes.
            stopped = self._pump_until(self._stands, STANDSTILL_LIMIT_S)
            how = "; the vehicle's watchdog brought the car to standstill" if stopped else ""
            return f"{controller.how_it_ended()}{how}"
        return self._why_stopped(controller.final)

    def _why_stopped(self, final: dict[str, Any]) -> str:
        """Return why the controller stopped the car, in plain words."""
        reason = int(final["reason"])
        text = TEXT.get(reason, f"reason {reason}")
        overruns, stall = final.get("overruns") or 0, final.get("longest_stall_cycles") or 0
        if text == self._overrun_text():
            worst_ms = 1e-3 * (final.get("wake_max_us") or 0.0)
            how = f"{overruns} cycles late, {stall} in a row at most, the latest by {worst_ms:.0f} ms"
            return f"{text}: {how} ({final.get('scheduler')})"
        stalls = []
        if overruns:
            stalls.append(f"the controller's loop was late by {overruns} cycles, {stall} in a row at most")
        if self._witness.longest_silence_ms > NOTEWORTHY_STALL_MS:
            stalls.append(f"the plant was silent for up to {self._witness.longest_silence_ms:.0f} ms")
        if self._station.max_late_ms > NOTEWORTHY_STALL_MS:
            stalls.append(f"the operator's heartbeat was late by up to {self._station.max_late_ms:.0f} ms")
        return f"the controller stopped the car: {text}" + (f" ({'; '.join(stalls)})" if stalls else "")

    @staticmethod
    def _overrun_text() -> str:
        from firmware_py.core.conditions import CYCLE_OVERRUN  # noqa: PLC0415

        return TEXT[CYCLE_OVERRUN]

    def _unclean_end(self) -> str | None:
        for child in (self._controller, self._emulator):
            if child.status != 0:
                return child.how_it_ended()
        return None

    # --------------------------------------------------------------------------------------------------------- ending

    def _end(self) -> None:
        """End both processes, the controller first; whoever does not end in time is killed."""
        for child in (self._controller, self._emulator):
            if child is self._emulator:
                self._pump_until(self._stands, STANDSTILL_LIMIT_S)
            child.terminate()
            # Without a car there is no standstill that the controller could wait for.
            driving = child is self._controller and not self._emulator.ended()
            limit_s = STANDSTILL_LIMIT_S if driving else END_LIMIT_S
            if not self._pump_until(child.ended, limit_s):
                child.kill()
            self._pump()  # its last frames

    @contextlib.contextmanager
    def _signals(self) -> Iterator[None]:
        """Count Ctrl-C and requests to end instead of falling over them."""

        def count(_number: int, _frame: FrameType | None) -> None:
            self._interrupts += 1

        numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
        before = {number: signal.signal(number, count) for number in numbers}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    # ------------------------------------------------------------------------------------------------------- progress

    def _leg(self) -> str:
        station = self._station
        if station.is_silent("CTRL_SysCmd", time.monotonic_ns()):
            return "starting" if not station.mode else "ending"
        if station.mode == ACTIVE or station.reason == COMPLETE:
            return station.leg
        return station.mode if station.reason == NO_REASON else f"{station.mode}: {station.reason}"

    def _moment(self, leg: str) -> Moment:
        report = self._emulator.latest
        if report is not self._shown_report and "x_m" in report:
            self._shown_report = report
            pose = (np.array([float(report[name])]) for name in ("x_m", "y_m", "yaw_rad"))
            at = project(self._path, *pose)
            self._place = float(at.station_m[0]), float(at.cross_track_error_m[0])
        return Moment(
            leg=leg,
            speed_mps=report.get("speed_mps"),
            station_m=self._place[0],
            length_m=self._path.length_m,
            cross_track_error_m=self._place[1],
            clearance_m=report.get("clearance_m"),
            wake_late_p99_us=self._controller.latest.get("wake_late_p99_us"),
        )


class _Witness:
    """What a third party sees of the bus's timing.

    Turnaround: from the newest localisation frame to the steering command after it. `longest_silence_ms`: between two
    of the plant's system reports.
    """

    def __init__(self, station: Station) -> None:
        ids = station.frame_ids
        self._sensor, self._command, self._report = ids["LOC_Attitude"], ids["CTRL_SteerCmd"], ids["VEH_SysRpt"]
        self.longest_silence_ms = 0.0
        self._sensor_s: float | None = None
        self._report_s: float | None = None
        self._samples_us: list[float] = []

    def add(self, frames: list[tuple[float, int, bytes, bool]]) -> None:
        for time_s, arbitration_id, _data, _is_error in frames:
            if arbitration_id == self._sensor:
                self._sensor_s = time_s
            elif arbitration_id == self._report:
                silence_ms = 1e3 * (time_s - (self._report_s or time_s))
                self.longest_silence_ms = max(self.longest_silence_ms, silence_ms)
                self._report_s = time_s
            elif arbitration_id == self._command and self._sensor_s is not None:
                self._samples_us.append(1e6 * (time_s - self._sensor_s))
                self._sensor_s = None

    def figures(self) -> dict[str, float]:
        if not self._samples_us:
            return {}
        p50, p99 = np.percentile(self._samples_us, [50.0, 99.0])
        return {"turnaround_p50_us": float(p50), "turnaround_p99_us": float(p99)}


@contextlib.contextmanager
def _first_among_ordinary(realtime: str | None) -> Iterator[None]:
    """Run at a low real-time priority where that is permitted and wanted, and without garbage collection."""
    changed = False
    if realtime != "off" and hasattr(os, "sched_setscheduler"):
        with contextlib.suppress(OSError):
            policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
            os.sched_setscheduler(0, policy, os.sched_param(PRIORITY))
            changed = True
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
        if changed:
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
