"""The soak: a car that is driven on from where it ended, the verdict's rows, and the processes' end."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from firmware_py.codec import load_codec
from firmware_py.core.controller import PERIOD_S
from firmware_py.node import ControllerNode, build_tables
from firmware_py.table_file import load_tables
from sim.data_files import load_course, load_scenario, load_vehicle
from tools import cli
from tools.bench import soak, wake
from tools.bench.soak import Drive, SoakRun, figures_of
from tools.lockstep import COMPUTE_NS, DBC, PERIOD_NS, Emulator
from tools.operator_station import ACTIVE, COMPLETE, MANUAL, Station

ROOT = Path(__file__).resolve().parent.parent


def test_the_car_is_driven_again_from_where_it_ended() -> None:
    """Virtual time: one controller, one car, one station; the second start finds the car parked after the first."""
    codec = load_codec(DBC)
    node = ControllerNode(codec, build_tables(load_tables(soak.TABLES, "left", "car", PERIOD_S), codec))
    emulator = Emulator(load_vehicle("paper"), load_course("ohio"), load_scenario("car"), "left", 3, DBC, 0)
    station = Station(DBC)
    ended_s: list[float] = []
    was_active = False
    now_ns = 0
    while len(ended_s) < 2 and now_ns < 100_000_000_000:
        now_ns += PERIOD_NS
        frames = emulator.reports(now_ns - 3_000_000)
        heartbeat = station.heartbeat(now_ns)
        commands = node.cycle(now_ns, [*frames, heartbeat] if heartbeat else frames, 0)
        for frame in commands:
            emulator.receive(now_ns + COMPUTE_NS, *frame)
            station.hear(now_ns, *frame)
        station.press_start_when_ready(now_ns)
        assert station.mode != "Fault", station.reason_text
        if was_active and station.mode == MANUAL and station.reason == COMPLETE:
            ended_s.append(now_ns * 1e-9)
            station.allow_another_start()
        was_active = station.mode == ACTIVE
    assert len(ended_s) == 2
    assert ended_s[1] - ended_s[0] < ended_s[0] + 2.0, "as soon as the first one"
    assert emulator.examiner.cones_touched == 0
    assert (emulator.lost_count, node.mailbox.lost) == (0, 0)


def rows(
    tmp_path: Path, *, tests: list[Drive], vehicle: dict[str, int] | None = None, **controller: Any
) -> dict[str, Any]:
    run = cast(SoakRun, SimpleNamespace(tests=tests, faults=0, vehicle=vehicle or {}))
    floor_us = [50.0] * 997 + [1001.0, 5000.0, 200_000.0]
    return {row["name"]: row for row in figures_of(2, run, controller, None, floor_us, tmp_path)["rows"]}


def test_the_verdict_counts_both_sides_and_what_cyclictest_saw(tmp_path: Path) -> None:
    two = [Drive(1, 31.0, 4, 0, 35.0), Drive(2, 31.0, 7, 0, 35.4)]
    good = rows(tmp_path, tests=two, late_cycles=11)
    assert all(row["passed"] for row in good.values())
    assert good["late_cycles"]["must"] == 2 * 3 + 5
    assert good["memory_growth_mib"]["value"] == pytest.approx(0.4)
    failed: dict[str, dict[str, Any]] = {
        "tests_completed": {"tests": two[:1]},
        "frames_lost": {"tests": two, "vehicle": {"lost": 1}},
        "frames_rejected": {"tests": two, "frames_rejected": 1},
        "frames_refused": {"tests": two, "send_failed": 1},
        "memory_growth_mib": {"tests": [two[0], two[1]._replace(rss_mib=35.6)]},
        "late_cycles": {"tests": two, "late_cycles": 12},
    }
    for name, arguments in failed.items():
        judged = rows(tmp_path, **arguments)
        assert [other for other, row in judged.items() if not row["passed"]] == [name]
    (tmp_path / "exam.json").write_text(json.dumps({"cones_touched": ["point"]}))
    assert not rows(tmp_path, tests=two)["cones_touched"]["passed"]


def test_cyclictests_histogram_is_read_with_what_lies_beyond_it() -> None:
    text = "# Histogram\n000003 000002\n001500 000001\n# Total: 000000003\n# Histogram Overflows: 00002\n"
    assert wake._late_us(0, text, "") == [3.0, 3.0, 1500.0, 200_000.0, 200_000.0]
    with pytest.raises(wake.UserError, match="cyclictest: no privileges"):
        wake._late_us(1, "", "no privileges\n")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--runs", "0"], "--runs 0: must be from 1 to 1000"),
        (["--scenario", "slow-rack"], "--scenario slow-rack: changes the car"),
        (["--json", "/nowhere/x.json"], "there is no folder /nowhere"),
        (["-i", "socketcan"], "name the channel too"),
    ],
)
def test_a_mistake_is_one_line(arguments: list[str], says: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["soak", *arguments]) == 2
    said = capsys.readouterr().err
    assert says in said
    assert said.count("\n") == 1


def test_without_cyclictest_one_line_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert cli.main(["soak"]) == 2
    assert "apt-get install rt-tests" in capsys.readouterr().err


def living(pids: list[int]) -> list[int]:
    return [pid for pid in pids if Path(f"/proc/{pid}").exists()]


@pytest.mark.live
def test_an_interrupted_soak_ends_its_processes_and_says_so(tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "tools.cli", "soak", "-c", "28680", "--no-cyclictest", "--json", "soak.json"],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT), "COLUMNS": "120"},
    )  # fmt: skip
    assert process.stdout is not None
    end_s = time.monotonic() + 60.0
    for line in process.stdout:
        assert time.monotonic() < end_s
        if line.startswith("Forward"):
            break
    children = [int(p) for p in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()]
    assert len(children) == 2
    process.send_signal(signal.SIGINT)
    said = process.communicate(timeout=60)[0]
    assert process.returncode == 130, said
    assert "interrupted in leg Forward: the operator's stop brought the car to standstill" in said
    figures = json.loads((tmp_path / "soak.json").read_text())
    assert (figures["passed"], figures["interrupted"], figures["tests"]) == (False, True, [])
    assert living(children) == []
