"""Preflight: what must be right before the car may be armed, a verdict a line. It listens; it never sends.

`check_machine` holds what is true or not before a frame has come; the controller itself runs it too and does not start
where one fails. What depends on the bus at run time (reports, their rates, hashes, a second controller) the controller
keeps watching by itself: `core/health.py`, `rates.py`. `run` is the whole checklist.
"""

import json
import os
import subprocess
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

from firmware_py.bus import Bus, Heard, frame_bits
from firmware_py.codec import FRAME_BYTES, INPUT_MESSAGES, NODE, Codec, Mailbox, MessageInfo
from firmware_py.core.health import PROTOCOL
from firmware_py.core.signals import MODE_ACTIVE, Inputs
from firmware_py.errors import UserError
from firmware_py.loop import clock_resolution_ns, listen
from firmware_py.realtime import Outcome
from firmware_py.table_file import TableSet

BITRATE = 500_000
"""bit/s of a physical bus, where -b names no other (dbc/CONVENTIONS.md, section 2)."""

LISTEN_S = 3.0
HAND_WHEEL_S = 20.0

HAND_WHEEL_TURN_RAD = 0.05
"""At the road wheel; some 40 degrees at the hand wheel: no accident, and possible at standstill."""

CYCLE_TIME_SHARE = 0.10
"""How far the mean cycle time of a report may be from the DBC's."""

JITTER_SHARE = 0.5
"""How far, in cycle times, 99 % of a report's intervals may be from it."""

GAP_SHARE = 0.5
"""How long, in timeouts, the longest silence of a report may be."""

LOAD_SHARE = 0.7
"""Bus load up to which the lowest priority still gets through in time; the controller's own frames counted in."""

LATE_P99_US = 1000.0
"""Lateness of the wake-ups that a physical bus asks for: a tenth of the cycle."""

CLOCK_RESOLUTION_NS = 1000

DISK_MIB = 64
"""Room for a quarter of an hour of bus log and the records."""

SYS_NET = Path("/sys/class/net")
CLOCK_SOURCE = Path("/sys/devices/system/clocksource/clocksource0/current_clocksource")
CAN_LINK_TYPE = "280"  # ARPHRD_CAN, linux/if_arp.h
IFF_UP = 1

EXIT_PASSED = 0
EXIT_FAILED = 1


class Check(NamedTuple):
    """One line of the checklist; `passed` is None for what was skipped at the operator's wish."""

    name: str
    passed: bool | None
    text: str


# ------------------------------------------------------------------------------------- the machine and its interface


def check_machine(bus: Bus, folder: Path) -> list[Check]:
    """Return the verdicts on what needs no frame: interface, bit rate, clock, room for the log in `folder`."""
    return [*check_link(bus), check_clock(), check_disk(folder)]


def refuse_unfit_machine(bus: Bus, folder: Path | None) -> None:
    """Raise UserError where a check of the machine fails; without a folder nothing is to be written."""
    for check in check_machine(bus, folder or Path()):
        if not check.passed and (check.name != "disk" or folder is not None):
            raise UserError(f"not to be armed: {check.name}: {check.text}")


def check_link(bus: Bus) -> list[Check]:
    """Return the verdicts on the interface and its bit rate."""
    name = f"{bus.interface} {bus.channel}".strip()
    wanted = bus.bitrate or BITRATE
    if bus.interface == "socketcan":
        return _check_socketcan(bus.channel, wanted, physical=bus.is_physical)
    opened = Check("interface", True, f"{name} is open")
    if not bus.is_physical:
        return [opened, Check("bit rate", True, "this bus has none")]
    if bus.bitrate is None:
        return [opened, Check("bit rate", False, f"not named: give -b {BITRATE}, what the DBC asks for")]
    return [opened, Check("bit rate", True, f"{bus.bitrate} bit/s, set by the driver")]


