"""How well the estimator knows where the car is: the covariance of its cross-track and heading error.

Carried on by the same gains that the estimator uses, whatever they are (Joseph's form), so it is that of this filter
and not of an ideal one; but for the gyro's bias and the road disturbance, whose small share is in the walk of the
heading. It knows two kinds of pose noise. What differs from one pose to the next averages out; how large it is, the
poses of a car that stands show. The rest of the standard deviation that the localisation states for itself stays for
seconds: no filter of poses sees it, and it is taken to be wholly in the estimate.

Nothing steers by it: it goes onto the bus ten times a second. But two of the noises here (HEADING_WALK and
YAW_RATE_NOISE_RADPS) are also what the estimator's gains are designed for: another number makes other tables.
"""

import math
from typing import NamedTuple

from firmware_py.core.path import wrap_angle
from firmware_py.core.schedule import Gains

YAW_PER_POSITION_RADPM = math.radians(0.1) / 0.01
"""Standard deviation of the yaw over that of the position, of which alone the localisation tells: 0.1 degrees for
1 cm, as of two antennas 6 m apart or an inertial unit of that class."""

SOFT_TYRE_SLIP = 0.4e-3
"""What the rear tyres' unknown slip moves a car aside that is heavier than its tyres are made for, m per root metre of
travel: more than the estimator's gains are designed for, which are for the usual car."""

HEADING_WALK = 0.2e-3
"""With the yaw rate: what is left of heading that it does not show, rad per root metre."""

HEADING_WALK_WITHOUT_YAW_RATE = 2.5e-3
"""Without it, the heading follows from the steering: rad per root metre."""

YAW_RATE_NOISE_RADPS = math.radians(0.02)
"""Noise of a yaw rate, a sample."""

COMPARED_MAX = 400
"""Pairs of poses that the noise of a pose is averaged over, at most; then a first-order filter of that length."""

SEEN_SHARE = 0.7
"""Where the poses differ by so much of the variance that the localisation states, all of it averages out: the rest is
within what some hundred pairs can tell."""

UNKNOWN_SIGMA_M = 0.01
"""Standard deviation of a position of which the localisation does not state any, as the estimator's gains assume."""

UNSTATED_M = 0.0003
"""What the localisation cannot state, as its standard deviation comes in steps of 1 mm."""

UNKNOWN_M = 1.0
UNKNOWN_RAD = 0.1
"""Before the first pose."""


class CovarianceState(NamedTuple):
    """Covariance of cross-track and heading error; noise of a pose as `compared` pairs of consecutive ones show it."""

    cross_m2: float
    cross_heading_mrad: float
    heading_rad2: float
    position_noise_m2: float
    yaw_noise_rad2: float
    compared: int


def begin() -> CovarianceState:
    """Return what is known before the first pose: nothing."""
    return CovarianceState(UNKNOWN_M * UNKNOWN_M, 0.0, UNKNOWN_RAD * UNKNOWN_RAD, 0.0, 0.0, 0)


def compare(state: CovarianceState, dx_m: float, dy_m: float, turned_rad: float) -> CovarianceState:
    """Return the state after two consecutive poses of a car that stands, which differ by so much."""
    compared = min(state.compared + 1, COMPARED_MAX)
    turned_rad = wrap_angle(turned_rad)
    # Half the square of a difference is the noise of one; of a position, two axes tell.
    position_m2 = 0.25 * (dx_m * dx_m + dy_m * dy_m)
    yaw_rad2 = 0.5 * turned_rad * turned_rad
    return CovarianceState(
        state.cross_m2,
        state.cross_heading_mrad,
        state.heading_rad2,
        state.position_noise_m2 + (position_m2 - state.position_noise_m2) / compared,
        state.yaw_noise_rad2 + (yaw_rad2 - state.yaw_noise_rad2) / compared,
        compared,
    )


