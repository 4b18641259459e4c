"""`parkctl soak`: tests back to back; controller, car and operator stay up, and each test begins where the last ended.

After a test the car stands parked in the box from which it came, as far off the start as its own errors have brought
it; the operator presses start again as soon as the controller is Ready. cyclictest runs beside it all the time and
tells what the machine itself delays.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from sim.errors import UserError
from tools.bench import wake
from tools.bench.process import rss_mib
from tools.bench.rows import quantile
from tools.buses import BusChoice, add_bus_arguments, choose_own_bus, open_bus, opened, refuse_occupied_bus
from tools.live_run import BLOCKED_LIMIT_S, DRIVE_LIMIT_S, PASSING_REASONS, STANDSTILL_LIMIT_S, START_LIMIT_S, LiveRun
from tools.operator_station import ACTIVE, COMPLETE, DBC, FAULT, MANUAL, Station
from tools.run_folder import MARK, RunFolder, check_writable_file, write_whole

if TYPE_CHECKING:
    from rich.console import Console

RUNS = 18
MOST_RUNS = 1000
LISTEN_S = 0.25
SIDE, LAW = "left", "car"
TABLES = Path(__file__).resolve().parent.parent.parent / "firmware_py" / "tables" / "paper-ohio"
LATE_US = 1000.0
"""What counts as late, of the controller's cycles (its LATE_NS) and of cyclictest's wake-ups."""
MEMORY_MIB = 0.5
"""So much the controller's resident memory may grow after the first test: a leak of 10 bytes a cycle shows in ten."""

EXIT_PASSED, EXIT_FAILED, EXIT_INTERRUPTED = 0, 1, 130


class Drive(NamedTuple):
    """One test of the soak, as the processes report it at its end; counts are of this test alone."""

    number: int
    duration_s: float
    late_cycles: int
    overruns: int
    rss_mib: float