def _check_socketcan(channel: str, wanted: int, *, physical: bool) -> list[Check]:
    up = f"ip link set {channel} up" + (f" type can bitrate {wanted} restart-ms 100" if physical else "")
    folder = SYS_NET / channel
    try:
        flags = int((folder / "flags").read_text(), 16)
        kind = (folder / "type").read_text().strip()
    except (OSError, ValueError):
        return [Check("interface", False, f"there is no {channel}; `ip link` lists those that there are")]
    if kind != CAN_LINK_TYPE:
        return [Check("interface", False, f"{channel} is no CAN interface")]
    if not flags & IFF_UP:
        return [Check("interface", False, f"{channel} is down: {up}")]
    if not physical:
        return [Check("interface", True, f"{channel} is up"), Check("bit rate", True, "this bus has none")]
    try:
        link = _read_link(channel)
    except UserError as error:
        return [Check("interface", True, f"{channel} is up"), Check("bit rate", False, str(error))]
    data = link.get("linkinfo", {}).get("info_data", {})
    state = str(data.get("state", "unknown state"))
    bitrate = data.get("bittiming", {}).get("bitrate")
    text = f"{channel} is up, {state}, txqueuelen {link.get('txqlen', '?')}, restart-ms {data.get('restart_ms', 0)}"
    healthy = state in ("ERROR-ACTIVE", "ERROR-WARNING")
    if not healthy:
        text += ": look for a wrong bit rate, missing termination, nobody who acknowledges"
    return [
        Check("interface", healthy, text),
        Check(
            "bit rate",
            bitrate == wanted,
            f"{bitrate} bit/s"
            if bitrate == wanted
            else f"{bitrate} bit/s, must be {wanted}: ip link set {channel} down, then {up}",
        ),
    ]


def _read_link(channel: str) -> dict[str, Any]:
    """Return what the kernel knows of a CAN interface; its bit rate is told by netlink only, hence by `ip`."""
    try:
        answer = subprocess.run(
            ["ip", "-details", "-json", "link", "show", "dev", channel],
            capture_output=True,
            text=True,
            timeout=5.0,
            check=True,
        ).stdout
        link = json.loads(answer)[0]
    except FileNotFoundError:
        raise UserError("cannot be read: the program ip is missing (package iproute2)") from None
    except (OSError, subprocess.SubprocessError, ValueError, LookupError):
        raise UserError(f"cannot be read: `ip -details -json link show dev {channel}` failed") from None
    if not isinstance(link, dict):
        raise UserError(f"cannot be read: `ip -details -json link show dev {channel}` says nothing of it")
    return link


def check_clock() -> Check:
    """Return the verdict on the clock that paces the loop."""
    resolution_ns = clock_resolution_ns()
    try:
        source = f", clock source {CLOCK_SOURCE.read_text().strip()}"
    except OSError:
        source = ""
    text = f"monotonic, resolution {resolution_ns} ns{source}"
    fine = resolution_ns <= CLOCK_RESOLUTION_NS
    return Check("clock", fine, text if fine else f"{text}; must be {CLOCK_RESOLUTION_NS} ns or less")


def check_disk(folder: Path) -> Check:
    """Return the verdict on the room for the log."""
    try:
        room = os.statvfs(folder)
    except OSError as error:
        return Check("disk", False, f"{folder}: {error.strerror}")
    free_mib = room.f_bavail * room.f_frsize >> 20
    text = f"{free_mib} MiB free in {folder.resolve()}"
    return Check("disk", free_mib >= DISK_MIB, text if free_mib >= DISK_MIB else f"{text}; must be {DISK_MIB} MiB")


# ------------------------------------------------------------------------------------------------------ what is heard


