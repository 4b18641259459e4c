"""The emulator's process: it starts, reports, ends cleanly, writes its results whole, and refuses in one line."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import can
import pytest
from live_support import before_ordinary_work
from sim_support import DBC

from sim.can_side import CanSide
from sim.data_files import FOLDERS, load_course, load_vehicle
from sim.emulator import TruthRow

ROOT = Path(__file__).resolve().parent.parent
WORKER = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
CHANNEL = 31200 + 20 * WORKER

pytestmark = pytest.mark.live


def command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "sim", "-c", str(CHANNEL), *arguments]


def environment() -> dict[str, str]:
    """The tests' own, with traps that a process must not fall into."""
    return {**os.environ, "CAN_INTERFACE": "socketcan", "CAN_CHANNEL": "can0", "PYTHONUNBUFFERED": "1"}


class Process:
    """A running emulator; ended by force at the end of the test whatever happens."""

    def __init__(self, arguments: list[str], stderr: Path) -> None:
        self._stderr = stderr
        with stderr.open("w") as sink:
            self.process = subprocess.Popen(
                command(*arguments), stdout=subprocess.PIPE, stderr=sink, text=True, cwd=ROOT, env=environment()
            )

    @property
    def said(self) -> list[str]:
        """Lines on stderr so far."""
        return self._stderr.read_text().splitlines()

    def wait_until_up(self) -> None:
        """Wait for the first state on stderr: the bus is open and the first report is out."""
        end_s = time.monotonic() + 20.0
        while len(self.said) < 2:
            assert self.process.poll() is None, self.said
            assert time.monotonic() < end_s
            time.sleep(0.02)

    def end(self, number: int = signal.SIGTERM) -> tuple[int, str]:
        """Exit status and stdout after a signal."""
        self.process.send_signal(number)
        out, _ = self.process.communicate(timeout=10)
        return self.process.returncode, out


