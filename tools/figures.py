"""The figures of a run, computed from the plant's truth and the path table, independently of the firmware.

Reference point is the rear-axle centre. Cross-track and heading error are ISO 8855: positive is left of the path, and
turned to the left of it. A leg's samples run from its first motion to the standstill that ends it.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sim.errors import UserError

Floats = npt.NDArray[np.float64]
FORWARD, REVERSE = "forward", "reverse"
STOP_M = 0.10
"""The last of a leg, where the brake ends the motion; its deceleration is a figure of its own."""


class PathTable(NamedTuple):
    """Points of the path on a uniform grid, arrays of shape (n,), for the side that is driven."""

    station_m: Floats
    x_m: Floats
    y_m: Floats
    yaw_rad: Floats
    curvature_1pm: Floats

    @property
    def length_m(self) -> float:
        """Arc length from the start to the stop pose."""
        return float(self.station_m[-1])


class Preview(NamedTuple):
    """Preview distance over speed, one pair of arrays a direction, from a law's gain table."""

    speed_mps: dict[str, Floats]
    preview_m: dict[str, Floats]


class Truth(NamedTuple):
    """The plant's own record of a run, arrays of shape (n,), one row every 10 ms."""

    t_s: Floats
    x_m: Floats
    y_m: Floats
    yaw_rad: Floats
    speed_mps: Floats
    accel_x_mps2: Floats
    accel_y_mps2: Floats
    road_wheel_angle_rad: Floats
    road_wheel_rate_radps: Floats
    road_wheel_angle_cmd_rad: Floats
    min_clearance_m: Floats


class Projection(NamedTuple):
    """Where poses lie on the path; arrays of shape (n,)."""

    station_m: Floats
    cross_track_error_m: Floats
    heading_error_rad: Floats


class Leg(NamedTuple):
    """The rows of one leg within a run's truth and what belongs to them; arrays of the leg's length.

    `rows` run from first motion to standstill; `steering_rows` take in the standstill before it, when the wheels are
    turned for the leg, and for the last leg also what comes after it.
    """

    direction: str
    rows: slice
    steering_rows: slice
    on_path: Projection
    preview_error_m: Floats


def _columns(path: Path, names: Sequence[str]) -> list[Floats]:
    """Columns of a CSV file with `#` comment lines and a header row."""
    try:
        lines = [line for line in path.read_text(encoding="utf-8").splitlines() if line and not line.startswith("#")]
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or 'not a text file'}") from None
    rows = csv.DictReader(lines)
    missing = [name for name in names if name not in (rows.fieldnames or [])]
    if missing:
        raise UserError(f"{path}: column {missing[0]} is missing")
    try:
        content = [[float(row[name]) for name in names] for row in rows]
    except (TypeError, ValueError):
        raise UserError(f"{path}: holds something that is not a number") from None
    if not content:
        raise UserError(f"{path}: has no rows")
    return list(np.array(content).T)


def load_path(tables: Path, side: str) -> PathTable:
    """Read path.csv, which is for the left side; the right side is its mirror image."""
    path = PathTable(*_columns(tables / "path.csv", PathTable._fields))
    if side == "left":
        return path
    return path._replace(y_m=-path.y_m, yaw_rad=-path.yaw_rad, curvature_1pm=-path.curvature_1pm)


def load_preview(tables: Path, law: str) -> Preview:
    """Read the preview distance that a law uses, over speed and by direction."""
    file = tables / f"gains_{law.replace('+', '_')}.csv"
    direction, speed, preview = _columns(file, ["direction", "speed_mps", "preview_m"])
    of = {FORWARD: direction > 0, REVERSE: direction < 0}
    return Preview({d: speed[rows] for d, rows in of.items()}, {d: preview[rows] for d, rows in of.items()})


def truth_of_rows(rows: Iterable[Any]) -> Truth:
    """Turn the plant's rows (records with the names of Truth) into arrays."""
    table = [[getattr(row, name) for name in Truth._fields] for row in rows]
    return Truth(*np.array(table, dtype=float).reshape(-1, len(Truth._fields)).T)


def load_truth(path: Path) -> Truth:
    """Read truth.csv as the plant's process writes it."""
    return Truth(*_columns(path, Truth._fields))


def project(path: PathTable, x_m: Floats, y_m: Floats, yaw_rad: Floats, *, chunk: int = 512) -> Projection:
    """Nearest point of the path for each pose; beyond its ends the path goes on straight.

    The nearest grid point is found over the whole path; from there one Newton step along the osculating circle, whose
    error on a grid of 0.01 m is below a micrometre for curvatures under 0.3 1/m.
    """
    nearest = np.concatenate(
        [
            np.argmin((x_m[i : i + chunk, None] - path.x_m) ** 2 + (y_m[i : i + chunk, None] - path.y_m) ** 2, axis=1)
            for i in range(0, len(x_m), chunk)
        ]
    )
    yaw, curvature = path.yaw_rad[nearest], path.curvature_1pm[nearest]
    dx, dy = x_m - path.x_m[nearest], y_m - path.y_m[nearest]
    ahead, aside = np.cos(yaw) * dx + np.sin(yaw) * dy, np.cos(yaw) * dy - np.sin(yaw) * dx
    last = len(path.station_m) - 1
    outside = ((nearest == 0) & (ahead < 0.0)) | ((nearest == last) & (ahead > 0.0))
    curvature = np.where(outside, 0.0, curvature)
    along = ahead / (1.0 - curvature * aside)
    turned = curvature * along
    # Distance from the circle's point at `along`, seen in the tangent's frame there.
    foot_ahead = along * np.sinc(turned / np.pi)
    foot_aside = 0.5 * turned * along * np.sinc(0.5 * turned / np.pi) ** 2
    error = np.cos(turned) * (aside - foot_aside) - np.sin(turned) * (ahead - foot_ahead)
    heading = yaw_rad - yaw - turned
    return Projection(path.station_m[nearest] + along, error, (heading + math.pi) % (2.0 * math.pi) - math.pi)


