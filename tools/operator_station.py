"""The operator station: heartbeat and push buttons in OPER_Cmd, and what the others say about themselves.

`parkctl demo` plays it within its own loop; `parkctl operate` is the station alone, with keys, on any bus.
"""

from __future__ import annotations

import contextlib
import functools
import os
import select
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, NamedTuple

from firmware_py.reasons import TEXT
from sim.errors import UserError
from tools.buses import add_bus_arguments, open_bus, opened

if TYPE_CHECKING:
    import argparse

    import can

    from sim.can_side import CanSide

DBC = Path(__file__).resolve().parent.parent / "dbc" / "parking.dbc"
MANUAL, READY, ACTIVE, FAULT = "Manual", "Ready", "Active", "Fault"
COMPLETE = "Complete"
NO_REASON = "None"
CLEAR_HOLD_S = 0.5
START_HOLD_S = 0.3
SLOWEST_MOTION = 1000
GONE_S = 5.0
"""Who was heard once, and then not for so long, is not waited for: longer than an interface takes to come up again."""
POLL_S = 0.005
"""Longest wait of a loop that plays the station: a quarter of the heartbeat's cycle time."""


class _Description(NamedTuple):
    """What the station needs of the DBC: ids by message, texts by signal and value, the heartbeat's cycle time."""

    frame_ids: dict[str, int]
    choices: dict[str, dict[int, str]]
    heartbeat_ns: int


@functools.cache
def _describe(dbc_path: Path) -> _Description:
    from sim.can_side import CanSide  # noqa: PLC0415

    messages = {name: reception.message for name, reception in CanSide(dbc_path, nodes=()).received.items()}
    cycle_time_ms = messages["OPER_Cmd"].cycle_time if "OPER_Cmd" in messages else None
    if not cycle_time_ms:
        raise UserError(f'DBC file {dbc_path}: message OPER_Cmd with the attribute "GenMsgCycleTime" is missing')
    return _Description(
        frame_ids={name: message.frame_id for name, message in messages.items()},
        choices={
            item.name: {int(number): str(choice) for number, choice in item.choices.items()}
            for message in messages.values()
            for item in message.signals
            if item.choices
        },
        heartbeat_ns=int(cycle_time_ms) * 1_000_000,
    )


