"""`parkctl demo`: the whole test, from the car's file to the examiner's card, live or in virtual time."""

from __future__ import annotations

import json
import platform
import shutil
import sys
import tempfile
from contextlib import ExitStack
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from firmware_py.table_file import LAWS
from sim.errors import UserError
from tools.buses import BusChoice, add_bus_arguments, choose_own_bus, open_bus, opened, refuse_occupied_bus
from tools.run_folder import MARK, RunFolder, check_writable_file, write_whole

if TYPE_CHECKING:
    import argparse

    import can
    from rich.console import Console

    from sim.data_files import Course, Scenario, Side, Vehicle
    from tools.figures import Leg, PathTable, Truth

EXIT_PASSED = 0
EXIT_FAILED = 1
EXIT_INTERRUPTED = 130
LISTEN_S = 0.25
"""A bus is listened to for so long before it is used: twice the longest timeout of a fast message."""
DBC = Path(__file__).resolve().parent.parent / "dbc" / "parking.dbc"
DEFAULT_COURSE = "ohio"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `parkctl demo`."""
    parser.epilog = (
        "Exit status: 0 the test was passed and both processes ended cleanly; 1 it was not; 2 a mistake in what was "
        "given; 130 interrupted (the car is stopped first). CAN_* variables and can.conf files are ignored here, and "
        "a physical bus is used only where -i and -c name it."
    )
    what = parser.add_argument_group("what is driven (a NAME of a shipped file, or the path of a .toml FILE)")
    what.add_argument("--vehicle", default="paper", metavar="NAME|FILE", help="the car (default: paper)")
    what.add_argument(
        "--course", metavar="NAME|FILE", help="cones, start and stop (default: the scenario's own, else ohio)"
    )
    what.add_argument("--side", choices=("left", "right"), default="left", help="where to pass the point cone (left)")
    what.add_argument(
        "--scenario",
        default="car",
        metavar="NAME|FILE",
        help="how car and sensors differ from the ideal (default: car)",
    )
    what.add_argument(
        "--law", choices=LAWS, default="car",
        help="control law (default: car); paper, dob and pid are the paper's own, which no car can be reversed by",
    )  # fmt: skip
    what.add_argument(
        "--seed", type=int, default=1, metavar="N", help="decides noise and unknown parameters (default: 1)"
    )
    how = parser.add_argument_group("how it is run")
    how.add_argument(
        "--lockstep", action="store_true", help="one process, virtual time: seconds, and the same bits at the same seed"
    )
    how.add_argument(
        "--tables",
        metavar="DIR",
        help="tables to drive by (default: the shipped ones of car and course, else made now)",
    )
    how.add_argument(
        "--realtime",
        choices=("auto", "off", "required"),
        help="real-time priority (SCHED_FIFO): where permitted (auto), never (off), or end with an error without it; "
        "default: auto, for the controller on a physical bus required",
    )
    out = parser.add_argument_group("what is written")
    out.add_argument(
        "--out", metavar="DIR", help="folder of this run (default: runs/TIME-VEHICLE-COURSE-SIDE-SCENARIO)"
    )
    out.add_argument("--json", metavar="FILE", help="the figures for machines (always in DIR/figures.json too)")
    out.add_argument("--no-plots", action="store_true", help="no pictures; saves two seconds")
    add_bus_arguments(parser, default_text="default: loopbus, the embedded bus on 127.0.0.1")


class Plan(NamedTuple):
    """What a demo is about to do, all of it checked."""

    vehicle: Vehicle
    course: Course
    scenario: Scenario
    side: Side
    law: str
    seed: int
    lockstep: bool
    realtime: str | None
    """None leaves the choice to each process, which knows whether its bus is a real one."""
    bus: BusChoice
    named: dict[str, str]
    """vehicle, course and scenario as the user named them, for the processes."""


class Driven(NamedTuple):
    """What a run brought: the plant's truth and verdict (None where there is none) and how the controller ended."""

    truth: Truth | None
    exam: dict[str, Any] | None
    controller: dict[str, Any]
    why: str | None
    interrupted: bool


