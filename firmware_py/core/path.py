"""Where the path is: points of a leg by station, and the errors of a pose against it."""

import math

from firmware_py.core.tables import LegTable

TURN_RAD = 2.0 * math.pi


def wrap_angle(angle_rad: float) -> float:
    """Return the angle in [-pi, pi)."""
    return angle_rad - TURN_RAD * math.floor((angle_rad + math.pi) / TURN_RAD)


def _place(leg: LegTable, station_m: float) -> tuple[int, float, float]:
    """Return the row before a station, the share of the next row, and how far it is beyond the path's ends (m)."""
    beyond_m = 0.0
    length_m = leg.length_m
    if station_m < 0.0:
        beyond_m = station_m
        station_m = 0.0
    elif station_m > length_m:
        beyond_m = station_m - length_m
        station_m = length_m
    at = station_m / leg.step_m
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
    xs_m, ys_m, yaws_rad = leg.x_m, leg.y_m, leg.yaw_rad
    slips_rad, slips_1pm = leg.slip_heading_rad, leg.slip_curvature_1pm
    x_m = a * xs_m[row] + b * xs_m[n]
    y_m = a * ys_m[row] + b * ys_m[n]
    yaw_rad = a * yaws_rad[row] + b * yaws_rad[n]
    if beyond_m != 0.0:
        travel_m = leg.sigma * beyond_m
        x_m += travel_m * math.cos(yaw_rad)
        y_m += travel_m * math.sin(yaw_rad)
    return (
        x_m,
        y_m,
        yaw_rad,
        a * slips_rad[row] + b * slips_rad[n],
        a * slips_1pm[row] + b * slips_1pm[n],
    )


def feedforward_at(leg: LegTable, station_m: float) -> tuple[float, float]:
    """Return feedforward curvature (1/m) and its slope per metre of travel (1/m^2) at a station."""
    row, b, _ = _place(leg, station_m)
    a = 1.0 - b
    n = row + 1
    curvatures_1pm, slopes_1pm2 = leg.feedforward_curvature_1pm, leg.feedforward_slope_1pm2
    return (
        a * curvatures_1pm[row] + b * curvatures_1pm[n],
        a * slopes_1pm2[row] + b * slopes_1pm2[n],
    )


def plan_at(leg: LegTable, station_m: float) -> tuple[float, float]:
    """Return planned speed (m/s) and acceleration (m/s^2) at a station."""
    row, b, _ = _place(leg, station_m)
    a = 1.0 - b
    n = row + 1
    speeds_mps, accels_mps2 = leg.speed_mps, leg.accel_mps2
    return (
        a * speeds_mps[row] + b * speeds_mps[n],
        a * accels_mps2[row] + b * accels_mps2[n],
    )


def feedforward_curvature_1pm(leg: LegTable, station_m: float) -> float:
    """Return the feedforward curvature at a station, held beyond the ends: the one column of the model."""
    row, b, _ = _place(leg, station_m)
    curvatures_1pm = leg.feedforward_curvature_1pm
    return (1.0 - b) * curvatures_1pm[row] + b * curvatures_1pm[row + 1]
