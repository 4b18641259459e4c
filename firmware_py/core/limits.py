"""The steering limits inside the law: what is cut here is told to the integrators and remembered as sent."""

from typing import NamedTuple

from firmware_py.core.bounds import bounded
from firmware_py.core.tables import CarTable

RATE_SHARE = 0.98
"""Share of the car's rate that the law uses, so that rounding to the bus's resolution stays inside the car's rate."""


class LimitedAngle(NamedTuple):
    """A road-wheel angle within the limits, and whether it had to be cut."""

    angle_rad: float
    limited: int


def limit_angle(car: CarTable, angle_rad: float, previous_rad: float, period_s: float) -> LimitedAngle:
    """Return the angle within the car's greatest angle and within its rate from the previous command."""
    step_rad = RATE_SHARE * car.max_road_wheel_rate_radps * period_s
    bounded_rad = bounded(angle_rad, -car.max_road_wheel_angle_rad, car.max_road_wheel_angle_rad)
    bounded_rad = bounded(bounded_rad, previous_rad - step_rad, previous_rad + step_rad)
    limited = 0
    if abs(bounded_rad - angle_rad) > 1e-9:
        limited = 1
    return LimitedAngle(bounded_rad, limited)
