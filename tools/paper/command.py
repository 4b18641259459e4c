"""`parkctl paper`: every table and figure of the paper from one command, ours beside the printed figures."""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sim.data_files import check_fit, load_course, load_vehicle
from sim.errors import UserError
from tools.run_folder import check_writable_file, write_whole

if TYPE_CHECKING:
    from rich.console import Console

    from tools.paper.study import Study

DONE, FAILED = 0, 1
MARK, PAGE, FIGURES = "paper.json", "index.html", "figures"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `parkctl paper`."""
    parser.epilog = (
        "Waypoints and gains, which the paper does not print, come from a fit to its tables that is kept with the "
        "project; --fit makes it anew (about 5 minutes). For another car the paper's cells are empty. "
        "Status 1 where the reproduction leaves its stated tolerances."
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for the page, the pictures and the tables")
    parser.add_argument("--json", type=Path, metavar="FILE", help="the figures for machines")
    parser.add_argument("--vehicle", default="paper", metavar="NAME|FILE", help="another car (default: paper)")
    parser.add_argument("--course", default="paper", metavar="NAME|FILE", help="another course (default: paper)")
    parser.add_argument(
        "--fit-file", type=Path, metavar="FILE", help="waypoints and gains of your own, in place of the stored fit"
    )
    parser.add_argument(
        "--fit", action="store_true", help="fit waypoints and gains to the printed cells anew, and store them"
    )


def run(args: argparse.Namespace) -> int:
    """Run the study, print the tables, write what was asked for; return the exit status."""
    from rich.console import Console  # noqa: PLC0415

    from tools.paper import fit, study, tables  # noqa: PLC0415

    console = Console()
    if args.json is not None:
        check_writable_file(args.json)
    stored_file = args.fit_file or fit.STORED
    if args.fit:
        check_writable_file(stored_file)
        write_whole(stored_file, fit.to_toml(fit.fit(lambda line: _say(console, line))))
        _say(console, f"fit stored in {stored_file}")
    stored = fit.load_fit(stored_file)
    vehicle, course = load_vehicle(args.vehicle), load_course(args.course)
    check_fit(vehicle, course)
    if args.out is not None:
        _make_folder(args.out)
    origin = stored.provenance.get("command", "a file of the user's")
    _say(console, f"waypoints and gains: {stored_file.name} ({origin})")
    results = study.compute(vehicle, course, stored, lambda line: _say(console, line))
    content = tables.as_json(results)
    if args.out is not None:
        from tools.paper import page  # noqa: PLC0415 -- matplotlib
        from tools.paper.loops import study as study_loops  # noqa: PLC0415
        from tools.paper.plant import FORWARD  # noqa: PLC0415

        loops = study_loops(results.car, results.gains, results.tracks[FORWARD], lambda line: _say(console, line))
        page.write(args.out, results, loops, content, lambda line: _say(console, line))
    _print(console, results, content)
    text = json.dumps(content, indent=2) + "\n"
    if args.json is not None:
        write_whole(args.json, text)
    if args.out is not None:
        write_whole(args.out / MARK, text)
        _say(console, f"page: {args.out / PAGE}")
    failed = [check for check in content["checks"] if not check["holds"]]
    return FAILED if failed else DONE


def _say(console: Console, text: str) -> None:
    console.print(text, highlight=False, markup=False, soft_wrap=True)


def _make_folder(folder: Path) -> None:
    if folder.exists() and not folder.is_dir():
        raise UserError(f"--out {folder}: is a file; name a folder")
    known = {MARK, PAGE, FIGURES}
    if folder.is_dir() and any(path.name not in known for path in folder.iterdir()):
        raise UserError(f"--out {folder}: holds files that are not of this command; name an empty or new folder")
    try:
        (folder / FIGURES).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"--out {folder}: cannot be made: {error.strerror}") from None
    if not os.access(folder, os.W_OK):
        raise UserError(f"--out {folder}: no right to write there")


NAMES = {
    "table5": "Table 5, forward",
    "table6": "Table 6, reverse, sign as printed",
    "table6_corrected": "Table 6, reverse, sign corrected (not in the paper)",
}
FIELDS = {
    "max_e_y_m": ("max e_y, mm", 1e3),
    "rms_e_y_m": ("rms e_y, mm", 1e3),
    "max_steer_rad": ("max angle, rad", 1.0),
    "max_steer_rate_radps": ("max rate, rad/s", 1.0),
    "max_cross_track_m": ("CG error, mm", 1e3),
    "min_clearance_m": ("clearance, m", 1.0),
}


def _print(console: Console, results: Study, content: dict[str, Any]) -> None:
    from rich.table import Table  # noqa: PLC0415

    for name, title in NAMES.items():
        table = Table(title=f"{title}: paper / ours", title_justify="left")
        table.add_column("", no_wrap=True)
        for law in content[name]:
            table.add_column(law, justify="right")
        for field, (heading, scale) in FIELDS.items():
            cells = [content[name][law][field] for law in content[name]]
            table.add_row(
                heading, *(f"{_number(cell['paper'], scale)} / {_number(cell['ours'], scale)}" for cell in cells)
            )
        console.print(table)
    for law, leaving in results.leaving.items():
        room = "stays" if leaving.room_m is None else f"leaves after {leaving.room_m:.2f} m"
        _say(
            console,
            f"corrected sign, reverse, {law}: {room} the {results.room_m:.2f} m beside the body between the cones",
        )
    for direction, figures in content["rear_axle_law"].items():
        _say(
            console,
            f"rear-axle law on the same plant, {direction}: {1e3 * figures['max_cross_track_m']:.2f} mm at most",
        )
    _print_lockstep(console, content["lockstep"])
    for check in content["checks"]:
        if not check["holds"]:
            _say(console, f"OUT OF TOLERANCE: {check['name']}: {check['value']:.4g}, wanted {check['limit']}")
    held = sum(check["holds"] for check in content["checks"])
    _say(console, f"checks: {held} of {len(content['checks'])} hold")


def _print_lockstep(console: Console, rows: list[dict[str, Any]]) -> None:
    from rich.table import Table  # noqa: PLC0415

    table = Table(title="In the controller, lock-step on eq. 11 (sign in reverse); errors in mm", title_justify="left")
    for heading in ("law", "leg", "ms old", "max e_y", "rms e_y", "CG error", "axle", "ends"):
        table.add_column(heading, justify="left" if heading in ("law", "leg") else "right", no_wrap=True)
    shown = set()
    for row in rows:
        forward = row["direction"] == "forward"
        key = (row["law"], row["direction"], "" if forward else row["reverse_sign"], row["delay_ms"])
        if key in shown:
            continue  # forward both signs are the same
        shown.add(key)
        errors = ("max_e_y_m", "rms_e_y_m", "max_cross_track_m", "max_rear_cross_track_m")
        table.add_row(
            row["law"], row["direction"] if forward else row["reverse_sign"], f"{row['delay_ms']:g}",
            *(f"{1e3 * row[key]:.3g}" for key in errors),
            "stop" if row["is_complete"] else f"{row['travelled_m']:.1f} m",
        )  # fmt: skip
    console.print(table)


def _number(value: float | None, scale: float) -> str:
    if value is None:
        return "-"
    return f"{scale * value:.3g}" if abs(scale * value) < 1e3 else f"{scale * value:.0f}"
