"""The paper's laws and the paper's path as tables that the firmware drives by.

Every folder of tables holds the paper's laws for its car (`law_texts`). One folder more, `paper-study`, holds the
paper's own manoeuvre for the car of scenario `paper`: eq. 9's path as printed and the speeds of Table 3.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path as FilePath
from typing import TYPE_CHECKING

import numpy as np

from firmware_py.table_file import PAPER_COLUMNS
from sim.body import clearance_array_m, outline_of
from sim.data_files import Course, Vehicle, load_course, load_scenario, load_vehicle
from tools.design.path import GRID_M, Path
from tools.design.speed_profile import SpeedProfile
from tools.paper.firmware_law import NAMES, tables_of
from tools.paper.fit import StoredFit, gains_for, load_fit
from tools.paper.laws import DOB, PID, Law
from tools.paper.path_study import AS_PRINTED, all_variants
from tools.paper.plant import FORWARD, car_of
from tools.paper.speed import TABLE_3, speed_squared
from tools.paper.track import Track, track_of

if TYPE_CHECKING:
    from tools.design.tables import DesignReport

SCENARIO = "paper"
WHAT = (
    "the paper's law on e_y of the centre of gravity: PID (rad, m, s), 1/Gn and Q (z, 10 ms) by direction and speed; "
    "a part of zeros is not in the law"
)


def law_rows(vehicle: Vehicle, stored: StoredFit) -> dict[str, list[tuple[float, ...]]]:
    """Rows in the order of PAPER_COLUMNS of each of the paper's laws, by the firmware's name, for a car."""
    car = car_of(vehicle)
    gains = gains_for(car, stored)
    rows = {}
    for name, law in NAMES.items():
        table = tables_of(car, Law(law, gains))
        q = (table.q_b1, table.q_b2, table.q_a1, table.q_a2) if law != PID else (0.0,) * 4
        rows[name] = [
            (direction, speed, row[0], *_kept(row[1:4], law != DOB), *_kept(row[4:6], law != PID), *q)
            for direction, by_speed in zip((1.0, -1.0), table.row, strict=True)
            for speed, row in zip(table.speed_grid_mps, by_speed, strict=True)
        ]
    return rows


def _kept(values: Sequence[float], is_kept: bool) -> Sequence[float]:
    return values if is_kept else (0.0,) * len(values)


def law_texts(vehicle: Vehicle, stored: StoredFit | None = None) -> dict[str, str]:
    """Text of the table of each of the paper's laws for a car, by the file's name."""
    from tools.design.tables import csv_text  # noqa: PLC0415 -- it writes these among its own

    stored = stored or load_fit()
    return {
        f"gains_{name}.csv": csv_text(WHAT, PAPER_COLUMNS, rows) for name, rows in law_rows(vehicle, stored).items()
    }


def study_pair() -> tuple[Vehicle, Course]:
    """Car (with the overlay of scenario `paper`) and course of the paper's own manoeuvre."""
    return load_vehicle("paper", load_scenario(SCENARIO).vehicle_overlay), load_course("paper")


def rear_axle_path(track: Track, ahead_m: float, start_yaw_rad: float = 0.0) -> tuple[Path, np.ndarray]:
    """Path of the rear axle while the centre of gravity, `ahead_m` ahead of it, goes along a track; GRID_M apart.

    The body turns by sin(slip) / ahead_m per metre of the centre's way, from the heading of eq. 20 on. Also returns
    the centre's station at each row, (n + 1,) m.
    """
    from scipy.integrate import solve_ivp  # noqa: PLC0415
    from scipy.interpolate import CubicHermiteSpline  # noqa: PLC0415

    yaw_of = CubicHermiteSpline(track.station_m, track.yaw_rad, track.curvature_1pm)
    curvature_of = CubicHermiteSpline(track.station_m, track.curvature_1pm, track.curvature_slope_1pm2)
    x_of = CubicHermiteSpline(track.station_m, track.x_m, np.cos(track.yaw_rad))
    y_of = CubicHermiteSpline(track.station_m, track.y_m, np.sin(track.yaw_rad))

    def turn(at_m: float, state: np.ndarray) -> list[float]:
        slip = float(yaw_of(at_m)) - state[0]
        return [math.sin(slip) / ahead_m, math.cos(slip)]

    solved = solve_ivp(
        turn, (0.0, track.length_m), [start_yaw_rad, 0.0], method="DOP853", rtol=1e-10, atol=1e-12, max_step=0.02,
        dense_output=True,
    )  # fmt: skip
    length_m = float(solved.y[1, -1])
    station = np.linspace(0.0, length_m, round(length_m / GRID_M) + 1)
    centre = np.interp(station, solved.y[1], solved.t)
    for _ in range(4):  # Newton on the rear axle's way
        yaw, way = solved.sol(centre)
        centre = np.clip(centre + (station - way) / np.cos(yaw_of(centre) - yaw), 0.0, track.length_m)
    yaw = solved.sol(centre)[0]
    slip = yaw_of(centre) - yaw
    c, s = np.cos(slip), np.sin(slip)
    slope = (curvature_of(centre) - s / ahead_m) / (ahead_m * c * c * c)
    path = Path(
        station,
        x_of(centre) - ahead_m * np.cos(yaw),
        y_of(centre) - ahead_m * np.sin(yaw),
        yaw,
        s / (ahead_m * c),
        slope,
    )
    return path, centre


def study_report(vehicle: Vehicle, course: Course, stored: StoredFit | None = None) -> DesignReport:
    """The paper's manoeuvre as a design: path and speeds are the paper's, the gains this car's; cones the course's."""
    from tools.design.gains import design_gains  # noqa: PLC0415
    from tools.design.optimise import PathDesign  # noqa: PLC0415
    from tools.design.tables import DesignReport  # noqa: PLC0415

    stored = stored or load_fit()
    printed = all_variants(stored.waypoints)[AS_PRINTED]
    track = track_of(printed.path, FORWARD)
    path, centre = rear_axle_path(track, vehicle.cg_to_rear_axle_m)
    square = np.interp(centre, track.station_m, speed_squared(track.station_m, track.curvature_1pm, TABLE_3))
    profiles = tuple(_profile(path.station_m, v2) for v2 in (square, square[::-1]))
    outline = outline_of(vehicle)
    clearance = clearance_array_m(outline, path.x_m, path.y_m, path.yaw_rad, course.cones_xy())
    body = clearance_array_m(
        outline._replace(mirror_half_width_m=outline.half_width_m), path.x_m, path.y_m, path.yaw_rad, course.cones_xy()
    )
    design = PathDesign(
        path, printed.fit, stored.waypoints, float(clearance.min()), float(body.min()),
        course.cone_names()[int(clearance.min(axis=0).argmin())],
        float(np.abs(np.arctan(vehicle.wheelbase_m * path.curvature_1pm)).max()), (),
    )  # fmt: skip
    return DesignReport(vehicle, course, design, (profiles[0], profiles[1]), design_gains(vehicle))


def _profile(station_m: np.ndarray, square: np.ndarray) -> SpeedProfile:
    speed = np.sqrt(square)
    accel = 0.5 * np.gradient(square, station_m)
    duration_s = float(np.sum(2.0 * np.diff(station_m) / (speed[1:] + speed[:-1])))
    return SpeedProfile(station_m, speed, accel, duration_s)


def study_folder() -> FilePath:
    """Folder of the shipped tables of the paper's own manoeuvre."""
    from tools.design.tables import SHIPPED_FOLDER, STUDY_NAME  # noqa: PLC0415

    return SHIPPED_FOLDER / STUDY_NAME
