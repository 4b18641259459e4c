"""`parkctl design`: make, check or rewrite the controller's tables from vehicle and course files."""

import argparse
import json
import math
import os
import sys
from pathlib import Path
from typing import Any

from sim.data_files import Course, Vehicle, load_course, load_scenario, load_vehicle
from sim.errors import UserError

DONE, DIFFERENT = 0, 1
TRADE_SEEDS = 4
MOST_RUNS = 1000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `parkctl design`."""
    parser.add_argument("--vehicle", metavar="NAME|FILE", help="the car (default: paper; with --update/--check: all)")
    parser.add_argument("--course", metavar="NAME|FILE", help="the course (default: ohio; with --update/--check: all)")
    parser.add_argument("--scenario", metavar="NAME|FILE", help="take this scenario's vehicle overlay into the design")
    parser.add_argument("--tables", type=Path, metavar="DIR", help="write the tables into this folder, replacing it")
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="draw the design on one sheet: DIR/design.png, design.json"
    )
    parser.add_argument(
        "--trade", type=Path, metavar="DIR",
        help="the trade between clearance, steering, tracking and time: DIR/trade.png, trade.json (about 3 min)",
    )  # fmt: skip
    parser.add_argument(
        "--seeds", type=int, default=TRADE_SEEDS, metavar="N",
        help="with --trade: runs of `car` in lock-step a path, 0 for none (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--finer", type=int, default=0, metavar="N",
        help="with --trade: an independent search from N random starts for a clearer path still (about 1 s each)",
    )  # fmt: skip
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--update", action="store_true", help="rewrite the tables that come with the project")
    what.add_argument("--check", action="store_true", help="make them again and compare; status 1 where they differ")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures for machines")


def run(options: argparse.Namespace) -> int:
    """Run `parkctl design`; return the exit status."""
    if options.update or options.check:
        if options.tables is not None or options.scenario is not None:
            raise UserError("--update and --check are for the shipped tables; leave out --tables and --scenario")
        if options.out is not None or options.trade is not None:
            raise UserError("--update and --check draw nothing; leave out --out and --trade")
        return _shipped(options)
    for name in ("seeds", "finer"):
        if not 0 <= getattr(options, name) <= MOST_RUNS:
            raise UserError(f"--{name} {getattr(options, name)}: must be from 0 to {MOST_RUNS}")
    overlay = load_scenario(options.scenario).vehicle_overlay if options.scenario else None
    vehicle = load_vehicle(options.vehicle or "paper", overlay)
    course = load_course(options.course or "ohio")
    if options.trade is not None:
        figures = _trade(vehicle, course, options)
        _write_json(options.json, figures)
        return DONE
    figures = _design(vehicle, course, options.tables, options.out)
    _write_json(options.json, figures)
    return DONE if figures["certificate"]["holds"] else DIFFERENT


def _shipped(options: argparse.Namespace) -> int:
    from tools.design import tables  # noqa: PLC0415 -- scipy

    pairs = tables.shipped_pairs(options.vehicle, options.course)
    if not pairs:
        known = ", ".join(f"{vehicle} on {course}" for vehicle, course in tables.SHIPPED)
        raise UserError(
            f"no shipped tables for {options.vehicle or 'any'} on {options.course or 'any'}; there are: {known}"
        )
    status = DONE
    all_figures = []
    for vehicle, course in pairs:
        folder = tables.SHIPPED_FOLDER / tables.folder_name(vehicle, course)
        if options.update:
            all_figures.append(_design(vehicle, course, folder))
            continue
        stale = tables.stale_inputs(folder, vehicle, course)
        # The search is not made again: another machine's rounding would end it at another optimum, equally good.
        report = tables.run_design(vehicle, course, tables.recorded_numbers(folder))
        found = [f"stale: {what} has changed since" for what in stale]
        found += tables.differences(tables.table_texts(report), folder)
        for line in found:
            print(f"{folder.name}: {line}")
        if found:
            status = DIFFERENT
            print(f"{folder.name}: differs; run `parkctl design --update`")
        else:
            print(f"{folder.name}: fresh, and the same when made again")
        all_figures.append(tables.as_json(report, None))
    if options.vehicle in (None, "paper") and options.course in (None, "paper"):
        status = max(status, _paper_study(options.update))
    _write_json(options.json, {"designs": all_figures})
    return status


def _paper_study(update: bool) -> int:
    """Write or check the tables of the paper's own manoeuvre."""
    from tools.design import tables  # noqa: PLC0415 -- scipy
    from tools.paper import firmware_tables  # noqa: PLC0415

    vehicle, course = firmware_tables.study_pair()
    folder = firmware_tables.study_folder()
    report = firmware_tables.study_report(vehicle, course)
    if update:
        tables.write_tables(report, folder)
        print(f"tables written to {folder}")
        return DONE
    found = [f"stale: {what} has changed since" for what in tables.stale_inputs(folder, vehicle, course)]
    found += tables.differences(tables.table_texts(report), folder)
    for line in found:
        print(f"{folder.name}: {line}")
    print(
        f"{folder.name}: {'differs; run `parkctl design --update`' if found else 'fresh, and the same when made again'}"
    )
    return DIFFERENT if found else DONE