@pytest.fixture
def start(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    running: list[Process] = []

    def begin(*arguments: str) -> Process:
        running.append(Process(list(arguments), tmp_path_factory.mktemp("process") / "stderr"))
        return running[-1]

    yield begin
    for each in running:
        if each.process.poll() is None:
            each.process.kill()
        each.process.communicate()


@pytest.fixture
def bus() -> Iterator[can.BusABC]:
    with can.Bus(interface="loopbus", channel=CHANNEL, ignore_config=True) as opened:
        yield opened


def refused(*arguments: str) -> str:
    """The one line of a start that fails with status 2."""
    done = subprocess.run(
        command(*arguments), capture_output=True, text=True, cwd=ROOT, env=environment(), check=False, timeout=60
    )
    assert done.returncode == 2, done.stderr
    assert done.stdout == ""
    lines = done.stderr.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("parkctl: error: ")
    return lines[0].removeprefix("parkctl: error: ")


# ------------------------------------------------------------------------------------------------------ clean ends


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_it_ends_cleanly_on_a_signal_and_writes_its_results(start: Any, tmp_path: Path, number: int) -> None:
    folder = tmp_path / "deep" / "run"
    process = start("--out", str(folder), "--status", "--vehicle", "fusion", "--side", "right", "--realtime", "off")
    process.wait_until_up()
    time.sleep(0.8)
    status, out = process.end(number)
    assert status == 0
    assert process.said == [
        f"plant emulator on loopbus {CHANNEL}, node 0: normal priority as asked",
        "vehicle Manual: no command",
    ]
    assert sorted(path.name for path in folder.iterdir()) == ["exam.json", "truth.csv"]

    rows = list(csv.DictReader((folder / "truth.csv").open()))
    assert list(rows[0]) == list(TruthRow._fields)
    start_pose = load_course("ohio").start_pose(load_vehicle("fusion"), "right")
    assert tuple(float(rows[0][name]) for name in ("x_m", "y_m", "yaw_rad")) == start_pose
    times = [float(row["t_s"]) for row in rows]
    assert 0.5 < times[-1] < 8.0
    assert all(round((b - a) * 100, 6) >= 1 for a, b in pairwise(times))
    assert all(round(t * 100, 6) == round(t * 100) for t in times)  # on the grid, however late the wake-up

    exam = json.loads((folder / "exam.json").read_text())
    assert exam["completed"] is False
    assert exam["passed"] is False

    shown = [json.loads(text) for text in out.splitlines()]
    assert len(shown) >= 2
    assert set(shown[0]) >= {"t_s", "state", "x_m", "y_m", "yaw_rad", "speed_mps", "gear", "leg", "clearance_m"}
    assert shown[-1]["cones_touched"] == 0
    assert shown[-1]["leg"] == "Idle"


def test_a_duration_ends_it_by_itself(start: Any, tmp_path: Path) -> None:
    process = start("--duration", "0.5", "--out", str(tmp_path))
    assert process.process.wait(timeout=30) == 0
    rows = list(csv.DictReader((tmp_path / "truth.csv").open()))
    assert float(rows[-1]["t_s"]) == pytest.approx(0.49, abs=0.011)


def test_results_replace_older_ones_whole(start: Any, tmp_path: Path) -> None:
    (tmp_path / "truth.csv").write_text("old")
    process = start("--duration", "0.2", "--out", str(tmp_path))
    assert process.process.wait(timeout=30) == 0
    assert (tmp_path / "truth.csv").read_text().startswith("t_s,x_m,")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["exam.json", "truth.csv"]


# --------------------------------------------------------------------------------------------------------- on the bus


def test_it_speaks_on_the_bus_at_its_pace_and_phase(start: Any, bus: can.BusABC) -> None:
    process = start("--phase-ms", "4", "--scenario", "ideal")
    process.wait_until_up()
    wire = CanSide(DBC, nodes=("CTRL", "OPER"), check_only=())
    heard: dict[str, int] = {}
    lateness_ms = []
    while bus.recv(0) is not None:
        pass
    end_s = time.monotonic() + 1.0
    while time.monotonic() < end_s:
        message = bus.recv(2.0)
        assert message is not None
        decoded = wire.decode(time.monotonic_ns(), message.arbitration_id, bytes(message.data))
        assert decoded is not None
        heard[decoded[0]] = heard.get(decoded[0], 0) + 1
        if decoded[0] == "VEH_SysRpt":
            age_s = time.time() - message.timestamp
            sent_s = time.monotonic() - age_s
            lateness_ms.append((sent_s * 1e3 + 4.0) % 10.0)
    status, _ = process.end()
    assert status == 0
    assert set(heard) == {
        "VEH_SysRpt", "VEH_SteerRpt", "VEH_MotionRpt", "VEH_LongRpt", "VEH_Version", "LOC_Position", "LOC_Attitude",
    }  # fmt: skip
    assert 60 <= heard["LOC_Position"] <= 101  # ordinary machines stall
    assert heard["VEH_SysRpt"] == pytest.approx(heard["LOC_Attitude"], abs=1)
    assert heard["VEH_Version"] == pytest.approx(heard["VEH_SysRpt"] / 10, abs=1.1)
    assert sorted(lateness_ms)[len(lateness_ms) // 2] < 3.0  # most wake-ups come soon after their tick


def test_it_hears_the_controller_through_the_bus(start: Any, bus: can.BusABC) -> None:
    """Ready after version and command; Active and Fault when the commands end; the button of the operator."""
    process = start("--scenario", "ideal", "--status")
    process.wait_until_up()
    wire = CanSide(DBC, nodes=("CTRL", "OPER"), check_only=())
    vehicle = load_vehicle(
        "paper", {"steering_lag_s": 0.0, "pose_latency_samples": 0.0, "command_latency_samples": 0.0}
    )
    version = {"ctrl_protocol": 1, "ctrl_dbc_hash": wire.dbc_hash24, "ctrl_vehicle_hash": vehicle.hash24}
    sys_cmd = {"enable_request": 0, "clear_request": 0, "control_mode": 0, "control_leg": 0, "control_reason": 0}
    steer = {"road_wheel_angle_cmd_rad": 0.25, "steer_enable": 1}
    long = {"speed_cmd_mps": 0, "brake_decel_cmd_mps2": 1, "gear_cmd": 0, "park_brake_cmd": 1, "long_enable": 1}
    states: list[int] = []
    angle = 0.0

    def exchange(seconds: float, **requests: int) -> None:
        nonlocal angle
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            messages = {"CTRL_Version": version, "CTRL_SysCmd": {**sys_cmd, **requests}, "CTRL_SteerCmd": steer}
            for name, values in {**messages, "CTRL_LongCmd": long}.items() if requests else ():
                arbitration_id, data = wire.encode(name, values)
                bus.send(can.Message(arbitration_id=arbitration_id, data=data, is_extended_id=False))
            time.sleep(0.01)
            while (message := bus.recv(0)) is not None:
                decoded = wire.decode(time.monotonic_ns(), message.arbitration_id, bytes(message.data))
                if decoded is not None and decoded[0] == "VEH_SysRpt":
                    states.append(int(decoded[1]["vehicle_state"]))
                elif decoded is not None and decoded[0] == "VEH_SteerRpt":
                    angle = decoded[1]["road_wheel_angle_meas_rad"]

    with before_ordinary_work():
        exchange(0.4, enable_request=0)
        assert states[-1] == 1
        exchange(0.8, enable_request=1)
        assert states[-1] == 2
        assert angle == pytest.approx(0.25)
        exchange(0.5)
        assert states[-1] == 3
    status, _ = process.end()
    assert status == 0
    assert [line for line in process.said if line.startswith("vehicle")] == [
        "vehicle Manual: no command",
        "vehicle Ready: none",
        "vehicle Active: none",
        "vehicle Fault: command timeout",
    ]


def test_a_reader_that_goes_away_does_not_stop_the_car(start: Any) -> None:
    process = start("--status")
    process.wait_until_up()
    process.process.stdout.close()
    time.sleep(0.6)
    assert process.process.poll() is None
    process.process.stdout = None
    process.process.send_signal(signal.SIGTERM)
    assert process.process.wait(timeout=10) == 0


# ------------------------------------------------------------------------------------------------------- refused starts


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (
            ["--vehicle", "nope"],
            "no vehicle is called 'nope'; there are compact, fusion, paper, pickup, or give the path of a .toml file",
        ),
        (
            ["--course", "x.toml"],
            "x.toml: no such course file; give the path of a .toml file or one of the names ohio, paper",
        ),
        (["--phase-ms", "10"], "--phase-ms 10: must be from 0 to less than 10"),
        (["--phase-ms", "nan"], "--phase-ms nan: must be from 0 to less than 10"),
        (["--duration", "0"], "--duration 0: must be more than 0"),
        (
            ["--side", "up"],
            "argument --side: invalid choice: 'up' (choose from 'left', 'right') (see parkctl emulate --help)",
        ),
        (["--seed", "x"], "argument --seed: invalid int value: 'x' (see parkctl emulate --help)"),
        (["--sceanrio", "car"], "unrecognized arguments: --sceanrio car (see parkctl emulate --help)"),
        (["-i", "socketcan"], "-i socketcan: name the channel too, as in -c vcan0; a physical bus is never guessed"),
        (["-i", "nobus", "-c", "1"], "-i nobus -c 1: CAN interface 'nobus' not supported"),
        (["-c", "here"], "loopbus: channel 'here' is no port number from 1024 to 65528, e.g. 29500"),
        (["--out", "/proc/nowhere"], "--out /proc/nowhere: cannot be made a folder: No such file or directory"),
        (["--out", str(DBC)], f"--out {DBC}: cannot be made a folder: File exists"),
    ],
)
def test_a_mistake_is_one_line_and_status_2(arguments: list[str], line: str) -> None:
    if arguments == ["-i", "socketcan"]:
        done = subprocess.run(
            [sys.executable, "-m", "sim", *arguments], capture_output=True, text=True, cwd=ROOT, env=environment(),
            check=False,
        )  # fmt: skip
        assert (done.returncode, done.stderr) == (2, f"parkctl: error: {line}\n")
    else:
        assert refused(*arguments) == line