class Listener:
    """Collects what is heard: stamps of each report, rejected frames by name and reason, bits, wake-ups."""

    def __init__(self, codec: Codec) -> None:
        self.mailbox = Mailbox(codec)
        self.stamps_s: dict[str, list[float]] = {name: [] for name in INPUT_MESSAGES}
        self.rejected: dict[str, int] = {}
        self.late_ns: list[int] = []
        self.bits = 0
        self.errors = 0
        self.foreign_ids: set[int] = set()
        self._names = {info.frame_id: name for name, info in codec.messages.items()}
        self._begun_ns = self._ended_ns = 0

    def take(self, now_ns: int, late_ns: int, heard: list[Heard]) -> bool:
        """Take in one wake-up's frames; never says that it is enough."""
        if not self.late_ns:
            # What waited in the driver's queue before is not of this time.
            self._begun_ns = now_ns
            heard = []
        self._ended_ns = now_ns
        self.late_ns.append(late_ns)
        for frame in heard:
            self._take_frame(now_ns, frame)
        return False

    @property
    def duration_s(self) -> float:
        """How long was listened."""
        return (self._ended_ns - self._begun_ns) * 1e-9

    def _take_frame(self, now_ns: int, frame: Heard) -> None:
        if frame.is_error:
            self.errors += 1
            return
        self.bits += frame.bits
        name = self._names.get(frame.arbitration_id) if frame.is_plain else None
        if name is None:
            self.foreign_ids.add(frame.arbitration_id)
            return
        mailbox = self.mailbox
        received = mailbox.received
        before = (mailbox.rejected_crc, mailbox.rejected_counter, mailbox.rejected_length)
        mailbox.put(now_ns, frame.arbitration_id, frame.data)
        if mailbox.received > received:
            self.stamps_s[name].append(frame.stamp_s or now_ns * 1e-9)
        after = (mailbox.rejected_crc, mailbox.rejected_counter, mailbox.rejected_length)
        for reason, was, now in zip(("CRC", "counter", "length"), before, after, strict=True):
            if now > was:
                key = f"{name} {reason}"
                self.rejected[key] = self.rejected.get(key, 0) + 1


def check_heard(listener: Listener, inputs: Inputs, codec: Codec, table_set: TableSet, bitrate: int) -> list[Check]:
    """Return the verdicts on what was heard; `inputs` are the newest valid values."""
    reports = [check_cycle(codec.messages[name], listener.stamps_s[name]) for name in INPUT_MESSAGES]
    return [
        _check_free(inputs),
        _check_load(listener, codec, bitrate),
        *reports,
        _check_counters(listener),
        *_check_versions(listener, inputs, codec, table_set),
    ]


def _check_free(inputs: Inputs) -> Check:
    if inputs.second_controller:
        return Check("controller", False, "another controller already sends on this bus; stop it first")
    return Check("controller", True, "no other on this bus")


def _check_load(listener: Listener, codec: Codec, bitrate: int) -> Check:
    """The greatest length of each frame, over the time: an upper bound, as planning takes it."""
    heard = listener.bits / max(listener.duration_s, 1e-3) / bitrate
    own = sum(
        frame_bits(FRAME_BYTES) * 1000 / info.cycle_time_ms for info in codec.messages.values() if info.sender == NODE
    )
    total = heard + own / bitrate
    text = f"{heard:.0%} now, {total:.0%} with the controller's frames, at {bitrate} bit/s"
    if listener.foreign_ids:
        text += f"; {len(listener.foreign_ids)} foreign ids"
    if listener.errors:
        return Check("bus load", False, f"{listener.errors} error frames; {text}")
    return Check("bus load", total <= LOAD_SHARE, text if total <= LOAD_SHARE else f"{text}; at most {LOAD_SHARE:.0%}")


def check_cycle(info: MessageInfo, stamps_s: list[float]) -> Check:
    """Return the verdict on the times at which the valid frames of one report came, s."""
    wanted_ms = info.cycle_time_ms
    if not stamps_s:
        return Check(info.name, False, f"never heard: is {info.sender} on this bus?")
    if len(stamps_s) < 3:
        return Check(info.name, False, f"heard {len(stamps_s)} times only, must come every {wanted_ms} ms")
    intervals_ms = [(after - before) * 1e3 for before, after in pairwise(stamps_s)]
    mean_ms = sum(intervals_ms) / len(intervals_ms)
    jitter_ms = _quantile([abs(interval - wanted_ms) for interval in intervals_ms], 0.99)
    gap_ms = max(intervals_ms)
    text = f"every {mean_ms:.2f} ms, jitter p99 {jitter_ms:.2f} ms, longest silence {gap_ms:.1f} ms"
    if abs(mean_ms - wanted_ms) > CYCLE_TIME_SHARE * wanted_ms:
        return Check(info.name, False, f"{text}; must be every {wanted_ms} ms")
    if jitter_ms > JITTER_SHARE * wanted_ms:
        return Check(info.name, False, f"{text}; jitter must be below {JITTER_SHARE * wanted_ms:g} ms")
    if gap_ms > GAP_SHARE * info.timeout_ms:
        return Check(info.name, False, f"{text}; no silence above {GAP_SHARE * info.timeout_ms:g} ms")
    return Check(info.name, True, text)


