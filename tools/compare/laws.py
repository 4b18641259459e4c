"""The steering laws that people use, in their textbook form, for a path of the rear axle driven in both directions.

One function, `steer`, with `math` only, so that it runs plain and compiled. All laws are given the same: the path's
table with its feedforward (tyre slip included), the pose's errors on it, the measured speed and yaw rate. What they
return is the road-wheel angle that they want; limits and all else are the loop's (`tools.compare.steered`).

Sign convention: cross-track error e of the rear axle and heading error psi of the body against the path, left positive;
curvature c is the body's; sigma = +1 forward, -1 in reverse. Per metre of travel

    de = sigma sin(psi),    d(sigma psi) = c - k

so with theta = sigma psi every law on (e, theta) is the same in both directions. Where a textbook has a forward law
alone, its reverse form is derived from these two equations.
"""

import math
from collections.abc import Callable, MutableSequence, Sequence
from typing import NamedTuple

from firmware_py.core.path import feedforward_curvature_1pm, pose_at, wrap_angle
from firmware_py.core.tables import CarTable, LegTable

PERIOD_S = 0.01

CAR, FF, PURE_PURSUIT, STANLEY, REAR_WHEEL, LQR, LQR_PREVIEW, MPC, PID, PID_FF, DOB_PID = range(11)

Solve = Callable[[float, float, float, float, float, float, float], float]

MPC_ARGUMENTS = 7
"""Of `Solve`: sigma, station (m), speed (m/s), cross-track error (m), theta (rad), wheels' angle (rad) and last command
(rad); it returns the command (rad)."""

PREVIEW_CYCLES = 60
"""Cycles of path ahead that the LQR with preview sees."""

FIRST_SPEED_MPS = 0.05
"""Of the gain tables' rows, which are so far apart too."""

PREVIEW_S = 0.5
"""Preview of the PID laws' error in seconds of travel, as in the project's own laws."""

DOB_PREVIEW_M = 0.5
INTEGRAL_AUTHORITY_1PM = 0.02
DISTURBANCE_MAX_1PM = 0.05

# Slots of a law's memory.
STARTED, INTEGRAL_M2, MODEL_RAD, ERROR_LOW_M, SLOPE_LOW, INPUT_LOW_1PM = range(6)
LAW_SLOTS = 6


class Seen(NamedTuple):
    """What a law is told in a cycle.

    The pose of the rear axle and where it lies on the path: as the newest report has it, or the estimator's. `ahead_*`:
    the same at the instant at which this cycle's command begins to act, with the wheels' angle then (disturbance
    included). `acted_rad` is the command that acts on the nominal steering at the instant of the pose, `command_rad`
    the last one, both with the known disturbance included. `ds_m` is the way since the last cycle.
    """

    x_m: float
    y_m: float
    yaw_rad: float
    station_m: float
    cross_m: float
    heading_rad: float
    ahead_station_m: float
    ahead_cross_m: float
    ahead_heading_rad: float
    ahead_angle_rad: float
    travel_mps: float
    ds_m: float
    yaw_rate_radps: float
    acted_rad: float
    command_rad: float
    limited: int


def on_path(leg: LegTable, near_m: float, x_m: float, y_m: float, yaw_rad: float) -> tuple[float, float, float]:
    """Return station (m), cross-track error (m) and heading error (rad) of a pose, from a station near it."""
    station_m = near_m
    cross_m = 0.0
    heading_rad = 0.0
    for _ in range(3):
        path_x_m, path_y_m, path_yaw_rad, slip_rad, _slip_1pm = pose_at(leg, station_m)
        dx_m = x_m - path_x_m
        dy_m = y_m - path_y_m
        cos_yaw = math.cos(path_yaw_rad)
        sin_yaw = math.sin(path_yaw_rad)
        station_m += leg.sigma * (dx_m * cos_yaw + dy_m * sin_yaw)
        cross_m = dy_m * cos_yaw - dx_m * sin_yaw
        heading_rad = wrap_angle(yaw_rad - path_yaw_rad - slip_rad)
    return station_m, cross_m, heading_rad


