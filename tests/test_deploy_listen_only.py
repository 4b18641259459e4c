"""Listening only: all is computed, nothing is sent; the real-time policy; the set-up's steps and its one line."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import can
import pytest
from wire_support import Open, base_fixture, drain, free_base, open_node_fixture  # noqa: F401 -- fixtures

from firmware_py import realtime
from firmware_py.__main__ import DEFAULT_DBC, DEFAULT_TABLES, build_parser, main
from firmware_py.bus import Bus, open_bus
from firmware_py.codec import INPUT_MESSAGES, Sender, load_codec
from firmware_py.core.controller import PERIOD_S
from firmware_py.core.signals import MotionReport, SteerCommand, SysReport
from firmware_py.core.tables import Tables
from firmware_py.errors import UserError
from firmware_py.node import build_tables
from firmware_py.realtime import Outcome
from firmware_py.table_file import LAWS, SIDES, load_tables
from firmware_py.warm_up import warm_up

ROOT = Path(__file__).resolve().parent.parent
CODEC = load_codec(DEFAULT_DBC)
OWN_IDS = {info.frame_id for info in CODEC.messages.values() if info.sender == "CTRL"}
INPUT_IDS = [CODEC.messages[name].frame_id for name in INPUT_MESSAGES]


def plain(number: int, data: bytes) -> can.Message:
    return can.Message(arbitration_id=number, data=data, is_extended_id=False)


# ------------------------------------------------------------------------------------------------ the bus that listens


def test_a_listening_bus_hears_the_reports_and_sends_nothing(open_node: Open, base: int) -> None:
    peer = open_node()
    bus = open_bus("loopbus", str(base), use_config=False, only_ids=INPUT_IDS, listen_only=True)
    try:
        sender = Sender(CODEC)
        report = sender.pack("VEH_SysRpt", SysReport(1, 0, 0, 0, 0, 0, 0))
        for frame in (report, sender.pack("CTRL_SteerCmd", SteerCommand(0.1, 1)), (0x7FF, bytes(8))):
            peer.send(plain(*frame))
        assert bus.drain() == [report], "the frames of the controller that drives are not for its shadow"
        assert bus.send([(0x010, bytes(8))] * 20) == 0
        assert bus.sent == bus.send_failed == 0
        assert drain(peer) == []
    finally:
        bus.close()


def test_a_bus_that_sends_counts_what_it_sent(open_node: Open, base: int) -> None:
    peer = open_node()
    bus = open_bus("loopbus", str(base), use_config=False)
    try:
        bus.send([(0x010, bytes(8))] * 3)
        assert (bus.sent, len(drain(peer))) == (3, 3)
    finally:
        bus.close()


@pytest.mark.live
def test_the_process_computes_and_logs_and_the_bus_stays_silent(open_node: Open, base: int, tmp_path: Path) -> None:
    """Even beside a controller that drives: a shadow is neither refused nor refuses."""
    witness = open_node()
    command = [
        sys.executable,
        "-m",
        "firmware_py",
        "-c",
        str(base),
        "--listen-only",
        "--status",
        "--out",
        str(tmp_path),
    ]
    child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT)
    try:
        assert child.stdout is not None
        first = json.loads(child.stdout.readline())
        sender = Sender(CODEC)
        end_s = time.monotonic() + 0.3
        while time.monotonic() < end_s:
            witness.send(plain(*sender.pack("VEH_MotionRpt", MotionReport(0.0, 0.0, 1, 1))))
            witness.send(plain(*sender.pack("CTRL_SteerCmd", SteerCommand(0.1, 1))))
            time.sleep(0.01)
        child.send_signal(signal.SIGTERM)
        out, error = child.communicate(timeout=20)
    finally:
        child.kill()
        child.wait()
    assert child.returncode == 0, error
    assert drain(witness) == []
    assert len(error.splitlines()) == 1
    assert error.endswith("; listening only, nothing is sent\n")
    final = json.loads(out.splitlines()[-1])["final"]
    assert first["reason_text"].startswith("waiting for reports")
    assert (final["listen_only"], final["frames_sent"]) == (True, 0)
    assert final["cycles"] > 20
    assert final["frames_received"] > 5
    assert final["reason_text"].startswith("waiting for reports"), "not: another controller"
    assert len((tmp_path / "flight_record.csv").read_text().splitlines()) > 20


# ---------------------------------------------------------------------------------------------------- real-time policy


class AnyDriver:
    channel_info = "any"


@pytest.mark.parametrize(
    ("interface", "channel", "physical"),
    [
        ("loopbus", "29500", False),
        ("virtual", "x", False),
        ("socketcan", "vcan0", False),
        ("socketcan", "vcan17", False),
        ("socketcan", "can0", True),
        ("socketcan", "slcan0", True),
        ("kvaser", "0", True),
        ("pcan", "PCAN_USBBUS1", True),
    ],
)
def test_what_is_not_known_to_be_emulated_is_physical(interface: str, channel: str, physical: bool) -> None:
    assert Bus(AnyDriver(), interface, channel).is_physical is physical  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("physical", "asked", "policy"),
    [
        (True, [], "required"),
        (False, [], "auto"),
        (True, ["--realtime", "auto"], "auto"),
        (False, ["--realtime", "off"], "off"),
    ],
)
def test_a_physical_bus_requires_real_time_unless_told_otherwise(
    monkeypatch: pytest.MonkeyPatch, physical: bool, asked: list[str], policy: str
) -> None:
    seen: list[tuple[str, int | None]] = []

    def set_up(policy: str, cpu: int | None = None) -> Outcome:
        seen.append((policy, cpu))
        raise UserError("enough")

    monkeypatch.setattr(Bus, "is_physical", property(lambda _self: physical))
    monkeypatch.setattr("firmware_py.__main__.set_up", set_up)
    monkeypatch.setattr("firmware_py.__main__.preflight.refuse_unfit_machine", lambda *_: None)
    assert main(["-i", "virtual", "-c", "policy", "--no-config", "--cpu", "0", *asked]) == 2
    assert seen == [(policy, 0)]


@pytest.mark.parametrize("law", ["paper", "dob", "pid"])
def test_no_car_is_driven_by_the_papers_laws(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], law: str
) -> None:
    monkeypatch.setattr(Bus, "is_physical", property(lambda _self: True))
    assert main(["-i", "virtual", "-c", "law", "--no-config", "--law", law]) == 2
    error = capsys.readouterr().err
    assert error == f"parkctl: error: --law {law}: no car can be reversed by it; drive a car with --law car\n"


# ------------------------------------------------------------------------------------------------------ set-up in order

SET_UP = "import json; from firmware_py.realtime import set_up; o = set_up({policy!r}, {cpu}); print(json.dumps(o))"


def outcome_in_a_process(policy: str, cpu: int | None = None, before: str = "") -> Any:
    """What a fresh process gets; this one must not freeze its collector or take a priority."""
    code = f"{before}\n{SET_UP.format(policy=policy, cpu=cpu)}"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    return Outcome(*json.loads(answer.stdout))


def test_every_step_of_the_set_up_is_told_in_its_order() -> None:
    outcome = outcome_in_a_process("auto", min(os.sched_getaffinity(0)))
    assert list(outcome.steps) == ["timer_slack", "cpu", "memory", "cpu_dma_latency", "gc", "scheduler"]
    assert outcome.steps["timer_slack"] == "1 ns"
    assert outcome.steps["cpu"] == str(min(os.sched_getaffinity(0)))
    assert outcome.steps["gc"] == "frozen"
    assert outcome.fifo == (outcome.steps["scheduler"] == "SCHED_FIFO 80")
    assert outcome.memory_locked == (outcome.steps["memory"] == "locked")
    assert (outcome.latency_fd is None) == outcome.steps["cpu_dma_latency"].startswith("not held: ")


REFUSE_FIFO = (
    "import os\ndef refuse(*_): raise PermissionError(1, 'Operation not permitted')\nos.sched_setscheduler = refuse"
)


def test_the_line_without_the_privilege() -> None:
    outcome = outcome_in_a_process("auto", before=REFUSE_FIFO)
    assert outcome.line == "normal priority: no CAP_SYS_NICE; jitter will be worse; see README, real time"
    assert outcome.steps["scheduler"] == "normal priority: no CAP_SYS_NICE"
    assert not outcome.fifo


def test_the_line_with_the_privilege() -> None:
    grant = "import os, firmware_py.realtime as r\nos.sched_setscheduler = lambda *_: None\nr._lock_memory = lambda: ''"
    outcome = outcome_in_a_process("required", before=grant)
    assert outcome.line == "SCHED_FIFO 80, memory locked, gc frozen"


def test_required_refuses_without_the_privilege() -> None:
    code = f"{REFUSE_FIFO}\nimport firmware_py.__main__ as m, sys\nsys.exit(m.main(sys.argv[1:]))"
    options = ["-i", "virtual", "-c", "required", "--no-config", "--realtime", "required"]
    answer = subprocess.run(
        [sys.executable, "-c", code, *options], capture_output=True, text=True, cwd=ROOT, check=False
    )
    assert answer.returncode == 2
    assert answer.stderr.startswith("parkctl: error: --realtime required: no SCHED_FIFO (no CAP_SYS_NICE); grant")
    assert len(answer.stderr.splitlines()) == 1


def test_the_sleep_states_are_held_as_long_as_the_file_is_open(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    file = tmp_path / "cpu_dma_latency"
    file.touch()
    monkeypatch.setattr(realtime, "LATENCY_FILE", str(file))
    fd, told = realtime._short_sleep_states()
    assert fd is not None
    os.close(fd)
    assert (told, file.read_bytes()) == ("0 us held", bytes(4))
    monkeypatch.setattr(realtime, "LATENCY_FILE", str(tmp_path / "none"))
    assert realtime._short_sleep_states() == (None, "not held: No such file or directory")


@pytest.mark.parametrize("cpu", [-1, 100_000])
def test_a_cpu_that_is_not_there_is_one_line(cpu: int) -> None:
    with pytest.raises(UserError, match=rf"--cpu {cpu}: .* the CPUs it may use are 0"):
        realtime._affinity(cpu)


def test_a_wrong_option_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--law", "none"]) == 2
    captured = capsys.readouterr()
    assert len(captured.err.splitlines()) == 1
    assert captured.err.startswith("parkctl: error: argument --law: invalid choice: 'none'")
    assert build_parser().parse_args([]).realtime is None


# ------------------------------------------------------------------------------------------------------------- warm-up


def tables_of(name: str, side: str, law: str) -> Tables:
    return build_tables(load_tables(DEFAULT_TABLES.parent / name, side, law, PERIOD_S, DEFAULT_DBC.parent), CODEC)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("name", ["paper-ohio", "fusion-ohio"])
def test_every_shipped_table_passes_the_self_test(name: str, side: str, law: str) -> None:
    warm_up(CODEC, tables_of(name, side, law))


def test_the_self_test_notices_tables_with_which_the_core_cannot_work() -> None:
    tables = tables_of("paper-ohio", "left", "car")
    with pytest.raises(UserError, match=r"self-test: .* \(AttributeError: "):
        warm_up(CODEC, tables._replace(gains=None))  # type: ignore[arg-type]
    with pytest.raises(UserError, match=r"self-test: .* \(the tables are for other vehicle parameters"):
        warm_up(CODEC, tables._replace(vehicle_hash24=1 << 24))  # more than its signal holds
