"""Tyre-slip feedforward: what the rear axle needs to stay on the path although tyres slip. Made once, at load.

Single-track model with linear tyres in steady progress along the path at the planned speed. The forces that the
path's lateral acceleration and yaw acceleration need give the slip of both axles, ahead by the tyres' relaxation
length; the body is then turned against the path by the rear slip, and the wheels are turned further by the difference
of front and rear.
"""

from itertools import accumulate
from typing import NamedTuple

SMOOTHING_M = 0.5
SMOOTHING_PASSES = 3
"""Window of the mean that smooths the lead of the tyres' relaxation, and how often it is taken."""


class SlipFeedforward(NamedTuple):
    """By station: heading of the body relative to the path, curvature to steer, and its slope per metre of travel.

    `slip_curvature_1pm` is how much more curvature the wheels make than the body has.
    """

    heading_rad: tuple[float, ...]
    slip_curvature_1pm: tuple[float, ...]
    curvature_1pm: tuple[float, ...]
    slope_1pm2: tuple[float, ...]


def slip_feedforward(
    sigma: float,
    step_m: float,
    curvature_1pm: list[float],
    slope_1pm2: list[float],
    speed_mps: list[float],
    accel_mps2: list[float],
    car: dict[str, float],
) -> SlipFeedforward:
    """Return the slip feedforward of a leg in travel order.

    sigma is +1 forward and -1 in reverse; curvature is the body's, slope and speed are along travel. With v the
    travel speed, k the curvature and k' its slope: the rear axle's lateral acceleration is v^2 k, the yaw
    acceleration sigma (a k + v^2 k').
    """
    wheelbase_m = car["wheelbase_m"]
    to_rear_m = car["cg_to_rear_axle_m"]
    to_front_m = wheelbase_m - to_rear_m
    front = []
    rear = []
    for k, dk, v, a in zip(curvature_1pm, slope_1pm2, speed_mps, accel_mps2, strict=True):
        yaw_accel = sigma * (a * k + v * v * dk)
        lateral_n = car["mass_kg"] * (v * v * k + to_rear_m * yaw_accel)
        moment_nm = car["yaw_inertia_kgm2"] * yaw_accel
        front_rad = (lateral_n * to_rear_m + moment_nm) / (wheelbase_m * car["cornering_stiffness_front_n_per_rad"])
        rear_rad = (lateral_n * to_front_m - moment_nm) / (wheelbase_m * car["cornering_stiffness_rear_n_per_rad"])
        front.append(front_rad)
        rear.append(rear_rad)
    front, rear = (_relaxed(slip, step_m, car["relaxation_length_m"]) for slip in (front, rear))
    heading = [sigma * slip for slip in rear]
    slip = [sigma * (at_front - at_rear) / wheelbase_m for at_front, at_rear in zip(front, rear, strict=True)]
    turning = _slopes(heading, step_m)
    curvature = [k + more + sigma * turn for k, more, turn in zip(curvature_1pm, slip, turning, strict=True)]
    return SlipFeedforward(
        heading_rad=tuple(heading),
        slip_curvature_1pm=tuple(slip),
        curvature_1pm=tuple(curvature),
        slope_1pm2=tuple(_slopes(curvature, step_m)),
    )


def _relaxed(slip_rad: list[float], step_m: float, relaxation_length_m: float) -> list[float]:
    """Return the slip whose force, relaxing over the length, is that of the slip given.

    The lead is smoothed over SMOOTHING_M: the path's higher derivatives jump where its segments meet.
    """
    lead = [relaxation_length_m * change for change in _slopes(slip_rad, step_m)]
    for _ in range(SMOOTHING_PASSES):
        lead = _mean_over(lead, max(round(0.5 * SMOOTHING_M / step_m), 1))
    return [slip + ahead for slip, ahead in zip(slip_rad, lead, strict=True)]


def _mean_over(values: list[float], reach: int) -> list[float]:
    """Return the mean of each value and its neighbours as far as `reach` rows, fewer at the ends."""
    sums = [0.0, *accumulate(values)]
    last = len(values)
    means = []
    for row in range(last):
        low = max(row - reach, 0)
        high = min(row + reach + 1, last)
        means.append((sums[high] - sums[low]) / (high - low))
    return means


def _slopes(values: list[float], step_m: float) -> list[float]:
    """Return central differences, one-sided at the ends."""
    last = len(values) - 1
    slopes = []
    for row in range(last + 1):
        low = max(row - 1, 0)
        high = min(row + 1, last)
        slopes.append((values[high] - values[low]) / ((high - low) * step_m))
    return slopes
