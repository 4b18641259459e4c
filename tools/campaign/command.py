"""`parkctl campaign`: many runs that nobody has seen before, on all cores or a cluster, and the worst of them again."""

from __future__ import annotations

import argparse
import base64
import hashlib
import json
import os
import sys
import tempfile
import time
import zlib
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from sim.errors import UserError
from tools.run_folder import check_writable_file, write_whole

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from sim.data_files import Course, Scenario, Vehicle
    from tools.campaign.results import Summary
    from tools.campaign.work import Job

    Rows = npt.NDArray[np.float64]

EXIT_DONE, EXIT_TOUCHED = 0, 1
LAWS = ("car", "pid+ff")
DEFAULTS: dict[str, Any] = {
    "vehicle": "paper",
    "course": "ohio",
    "scenario": "car",
    "law": "car",
    "seed": 1_000_000,
    "tables": None,
}
MOST_RUNS = 10_000_000
SHOWN = {
    "min_clearance_m": ("clearance", "m", 1.0),
    "max_cross_track_m": ("cross-track max", "mm", 1e3),
    "rms_cross_track_m": ("cross-track rms", "mm", 1e3),
    "final_cross_track_m": ("final cross-track", "mm", 1e3),
    "final_heading_error_rad": ("final heading", "mrad", 1e3),
    "duration_s": ("duration", "s", 1.0),
}
"""Figures of the table: name, unit, and what makes it of the SI one."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `parkctl campaign`."""
    from tools.campaign.draws import text_of_table  # noqa: PLC0415

    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = f"""\
Each run is a whole test, both legs, with a seed of its own: first seed + number of the run. By it alone are drawn:
{text_of_table()}

Finished runs are appended to FILE.journal as they come; when all are there, FILE becomes a Parquet file with one row a
run in order of the runs, the same for any number of workers, and the journal goes. After an end at any moment
`parkctl campaign --resume FILE` goes on: nothing is lost, nothing counted twice. A run is driven again with
`--runs 1 --seed SEED --worst 1`, SEED as in its row.
Exit status: 0 all runs were driven and no cone was touched; 1 a cone was touched; 2 a mistake in what was given; 130
interrupted."""
    what = parser.add_argument_group("what is driven (a NAME of a shipped file, or the path of a .toml FILE)")
    what.add_argument("--runs", type=int, metavar="N", help="so many runs of both legs")
    what.add_argument("--vehicle", metavar="NAME|FILE", help="the car and its box (default: paper)")
    what.add_argument("--course", metavar="NAME|FILE", help="cones, start and stop (default: ohio)")
    what.add_argument("--scenario", metavar="NAME|FILE", help="how car and sensors differ (default: car)")
    what.add_argument("--law", choices=LAWS, help="control law (default: car)")
    what.add_argument("--seed", type=int, metavar="N", help="seed of the first run (default: 1000000)")
    what.add_argument("--tables", metavar="DIR", help="tables to drive by (default: the shipped ones, else made now)")
    how = parser.add_argument_group("how it is run")
    how.add_argument("--workers", type=int, metavar="N", help="processes (default: one for each core)")
    how.add_argument("--scheduler", metavar="ADDRESS", help="a Dask cluster instead, e.g. tcp://10.0.0.1:8786")
    how.add_argument("--resume", type=Path, metavar="FILE", help="go on with the campaign that was to become FILE")
    out = parser.add_argument_group("what is written")
    out.add_argument("--out", type=Path, metavar="FILE", help="the rows (default: runs/campaign-SCENARIO-TIME.parquet)")
    out.add_argument(
        "--worst", type=int, default=0, metavar="N", help="drive the N worst again in lock-step, with plots"
    )
    out.add_argument("--json", type=Path, metavar="FILE", help="the figures for machines")


def run(args: argparse.Namespace) -> int:
    """Run the campaign; return the exit status. Raises UserError before anything is started or written."""
    if args.worst < 0:
        raise UserError(f"--worst {args.worst}: must not be negative")
    workers = _workers(args)
    if args.json is not None:
        check_writable_file(args.json)
    with ExitStack() as stack:
        if args.resume is not None:
            return _resume(args, workers, stack)
        if args.runs is None:
            raise UserError("name how many runs with --runs N, or a file to go on with by --resume FILE")
        if not 1 <= args.runs <= MOST_RUNS:
            raise UserError(f"--runs {args.runs}: must be from 1 to {MOST_RUNS}")
        given = {name: getattr(args, name) if getattr(args, name) is not None else default
                 for name, default in DEFAULTS.items()}  # fmt: skip
        if given["seed"] < 0:
            raise UserError(f"--seed {given['seed']}: must not be negative")
        if args.out is not None:
            _check_out(args.out)
        campaign = _prepare(given, args.runs, stack)
        file = args.out or _default_file(campaign.scenario.name)
        return _drive(campaign, file, None, args, workers)


