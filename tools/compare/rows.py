"""From runs to rows: the figures of a controller in a scenario over all seeds, one row a direction."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from firmware_py.core import pid, predictor
from firmware_py.core.controller import PERIOD_S, begin
from firmware_py.core.path import feedforward_at, plan_at, pose_at
from firmware_py.core.schedule import gains_at
from firmware_py.core.tables import Tables
from tools.compare import laws
from tools.compare.laws import LAW_SLOTS, Seen
from tools.compare.mpc import Mpc, no_solver
from tools.compare.runs import CONTROLLERS, RunFigures, gain_table

DIRECTIONS = ("forward", "reverse")
TICK_SAMPLES = 150


class Both(NamedTuple):
    """Figures over both legs of all runs, in m: what a comparison is about."""

    max_m: float
    p95_m: float
    rms_m: float
    min_clearance_m: float
    jitter_rad: float
    stopped: int


def row_of(
    controller: str,
    inputs: str,
    scenario: str,
    vehicle: str,
    leg: int,
    runs: Sequence[RunFigures],
    tick_us: float,
    latency_borne_samples: int | None,
) -> dict[str, Any]:
    """Return the row of one direction.

    Max over all seeds, p95 over the seeds' maxima, rms over all samples; final errors and clearance are the worst ones.
    A run that was stopped counts with what it came to until then, and in `stopped_runs`. `latency_borne_samples` is of
    both directions together, as a run is.
    """
    legs = [run.legs[leg] for run in runs]
    maxima = [figures.max_cross_track_m for figures in legs]
    clearance = min(figures.min_clearance_m for figures in legs)
    return {
        "controller": controller,
        "inputs": inputs,
        "scenario": scenario,
        "vehicle": vehicle,
        "direction": DIRECTIONS[leg],
        "seeds": len(runs),
        "max_cross_track_m": max(maxima),
        "p95_cross_track_m": float(np.quantile(maxima, 0.95)),
        "rms_cross_track_m": _pooled_rms(legs),
        "final_cross_track_m": max(abs(figures.final_cross_track_m) for figures in legs),
        "final_heading_error_rad": max(abs(figures.final_heading_error_rad) for figures in legs),
        "min_clearance_m": clearance if math.isfinite(clearance) else None,
        "command_jitter_rad": math.sqrt(sum(figures.jitter_rad**2 for figures in legs) / len(legs)),
        "tick_us": tick_us,
        "stopped_runs": sum(not run.completed for run in runs),
        "latency_borne_samples": latency_borne_samples,
    }


def _pooled_rms(legs: Sequence[Any]) -> float:
    samples = sum(figures.samples for figures in legs)
    return math.sqrt(sum(figures.sum_of_squares_m2 for figures in legs) / samples) if samples else 0.0


def both_of(runs: Sequence[RunFigures]) -> Both:
    """Return the figures over both legs."""
    legs = [leg for run in runs for leg in run.legs]
    maxima = [max(leg.max_cross_track_m for leg in run.legs) for run in runs]
    return Both(
        max(maxima),
        float(np.quantile(maxima, 0.95)),
        _pooled_rms(legs),
        min(leg.min_clearance_m for leg in legs),
        math.sqrt(sum(leg.jitter_rad**2 for leg in legs) / len(legs)),
        sum(not run.completed for run in runs),
    )


def tick_us(name: str, numbers: tuple[float, ...], tables: Tables) -> float:
    """Return what a law takes in a cycle in CPython, as it would in the car: median over places along both legs, us.

    The law alone: estimator, supervisor and the rest are the same for all. For `car` that is prediction, gains,
    feedforward and PID.
    """
    law = CONTROLLERS[name].law
    table = gain_table(law, numbers, tables).tolist()
    solve = Mpc(tables.car, tables.leg, numbers).solve if law == laws.MPC else no_solver
    memory = [0.0] * LAW_SLOTS
    p = (*numbers, 0.0)
    taken = []
    for direction in range(2):
        leg = tables.leg[direction]
        for index in range(TICK_SAMPLES):
            station_m = leg.length_m * (index + 0.5) / TICK_SAMPLES
            seen = seen_at(tables, direction, station_m, 0.002 * math.sin(index), 0.001 * math.cos(index))
            begun = time.perf_counter_ns()
            if law == laws.CAR:
                _shipped(tables, direction, seen)
            else:
                laws.steer(law, p, table, leg, tables.car, seen, memory, solve)
            taken.append(time.perf_counter_ns() - begun)
    return 1e-3 * float(np.median(taken))


def seen_at(tables: Tables, direction: int, station_m: float, cross_m: float, heading_rad: float) -> Seen:
    """Return what a law is told at a place of a leg, with these errors, at the planned speed."""
    leg = tables.leg[direction]
    x_m, y_m, yaw_rad, slip_rad, _ = pose_at(leg, station_m)
    curvature_1pm, _ = feedforward_at(leg, station_m)
    angle_rad = math.atan(tables.car.wheelbase_m * curvature_1pm)
    speed_mps, _ = plan_at(leg, station_m)
    return Seen(
        x_m - cross_m * math.sin(yaw_rad),
        y_m + cross_m * math.cos(yaw_rad),
        yaw_rad + slip_rad + heading_rad,
        station_m,
        cross_m,
        heading_rad,
        station_m,
        cross_m,
        heading_rad,
        angle_rad,
        speed_mps,
        speed_mps * PERIOD_S,
        leg.sigma * speed_mps * curvature_1pm,
        angle_rad,
        angle_rad,
        0,
    )


def _shipped(tables: Tables, direction: int, seen: Seen) -> float:
    """Return the angle of the shipped law's steering part."""
    leg, car = tables.leg[direction], tables.car
    state = begin()
    estimated = state.estimator
    estimated = estimated._replace(station_m=seen.station_m, cross_track_error_m=seen.cross_m)
    gains = gains_at(tables.gains, direction, seen.travel_mps)
    station_m, cross_m, heading_rad, _angle_rad = predictor.predict(
        leg, car, estimated, state.sent_angles_rad, seen.travel_mps, PERIOD_S
    )
    feedforward_1pm, _slope = feedforward_at(leg, station_m)
    preview_m = pid.preview_error_m(cross_m, heading_rad, gains.preview_m, leg.sigma)
    correction_1pm = pid.feedback_1pm(preview_m, heading_rad, 0.0, gains, leg.sigma)
    return math.atan(car.wheelbase_m * (feedforward_1pm - correction_1pm))
