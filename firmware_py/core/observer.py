"""The disturbance observer: cross-track error, heading error and curvature disturbance from noisy poses.

A discrete steady-state observer on the nominal motion model; its coefficients come from the gain table, indexed by
(direction, speed). It lives at the age of the pose: the command that drives it is the one that acted then.
"""

from typing import NamedTuple

from firmware_py.core.motion import PathState, advance
from firmware_py.core.path import PoseError, pose_at, pose_error
from firmware_py.core.schedule import Gains
from firmware_py.core.tables import CarTable, LegTable

STATION_GAIN = 0.05
"""Share of the along-track innovation that corrects the odometry's station each cycle: odometry is smooth but
drifts by its scale error, the pose does not drift but is noisy."""

GATE_CROSS_M = 0.15
GATE_HEADING_RAD = 0.08
"""A pose farther than this from the prediction is not believed; several in a row are a fault (health)."""

AVERAGING_MAX = 100
"""Poses averaged at standstill, at most; then a first-order filter of that length."""

PRIOR_SAMPLES = 25
"""What the state at the end of a leg is worth at the start of the next, counted in poses."""


class ObserverState(NamedTuple):
    """The observed state, how many poses were averaged at standstill, and how many were disbelieved in a row."""

    path: PathState
    averaged: int
    disbelieved: int


def begin(station_m: float, angle_rad: float) -> ObserverState:
    """Return an observer that knows nothing but a guess of the station."""
    return ObserverState(
        path=PathState(
            station_m=station_m,
            cross_track_error_m=0.0,
            heading_error_rad=0.0,
            curvature_disturbance_1pm=0.0,
            road_wheel_angle_rad=angle_rad,
        ),
        averaged=0,
        disbelieved=0,
    )


def turn_round(leg: LegTable, observer: ObserverState) -> ObserverState:
    """Return the observer on the path travelled the other way: same body, same errors, station counted from the end.

    Errors and disturbance are the body's, so they carry over unchanged.
    """
    path = observer.path
    return ObserverState(
        PathState(
            leg.length_m - path.station_m,
            path.cross_track_error_m,
            path.heading_error_rad,
            path.curvature_disturbance_1pm,
            path.road_wheel_angle_rad,
        ),
        PRIOR_SAMPLES,
        0,
    )


def predict_to_pose(
    leg: LegTable, car: CarTable, observer: ObserverState, angle_cmd_rad: float, travel_speed_mps: float, dt_s: float
) -> ObserverState:
    """Return the observer one cycle later, driven by the command that acted at the pose's age and by odometry."""
    return ObserverState(
        advance(leg, car, observer.path, angle_cmd_rad, travel_speed_mps, dt_s),
        observer.averaged,
        observer.disbelieved,
    )


def innovation(leg: LegTable, observer: ObserverState, x_m: float, y_m: float, yaw_rad: float) -> PoseError:
    """Return how far a measured pose is from the observed one."""
    path = observer.path
    measured = pose_error(pose_at(leg, path.station_m), leg.sigma, x_m, y_m, yaw_rad)
    return PoseError(
        measured.along_m,
        measured.cross_track_error_m - path.cross_track_error_m,
        measured.heading_error_rad - path.heading_error_rad,
    )


def _corrected(
    path: PathState, station_m: float, cross_m: float, heading_rad: float, curvature_1pm: float
) -> PathState:
    return PathState(
        path.station_m + station_m,
        path.cross_track_error_m + cross_m,
        path.heading_error_rad + heading_rad,
        path.curvature_disturbance_1pm + curvature_1pm,
        path.road_wheel_angle_rad,
    )


def is_believable(error: PoseError) -> bool:
    """Return whether a pose is within the gate around the observed one."""
    return (
        abs(error.cross_track_error_m) <= GATE_CROSS_M
        and abs(error.along_m) <= GATE_CROSS_M
        and abs(error.heading_error_rad) <= GATE_HEADING_RAD
    )


def disbelieve(observer: ObserverState) -> ObserverState:
    """Return the observer untouched by a pose that is not believed, which is counted."""
    return ObserverState(observer.path, observer.averaged, observer.disbelieved + 1)


def correct_standing(observer: ObserverState, error: PoseError) -> ObserverState:
    """Return the observer corrected by a pose taken at standstill: the mean of the poses so far."""
    averaged = min(observer.averaged + 1, AVERAGING_MAX)
    share = 1.0 / averaged
    return ObserverState(
        _corrected(
            observer.path,
            share * error.along_m,
            share * error.cross_track_error_m,
            share * error.heading_error_rad,
            0.0,
        ),
        averaged,
        0,
    )


def correct_moving(observer: ObserverState, gains: Gains, error: PoseError) -> ObserverState:
    """Return the observer corrected by a pose taken on the move; a pose beyond the gate is not believed."""
    if not is_believable(error):
        return disbelieve(observer)
    cross_m = error.cross_track_error_m
    heading_rad = error.heading_error_rad
    return ObserverState(
        _corrected(
            observer.path,
            STATION_GAIN * error.along_m,
            gains.l_ee * cross_m + gains.l_ep * heading_rad,
            gains.l_pe * cross_m + gains.l_pp * heading_rad,
            gains.l_de * cross_m + gains.l_dp * heading_rad,
        ),
        0,
        0,
    )
