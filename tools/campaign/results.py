"""The row of a run: columns, from a run's records to numbers, and the figures of all rows."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sim import examiner
from tools.campaign import manoeuvre
from tools.campaign.draws import DRAWN_FROM_BOX, Drawn
from tools.campaign.manoeuvre import ERRORS_A_LEG, LEG_FIGURES, root_mean_square
from tools.campaign.single import Outcome

Rows = npt.NDArray[np.float64]

LEG_COLUMNS = (
    "max_cross_track_m",
    "rms_cross_track_m",
    "final_cross_track_m",
    "final_heading_error_rad",
    "final_station_error_m",
    "duration_s",
)
COLUMNS = (
    "run",
    "seed",
    "right_side",
    "completed",
    "reason",
    "cones_touched",
    "cones_knocked_down",
    "min_clearance_m",
    "nearest_cone",
    "legs",
    "stops",
    "cycles",
    "max_cross_track_m",
    "rms_cross_track_m",
    "max_road_wheel_rate_cmd_radps",
    *(f"forward_{name}" for name in LEG_COLUMNS),
    *(f"reverse_{name}" for name in LEG_COLUMNS),
    "steering_gain",
    "steering_bias_rad",
    "steering_backlash_rad",
    "odometry_scale",
    "start_ahead_m",
    "start_aside_m",
    "start_heading_rad",
    *DRAWN_FROM_BOX,
)
"""A row's columns, in order. Integers and flags are exact; a parameter that was not drawn is the nominal one. Errors
are the rear axle's true ones against the path; `reason` by the DBC's control_reason; `nearest_cone` a place in the
course file's list."""

WHOLE = (
    "run",
    "seed",
    "right_side",
    "completed",
    "reason",
    "cones_touched",
    "cones_knocked_down",
    "nearest_cone",
    "legs",
    "stops",
    "cycles",
)
QUANTILES = (0.0, 0.01, 0.05, 0.5, 0.95, 0.99, 1.0)
QUANTILES_OF = (
    "min_clearance_m",
    "max_cross_track_m",
    "rms_cross_track_m",
    "final_cross_track_m",
    "final_heading_error_rad",
    "duration_s",
)


def row_of(run: int, drawn: Drawn, outcome: Outcome, nominal: dict[str, float]) -> list[float]:
    """Return the row of a run; `nominal` are the vehicle's parameters."""
    error, notes, end = outcome.error, outcome.notes, outcome.end
    legs = notes.number[examiner.LEGS]
    figures = []
    squares = samples = largest = 0.0
    for leg in range(LEG_FIGURES):
        first = leg * ERRORS_A_LEG
        squares += error[first + manoeuvre.SUM_OF_SQUARES_M2]
        samples += error[first + manoeuvre.SAMPLES]
        largest = max(largest, error[first + manoeuvre.MAX_ERROR_M])
        row = examiner.LEG_VALUES + leg * examiner.VALUES_A_LEG
        driven = leg < legs
        duration_s = notes.value[row + examiner.END_S] - notes.value[row + examiner.START_S] if driven else 0.0
        figures += [
            error[first + manoeuvre.MAX_ERROR_M],
            root_mean_square(error[first + manoeuvre.SUM_OF_SQUARES_M2], error[first + manoeuvre.SAMPLES]),
            error[first + manoeuvre.FINAL_ERROR_M],
            error[first + manoeuvre.FINAL_HEADING_RAD],
            error[first + manoeuvre.FINAL_STATION_M],
            duration_s,
        ]
    places = [examiner.LEG_COUNTS + leg * examiner.COUNTS_A_LEG + examiner.STOPS for leg in range(legs)]
    plant, start, unknown = drawn.scenario.plant, drawn.scenario.start, drawn.scenario.plant.unknown
    return [
        run,
        drawn.seed,
        int(drawn.side == "right"),
        end[manoeuvre.COMPLETED],
        end[manoeuvre.REASON],
        notes.number[examiner.TOUCHED].bit_count(),
        notes.number[examiner.KNOCKED].bit_count(),
        notes.value[examiner.MIN_CLEARANCE_M],
        notes.number[examiner.NEAREST],
        legs,
        sum(notes.number[place] for place in places),
        end[manoeuvre.CYCLES],
        largest,
        root_mean_square(squares, samples),
        end[manoeuvre.MAX_RATE_CMD_RADPS],
        *figures,
        plant.steering_gain[0],
        plant.steering_bias_rad[0],
        plant.steering_backlash_rad[0],
        drawn.scenario.sensors.odometry_scale[0],
        start.ahead_m[0],
        start.aside_m[0],
        start.heading_rad[0],
        *[unknown[name][0] if name in unknown else nominal[name] for name in DRAWN_FROM_BOX],
    ]


class Summary(NamedTuple):
    """The figures of a campaign, as `--json` gives them."""

    runs: int
    completed: int
    cones_touched: int
    runs_with_cones_touched: int
    worst_clearance_m: float
    worst_seed: int
    pooled_rms_cross_track_m: float
    quantiles: dict[str, dict[str, float]]


def summarise(rows: Rows) -> Summary:
    """Return the figures over all rows, which are in order of their runs."""
    column = {name: rows[:, place] for place, name in enumerate(COLUMNS)}
    final = {
        "final_cross_track_m": _larger(column, "final_cross_track_m"),
        "final_heading_error_rad": _larger(column, "final_heading_error_rad"),
        "duration_s": column["cycles"] * 1e-9 * manoeuvre.PERIOD_NS,
    }
    worst = int(np.argmin(column["min_clearance_m"]))
    return Summary(
        runs=len(rows),
        completed=int(np.sum(column["completed"])),
        cones_touched=int(np.sum(column["cones_touched"])),
        runs_with_cones_touched=int(np.count_nonzero(column["cones_touched"])),
        worst_clearance_m=float(column["min_clearance_m"][worst]),
        worst_seed=int(column["seed"][worst]),
        pooled_rms_cross_track_m=math.sqrt(float(np.mean(column["rms_cross_track_m"] ** 2))),
        quantiles={
            name: {f"p{100 * share:g}": float(np.quantile((final | column)[name], share)) for share in QUANTILES}
            for name in QUANTILES_OF
        },
    )


def _larger(column: dict[str, Any], name: str) -> Any:
    return np.maximum(np.abs(column[f"forward_{name}"]), np.abs(column[f"reverse_{name}"]))


def worst_first(rows: Rows) -> list[int]:
    """Return the places of the rows, worst first: cones touched, then not completed, then by clearance, then by run."""
    column = {name: rows[:, place] for place, name in enumerate(COLUMNS)}
    order = np.lexsort(
        (column["run"], column["min_clearance_m"], column["completed"], -column["cones_touched"].astype(float))
    )
    return [int(place) for place in order]