class Row(NamedTuple):
    """A line of the verdict: what was counted, and the most (or, for the tests, the least) that it may be."""

    name: str
    value: float
    must: float
    why: str = ""

    @property
    def passed(self) -> bool:
        """Whether the figure is within its limit."""
        return self.value >= self.must if self.name == "tests_completed" else self.value <= self.must


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `parkctl soak`."""
    parser.epilog = (
        "Exit status: 0 all within its limits; 1 not; 2 a mistake in what was given; 130 interrupted. A test takes "
        "half a minute. On a real vcan0: parkctl guest -- parkctl soak -i socketcan -c vcan0."
    )
    parser.add_argument("--runs", type=int, default=RUNS, metavar="N", help=f"tests in a row (default: {RUNS}, 10 min)")
    parser.add_argument("--scenario", default="car", metavar="NAME|FILE", help="how the car is (default: car)")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="decides noise and parameters (default: 1)")
    parser.add_argument("--realtime", choices=("auto", "off", "required"), help="as with parkctl demo")
    parser.add_argument("--no-cyclictest", action="store_true", help="judge no late cycles; cyclictest is not needed")
    parser.add_argument("--out", metavar="DIR", help="folder for truth, flight record and figures")
    parser.add_argument("--json", type=Path, metavar="FILE", help="the figures for machines")
    add_bus_arguments(parser, default_text="default: loopbus, the embedded bus on 127.0.0.1")


def run(args: argparse.Namespace) -> int:
    """Run the soak; return its exit status. Raises UserError before anything is started or written."""
    from rich.console import Console  # noqa: PLC0415

    from sim.data_files import load_scenario  # noqa: PLC0415

    if not 1 <= args.runs <= MOST_RUNS:
        raise UserError(f"--runs {args.runs}: must be from 1 to {MOST_RUNS}")
    if load_scenario(args.scenario).vehicle_overlay:
        raise UserError(f"--scenario {args.scenario}: changes the car, and the soak drives by the shipped tables")
    choice = choose_own_bus(args.interface, args.channel, args.bitrate)
    if args.json is not None:
        check_writable_file(args.json)
    if not args.no_cyclictest and (why := wake.why_no_cyclictest()):
        raise UserError(f"soak: {why}; or leave the late cycles out with --no-cyclictest")
    folder = None if args.out is None else RunFolder.plan(args.out, "soak")
    with contextlib.ExitStack() as stack:
        bus = stack.enter_context(
            opened(open_bus(choice.interface, choice.channel, choice.bitrate, ignore_settings=True))
        )
        station = Station(DBC)
        refuse_occupied_bus(bus, choice, station.frame_ids, LISTEN_S)
        if folder is None:
            place = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="parkctl-soak-")))
        else:
            folder.make()
            place = folder.path
            write_whole(place / MARK, json.dumps({"soak": args.runs, "bus": choice._asdict()}) + "\n")
        try:
            figures = _soak(args, choice, bus, station, place)
        except (UserError, KeyboardInterrupt):
            if folder is not None:
                folder.discard()
            raise
        text = json.dumps(figures, indent=2) + "\n"
        if folder is not None:
            write_whole(place / "soak.json", text)
        if args.json is not None:
            write_whole(args.json, text)
    _print(Console(highlight=False), figures)
    if figures["passed"]:
        return EXIT_PASSED
    return EXIT_INTERRUPTED if figures["interrupted"] else EXIT_FAILED


def _soak(args: argparse.Namespace, choice: BusChoice, bus: Any, station: Station, folder: Path) -> dict[str, Any]:
    """Drive, and return the figures."""
    from tools.bus_log import NoLog  # noqa: PLC0415
    from tools.figures import load_path  # noqa: PLC0415
    from tools.progress import Progress  # noqa: PLC0415

    common = [*choice.arguments(), "--no-config", "--side", SIDE, "--status", "--out", str(folder)]
    common += [] if args.realtime is None else ["--realtime", args.realtime]
    soak = SoakRun(
        args.runs,
        bus=bus,
        station=station,
        log=NoLog(),
        progress=Progress(),
        path=load_path(TABLES, SIDE),
        realtime=args.realtime,
    )
    with contextlib.ExitStack() as stack:
        beside = None
        if not args.no_cyclictest:
            beside = wake.Beside()
            stack.callback(beside.close)
        outcome = soak.run(
            [*common, "--tables", str(TABLES), "--law", LAW],
            [*common, "--scenario", args.scenario, "--seed", str(args.seed)],
            folder,
        )
        floor_us = beside.late_us() if beside else []
    return figures_of(args.runs, soak, outcome.controller, outcome.why, floor_us, folder) | {
        "interrupted": outcome.interrupted,
        "bus": {"interface": choice.interface, "channel": choice.channel},
        "scenario": args.scenario,
        "seed": args.seed,
    }


class SoakRun(LiveRun):
    """The processes of a run, but the operator starts one test after the other."""

    def __init__(self, runs: int, **parts: Any) -> None:
        super().__init__(**parts)
        self._runs = runs
        self.tests: list[Drive] = []
        self.faults = 0
        self.vehicle: dict[str, Any] = {}
        """The emulator's newest report."""

    def _drive(self) -> str | None:
        station = self._station
        late = overruns = 0
        waiting_s = time.monotonic()
        began_s: float | None = None
        blocked_s: float | None = None
        while len(self.tests) < self._runs:
            self._pump()
            now_s = time.monotonic()
            station.press_start_when_ready(time.monotonic_ns())
            if self._interrupts:
                return self._stop_by_operator(driving=began_s is not None)
            if self._emulator.ended():
                return self._emulator_gone()
            if self._controller.ended():
                return self._controller_gone()
            if station.mode == FAULT:
                self.faults += 1
                text = station.reason_text
                self._pump_until(self._stands, STANDSTILL_LIMIT_S)
                return f"test {len(self.tests) + 1}: the controller stopped the car: {text}"
            if began_s is None:
                began_s = now_s if station.mode == ACTIVE else None
                blocked = station.mode == MANUAL and station.reason not in {*PASSING_REASONS, COMPLETE}
                blocked_s = (blocked_s or now_s) if blocked else None
                if now_s - waiting_s > START_LIMIT_S or now_s - (blocked_s or now_s) > BLOCKED_LIMIT_S:
                    return f"test {len(self.tests) + 1}: the car did not start: {station.reason_text}"
            elif station.completions > len(self.tests):
                said = self._controller.latest
                test = Drive(
                    number=len(self.tests) + 1,
                    duration_s=now_s - began_s,
                    late_cycles=said.get("late_cycles", 0) - late,
                    overruns=said.get("overruns", 0) - overruns,
                    rss_mib=rss_mib(self._controller.process.pid),
                )
                late, overruns = late + test.late_cycles, overruns + test.overruns
                self.tests.append(test)
                self._progress.close()
                print(_line_of(test, self._runs), flush=True)
                began_s, waiting_s = None, now_s
                station.allow_another_start()
            elif now_s - began_s > DRIVE_LIMIT_S:
                return f"test {len(self.tests) + 1} was not over after {DRIVE_LIMIT_S:.0f} s"
        self.vehicle = self._emulator.latest
        return None


def _line_of(test: Drive, runs: int) -> str:
    return (
        f"test {test.number:2d} of {runs}: {test.duration_s:.1f} s, {test.late_cycles} late cycles, "
        f"{test.overruns} skipped, controller {test.rss_mib:.2f} MiB"
    )


