"""The demo's pieces: choice of the bus, run folder, bus log, child processes, operator station, progress line, card."""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import can
import pytest
from rich.console import Console

from firmware_py.core.conditions import COMPLETE
from sim.can_side import CanSide
from sim.data_files import load_course, load_vehicle
from sim.errors import UserError
from tools import cli
from tools.bus_log import BusLog
from tools.buses import (
    BusChoice,
    choose_own_bus,
    environment_without_can_settings,
    open_bus,
    opened,
    refuse_occupied_bus,
)
from tools.card import print_card, print_figures
from tools.operator_station import DBC, Ending, Station, ending_of, exchange, text_of_state
from tools.processes import Child
from tools.progress import Moment, Progress, line_of
from tools.run_folder import MARK, RunFolder, check_writable_file, write_whole

MS = 1_000_000


# ------------------------------------------------------------------------------------------------------ choice of a bus


def test_the_default_bus_is_the_embedded_one_whatever_the_environment_says(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CAN_INTERFACE", "socketcan")
    monkeypatch.setenv("CAN_CHANNEL", "can0")
    monkeypatch.setenv("CAN_BITRATE", "125000")
    assert choose_own_bus(None, None, None) == BusChoice("loopbus", "29500", None)
    assert not {name for name in environment_without_can_settings() if name.startswith("CAN_")}
    assert environment_without_can_settings()["PATH"] == os.environ["PATH"]
    with opened(open_bus("loopbus", "28100", None, ignore_settings=True)) as bus:
        assert "28100" in bus.channel_info


@pytest.mark.parametrize(
    ("interface", "channel", "says"),
    [
        ("virtual", None, "ends at its own process"),
        ("virtual", "x", "ends at its own process"),
        ("socketcan", None, "name the channel"),
        ("kvaser", None, "name the channel"),
        (None, "vcan0", "name the interface"),
    ],
)
def test_a_bus_that_is_not_named_in_full_is_refused(interface: str | None, channel: str | None, says: str) -> None:
    with pytest.raises(UserError, match=says):
        choose_own_bus(interface, channel, None)


def test_the_choice_reaches_the_processes_in_full() -> None:
    assert BusChoice("socketcan", "can0", 500000).arguments() == ["-i", "socketcan", "-c", "can0", "-b", "500000"]
    assert choose_own_bus(None, "29600", None).arguments() == ["-i", "loopbus", "-c", "29600"]


@pytest.mark.parametrize(
    ("interface", "channel", "says"),
    [
        ("nosuch", "0", "nosuch"),
        ("loopbus", "http", "port"),
        ("loopbus", "80", "port"),
        ("socketcan", "vcan97", "vcan97"),
    ],
)
def test_a_bus_that_cannot_be_opened_is_one_line(interface: str, channel: str, says: str) -> None:
    with pytest.raises(UserError, match=says) as caught:
        open_bus(interface, channel, None, ignore_settings=True)
    assert "\n" not in str(caught.value)


def test_an_occupied_bus_is_refused_and_a_quiet_one_is_not() -> None:
    station = Station(DBC)
    other = CanSide(DBC, nodes=("CTRL",))
    choice = BusChoice("loopbus", "28120", None)
    with (
        opened(open_bus("loopbus", "28120", None, ignore_settings=True)) as bus,
        opened(open_bus("loopbus", "28120", None, ignore_settings=True)) as peer,
    ):
        refuse_occupied_bus(bus, choice, station.frame_ids, 0.02)
        peer.send(can.Message(arbitration_id=0x7DF, data=b"\0" * 8, is_extended_id=False))  # nobody's of the DBC
        refuse_occupied_bus(bus, choice, station.frame_ids, 0.05)
        values = {"ctrl_protocol": 1, "ctrl_dbc_hash": 0, "ctrl_vehicle_hash": 0}
        frame_id, data = other.encode("CTRL_Version", values)
        peer.send(can.Message(arbitration_id=frame_id, data=data, is_extended_id=False))
        with pytest.raises(UserError, match=r"loopbus 28120: a controller already sends there \(CTRL_Version\)"):
            refuse_occupied_bus(bus, choice, station.frame_ids, 0.2)


# ----------------------------------------------------------------------------------------------------------- run folder


def test_the_default_folder_is_new_each_time_and_latest_points_to_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    paths = []
    for _ in range(3):
        folder = RunFolder.plan(None, "paper-ohio-left-car")
        assert not folder.path.exists()
        folder.make()
        folder.publish()
        paths.append(folder.path)
        assert (tmp_path / "runs" / "latest").resolve() == (tmp_path / folder.path).resolve()
    assert len(set(paths)) == 3
    assert all(path.name.endswith("paper-ohio-left-car") or path.name[-2] == "-" for path in paths)


def test_a_real_folder_called_latest_is_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs" / "latest").mkdir(parents=True)
    folder = RunFolder.plan(None, "x")
    folder.make()
    folder.publish()
    assert not (tmp_path / "runs" / "latest").is_symlink()


def test_planning_makes_nothing_and_discarding_takes_everything_back(tmp_path: Path) -> None:
    folder = RunFolder.plan(str(tmp_path / "a" / "b" / "run"), "x")
    assert not (tmp_path / "a").exists()
    folder.make()
    (folder.path / "tables").mkdir()
    write_whole(folder.path / MARK, "{}")
    folder.discard()
    assert not (tmp_path / "a").exists()


def test_a_users_folder_survives_a_run_that_never_began(tmp_path: Path) -> None:
    folder = RunFolder.plan(str(tmp_path), "x")
    folder.make()
    write_whole(folder.path / MARK, "{}")
    folder.discard()
    assert tmp_path.is_dir()
    assert not list(tmp_path.iterdir())


def test_a_folder_of_an_earlier_run_is_used_again_and_emptied(tmp_path: Path) -> None:
    for name in (MARK, "bus.log", "signals.png"):
        (tmp_path / name).write_text("old")
    (tmp_path / "tables").mkdir()
    (tmp_path / "tables" / "path.csv").write_text("old")
    (tmp_path / "notes.md").write_text("the user's own")
    RunFolder.plan(str(tmp_path), "x").make()
    assert [path.name for path in tmp_path.iterdir()] == ["notes.md"]


def test_a_folder_with_other_peoples_files_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(UserError, match="holds files that are not of a run"):
        RunFolder.plan(str(tmp_path), "x")
    with pytest.raises(UserError, match="is a file"):
        RunFolder.plan(str(tmp_path / "thesis.tex"), "x")


def test_a_file_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    file = tmp_path / "figures.json"
    write_whole(file, "old")
    with pytest.raises(UnicodeEncodeError):
        write_whole(file, "half of it \udcff")
    assert file.read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["figures.json"]


def test_a_file_that_cannot_be_written_is_known_before_the_work(tmp_path: Path) -> None:
    check_writable_file(tmp_path / "new.json")
    with pytest.raises(UserError, match="there is no folder"):
        check_writable_file(tmp_path / "nowhere" / "new.json")
    with pytest.raises(UserError, match="is a folder"):
        check_writable_file(tmp_path)


# -------------------------------------------------------------------------------------------------------------- bus log


def test_the_bus_log_is_candumps_format_in_order_of_time(tmp_path: Path) -> None:
    path = tmp_path / "bus.log"
    frames = [(100.000300, 0x10, b"\x01\x02", False), (100.000100, 0x601, bytes(8), False), (100.0002, 0, b"", True)]
    with BusLog(path, "vcan0") as log:
        log.add(frames[:2])
        log.write_due(100.1)  # both are still held back
        assert path.stat().st_size == 0
        log.add(frames[2:])
        log.write_due(100.5)
        log.add([(99.0, 0x20, b"\xff", False)])  # the clock was set back
    lines = path.read_text().splitlines()
    assert lines[:2] == ["(100.000100) vcan0 601#0000000000000000", "(100.000200) vcan0 20000080#"]
    assert lines[2:] == ["(100.000300) vcan0 010#0102", "(100.000300) vcan0 020#FF"]
    read = list(can.LogReader(path))
    assert [(m.arbitration_id, bytes(m.data)) for m in read if not m.is_error_frame] == [
        (0x601, bytes(8)), (0x10, b"\x01\x02"), (0x20, b"\xff"),
    ]  # fmt: skip
    assert [m.is_error_frame for m in read] == [False, True, False, False]
    assert [m.timestamp for m in read] == sorted(m.timestamp for m in read)


# ------------------------------------------------------------------------------------------------------ child processes


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """A factory of modules that a child can run."""
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))

    def make(text: str) -> str:
        (tmp_path / "a_child.py").write_text(text)
        return "a_child"

    return make