def split_legs(truth: Truth, path: PathTable, preview: Preview | None) -> list[Leg]:
    """Cut a run into its legs: a leg ends where the car next moves in the other direction; a test has two."""
    moving = np.flatnonzero(truth.speed_mps)
    sign = np.sign(truth.speed_mps[moving])
    legs: list[Leg] = []
    for part in np.split(moving, np.flatnonzero(np.diff(sign)) + 1) if len(moving) else []:
        sigma = float(np.sign(truth.speed_mps[part[0]]))
        direction = FORWARD if sigma > 0.0 else REVERSE
        rows = slice(int(part[0]), min(int(part[-1]) + 2, len(truth.t_s)))
        on_path = project(path, truth.x_m[rows], truth.y_m[rows], truth.yaw_rad[rows])
        preview_m: Floats | float = 0.0
        if preview is not None:
            speed = np.abs(truth.speed_mps[rows])
            preview_m = np.interp(speed, preview.speed_mps[direction], preview.preview_m[direction])
        preview_error = on_path.cross_track_error_m + sigma * preview_m * np.sin(on_path.heading_error_rad)
        steering_rows = slice(min(legs[-1].rows.stop, rows.start) if legs else 0, rows.stop)
        legs.append(Leg(direction, rows, steering_rows, on_path, preview_error))
    if legs:
        legs[-1] = legs[-1]._replace(steering_rows=slice(legs[-1].steering_rows.start, len(truth.t_s)))
    return legs


def command_rate(truth: Truth, rows: slice) -> Floats:
    """Rate of the steering command as the plant accepted it, rad/s, one value a row; the first is 0."""
    command, t = truth.road_wheel_angle_cmd_rad[rows], truth.t_s[rows]
    return np.concatenate([[0.0], np.diff(command) / np.diff(t)]) if len(t) else command


def leg_figures(leg: Leg, truth: Truth, path: PathTable) -> dict[str, Any]:
    """Return the figures of one leg, names with their units.

    `final_station_error_m` is positive where the car stopped beyond the leg's end, in the direction of travel.
    """
    rows, error = leg.rows, leg.on_path.cross_track_error_m
    beyond = leg.on_path.station_m[-1] - path.length_m if leg.direction == FORWARD else -leg.on_path.station_m[-1]
    steering = leg.steering_rows
    station = leg.on_path.station_m
    stopping = np.abs(station - station[-1]) <= STOP_M
    return {
        "direction": leg.direction,
        "max_cross_track_m": float(np.max(np.abs(error))),
        "rms_cross_track_m": float(np.sqrt(np.mean(error * error))),
        "max_preview_error_m": float(np.max(np.abs(leg.preview_error_m))),
        "final_cross_track_m": float(error[-1]),
        "final_station_error_m": float(beyond),
        "final_heading_error_rad": float(leg.on_path.heading_error_rad[-1]),
        "max_road_wheel_angle_rad": float(np.max(np.abs(truth.road_wheel_angle_rad[steering]))),
        "max_road_wheel_rate_radps": float(np.max(np.abs(truth.road_wheel_rate_radps[steering]))),
        "max_road_wheel_rate_cmd_radps": float(np.max(np.abs(command_rate(truth, steering)), initial=0.0)),
        "max_speed_mps": float(np.max(np.abs(truth.speed_mps[rows]))),
        "max_accel_x_mps2": float(np.max(np.abs(truth.accel_x_mps2[rows][~stopping]), initial=0.0)),
        "max_stop_decel_mps2": float(np.max(np.abs(truth.accel_x_mps2[rows][stopping]))),
        "max_accel_y_mps2": float(np.max(np.abs(truth.accel_y_mps2[rows]))),
        "min_clearance_m": float(np.min(truth.min_clearance_m[rows])),
        "duration_s": float(truth.t_s[rows][-1] - truth.t_s[rows][0]),
    }


LOOP_FIELDS = (
    "cycles", "overruns", "wake_p50_us", "wake_p99_us", "wake_p999_us", "wake_max_us", "step_p50_us", "step_p99_us",
    "turnaround_p50_us", "turnaround_p99_us", "scheduler",
)  # fmt: skip
FRAME_FIELDS = ("sent", "received", "lost", "rejected")


def run_figures(
    *,
    setup: dict[str, Any],
    legs: list[dict[str, Any]],
    exam: dict[str, Any] | None,
    controller: dict[str, Any],
    why: str | None,
) -> dict[str, Any]:
    """Put a run's figures together as `--json` gives them.

    `setup`: scenario, law, vehicle, course, side, seed, bus; `exam`: the examiner's verdict or None where the run ended
    before one; `controller`: the controller's last report; `why`: the reason in plain words where not passed.
    """
    return {
        **setup,
        "passed": why is None,
        "why": why,
        "legs": legs,
        "cones_touched": None if exam is None else len(exam["cones_touched"]),
        "score": None if exam is None else exam["score"],
        "exam": exam,
        "loop": {name: controller.get(name) for name in LOOP_FIELDS},
        "frames": {name: controller.get(f"frames_{name}") for name in FRAME_FIELDS}
        | {"send_failed": controller.get("send_failed")},
    }
