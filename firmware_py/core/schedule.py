"""Gains and observer coefficients for the present (direction, speed), interpolated over speed."""

from typing import NamedTuple

from firmware_py.core.tables import (
    KD,
    KI,
    KP,
    L_BE,
    L_BP,
    L_DR,
    L_EE,
    L_EP,
    L_O,
    L_PE,
    L_PP,
    M_DE,
    M_DP,
    M_EE,
    M_EP,
    M_PE,
    M_PP,
    PREVIEW,
    GainTable,
)


class Gains(NamedTuple):
    """The gains of one cycle.

    kp is in 1/m^2 (curvature per metre of preview error), ki in 1/m^3, kd in 1/m (curvature per radian), preview in
    m. The rest is the estimator's, per 10 ms cycle: `offset` of the steering offset for the gap to the nominal
    actuator; `ee` to `pp` of (cross-track error: m, heading: rad) for innovations of both; `xe` and `xp` of what
    carries the heading wrong, the gyro's bias (rad/s) with the yaw rate, else the road disturbance (1/m); `dr` of the
    road disturbance for the gap between yaw rate and steering (1/m for a radian).
    """

    preview_m: float
    kp: float
    ki: float
    kd: float
    offset: float
    ee: float
    ep: float
    pe: float
    pp: float
    xe: float
    xp: float
    dr: float


def gains_at(table: GainTable, direction: int, travel_speed_mps: float, with_yaw_rate: int) -> Gains:
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
    if with_yaw_rate != 0:
        return Gains(
            a * low[PREVIEW] + b * high[PREVIEW],
            a * low[KP] + b * high[KP],
            a * low[KI] + b * high[KI],
            a * low[KD] + b * high[KD],
            a * low[L_O] + b * high[L_O],
            a * low[L_EE] + b * high[L_EE],
            a * low[L_EP] + b * high[L_EP],
            a * low[L_PE] + b * high[L_PE],
            a * low[L_PP] + b * high[L_PP],
            a * low[L_BE] + b * high[L_BE],
            a * low[L_BP] + b * high[L_BP],
            a * low[L_DR] + b * high[L_DR],
        )
    return Gains(
        a * low[PREVIEW] + b * high[PREVIEW],
        a * low[KP] + b * high[KP],
        a * low[KI] + b * high[KI],
        a * low[KD] + b * high[KD],
        a * low[L_O] + b * high[L_O],
        a * low[M_EE] + b * high[M_EE],
        a * low[M_EP] + b * high[M_EP],
        a * low[M_PE] + b * high[M_PE],
        a * low[M_PP] + b * high[M_PP],
        a * low[M_DE] + b * high[M_DE],
        a * low[M_DP] + b * high[M_DP],
        0.0,
    )