def wait_until(done: Any, limit_s: float = 10.0) -> None:
    end = time.monotonic() + limit_s
    while not done():
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.005)


def test_a_child_is_heard_line_by_line(module: Any) -> None:
    child = Child("plant", module(
        "import sys, time\n"
        "sys.stdout.write('{\"x_m\": 1.0}\\n{\"x_m\"'); sys.stdout.flush(); time.sleep(0.05)\n"
        "print(': 2.0}'); print('no json'); print('{\"final\": {\"cycles\": 7}}')\n"
        "print('parkctl: error: the last word', file=sys.stderr); sys.exit(3)\n"
    ), [])  # fmt: skip
    wait_until(child.ended)
    assert child.latest == {"x_m": 2.0}
    assert child.final == {"cycles": 7}
    assert child.status == 3
    assert child.how_it_ended() == "the plant ended with status 3: the last word"
    assert child.complaints == "parkctl: error: the last word\n"
    child.close()


def test_a_child_is_out_of_reach_of_the_terminals_ctrl_c_and_of_can_variables(
    module: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CAN_INTERFACE", "socketcan")
    child = Child("plant", module("import json, os; print(json.dumps({'group': os.getpgrp(), 'pid': os.getpid(), "
                                  "'can': os.environ.get('CAN_INTERFACE')}))"), [])  # fmt: skip
    wait_until(child.ended)
    assert child.latest["group"] == child.latest["pid"] != os.getpgrp()
    assert child.latest["can"] is None
    child.close()


def test_a_killed_child_is_named_with_its_signal(module: Any) -> None:
    child = Child("controller", module("import time; time.sleep(60)"), [])
    assert not child.ended()
    os.kill(child.process.pid, signal.SIGKILL)
    wait_until(child.ended)
    assert child.how_it_ended() == "the controller was killed by SIGKILL"
    child.close()


def test_closing_leaves_nothing_behind_even_of_a_child_that_ignores_requests(module: Any) -> None:
    child = Child("plant", module(
        "import signal, subprocess, sys, time\n"
        "signal.signal(signal.SIGTERM, signal.SIG_IGN)\n"
        "grandchild = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)'])\n"
        "print('{\"grandchild\": %d}' % grandchild.pid, flush=True); time.sleep(60)\n"
    ), [])  # fmt: skip
    wait_until(lambda: child.listen() or child.latest)
    child.terminate()
    time.sleep(0.1)
    assert not child.ended()
    child.close(grace_s=0.1)
    assert child.status == -signal.SIGKILL
    wait_until(
        lambda: not Path(f"/proc/{child.latest['grandchild']}").exists() or _is_zombie(child.latest["grandchild"])
    )


def _is_zombie(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


@pytest.mark.skipif(sys.platform != "linux", reason="the kernel's parent-death signal is Linux")
def test_children_do_not_outlive_a_parent_that_is_killed(module: Any, tmp_path: Path) -> None:
    name = module("import time; print('{}', flush=True); time.sleep(60)")
    script = (
        f"from tools.processes import Child; import time\nchild = Child('x', '{name}', [])\n"
        "print(child.process.pid, flush=True)\ntime.sleep(60)"
    )
    parent = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    pid = int(parent.stdout.readline())
    parent.kill()
    parent.wait()
    parent.stdout.close()
    wait_until(lambda: not Path(f"/proc/{pid}").exists() or _is_zombie(pid))


# ----------------------------------------------------------------------------------------------------- operator station


def test_heartbeats_come_every_20_ms_and_skip_what_was_missed() -> None:
    station = Station(DBC)
    sent = [t for t in range(0, 200) if station.heartbeat(t * MS)]
    assert sent == list(range(0, 200, 20))
    assert station.heartbeat(275 * MS) is not None  # late by 75 ms
    assert station.heartbeat(276 * MS) is None  # no burst to make up for it
    assert [t for t in range(277, 340) if station.heartbeat(t * MS)] == [295, 315, 335]
    assert station.max_late_ms == pytest.approx(75.0)


def test_buttons_and_heartbeat_are_what_the_vehicles_side_decodes() -> None:
    station, vehicle = Station(DBC), CanSide(DBC)
    counters = []
    for index, button in enumerate(("start", "stop", "estop", "clear")):
        setattr(station, button, True)
        frame = station.heartbeat(index * 20 * MS)
        assert frame is not None
        decoded = vehicle.decode(index * 20 * MS, *frame)
        assert decoded is not None
        name, values = decoded
        assert name == "OPER_Cmd"
        pressed = {key.removeprefix("oper_") for key, value in values.items() if key.startswith("oper_") and value}
        assert pressed == {button}
        counters.append(frame[1][1] & 0x0F)
        setattr(station, button, False)
    assert counters == [0, 1, 2, 3]


def hear(station: Station, side: CanSide, now_ns: int, mode: int, *, leg: int = 0, reason: int = 0) -> None:
    values = {
        "enable_request": 0,
        "clear_request": 0,
        "control_mode": mode,
        "control_leg": leg,
        "control_reason": reason,
    }
    station.hear(now_ns, *side.encode("CTRL_SysCmd", values))


def test_start_is_pressed_for_a_moment_each_time_the_controller_becomes_ready_until_it_has_driven() -> None:
    station, controller = Station(DBC), CanSide(DBC, nodes=("CTRL",))
    pressed = []
    for t, mode in [(0, 0), (10, 1), (200, 1), (400, 1), (500, 0), (510, 1), (520, 2), (530, 1), (540, 0), (550, 1)]:
        hear(station, controller, t * MS, mode)
        station.press_start_when_ready(t * MS)
        pressed.append(station.start)
    assert pressed == [False, True, True, False, False, True, False, False, False, False]


def test_a_completed_manoeuvre_is_counted_however_soon_the_controller_is_ready_again() -> None:
    """All frames of a busy moment are heard before anybody looks at the mode."""
    station, controller = Station(DBC), CanSide(DBC, nodes=("CTRL",))
    for t, mode, reason in [(0, 0, COMPLETE), (10, 1, 0), (20, 2, 0), (30, 0, COMPLETE), (40, 0, COMPLETE), (50, 1, 0)]:
        hear(station, controller, t * MS, mode, reason=reason)
    assert (station.mode, station.completions) == ("Ready", 1)
    for t, mode, reason in [(60, 2, 0), (70, 3, 9), (80, 0, 0)]:  # one that was stopped is none
        hear(station, controller, t * MS, mode, reason=reason)
    assert station.completions == 1


def test_a_frame_with_a_wrong_crc_says_nothing_to_the_station() -> None:
    station, controller = Station(DBC), CanSide(DBC, nodes=("CTRL",))
    values = {"enable_request": 0, "clear_request": 0, "control_mode": 1, "control_leg": 0, "control_reason": 0}
    frame_id, data = controller.encode("CTRL_SysCmd", values)
    station.hear(0, frame_id, bytes([data[0] ^ 1]) + data[1:])
    assert station.mode == ""
    station.hear(0, frame_id, data)
    assert (station.mode, station.leg, station.reason) == ("Ready", "Idle", "None")


def test_state_in_words_and_silence_after_the_timeout() -> None:
    station, controller, vehicle = Station(DBC), CanSide(DBC, nodes=("CTRL",)), CanSide(DBC)
    assert text_of_state(station, 0) == "controller silent | vehicle silent"
    hear(station, controller, 0, 3, leg=1, reason=9)
    names = {item.name for item in station.side.received["VEH_SysRpt"].message.signals}
    station.hear(0, *vehicle.encode("VEH_SysRpt", {**dict.fromkeys(names, 0), "vehicle_state": 1}))
    assert text_of_state(station, 0).startswith("controller Fault, Forward, OperatorStop | vehicle Ready, None")
    assert "stopped by the operator (OperatorStop)" in station.reason_text
    assert text_of_state(station, 200 * MS) == "controller silent | vehicle silent"


def hear_car(station: Station, side: CanSide, now_ns: int, *, standstill: int) -> None:
    names = {item.name for item in station.side.received["VEH_LongRpt"].message.signals}
    station.hear(now_ns, *side.encode("VEH_LongRpt", {**dict.fromkeys(names, 0), "standstill": standstill}))


ACTIVE_IN_CHANGE, FAULT_BY_TIMEOUT = {"mode": 2, "leg": 2}, {"mode": 3, "leg": 2, "reason": 13}


@pytest.mark.parametrize(
    ("controller_says", "standstill", "silence_ms", "ending"),
    [
        (ACTIVE_IN_CHANGE, 1, 0, None),
        (FAULT_BY_TIMEOUT, 0, 0, None),
        (FAULT_BY_TIMEOUT, 1, 0, "VEH_SysRpt was missing for its timeout (SysReportTimeout)"),
        # The bus is away while the car stands in the change of direction: the reason is still to come.
        (ACTIVE_IN_CHANGE, 1, 400, None),
        (ACTIVE_IN_CHANGE, 1, 4900, None),
        (
            ACTIVE_IN_CHANGE, 1, 5100,
            "the controller fell silent on the bus; its last words: Active, DirectionChange, None"
            "; the vehicle is silent, too",
        ),
        (FAULT_BY_TIMEOUT, 0, 400, None),
        (
            FAULT_BY_TIMEOUT, 0, 5100,
            "VEH_SysRpt was missing for its timeout (SysReportTimeout); the vehicle is silent, too",
        ),
        ({"mode": 0, "leg": 0, "reason": 2}, 1, 0, "the controller has begun anew: Manual, Idle, WaitingForOperator"),
        ({"mode": 0, "leg": 4, "reason": 31}, 1, 0, "completed"),
        ({"mode": 0, "leg": 4, "reason": 31}, 0, 0, None),
    ],
)  # fmt: skip
def test_how_a_manoeuvre_is_over(
    controller_says: dict[str, int], standstill: int, silence_ms: int, ending: str | None
) -> None:
    station, controller, vehicle = Station(DBC), CanSide(DBC, nodes=("CTRL",)), CanSide(DBC)
    hear(station, controller, MS, **controller_says)
    hear_car(station, vehicle, MS, standstill=standstill)
    found = ending_of(station, (1 + silence_ms) * MS)
    expected = None if ending is None else Ending(ending == "completed", "" if ending == "completed" else ending)
    assert found == expected


def test_a_controller_that_dies_beside_a_standing_car_is_told() -> None:
    station, controller, vehicle = Station(DBC), CanSide(DBC, nodes=("CTRL",)), CanSide(DBC)
    hear(station, controller, 0, 2, leg=1)
    for t in range(0, 5010, 10):
        hear_car(station, vehicle, t * MS, standstill=int(t > 1000))
        assert (ending_of(station, t * MS) is None) == (t <= 5000), t
    hear_car(station, vehicle, 5010 * MS, standstill=1)
    why = "the controller fell silent on the bus; its last words: Active, Forward, None"
    assert ending_of(station, 5010 * MS) == Ending(False, why)


def test_exchange_sends_hears_and_returns_all_frames() -> None:
    station, controller = Station(DBC), CanSide(DBC, nodes=("CTRL",))
    values = {"enable_request": 0, "clear_request": 0, "control_mode": 2, "control_leg": 1, "control_reason": 0}
    with (
        opened(open_bus("loopbus", "28140", None, ignore_settings=True)) as bus,
        opened(open_bus("loopbus", "28140", None, ignore_settings=True)) as peer,
    ):
        frame_id, data = controller.encode("CTRL_SysCmd", values)
        peer.send(can.Message(arbitration_id=frame_id, data=data, is_extended_id=False))
        seen = exchange(bus, station)
        heartbeat = peer.recv(1.0)
    assert heartbeat is not None
    assert {frame[1] for frame in seen} == {frame_id, heartbeat.arbitration_id}
    assert all(abs(frame[0] - time.time()) < 5.0 for frame in seen)
    assert station.mode == "Active"


# ------------------------------------------------------------------------------------------------------- what is shown


def test_the_progress_line_has_units_and_leaves_out_what_is_not_known() -> None:
    full = line_of(Moment("Forward", 0.98, 12.341, 18.3, -0.0012, 0.4123, 310.0))
    assert full.split("  ")[0] == "Forward"
    for text in ("+0.98 m/s", "station 12.34 of 18.30 m", "cross-track  -1.2 mm", "clearance 0.412 m", "p99 0.31 ms"):
        assert text in full
    assert line_of(Moment("starting")).strip() == "starting"


def test_a_terminal_has_one_line_and_a_file_few() -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    terminal, file = Terminal(), io.StringIO()
    for stream in (terminal, file):
        progress = Progress(stream)
        shown = 0
        for tick in range(1000):
            now_s, leg = 0.01 * tick, "Forward" if tick < 700 else "Reverse"
            if progress.due(now_s, leg):
                progress.show(now_s, Moment(leg, 1.0))
                shown += 1
        progress.close()
        assert shown in (range(95, 105) if stream is terminal else [3])
    assert terminal.getvalue().count("\n") == 1
    assert file.getvalue().count("\n") == 3


def test_the_card_says_what_the_examiner_wrote() -> None:
    leg = {"final_heading_error_rad": 0.01, "final_ahead_m": -0.02}
    exam = {
        "passed": False, "score": 85, "full_score": 100, "pass_score": 75, "cones_touched": ["point"], "stops": 1,
        "direction_changes": 1, "dwell_s": 0.9, "duration_s": 38.0, "min_clearance_m": 0.05, "nearest_cone": "point",
        "legs": [leg, leg],
        "mistakes": [{"rule": "cone_bumped", "points": 5, "fails": False, "text": "cone [point]"}],
    }  # fmt: skip
    figures = {"exam": exam, "side": "left", "legs": [], "loop": {"cycles": None}, "frames": {"sent": 1, "lost": None}}
    console = Console(file=io.StringIO(), width=120)
    print_card(console, figures, load_course("ohio"))
    print_figures(console, figures, load_vehicle("paper"))
    text = console.file.getvalue()
    for expected in (
        "point",
        "2.0 cm off",
        "0.57 deg",
        "cone [point]: -5",
        "85 of 100 points, 75 needed: FAIL",
        "? lost",
    ):
        assert expected in text
    console = Console(file=io.StringIO(), width=120)
    print_card(console, {"exam": None}, load_course("ohio"))
    assert "no verdict" in console.file.getvalue()


# -------------------------------------------------------------------------------------------------------- command line


@pytest.mark.parametrize("command", ["demo", "operate"])
def test_help_of_each_subcommand(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main([command, "--help"])
    assert ended.value.code == 0
    assert "--interface" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ([], "COMMAND"),
        (["dmeo"], "dmeo"),
        (["demo", "--sied", "left"], "--sied"),
        (["demo", "--side", "middle"], "middle"),
        (["operate", "-b", "fast"], "fast"),
    ],
)
def test_a_wrong_command_line_is_one_line(arguments: list[str], says: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith("parkctl: error: ")
    assert says in error
    assert error.count("\n") == 1


def test_drive_and_emulate_become_their_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    called: list[Any] = []
    monkeypatch.setattr(os, "execve", lambda *arguments: called.append(arguments))
    monkeypatch.setenv("CAN_CHANNEL", "can0")
    cli.main(["drive", "-i", "socketcan", "-c", "can0", "--side", "right"])
    cli.main(["emulate", "--seed", "4"])
    (_, drive, drive_environment), (_, emulate, emulate_environment) = called
    assert drive[1:] == ["-P", "-m", "firmware_py", "-i", "socketcan", "-c", "can0", "--side", "right"]
    assert drive_environment["CAN_CHANNEL"] == "can0"  # the controller in a car obeys python-can's settings
    assert emulate[1:] == ["-P", "-m", "sim", "-i", "loopbus", "-c", "29500", "--seed", "4"]
    assert "CAN_CHANNEL" not in emulate_environment
    assert cli.main(["emulate", "-i", "kvaser"]) == 2
    assert len(called) == 2


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_ends_the_log_and_not_the_run() -> None:
    log = BusLog(Path("/dev/full"), "vcan0")
    with log:
        for tick in range(5):
            log.add([(100.0 + tick, 0x10, bytes(8), False)])
            log.write_due(101.0 + tick)
    assert log.failed == "the bus log could not be written: No space left on device"


def test_a_reader_that_has_gone_does_not_stop_the_car() -> None:
    read, write = os.pipe()
    os.close(read)
    progress = Progress(os.fdopen(write, "w"))
    progress.show(0.0, Moment("Forward"))
    progress.close()