class Station:
    """Heartbeat and buttons towards the bus; modes, leg, reason and standstill as heard from it.

    Frames of other nodes are checked (CRC, counter) before they count. `max_late_ms` is the longest delay of a
    heartbeat against its cycle time.
    """

    def __init__(self, dbc_path: Path) -> None:
        from sim.can_side import CanSide  # noqa: PLC0415

        description = _describe(dbc_path)
        heard = {"CTRL_SysCmd", "CTRL_Track", "VEH_SysRpt", "VEH_LongRpt", "VEH_MotionRpt"}
        self.side: CanSide = CanSide(dbc_path, nodes=("OPER",), check_only=set(description.frame_ids) - heard)
        self.values: dict[str, dict[str, Any]] = {}
        self.heard_ns: dict[str, int] = {}
        self.start = self.stop = self.estop = self.clear = False
        self.max_late_ms = 0.0
        self.frame_ids = description.frame_ids
        self._choices = description.choices
        self._period_ns = description.heartbeat_ns
        self._due_ns = 0
        self._ready_ns = 0
        self._has_driven = False
        self.completions = 0
        """How often a manoeuvre was completed: the controller may be Ready again before one looks."""

    def heartbeat(self, now_ns: int) -> tuple[int, bytes] | None:
        """Return the frame that is due now, or None; skipped periods are not made up for."""
        if now_ns < self._due_ns:
            return None
        if self._due_ns:
            self.max_late_ms = max(self.max_late_ms, 1e-6 * (now_ns - self._due_ns))
        self._due_ns += self._period_ns
        if self._due_ns <= now_ns:
            self._due_ns = now_ns + self._period_ns
        buttons = {"start": self.start, "stop": self.stop, "estop": self.estop, "clear": self.clear}
        return self.side.encode("OPER_Cmd", {f"oper_{name}": int(pressed) for name, pressed in buttons.items()})

    def hear(self, now_ns: int, arbitration_id: int, data: bytes) -> None:
        """Take in a frame of the bus."""
        decoded = self.side.decode(now_ns, arbitration_id, data)
        if decoded is not None:
            name, values = decoded
            self.heard_ns[name] = now_ns
            if values:
                was_active = name == "CTRL_SysCmd" and self.mode == ACTIVE
                self.values[name] = values
                if was_active and self.mode == MANUAL and self.reason == COMPLETE:
                    self.completions += 1

    def is_silent(self, name: str, now_ns: int) -> bool:
        """Whether no valid frame of the message has come for its timeout."""
        return name not in self.heard_ns or now_ns - self.heard_ns[name] > self.side.timeout_ns(name)

    def is_gone(self, name: str, now_ns: int) -> bool:
        """Whether the message has been heard, and then not for GONE_S."""
        return name in self.heard_ns and now_ns - self.heard_ns[name] > 1e9 * GONE_S

    def text(self, message: str, signal_name: str) -> str:
        """Return a signal's newest value as the DBC's value table names it; empty where nothing was heard."""
        value = self.values.get(message, {}).get(signal_name)
        return "" if value is None else self._choices.get(signal_name, {}).get(int(value), str(value))

    @property
    def mode(self) -> str:
        """The controller's mode."""
        return self.text("CTRL_SysCmd", "control_mode")

    @property
    def leg(self) -> str:
        """The leg that the controller drives."""
        return self.text("CTRL_SysCmd", "control_leg")

    @property
    def reason(self) -> str:
        """Why the controller is not Active."""
        return self.text("CTRL_SysCmd", "control_reason")

    @property
    def standstill(self) -> bool:
        """Whether the vehicle reports standstill."""
        return bool(self.values.get("VEH_LongRpt", {}).get("standstill", 0))

    @property
    def reason_text(self) -> str:
        """The controller's reason in plain words, with its name."""
        values = self.values.get("CTRL_SysCmd")
        if values is None:
            return "the controller has not been heard on the bus"
        return f"{TEXT.get(int(values['control_reason']), 'unknown reason')} ({self.reason})"

    def press_start_when_ready(self, now_ns: int) -> None:
        """Press start for a moment each time the controller becomes Ready, until it has driven: one start, one test."""
        self._has_driven |= self.mode == ACTIVE
        if self.mode != READY or self._has_driven:
            self._ready_ns = 0
        elif not self._ready_ns:
            self._ready_ns = now_ns
        self.start = bool(self._ready_ns) and now_ns - self._ready_ns < int(1e9 * START_HOLD_S)

    def allow_another_start(self) -> None:
        """Let `press_start_when_ready` press start again: for one more test with the same car."""
        self._has_driven = False


class Ending(NamedTuple):
    """How a manoeuvre that had begun is over: whether completed, and if not, why, in plain words."""

    completed: bool
    why: str


def ending_of(station: Station, now_ns: int) -> Ending | None:
    """Return how the manoeuvre is over, for a controller that has been Active; None while it may go on.

    Over it is only with a car that is heard to stand, or is not heard any more: a controller that still waits for the
    gear misses its operator. A short silence decides nothing. Who is silent because the bus was away has a reason to
    tell afterwards; and a car may well stand while its controller drives, as in the change of direction.
    """
    car_gone = station.is_gone("VEH_LongRpt", now_ns)
    stands = station.standstill and not station.is_silent("VEH_LongRpt", now_ns)
    if not (stands or car_gone):
        return None
    where = "" if stands else "; the vehicle is silent, too"
    last = f"{station.mode}, {station.leg}, {station.reason}"
    if station.mode == MANUAL and station.reason == COMPLETE:
        return Ending(completed=True, why="")
    if station.mode == FAULT:
        return Ending(completed=False, why=station.reason_text + where)
    if station.is_gone("CTRL_SysCmd", now_ns):
        return Ending(completed=False, why=f"the controller fell silent on the bus; its last words: {last}{where}")
    if station.mode in (MANUAL, READY) and not station.is_silent("CTRL_SysCmd", now_ns):
        return Ending(completed=False, why=f"the controller has begun anew: {last}{where}")
    return None