def _check_counters(listener: Listener) -> Check:
    received, lost = listener.mailbox.received, listener.mailbox.lost
    if listener.rejected:
        parts = ", ".join(f"{count} of wrong {key}" for key, count in _by_reason(listener.rejected))
        return Check("counters", False, f"rejected {parts}")
    if lost:
        return Check("counters", False, f"{lost} frames lost of {received + lost}")
    return Check("counters", received > 0, f"{received} frames, none rejected, none lost")


def _by_reason(rejected: dict[str, int]) -> list[tuple[str, int]]:
    return [(" in ".join(reversed(key.split(" "))), count) for key, count in sorted(rejected.items())]


def _check_versions(listener: Listener, inputs: Inputs, codec: Codec, table_set: TableSet) -> list[Check]:
    if not listener.stamps_s["VEH_Version"]:
        unheard = "the vehicle has not told its own (VEH_Version)"
        return [Check("DBC", False, unheard), Check("vehicle", False, unheard)]
    version = inputs.version
    dbc_text = f"0x{codec.dbc_hash24:06X} here, 0x{version.veh_dbc_hash:06X} in the vehicle"
    same_dbc = version.veh_dbc_hash == codec.dbc_hash24
    if version.veh_protocol != PROTOCOL:
        dbc = Check("DBC", False, f"the vehicle speaks protocol {version.veh_protocol}, the controller {PROTOCOL}")
    else:
        dbc = Check("DBC", same_dbc, dbc_text if same_dbc else f"{dbc_text}: both must have the same parking.dbc")
    same = version.veh_vehicle_hash == table_set.vehicle_hash24
    text = (
        f"{table_set.vehicle}: 0x{table_set.vehicle_hash24:06X} here, 0x{version.veh_vehicle_hash:06X} in the vehicle"
    )
    return [dbc, Check("vehicle", same, text if same else f"{text}: make the tables from the vehicle's own file")]


def check_realtime(outcome: Outcome, late_ns: list[int], *, physical: bool) -> Check:
    """Return the verdict on privileges and on how late the wake-ups were; a physical bus asks for both."""
    late_us = _quantile([late * 1e-3 for late in late_ns], 0.99)
    text = f"{outcome.line}; wake-ups late by {late_us:.0f} us (p99)"
    if not physical:
        return Check("real time", True, text)
    if not outcome.fifo or not outcome.memory_locked:
        return Check("real time", False, f"{text}; a physical bus needs SCHED_FIFO and locked memory")
    late = late_us > LATE_P99_US
    return Check("real time", not late, f"{text}; must be below {LATE_P99_US:g} us" if late else text)


def _quantile(values: list[float], share: float) -> float:
    return sorted(values)[min(int(share * len(values)), len(values) - 1)] if values else 0.0


