"""The emulator's process: the plant on a CAN bus, in real time. The only reader of a clock in sim, beside the bus.

The plant is integrated to the instants at which things happened, not to those at which this process woke up: a report
is of its tick, and a command acts from the instant at which the kernel took its frame. A late wake-up thus makes a
report late, never wrong; ticks that were missed altogether are skipped.
"""

# ruff: noqa: E402
import sys

sys.modules["firmware_py"] = None  # type: ignore[assignment]  # the plant is not to share a line with the controller

import argparse
import contextlib
import csv
import io
import json
import os
import signal
import stat
import time
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, NoReturn

from sim.errors import UserError

if TYPE_CHECKING:
    import can

    from sim.emulator import Emulator

ROOT = Path(__file__).resolve().parent.parent
DEFAULT_DBC = ROOT / "dbc" / "parking.dbc"
PERIOD_NS = 10_000_000
LISTEN_S = 0.25
SLOWEST_MOTION = 1000
STATUS_TICKS = 20
MOST_FRAMES_A_TURN = 256
OLDEST_STAMP_NS = 10_000_000_000

EXIT_DONE = 0
EXIT_MISTAKE = 2
LEGS = ("Idle", "Forward", "DirectionChange", "Reverse", "Complete")


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise UserError(f"{message} (see {self.prog} --help)")


def build_parser() -> argparse.ArgumentParser:
    """Return the options of the emulator's process."""
    parser = _Parser(
        prog="parkctl emulate",
        description="The car on the other end of the bus: plant, sensors, drive-by-wire system and examiner. "
        "Runs until SIGINT or SIGTERM, then writes what it saw.",
    )
    bus = parser.add_argument_group("CAN bus (python-can's names)")
    bus.add_argument("-i", "--interface", default="loopbus", help="loopbus (default), socketcan, kvaser, ...")
    bus.add_argument("-c", "--channel", help="base UDP port of loopbus (29500), vcan0, can0, ...")
    bus.add_argument("-b", "--bitrate", type=int, help="bit/s, where the interface sets it")
    bus.add_argument("--no-config", action="store_true", help="ignore CAN_* variables and can.conf; always so here")
    what = parser.add_argument_group("what is emulated (NAME of a shipped file or path of a FILE)")
    what.add_argument("--vehicle", default="paper", metavar="NAME|FILE", help="the car (default: paper)")
    what.add_argument("--course", metavar="NAME|FILE", help="cones, start, stop (default: the scenario's, else ohio)")
    what.add_argument("--scenario", default="car", metavar="NAME|FILE", help="what is not ideal (default: car)")
    what.add_argument("--side", choices=("left", "right"), default="left", help="side to pass the point cone on")
    what.add_argument("--seed", type=int, default=1, metavar="N", help="decides every random draw (default: 1)")
    what.add_argument("--dbc", type=Path, default=DEFAULT_DBC, metavar="FILE", help="the messages")
    how = parser.add_argument_group("how")
    how.add_argument(
        "--phase-ms", type=float, default=3.0, metavar="MS", help="reports this long before multiples of 10 ms (3)"
    )
    how.add_argument("--duration", type=float, metavar="S", help="end by itself after this time")
    how.add_argument("--realtime", choices=("auto", "off", "required"), default="auto", help="use of SCHED_FIFO")
    how.add_argument(
        "--slow-motion", type=int, default=1, metavar="N",
        help="a second of the plant lasts N, for a machine that cannot keep up; N must be the controller's too",
    )  # fmt: skip
    how.add_argument("--status", action="store_true", help="one JSON line on standard output every 0.2 s")
    how.add_argument("--out", type=Path, metavar="DIR", help="folder for truth.csv and exam.json, written at the end")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Run the emulator; returns 0 after a clean end, 2 after a user's mistake."""
    try:
        options = build_parser().parse_args(arguments)
        return _run(options)
    except UserError as error:
        print(f"parkctl: error: {error}", file=sys.stderr)
        return EXIT_MISTAKE


