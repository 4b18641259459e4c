"""Gains and observer coefficients for the present (direction, speed), interpolated over speed."""

from typing import NamedTuple

from firmware_py.core.tables import (
    KD,
    KI,
    KP,
    L_DE,
    L_DP,
    L_EE,
    L_EP,
    L_PE,
    L_PP,
    PREVIEW,
    GainTable,
)


class Gains(NamedTuple):
    """One row of the schedule.

    kp is in 1/m^2 (curvature per metre of preview error), ki in 1/m^3, kd in 1/m (curvature per radian), preview in
    m. The l_* are observer corrections per 10 ms cycle of (e: m, p: heading rad, d: 1/m) for innovations of (e, p).
    """

    preview_m: float
    kp: float
    ki: float
    kd: float
    l_ee: float
    l_ep: float
    l_pe: float
    l_pp: float
    l_de: float
    l_dp: float


def gains_at(table: GainTable, direction: int, travel_speed_mps: float) -> Gains:
    """Return the gains for a direction index and a travel speed (never negative); held beyond the grid's ends."""
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
    b = max(min(b, 1.0), 0.0)
    a = 1.0 - b
    low = table.gain[direction][row]
    high = table.gain[direction][row + 1]
    return Gains(
        a * low[PREVIEW] + b * high[PREVIEW],
        a * low[KP] + b * high[KP],
        a * low[KI] + b * high[KI],
        a * low[KD] + b * high[KD],
        a * low[L_EE] + b * high[L_EE],
        a * low[L_EP] + b * high[L_EP],
        a * low[L_PE] + b * high[L_PE],
        a * low[L_PP] + b * high[L_PP],
        a * low[L_DE] + b * high[L_DE],
        a * low[L_DP] + b * high[L_DP],
    )
