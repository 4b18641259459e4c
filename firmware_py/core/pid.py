"""Speed-scheduled PID on the preview error, in curvature, per metre of travel.

Every state advances with distance, so nothing divides by speed and everything freezes at standstill.
"""

import math

from firmware_py.core.bounds import bounded
from firmware_py.core.schedule import Gains
from firmware_py.core.tables import CarTable

INTEGRAL_AUTHORITY_1PM = 0.02
"""Greatest curvature that the integral part may ask for: several times a steering bias, far below the car's."""

ANGLE_GAIN = 0.55
"""Share of what the wheels will lack of their wanted angle that is commanded on top of it."""

CROSS_TRACK_MAX_M = 0.025
"""A car that is farther off comes back at the angle that this asks for: about 1.5 degrees. Between the cones of the box
a steeper way back would swing the body's ends out."""


def preview_error_m(cross_track_error_m: float, heading_error_rad: float, preview_m: float, sigma: float) -> float:
    """Return the cross-track error of the point `preview_m` ahead in the direction of travel, positive to the left.

    Of the cross-track error itself no more than CROSS_TRACK_MAX_M counts.
    """
    cross_m = bounded(cross_track_error_m, -CROSS_TRACK_MAX_M, CROSS_TRACK_MAX_M)
    return cross_m + sigma * preview_m * math.sin(heading_error_rad)


def feedback_1pm(
    cross_track_error_m: float, heading_error_rad: float, integral_m2: float, gains: Gains, sigma: float
) -> float:
    """Return the curvature to take away from the feedforward; positive when the car is left of the path."""
    return (
        gains.kp * preview_error_m(cross_track_error_m, heading_error_rad, gains.preview_m, sigma)
        + sigma * gains.kd * math.sin(heading_error_rad)
        + gains.ki * integral_m2
    )


def integrate_m2(integral_m2: float, preview_m: float, ds_m: float, gains: Gains, limited: int) -> float:
    """Return the integral of the preview error (m) over distance; it stands still while the command is limited."""
    if limited != 0 or gains.ki <= 0.0:
        return integral_m2
    bound_m2 = INTEGRAL_AUTHORITY_1PM / gains.ki
    return bounded(integral_m2 + preview_m * ds_m, -bound_m2, bound_m2)


def push_rad(lacking_rad: float, car: CarTable) -> float:
    """Return what to command on top of a wanted angle of which the wheels lack so much (rad).

    The steering answers half as fast again, whatever its lag, which is worth more in phase than a faster PID. Twice as
    much costs a third of the delay margin, and with a fast PID it reaches the rate limit at every turn of the command.
    What the nominal actuator makes good within a cycle needs no push: one without lag gets none.
    """
    return ANGLE_GAIN * (1.0 - car.lag_alpha) * lacking_rad