def run(args: argparse.Namespace) -> int:
    """Run the demo; return its exit status. Raises UserError before anything is started or written."""
    plan = _plan(args)
    folder = RunFolder.plan(args.out, f"{plan.vehicle.name}-{plan.course.name}-{plan.side}-{plan.scenario.name}")
    json_file = None if args.json is None else Path(args.json)
    if json_file is not None and json_file.parent.resolve() != folder.path.resolve():
        check_writable_file(json_file)
    from rich.console import Console  # noqa: PLC0415

    console = Console(highlight=False)
    print(f"vehicle   {plan.vehicle.name}: {plan.vehicle.description}")
    print(f"course    {plan.course.name}, {plan.side} side: {plan.course.description}")
    print(f"scenario  {plan.scenario.name}: {plan.scenario.description}; law {plan.law}, seed {plan.seed}")
    with ExitStack() as stack:
        bus = None if plan.lockstep else _quiet_bus(plan.bus, stack)
        made = _given_tables(plan, Path(args.tables)) if args.tables else _tables(plan, stack)
        tables = _begin_folder(plan, made, folder)
        try:
            driven = _drive_lockstep(plan, tables, folder) if bus is None else _drive_live(plan, tables, folder, bus)
        except (UserError, KeyboardInterrupt):
            folder.discard()
            raise
        return _report(plan, tables, folder, driven, console, json_file, plots=not args.no_plots)


def _plan(args: argparse.Namespace) -> Plan:
    from sim.data_files import check_fit, load_course, load_scenario, load_vehicle  # noqa: PLC0415

    if args.seed < 0:
        raise UserError(f"--seed {args.seed}: must not be negative")
    bus = choose_own_bus(args.interface, args.channel, args.bitrate)
    if args.lockstep and (args.interface or args.channel or args.bitrate):
        raise UserError("--lockstep: runs in one process without a bus; leave out -i, -c and -b")
    scenario = load_scenario(args.scenario)
    vehicle = load_vehicle(args.vehicle, scenario.vehicle_overlay)
    course_name = args.course or scenario.course or DEFAULT_COURSE
    course = load_course(course_name)
    check_fit(vehicle, course)
    return Plan(
        vehicle=vehicle,
        course=course,
        scenario=scenario,
        side=args.side,
        law=args.law,
        seed=args.seed,
        lockstep=args.lockstep,
        realtime=args.realtime,
        bus=bus,
        named={"vehicle": args.vehicle, "course": course_name, "scenario": args.scenario},
    )


def _quiet_bus(choice: BusChoice, stack: ExitStack) -> can.BusABC:
    """Open the bus, to be closed with the stack. Raises UserError where that fails or somebody already sends there."""
    from tools.operator_station import Station  # noqa: PLC0415

    bus = stack.enter_context(opened(open_bus(choice.interface, choice.channel, choice.bitrate, ignore_settings=True)))
    refuse_occupied_bus(bus, choice, Station(DBC).frame_ids, LISTEN_S)
    return bus


def _given_tables(plan: Plan, folder: Path) -> Path:
    """Return the user's own folder of tables. Raises UserError where it is for another car or cannot be read."""
    from firmware_py.core.controller import PERIOD_S  # noqa: PLC0415
    from firmware_py.table_file import load_tables  # noqa: PLC0415

    made_for = load_tables(folder, plan.side, plan.law, PERIOD_S)
    if made_for.vehicle_hash24 != plan.vehicle.hash24:
        raise UserError(
            f"--tables {folder}: made for another car than {plan.vehicle.name} in scenario {plan.scenario.name}; "
            "leave --tables out and they are made now"
        )
    return folder


