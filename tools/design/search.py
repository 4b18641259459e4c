"""The local search for a path: a minimax problem, solved as such by linear programmes.

Cost = - clearance + price * largest slope of the road-wheel angle + penalty * angle beyond the wanted one. It is smooth
but for its maxima; each step is a linear programme over what the path is near to (poses, cones, slopes, angles) inside
a box that grows and shrinks with success. No part of it is random.
"""

from typing import NamedTuple

import numpy as np

from sim.body import clearance_array_m, outline_of
from sim.data_files import Course, Vehicle
from sim.errors import UserError
from tools.design.families import Family, fit_waypoints
from tools.design.path import coarse
from tools.design.path_fit import FitResult
from tools.design.waypoints import Floats

SEARCH_STEP_M = 0.05
"""Distance of the poses at which the search judges a path, which is good to 1 mm of clearance; the result is checked on
the fine grid."""

_ANGLE_PENALTY_M = 10.0
"""Clearance that a radian beyond the wanted angle costs: more than any path can win by it."""

REFUSED_M = 100.0


class View(NamedTuple):
    """A path as the search sees it: distances (pose, cone) of body with mirrors and of the body alone, slope, angle."""

    clearance_m: Floats
    body_clearance_m: Floats
    slope_radpm: Floats
    angle_rad: Floats


class Judge:
    """The cost of a path for a car on a course.

    angle_rad: road-wheel angle that the path may use; slope_price_m: clearance (m) that a rad/m of steering slope must
    buy. Mirrors count half: where they stand out, clearance is the mean of that with them and that of the body alone.
    """

    def __init__(self, vehicle: Vehicle, course: Course, angle_rad: float, slope_price_m: float) -> None:
        self.vehicle = vehicle
        self.course = course
        self.angle_rad = angle_rad
        self.price_m = slope_price_m
        self.outline = outline_of(vehicle)
        self.body = self.outline._replace(mirror_half_width_m=self.outline.half_width_m)
        self.cones = course.cones_xy()

    def view(self, fit: FitResult) -> View:
        """Return what the search needs of a path."""
        points = coarse(fit, SEARCH_STEP_M)
        pose = (points.x_m, points.y_m, points.yaw_rad)
        body = clearance_array_m(self.body, *pose, self.cones).ravel()
        whole = body
        if self.body != self.outline:
            whole = clearance_array_m(self.outline, *pose, self.cones).ravel()
        bend = self.vehicle.wheelbase_m * points.curvature_1pm
        slope = self.vehicle.wheelbase_m * points.curvature_slope_1pm2 / (1.0 + bend * bend)
        return View(whole, body, slope, np.asarray(np.arctan(bend)))

    def cost_of(self, view: View) -> float:
        """Return the cost in metres of clearance."""
        beyond_rad = max(0.0, float(np.abs(view.angle_rad).max()) - self.angle_rad)
        slope = float(np.abs(view.slope_radpm).max())
        clearance_m = 0.5 * float(view.clearance_m.min() + view.body_clearance_m.min())
        return -clearance_m + self.price_m * slope + _ANGLE_PENALTY_M * beyond_rad

    def cost(self, family: Family, numbers: Floats) -> float:
        """Return the cost of a point of a family; large where it stands for no path at all."""
        try:
            return self.cost_of(self.view(fit_waypoints(family.waypoints(numbers))))
        except UserError:
            return REFUSED_M


def improve(judge: Judge, family: Family, numbers: Floats, rounds: int) -> tuple[Floats, float]:
    """Return the local optimum of a family that a start leads to in at most so many rounds, and its cost."""
    from scipy.optimize import linprog  # noqa: PLC0415 -- heavy

    try:
        view = judge.view(fit_waypoints(family.waypoints(numbers)))
    except UserError:
        return numbers, REFUSED_M
    cost = judge.cost_of(view)
    reach = 0.05
    change: View | None = None
    for _ in range(rounds):
        if change is None:
            change = _change(judge, family, numbers, view)
        matrix, side = _linear(judge, view, change)
        box = reach * family.step
        bounds = [
            *zip(np.maximum(-box, family.low - numbers), np.minimum(box, family.high - numbers), strict=True),
            (None, None),
            (None, None),
            (0.0, None),
            (0.0, None),
        ]
        goal = np.concatenate([np.zeros(len(numbers)), [-0.5, -0.5, judge.price_m, _ANGLE_PENALTY_M]])
        answer = linprog(goal, A_ub=matrix, b_ub=side, bounds=bounds, method="highs")
        if answer.status != 0:
            break
        promised = cost - float(answer.fun)
        if promised < 1e-7 or reach < 1e-7:
            break
        candidate = np.clip(numbers + answer.x[: len(numbers)], family.low, family.high)
        try:
            seen: View | None = judge.view(fit_waypoints(family.waypoints(candidate)))
        except UserError:
            seen = None
        won = cost - judge.cost_of(seen) if seen is not None else -REFUSED_M
        if seen is not None and won > 0.0:
            numbers, view, cost, change = candidate, seen, cost - won, None
        if won > 0.5 * promised:
            reach = min(2.0 * reach, 0.3)
        elif won < 0.2 * promised:
            reach *= 0.4
    return numbers, cost


def _change(judge: Judge, family: Family, numbers: Floats, view: View) -> View:
    """Return the derivatives of a view by the family's numbers, each of shape (points, numbers), by differences."""
    columns = [
        View(*((new - old) / step for new, old in zip(judge.view(fit), view, strict=True)))
        for step, fit in family.moved(numbers)
    ]
    return View(*(np.stack(parts, axis=1) for parts in zip(*columns, strict=True)))


def _linear(judge: Judge, view: View, change: View) -> tuple[Floats, Floats]:
    """Return the constraints of one step's linear programme, over (step, clearances (2), slope, angle beyond)."""
    near = view.clearance_m < view.clearance_m.min() + 0.08
    body_near = view.body_clearance_m < view.body_clearance_m.min() + 0.08
    steep = np.abs(view.slope_radpm) > 0.4 * np.abs(view.slope_radpm).max()
    bent = np.abs(view.angle_rad) > 0.7 * judge.angle_rad
    rows, sides = [], []
    for column, sign, jacobian, side in (
        (0, 1.0, -change.clearance_m[near], view.clearance_m[near]),
        (1, 1.0, -change.body_clearance_m[body_near], view.body_clearance_m[body_near]),
        (2, -1.0, np.sign(view.slope_radpm[steep])[:, None] * change.slope_radpm[steep],
         -np.abs(view.slope_radpm[steep])),
        (3, -1.0, np.sign(view.angle_rad[bent])[:, None] * change.angle_rad[bent],
         judge.angle_rad - np.abs(view.angle_rad[bent])),
    ):  # fmt: skip
        extra = np.zeros((len(jacobian), 4))
        extra[:, column] = sign
        rows.append(np.hstack([jacobian, extra]))
        sides.append(side)
    return np.vstack(rows), np.concatenate(sides)