class HandWheel:
    """Watches the reported road-wheel angle while the operator turns the hand wheel to the left at standstill."""

    def __init__(self, codec: Codec) -> None:
        self._mailbox = Mailbox(codec)
        self._first_rad: float | None = None
        self.check = Check("hand wheel", False, "no turn to the left was seen within the time")

    def take(self, now_ns: int, _late_ns: int, heard: list[Heard]) -> bool:
        """Take in one wake-up's frames; return whether the verdict stands."""
        for frame in heard:
            if frame.is_plain:
                self._mailbox.put(now_ns, frame.arbitration_id, frame.data)
        inputs = self._mailbox.take(now_ns // 1000, 0)
        if not inputs.steer.steer_angle_valid:
            return False
        if inputs.motion.speed_meas_mps != 0.0 or inputs.sys.vehicle_state == MODE_ACTIVE:
            self.check = Check("hand wheel", False, "only at standstill, with the vehicle not Active")
            return True
        angle_rad = inputs.steer.road_wheel_angle_meas_rad
        if self._first_rad is None:
            self._first_rad = angle_rad
        turned_rad = angle_rad - self._first_rad
        if abs(turned_rad) < HAND_WHEEL_TURN_RAD:
            return False
        text = f"turned to the left, the reported angle went by {turned_rad:+.3f} rad"
        wrong = "; left must be positive (dbc/CONVENTIONS.md, section 1)"
        self.check = Check("hand wheel", turned_rad > 0.0, text if turned_rad > 0.0 else text + wrong)
        return True


# ------------------------------------------------------------------------------------------------------ the checklist


def run(
    bus: Bus,
    codec: Codec,
    table_set: TableSet,
    outcome: Outcome,
    *,
    folder: Path,
    hand_wheel: bool,
    json_file: Path | None,
) -> int:
    """Go through the checklist and print it; return 0 only if nothing failed."""
    print(f"preflight on {bus.description}", flush=True)
    checks: list[Check] = []
    _tell(checks, *check_machine(bus, folder))
    if all(check.passed for check in checks if check.name == "interface"):
        listener = Listener(codec)
        listen(bus, LISTEN_S, listener.take)
        inputs = listener.mailbox.take(0, 0)
        _tell(checks, check_realtime(outcome, listener.late_ns, physical=bus.is_physical))
        _tell(checks, *check_heard(listener, inputs, codec, table_set, bus.bitrate or BITRATE))
        _tell(checks, _check_hand_wheel(bus, codec, heard=bool(listener.stamps_s["VEH_SteerRpt"]), wanted=hand_wheel))
    else:
        _tell(checks, Check("the rest", False, "not checked: nothing can be heard"))
    failed = [check.name for check in checks if check.passed is False]
    skipped = [check.name for check in checks if check.passed is None]
    done = f"{sum(check.passed is True for check in checks)} of {len(checks)} passed"
    if skipped:
        done += f", not checked: {', '.join(skipped)}"
    print(f"preflight: {done}; " + (f"do not arm: {', '.join(failed)}" if failed else "ready to be armed"), flush=True)
    if json_file is not None:
        _write_json(json_file, bus, checks, passed=not failed)
    return EXIT_FAILED if failed else EXIT_PASSED


def _tell(checks: list[Check], *new: Check) -> None:
    for check in new:
        verdict = {True: "ok", False: "FAIL", None: "skip"}[check.passed]
        print(f"  {verdict:<5} {check.name:<14} {check.text}", flush=True)
        checks.append(check)


def _check_hand_wheel(bus: Bus, codec: Codec, *, heard: bool, wanted: bool) -> Check:
    if not wanted:
        return Check("hand wheel", None, "skipped (--no-hand-wheel): the signs of the steering are NOT checked")
    if not heard:
        return Check("hand wheel", False, "not possible: VEH_SteerRpt was not heard")
    print(f"        turn the hand wheel to the LEFT by a quarter turn now (within {HAND_WHEEL_S:g} s)", flush=True)
    watch = HandWheel(codec)
    listen(bus, HAND_WHEEL_S, watch.take)
    return watch.check


def _write_json(file: Path, bus: Bus, checks: list[Check], *, passed: bool) -> None:
    """Write the checklist for machines; the file appears whole or not at all."""
    verdicts = {True: "pass", False: "fail", None: "skip"}
    rows = [{"name": check.name, "verdict": verdicts[check.passed], "text": check.text} for check in checks]
    content = {"bus": {"interface": bus.interface, "channel": bus.channel}, "passed": passed, "checks": rows}
    temporary = file.with_name(file.name + ".part")
    try:
        temporary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
        os.replace(temporary, file)
    except OSError as error:
        raise UserError(f"--json {file}: cannot be written ({error.strerror})") from None
