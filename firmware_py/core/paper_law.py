"""The law of the paper at 100 Hz: disturbance observer Q/Gn and scheduled PID on the error at the preview point.

It tracks the centre of gravity and sees e_y alone, in the direction of travel. Per cycle, with y = e_y:

    u[k] = -(kp y + ki sum(y) T + kd (y - y[k-1]) / T) - (Q/Gn)(z) y + Q(z) u

Q is the paper's eq. 18 by zero-order hold, strictly proper, so that u on the right is a past one. Q/Gn is Q over the
zero-order-hold model of the kinematic plant: (z - 1)^2 / (gain (z - pole)), of which one difference goes into Q. Only
gain and pole depend on the speed; they and the PID come from tables indexed by (direction, speed). No latency and no
lag is in the nominal model: that is the paper's law, kept for comparison with it, not for driving.
"""

import math
from typing import NamedTuple

from firmware_py.core.limits import limit_angle
from firmware_py.core.path import wrap_angle
from firmware_py.core.tables import CarTable, LegTable, PaperTable, ReferencePath

PERIOD_S = 0.01

# Columns of a row.
PREVIEW_M, KP, KI, KD, INVERSE_GAIN, INVERSE_POLE = range(6)
COLUMNS = 6

INTEGRAL_AUTHORITY_RAD = 0.2
"""Greatest angle that the integral part may ask for."""

FOOT_POINT_ITERATIONS = 3
"""From a station that is a few centimetres off: what is left after two is below a micrometre."""


class PaperRow(NamedTuple):
    """One row, interpolated; see the columns."""

    preview_m: float
    kp: float
    ki: float
    kd: float
    inverse_gain: float
    inverse_pole: float


class Filters(NamedTuple):
    """What one cycle hands to the next: PID, differenced Q of e_y (two states), inverse, Q of the command (two)."""

    integral_ms: float
    last_error_m: float
    has_last: int
    filtered_1: float
    filtered_2: float
    inverse: float
    command_1: float
    command_2: float


class PaperState(NamedTuple):
    """The law's filters; the true errors, ISO 8855: of the centre of gravity (m), and of the body's heading (rad).

    The heading error is what is left of it beyond the side slip that a centre of gravity on the path has.
    """

    filters: Filters
    cross_track_error_m: float
    heading_error_rad: float


def clear() -> Filters:
    """Return the filters at the begin of a leg."""
    return Filters(0.0, 0.0, 0, 0.0, 0.0, 0.0, 0.0, 0.0)


def begin() -> PaperState:
    """Return the state at standstill."""
    return PaperState(clear(), 0.0, 0.0)


def steer(
    table: PaperTable,
    reference: ReferencePath,
    leg: LegTable,
    car: CarTable,
    state: PaperState,
    direction: int,
    travel_mps: float,
    station_m: float,
    x_m: float,
    y_m: float,
    yaw_rad: float,
    angle_meas_rad: float,
    sent_rad: float,
) -> tuple[PaperState, float]:
    """Return the next state and the wanted road-wheel angle for a pose of the rear axle, near a station.

    A car that stands is at the begin of a leg: it keeps its wheels (`angle_meas_rad`). The angle keeps to the car's
    limits from the last one sent, so that the observer knows what is really asked for.
    """
    if travel_mps <= 0.0:
        return begin(), angle_meas_rad
    ahead_x_m = x_m + reference.ahead_m * math.cos(yaw_rad)
    ahead_y_m = y_m + reference.ahead_m * math.sin(yaw_rad)
    cross_m, path_yaw_rad, slip_rad = foot_point(reference, leg, direction, station_m, ahead_x_m, ahead_y_m)
    preview_m = row_at(table, direction, travel_mps).preview_m
    # In travel: in reverse its left is the body's right; a heading error and a wheel turned left are the same in both.
    heading_rad = wrap_angle(yaw_rad - path_yaw_rad)
    error_m = leg.sigma * cross_m + preview_m * math.sin(heading_rad)
    filters, angle_rad = step(table, state.filters, car, direction, travel_mps, error_m, sent_rad)
    # Either way: in reverse with the sign that the paper prints the body slips to the other side.
    heading_rad -= max(min(heading_rad, abs(slip_rad)), -abs(slip_rad))
    return PaperState(filters, cross_m, heading_rad), angle_rad


def foot_point(
    reference: ReferencePath, leg: LegTable, direction: int, station_m: float, x_m: float, y_m: float
) -> tuple[float, float, float]:
    """Return how far a point is to the left of the reference's path (m), and the path's yaw and side slip there (rad).

    The side slip is the angle by which the body's yaw on the leg is less.
    """
    at = station_m / leg.step_m
    cross_m = 0.0
    path_yaw_rad = 0.0
    slip_rad = 0.0
    for _ in range(FOOT_POINT_ITERATIONS):
        row = max(min(math.floor(at), leg.last_row - 1), 0)
        b = at - row  # beyond the ends: straight on
        a = 1.0 - b
        xs = reference.x_m[direction]
        ys = reference.y_m[direction]
        dx_m = x_m - (a * xs[row] + b * xs[row + 1])
        dy_m = y_m - (a * ys[row] + b * ys[row + 1])
        b = max(min(b, 1.0), 0.0)
        path_yaw_rad = (1.0 - b) * reference.yaw_rad[direction][row] + b * reference.yaw_rad[direction][row + 1]
        slip_rad = path_yaw_rad - (1.0 - b) * leg.yaw_rad[row] - b * leg.yaw_rad[row + 1]
        c = math.cos(path_yaw_rad)
        s = math.sin(path_yaw_rad)
        cross_m = dy_m * c - dx_m * s
        at += leg.sigma * (dx_m * c + dy_m * s) / leg.step_m
    return cross_m, path_yaw_rad, slip_rad


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
    table: PaperTable,
    state: Filters,
    car: CarTable,
    direction: int,
    travel_speed_mps: float,
    preview_error_m: float,
    sent_rad: float,
) -> tuple[Filters, float]:
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
        return Filters(integral_ms, y, 1, 0.0, 0.0, 0.0, 0.0, 0.0), angle_rad
    # Differenced Q of e_y, transposed direct form II: numerator (q_b1 z + q_b2)(z - 1).
    difference = table.q_b1 * y + state.filtered_1
    filtered_1 = (table.q_b2 - table.q_b1) * y - table.q_a1 * difference + state.filtered_2
    filtered_2 = -table.q_b2 * y - table.q_a2 * difference
    # The rest of 1/Gn: (z - 1) / (z - pole).
    nominal_rad = row.inverse_gain * (difference + state.inverse)
    inverse = row.inverse_pole * state.inverse + (row.inverse_pole - 1.0) * difference
    angle_rad += state.command_1 - nominal_rad
    angle_rad, _ = limit_angle(car, angle_rad, sent_rad, PERIOD_S)
    command_1 = table.q_b1 * angle_rad - table.q_a1 * state.command_1 + state.command_2
    command_2 = table.q_b2 * angle_rad - table.q_a2 * state.command_1
    return Filters(integral_ms, y, 1, filtered_1, filtered_2, inverse, command_1, command_2), angle_rad
