"""Preflight: a verdict a line, failing for the right reason; the same checks keep the controller from arming."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from wire_support import base_fixture  # noqa: F401 -- fixture

from firmware_py import preflight
from firmware_py.__main__ import DEFAULT_DBC, DEFAULT_TABLES, main
from firmware_py.bus import Bus, Heard, frame_bits
from firmware_py.codec import INPUT_MESSAGES, Sender, load_codec
from firmware_py.core.controller import PERIOD_S
from firmware_py.core.signals import MODE_ACTIVE, MotionReport, SteerReport, SysReport, VehicleVersion
from firmware_py.errors import UserError
from firmware_py.preflight import Check, HandWheel, Listener, check_cycle, check_heard, check_realtime
from firmware_py.realtime import Outcome
from firmware_py.table_file import load_tables

ROOT = Path(__file__).resolve().parent.parent
CODEC = load_codec(DEFAULT_DBC)
TABLES = load_tables(DEFAULT_TABLES, "left", "car", PERIOD_S, DEFAULT_DBC.parent)
VERSION = VehicleVersion(1, CODEC.dbc_hash24, TABLES.vehicle_hash24)
CYCLES = 300


class AnyDriver:
    channel_info = "any"


def bus_of(interface: str, channel: str, bitrate: int | None = None) -> Bus:
    return Bus(AnyDriver(), interface, channel, bitrate)  # type: ignore[arg-type]


def heard(stamp_s: float, frame: tuple[int, bytes], **kinds: bool) -> Heard:
    kinds = {"is_error": False, "is_plain": True, **kinds}
    return Heard(stamp_s, frame[0], frame[1], frame_bits(len(frame[1])), **kinds)


class Car:
    """Reports as a car sends them, with what is wrong with it."""

    def __init__(self, version: VehicleVersion = VERSION, every: dict[str, int] | None = None) -> None:
        self._sender = Sender(CODEC)
        self._version = version
        self._every = {name: CODEC.messages[name].cycle_time_ms // 10 for name in INPUT_MESSAGES} | (every or {})

    def frames(self, cycle: int) -> list[tuple[int, bytes]]:
        out = []
        for name in INPUT_MESSAGES:
            struct = CODEC.messages[name].struct
            values = self._version if name == "VEH_Version" else struct._make([0] * len(struct._fields))
            if self._every[name] and cycle % self._every[name] == 0:
                out.append(self._sender.pack(name, values))
        return out


def checklist(car: Car, extra: Any = None) -> dict[str, Check]:
    """The verdicts on three seconds of a car, in virtual time; `extra(cycle)` adds frames."""
    listener = Listener(CODEC)
    for cycle in range(CYCLES + 1):
        now_ns = (cycle + 1) * 10_000_000
        frames = [heard(now_ns * 1e-9, frame) for frame in car.frames(cycle)]
        assert listener.take(now_ns, 50_000, frames + (extra(cycle) if extra else [])) is False
    inputs = listener.mailbox.take(0, 0)
    return {check.name: check for check in check_heard(listener, inputs, CODEC, TABLES, 500_000)}


def failed(checks: dict[str, Check]) -> list[str]:
    return [name for name, check in checks.items() if not check.passed]


# ------------------------------------------------------------------------------------------------------ what is heard


def test_a_right_car_passes_every_line() -> None:
    checks = checklist(Car())
    assert failed(checks) == []
    assert list(checks) == ["controller", "bus load", *INPUT_MESSAGES, "counters", "DBC", "vehicle"]
    assert checks["VEH_SteerRpt"].text == "every 10.00 ms, jitter p99 0.00 ms, longest silence 10.0 ms"
    assert checks["OPER_Cmd"].text.startswith("every 20.00 ms")
    # 6 reports at 100 Hz, one at 50, one at 10: 660 frames of at most 135 bits; the controller adds 612.
    assert checks["bus load"].text == "18% now, 35% with the controller's frames, at 500000 bit/s"


def test_the_nominal_bit_rate_is_the_dbcs() -> None:
    assert re.findall(r'^BA_ "Baudrate" (\d+);', DEFAULT_DBC.read_text(), re.M) == [str(preflight.BITRATE)]


@pytest.mark.parametrize(
    ("extended", "data_bytes", "bits"), [(False, 8, 135), (False, 0, 55), (True, 8, 160), (True, 0, 80)]
)
def test_longest_frames_of_the_standard(extended: bool, data_bytes: int, bits: int) -> None:
    """The known bounds, 8 n + 47 + (34 + 8 n - 1) / 4 for 11-bit ids; with 29 bits 67 and 54."""
    assert frame_bits(data_bytes, extended=extended) == bits


@pytest.mark.parametrize("name", INPUT_MESSAGES)
def test_a_report_that_never_comes_fails_its_line(name: str) -> None:
    checks = checklist(Car(every={name: 0}))
    expected = {name} | ({"DBC", "vehicle"} if name == "VEH_Version" else set())
    assert set(failed(checks)) == expected
    assert checks[name].text == f"never heard: is {name.partition('_')[0]} on this bus?"


def test_a_report_at_half_its_rate_fails_its_line_alone() -> None:
    checks = checklist(Car(every={"VEH_MotionRpt": 2}))
    assert failed(checks) == ["VEH_MotionRpt"]
    assert checks["VEH_MotionRpt"].text.startswith("every 20.00 ms")
    assert checks["VEH_MotionRpt"].text.endswith("; must be every 10 ms")


@pytest.mark.parametrize(
    ("stamps_ms", "hint"),
    [
        ([0, 10], "heard 2 times only"),
        ([10.0 * n for n in range(100)], None),
        ([10.0 * n + (n % 2) for n in range(100)], None),
        ([10.0 * n + 5.5 * (n % 2) for n in range(100)], "jitter must be below 5 ms"),
        ([10.0 * n for n in range(60)] + [650.0 + 8.6 * n for n in range(60)], "no silence above 50 ms"),
        ([10.9 * n for n in range(100)], None),
        ([11.1 * n for n in range(100)], "must be every 10 ms"),
        ([8.9 * n for n in range(100)], "must be every 10 ms"),
    ],
)
def test_cycle_time_jitter_and_silence(stamps_ms: list[float], hint: str | None) -> None:
    check = check_cycle(CODEC.messages["VEH_SteerRpt"], [stamp * 1e-3 for stamp in stamps_ms])
    if hint == "no silence above 50 ms":
        # One silence of 60 ms among 120 intervals is above the p99 of the jitter; so is its verdict the first.
        assert not check.passed
        assert "longest silence 60.0 ms" in check.text
    else:
        assert check.passed is (hint is None), check.text
        assert hint is None or hint in check.text


def test_one_long_silence_among_many_intervals_fails() -> None:
    stamps = [0.01 * n for n in range(200)] + [2.05 + 0.01 * n for n in range(200)]
    check = check_cycle(CODEC.messages["VEH_SteerRpt"], stamps)
    assert not check.passed
    assert check.text.endswith("no silence above 50 ms")


def test_other_hashes_and_another_protocol_fail() -> None:
    other_dbc = checklist(Car(VERSION._replace(veh_dbc_hash=1)))
    assert failed(other_dbc) == ["DBC"]
    assert other_dbc["DBC"].text.startswith(f"0x{CODEC.dbc_hash24:06X} here, 0x000001 in the vehicle")
    other_car = checklist(Car(VERSION._replace(veh_vehicle_hash=2)))
    assert failed(other_car) == ["vehicle"]
    assert "0x000002 in the vehicle: make the tables" in other_car["vehicle"].text
    other_protocol = checklist(Car(VERSION._replace(veh_protocol=9)))
    assert failed(other_protocol) == ["DBC"]
    assert other_protocol["DBC"].text == "the vehicle speaks protocol 9, the controller 1"


def test_rejected_frames_are_told_by_message_and_reason() -> None:
    number = CODEC.messages["VEH_LongRpt"].frame_id
    forged = heard(0.0, (number, b"\x01" * 8))
    checks = checklist(Car(), lambda cycle: [forged] if cycle in (50, 60) else [])
    assert failed(checks) == ["counters"]
    assert checks["counters"].text == "rejected 2 of wrong CRC in VEH_LongRpt"


def test_lost_frames_are_told() -> None:
    car = Car()
    listener = Listener(CODEC)
    for cycle in range(200):
        frames = [heard(cycle * 0.01, frame) for frame in car.frames(cycle)]
        listener.take((cycle + 1) * 10_000_000, 0, frames if cycle != 77 else [])
    checks = {c.name: c for c in check_heard(listener, listener.mailbox.take(0, 0), CODEC, TABLES, 500_000)}
    assert not checks["counters"].passed
    assert re.fullmatch(r"6 frames lost of \d+", checks["counters"].text)


def test_another_controller_fails() -> None:
    sender = Sender(CODEC)
    own = sender.pack("CTRL_SysCmd", CODEC.messages["CTRL_SysCmd"].struct._make([0] * 5))
    checks = checklist(Car(), lambda cycle: [heard(0.0, own)] if cycle == 9 else [])
    assert failed(checks) == ["controller"]


def test_a_busy_bus_and_error_frames_fail() -> None:
    foreign = [heard(0.0, (0x7F0, bytes(8)))] * 15
    busy = checklist(Car(), lambda _: foreign)
    assert failed(busy) == ["bus load"]
    assert busy["bus load"].text.endswith("; 1 foreign ids; at most 70%")
    error = heard(0.0, (0, bytes(8)), is_error=True, is_plain=False)
    checks = checklist(Car(), lambda cycle: [error] if cycle % 100 == 50 else [])
    assert failed(checks) == ["bus load"]
    assert checks["bus load"].text.startswith("3 error frames; ")


def test_what_waited_before_the_listening_does_not_count() -> None:
    listener = Listener(CODEC)
    listener.take(10_000_000, 0, [heard(0.0, (0x7F0, bytes(8)))] * 256)
    assert (listener.bits, listener.foreign_ids) == (0, set())


# ----------------------------------------------------------------------------------------------------------- real time

FIFO = Outcome("SCHED_FIFO 80, memory locked, gc frozen", True, True, {}, None)
ORDINARY = Outcome("normal priority: no CAP_SYS_NICE", False, True, {}, None)


@pytest.mark.parametrize(
    ("outcome", "late_us", "physical", "passed"),
    [
        (FIFO, 100, True, True),
        (FIFO, 1500, True, False),
        (FIFO._replace(memory_locked=False), 100, True, False),
        (ORDINARY, 100, True, False),
        (ORDINARY, 9000, False, True),
    ],
)
def test_a_physical_bus_needs_the_privileges_and_the_punctuality(
    outcome: Outcome, late_us: int, physical: bool, passed: bool
) -> None:
    check = check_realtime(outcome, [late_us * 1000] * 100, physical=physical)
    assert check.passed is passed
    assert f"late by {late_us} us (p99)" in check.text


# ---------------------------------------------------------------------------------------------------------- hand wheel


def turn(angles_rad: list[float], speed_mps: float = 0.0, state: int = 0, *, valid: int = 1) -> Check:
    """The verdict after a hand wheel turned so."""
    sender, watch = Sender(CODEC), HandWheel(CODEC)
    zeros = [0] * 10
    for cycle, angle in enumerate(angles_rad):
        steer = SteerReport(angle, 0.0, valid, *zeros[:7], 0.0)
        frames = [
            sender.pack("VEH_SysRpt", SysReport(state, *zeros[:6])),
            sender.pack("VEH_MotionRpt", MotionReport(speed_mps, 0.0, 1, 1)),
            sender.pack("VEH_SteerRpt", steer),
        ]
        if watch.take((cycle + 1) * 10_000_000, 0, [heard(0.0, frame) for frame in frames]):
            break
    return watch.check


def test_left_must_be_positive() -> None:
    ramp = [0.004 * n for n in range(50)]
    right = turn([0.2 + angle for angle in ramp])
    assert right.passed
    assert right.text == "turned to the left, the reported angle went by +0.052 rad"
    wrong = turn([0.2 - angle for angle in ramp])
    assert wrong.passed is False
    assert "went by -0.052 rad; left must be positive" in wrong.text


def test_a_hand_wheel_that_nobody_turns_is_no_pass() -> None:
    assert turn([0.01 * (n % 4) for n in range(300)]).passed is False
    assert turn([0.1 * n for n in range(30)], valid=0).passed is False


def test_the_hand_wheel_is_checked_at_standstill_and_not_while_driven() -> None:
    ramp = [0.004 * n for n in range(50)]
    assert turn(ramp, speed_mps=0.1).text == "only at standstill, with the vehicle not Active"
    assert turn(ramp, state=MODE_ACTIVE).passed is False


# ----------------------------------------------------------------------------------------- the machine, its interfaces

LINK = {
    "txqlen": 128,
    "linkinfo": {"info_data": {"state": "ERROR-ACTIVE", "restart_ms": 100, "bittiming": {"bitrate": 500000}}},
}


@pytest.fixture
def net(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A folder in place of /sys/class/net, and of the program ip."""
    monkeypatch.setattr(preflight, "SYS_NET", tmp_path / "net")
    monkeypatch.setenv("PATH", str(tmp_path))
    return tmp_path