def _run(options: argparse.Namespace) -> int:
    from sim.can_side import CanSide  # noqa: PLC0415
    from sim.data_files import load_course, load_scenario, load_vehicle  # noqa: PLC0415
    from sim.emulator import Emulator  # noqa: PLC0415
    from sim.realtime import set_up  # noqa: PLC0415

    if not 0.0 <= options.phase_ms < 10.0:
        raise UserError(f"--phase-ms {options.phase_ms:g}: must be from 0 to less than 10")
    if options.duration is not None and not options.duration > 0.0:
        raise UserError(f"--duration {options.duration:g}: must be more than 0")
    if not 1 <= options.slow_motion <= SLOWEST_MOTION:
        raise UserError(f"--slow-motion {options.slow_motion}: must be from 1 to {SLOWEST_MOTION}")
    vehicle, scenario = load_vehicle(options.vehicle), load_scenario(options.scenario)
    course = load_course(options.course or scenario.course or "ohio")
    phase_ns = round(options.phase_ms * 1e6)

    def make(start_ns: int) -> Emulator:
        return Emulator(vehicle, course, scenario, options.side, options.seed, options.dbc, start_ns)

    # Whatever is wrong with the files is said before the bus is touched.
    own_ids = {arbitration_id for arbitration_id, _ in make(0).reports(0)}
    if options.out is not None:
        _make_folder(options.out)
    end = _EndSignal()
    known_ids = [reception.message.frame_id for reception in CanSide(options.dbc, nodes=()).received.values()]
    bus = _open_bus(options.interface, options.channel, options.bitrate, known_ids)
    try:
        realtime = set_up(options.realtime)
        _refuse_second_vehicle(bus, own_ids, LISTEN_S * options.slow_motion)
        clock = _Clock(options.slow_motion)
        emulator = make(_tick_after(clock.now_ns(), phase_ns))
        print(f"plant emulator on {bus.channel_info}: {realtime}", file=sys.stderr, flush=True)
        duration_ns = None if options.duration is None else round(options.duration * 1e9)
        _Loop(emulator, bus, clock, status=options.status, end=end).run(duration_ns)
    finally:
        with contextlib.suppress(Exception):
            bus.shutdown()
    if options.out is not None:
        write_results(emulator, options.out)
    return EXIT_DONE


class _Clock:
    """The plant's time: the monotonic clock, or the same in slow motion, where a second of it lasts several."""

    def __init__(self, slow_motion: int) -> None:
        self.slow_motion = slow_motion

    def now_ns(self) -> int:
        return time.monotonic_ns() // self.slow_motion


class _EndSignal:
    """Becomes true on SIGINT or SIGTERM."""

    def __init__(self) -> None:
        self.has_come = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._note)

    def _note(self, _number: int, _frame: FrameType | None) -> None:
        self.has_come = True


def _tick_after(now_ns: int, phase_ns: int) -> int:
    """Return the next instant of the reports' grid: multiples of 10 ms of the monotonic clock, less the phase."""
    return (now_ns + phase_ns) // PERIOD_NS * PERIOD_NS + PERIOD_NS - phase_ns


class _Loop:
    """Frames in as they come, reports out on the grid."""

    def __init__(
        self, emulator: "Emulator", bus: "can.BusABC", clock: _Clock, *, status: bool, end: _EndSignal
    ) -> None:
        import can  # noqa: PLC0415  loaded by now

        self._emulator = emulator
        self._bus = bus
        self._clock = clock
        self._end = end
        self._message = can.Message
        self._bus_errors = (can.CanError, OSError)
        self._arrived_ns = emulator.now_ns
        self._ticks = 0
        self._shown: tuple[int, int] | None = None
        self._status = _StatusLine() if status else None
        self.bus_failures = 0

    def run(self, duration_ns: int | None) -> None:
        """Run until the end signal, or for a time."""
        emulator = self._emulator
        tick_ns = emulator.now_ns
        end_ns = None if duration_ns is None else tick_ns + duration_ns
        while True:
            frames = self._frames_until(tick_ns)
            missed = (self._clock.now_ns() - tick_ns) // PERIOD_NS
            if missed > 0:
                tick_ns += missed * PERIOD_NS
            later = []
            for frame in frames:
                if frame[0] <= tick_ns:
                    emulator.receive(*frame)
                else:
                    later.append(frame)
            self._send(emulator.reports(tick_ns))
            for frame in later:
                emulator.receive(*frame)
            self._ticks += 1
            if self._ticks % STATUS_TICKS == 1:
                self._tell()
            tick_ns += PERIOD_NS
            if self._end.has_come or (end_ns is not None and tick_ns >= end_ns):
                return

    def _frames_until(self, tick_ns: int) -> list[tuple[int, int, bytes]]:
        """Wait for the tick and take what comes meanwhile: at once what is before it, as a list what is to be sorted.

        After a stall much may wait whose instants lie before the tick that will be served, so nothing is acted on
        before all of it is here; in the ordinary case each frame is handed over as it comes.
        """
        waiting: list[tuple[int, int, bytes]] = []
        while True:
            rest_ns = tick_ns - self._clock.now_ns()
            frame = self._receive(rest_ns * 1e-9 * self._clock.slow_motion if rest_ns > 0 else 0.0)
            if frame is not None:
                if rest_ns > 0 and frame[0] <= tick_ns:
                    self._emulator.receive(*frame)
                else:
                    waiting.append(frame)
            elif rest_ns <= 0:
                return waiting
            if len(waiting) >= MOST_FRAMES_A_TURN:
                return waiting

    def _receive(self, timeout_s: float) -> tuple[int, int, bytes] | None:
        """Return (instant of arrival, id, data) of the next data frame, None where there is none."""
        try:
            message = self._bus.recv(timeout_s)
        except self._bus_errors:
            self.bus_failures += 1
            time.sleep(min(timeout_s, 0.001))
            return None
        if message is None or message.is_error_frame or message.is_remote_frame or message.is_extended_id:
            return None
        now_ns = self._clock.now_ns()
        age_ns = time.time_ns() - round(message.timestamp * 1e9)
        if 0 < age_ns < OLDEST_STAMP_NS:  # else the driver's stamps are of another clock
            now_ns -= age_ns // self._clock.slow_motion
        self._arrived_ns = max(self._arrived_ns, now_ns)
        return self._arrived_ns, message.arbitration_id, bytes(message.data)

    def _send(self, frames: list[tuple[int, bytes]]) -> None:
        for arbitration_id, data in frames:
            try:
                self._bus.send(self._message(arbitration_id=arbitration_id, data=data, is_extended_id=False))
            except self._bus_errors:
                self.bus_failures += 1

    def _tell(self) -> None:
        emulator = self._emulator
        state = (int(emulator.state), int(emulator.reason))
        if state != self._shown:
            self._shown = state
            line = f"vehicle {emulator.state.name.title()}: {emulator.reason.name.lower().replace('_', ' ')}\n"
            with contextlib.suppress(OSError):
                os.write(2, line.encode())
        if self._status is not None:
            self._status.write(status_of(emulator))


