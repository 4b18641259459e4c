"""A second search for the clearest path, independent of the first: to find out what that one leaves on the table.

Nothing is shared with `optimise` but the files of car and course. The path is y(x): four polynomials of order 6 over
segments of x, held together by their own null space, with cuts anywhere; no waypoints, no fit. The problem is solved as
a constrained one (largest clearance subject to the road-wheel angle) by sequential quadratic programming, from random
shapes, with distances and curvature computed here.
"""

import math
from typing import NamedTuple

import numpy as np

from sim.data_files import Course, Vehicle
from tools.design.waypoints import Floats

ORDER, SEGMENTS, SMOOTH = 6, 4, 3
POSES = 260
"""Poses of the search, at even steps of x; the result is checked on four times as many."""

LEAST_SEGMENT = 0.05
"""Share of the way that every segment keeps."""

ITERATIONS = 120


class FinerPath(NamedTuple):
    """What a start came to: clearance (m) and road-wheel angle (rad) on the fine grid."""

    clearance_m: float
    max_road_wheel_angle_rad: float


class _Space(NamedTuple):
    """All y(x) of the family for one choice of cuts: coefficients = fixed + free @ z, in powers of x - border."""

    border: Floats
    fixed: Floats
    free: Floats


def clearest(
    vehicle: Vehicle, course: Course, angle_rad: float, *, starts: int, seed: int = 1, mirrors: bool = True
) -> FinerPath:
    """Return the clearest path that so many random starts lead to, within a road-wheel angle; deterministic by seed.

    mirrors: whether they belong to the outline.
    """
    rng = np.random.default_rng(seed)
    best = FinerPath(-math.inf, 0.0)
    for _ in range(starts):
        found = _from(vehicle, course, angle_rad, rng, mirrors)
        if found.max_road_wheel_angle_rad <= angle_rad + 1e-3 and found.clearance_m > best.clearance_m:
            best = found
    return best


def _from(vehicle: Vehicle, course: Course, angle_rad: float, rng: np.random.Generator, mirrors: bool) -> FinerPath:
    from scipy.optimize import minimize  # noqa: PLC0415 -- heavy

    start, stop = course.start_pose(vehicle), course.stop_pose(vehicle)
    ahead_m, aside_m = stop.x_m - start.x_m, stop.y_m - start.y_m
    cones = np.array(course.cones_xy()) - np.array([start.x_m, start.y_m])
    outlines = _rectangles(vehicle, mirrors)
    shares = np.clip(0.25 + 0.04 * rng.standard_normal(SEGMENTS), 0.15, 0.4)
    shares = shares / shares.sum()
    centre, half = ahead_m * (0.60 + 0.06 * rng.standard_normal()), ahead_m * (0.26 + 0.03 * rng.standard_normal())
    x = np.linspace(0.0, ahead_m, POSES)
    ramp = np.clip((x - centre + half) / (2.0 * half), 0.0, 1.0)
    wanted = aside_m * ramp**3 * (10.0 - 15.0 * ramp + 6.0 * ramp * ramp)
    first = _space(shares, ahead_m, aside_m)
    z = np.linalg.lstsq(_rows(first.border, x, 0) @ first.free, wanted - _rows(first.border, x, 0) @ first.fixed)[0]
    # In units of metres: each direction of the null space moves the path by about as much.
    unit = 1.0 / np.abs(_rows(first.border, x, 0) @ first.free).max(axis=0)

    def parts(point: Floats, at: Floats) -> tuple[Floats, Floats]:
        lengths = np.array([*point[: SEGMENTS - 1], 1.0 - point[: SEGMENTS - 1].sum()])
        space = _space(lengths, ahead_m, aside_m, first.free)
        coefficients = space.fixed + space.free @ (unit * point[SEGMENTS - 1 : -1])
        y, slope, bend = (_rows(space.border, at, order) @ coefficients for order in range(3))
        curvature = bend / (1.0 + slope * slope) ** 1.5
        yaw = np.arctan(slope)
        return _distances(outlines, at, y, yaw, cones), curvature

    most_1pm = math.tan(angle_rad) / vehicle.wheelbase_m

    def constraints(point: Floats) -> Floats:
        distance, curvature = parts(point, x)
        return np.concatenate([distance - point[-1], 1.0 - (curvature / most_1pm) ** 2])

    point = np.array([*shares[:-1], *(z / unit), 0.0])
    point[-1] = parts(point, x)[0].min()
    goal = np.zeros(len(point))
    goal[-1] = -1.0
    low, high = [LEAST_SEGMENT] * (SEGMENTS - 1), [0.6] * (SEGMENTS - 1)
    answer = minimize(
        lambda p: -p[-1],
        point,
        jac=lambda _: goal,
        method="SLSQP",
        bounds=[*zip(low, high, strict=True), *[(None, None)] * (len(point) - SEGMENTS + 1)],
        constraints=[
            {"type": "ineq", "fun": constraints},
            {"type": "ineq", "fun": lambda p: 1.0 - LEAST_SEGMENT - p[: SEGMENTS - 1].sum()},
        ],
        options={"maxiter": ITERATIONS, "ftol": 1e-7},
    )
    distance, curvature = parts(answer.x, np.linspace(0.0, ahead_m, 4 * POSES))
    lengths = np.array([*answer.x[: SEGMENTS - 1], 1.0 - answer.x[: SEGMENTS - 1].sum()])
    if not answer.success or lengths.min() < 0.9 * LEAST_SEGMENT:
        return FinerPath(-math.inf, 0.0)  # cut off in the middle of a step: no path
    return FinerPath(float(distance.min()), float(np.arctan(vehicle.wheelbase_m * np.abs(curvature).max())))