def steer(
    law: int,
    p: Sequence[float],
    table: Sequence[Sequence[float]],
    leg: LegTable,
    car: CarTable,
    seen: Seen,
    memory: MutableSequence[float],
    solve: Solve,
) -> float:
    """Return the wanted road-wheel angle (rad).

    `p`: the law's tuned numbers; `table`: its gains by speed, if it has any; `memory`: LAW_SLOTS numbers, all 0 at
    the beginning of a leg; `solve` is called by the MPC.
    """
    if law == FF:
        return _feedforward_rad(leg, car, seen, p[0])
    if law == PURE_PURSUIT:
        return pure_pursuit_rad(leg, car, seen, p[0], p[1])
    if law == STANLEY:
        return stanley_rad(leg, car, seen, p[0], p[1], p[2], p[3])
    if law == REAR_WHEEL:
        return rear_wheel_rad(leg, car, seen, p[0], p[1])
    if law == LQR:
        return lqr_rad(table, leg, car, seen)
    if law == LQR_PREVIEW:
        return lqr_preview_rad(table, leg, car, seen)
    if law == MPC:
        return solve(
            leg.sigma,
            seen.ahead_station_m,
            seen.travel_mps,
            seen.ahead_cross_m,
            leg.sigma * seen.ahead_heading_rad,
            seen.ahead_angle_rad,
            seen.command_rad,
        )
    if law == PID:
        correction = _pid_1pm(seen, leg.sigma, p[0], p[1], p[2], memory)
        return math.atan(-car.wheelbase_m * correction)
    if law == PID_FF:
        correction = _pid_1pm(seen, leg.sigma, p[0], p[1], p[2], memory)
        return _angle_rad(leg, car, seen, p[3], correction)
    correction = _dob_1pm(leg, car, seen, p[2], memory) + _pid_1pm(seen, leg.sigma, p[0], 0.0, p[1], memory)
    return _angle_rad(leg, car, seen, p[3], correction)


def _angle_rad(leg: LegTable, car: CarTable, seen: Seen, ahead_s: float, correction_1pm: float) -> float:
    """Return the angle for the path's curvature at a preview time, less a correction."""
    curvature_1pm = feedforward_curvature_1pm(leg, seen.station_m + ahead_s * seen.travel_mps)
    return math.atan(car.wheelbase_m * (curvature_1pm - correction_1pm))


def _feedforward_rad(leg: LegTable, car: CarTable, seen: Seen, ahead_s: float) -> float:
    """Feedforward alone: the angle that the path asks for, `ahead_s` of travel ahead."""
    return _angle_rad(leg, car, seen, ahead_s, 0.0)


def pure_pursuit_rad(leg: LegTable, car: CarTable, seen: Seen, least_m: float, ahead_s: float) -> float:
    """Pure pursuit (Coulter 1992, CMU-RI-TR-92-01): the circle through a goal point on the path, tangent to the course.

    A circle of body curvature c through the rear axle that touches the course has y = c (x^2 + y^2) / 2 in the body's
    frame, before it and behind it: in reverse the goal point lies behind and the formula stays. The goal's distance
    grows with speed. Course and wheels differ from the body by the path's tyre slip.
    """
    station_m = seen.station_m + least_m + ahead_s * seen.travel_mps
    goal_x_m, goal_y_m, _yaw_rad, _slip_rad, _slip_1pm = pose_at(leg, station_m)
    _x_m, _y_m, _yaw_rad, slip_rad, slip_1pm = pose_at(leg, seen.station_m)
    course_rad = seen.yaw_rad - slip_rad
    dx_m = goal_x_m - seen.x_m
    dy_m = goal_y_m - seen.y_m
    aside_m = math.cos(course_rad) * dy_m - math.sin(course_rad) * dx_m
    curvature_1pm = 2.0 * aside_m / max(dx_m * dx_m + dy_m * dy_m, 1e-6)
    return math.atan(car.wheelbase_m * (curvature_1pm + slip_1pm))


