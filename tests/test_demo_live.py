"""The demo as its user runs it: real processes, in wall-clock time, one test at a time."""

from __future__ import annotations

import json
import os
import pty
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import can
import cantools.database
import pytest
from live_support import again_where_the_machine_was_away

from sim.can_side import CanSide
from sim.data_files import FOLDERS
from tools.operator_station import DBC

pytestmark = pytest.mark.live

PARKCTL = [sys.executable, "-m", "tools.cli"]
CHANNEL = "28600"


def children_of(pid: int) -> list[int]:
    """Living children of a process."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[1]) == pid and fields[0] != "Z":
            found.append(int(stat.parent.name))
    return found


def command_of(pid: int) -> str:
    return Path(f"/proc/{pid}/cmdline").read_text().replace("\0", " ")


class Demo:
    """A demo that runs in a folder of its own."""

    def __init__(self, folder: Path, *arguments: str) -> None:
        self.out = folder / "run"
        self._text = folder / "stdout.txt"
        with self._text.open("w") as stdout:
            self.process = subprocess.Popen(
                [*PARKCTL, "demo", "-c", CHANNEL, "--out", str(self.out), "--no-plots", *arguments],
                stdout=stdout,
                stderr=subprocess.PIPE,
                text=True,
                cwd=folder,
            )
        self.children: dict[str, int] = {}

    @property
    def text(self) -> str:
        return self._text.read_text()

    def wait_for(self, what: str | Callable[[], Any], limit_s: float = 60.0) -> None:
        end = time.monotonic() + limit_s
        while not (what in self.text if isinstance(what, str) else what()):
            assert time.monotonic() < end, f"waited in vain for {what}: {self.text}"
            assert self.process.poll() is None, f"ended early: {self.text} {self.end()}"
            time.sleep(0.02)

    def note_children(self) -> None:
        """Learn the processes' ids, once both are there."""
        self.wait_for(lambda: len(children_of(self.process.pid)) == 2)
        time.sleep(0.2)  # between fork and exec a child still looks like its parent
        for pid in children_of(self.process.pid):
            self.children["controller" if "firmware_py" in command_of(pid) else "emulator"] = pid
        assert set(self.children) == {"controller", "emulator"}

    def end(self, limit_s: float = 90.0) -> tuple[int, str]:
        """Wait for the end; return exit status and what was said on stderr. No process may be left."""
        _, error = self.process.communicate(timeout=limit_s)
        left = [pid for pid in self.children.values() if Path(f"/proc/{pid}").exists()]
        assert not left, [command_of(pid) for pid in left]
        return self.process.returncode, error

    def figures(self) -> Any:
        return json.loads((self.out / "figures.json").read_text())


def columns_of(demo: Demo, *names: str) -> list[list[float]]:
    """Columns of the plant's record of the run."""
    lines = [line.split(",") for line in (demo.out / "truth.csv").read_text().splitlines()]
    return [[float(line[lines[0].index(name)]) for line in lines[1:]] for name in names]


def speeds_of(demo: Demo) -> list[float]:
    """True speeds of the run."""
    return columns_of(demo, "speed_mps")[0]


@again_where_the_machine_was_away
def test_a_demo_passes_and_leaves_a_whole_run(tmp_path: Path) -> None:
    file = tmp_path / "figures.json"
    demo = Demo(tmp_path, "--json", str(file), "--side", "right")
    demo.note_children()
    status, error = demo.end()
    assert (status, error) == (0, ""), demo.text
    figures = json.loads(file.read_text())
    assert figures == demo.figures()
    assert figures["passed"] is True
    assert figures["score"] == 100
    assert figures["cones_touched"] == 0
    assert [leg["direction"] for leg in figures["legs"]] == ["forward", "reverse"]
    assert max(leg["max_cross_track_m"] for leg in figures["legs"]) <= 0.015
    assert figures["bus"] == {"interface": "loopbus", "channel": CHANNEL}
    assert (figures["frames"]["lost"], figures["frames"]["rejected"]) == (0, 0)
    assert figures["loop"]["cycles"] > 3000
    assert all(figures["loop"][name] is not None for name in ("wake_p99_us", "step_p99_us", "turnaround_p99_us"))
    assert "of 100 points" in demo.text

    # The log holds every frame of every node, counters without a gap, and decodes.
    database = cantools.database.load_file(DBC)
    counters: dict[int, list[int]] = {}
    for message in can.LogReader(demo.out / "bus.log"):
        counters.setdefault(message.arbitration_id, []).append(message.data[1] & 0x0F)
    assert set(counters) == {message.frame_id for message in database.messages}
    for frame_id, seen in counters.items():
        steps = {(b - a) % 15 for a, b in pairwise(seen)}
        assert steps == {1}, f"{frame_id:#x}"
    command = database.get_message_by_name("CTRL_SteerCmd")
    assert len(counters[command.frame_id]) == pytest.approx(figures["loop"]["cycles"], abs=3)