def _rows(border: Floats, x: Floats, order: int) -> Floats:
    """Rows that give the derivative of an order at x from all coefficients; shape (n, SEGMENTS * (ORDER + 1))."""
    segment = np.clip(np.searchsorted(border, x, side="right") - 1, 0, SEGMENTS - 1)
    rows = np.zeros((len(x), SEGMENTS, ORDER + 1))
    along = x - border[segment]
    for power in range(order, ORDER + 1):
        rows[np.arange(len(x)), segment, power] = math.perm(power, order) * along ** (power - order)
    return rows.reshape(len(x), -1)


def _space(shares: Floats, ahead_m: float, aside_m: float, like: Floats | None = None) -> _Space:
    """Return the family for segments of such shares. like: a basis to stay near to, so that it moves smoothly."""
    border = np.concatenate([[0.0], np.cumsum(shares)]) * ahead_m
    joints = []
    for joint in range(1, SEGMENTS):
        for order in range(SMOOTH + 1):
            row = np.zeros((SEGMENTS, ORDER + 1))
            length = border[joint] - border[joint - 1]
            for power in range(order, ORDER + 1):
                row[joint - 1, power] = math.perm(power, order) * length ** (power - order)
            row[joint, order] = -math.factorial(order)
            joints.append(row.ravel())
    ends = [_rows(border, np.array([at]), order)[0] for at in (0.0, ahead_m) for order in range(3)]
    conditions = np.array(joints + ends)
    target = np.zeros(len(conditions))
    target[len(joints) + 3] = aside_m
    fixed = np.linalg.lstsq(conditions, target)[0]
    rank = len(conditions)
    free = np.linalg.svd(conditions)[2][rank:].T
    if like is not None:
        free = free @ (free.T @ like)
    return _Space(border, fixed, free)


def _rectangles(vehicle: Vehicle, mirrors: bool) -> list[tuple[float, float, float]]:
    """Rear end, front end and half width of the body and of the mirrors, from the rear axle."""
    front_m = vehicle.wheelbase_m + vehicle.front_overhang_m
    found = [(-vehicle.rear_overhang_m, front_m, 0.5 * vehicle.body_width_m)]
    if mirrors and vehicle.mirror_width_m > vehicle.body_width_m:
        at = vehicle.mirror_from_rear_axle_m
        found.append((at - 0.1, at + 0.1, 0.5 * vehicle.mirror_width_m))
    return found


def _distances(
    rectangles: list[tuple[float, float, float]], x: Floats, y: Floats, yaw: Floats, cones: Floats
) -> Floats:
    """Signed distance of the nearest cone's axis to the outline at each pose."""
    turn = np.exp(-1j * yaw)
    seen = ((cones[:, 0] + 1j * cones[:, 1])[None, :] - (x + 1j * y)[:, None]) * turn[:, None]
    nearest = np.full(len(x), np.inf)
    for rear, front, half in rectangles:
        across = np.abs(seen.imag) - half
        along = np.abs(seen.real - 0.5 * (rear + front)) - 0.5 * (front - rear)
        outside = np.hypot(np.maximum(across, 0.0), np.maximum(along, 0.0))
        nearest = np.minimum(nearest, (outside + np.minimum(np.maximum(across, along), 0.0)).min(axis=1))
    return nearest
