"""The trade between clearance, steering effort, tracking and time: paths from the clearest to a gentle one.

Every point of the curve is a path of its own, searched with other weights (`optimise.Weights`): the share of the car's
road-wheel angle that it may use, and the price of steering slope. Tracking errors come from the manoeuvre in lock-step
with the controller's own gains; only the path differs from point to point.
"""

import math
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from sim.data_files import Course, Side, Vehicle, load_scenario
from tools.design.gains import design_gains
from tools.design.optimise import CHOSEN, MOST_CLEARANCE, PathDesign, Weights, max_road_wheel_slope, optimise_path
from tools.design.speed_profile import plan_speed, road_wheel_slope
from tools.design.tables import DesignReport, speed_limits, write_tables

SWEEP = (
    MOST_CLEARANCE,
    Weights(0.97, 0.005),
    Weights(0.94, 0.005),
    Weights(0.94, 0.02),
    CHOSEN,
    Weights(0.88, 0.1),
    Weights(0.80, 0.1),
    Weights(0.70, 0.2),
)
"""Weights of the curve's points, from the clearest path to the gentlest."""

NEIGHBOURS = 2
"""Designs nearest in the sweep from which a point's search begins."""

SCENARIO, LAW = "car", "car"
SIDE: Side = "right"
"""The side on which a bias to the left asks for most of the steering."""


class Tracking(NamedTuple):
    """True cross-track error of the rear axle over both legs: largest of all runs, pooled rms; smallest clearance."""

    runs: int
    max_cross_track_m: float
    rms_cross_track_m: float
    min_clearance_m: float
    completed: int


class TradePoint(NamedTuple):
    """A path of the curve and what it costs; duration of the forward leg as planned, rate at the planned speeds."""

    weights: Weights
    design: PathDesign
    max_road_wheel_slope_radpm: float
    max_road_wheel_rate_radps: float
    duration_s: float
    tracking: Tracking | None


Tell = Callable[[str], None]


def trade_curve(vehicle: Vehicle, course: Course, seeds: Sequence[int], tell: Tell) -> list[TradePoint]:
    """Return the curve's points in the order of `SWEEP`; without seeds, without tracking. `tell` hears of progress.

    Raises UserError where the car cannot do the course. Weights that leave no path are left out.
    """
    designs = trade_paths(vehicle, course, tell)
    gains = design_gains(vehicle) if seeds else {}
    points = []
    for weights in SWEEP:
        design = designs[weights]
        limits = speed_limits(vehicle)
        forward, reverse = (plan_speed(design.path, vehicle.wheelbase_m, limits, sign) for sign in (1, -1))
        slope = road_wheel_slope(design.path, vehicle.wheelbase_m)
        rate = max(
            float(abs(forward.speed_mps * slope).max()),
            float(abs(reverse.speed_mps * slope[::-1]).max()),
        )
        report = DesignReport(vehicle, course, design, (forward, reverse), gains)
        tracking = _track(report, seeds, tell) if seeds else None
        points.append(
            TradePoint(
                weights, design, max_road_wheel_slope(design, vehicle.wheelbase_m), rate, forward.duration_s, tracking
            )
        )
    return points


def trade_paths(vehicle: Vehicle, course: Course, tell: Tell) -> dict[Weights, PathDesign]:
    """Return the path of each weights of `SWEEP`: the chosen one searched from nothing, the others from neighbours."""
    designs = {CHOSEN: optimise_path(vehicle, course)}
    middle = SWEEP.index(CHOSEN)
    outwards = [*reversed(SWEEP[:middle]), *SWEEP[middle + 1 :]]
    for number, weights in enumerate(outwards, 2):
        tell(f"path {number} of {len(SWEEP)}")
        at = SWEEP.index(weights)
        known = sorted(designs, key=lambda other: abs(SWEEP.index(other) - at))[:NEIGHBOURS]
        designs[weights] = optimise_path(
            vehicle, course, weights=weights, near=tuple(designs[other].numbers for other in known)
        )
    # The clearest end is a claim of its own: searched from nothing too.
    clearest = optimise_path(vehicle, course, weights=MOST_CLEARANCE)
    designs[MOST_CLEARANCE] = max(designs[MOST_CLEARANCE], clearest, key=_room)
    return designs


def _room(design: PathDesign) -> float:
    return design.clearance_m + design.body_clearance_m


def _track(report: DesignReport, seeds: Sequence[int], tell: Tell) -> Tracking:
    """Drive the manoeuvre once a seed with the tables of a design."""
    from tools import figures  # noqa: PLC0415
    from tools.lockstep import run_lockstep  # noqa: PLC0415 -- plant and controller

    scenario = load_scenario(SCENARIO)
    worst_m, square, clearance_m, completed = 0.0, 0.0, math.inf, 0
    samples = 0
    with tempfile.TemporaryDirectory(prefix="parkctl-trade-") as folder:
        tables = Path(folder) / "tables"
        write_tables(report, tables)
        path = figures.load_path(tables, SIDE)
        for number, seed in enumerate(seeds, 1):
            tell(f"clearance {report.design.clearance_m:.3f} m: run {number} of {len(seeds)}")
            run = run_lockstep(report.vehicle, report.course, scenario, SIDE, seed, LAW, tables)
            truth = figures.truth_of_rows(run.truth)
            completed += bool(run.controller["completed"])
            clearance_m = min(clearance_m, float(truth.min_clearance_m.min()))
            for leg in figures.split_legs(truth, path, None):
                error = leg.on_path.cross_track_error_m
                worst_m = max(worst_m, float(abs(error).max()))
                square += float((error * error).sum())
                samples += len(error)
    return Tracking(len(seeds), worst_m, math.sqrt(square / max(1, samples)), clearance_m, completed)


def as_json(vehicle: Vehicle, course: Course, points: Sequence[TradePoint], seeds: Sequence[int]) -> dict[str, Any]:
    """Return the curve for machines, with what its tracking errors were measured on."""
    return {
        "vehicle": vehicle.name,
        "vehicle_hash24": vehicle.hash24,
        "course": course.name,
        "tracking": {"scenario": SCENARIO, "law": LAW, "side": SIDE, "seeds": list(seeds)} if seeds else None,
        "points": [
            {
                "angle_share": point.weights.angle_share,
                "slope_price_m": point.weights.slope_price_m,
                "chosen": point.weights == CHOSEN,
                "min_clearance_m": point.design.clearance_m,
                "min_body_clearance_m": point.design.body_clearance_m,
                "nearest_cone": point.design.nearest_cone,
                "max_road_wheel_angle_rad": point.design.max_road_wheel_angle_rad,
                "max_road_wheel_slope_radpm": point.max_road_wheel_slope_radpm,
                "max_road_wheel_rate_radps": point.max_road_wheel_rate_radps,
                "max_curvature_slope_1pm2": float(abs(point.design.path.curvature_slope_1pm2).max()),
                "leg_duration_s": point.duration_s,
                "path_numbers": list(point.design.numbers),
                "tracking": None if point.tracking is None else point.tracking._asdict(),
            }
            for point in points
        ],
    }
