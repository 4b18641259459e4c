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
    Column,
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


def _between(low: Column, high: Column, b: float, column: int) -> float:
    return (1.0 - b) * low[column] + b * high[column]


def gains_at(table: GainTable, direction: int, travel_speed_mps: float) -> Gains:
    """Return the gains for a direction index and a travel speed (never negative); held beyond the grid's ends."""
    row = 0
    while row < table.last_row - 1 and table.speed_grid_mps[row + 1] < travel_speed_mps:
        row += 1
    low_mps = table.speed_grid_mps[row]
    b = (travel_speed_mps - low_mps) / (table.speed_grid_mps[row + 1] - low_mps)
    b = max(min(b, 1.0), 0.0)
    low = table.gain[direction][row]
    high = table.gain[direction][row + 1]
    return Gains(
        preview_m=_between(low, high, b, PREVIEW),
        kp=_between(low, high, b, KP),
        ki=_between(low, high, b, KI),
        kd=_between(low, high, b, KD),
        l_ee=_between(low, high, b, L_EE),
        l_ep=_between(low, high, b, L_EP),
        l_pe=_between(low, high, b, L_PE),
        l_pp=_between(low, high, b, L_PP),
        l_de=_between(low, high, b, L_DE),
        l_dp=_between(low, high, b, L_DP),
    )
