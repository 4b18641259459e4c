"""Where the path is: points of a leg by station, and the errors of a pose against it."""

import math

from firmware_py.core.bounds import bounded
from firmware_py.core.tables import LegTable


def wrap_angle(angle_rad: float) -> float:
    """Return the angle in [-pi, pi)."""
    return angle_rad - 2.0 * math.pi * math.floor((angle_rad + math.pi) / (2.0 * math.pi))


def _place(leg: LegTable, station_m: float) -> tuple[int, float, float]:
    """Return the row before a station, the share of the next row, and how far it is beyond the path's ends (m)."""
    beyond_m = 0.0
    station = station_m
    if station < 0.0:
        beyond_m = station
        station = 0.0
    elif station > leg.length_m:
        beyond_m = station - leg.length_m
        station = leg.length_m
    at = station / leg.step_m
    row = math.floor(at)
    if row >= leg.last_row:
        row = leg.last_row - 1
    return row, at - row, beyond_m


def pose_at(leg: LegTable, station_m: float) -> tuple[float, float, float, float, float]:
    """Return place (m, m) and yaw (rad) of the path at a station, and how the body differs there through tyre slip.

    The last two are the heading of the body against the path (rad) and the curvature (1/m) that the wheels make beyond
    the body's. Before the start and past the end the path goes on straight.
    """
    row, b, beyond_m = _place(leg, station_m)
    a = 1.0 - b
    n = row + 1
    yaw_rad = a * leg.yaw_rad[row] + b * leg.yaw_rad[n]
    x_m = a * leg.x_m[row] + b * leg.x_m[n]
    y_m = a * leg.y_m[row] + b * leg.y_m[n]
    if beyond_m != 0.0:
        travel_m = leg.sigma * beyond_m
        x_m += travel_m * math.cos(yaw_rad)
        y_m += travel_m * math.sin(yaw_rad)
    return (
        x_m,
        y_m,
        yaw_rad,
        a * leg.slip_heading_rad[row] + b * leg.slip_heading_rad[n],
        a * leg.slip_curvature_1pm[row] + b * leg.slip_curvature_1pm[n],
    )


def feedforward_at(leg: LegTable, station_m: float) -> tuple[float, float]:
    """Return feedforward curvature (1/m) and its slope per metre of travel (1/m^2) at a station."""
    row, b, _ = _place(leg, station_m)
    a = 1.0 - b
    n = row + 1
    return (
        a * leg.feedforward_curvature_1pm[row] + b * leg.feedforward_curvature_1pm[n],
        a * leg.feedforward_slope_1pm2[row] + b * leg.feedforward_slope_1pm2[n],
    )


def plan_at(leg: LegTable, station_m: float) -> tuple[float, float]:
    """Return planned speed (m/s) and acceleration (m/s^2) at a station."""
    row, b, _ = _place(leg, station_m)
    a = 1.0 - b
    n = row + 1
    return (
        a * leg.speed_mps[row] + b * leg.speed_mps[n],
        a * leg.accel_mps2[row] + b * leg.accel_mps2[n],
    )


def feedforward_curvature_1pm(leg: LegTable, station_m: float) -> float:
    """Return the feedforward curvature at a station, held beyond the ends: the one column of the model."""
    station = bounded(station_m, 0.0, leg.length_m) / leg.step_m
    row = math.floor(station)
    if row >= leg.last_row:
        row = leg.last_row - 1
    b = station - row
    return (1.0 - b) * leg.feedforward_curvature_1pm[row] + b * leg.feedforward_curvature_1pm[row + 1]
