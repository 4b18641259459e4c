"""The law of the paper at 100 Hz: disturbance observer Q/Gn and scheduled PID on the error at the preview point.

It tracks the centre of gravity and sees e_y alone, in the direction of travel. Per cycle, with y = e_y:

    u[k] = -(kp y + ki sum(y) T + kd (y - y[k-1]) / T) - (Q/Gn)(z) y + Q(z) u

Q is the paper's eq. 18 by zero-order hold, strictly proper, so that u on the right is a past one. Q/Gn is Q over the
zero-order-hold model of the kinematic plant: (z - 1)^2 / (gain (z - pole)), of which one difference goes into Q. Only
gain and pole depend on the speed; they and the PID come from tables indexed by (direction, speed). No latency and no
lag is in the nominal model: that is the paper's law, kept for comparison with it, not for driving.
"""

from collections.abc import Sequence
from typing import NamedTuple

from firmware_py.core.tables import Column

PERIOD_S = 0.01

# Columns of a row.
PREVIEW_M, KP, KI, KD, INVERSE_GAIN, INVERSE_POLE = range(6)
COLUMNS = 6

INTEGRAL_AUTHORITY_RAD = 0.2
"""Greatest angle that the integral part may ask for."""


class PaperTable(NamedTuple):
    """What the law knows: `row[direction][index][column]` over `speed_grid_mps`, and Q(z).

    Angles in rad, e_y in m. Q(z) = (q_b1 z + q_b2) / (z^2 + q_a1 z + q_a2). uses_pid, uses_observer: 1 or 0.
    """

    speed_grid_mps: Column
    last_row: int
    row: Sequence[Sequence[Column]]
    q_b1: float
    q_b2: float
    q_a1: float
    q_a2: float
    uses_pid: int
    uses_observer: int


class PaperRow(NamedTuple):
    """One row, interpolated; see the columns."""

    preview_m: float
    kp: float
    ki: float
    kd: float
    inverse_gain: float
    inverse_pole: float


class PaperState(NamedTuple):
    """What one cycle hands to the next: PID, differenced Q of e_y (two states), inverse, Q of the command (two)."""

    integral_ms: float
    last_error_m: float
    has_last: int
    filtered_1: float
    filtered_2: float
    inverse: float
    command_1: float
    command_2: float


def begin() -> PaperState:
    """Return the state at the begin of a leg."""
    return PaperState(0.0, 0.0, 0, 0.0, 0.0, 0.0, 0.0, 0.0)


def row_at(table: PaperTable, direction: int, travel_speed_mps: float) -> PaperRow:
    """Return the row for a direction index and a travel speed; held beyond the grid's ends."""
    grid = table.speed_grid_mps
    index = 0
    while index < table.last_row - 1 and grid[index + 1] < travel_speed_mps:
        index += 1
    b = (travel_speed_mps - grid[index]) / (grid[index + 1] - grid[index])
    b = max(min(b, 1.0), 0.0)
    a = 1.0 - b
    low = table.row[direction][index]
    high = table.row[direction][index + 1]
    return PaperRow(
        a * low[PREVIEW_M] + b * high[PREVIEW_M],
        a * low[KP] + b * high[KP],
        a * low[KI] + b * high[KI],
        a * low[KD] + b * high[KD],
        a * low[INVERSE_GAIN] + b * high[INVERSE_GAIN],
        a * low[INVERSE_POLE] + b * high[INVERSE_POLE],
    )


def step(
    table: PaperTable, state: PaperState, direction: int, travel_speed_mps: float, preview_error_m: float
) -> tuple[PaperState, float]:
    """Return the next state and the road-wheel angle (rad, left positive in travel) for an error (m, likewise)."""
    row = row_at(table, direction, travel_speed_mps)
    y = preview_error_m
    angle_rad = 0.0
    integral_ms = state.integral_ms
    if table.uses_pid != 0:
        slope_mps = 0.0
        if state.has_last != 0:
            slope_mps = (y - state.last_error_m) / PERIOD_S
        integral_ms += y * PERIOD_S
        if row.ki > 0.0:
            bound_ms = INTEGRAL_AUTHORITY_RAD / row.ki
            integral_ms = max(min(integral_ms, bound_ms), -bound_ms)
        angle_rad = -(row.kp * y + row.ki * integral_ms + row.kd * slope_mps)
    if table.uses_observer == 0:
        return PaperState(integral_ms, y, 1, 0.0, 0.0, 0.0, 0.0, 0.0), angle_rad
    # Differenced Q of e_y, transposed direct form II: numerator (q_b1 z + q_b2)(z - 1).
    difference = table.q_b1 * y + state.filtered_1
    filtered_1 = (table.q_b2 - table.q_b1) * y - table.q_a1 * difference + state.filtered_2
    filtered_2 = -table.q_b2 * y - table.q_a2 * difference
    # The rest of 1/Gn: (z - 1) / (z - pole).
    nominal_rad = row.inverse_gain * (difference + state.inverse)
    inverse = row.inverse_pole * state.inverse + (row.inverse_pole - 1.0) * difference
    angle_rad += state.command_1 - nominal_rad
    command_1 = table.q_b1 * angle_rad - table.q_a1 * state.command_1 + state.command_2
    command_2 = table.q_b2 * angle_rad - table.q_a2 * state.command_1
    return PaperState(integral_ms, y, 1, filtered_1, filtered_2, inverse, command_1, command_2), angle_rad
