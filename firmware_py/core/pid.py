"""Speed-scheduled PID on the preview error, in curvature, per metre of travel.

Every state advances with distance, so nothing divides by speed and everything freezes at standstill.
"""

import math

from firmware_py.core.schedule import Gains

INTEGRAL_AUTHORITY_1PM = 0.02
"""Greatest curvature that the integral part may ask for: several times a steering bias, far below the car's."""


def preview_error_m(cross_track_error_m: float, heading_error_rad: float, preview_m: float, sigma: float) -> float:
    """Return the cross-track error of the point `preview_m` ahead in the direction of travel, positive to the left."""
    return cross_track_error_m + sigma * preview_m * math.sin(heading_error_rad)


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
    return max(min(integral_m2 + preview_m * ds_m, bound_m2), -bound_m2)
