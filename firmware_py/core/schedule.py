"""Gains and the estimator's coefficients for the present (direction, speed), interpolated over speed."""

from typing import NamedTuple

from firmware_py.core.tables import KD, KI, KP, L_DR, L_G, L_O, PREVIEW, W_D, W_E, W_P, GainTable


class Gains(NamedTuple):
    """The gains of one cycle.

    kp is in 1/m^2 (curvature per metre of preview error), ki in 1/m^3, kd in 1/m (curvature per radian), preview in
    m. The rest is the estimator's, for a 10 ms cycle: what the steering's `offset` and, at a large angle, its `gain`
    take of the gap to the nominal actuator, and `dr` the road disturbance of the gap between yaw rate and steering (1/m
    for a radian); without the yaw rate `*_walk`, noise of cross-track error (m), heading (rad) and road disturbance
    (1/m) per root metre of travel.
    """

    preview_m: float
    kp: float
    ki: float
    kd: float
    offset: float
    gain: float
    dr: float
    cross_walk: float
    heading_walk: float
    road_walk: float


def gains_at(table: GainTable, direction: int, travel_speed_mps: float) -> Gains:
    """Return the gains for a direction index and a travel speed; held beyond the grid's ends."""
    grid = table.speed_grid_mps
    # The first row whose upper end is not below the speed, by halving.
    row = 0
    highest = table.last_row - 1
    while row < highest:
        middle = (row + highest) // 2
        if grid[middle + 1] < travel_speed_mps:
            row = middle + 1
        else:
            highest = middle
    low_mps = grid[row]
    b = (travel_speed_mps - low_mps) / (grid[row + 1] - low_mps)
    if b > 1.0:
        b = 1.0
    if b < 0.0:
        b = 0.0
    a = 1.0 - b
    low = table.gain[direction][row]
    high = table.gain[direction][row + 1]
    return Gains(
        a * low[PREVIEW] + b * high[PREVIEW],
        a * low[KP] + b * high[KP],
        a * low[KI] + b * high[KI],
        a * low[KD] + b * high[KD],
        a * low[L_O] + b * high[L_O],
        a * low[L_G] + b * high[L_G],
        a * low[L_DR] + b * high[L_DR],
        a * low[W_E] + b * high[W_E],
        a * low[W_P] + b * high[W_P],
        a * low[W_D] + b * high[W_D],
    )