class Campaign(NamedTuple):
    """A campaign, loaded and checked; `about` says in plain values what it is."""

    vehicle: Vehicle
    course: Course
    scenario: Scenario
    law: str
    tables: Path
    job: Job
    about: dict[str, Any]


def _workers(args: argparse.Namespace) -> int:
    if args.scheduler is not None and args.workers is not None:
        raise UserError("--workers: a cluster brings its own; leave out --workers or --scheduler")
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    workers: int = args.workers if args.workers is not None else cores
    if not 1 <= workers <= 1024:
        raise UserError(f"--workers {workers}: must be from 1 to 1024")
    return workers


def _default_file(scenario: str) -> Path:
    folder = Path("runs")
    if not folder.is_dir():
        try:
            folder.mkdir()
        except OSError as error:
            raise UserError(f"{folder}: cannot be made a folder: {error.strerror}; name a file with --out") from None
    return folder / f"campaign-{scenario}-{time.strftime('%Y%m%d-%H%M%S')}.parquet"


def _check_out(file: Path) -> None:
    from tools.campaign.journal import journal_of  # noqa: PLC0415

    check_writable_file(file)
    if file.exists():
        raise UserError(f"--out {file}: is there already; name another file")
    if journal_of(file).exists():
        raise UserError(f"--out {file}: a campaign was begun there; go on with --resume {file}, or name another file")


def _prepare(
    given: dict[str, Any], runs: int, stack: ExitStack, begun: dict[str, Any] | None = None, file: Path = Path()
) -> Campaign:
    """Load and check all files, design tables where none are shipped.

    `begun` is what the journal or `file` of a campaign tells of it: then it must be the same, and brings its tables.
    """
    from sim.data_files import check_fit, load_course, load_scenario, load_vehicle  # noqa: PLC0415
    from tools.campaign import work  # noqa: PLC0415
    from tools.campaign.draws import TABLE  # noqa: PLC0415
    from tools.campaign.single import share  # noqa: PLC0415
    from tools.campaign.world import DBC  # noqa: PLC0415

    scenario = load_scenario(given["scenario"])
    if scenario.faults:
        raise UserError(f"scenario {scenario.name}: has [[faults]]; a campaign drives without (use parkctl demo)")
    vehicle = load_vehicle(given["vehicle"], scenario.vehicle_overlay)
    course = load_course(given["course"])
    check_fit(vehicle, course)
    digest = {
        "vehicle": _digest(vehicle.file_bytes),
        "course": _digest(course.model_dump_json().encode()),
        "scenario": _digest(scenario.model_dump_json().encode()),
        "dbc": _digest(DBC.read_bytes()),
        "code": work.code_digest(),
    }
    if begun is not None:
        _same_digests(digest, begun, file)
        tables = _unpack_tables(begun["tables_zlib"], stack)
    elif given["tables"]:
        tables = Path(given["tables"])
    else:
        tables = _tables(vehicle, course, stack)
    shared = share(vehicle, course, given["law"], tables)
    job = work.Job(shared, scenario, given["seed"], runs, work.chunk_runs_of(runs), digest["code"])
    if begun is not None:
        return Campaign(vehicle, course, scenario, given["law"], tables, job, begun)
    tables_text = {file.name: file.read_bytes() for file in sorted(tables.iterdir()) if file.is_file()}
    about = {
        **given,
        "vehicle": str(given["vehicle"]),
        "course": str(given["course"]),
        "scenario": str(given["scenario"]),
        "runs": runs,
        "chunk_runs": job.chunk_runs,
        "digest": {**digest, "tables": _digest(b"".join(tables_text.values()))},
        "draws": [list(line) for line in TABLE],
        "tables_zlib": {name: base64.b64encode(zlib.compress(text)).decode() for name, text in tables_text.items()},
    }
    return Campaign(vehicle, course, scenario, given["law"], tables, job, about)


def _unpack_tables(kept: dict[str, str], stack: ExitStack) -> Path:
    """Write the tables that a campaign carries with it into a temporary folder."""
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="parkctl-tables-")))
    for name, text in kept.items():
        (folder / Path(name).name).write_bytes(zlib.decompress(base64.b64decode(text)))
    return folder


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:24]