def _tables(plan: Plan, stack: ExitStack) -> Path:
    """Return the folder of tables for the car and course: the shipped one, or one designed now.

    Designed tables lie in a temporary folder until the run's own is there.
    """
    from tools.design.tables import design_tables, tables_folder  # noqa: PLC0415

    shipped = tables_folder(plan.vehicle, plan.course)
    if shipped is not None:
        return shipped
    print(f"tables    no fresh ones are shipped for {plan.vehicle.name} on {plan.course.name}: made now", flush=True)
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="parkctl-tables-"))) / "tables"
    design_tables(plan.vehicle, plan.course, folder)
    return folder


def _drive_lockstep(plan: Plan, tables: Path, folder: RunFolder) -> Driven:
    from firmware_py.core.signals import MODE_FAULT  # noqa: PLC0415
    from tools.bus_log import BusLog  # noqa: PLC0415
    from tools.figures import truth_of_rows  # noqa: PLC0415
    from tools.lockstep import run_lockstep  # noqa: PLC0415

    result = run_lockstep(plan.vehicle, plan.course, plan.scenario, plan.side, plan.seed, plan.law, tables, record=True)
    with BusLog(folder.path / "bus.log", "lockstep") as log:
        log.add([(*frame, False) for frame in result.frames])
    write_whole(folder.path / "truth.csv", _csv_of(result.truth))
    exam = result.exam.as_dict()
    write_whole(folder.path / "exam.json", json.dumps(exam, indent=2) + "\n")
    controller = {name: None if name.endswith("_us") else value for name, value in result.controller.items()}
    what = "the controller stopped the car" if controller["mode"] == MODE_FAULT else "the car did not start"
    why = None if controller["completed"] else f"{what}: {controller['reason_text']}"
    return Driven(truth_of_rows(result.truth), exam, controller, why, interrupted=False)


def _drive_live(plan: Plan, tables: Path, folder: RunFolder, bus: can.BusABC) -> Driven:
    from tools.bus_log import BusLog  # noqa: PLC0415
    from tools.figures import load_path, load_truth  # noqa: PLC0415
    from tools.live_run import LiveRun  # noqa: PLC0415
    from tools.operator_station import Station  # noqa: PLC0415
    from tools.progress import Progress  # noqa: PLC0415

    bus_options = plan.bus.arguments()
    options = ["--side", plan.side, "--status", "--out", str(folder.path)]
    options += [] if plan.realtime is None else ["--realtime", plan.realtime]
    controller = [*bus_options, *options, "--no-config", "--once", "--tables", str(tables), "--law", plan.law]
    emulator = [*bus_options, *options, "--no-config", "--seed", str(plan.seed)]
    for name, value in plan.named.items():
        emulator += [f"--{name}", value]
    path = load_path(tables, plan.side)
    watch = f"python -m can.viewer {' '.join(bus_options)}"
    print(f"bus       {plan.bus} (watch it in another terminal: {watch})")
    with BusLog(folder.path / "bus.log", _log_channel(plan.bus)) as log:
        live = LiveRun(bus=bus, station=Station(DBC), log=log, progress=Progress(), path=path, realtime=plan.realtime)
        outcome = live.run(controller, emulator, folder.path)
    truth, exam = folder.path / "truth.csv", folder.path / "exam.json"
    return Driven(
        load_truth(truth) if truth.is_file() else None,
        json.loads(exam.read_text()) if exam.is_file() else None,
        outcome.controller,
        outcome.why,
        outcome.interrupted,
    )


def _log_channel(bus: BusChoice) -> str:
    """Return the channel's name in the log: candump knows names, not port numbers."""
    return bus.interface if bus.channel.isdigit() else bus.channel


def _csv_of(rows: list[Any]) -> str:
    if not rows:
        return ""
    return "\n".join([",".join(rows[0]._fields), *(",".join(repr(value) for value in row) for row in rows)]) + "\n"