def interface(net: Path, name: str, flags: str = "0x40081", kind: str = "280") -> None:
    folder = net / "net" / name
    folder.mkdir(parents=True)
    (folder / "flags").write_text(flags + "\n")
    (folder / "type").write_text(kind + "\n")


def link(net: Path, text: str) -> None:
    """A program `ip` that knows one interface."""
    program = net / "ip"
    program.write_text(
        f"#!{sys.executable}\nimport sys\n"
        "assert sys.argv[1:] == ['-details', '-json', 'link', 'show', 'dev', 'can0'], sys.argv\n"
        f"print({text!r})\n"
    )
    program.chmod(0o755)


def changed(**data: Any) -> str:
    copy = json.loads(json.dumps(LINK))
    copy["linkinfo"]["info_data"] |= data
    return json.dumps([copy])


def test_a_right_can0_passes(net: Path) -> None:
    interface(net, "can0")
    link(net, changed())
    assert preflight.check_link(bus_of("socketcan", "can0")) == [
        Check("interface", True, "can0 is up, ERROR-ACTIVE, txqueuelen 128, restart-ms 100"),
        Check("bit rate", True, "500000 bit/s"),
    ]


def test_vcan_has_no_bit_rate_and_needs_no_ip(net: Path) -> None:
    interface(net, "vcan0")
    checks = preflight.check_link(bus_of("socketcan", "vcan0"))
    assert [check.passed for check in checks] == [True, True]


