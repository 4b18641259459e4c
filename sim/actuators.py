"""Steering, drive and brake: from the command that acts to what the car does.

Steering: command -> resolution, limit and gain (`steering_target`) -> rate limit -> first-order lag = the rack, where
the steering sensor sits -> backlash -> bias = the true road-wheel angle. Dead times lie before all of this, in the
emulator's queue of commands. Floats, NamedTuples and `math` only.
"""

from math import exp, floor
from typing import NamedTuple

STANDSTILL_SPEED_MPS = 1.0e-3
"""Below it a car that is to stand does stand: brake or drive hold it."""

RELEASED_BRAKE_MPS2 = 5.0e-3
"""Below it a brake that is being released no longer drags."""


class SteeringParameters(NamedTuple):
    """Steering actuator and its errors: rad, rad/s, s; `half_backlash_rad` is half of the whole play."""

    max_angle_rad: float
    max_rate_radps: float
    lag_s: float
    gain: float
    bias_rad: float
    half_backlash_rad: float
    resolution_rad: float


class SteeringState(NamedTuple):
    """Angles at the road wheel, rad: rate-limited demand, rack (sensor side), wheel side of the backlash."""

    demand_rad: float
    rack_rad: float
    wheel_rad: float


def steering_target(p: SteeringParameters, command_rad: float) -> float:
    """Angle in rad that the rack will settle at for a command: limited, in the converter's steps, times the gain."""
    angle = command_rad
    if angle > p.max_angle_rad:
        angle = p.max_angle_rad
    elif angle < -p.max_angle_rad:
        angle = -p.max_angle_rad
    if p.resolution_rad > 0.0:
        angle = p.resolution_rad * floor(angle / p.resolution_rad + 0.5)
    return p.gain * angle


def step_steering(p: SteeringParameters, s: SteeringState, target_rad: float, h: float) -> SteeringState:
    """State after `h` seconds with a constant target; the lag is exact for the rate-limited demand."""
    demand, rack, wheel = s
    if demand == target_rad and rack == target_rad:
        return s
    most = p.max_rate_radps * h
    change = target_rad - demand
    if change > most:
        change = most
    elif change < -most:
        change = -most
    demand_next = demand + change
    if p.lag_s > 0.0:
        # First-order lag of a demand that rises evenly over the step.
        behind = change * (p.lag_s / h)
        rack = demand_next - behind + (rack - demand + behind) * exp(-h / p.lag_s)
    else:
        rack = demand_next
    if wheel > rack + p.half_backlash_rad:
        wheel = rack + p.half_backlash_rad
    elif wheel < rack - p.half_backlash_rad:
        wheel = rack - p.half_backlash_rad
    return SteeringState(demand_next, rack, wheel)


def step_speed(
    drive_lag_s: float,
    brake_lag_s: float,
    speed_mps: float,
    decel_mps2: float,
    speed_target_mps: float,
    decel_target_mps2: float,
    h: float,
) -> tuple[float, float]:
    """Signed speed (m/s) and brake deceleration (m/s^2, never negative) after `h` seconds.

    While the brake is asked for, the drive is off and the brake acts against the motion, down to exactly 0. Without
    it the speed follows its target with a first-order lag, and what is left of the brake still acts.
    """
    if brake_lag_s > 0.0 and decel_mps2 != decel_target_mps2:
        decay = exp(-h / brake_lag_s)
        excess = decel_mps2 - decel_target_mps2
        decel_next = decel_target_mps2 + excess * decay
        lost = decel_target_mps2 * h + excess * brake_lag_s * (1.0 - decay)
    else:
        decel_next = decel_target_mps2
        lost = decel_target_mps2 * h
    if decel_target_mps2 == 0.0:
        if decel_next < RELEASED_BRAKE_MPS2:
            decel_next = 0.0
        if drive_lag_s > 0.0:
            speed = speed_target_mps + (speed_mps - speed_target_mps) * exp(-h / drive_lag_s)
        else:
            speed = speed_target_mps
    else:
        speed = speed_mps
    if speed > 0.0:
        speed -= lost
        if speed < 0.0:
            speed = 0.0
    elif speed < 0.0:
        speed += lost
        if speed > 0.0:
            speed = 0.0
    to_stand = decel_target_mps2 > 0.0 or speed_target_mps == 0.0
    if to_stand and -STANDSTILL_SPEED_MPS < speed < STANDSTILL_SPEED_MPS:
        speed = 0.0
    return speed, decel_next
