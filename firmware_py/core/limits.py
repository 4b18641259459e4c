"""The steering limits inside the law: what is cut here is told to the integrators and remembered as sent."""

from firmware_py.core.bounds import bounded
from firmware_py.core.tables import CarTable

RATE_SHARE = 0.98
"""Share of the car's rate that the law uses, so that rounding to the bus's resolution stays inside the car's rate."""


def limit_angle(car: CarTable, angle_rad: float, previous_rad: float, period_s: float) -> tuple[float, int]:
    """Return the angle within the car's greatest and within its rate from the previous command, and 1 if it was cut."""
    step_rad = RATE_SHARE * car.max_road_wheel_rate_radps * period_s
    most_rad = car.max_road_wheel_angle_rad
    bounded_rad = bounded(angle_rad, -most_rad, most_rad)
    bounded_rad = bounded(bounded_rad, previous_rad - step_rad, previous_rad + step_rad)
    limited = 0
    if abs(bounded_rad - angle_rad) > 1e-9:
        limited = 1
    return bounded_rad, limited