@pytest.mark.parametrize(
    ("flags", "kind", "answer", "bitrate", "line"),
    [
        ("0x40080", "280", changed(), None, "interface: can0 is down: ip link set can0 up type can bitrate 500000 "),
        ("0x40081", "1", changed(), None, "interface: can0 is no CAN interface"),
        ("0x40081", "280", changed(bittiming={"bitrate": 250000}), None, "bit rate: 250000 bit/s, must be 500000: "),
        ("0x40081", "280", changed(), 250000, "bit rate: 500000 bit/s, must be 250000: "),
        ("0x40081", "280", changed(state="BUS-OFF"), None, "interface: can0 is up, BUS-OFF, "),
        ("0x40081", "280", changed(state="ERROR-PASSIVE"), None, "interface: can0 is up, ERROR-PASSIVE, "),
        ("0x40081", "280", "[]", None, "bit rate: cannot be read: `ip "),
        ("0x40081", "280", "no json", None, "bit rate: cannot be read: `ip "),
        ("0x40081", "280", "[3]", None, "bit rate: cannot be read: `ip "),
        ("0x40081", "280", None, None, "bit rate: cannot be read: the program ip is missing"),
    ],
)
def test_a_wrong_can0_keeps_the_controller_from_arming(
    net: Path, flags: str, kind: str, answer: str | None, bitrate: int | None, line: str
) -> None:
    interface(net, "can0", flags, kind)
    if answer is not None:
        link(net, answer)
    with pytest.raises(UserError) as caught:
        preflight.refuse_unfit_machine(bus_of("socketcan", "can0", bitrate), None)
    assert str(caught.value).startswith(f"not to be armed: {line}")
    assert "\n" not in str(caught.value)


