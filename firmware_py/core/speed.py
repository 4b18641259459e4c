"""Speed along the leg: a reference that moves by the profile, followed to a stop at the last station."""

from typing import NamedTuple

from firmware_py.core.bounds import bounded
from firmware_py.core.path import plan_at
from firmware_py.core.tables import CarTable, LegTable

STATION_GAIN_1PS = 0.8
"""Speed added per metre that the car is behind its reference; slow against the drive's lag, so it never oscillates."""

REFERENCE_LEAD_M = 0.10
"""The reference waits when it is this far ahead: a car that does not follow is not chased."""

ACCEL_LIMIT_MPS2 = 0.45
JERK_LIMIT_MPS3 = 1.0
"""What the command may ask of the drive: below 0.05 g whatever the profile and the error to it say, and eased in."""

LEAST_DRIVE_LAG_S = 0.05
"""A drive quicker than this is treated as if it had this lag: the command then leads the speed a little less."""

CREEP_MPS = 0.04
"""Least speed asked for on the way to the stop: below the profile's floor, above what odometry can resolve."""

STOP_DECEL_MPS2 = 0.80
"""Brake for the last centimetres, from creeping speed: harder than any planned deceleration, so that a car that follows
its profile never needs it before."""

HOLD_DECEL_MPS2 = 1.5
"""Brake at standstill: holds the car on any slope of a test area (10 % is 1 m/s^2)."""


class SpeedState(NamedTuple):
    """The moving reference's station, the acceleration asked for last, and whether the stop has begun."""

    reference_station_m: float
    accel_mps2: float
    stopping: int


def begin(station_m: float) -> SpeedState:
    """Return the state at standstill at a station."""
    return SpeedState(reference_station_m=station_m, accel_mps2=0.0, stopping=0)


def follow(
    leg: LegTable, car: CarTable, state: SpeedState, station_now_m: float, travel_speed_mps: float, dt_s: float
) -> tuple[SpeedState, float, float]:
    """Return the next reference and the command that follows it: travel speed (never negative) and brake.

    The drive answers a speed command with a first-order lag, so the command leads the speed by lag times acceleration.
    Once the remaining distance is what the brake needs, the stop begins and is not taken back.
    """
    reference_m, last_mps2, stopping = state
    length_m = leg.length_m
    speed_mps = travel_speed_mps
    if speed_mps < 0.0:
        speed_mps = 0.0
    braking_m = speed_mps * (car.brake_lag_s + 0.5 * dt_s) + 0.5 * speed_mps * speed_mps / STOP_DECEL_MPS2
    if stopping != 0 or length_m - station_now_m <= braking_m:
        return SpeedState(length_m, 0.0, 1), 0.0, STOP_DECEL_MPS2
    planned_mps, planned_mps2 = plan_at(leg, reference_m)
    lag_s = car.drive_lag_s
    wanted_mps = planned_mps + lag_s * planned_mps2 + STATION_GAIN_1PS * (reference_m - station_now_m)
    reference_m += planned_mps * dt_s
    if reference_m > length_m:
        reference_m = length_m
    if reference_m > station_now_m + REFERENCE_LEAD_M:
        reference_m = station_now_m + REFERENCE_LEAD_M
    if lag_s < LEAST_DRIVE_LAG_S:
        lag_s = LEAST_DRIVE_LAG_S
    eased_mps2 = JERK_LIMIT_MPS3 * dt_s
    accel_mps2 = (wanted_mps - speed_mps) / lag_s
    accel_mps2 = bounded(accel_mps2, last_mps2 - eased_mps2, last_mps2 + eased_mps2)
    accel_mps2 = bounded(accel_mps2, -ACCEL_LIMIT_MPS2, ACCEL_LIMIT_MPS2)
    command_mps = bounded(speed_mps + lag_s * accel_mps2, CREEP_MPS, car.max_speed_mps)
    # What the clamps took away is not remembered: the next easing starts from what was asked for.
    commanded_mps2 = (command_mps - speed_mps) / lag_s
    if accel_mps2 > commanded_mps2:
        accel_mps2 = commanded_mps2
    return SpeedState(reference_m, accel_mps2, 0), command_mps, 0.0
