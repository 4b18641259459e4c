"""The firmware's Kalman filter (`firmware_py.core.kalman`) as it is in the long run, at a constant speed.

Settled by its own recursion, with the poses of a localisation. How quickly poses are followed depends on it, and with
that what margin the whole loop has.
"""

from functools import cache
from typing import NamedTuple

from firmware_py.core import kalman

POSITION_NOISE_M = kalman.UNKNOWN_SIGMA_M
HEADING_NOISE_RAD = kalman.YAW_PER_POSITION_RADPM * POSITION_NOISE_M
"""Noise of one pose, of the localisation that the design assumes: that of one which does not state any."""


class Localisation(NamedTuple):
    """What a standing car's poses show of their noise, and the standard deviation that is stated of a position, m."""

    noise: kalman.SeenNoise
    stated_m: float


def _poses(position_m: float, stated_m: float) -> Localisation:
    yaw_rad = kalman.YAW_PER_POSITION_RADPM * position_m
    noise = kalman.begin_noise()._replace(
        position_m2=position_m * position_m, yaw_rad2=yaw_rad * yaw_rad, compared=kalman.COMPARED_MAX
    )
    return Localisation(noise, stated_m)


LOCALISATIONS = {
    "white": _poses(POSITION_NOISE_M, POSITION_NOISE_M),
    "exact": _poses(0.0, 0.001),
    "slow": _poses(0.0, POSITION_NOISE_M),
}
"""Noise that differs from pose to pose, the usual; none, of which 1 mm is stated; noise that stays for seconds."""

SETTLED = 1e-6
"""Relative change of every gain in `CHECKED_EVERY` steps of the recursion at which it has settled."""

CHECKED_EVERY = 20
LONGEST = 100_000


@cache
def settled(
    direction: float,
    speed_mps: float,
    with_yaw_rate: bool,
    walks: tuple[float, float, float],
    localisation: str = "white",
) -> kalman.Filter:
    """The filter after a long way; `walks` are the noises without the yaw rate (`kalman.Walks`).

    At standstill nothing settles, as nothing is added to what the poses have told: there the gains are 0. Raises
    ArithmeticError where the recursion does not settle.
    """
    noise, stated_m = LOCALISATIONS[localisation]
    state = kalman.begin()._replace(with_yaw_rate=int(with_yaw_rate))
    if speed_mps == 0.0:
        return state._replace(gains=kalman.PoseGains(*(0.0,) * 12))
    every = kalman.GAINS_EVERY
    interval = kalman.Interval(
        body_m=direction * speed_mps * kalman.PERIOD_S * every,
        slipped_m=0.0,  # on the straight: what the bends teach of the tyres' slip is slow, and no part of the loop
        poses=every,
        stated_m=stated_m,
        averaged=0,
        bias_averaged=1,
        standstill=0,
        with_yaw_rate=int(with_yaw_rate),
    )
    for _ in range(LONGEST // CHECKED_EVERY):
        before = state.gains
        for _ in range(CHECKED_EVERY):
            state = kalman.advance(state, kalman.Walks(*walks), noise, interval)
        if all(abs(a - b) <= SETTLED * abs(a) + 1e-12 for a, b in zip(state.gains, before, strict=True)):
            return state
    raise ArithmeticError(f"the filter does not settle at {speed_mps:g} m/s with {walks} and {localisation} poses")