def _tables(vehicle: Vehicle, course: Course, stack: ExitStack) -> Path:
    """Return the folder of tables for the car and course: the shipped one, or one designed now."""
    from tools.design.tables import design_tables, tables_folder  # noqa: PLC0415

    shipped = tables_folder(vehicle, course)
    if shipped is not None:
        return shipped
    print(f"no fresh tables are shipped for {vehicle.name} on {course.name}: made now", file=sys.stderr, flush=True)
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="parkctl-tables-"))) / "tables"
    design_tables(vehicle, course, folder)
    return folder


# -- going on ---------------------------------------------------------------------------------------------------------


def _resume(args: argparse.Namespace, workers: int, stack: ExitStack) -> int:
    from tools.campaign.journal import Journal, journal_of  # noqa: PLC0415
    from tools.campaign.parquet import read_rows  # noqa: PLC0415

    if args.out is not None:
        raise UserError("--out: the file is that of --resume; leave --out out")
    file: Path = args.resume
    if file.name.endswith(".journal"):
        file = file.with_name(file.name.removesuffix(".journal"))
    if file.is_dir():
        raise UserError(f"--resume {file}: is a folder; name the campaign's file")
    if file.is_file():
        rows, about = read_rows(file)
        journal_of(file).unlink(missing_ok=True)  # the end came between the file and its journal's removal
        _same_options(args, about, file)
        print(f"{file}: is complete, {len(rows)} runs", file=sys.stderr)
        campaign = _again(about, file, stack) if args.worst else None
        return _report(campaign, file, rows, about, args, 0.0, 0)
    if not journal_of(file).is_file():
        raise UserError(f"--resume {file}: there is neither this file nor {journal_of(file).name} beside it")
    journal = Journal.resume(journal_of(file))
    stack.callback(journal.close)
    _same_options(args, journal.about, file)
    return _drive(_again(journal.about, file, stack), file, journal, args, workers)


def _same_options(args: argparse.Namespace, about: dict[str, Any], file: Path) -> None:
    for name in (*DEFAULTS, "runs"):
        value = getattr(args, name)
        if value is not None and value != about.get(name):
            raise UserError(f"--{name} {value}: {file} was begun with {about.get(name)}; leave --{name} out")


def _again(about: dict[str, Any], file: Path, stack: ExitStack) -> Campaign:
    """Load the campaign that a journal or file tells of. Raises UserError where it is no longer the same."""
    return _prepare({name: about[name] for name in DEFAULTS}, about["runs"], stack, about, file)


def _same_digests(digest: dict[str, str], begun: dict[str, Any], file: Path) -> None:
    for what, is_now in digest.items():
        if is_now != begun["digest"][what]:
            named = "parkctl itself" if what == "code" else f"the {what}"
            raise UserError(f"--resume {file}: {named} is no longer what the campaign was begun with; begin anew")


# -- driving ----------------------------------------------------------------------------------------------------------


def _drive(campaign: Campaign, file: Path, journal: Any, args: argparse.Namespace, workers: int) -> int:
    import pyarrow  # noqa: F401, PLC0415 -- missing, it must be missed before hours of driving

    from tools.campaign.journal import Journal, journal_of  # noqa: PLC0415
    from tools.campaign.parquet import write_rows  # noqa: PLC0415
    from tools.campaign.results import COLUMNS  # noqa: PLC0415
    from tools.progress import CountProgress  # noqa: PLC0415

    job = campaign.job
    chunks = job.chunks
    known = {} if journal is None else journal.done
    missing = [chunk for chunk in range(chunks) if chunk not in known]
    begun_s = time.monotonic()
    is_new = journal is None
    if journal is None:
        journal = Journal.begin(journal_of(file), campaign.about)
    done = sum(len(rows) for rows in journal.done.values())
    fresh = 0
    clearance = COLUMNS.index("min_clearance_m")
    worst = min((float(rows[:, clearance].min()) for rows in journal.done.values()), default=float("inf"))
    progress = CountProgress("campaign", "runs", job.runs, done)
    progress.show(begun_s, done)
    source = _source(job, missing, args.scheduler, workers)
    try:
        for chunk, rows in source:
            journal.append(chunk, rows)
            fresh += len(rows)
            worst = min(worst, float(rows[:, clearance].min()))
            progress.show(time.monotonic(), done + fresh, f"worst clearance {worst:.3f} m")
    except UserError:
        if is_new and not fresh:  # wrong from the start, as a cluster's address may be: nothing to go on with
            journal.path.unlink(missing_ok=True)
        raise
    except KeyboardInterrupt:
        progress.close()
        print(f"parkctl: {done + fresh} runs are kept; go on with: parkctl campaign --resume {file}", file=sys.stderr)
        raise
    finally:
        progress.close()
        source.close()  # type: ignore[attr-defined]
    passed_s = time.monotonic() - begun_s
    rows = journal.rows()
    write_rows(file, rows, campaign.about)
    journal.path.unlink()
    journal.close()
    return _report(campaign, file, rows, campaign.about, args, passed_s, fresh)