def test_a_broken_file_leaves_nothing_behind(tmp_path: Path) -> None:
    broken = tmp_path / "v.toml"
    text = (FOLDERS["vehicle"] / "paper.toml").read_text()
    broken.write_text(text.replace('unit = "kg"', 'unit = "g"'))
    out = tmp_path / "out"
    assert (
        refused("--vehicle", str(broken), "--out", str(out)) == f"{broken}: parameters.mass_kg.unit = 'g': must be 'kg'"
    )
    assert not out.exists()


def test_a_car_that_does_not_fit(tmp_path: Path) -> None:
    wide = tmp_path / "v.toml"
    text = (FOLDERS["vehicle"] / "paper.toml").read_text()
    for name in ("body_width_m", "mirror_width_m"):
        text = text.replace(
            f"{name} = {{ nominal = 2.0, low = 2.0, high = 2.0", f"{name} = {{ nominal = 2.7, low = 2.7, high = 2.7"
        )
    wide.write_text(text)
    assert refused("--vehicle", str(wide)).startswith(
        "vehicle paper does not fit course ohio: at the start its outline is 0.022 m from the axis of cone front-left"
    )


def test_a_second_vehicle_on_the_bus_is_refused(start: Any) -> None:
    first = start()
    first.wait_until_up()
    line = refused()
    assert line == f"loopbus {CHANNEL}, node 1: a vehicle already sends there; end it, or take another channel"
    assert first.end()[0] == 0


def test_a_taken_port_is_refused() -> None:
    buses = [can.Bus(interface="loopbus", channel=CHANNEL, ignore_config=True) for _ in range(8)]
    try:
        assert "taken" in refused()
    finally:
        for each in buses:
            each.shutdown()


def test_without_the_right_real_time_may_be_required(start: Any) -> None:
    process = start("--realtime", "required", "--duration", "0.1")
    status = process.process.wait(timeout=30)
    line = process.said[0]
    if status == 0:
        assert "SCHED_FIFO 70" in line
    else:
        assert status == 2
        assert line.startswith("parkctl: error: --realtime required: no SCHED_FIFO (")