class Interval(NamedTuple):
    """Some cycles of which the estimator's covariance is to be carried on.

    `body_m` is the way along the body (negative in reverse), `poses` how many poses were believed, `averaged` how many
    the estimate is worth at its end (`EstimatorState.averaged`); `standstill` is 1 for a car that stood, and
    `with_yaw_rate` 1 where the yaw rate carried the heading.
    """

    cycles: int
    dt_s: float
    body_m: float
    poses: int
    averaged: int
    standstill: int
    with_yaw_rate: int


def advance(state: CovarianceState, gains: Gains, interval: Interval) -> CovarianceState:
    """Return the state at the end of an interval, of which `gains` are those of its speed."""
    cross_m2 = state.cross_m2
    both = state.cross_heading_mrad
    heading_rad2 = state.heading_rad2
    position_m2 = state.position_noise_m2
    yaw_rad2 = state.yaw_noise_rad2
    if interval.standstill != 0:
        # An average of poses. One that was begun anew holds fewer than came meanwhile.
        poses = min(interval.poses, interval.averaged)
        if poses > 0:
            kept = (interval.averaged - poses) / interval.averaged
            added = poses / (interval.averaged * interval.averaged)
            cross_m2 = kept * kept * cross_m2 + added * position_m2
            both = kept * kept * both
            heading_rad2 = kept * kept * heading_rad2 + added * yaw_rad2
    else:
        way_m = interval.body_m / interval.cycles
        slip_m2 = SOFT_TYRE_SLIP * SOFT_TYRE_SLIP * abs(way_m)
        walk_rad2 = HEADING_WALK_WITHOUT_YAW_RATE * HEADING_WALK_WITHOUT_YAW_RATE * abs(way_m)
        if interval.with_yaw_rate != 0:
            noise_rad = YAW_RATE_NOISE_RADPS * interval.dt_s / interval.cycles
            walk_rad2 = HEADING_WALK * HEADING_WALK * abs(way_m) + noise_rad * noise_rad
        a = 1.0 - gains.ee
        b = -gains.ep
        c = -gains.pe
        d = 1.0 - gains.pp
        for cycle in range(interval.cycles):
            cross_m2 += way_m * (2.0 * both + way_m * heading_rad2) + slip_m2
            both += way_m * heading_rad2
            heading_rad2 += walk_rad2
            if cycle < interval.poses:
                before_m2 = cross_m2
                before = both
                cross_m2 = a * a * before_m2 + 2.0 * a * b * before + b * b * heading_rad2
                both = a * c * before_m2 + (a * d + b * c) * before + b * d * heading_rad2
                heading_rad2 = c * c * before_m2 + 2.0 * c * d * before + d * d * heading_rad2
                cross_m2 += gains.ee * gains.ee * position_m2 + gains.ep * gains.ep * yaw_rad2
                both += gains.ee * gains.pe * position_m2 + gains.ep * gains.pp * yaw_rad2
                heading_rad2 += gains.pe * gains.pe * position_m2 + gains.pp * gains.pp * yaw_rad2
    return CovarianceState(cross_m2, both, heading_rad2, position_m2, yaw_rad2, state.compared)


def deviations(state: CovarianceState, position_sigma_m: float) -> tuple[float, float]:
    """Return the standard deviations of cross-track (m) and heading error (rad) of the estimate.

    `position_sigma_m` is what the localisation states for a position, 0 if it does not know; what of it does not show
    from pose to pose stays.
    """
    if position_sigma_m <= 0.0:
        position_sigma_m = UNKNOWN_SIGMA_M
    stays_m2 = max(position_sigma_m * position_sigma_m - state.position_noise_m2 / SEEN_SHARE, UNSTATED_M * UNSTATED_M)
    yaw_sigma_rad = YAW_PER_POSITION_RADPM * position_sigma_m
    unstated_rad = YAW_PER_POSITION_RADPM * UNSTATED_M
    stays_rad2 = max(yaw_sigma_rad * yaw_sigma_rad - state.yaw_noise_rad2 / SEEN_SHARE, unstated_rad * unstated_rad)
    # Rounding may leave a covariance a little below zero.
    return math.sqrt(max(state.cross_m2, 0.0) + stays_m2), math.sqrt(max(state.heading_rad2, 0.0) + stays_rad2)