def text_of_state(station: Station, now_ns: int) -> str:
    """Return one line on how controller and vehicle are."""
    if station.is_silent("CTRL_SysCmd", now_ns):
        controller = "controller silent"
    else:
        controller = f"controller {station.mode}, {station.leg}, {station.reason}"
    if station.is_silent("VEH_SysRpt", now_ns):
        return f"{controller} | vehicle silent"
    speed_mps = station.values.get("VEH_MotionRpt", {}).get("speed_meas_mps", 0.0)
    motion = "standstill" if station.standstill else f"{speed_mps:+.2f} m/s"
    vehicle = f"vehicle {station.text('VEH_SysRpt', 'vehicle_state')}, {station.text('VEH_SysRpt', 'vehicle_reason')}"
    return f"{controller} | {vehicle}, {motion}"


KEYS = "s start   space stop   e emergency stop   c clear   q quit"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `parkctl operate`."""
    add_bus_arguments(parser, default_text="else CAN_* variables and can.conf count, then loopbus")
    parser.add_argument(
        "--dbc", default=str(DBC), metavar="FILE", help="message description (default: the shipped DBC)"
    )
    parser.add_argument(
        "--auto",
        action="store_true",
        help="no keys: press start when the controller is Ready, end when it has finished",
    )
    parser.add_argument(
        "--slow-motion", type=int, default=1, metavar="N", help="a second lasts N, as with drive and emulate"
    )


def run(args: argparse.Namespace) -> int:
    """Be the operator station until the operator quits; with --auto until the manoeuvre is over.

    Exit status 0 where the operator quit, or the manoeuvre was completed; 1 where it was not: the controller stopped
    with a fault, or was not heard any more.
    """
    if not args.auto and not sys.stdin.isatty():
        raise UserError("operate: its keys need a terminal; use --auto to press start without one")
    if not 1 <= args.slow_motion <= SLOWEST_MOTION:
        raise UserError(f"--slow-motion {args.slow_motion}: must be from 1 to {SLOWEST_MOTION}")
    station = Station(Path(args.dbc))
    interface, channel = args.interface, args.channel
    if interface is None and not _is_configured():
        interface = "loopbus"
    ids = station.frame_ids.values()
    with opened(open_bus(interface, channel, args.bitrate, ignore_settings=interface is not None, only_ids=ids)) as bus:
        return _Console(station, bus, auto=args.auto, slow_motion=args.slow_motion).run()


def _is_configured() -> bool:
    import can  # noqa: PLC0415

    return bool(can.util.load_file_config().get("interface") or can.util.load_environment_config().get("interface"))


class _Console:
    """The station with its keys and its lines."""

    def __init__(self, station: Station, bus: can.BusABC, *, auto: bool, slow_motion: int) -> None:
        self._slow_motion = slow_motion
        self._station = station
        self._bus = bus
        self._auto = auto
        self._quits = 0
        self._clear_until_ns = 0
        self._shown = ""
        self._was_active = False

    def run(self) -> int:
        if not self._auto:
            print(KEYS, flush=True)
        previous = signal.signal(signal.SIGINT, self._on_interrupt)
        try:
            with _keys_one_by_one(enabled=not self._auto):
                return self._loop()
        finally:
            signal.signal(signal.SIGINT, previous)

    def _on_interrupt(self, _number: int, _frame: FrameType | None) -> None:
        self._quits += 1

    def _loop(self) -> int:
        station = self._station
        while True:
            now_ns = time.monotonic_ns() // self._slow_motion
            exchange(self._bus, station, self._slow_motion)
            if not self._auto:
                self._keys(now_ns)
            station.clear = now_ns < self._clear_until_ns
            self._was_active |= station.mode == ACTIVE
            if self._auto:
                station.press_start_when_ready(now_ns)
            elif station.mode in (ACTIVE, FAULT):
                station.start = False
            self._say(now_ns)
            status = self._finished(now_ns)
            if status is not None:
                return status

    def _finished(self, now_ns: int) -> int | None:
        station = self._station
        if self._quits:
            # Leaving while the car drives would stop it by timeout; the stop button does it in good order.
            station.stop, station.start = True, False
            moving = not station.is_silent("VEH_LongRpt", now_ns) and not station.standstill
            return 0 if self._quits > 1 or not moving else None
        ending = ending_of(station, now_ns) if self._auto and self._was_active else None
        if ending is None:
            return None
        if not ending.completed:
            print(f"parkctl: stopped: {ending.why}", file=sys.stderr)
        return 0 if ending.completed else 1

    def _keys(self, now_ns: int) -> None:
        while select.select([sys.stdin], [], [], 0)[0]:
            key = os.read(sys.stdin.fileno(), 1).decode(errors="replace").lower()
            station = self._station
            if key == "s":
                station.stop, station.start = False, True
            elif key == " ":
                station.stop, station.start = True, False
            elif key == "e":
                station.estop, station.start = True, False
            elif key == "c":
                station.estop = station.stop = False
                self._clear_until_ns = now_ns + int(1e9 * CLEAR_HOLD_S)
            elif key in {"q", ""}:
                self._quits += 1
                if not key:
                    return

    def _say(self, now_ns: int) -> None:
        pressed = [name for name in ("start", "stop", "estop", "clear") if getattr(self._station, name)]
        text = text_of_state(self._station, now_ns) + (f" | pressed: {', '.join(pressed)}" if pressed else "")
        if _without_speed(text) != _without_speed(self._shown):
            self._shown = text
            print(text, flush=True)


def _without_speed(text: str) -> str:
    return " ".join(word for word in text.split() if word[0] not in "+-" and word != "m/s")


def exchange(bus: can.BusABC, station: Station, slow_motion: int = 1) -> list[tuple[float, int, bytes, bool]]:
    """Send the heartbeat if due, take in all that has come, and wait at most POLL_S for more.

    Returns (Unix time in s, arbitration id, data, is error frame) of every frame, the station's own included. A frame
    that the driver refuses is not sent again: the next heartbeat follows within its cycle time. A second of the station
    lasts `slow_motion` seconds.
    """
    import can  # noqa: PLC0415

    seen: list[tuple[float, int, bytes, bool]] = []
    now_ns = time.monotonic_ns() // slow_motion
    frame = station.heartbeat(now_ns)
    if frame is not None:
        with contextlib.suppress(can.CanError, OSError):
            bus.send(can.Message(arbitration_id=frame[0], data=frame[1], is_extended_id=False))
            seen.append((time.time(), *frame, False))
    wait_s = POLL_S
    for _ in range(256):
        try:
            message = bus.recv(wait_s)
        except (can.CanError, OSError):
            time.sleep(POLL_S)
            break
        if message is None:
            break
        wait_s = 0.0
        data = bytes(message.data)
        seen.append((message.timestamp, message.arbitration_id, data, message.is_error_frame))
        if not (message.is_error_frame or message.is_extended_id or message.is_remote_frame):
            station.hear(time.monotonic_ns() // slow_motion, message.arbitration_id, data)
    return seen


@contextlib.contextmanager
def _keys_one_by_one(*, enabled: bool) -> Iterator[None]:
    """Have the terminal hand over each key at once and unseen; put it back in the end."""
    if not enabled:
        yield
        return
    import termios  # noqa: PLC0415
    import tty  # noqa: PLC0415

    before = termios.tcgetattr(sys.stdin)
    tty.setcbreak(sys.stdin)
    try:
        yield
    finally:
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)