def stanley_rad(
    leg: LegTable, car: CarTable, seen: Seen, k_1ps: float, k_reverse_1ps: float, soft_mps: float, k_yaw_s: float
) -> float:
    """Stanley's law (Hoffmann, Tomlin, Montemerlo, Thrun, ACC 2007, eq. 5 and 9), with softening speed and yaw damping.

    Forward: the front wheels point along the path's tangent at the front axle, turned towards it by atan(k e / v). The
    path is one of the rear axle, so the front axle's is what it draws meanwhile: p + L (cos yaw, sin yaw), tangent
    yaw + atan(L k); on it the law needs no feedforward of its own.

    Reverse: with the same law the front axle would converge and the body turn away from behind it (psi grows as
    exp(s / L)). The axle that leads is the rear one; asking of theta what the law asks of the front wheels, so
    d(theta) = -(theta + atan(k e / v)) / L, gives angle = atan(L k) - theta - atan(k e / v), stable in both directions
    (poles of s^2 + s / L + k / (v L)).
    """
    speed_mps = soft_mps + seen.travel_mps
    here_1pm = feedforward_curvature_1pm(leg, seen.station_m)
    damping_rad = leg.sigma * k_yaw_s * (seen.yaw_rate_radps - leg.sigma * seen.travel_mps * here_1pm)
    if leg.sigma < 0.0:
        return (
            math.atan(car.wheelbase_m * here_1pm)
            - leg.sigma * seen.heading_rad
            - math.atan(k_reverse_1ps * seen.cross_m / speed_mps)
            - damping_rad
        )
    length_m = car.wheelbase_m
    front_x_m = seen.x_m + length_m * math.cos(seen.yaw_rad)
    front_y_m = seen.y_m + length_m * math.sin(seen.yaw_rad)
    station_m = seen.station_m
    error_m = 0.0
    tangent_rad = 0.0
    for _ in range(3):
        x_m, y_m, yaw_rad, slip_rad, _slip_1pm = pose_at(leg, station_m)
        body_rad = yaw_rad + slip_rad
        steered = length_m * feedforward_curvature_1pm(leg, station_m)
        tangent_rad = body_rad + math.atan(steered)
        dx_m = front_x_m - x_m - length_m * math.cos(body_rad)
        dy_m = front_y_m - y_m - length_m * math.sin(body_rad)
        along_m = dx_m * math.cos(tangent_rad) + dy_m * math.sin(tangent_rad)
        error_m = dy_m * math.cos(tangent_rad) - dx_m * math.sin(tangent_rad)
        station_m += along_m / math.sqrt(1.0 + steered * steered)
    return wrap_angle(tangent_rad - seen.yaw_rad) - math.atan(k_1ps * error_m / speed_mps) - damping_rad


def rear_wheel_rad(leg: LegTable, car: CarTable, seen: Seen, k_e_1pm2: float, k_theta_1pm: float) -> float:
    """Rear-wheel feedback (Samson 1992; Paden et al. 2016, IEEE T-IV 1(1), eq. 23).

    omega = v k cos(psi) / (1 - k e) - k_theta |v| psi - k_e v sin(psi) / psi e; over the signed v it is the curvature
    c = k cos(psi) / (1 - k e) - k_theta theta - k_e sin(psi) / psi e, for both directions.
    """
    curvature_1pm = feedforward_curvature_1pm(leg, seen.station_m)
    heading = seen.heading_rad
    share = 1.0
    if abs(heading) > 1e-6:
        share = math.sin(heading) / heading
    wanted_1pm = (
        curvature_1pm * math.cos(heading) / max(1.0 - curvature_1pm * seen.cross_m, 0.2)
        - k_theta_1pm * leg.sigma * heading
        - k_e_1pm2 * share * seen.cross_m
    )
    return math.atan(car.wheelbase_m * wanted_1pm)


def _row(table: Sequence[Sequence[float]], speed_mps: float) -> tuple[int, float]:
    at = max(speed_mps / FIRST_SPEED_MPS - 1.0, 0.0)
    row = min(math.floor(at), len(table) - 2)
    return row, min(at - row, 1.0)


def lqr_rad(table: Sequence[Sequence[float]], leg: LegTable, car: CarTable, seen: Seen) -> float:
    """LQR on (e, theta) with the path's curvature fed forward (Snider 2009, CMU-RI-TR-09-08, sections 5 and 6).

    The kinematic model knows neither lag nor latency. A table's row: K of e, K of theta.
    """
    row, b = _row(table, seen.travel_mps)
    k_e = (1.0 - b) * table[row][0] + b * table[row + 1][0]
    k_theta = (1.0 - b) * table[row][1] + b * table[row + 1][1]
    correction_1pm = k_e * seen.cross_m + k_theta * leg.sigma * seen.heading_rad
    return _angle_rad(leg, car, seen, 0.0, correction_1pm)