def _design(vehicle: Vehicle, course: Course, folder: Path | None, out: Path | None = None) -> dict[str, Any]:
    """Design, certify, show, and write where a folder is given; nothing is written where the certificate fails."""
    from tools.design import tables  # noqa: PLC0415 -- scipy
    from tools.design.certificate import certify  # noqa: PLC0415 -- scipy

    report = tables.run_design(vehicle, course)
    certificate = certify(vehicle, report.gains)
    figures = tables.as_json(report, certificate)
    _show(figures)
    if out is not None:
        from tools.design import sheet  # noqa: PLC0415 -- matplotlib

        _folder("--out", out)
        sheet.draw(report, certificate, out / "design.png")
        _write_json(out / "design.json", figures)
        print(f"sheet in {out / 'design.png'}")
    if not certificate.holds:
        raise UserError(
            f"vehicle {vehicle.name}: the design does not hold in its whole box: {'; '.join(certificate.lacks)};"
            " narrow the box, or ask for less in [design]"
        )
    if folder is not None:
        tables.write_tables(report, folder)
        print(f"tables written to {folder}")
    return figures


def _folder(option: str, folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{option} {folder}: no folder can be made there ({error.strerror})") from error


def _trade(vehicle: Vehicle, course: Course, options: argparse.Namespace) -> dict[str, Any]:
    """Compute, show and draw the trade curve; return its figures."""
    from tools.design import finer, trade  # noqa: PLC0415 -- scipy
    from tools.plots import trade as draw  # noqa: PLC0415 -- matplotlib

    _folder("--trade", options.trade)
    terminal = sys.stderr.isatty()

    def tell(text: str) -> None:
        print(f"\r\x1b[K{text}" if terminal else text, end="" if terminal else "\n", file=sys.stderr, flush=True)

    seeds = list(range(options.seeds))
    points = trade.trade_curve(vehicle, course, seeds, tell)
    figures = trade.as_json(vehicle, course, points, seeds)
    if options.finer:
        tell(f"independent search from {options.finer} starts")
        angle_rad = points[0].weights.angle_share * vehicle.max_road_wheel_angle_rad
        best = finer.clearest(vehicle, course, angle_rad, starts=options.finer)
        figures["finer"] = {
            "starts": options.finer,
            "min_clearance_m": best.clearance_m,
            "more_than_the_curve_m": best.clearance_m - points[0].design.clearance_m,
        }
    if terminal:
        tell("")
    _show_trade(figures)
    draw(
        options.trade / "trade.png",
        points=figures["points"],
        title=f"trade curve: vehicle {vehicle.name} on course {course.name}; a point is a path, as in the table",
    )
    _write_json(options.trade / "trade.json", figures)
    print(f"curve in {options.trade / 'trade.png'}")
    return figures


def _show_trade(figures: dict[str, Any]) -> None:
    from rich.console import Console  # noqa: PLC0415
    from rich.table import Table  # noqa: PLC0415

    table = Table(title=f"trade: {figures['vehicle']} on {figures['course']}", title_justify="left")
    units = {"room": "m", "body": "m", "angle": "rad", "slope": "rad/m", "rate": "rad/s", "leg": "s", "max/rms": "mm"}
    for name in ("path", *units, "done"):
        table.add_column(f"{name}\n{units.get(name, '')}", justify="right", no_wrap=True)
    for number, point in enumerate(figures["points"], 1):
        tracking = point["tracking"]
        table.add_row(
            f"{number}{' *' if point['chosen'] else '  '}",
            f"{point['min_clearance_m']:.3f}",
            f"{point['min_body_clearance_m']:.3f}",
            f"{point['max_road_wheel_angle_rad']:.3f}",
            f"{point['max_road_wheel_slope_radpm']:.3f}",
            f"{point['max_road_wheel_rate_radps']:.3f}",
            f"{point['leg_duration_s']:.2f}",
            f"{1e3 * tracking['max_cross_track_m']:.1f}/{1e3 * tracking['rms_cross_track_m']:.2f}" if tracking else "-",
            f"{tracking['completed']}/{tracking['runs']}" if tracking else "-",
        )
    console = Console()
    console.print(table)
    console.print("* the path that the tables take")
    if "finer" in figures:
        more = figures["finer"]["more_than_the_curve_m"]
        found = figures["finer"]["min_clearance_m"]
        console.print(f"independent search: {found:.4f} m, {1e3 * more:+.1f} mm against path 1")


def _show(figures: dict[str, Any]) -> None:
    from rich.console import Console  # noqa: PLC0415
    from rich.table import Table  # noqa: PLC0415

    table = Table(title=f"design: {figures['vehicle']} on {figures['course']}", title_justify="left")
    table.add_column("what")
    table.add_column("value", justify="right")
    for part in (figures["path"], figures["gains"]):
        for name, value in part.items():
            shown = ", ".join(f"{v:.2f}" for v in value) if isinstance(value, list) else value
            table.add_row(name, f"{shown:.4g}" if isinstance(shown, float) else str(shown))
    console = Console()
    console.print(table)
    certificate = figures["certificate"]
    title = "certificate: the least of all cars of the box, speeds and directions"
    table = Table(title=title, title_justify="left", padding=(0, 0))
    table.add_column("law, and how it runs", no_wrap=True)
    for name in ("disk\nmargin", "delay\nsamples", "gain\nfactor", "phase\ndeg", "D-stable"):
        table.add_column(name, justify="right", no_wrap=True)
    for name, of in {"car": certificate, **certificate["others"]}.items():
        table.add_row(
            name,
            f"{of['min_disk_margin']:.2f}",
            f"{of['min_delay_margin_samples']:.1f}",
            f"{of['min_gain_margin']:.2f}",
            f"{math.degrees(of['min_phase_margin_rad']):.0f}",
            "all" if of["all_d_stable"] else "NOT ALL",
        )
    console.print(table)
    console.print(f"least disk margin of the usual: {certificate['worst']}", highlight=False, soft_wrap=True)


def _write_json(file: Path | None, figures: dict[str, Any]) -> None:
    """Write the figures; the file appears whole or not at all."""
    if file is None:
        return
    temporary = file.with_name(file.name + ".part")
    try:
        temporary.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
        os.replace(temporary, file)
    except OSError as error:
        raise UserError(f"--json {file}: cannot be written ({error.strerror})") from error