def test_an_interface_that_went_away_is_told(net: Path) -> None:
    assert preflight.check_link(bus_of("socketcan", "can0"))[0].text.startswith("there is no can0; ")


def test_a_driver_that_sets_the_bit_rate_must_be_told_it() -> None:
    assert preflight.check_link(bus_of("kvaser", "0"))[1] == Check(
        "bit rate", False, "not named: give -b 500000, what the DBC asks for"
    )
    assert preflight.check_link(bus_of("kvaser", "0", 500_000))[1].passed


def test_the_clock_must_be_fine(monkeypatch: pytest.MonkeyPatch) -> None:
    assert preflight.check_clock().passed
    monkeypatch.setattr(preflight, "clock_resolution_ns", lambda: 4_000_000)
    assert preflight.check_clock().text.endswith("must be 1000 ns or less")
    assert preflight.check_clock().passed is False


def test_a_full_disk_keeps_from_arming_where_something_is_to_be_written(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert preflight.check_disk(tmp_path).passed
    assert preflight.check_disk(tmp_path / "none").text.endswith("No such file or directory")
    monkeypatch.setattr(preflight, "DISK_MIB", 1 << 40)
    preflight.refuse_unfit_machine(bus_of("virtual", "x"), None)
    with pytest.raises(UserError, match=r"not to be armed: disk: \d+ MiB free in .*; must be \d+ MiB"):
        preflight.refuse_unfit_machine(bus_of("virtual", "x"), tmp_path)


# ---------------------------------------------------------------------------------------------------- the whole thing


def test_nothing_on_the_bus_is_a_failed_checklist_and_nothing_else(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr(preflight, "LISTEN_S", 0.05)
    file = tmp_path / "checks.json"
    monkeypatch.setattr("firmware_py.__main__.set_up", lambda *_: ORDINARY)
    assert main(["--preflight", "-i", "virtual", "-c", "alone", "--no-config", "--json", str(file)]) == 1
    out = capsys.readouterr().out.splitlines()
    assert out[0].startswith("preflight on ")
    assert out[-1].startswith("preflight: 7 of 19 passed; do not arm: VEH_SysRpt, ")
    content = json.loads(file.read_text())
    assert content["passed"] is False
    assert content["bus"] == {"interface": "virtual", "channel": "alone"}
    assert len(content["checks"]) == len(out) - 2 == 19
    verdicts = {row["name"]: row["verdict"] for row in content["checks"]}
    assert verdicts["interface"] == verdicts["controller"] == "pass"
    assert verdicts["VEH_SysRpt"] == verdicts["hand wheel"] == "fail"


def test_a_json_file_that_cannot_be_written_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr(preflight, "LISTEN_S", 0.03)
    monkeypatch.setattr("firmware_py.__main__.set_up", lambda *_: ORDINARY)
    options = ["--preflight", "-i", "virtual", "-c", "alone", "--no-config", "--json", str(tmp_path / "no" / "x.json")]
    assert main(options) == 2
    assert capsys.readouterr().err.startswith(
        f"parkctl: error: --json {tmp_path}/no/x.json: cannot be written (No such"
    )


def test_an_interface_that_is_down_ends_the_list_at_once(
    net: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    interface(net, "can0", "0x40080")
    monkeypatch.setattr(preflight, "listen", lambda *_: pytest.fail("nothing can be heard"))
    bus = bus_of("socketcan", "can0")
    options = {"folder": Path(), "hand_wheel": True, "json_file": None}
    assert preflight.run(bus, CODEC, TABLES, FIFO, **options) == 1  # type: ignore[arg-type]
    assert capsys.readouterr().out.splitlines()[-1].endswith("do not arm: interface, the rest")


@pytest.fixture
def peers(base: int, tmp_path: Path) -> Iterator[list[str]]:
    """An emulated car and an operator station's heartbeat on a bus of their own; the bus's options."""
    channel = ["-c", str(base)]
    heartbeat = (
        "import sys, time\nfrom pathlib import Path\nfrom tools.buses import open_bus\n"
        "from tools.operator_station import Station, exchange, DBC\n"
        "bus = open_bus('loopbus', sys.argv[1], None, ignore_settings=True)\nstation = Station(DBC)\n"
        "while True:\n    exchange(bus, station)\n    time.sleep(0.002)\n"
    )
    commands = [
        [sys.executable, "-m", "sim", *channel],
        [sys.executable, "-c", heartbeat, str(base)],
    ]
    children = [subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True) for command in commands]
    try:
        assert children[0].stderr is not None
        children[0].stderr.readline()
        time.sleep(0.5)
        yield channel
    finally:
        for child in children:
            child.send_signal(signal.SIGTERM)
            child.communicate()


@pytest.mark.live
def test_an_emulated_car_passes_but_for_what_this_machine_does_to_its_timing(peers: list[str], tmp_path: Path) -> None:
    file = tmp_path / "checks.json"
    command = [sys.executable, "-m", "tools.cli", "preflight", *peers, "--no-hand-wheel", "--json", str(file)]
    answer = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=60, check=False)
    content = json.loads(file.read_text())
    rows = {row["name"]: row for row in content["checks"]}
    assert rows["hand wheel"]["verdict"] == "skip"
    assert "NOT checked" in rows["hand wheel"]["text"]
    assert "not checked: hand wheel" in answer.stdout
    for name in ("interface", "bit rate", "clock", "disk", "real time", "controller", "bus load", "DBC", "vehicle"):
        assert rows[name]["verdict"] == "pass", answer.stdout
    for name in INPUT_MESSAGES:
        assert re.match(r"every \d+\.\d\d ms, ", rows[name]["text"]), answer.stdout
    bad = [name for name, row in rows.items() if row["verdict"] == "fail"]
    assert answer.returncode == (1 if bad else 0)
    assert content["passed"] == (not bad)
    assert set(bad) <= {*INPUT_MESSAGES, "counters"}, "a loaded machine may spoil times, nothing else"
