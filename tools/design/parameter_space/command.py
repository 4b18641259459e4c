"""`parkctl parameter-space`: the admissible PID gains of a plant of the user's own, with picture, page and figures."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sim.errors import UserError
from tools.design.parameter_space import (
    RULES,
    AdmissibleRegion,
    DRegion,
    Pid,
    Point,
    Window,
    admissible_region,
    case_of,
    plane_of,
    plant_of,
)
from tools.design.parameter_space.loop import Complexes
from tools.design.parameter_space.plant_file import HELP, PlantSet, read_plants
from tools.run_folder import check_writable_file, write_whole

PLANE_PICTURE, POLES_PICTURE, PAGE, FIGURES = "plane.png", "poles.png", "explorer.html", "parameter_space.json"
CONTENT = (PLANE_PICTURE, POLES_PICTURE, PAGE, FIGURES)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `parkctl parameter-space`."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = (
        HELP
        + '\nexample: parkctl parameter-space --plant "1 / 1 3 2 0" --plane kp-ki --fixed 1 --sigma 0.1 --zeta 0.5\n'
    )
    parser.add_argument("--plant", required=True, metavar="NUM/DEN|FILE", help="the plant or plants; see below")
    parser.add_argument("--delay", type=float, default=0.0, metavar="S", help="dead time at the plant's input, exactly")
    parser.add_argument("--plane", default="kp-ki", metavar="X-Y", help="kp-ki, kp-kd or ki-kd (default: kp-ki)")
    parser.add_argument("--fixed", type=float, default=0.0, metavar="K", help="value of the third gain (default: 0)")
    parser.add_argument("--derivative-lag", type=float, default=0.0, metavar="S", help="time constant of kd's filter")
    parser.add_argument("--compensator", metavar="NUM/DEN|FILE", help="a fixed, stable compensator in the loop")
    parser.add_argument("--sigma", type=float, default=0.0, metavar="RADPS", help="d1: Re s <= -sigma")
    parser.add_argument("--zeta", type=float, default=0.0, metavar="Z", help="d2: damping of every pole at least this")
    parser.add_argument("--radius", type=float, default=math.inf, metavar="RADPS", help="d3: |s| at most this")
    parser.add_argument(
        "--zeta-within", type=float, default=math.inf, metavar="RADPS", help="ask the damping of |s| up to this only"
    )
    parser.add_argument(
        "--window", type=float, nargs=4, metavar=("XLOW", "XHIGH", "YLOW", "YHIGH"), help="part of the plane to show"
    )
    parser.add_argument("--cells", type=int, default=81, metavar="N", help="points of the grid a side (default: 81)")
    how = parser.add_mutually_exclusive_group()
    how.add_argument("--choose", default="centre", metavar="RULE", help=" | ".join(RULES) + " (default: centre)")
    how.add_argument("--point", type=float, nargs=2, metavar=("X", "Y"), help="take this point instead")
    parser.add_argument("--json", type=Path, metavar="FILE", help="the figures for machines")
    parser.add_argument("--out", type=Path, metavar="DIR", help=f"folder for {', '.join(CONTENT)}")


def run(args: argparse.Namespace) -> int:
    """Find the admissible set, print the point and its distances, write what was asked for; return the exit status."""
    if args.cells > MOST_CELLS:
        raise UserError(f"--cells {args.cells}: must be {MOST_CELLS} or less")
    if args.choose not in RULES:
        raise UserError(f"--choose {args.choose!r}: must be one of {', '.join(RULES)}")
    if args.json is not None:
        check_writable_file(args.json)
    if args.out is not None:
        _check_folder(args.out)
    given = read_plants(args.plant, args.delay)
    compensator = None
    if args.compensator is not None:
        fixed = read_plants(args.compensator).plants
        if len(fixed) != 1:
            raise UserError(f"--compensator {args.compensator}: must be one compensator, not {len(fixed)}")
        compensator = plant_of(fixed[0], must_be_stable=True)
    plane = plane_of(args.plane, args.fixed)
    region = DRegion(args.sigma, args.zeta, args.radius, args.zeta_within)
    pid = Pid(args.derivative_lag, compensator)
    cases = [case_of(plant.name, plant, plane, region, pid) for plant in given.plants]
    window = Window(*args.window) if args.window else None
    found = admissible_region(cases, plane, window, cells=args.cells)
    point = found.point(*args.point) if args.point else found.choose(args.choose)
    poles = found.poles(point.x, point.y)
    figures = figures_of(found, region, point, poles, "given" if args.point else args.choose)
    _print(figures)
    text = json.dumps(figures, indent=1, allow_nan=False) + "\n"
    if args.out is not None:
        _write_folder(args.out, given, found, region, point, poles, text, pid)
    if args.json is not None:
        write_whole(args.json, text)
    return 0


MOST_CELLS = 400


def figures_of(
    found: AdmissibleRegion, region: DRegion, point: Point, poles: dict[str, Complexes], rule: str
) -> dict[str, Any]:
    """The result as plain data: what `--json` holds."""
    return {
        "plane": {"x": found.plane.x, "y": found.plane.y, "fixed": {found.plane.third_name: found.plane.third}},
        "region": {
            "sigma_radps": region.sigma_radps,
            "zeta": region.zeta,
            "radius_radps": _finite(region.radius_radps),
            "zeta_within_radps": _finite(region.zeta_within_radps),
        },
        "cases": [case.name for case in found.cases],
        "window": dict(zip(("x_low", "x_high", "y_low", "y_high"), map(float, found.window), strict=True)),
        "scale": [float(side) for side in found.scale],
        "admissible": {
            "share_of_window": float(found.inside.mean()),
            "x": found.x.tolist(),
            "y": found.y.tolist(),
            "inside": ["".join("1" if cell else "0" for cell in row) for row in found.inside],
            "outline": [_rounded(line) for line in found.outline],
        },
        "boundaries": [
            {
                "name": boundary.name,
                "case": boundary.case,
                "line": [float(v) for v in boundary.line] if boundary.line else None,
                "xy": _rounded(np.column_stack([boundary.x, boundary.y])),
            }
            for boundary in found.boundaries
        ],
        "absent": found.absent,
        "point": {
            "rule": rule,
            "gains": {name: float(value) for name, value in sorted(point.gains.items())},
            "inside": bool(point.inside),
            "distances_scaled": {name: float(d.distance) for name, d in point.distances.items()},
            "nearest": {
                name: {"x": float(d.x), "y": float(d.y), "case": d.case} for name, d in point.distances.items()
            },
            "poles": {name: [[float(s.real), float(s.imag)] for s in some] for name, some in poles.items()},
        },
    }


def _rounded(line: Any) -> list[list[float] | None]:
    """Points of a polyline with seven digits; null in its gaps."""
    return [None if math.isnan(x + y) else [float(f"{x:.7g}"), float(f"{y:.7g}")] for x, y in line]


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _print(figures: dict[str, Any]) -> None:
    from rich.console import Console  # noqa: PLC0415
    from rich.table import Table  # noqa: PLC0415

    console = Console()
    point, window = figures["point"], figures["window"]
    plane = figures["plane"]
    share = 100.0 * figures["admissible"]["share_of_window"]
    console.print(
        f"{share:.1f} % of {plane['x']} in [{window['x_low']:.4g}, {window['x_high']:.4g}], {plane['y']} in "
        f"[{window['y_low']:.4g}, {window['y_high']:.4g}] is admissible for {len(figures['cases'])} case(s)",
        highlight=False,
        soft_wrap=True,
    )
    table = Table(title=f"the chosen point ({point['rule']})", title_justify="left")
    for name, side in (("what", "left"), ("value", "right"), ("nearest at", "left"), ("case", "left")):
        table.add_column(name, justify="right" if side == "right" else "left", overflow="fold")
    for name, value in point["gains"].items():
        table.add_row(name, f"{value:.5g}")
    table.add_row("all poles in the region", "yes" if point["inside"] else "NO")
    for name, distance in point["distances_scaled"].items():
        at = point["nearest"][name]
        table.add_row(f"to {name}", f"{distance:.4f}", f"({at['x']:.4g}, {at['y']:.4g})", at["case"])
    console.print(table)
    console.print("distances are scaled: 1 is the side of the window", highlight=False)
    for name, why in figures["absent"].items():
        console.print(f"{name} does not exist: {why}", highlight=False, soft_wrap=True)


def _check_folder(folder: Path) -> None:
    if folder.exists() and not folder.is_dir():
        raise UserError(f"--out {folder}: is a file; name a folder")
    if folder.is_dir() and any(path.name not in CONTENT for path in folder.iterdir()):
        raise UserError(f"--out {folder}: holds files that are not of a parameter space; name an empty or new folder")


def _write_folder(
    folder: Path,
    given: PlantSet,
    found: AdmissibleRegion,
    region: DRegion,
    point: Point,
    poles: dict[str, Complexes],
    text: str,
    pid: Pid,
) -> None:
    from tools.design.parameter_space.explorer import Units, explorer_page  # noqa: PLC0415
    from tools.plots import parameter_space as plots  # noqa: PLC0415 -- matplotlib

    units = Units(given.input_unit, given.output_unit)
    speeds: Sequence[float] = sorted(set(given.speeds_mps)) or [0.0]
    by_speed = {speed: _at(given, speed) for speed in speeds}
    plane = found.plane
    # Several plants at one speed are corners: they go by their number.
    most = min(len(plants) for plants in by_speed.values())
    if len({len(plants) for plants in by_speed.values()}) > 1:
        raise UserError("--out: the page needs equally many plants at each speed_mps; leave speed_mps out otherwise")
    page = explorer_page(
        f"{given.plants[0].name}: PID gains that keep all poles in the region",
        lambda speed, number=0.0: by_speed[speed][round(number)],
        speeds,
        [plane],
        region,
        windows={plane.name: found.window},
        points={plane.name: (point.x, point.y)},
        corners=[{"number": float(number)} for number in range(1, most)],
        pid=pid,
        units=units,
        intro=f"Negative feedback, u = -(kp + ki/s + kd s) y{_sampling(given)}. Shaded: gains for which "
        f"{_meaning(len(found.cases))}.",
    )
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"--out {folder}: cannot be made: {error.strerror}") from None
    labels = {"x_label": units.label(plane.x), "y_label": units.label(plane.y)}
    try:
        plots.parameter_plane(folder / PLANE_PICTURE, found, {"chosen point": point}, **labels)
        plots.poles_in_region(folder / POLES_PICTURE, region, poles)
    except OSError as error:
        raise UserError(f"--out {folder}: cannot be written: {error.strerror}") from None
    write_whole(folder / PAGE, page)
    write_whole(folder / FIGURES, text)
    print(f"{', '.join(CONTENT)} in {folder}")


def _at(given: PlantSet, speed: float) -> list[Any]:
    if not given.speeds_mps:
        return list(given.plants)
    return [plant for plant, own in zip(given.plants, given.speeds_mps, strict=True) if own == speed]


def _sampling(given: PlantSet) -> str:
    return " with s = (z - 1)/(T z)" if given.plants[0].period_s else ""


def _meaning(cases: int) -> str:
    return "all poles of all plants lie in the region" if cases > 1 else "all poles lie in the region"