def lqr_preview_rad(table: Sequence[Sequence[float]], leg: LegTable, car: CarTable, seen: Seen) -> float:
    """LQR that knows lag and latency, with preview of the path (Tomizuka 1975; Sharp, Valtetsiotis 2001).

    State: e, theta and the wheels' curvature less the path's, predicted over the latency; input: the commanded
    curvature less the path's; known disturbance: the steps of the path's curvature, cycle by cycle ahead. A table's
    row: K of the three, then the gains of the steps ahead.
    """
    row, b = _row(table, seen.travel_mps)
    low = table[row]
    high = table[row + 1]
    a = 1.0 - b
    # Half a cycle on: the command holds over one.
    ds_m = seen.travel_mps * PERIOD_S
    station_m = seen.ahead_station_m + 0.85 * ds_m
    here_1pm = feedforward_curvature_1pm(leg, station_m)
    wheels_1pm = math.tan(seen.ahead_angle_rad) / car.wheelbase_m
    correction_1pm = (
        (a * low[0] + b * high[0]) * seen.ahead_cross_m
        + (a * low[1] + b * high[1]) * leg.sigma * seen.ahead_heading_rad
        + (a * low[2] + b * high[2]) * (wheels_1pm - here_1pm)
    )
    last_1pm = here_1pm
    for index in range(PREVIEW_CYCLES):
        next_1pm = feedforward_curvature_1pm(leg, station_m + (index + 1) * ds_m)
        correction_1pm += (a * low[3 + index] + b * high[3 + index]) * (next_1pm - last_1pm)
        last_1pm = next_1pm
    return math.atan(car.wheelbase_m * (here_1pm - correction_1pm))


def _pid_1pm(seen: Seen, sigma: float, kp: float, ki: float, kd: float, memory: MutableSequence[float]) -> float:
    """PID per metre of travel on e + 0.5 s V theta; theta is the derivative of e. The integral stops at the limits."""
    theta_rad = sigma * math.sin(seen.heading_rad)
    preview_m = seen.cross_m + PREVIEW_S * seen.travel_mps * theta_rad
    if seen.limited == 0 and ki > 0.0:
        bound_m2 = INTEGRAL_AUTHORITY_1PM / ki
        memory[INTEGRAL_M2] = max(min(memory[INTEGRAL_M2] + preview_m * seen.ds_m, bound_m2), -bound_m2)
    return kp * preview_m + ki * memory[INTEGRAL_M2] + kd * theta_rad


def _dob_1pm(leg: LegTable, car: CarTable, seen: Seen, length_m: float, memory: MutableSequence[float]) -> float:
    """Disturbance observer Q / Gn per metre of travel: the curvature by which the car turns as if steered otherwise.

    On y = e + l theta the plant is Gn = (l s + 1) / s^2 from curvature to y, minimum phase in both directions. With
    Q = 1 / (L s + 1): d = s^2 / ((L s + 1)(l s + 1)) y - Q (c - k), where c is what the nominal steering, its lag and
    its latency make of the commands (and the pose's latency for a late pose).
    """
    y_m = seen.cross_m + DOB_PREVIEW_M * leg.sigma * math.sin(seen.heading_rad)
    limit_rad = car.max_road_wheel_rate_radps * PERIOD_S
    if memory[STARTED] == 0.0:
        memory[STARTED] = 1.0
        memory[MODEL_RAD] = seen.acted_rad
        memory[ERROR_LOW_M] = y_m
    change_rad = car.lag_alpha * (seen.acted_rad - memory[MODEL_RAD])
    memory[MODEL_RAD] += max(min(change_rad, limit_rad), -limit_rad)
    input_1pm = math.tan(memory[MODEL_RAD]) / car.wheelbase_m - feedforward_curvature_1pm(leg, seen.station_m)
    share = 1.0 - math.exp(-seen.ds_m / length_m)
    memory[ERROR_LOW_M] += share * (y_m - memory[ERROR_LOW_M])
    slope = (y_m - memory[ERROR_LOW_M]) / length_m
    memory[SLOPE_LOW] += (1.0 - math.exp(-seen.ds_m / DOB_PREVIEW_M)) * (slope - memory[SLOPE_LOW])
    memory[INPUT_LOW_1PM] += share * (input_1pm - memory[INPUT_LOW_1PM])
    disturbance_1pm = (slope - memory[SLOPE_LOW]) / DOB_PREVIEW_M - memory[INPUT_LOW_1PM]
    return max(min(disturbance_1pm, DISTURBANCE_MAX_1PM), -DISTURBANCE_MAX_1PM)
