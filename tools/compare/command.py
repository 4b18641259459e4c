"""`parkctl compare`: the controllers that people use beside the shipped one, on the same plant in the same runs."""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from sim.errors import UserError
from tools.run_folder import check_writable_file, write_whole

if TYPE_CHECKING:
    from rich.console import Console

    from sim.data_files import Course, Vehicle
    from tools.compare.latency import Borne
    from tools.compare.runs import RunFigures, Setting
    from tools.compare.verdicts import Figures
    from tools.compare.work import Task

SCENARIOS = ("ideal", "quantised", "car-quiet", "car", "car-unknown-lag", "car-drift")
SEEDS = 64
"""Runs of each: four times every corner of the car on either side. Of fewer, the greatest error is one run's luck."""

FIRST_SEED = 2_000_000
"""Of the measured runs; the training seeds lie far below."""

MOST_SEEDS = 10_000
SEEDS_A_TASK = 4


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `parkctl compare`."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = """\
Path, speed, gear changes, limits, plant, noise and seeds are the same for all; the steering law alone is exchanged.
Inputs: `raw` is the newest pose as it comes, measured speed, yaw rate and wheel angle; `estimator` is the state of the
firmware's own estimator, with the steering's disturbance that it has learnt taken off every law's command. `car`
brings its estimator along, so its two rows are the same runs. All others were tuned alike, on other seeds
(tools/compare/tunings.json); --tune does that again (some minutes), then compares.
Errors are the rear axle's true ones against the path: max over all seeds, p95 over the seeds' maxima. The greatest
error is that of one run: beside a verdict stands the difference of `car` to the best other in the mean over the runs'
maxima, with its standard error, and in how many runs `car` had the smaller one.
Errors of metres are no slip: in the sharpest bend the heaviest car on the softest tyres needs more angle than it has,
and a law with large gains and no bound on its correction then swings between the limits to the end.
Latency is how many samples of 10 ms the steering command may take longer in `car` than the law knows of, so that in
every corner of the car on either side (the first 16 seeds) the run still comes to its end and stays within 50 mm of
the path, with the firmware's supervision, which would stop some of them, out of the way; - is a law that does not even
with none added. A small error can be bought with gains that leave little of it: the last verdict holds `car` against
those only that bear what the vehicle file asks of a design (least_delay_margin_samples), and `car` has to bear that
itself. With fewer seeds than 16 not every corner was driven."""
    what = parser.add_argument_group("what is compared")
    what.add_argument(
        "--scenario",
        metavar="NAME|FILE",
        action="append",
        help=f"may be repeated (default: {', '.join(SCENARIOS)}; slow-rack is another)",
    )
    what.add_argument("--controller", metavar="NAME", action="append", help="may be repeated (default: all)")
    what.add_argument("--inputs", choices=("raw", "estimator"), action="append", help="(default: both)")
    what.add_argument("--seeds", type=int, default=SEEDS, metavar="N", help=f"runs of each (default: {SEEDS})")
    what.add_argument("--seed", type=int, default=FIRST_SEED, metavar="N", help=f"the first (default: {FIRST_SEED})")
    what.add_argument("--vehicle", default="paper", metavar="NAME|FILE", help="the car (default: paper)")
    what.add_argument("--course", default="ohio", metavar="NAME|FILE", help="the course (default: ohio)")
    how = parser.add_argument_group("how it is run")
    how.add_argument("--tune", action="store_true", help="tune all controllers anew first and store the tunings")
    how.add_argument(
        "--budget", type=int, default=40, metavar="N", help="candidates that --tune tries for each (default: 40)"
    )
    how.add_argument("--tunings", type=Path, metavar="FILE", help="tunings (default: the shipped ones)")
    how.add_argument("--jobs", type=int, metavar="N", help="processes (default: one for each core)")
    out = parser.add_argument_group("what is written")
    out.add_argument("--json", type=Path, metavar="FILE", help="the rows for machines")
    out.add_argument("--plot", type=Path, metavar="FILE", help="the errors as a picture (.png)")


class Prepared(NamedTuple):
    """Everything checked and loaded, before the first run."""

    vehicle: Vehicle
    course: Course
    settings: dict[str, Setting]
    measured: list[str]
    tables_dir: Path
    controllers: list[str]
    inputs: list[str]
    seeds: list[int]
    jobs: int


def run(args: argparse.Namespace) -> int:
    """Compare, print the table, write what was asked for; return the exit status."""
    from rich.console import Console  # noqa: PLC0415

    console = Console()
    jobs = _check(args)
    with ExitStack() as stack:
        prepared = _prepare(args, jobs, stack)
        tunings = _tunings(args, prepared)
        begun_s = time.monotonic()
        figures = _measure(prepared, tunings.numbers)
        borne = _bear(prepared, tunings.numbers)
        rows = _rows(prepared, tunings.numbers, figures, borne)
        _report(args, console, prepared, figures, borne, rows, tunings.stale, time.monotonic() - begun_s)
    return 0


def _check(args: argparse.Namespace) -> int:
    """Check what can be checked without loading anything; return the number of processes."""
    if not 1 <= args.seeds <= MOST_SEEDS:
        raise UserError(f"--seeds {args.seeds}: must be from 1 to {MOST_SEEDS}")
    if not 1 <= args.budget <= 1000:
        raise UserError(f"--budget {args.budget}: must be from 1 to 1000")
    if args.seed < 1000:
        raise UserError(f"--seed {args.seed}: must be at least 1000; those below are for tuning")
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    jobs: int = cores if args.jobs is None else args.jobs
    if not 1 <= jobs <= 256:
        raise UserError(f"--jobs {jobs}: must be from 1 to 256")
    for file in (args.json, args.plot):
        if file is not None:
            check_writable_file(file)
    if args.plot is not None and args.plot.suffix != ".png":
        raise UserError(f"--plot {args.plot}: name a file that ends in .png")
    if args.tune and args.tunings is not None:
        check_writable_file(args.tunings)
    return jobs


def _prepare(args: argparse.Namespace, jobs: int, stack: ExitStack) -> Prepared:
    from sim.data_files import load_course, load_scenario, load_vehicle  # noqa: PLC0415
    from tools.compare import procedure  # noqa: PLC0415
    from tools.compare.runs import CONTROLLERS, INPUTS  # noqa: PLC0415

    controllers = list(dict.fromkeys(args.controller or CONTROLLERS))
    for name in controllers:
        if name not in CONTROLLERS:
            raise UserError(f"--controller {name}: there is no such one; there are {', '.join(CONTROLLERS)}")
    names = list(dict.fromkeys(args.scenario or SCENARIOS))
    wanted = {name: load_scenario(name) for name in names}
    for name, scenario in wanted.items():
        if scenario.faults:
            raise UserError(f"--scenario {name}: has [[faults]]; a comparison drives without")
    if args.tune:
        wanted |= {name: load_scenario(name) for name in procedure.SCENARIOS if name not in wanted}
    vehicle = load_vehicle(args.vehicle)
    course = load_course(args.course)
    made: dict[str, Path] = {}
    settings = {name: _setting(args.vehicle, scenario, course, made, stack) for name, scenario in wanted.items()}
    tables_dir = _tables(vehicle, course, made, stack)
    inputs = [name for name in INPUTS if name in (args.inputs or INPUTS)]
    seeds = list(range(args.seed, args.seed + args.seeds))
    return Prepared(vehicle, course, settings, names, tables_dir, controllers, inputs, seeds, jobs)


def _setting(vehicle: str, scenario: Any, course: Course, made: dict[str, Path], stack: ExitStack) -> Setting:
    from sim.data_files import load_vehicle  # noqa: PLC0415
    from tools.compare.runs import setting_of  # noqa: PLC0415

    with_overlay = load_vehicle(vehicle, scenario.vehicle_overlay)
    return setting_of(with_overlay, course, scenario, _tables(with_overlay, course, made, stack))


def _tables(vehicle: Vehicle, course: Course, made: dict[str, Path], stack: ExitStack) -> Path:
    """Return the folder of tables for a car: the shipped one, or one designed now, once a car."""
    from sim.data_files import check_fit  # noqa: PLC0415
    from tools.design.tables import design_tables, tables_folder  # noqa: PLC0415

    check_fit(vehicle, course)
    key = f"{vehicle.hash24:06x}"
    if key not in made:
        shipped = tables_folder(vehicle, course)
        if shipped is None:
            print(f"making tables of {vehicle.name} for a scenario's car", file=sys.stderr, flush=True)
            shipped = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="parkctl-tables-"))) / "tables"
            design_tables(vehicle, course, shipped)
        made[key] = shipped
    return made[key]


def _tunings(args: argparse.Namespace, prepared: Prepared) -> Any:
    """Return the stored tunings, made anew where asked for; say so where they are not of this car, path and code."""
    from tools.compare import tunings  # noqa: PLC0415

    file = args.tunings or tunings.STORED
    if args.tune:
        _tune(prepared, file, args.budget)
    stored = tunings.load(file, prepared.vehicle, prepared.course, prepared.tables_dir)
    if stored.stale:
        print(
            f"parkctl: warning: {file.name}: the tunings are stale ({'; '.join(stored.stale)}); "
            "`parkctl compare --tune` makes them anew",
            file=sys.stderr,
        )
    return stored


def _compile(prepared: Prepared) -> None:
    """Compile here first, so that the processes find it done; a run is what makes numba compile."""
    from tools.compare.runs import CONTROLLERS, Driver, is_compiled  # noqa: PLC0415

    if not is_compiled():
        print("compiling core, plant and controllers, once for this version (a minute)", file=sys.stderr, flush=True)
        Driver(next(iter(prepared.settings.values()))).run(CONTROLLERS["car"].law, (), "estimator", FIRST_SEED)


def _tune(prepared: Prepared, file: Path, budget: int) -> None:
    from tools.compare import procedure, tunings, work  # noqa: PLC0415
    from tools.compare.runs import CONTROLLERS  # noqa: PLC0415
    from tools.progress import CountProgress  # noqa: PLC0415

    _compile(prepared)
    settings = {name: prepared.settings[name] for name in procedure.SCENARIOS}
    parts = [(name, inputs, budget) for name, it in CONTROLLERS.items() if it.box for inputs in it.inputs]
    parts.sort(key=lambda part: part[0] != "mpc")  # what takes longest, first
    progress = CountProgress("tuning", "tunings", len(parts))
    progress.show(time.monotonic(), 0)
    found = {}
    try:
        for (name, inputs), tuned in work.spread(work.tune_one, parts, settings, prepared.jobs):
            found[name, inputs] = tuned
            progress.show(time.monotonic(), len(found), f"{name} {inputs}: {1e3 * tuned.cost_m:.1f} mm")
    finally:
        progress.close()
    by_name = {
        name: {inputs: found[name, inputs] for inputs in it.inputs} for name, it in CONTROLLERS.items() if it.box
    }
    tunings.store(file, by_name, budget, prepared.vehicle, prepared.course, prepared.tables_dir)


def _driven(name: str, inputs: str) -> str:
    """Return the inputs that a controller is driven with for a row: those of the row, unless it brings its own."""
    from tools.compare.runs import CONTROLLERS, ESTIMATOR  # noqa: PLC0415

    return inputs if CONTROLLERS[name].box else ESTIMATOR


def _tasks(
    prepared: Prepared, numbers: dict[tuple[str, str], tuple[float, ...]], scenario: str, seeds: list[int], size: int
) -> list[Task]:
    """Return the runs of all controllers in a scenario as tasks of so many seeds."""
    from tools.compare.work import Task  # noqa: PLC0415

    return [
        Task(name, inputs, scenario, numbers.get((name, inputs), ()), tuple(seeds[first : first + size]))
        for name in prepared.controllers
        for inputs in dict.fromkeys(_driven(name, inputs) for inputs in prepared.inputs)
        for first in range(0, len(seeds), size)
    ]


def _measure(prepared: Prepared, numbers: dict[tuple[str, str], tuple[float, ...]]) -> Figures:
    from tools.compare import work  # noqa: PLC0415
    from tools.progress import CountProgress  # noqa: PLC0415

    _compile(prepared)
    tasks = [
        task
        for scenario in prepared.measured
        for task in _tasks(prepared, numbers, scenario, prepared.seeds, SEEDS_A_TASK)
    ]
    tasks.sort(key=_is_quick)
    total = sum(len(task.seeds) for task in tasks)
    progress = CountProgress("compare", "runs", total)
    progress.show(time.monotonic(), 0)
    done = 0
    by_seed: dict[tuple[str, str, str], dict[int, RunFigures]] = {}
    try:
        for task, runs in work.spread(work.drive_task, tasks, prepared.settings, prepared.jobs):
            key = (task.scenario, task.controller, task.inputs)
            by_seed.setdefault(key, {}).update(zip(task.seeds, runs, strict=True))
            done += len(runs)
            progress.show(time.monotonic(), done)
    finally:
        progress.close()
    figures: Figures = {}
    for scenario in prepared.measured:
        for name in prepared.controllers:
            for inputs in prepared.inputs:
                runs_of = by_seed[scenario, name, _driven(name, inputs)]
                figures[scenario, name, inputs] = [runs_of[seed] for seed in prepared.seeds]
    return figures


def _bear(prepared: Prepared, numbers: dict[tuple[str, str], tuple[float, ...]]) -> Borne | None:
    """Return what added latency each controller bears; None where the scenario for that is not compared."""
    from tools.compare import latency, work  # noqa: PLC0415
    from tools.progress import CountProgress  # noqa: PLC0415

    if latency.SCENARIO not in prepared.measured:
        return None
    seeds = prepared.seeds[: latency.RUNS]
    tasks = _tasks(prepared, numbers, latency.SCENARIO, seeds, latency.RUNS)
    tasks.sort(key=_is_quick)
    progress = CountProgress("latency", "laws", len(tasks))
    progress.show(time.monotonic(), 0)
    found: dict[tuple[str, str], int | None] = {}
    try:
        for task, samples in work.spread(work.bear_task, tasks, prepared.settings, prepared.jobs):
            found[task.controller, task.inputs] = samples
            progress.show(time.monotonic(), len(found))
    finally:
        progress.close()
    vehicle = prepared.settings[latency.SCENARIO].shared.vehicle
    samples_of = {
        (name, inputs): found[name, _driven(name, inputs)]
        for name in prepared.controllers
        for inputs in prepared.inputs
    }
    return latency.Borne(samples_of, latency.most_samples(vehicle), vehicle.criteria.least_delay_margin_samples)


def _is_quick(task: Task) -> bool:
    """Sort what takes longest first."""
    return task.controller != "mpc"


# -- what came out ----------------------------------------------------------------------------------------------------


def _rows(
    prepared: Prepared,
    numbers: dict[tuple[str, str], tuple[float, ...]],
    figures: Figures,
    borne: Borne | None,
) -> list[dict[str, Any]]:
    from tools.compare.latency import SCENARIO  # noqa: PLC0415
    from tools.compare.rows import DIRECTIONS, row_of, tick_us  # noqa: PLC0415

    tables = next(iter(prepared.settings.values())).shared.tables["left"]
    taken = {
        (name, inputs): tick_us(name, numbers.get((name, inputs), ()), tables)
        for name in prepared.controllers
        for inputs in prepared.inputs
    }
    latency = {} if borne is None else {(SCENARIO, *key): samples for key, samples in borne.samples.items()}
    return [
        row_of(
            name,
            inputs,
            scenario,
            prepared.vehicle.name,
            leg,
            runs,
            taken[name, inputs],
            latency.get((scenario, name, inputs)),
        )
        for (scenario, name, inputs), runs in figures.items()
        for leg in range(len(DIRECTIONS))
    ]


def _report(
    args: argparse.Namespace,
    console: Console,
    prepared: Prepared,
    figures: Figures,
    borne: Borne | None,
    rows: list[dict[str, Any]],
    stale: list[str],
    passed_s: float,
) -> None:
    from tools.compare.rows import both_of  # noqa: PLC0415
    from tools.compare.table import print_tables  # noqa: PLC0415
    from tools.compare.verdicts import line_of, verdicts  # noqa: PLC0415

    both = {key: both_of(runs) for key, runs in figures.items()}
    ticks = {(row["controller"], row["inputs"]): row["tick_us"] for row in rows}
    titles = {name: prepared.settings[name].scenario.name for name in prepared.measured}
    print_tables(console, titles, both, ticks, borne)
    judged = verdicts(figures, borne)
    for verdict in judged:
        console.print(line_of(verdict), soft_wrap=True, highlight=False)
    console.print(f"{len(prepared.seeds)} seeds from {prepared.seeds[0]}, {passed_s / 60.0:.1f} min", highlight=False)
    if args.json is not None:
        content = {
            "seeds": prepared.seeds,
            "seconds": passed_s,
            "stale_tunings": stale,
            "claims": [verdict._asdict() for verdict in judged],
            "rows": rows,
        }
        write_whole(args.json, json.dumps(content, indent=1) + "\n")
    if args.plot is not None:
        from tools.plots.compare import compare_picture  # noqa: PLC0415

        compare_picture(args.plot, both, title=_title(prepared))
        console.print(f"picture: {args.plot}", soft_wrap=True, highlight=False)


def _title(prepared: Prepared) -> str:
    return (
        f"true cross-track error of the rear axle in mm, {prepared.vehicle.name} on {prepared.course.name}, "
        f"both legs, {len(prepared.seeds)} runs each"
    )