def status_of(emulator: "Emulator") -> dict[str, Any]:
    """Return what a watcher wants to know of the present instant; rear-axle pose, SI units."""
    row = emulator.truth[-1]
    return {
        "t_s": round(row.t_s, 3),
        "state": row.state,
        "state_text": emulator.state.name.title(),
        "reason": int(emulator.reason),
        "x_m": row.x_m,
        "y_m": row.y_m,
        "yaw_rad": row.yaw_rad,
        "speed_mps": row.speed_mps,
        "gear": row.gear,
        "leg": LEGS[emulator.control_leg] if emulator.control_leg < len(LEGS) else str(emulator.control_leg),
        "clearance_m": row.min_clearance_m,
        "cones_touched": emulator.examiner.cones_touched,
        "rejected": emulator.rejected_count,
        "lost": emulator.lost_count,
    }


class _StatusLine:
    """JSON lines on standard output; a reader that does not keep up misses lines, the plant does not wait."""

    def __init__(self) -> None:
        if stat.S_ISFIFO(os.fstat(1).st_mode):
            os.set_blocking(1, False)

    def write(self, status: dict[str, Any]) -> None:
        with contextlib.suppress(OSError):
            os.write(1, (json.dumps(status) + "\n").encode())  # shorter than PIPE_BUF: all or nothing


def _open_bus(interface: str, channel: str | None, bitrate: int | None, ids: list[int]) -> "can.BusABC":
    """Open the bus; on SocketCAN the kernel passes on these ids only, and a flood of others costs the plant nothing."""
    import logging  # noqa: PLC0415

    import can  # noqa: PLC0415

    logging.getLogger("can").setLevel(logging.CRITICAL)  # what goes wrong is said once, below
    if channel is None and interface != "loopbus":
        raise UserError(f"-i {interface}: name the channel too, as in -c vcan0; a physical bus is never guessed")
    given: dict[str, Any] = {"interface": interface}
    given |= {} if channel is None else {"channel": channel}
    given |= {} if bitrate is None else {"bitrate": bitrate}
    try:
        if interface == "socketcan":
            from sim.quick_socketcan import QuickSocketcanBus  # noqa: PLC0415

            return QuickSocketcanBus(str(channel), ids)
        return can.Bus(ignore_config=True, **given)
    except (can.CanError, ImportError, NotImplementedError, OSError, TypeError, ValueError) as error:
        text = " ".join(str(error).split())
        raise UserError(text if text.startswith(interface) else f"-i {interface} -c {channel}: {text}") from None


def _refuse_second_vehicle(bus: "can.BusABC", own_ids: set[int], listen_s: float) -> None:
    """Listen for a while: two vehicles under the same ids would be one that jumps."""
    end_s = time.monotonic() + listen_s
    while (rest_s := end_s - time.monotonic()) > 0.0:
        message = bus.recv(rest_s)
        if message is not None and not message.is_error_frame and message.arbitration_id in own_ids:
            raise UserError(f"{bus.channel_info}: a vehicle already sends there; end it, or take another channel")


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"--out {folder}: cannot be made a folder: {error.strerror}") from None
    if not os.access(folder, os.W_OK):
        raise UserError(f"--out {folder}: may not be written to")


def write_results(emulator: "Emulator", folder: Path) -> None:
    """Write truth.csv (a row a tick, names and units of TruthRow) and exam.json (the examiner's card), each whole."""
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(type(emulator.truth[0])._fields)
    rows.writerows(map(repr, row) for row in emulator.truth)
    _write_whole(folder / "truth.csv", text.getvalue())
    _write_whole(folder / "exam.json", json.dumps(emulator.examiner.verdict().as_dict(), indent=2) + "\n")


def _write_whole(path: Path, text: str) -> None:
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        temporary.write_text(text)
        temporary.replace(path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise UserError(f"{path}: cannot be written: {error.strerror}") from None


if __name__ == "__main__":
    sys.exit(main())
