"""The nominal motion along the path: the one model that the observer and the predictor share.

Kinematics of the rear-axle centre per metre of travel, body curvature c (left positive, sigma = +1
forward and -1 in reverse):

    de = sigma sin(heading error) ds,    d(heading error) = sigma (c + d - k) ds

with k the feedforward curvature (tyre slip included) and d the curvature disturbance. The road-wheel angle follows
the command through a first-order lag under the car's rate limit.
"""

import math
from typing import NamedTuple

from firmware_py.core.path import feedforward_curvature_1pm
from firmware_py.core.tables import CarTable, LegTable


class PathState(NamedTuple):
    """Where the car is relative to the path, what disturbs it, and where its wheels are in the nominal model."""

    station_m: float
    cross_track_error_m: float
    heading_error_rad: float
    curvature_disturbance_1pm: float
    road_wheel_angle_rad: float


def advance(
    leg: LegTable, car: CarTable, state: PathState, angle_cmd_rad: float, travel_speed_mps: float, dt_s: float
) -> PathState:
    """Return the state after `dt_s` at constant travel speed with the command held.

    `travel_speed_mps` is positive along the leg's travel. The heading changes with the mean angle of the interval,
    which is exact for the lag (table weight) and a good approximation under the rate limit.
    """
    station_m, cross_m, heading_rad, disturbance_1pm, angle_rad = state
    limit_rad = car.max_road_wheel_rate_radps * dt_s
    gap_rad = angle_cmd_rad - angle_rad
    change_rad = max(min(car.lag_alpha * gap_rad, limit_rad), -limit_rad)
    mean_change_rad = max(min((1.0 - car.lag_mean_weight) * gap_rad, limit_rad), -limit_rad)
    curvature_1pm = math.tan(angle_rad + mean_change_rad) / car.wheelbase_m

    ds_m = travel_speed_mps * dt_s
    reference_1pm = feedforward_curvature_1pm(leg, station_m + 0.5 * ds_m)
    path_ds_m = ds_m * math.cos(heading_rad) / max(1.0 - reference_1pm * cross_m, 0.5)
    heading_change_rad = leg.sigma * ((curvature_1pm + disturbance_1pm) * ds_m - reference_1pm * path_ds_m)
    mean_heading_rad = heading_rad + 0.5 * heading_change_rad
    return PathState(
        station_m + path_ds_m,
        cross_m + leg.sigma * math.sin(mean_heading_rad) * ds_m,
        heading_rad + heading_change_rad,
        disturbance_1pm,
        angle_rad + change_rad,
    )