def interrupted(tmp_path: Path, wait_for: str | None, after_s: float, *, number: int = signal.SIGINT) -> Demo:
    """A demo that gets a signal some time after a text has appeared."""
    demo = Demo(tmp_path)
    if wait_for is not None:
        demo.note_children()
        demo.wait_for(wait_for)
    time.sleep(after_s)
    demo.process.send_signal(number)
    return demo


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@again_where_the_machine_was_away
def test_an_interrupt_on_the_way_stops_the_car_first(tmp_path: Path, number: int) -> None:
    demo = interrupted(tmp_path, "\nForward", 4.0, number=number)
    begun = time.monotonic()
    status, error = demo.end()
    assert time.monotonic() - begun < 10.0
    assert status == 130
    assert error == (
        "parkctl: not passed: interrupted in leg Forward: the operator's stop brought the car to standstill\n"
    )
    times, speeds = columns_of(demo, "t_s", "speed_mps")
    assert max(speeds) > 0.3, "the car was driving"
    assert speeds[-1] == 0.0, "and stands in the end"
    # By the controlled stop, not harder; a row that was skipped is a longer step.
    slowed_mps2 = [(v - w) / (b - a) for (a, b), (v, w) in zip(pairwise(times), pairwise(speeds), strict=True)]
    assert max(slowed_mps2) <= 1.3
    assert demo.figures()["passed"] is False


@pytest.mark.parametrize("after_s", [0.3, 0.7, 1.3, 2.2])
def test_an_interrupt_before_the_car_drives(tmp_path: Path, after_s: float) -> None:
    demo = interrupted(tmp_path, None, after_s)
    status, error = demo.end()
    # Python ends by the signal itself where the interrupt fell into an exec() of some library; to a shell both are 130.
    assert status in (130, -signal.SIGINT)
    assert error.count("\n") == 1
    assert "interrupted" in error
    assert not children_of(demo.process.pid)


@again_where_the_machine_was_away
def test_a_second_interrupt_ends_at_once(tmp_path: Path) -> None:
    demo = interrupted(tmp_path, "\nForward", 3.0)
    time.sleep(0.1)
    demo.process.send_signal(signal.SIGINT)
    begun = time.monotonic()
    status, error = demo.end()
    assert time.monotonic() - begun < 4.0
    assert status == 130
    assert "interrupted" in error


@again_where_the_machine_was_away
def test_a_killed_controller_is_said_and_the_watchdog_stops_the_car(tmp_path: Path) -> None:
    demo = Demo(tmp_path)
    demo.note_children()
    demo.wait_for("\nForward")
    time.sleep(4.0)
    os.kill(demo.children["controller"], signal.SIGKILL)
    status, error = demo.end()
    assert status == 1
    assert error == (
        "parkctl: not passed: the controller was killed by SIGKILL; "
        "the vehicle's watchdog brought the car to standstill\n"
    )
    speeds = speeds_of(demo)
    assert max(speeds) > 0.3
    assert speeds[-1] == 0.0
    assert "not completed" in demo.text


@again_where_the_machine_was_away
def test_a_killed_plant_is_said_and_the_controller_ends_by_itself(tmp_path: Path) -> None:
    demo = Demo(tmp_path)
    demo.note_children()
    demo.wait_for("\nForward")
    time.sleep(3.0)
    os.kill(demo.children["emulator"], signal.SIGKILL)
    status, error = demo.end()
    assert status == 1
    assert error == "parkctl: not passed: the plant emulator was killed by SIGKILL\n"
    assert "no verdict" in demo.text
    assert demo.figures()["exam"] is None


