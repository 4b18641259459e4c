"""Where the path is: points of a leg by station, and the errors of a pose against it."""

import math
from typing import NamedTuple

from firmware_py.core.tables import LegTable


class PathPoint(NamedTuple):
    """The path and the plan at one station."""

    x_m: float
    y_m: float
    yaw_rad: float
    curvature_1pm: float
    slip_heading_rad: float
    feedforward_curvature_1pm: float
    feedforward_slope_1pm2: float
    speed_mps: float
    accel_mps2: float


class PathPose(NamedTuple):
    """Where the body should be at one station."""

    x_m: float
    y_m: float
    yaw_rad: float
    slip_heading_rad: float


class PoseError(NamedTuple):
    """A pose relative to one point of the path: along travel, to the left of the body's path heading, and turned."""

    along_m: float
    cross_track_error_m: float
    heading_error_rad: float


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
    row = max(min(row, leg.last_row - 1), 0)
    return row, at - row, beyond_m


def locate(leg: LegTable, station_m: float) -> PathPoint:
    """Return the path at a station; before the start and past the end the path goes on straight."""
    row, b, beyond_m = _place(leg, station_m)
    a = 1.0 - b
    n = row + 1
    yaw_rad = a * leg.yaw_rad[row] + b * leg.yaw_rad[n]
    travel_m = leg.sigma * beyond_m
    return PathPoint(
        a * leg.x_m[row] + b * leg.x_m[n] + travel_m * math.cos(yaw_rad),
        a * leg.y_m[row] + b * leg.y_m[n] + travel_m * math.sin(yaw_rad),
        yaw_rad,
        a * leg.curvature_1pm[row] + b * leg.curvature_1pm[n],
        a * leg.slip_heading_rad[row] + b * leg.slip_heading_rad[n],
        a * leg.feedforward_curvature_1pm[row] + b * leg.feedforward_curvature_1pm[n],
        a * leg.feedforward_slope_1pm2[row] + b * leg.feedforward_slope_1pm2[n],
        a * leg.speed_mps[row] + b * leg.speed_mps[n],
        a * leg.accel_mps2[row] + b * leg.accel_mps2[n],
    )


# The same for those who need a part of it in every cycle; the values are those of `locate`.


def pose_at(leg: LegTable, station_m: float) -> PathPose:
    """Return the pose that the body should have at a station."""
    row, b, beyond_m = _place(leg, station_m)
    a = 1.0 - b
    n = row + 1
    yaw_rad = a * leg.yaw_rad[row] + b * leg.yaw_rad[n]
    travel_m = leg.sigma * beyond_m
    return PathPose(
        a * leg.x_m[row] + b * leg.x_m[n] + travel_m * math.cos(yaw_rad),
        a * leg.y_m[row] + b * leg.y_m[n] + travel_m * math.sin(yaw_rad),
        yaw_rad,
        a * leg.slip_heading_rad[row] + b * leg.slip_heading_rad[n],
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
    """Return the feedforward curvature at a station, held beyond the ends: `locate` for the one column of the model."""
    station = max(min(station_m, leg.length_m), 0.0) / leg.step_m
    row = max(min(math.floor(station), leg.last_row - 1), 0)
    b = station - row
    return (1.0 - b) * leg.feedforward_curvature_1pm[row] + b * leg.feedforward_curvature_1pm[row + 1]


def pose_error(point: PathPoint | PathPose, sigma: float, x_m: float, y_m: float, yaw_rad: float) -> PoseError:
    """Return the pose relative to a path point, in the frame of the body's heading there.

    `along_m` grows with travel (sigma = +1 forward, -1 reverse); the heading error is the body's against the heading
    that it should have there, slip included.
    """
    dx = x_m - point.x_m
    dy = y_m - point.y_m
    cos_yaw = math.cos(point.yaw_rad)
    sin_yaw = math.sin(point.yaw_rad)
    return PoseError(
        sigma * (dx * cos_yaw + dy * sin_yaw),
        dy * cos_yaw - dx * sin_yaw,
        wrap_angle(yaw_rad - point.yaw_rad - point.slip_heading_rad),
    )