def _begin_folder(plan: Plan, tables: Path, folder: RunFolder) -> Path:
    """Make the run's folder with what the run is and its own copy of the tables; return the copy's folder.

    Controller and figures use the copy: the run can be understood later, whatever becomes of the tables.
    """
    folder.make()
    about = {
        **_setup(plan),
        "named": plan.named,
        "vehicle_hash24": plan.vehicle.hash24,
        "begun": datetime.now().astimezone().isoformat(timespec="seconds"),
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.release()} {platform.machine()}",
        "command": sys.argv,
    }
    write_whole(folder.path / MARK, json.dumps(about, indent=2) + "\n")
    copy = folder.path / "tables"
    shutil.copytree(tables, copy)
    return copy


def _setup(plan: Plan) -> dict[str, Any]:
    bus = {"interface": None, "channel": None} if plan.lockstep else {
        "interface": plan.bus.interface, "channel": plan.bus.channel,
    }  # fmt: skip
    return {
        "scenario": plan.scenario.name,
        "law": plan.law,
        "vehicle": plan.vehicle.name,
        "course": plan.course.name,
        "side": plan.side,
        "seed": plan.seed,
        "lockstep": plan.lockstep,
        "bus": bus,
    }


def _report(
    plan: Plan,
    tables: Path,
    folder: RunFolder,
    driven: Driven,
    console: Console,
    json_file: Path | None,
    *,
    plots: bool,
) -> int:
    """Show and write what the run brought; return the exit status."""
    from tools.card import print_card, print_figures  # noqa: PLC0415
    from tools.figures import leg_figures, load_path, load_preview, run_figures, split_legs  # noqa: PLC0415

    path = load_path(tables, plan.side)
    truth = driven.truth
    legs = [] if truth is None else split_legs(truth, path, load_preview(tables, plan.law))
    why = driven.why
    if why is None and driven.exam is None:
        why = "the plant emulator left no verdict"
    if why is None and driven.exam is not None and not driven.exam["passed"]:
        mistakes = "; ".join(
            f"{mistake['rule'].replace('_', ' ')}: {mistake['text']}" for mistake in driven.exam["mistakes"]
        )
        why = f"the examiner did not pass the test ({mistakes})"
    figures = run_figures(
        setup=_setup(plan),
        legs=[leg_figures(leg, truth, path) for leg in legs] if truth is not None else [],
        exam=driven.exam,
        controller=driven.controller,
        why=why,
    )
    text = json.dumps(figures, indent=2) + "\n"
    write_whole(folder.path / "figures.json", text)
    if json_file is not None:
        write_whole(json_file, text)
    print_card(console, figures, plan.course)
    print_figures(console, figures, plan.vehicle)
    if plots and truth is not None:
        _plot(plan, folder, truth, path, legs, why)
    folder.publish()
    print(f"run's folder: {folder.path}", flush=True)
    if why is None:
        return EXIT_PASSED
    print(f"parkctl: not passed: {why}", file=sys.stderr)
    return EXIT_INTERRUPTED if driven.interrupted else EXIT_FAILED


def _plot(plan: Plan, folder: RunFolder, truth: Truth, path: PathTable, legs: list[Leg], why: str | None) -> None:
    from tools.estimates import load_estimates  # noqa: PLC0415
    from tools.plots import signals, swept_body  # noqa: PLC0415

    title = (
        f"{plan.vehicle.name} on {plan.course.name}, {plan.side} side; scenario {plan.scenario.name}, law {plan.law}"
    )
    title += f", seed {plan.seed}" + ("" if why is None else " (not passed)")
    common = {
        "vehicle": plan.vehicle,
        "course": plan.course,
        "truth": truth,
        "path": path,
        "legs": legs,
        "title": title,
    }
    swept_body(folder.path / "swept_body.png", side=plan.side, **common)  # type: ignore[arg-type]
    if legs:
        estimates = load_estimates(folder.path / "bus.log", DBC, path.length_m)
        signals(folder.path / "signals.png", estimates=estimates, **common)  # type: ignore[arg-type]