def figures_of(
    runs: int,
    soak: SoakRun,
    controller: dict[str, Any],
    why: str | None,
    floor_us: list[float],
    folder: Path,
) -> dict[str, Any]:
    """Put the figures together: the verdict's rows, what the processes told at their end, each test."""
    exam_file, truth_file = folder / "exam.json", folder / "truth.csv"
    exam = json.loads(exam_file.read_text()) if exam_file.is_file() else {}
    vehicle = soak.vehicle
    rejected = (controller.get("frames_rejected") or 0) + vehicle.get("rejected", 0)
    lost = (controller.get("frames_lost") or 0) + vehicle.get("lost", 0)
    memory = [test.rss_mib for test in soak.tests]
    rows = [
        Row("tests_completed", len(soak.tests), runs),
        Row("faults", soak.faults, 0),
        Row("frames_lost", lost, 0),
        Row("frames_rejected", rejected, 0),
        Row("frames_refused", controller.get("send_failed") or 0, 0),
        Row("cones_touched", len(exam.get("cones_touched", ())), 0),
        Row("memory_growth_mib", max(memory) - memory[0] if memory else 0.0, MEMORY_MIB),
    ]
    if floor_us:
        floor_late = sum(us > LATE_US for us in floor_us)
        told = f"cyclictest: {floor_late} of {len(floor_us)}"
        rows.append(Row("late_cycles", controller.get("late_cycles") or 0, 2 * floor_late + 5, told))
    legs = _worst_of_legs(truth_file) if truth_file.is_file() and soak.tests else {}
    return {
        "passed": why is None and all(row.passed for row in rows),
        "why": why,
        "rows": [row._asdict() | {"passed": row.passed} for row in rows],
        "tests": [test._asdict() for test in soak.tests],
        "worst": legs,
        "cyclictest": {
            f"wake_{name}_us": quantile(floor_us, share)
            for name, share in (("p50", 0.5), ("p99", 0.99), ("max", 1.0))
            if floor_us
        },
        "controller": controller,
    }


def _worst_of_legs(truth_file: Path) -> dict[str, float]:
    """Return the worst figures of all legs, by the plant's own truth."""
    from tools.figures import leg_figures, load_path, load_truth, split_legs  # noqa: PLC0415

    path, truth = load_path(TABLES, SIDE), load_truth(truth_file)
    legs = [leg_figures(leg, truth, path) for leg in split_legs(truth, path, None)]
    return {
        "max_cross_track_m": max((leg["max_cross_track_m"] for leg in legs), default=0.0),
        "max_final_cross_track_m": max((abs(leg["final_cross_track_m"]) for leg in legs), default=0.0),
        "max_final_station_error_m": max((abs(leg["final_station_error_m"]) for leg in legs), default=0.0),
        "min_clearance_m": min((leg["min_clearance_m"] for leg in legs), default=0.0),
    }


def _print(console: Console, figures: dict[str, Any]) -> None:
    from rich.table import Table  # noqa: PLC0415

    bus, controller, floor = figures["bus"], figures["controller"], figures["cyclictest"]
    table = Table(title=f"parkctl soak on {bus['interface']} {bus['channel']}", title_justify="left")
    for heading in ("figure", "value", "must", "", ""):
        table.add_column(heading, justify="right" if heading in ("value", "must") else "left", no_wrap=True)
    for row in figures["rows"]:
        sign = "≥" if row["name"] == "tests_completed" else "≤"
        mark = "[green]ok[/]" if row["passed"] else "[red]OVER[/]"
        table.add_row(row["name"], f"{row['value']:g}", f"{sign} {row['must']:g}", mark, row["why"])
    console.print(table)
    if controller.get("cycles"):
        console.print(
            f"{controller['cycles']} cycles, {controller['overruns']} skipped; wake-up late p50/p99/max "
            f"{controller['wake_p50_us']:.0f}/{controller['wake_p99_us']:.0f}/{controller['wake_max_us']:.0f} us "
            f"({controller['scheduler']})"
            + (
                f"; cyclictest {floor['wake_p50_us']:.0f}/{floor['wake_p99_us']:.0f}/{floor['wake_max_us']:.0f}"
                if floor
                else ""
            ),
            soft_wrap=True,
        )
    if figures["worst"]:
        worst = figures["worst"]
        console.print(
            f"worst of all legs: cross-track {1e3 * worst['max_cross_track_m']:.1f} mm, at the end "
            f"{1e3 * worst['max_final_cross_track_m']:.1f} mm aside and "
            f"{1e3 * worst['max_final_station_error_m']:.1f} mm along; clearance {worst['min_clearance_m']:.3f} m",
            soft_wrap=True,
        )
    if figures["why"]:
        console.print(f"not passed: {figures['why']}", soft_wrap=True)
