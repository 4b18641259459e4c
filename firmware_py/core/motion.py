"""The nominal motion along the path: what the predictor takes the car to do with the commands on their way.

Kinematics of the rear-axle centre per metre of travel, body curvature c (left positive, sigma = +1 forward and -1 in
reverse):

    de = sigma sin(heading error) ds,    d(heading error) = sigma (c - k) ds

with k the feedforward curvature (tyre slip included) and c = tan(road-wheel angle + road disturbance) / wheelbase. The
road-wheel angle follows the command through a first-order lag under the car's rate limit.
"""

import math

from firmware_py.core.bounds import bounded
from firmware_py.core.path import feedforward_curvature_1pm
from firmware_py.core.tables import CarTable, LegTable

QUEUE_LENGTH = 48
"""Commands that are remembered; the latency of the command must be less."""


LATE_SHARE = 0.35
"""Share of a cycle between two reports in which an older command still acts: reports are 3 ms old when a cycle begins,
and a command leaves half a millisecond after it."""


def lag_weights(lag_s: float, period_s: float) -> tuple[float, float, float]:
    """Return `lag_alpha`, `lag_mean_weight` and `late_weight` of the car's table for a first-order lag."""
    if lag_s <= 0.0:
        return 1.0, 0.0, 0.0
    alpha = 1.0 - math.exp(-period_s / lag_s)
    kept = math.exp(-(1.0 - LATE_SHARE) * period_s / lag_s)
    late_weight = (1.0 - math.exp(-LATE_SHARE * period_s / lag_s)) * kept / alpha
    return alpha, lag_s / period_s * alpha, late_weight


def advance(
    leg: LegTable,
    car: CarTable,
    station_m: float,
    cross_m: float,
    heading_rad: float,
    angle_rad: float,
    target_rad: float,
    disturbance_rad: float,
    travel_speed_mps: float,
    dt_s: float,
) -> tuple[float, float, float, float]:
    """Return station (m), cross-track error (m), heading error (rad) and road-wheel angle (rad) after `dt_s`.

    The travel speed is constant and positive along the leg's travel; the wheels go to `target_rad`. The heading changes
    with the mean angle of the interval, which is exact for the lag (table weight) and a good approximation under the
    rate limit.
    """
    sigma = leg.sigma
    limit_rad = car.max_road_wheel_rate_radps * dt_s
    gap_rad = target_rad - angle_rad
    change_rad = bounded(car.lag_alpha * gap_rad, -limit_rad, limit_rad)
    mean_change_rad = bounded((1.0 - car.lag_mean_weight) * gap_rad, -limit_rad, limit_rad)
    curvature_1pm = math.tan(angle_rad + mean_change_rad + disturbance_rad) / car.wheelbase_m

    ds_m = travel_speed_mps * dt_s
    reference_1pm = feedforward_curvature_1pm(leg, station_m + 0.5 * ds_m)
    radius_share = 1.0 - reference_1pm * cross_m
    if radius_share < 0.5:
        radius_share = 0.5
    path_ds_m = ds_m * math.cos(heading_rad) / radius_share
    heading_change_rad = sigma * (curvature_1pm * ds_m - reference_1pm * path_ds_m)
    return (
        station_m + path_ds_m,
        cross_m + sigma * math.sin(heading_rad + 0.5 * heading_change_rad) * ds_m,
        heading_rad + heading_change_rad,
        angle_rad + change_rad,
    )