@again_where_the_machine_was_away
def test_a_second_controller_on_the_way_stops_the_car(tmp_path: Path) -> None:
    demo = Demo(tmp_path)
    demo.note_children()
    demo.wait_for("\nForward")
    time.sleep(3.0)
    intruder = CanSide(DBC, nodes=("CTRL",))
    with can.Bus(interface="loopbus", channel=CHANNEL, ignore_config=True) as bus:
        frame_id, data = intruder.encode("CTRL_SteerCmd", {"road_wheel_angle_cmd_rad": 0.3, "steer_enable": 1})
        bus.send(can.Message(arbitration_id=frame_id, data=data, is_extended_id=False))
        status, error = demo.end()
    assert status == 1
    assert error.startswith("parkctl: not passed: the controller stopped the car: another controller sends on this bus")
    assert speeds_of(demo)[-1] == 0.0


@again_where_the_machine_was_away
def test_a_second_demo_on_the_same_bus_is_refused(tmp_path: Path) -> None:
    demo = Demo(tmp_path)
    demo.note_children()
    demo.wait_for("\nForward")
    second = subprocess.run(
        [*PARKCTL, "demo", "-c", CHANNEL, "--out", str(tmp_path / "second")],
        capture_output=True, text=True, check=False, cwd=tmp_path, timeout=60,
    )  # fmt: skip
    assert second.returncode == 2
    assert re.fullmatch(r"parkctl: error: loopbus 28600: .* already sends there .*\n", second.stderr), second.stderr
    assert not (tmp_path / "second").exists()
    demo.process.send_signal(signal.SIGINT)
    demo.end()


@again_where_the_machine_was_away
def test_a_car_that_stands_a_metre_off_does_not_start(tmp_path: Path) -> None:
    scenario = (FOLDERS["scenario"] / "car.toml").read_text() + "\n[start]\nahead_m = -1.0\n"
    (tmp_path / "off.toml").write_text(scenario)
    demo = Demo(tmp_path, "--scenario", "off.toml")
    demo.note_children()
    begun = time.monotonic()
    status, error = demo.end()
    assert time.monotonic() - begun < 20.0
    assert status == 1
    assert error.startswith("parkctl: not passed: the car did not start: the car does not stand at the start pose")
    assert error.count("\n") == 1
    assert set(speeds_of(demo)) == {0.0}


@again_where_the_machine_was_away
def test_the_operators_keys_start_stop_and_clear(tmp_path: Path) -> None:
    """Three processes by hand, as in three terminals; the station's keys come from a terminal."""
    common = ["-i", "loopbus", "-c", "28620"]
    master, terminal = pty.openpty()
    started: list[subprocess.Popen[Any]] = []
    with (tmp_path / "said.txt").open("w") as said:
        try:
            started += [
                subprocess.Popen([*PARKCTL, name, *common], stderr=subprocess.DEVNULL) for name in ("emulate", "drive")
            ]
            operate = subprocess.Popen([*PARKCTL, "operate", *common], stdin=terminal, stdout=said)
            started.append(operate)

            def wait_for(text: str, limit_s: float = 30.0) -> None:
                """Wait for a text in the newest line."""
                end = time.monotonic() + limit_s
                while text not in (tmp_path / "said.txt").read_text().rstrip("\n").rpartition("\n")[2]:
                    assert time.monotonic() < end, f"waited for {text}: {(tmp_path / 'said.txt').read_text()}"
                    time.sleep(0.02)

            wait_for("controller Ready")
            os.write(master, b"s")
            wait_for("controller Active, Forward, None | vehicle Active, None, +")
            time.sleep(2.0)
            os.write(master, b" ")
            wait_for("controller Fault, Forward, OperatorStop")
            wait_for("standstill | pressed: stop")
            os.write(master, b"c")
            wait_for("controller Manual, Idle")
            os.write(master, b"q")
            assert operate.wait(10.0) == 0
            for process in reversed(started[:2]):
                process.send_signal(signal.SIGTERM)
                assert process.wait(10.0) == 0
        finally:
            for process in started:
                if process.poll() is None:
                    process.kill()
                    process.wait()
            os.close(master)
            os.close(terminal)