def _source(job: Job, chunks: list[int], scheduler: str | None, workers: int) -> Iterator[tuple[int, Rows]]:
    from tools.campaign import work  # noqa: PLC0415
    from tools.campaign.single import Runner, is_compiled  # noqa: PLC0415

    if not chunks:
        return
    if scheduler is not None:
        yield from work.drive_on_cluster(job, chunks, scheduler)
        return
    if not is_compiled():
        print("compiling core and plant, once for this version (half a minute)", file=sys.stderr, flush=True)
    # Here first, so that the workers find it done; a run of its own is what makes numba compile.
    work.drive_chunk(job._replace(runs=1), Runner(job.shared), 0)
    yield from work.drive_on_this_machine(job, chunks, workers)


# -- what came out ----------------------------------------------------------------------------------------------------


def _report(
    campaign: Campaign | None,
    file: Path,
    rows: Rows,
    about: dict[str, Any],
    args: argparse.Namespace,
    passed_s: float,
    fresh: int,
) -> int:
    from tools.campaign.results import COLUMNS, summarise, worst_first  # noqa: PLC0415

    summary = summarise(rows)
    rate = fresh / passed_s if passed_s > 0.0 else None
    places = worst_first(rows)[: args.worst]
    worst = [dict(zip(COLUMNS, rows[place].tolist(), strict=True)) for place in places]
    replays: list[dict[str, Any]] = []
    _print(summary, about, rate, passed_s)
    print(f"rows: {file}")
    if campaign is not None and worst:
        from tools.campaign.replay import replay  # noqa: PLC0415

        folder = file.with_name(f"{file.stem}-worst")
        for row in worst:
            told = replay(
                campaign.vehicle, campaign.course, campaign.scenario, campaign.law, campaign.tables, row, folder
            )
            replays.append(told)
            same = "the same in lock-step" if told["same"] else "NOT THE SAME in lock-step"
            print(
                f"seed {told['seed']}: clearance {told['min_clearance_m']:.3f} m, "
                f"cross-track {1e3 * told['max_cross_track_m']:.1f} mm, {told['ended']}; {same}: {told['folder']}"
            )
    if args.json is not None:
        figures = {
            **summary._asdict(),
            "runs_per_s": rate,
            "seconds": passed_s,
            "file": str(file),
            **{name: about[name] for name in ("vehicle", "course", "scenario", "law", "seed", "digest")},
            "worst": replays,
        }
        write_whole(args.json, json.dumps(figures, indent=2) + "\n")
    if any(not told["same"] for told in replays):
        raise UserError("lock-step and campaign differ: see above; one of them has a defect")
    return EXIT_DONE if summary.cones_touched == 0 else EXIT_TOUCHED


def _print(summary: Summary, about: dict[str, Any], rate: float | None, passed_s: float) -> None:
    from rich.console import Console  # noqa: PLC0415
    from rich.table import Table  # noqa: PLC0415

    title = f"campaign: {summary.runs} runs of {about['scenario']}, {about['vehicle']} on {about['course']}, law "
    table = Table(title=title + about["law"], title_justify="left", padding=(0, 0))
    table.add_column("figure", no_wrap=True)
    names = list(next(iter(summary.quantiles.values())))
    for name in names:
        table.add_column({"p0": "least", "p100": "most"}.get(name, name), justify="right", no_wrap=True)
    for figure, quantiles in summary.quantiles.items():
        text, unit, scale = SHOWN[figure]
        table.add_row(f"{text}, {unit}", *[f"{scale * quantiles[name]:.3g}" for name in names])
    console = Console(highlight=False)
    console.print(table)
    speed = "" if rate is None else f"; {rate:.1f} runs/s, {passed_s:.0f} s in all"
    console.print(
        f"completed {summary.completed} of {summary.runs}; cones touched {summary.cones_touched}; worst clearance "
        f"{summary.worst_clearance_m:.3f} m (seed {summary.worst_seed}){speed}",
        soft_wrap=True,
    )
