"""Speed-scheduled PID on the preview error, in curvature, per metre of travel.

Every state advances with distance, so nothing divides by speed and everything freezes at standstill.
"""

import math

from firmware_py.core.bounds import bounded
from firmware_py.core.schedule import Gains
from firmware_py.core.tables import CarTable

INTEGRAL_AUTHORITY_1PM = 0.02
"""Greatest curvature that the integral part may ask for: several times a steering bias, far below the car's."""

CROSS_TRACK_MAX_M = 0.015
"""A car that is farther off comes back at the angle that this asks for: about 1.5 degrees. Between the cones of the box
a steeper way back would swing the body's ends out."""

CORRECTION_MAX_1PM = 0.025
"""Greatest curvature by which the feedback corrects the feedforward: what a rack of 0.59 rad/s turns in a sixth of a
second with a wheelbase of 4 m. A car that needs more angle than it has comes out of the sharpest bend centimetres off;
with the whole of such gains its wheels would then go from side to side as fast as they can, always too late, and it
would swing about the path to the end. The bound is reached 4 mm beside the path, or turned by 0.4 degrees, at 1 m/s."""


def preview_error_m(cross_track_error_m: float, heading_error_rad: float, preview_m: float, sigma: float) -> float:
    """Return the cross-track error of the point `preview_m` ahead in the direction of travel, positive to the left.

    Of the cross-track error itself no more than CROSS_TRACK_MAX_M counts.
    """
    cross_m = bounded(cross_track_error_m, -CROSS_TRACK_MAX_M, CROSS_TRACK_MAX_M)
    return cross_m + sigma * preview_m * math.sin(heading_error_rad)


def feedback_1pm(preview_m: float, heading_error_rad: float, integral_m2: float, gains: Gains, sigma: float) -> float:
    """Return the curvature to take away from the feedforward, by the preview error; positive left of the path."""
    return gains.kp * preview_m + sigma * gains.kd * math.sin(heading_error_rad) + gains.ki * integral_m2


def integrate_m2(integral_m2: float, preview_m: float, ds_m: float, gains: Gains, limited: int) -> float:
    """Return the integral of the preview error (m) over distance; it stands still while the command is limited."""
    if limited != 0 or gains.ki <= 0.0:
        return integral_m2
    bound_m2 = INTEGRAL_AUTHORITY_1PM / gains.ki
    return bounded(integral_m2 + preview_m * ds_m, -bound_m2, bound_m2)


def push_rad(lacking_rad: float, car: CarTable) -> float:
    """Return what to command on top of a wanted angle of which the wheels lack so much (rad).

    With the usual lag and one sample of latency the steering answers 1.8 times as fast, which is worth more in phase
    than a faster PID; it costs delay margin, which the certificate watches. What the nominal actuator makes good before
    a command can act needs no push: one without lag gets none, and one with a long dead time, where what the wheels
    will lack is mostly a guess, gets little.
    """
    kept = 1.0 - car.lag_alpha
    push = kept * lacking_rad
    for _ in range(car.command_latency_samples):
        push *= kept
    return push
