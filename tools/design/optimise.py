"""The path with the most room to the cones that a car can steer, within the paper's polynomial family.

The search is over the few numbers that place the waypoints and cut the segments. More clearance costs steeper steering,
which costs speed and tracking; so the cost trades clearance against the steering's slope, and the angle keeps a reserve
for feedback.

Cost = - smallest clearance + price * largest slope + penalty * angle beyond the share: a minimax problem, smooth but
for its maxima. It is solved as such, by linear programmes over what the path is near to (poses, cones, slopes) inside a
step that grows and shrinks with success; many starts, because the cuts have many local optima. No part of it is random
from run to run.
"""

from typing import NamedTuple

import numpy as np

from sim.body import clearance_array_m, outline_of
from sim.data_files import Course, Vehicle, check_fit
from sim.errors import UserError
from tools.design.path import Path, coarse, sample
from tools.design.path_fit import FitResult, fit_path, pins
from tools.design.speed_profile import road_wheel_slope
from tools.design.waypoints import JOIN_SHARE, Floats, Waypoints, interpolate, turn_waypoints

ANGLE_SHARE = 0.94
"""Share of the car's road-wheel angle that the path may use; the rest is for feedback and steering errors."""

SLOPE_PRICE_M = 0.02
"""Clearance (m) that a rad/m of steering slope must buy: the knee of the trade for a 5.8 m car in a 9 ft box."""

SEARCH_STEP_M = 0.05
"""Distance of the poses at which the search judges a path, which is good to 1 mm of clearance; the result is checked on
the fine grid."""

FIRST_GUESSES = (
    (0.350, -0.011, 0.876, 0.980, 2.76, 4.00, 2.67),
    (0.253, 0.007, 0.907, 0.988, 2.46, 3.08, 1.82),
    (0.287, -0.013, 0.612, 0.974, 2.12, 3.89, 1.12),
    (0.282, -0.011, 0.690, 1.089, 3.03, 1.19, 3.08),
)
"""Where the search begins besides random points: what searches with many more starts found for a long van, a saloon and
the longer course. They are relative to the distance between start and stop, so they are fair guesses for any car; the
result is the search's."""

SCREENED = 300
STARTS = 8
FINALISTS = 3
"""Points drawn to start from, how many of the best are followed for a while, and how many of those to their optimum."""

ROUNDS = 60
"""Steps of a local search; most end sooner because nothing more is to be won."""

NUMBERS_DECIMALS = 6
"""Decimals of the search's numbers that are kept: 10 um of path."""

_ANGLE_PENALTY_M = 10.0
"""Clearance that a radian beyond the share of the car's angle costs: more than any path can win by it."""

_REFUSED_M = 100.0


class PathDesign(NamedTuple):
    """A designed path of the left side and what it was judged by; clearance in m, to the nearest cone's axis.

    `numbers` are what the search found, rounded: with them, the path is made again without a search.
    """

    path: Path
    fit: FitResult
    waypoints: Waypoints
    clearance_m: float
    nearest_cone: str
    max_road_wheel_angle_rad: float
    numbers: tuple[float, ...]


_LOW = np.array([0.05, -0.15, 0.20, 0.10, 0.1, 0.1, 0.1])
_HIGH = np.array([0.60, 0.15, 0.95, 1.30, 4.0, 4.0, 4.0])
"""Bounds of the search's numbers: swing (ahead, aside), middle (ahead, aside), segment lengths relative to the last.
Ahead are shares of the distance between start and stop (the middle's: between the swing and the joining with the stop's
line), aside shares of the lateral shift."""

_STEP = np.array([0.5, 0.2, 0.5, 0.5, 1.0, 1.0, 1.0])
"""What a step of the local search means for each number, relative to the others."""


def waypoints_of(numbers: Floats, vehicle: Vehicle, course: Course) -> Waypoints:
    """Return the waypoints that a point of the search stands for; shape of `numbers`: (7,)."""
    start, stop = course.start_pose(vehicle), course.stop_pose(vehicle)
    ahead_m, aside_m = stop.x_m - start.x_m, stop.y_m - start.y_m
    swing_x, swing_y, middle_x, middle_y, *relative = (float(number) for number in numbers)
    swing_m = start.x_m + ahead_m * swing_x
    joined_m = stop.x_m - JOIN_SHARE * ahead_m
    middle = (swing_m + (joined_m - swing_m) * middle_x, start.y_m + aside_m * middle_y)
    lengths = np.array([*relative, 1.0])
    cuts = start.x_m + ahead_m * np.cumsum(lengths)[:-1] / lengths.sum()
    return turn_waypoints(start, stop, (swing_m, aside_m * swing_y), middle, tuple(float(cut) for cut in cuts))


def fit_waypoints(waypoints: Waypoints, per_segment: int = 41) -> FitResult:
    """Return the fit of the waypoints, position, heading and curvature (zero) pinned at both ends."""
    dense = interpolate(waypoints, per_segment)
    return fit_path(
        dense,
        start=pins(waypoints.x_m[0], waypoints.y_m[0], waypoints.start_yaw_rad),
        stop=pins(waypoints.x_m[-1], waypoints.y_m[-1], waypoints.stop_yaw_rad),
    )


def optimise_path(
    vehicle: Vehicle,
    course: Course,
    *,
    slope_price_m: float = SLOPE_PRICE_M,
    numbers: tuple[float, ...] | None = None,
) -> PathDesign:
    """Return the best path of the left side for a car on a course; the same for the same files on the same machine.

    numbers: those of a former design, to make its path again on any machine; None searches. On another machine a search
    rounds differently on its way and may end at a neighbouring optimum that is as good.
    Raises UserError where the car does not fit between the cones or cannot steer any path of the family, and says
    which dimension prevents it.
    """
    check_fit(vehicle, course)
    judge = _Judge(vehicle, course, slope_price_m)
    if numbers is not None:
        if len(numbers) != len(_LOW):
            raise UserError(f"path: {len(numbers)} numbers given; it takes {len(_LOW)}")
        return judge.design(np.array(numbers))
    rng = np.random.default_rng(1)
    guesses = np.array(FIRST_GUESSES)
    anywhere = _LOW + (_HIGH - _LOW) * rng.random((SCREENED // 2, len(_LOW)))
    near = guesses[rng.integers(len(guesses), size=SCREENED // 2)]
    near = near + rng.normal(0.0, 0.15, near.shape) * _STEP * np.array([0.5, 0.2, 1.0, 0.3, 3.0, 3.0, 3.0])
    drawn = np.clip(np.concatenate([anywhere, near]), _LOW, _HIGH)
    order = np.argsort([judge.cost(point) for point in drawn], kind="stable")
    starts = [*guesses, *drawn[order[:STARTS]]]
    tried = sorted((_improve(judge, start, ROUNDS // 5) for start in starts), key=lambda pair: pair[1])
    found = [_improve(judge, numbers, ROUNDS) for numbers, _ in tried[:FINALISTS]]
    best, _ = min(found, key=lambda pair: pair[1])
    return judge.design(np.round(best, NUMBERS_DECIMALS))


class _View(NamedTuple):
    """A path as the search sees it: distance to each cone at each pose, steering slope and road-wheel angle."""

    clearance_m: Floats
    slope_radpm: Floats
    angle_rad: Floats


class _Judge:
    """The cost of a point of the search, and the checked design it stands for."""

    def __init__(self, vehicle: Vehicle, course: Course, slope_price_m: float) -> None:
        self.vehicle = vehicle
        self.course = course
        self.price_m = slope_price_m
        self.angle_rad = ANGLE_SHARE * vehicle.max_road_wheel_angle_rad
        self._outline = outline_of(vehicle)
        self._cones = course.cones_xy()

    def view(self, numbers: Floats) -> _View:
        """Return what the search needs of a point's path; UserError where the point stands for no path."""
        fit = fit_waypoints(waypoints_of(numbers, self.vehicle, self.course))
        points = coarse(fit, SEARCH_STEP_M)
        clearance = clearance_array_m(self._outline, points.x_m, points.y_m, points.yaw_rad, self._cones)
        bend = self.vehicle.wheelbase_m * points.curvature_1pm
        slope = self.vehicle.wheelbase_m * points.curvature_slope_1pm2 / (1.0 + bend * bend)
        return _View(clearance.ravel(), slope, np.asarray(np.arctan(bend)))

    def cost_of(self, view: _View) -> float:
        """Return the cost in metres of clearance."""
        beyond_rad = max(0.0, float(np.abs(view.angle_rad).max()) - self.angle_rad)
        slope = float(np.abs(view.slope_radpm).max())
        return -float(view.clearance_m.min()) + self.price_m * slope + _ANGLE_PENALTY_M * beyond_rad

    def cost(self, numbers: Floats) -> float:
        """Return the cost of a point; large where it stands for no path at all."""
        try:
            return self.cost_of(self.view(numbers))
        except UserError:
            return _REFUSED_M

    def design(self, numbers: Floats) -> PathDesign:
        """Return the design of a point, checked on the fine grid; UserError where the car cannot drive it."""
        vehicle, course = self.vehicle, self.course
        waypoints = waypoints_of(numbers, vehicle, course)
        fit = fit_waypoints(waypoints)
        path = sample(fit)
        distances = clearance_array_m(self._outline, path.x_m, path.y_m, path.yaw_rad, self._cones)
        clearance = float(distances.min())
        cone = course.cones[int(distances.min(axis=0).argmin())].name
        angle_rad = float(np.arctan(np.abs(vehicle.wheelbase_m * path.curvature_1pm).max()))
        where = f"vehicle {vehicle.name} on course {course.name}"
        if angle_rad > vehicle.max_road_wheel_angle_rad:
            raise UserError(
                f"{where}: the path needs {angle_rad:.3f} rad at the road wheels, more than "
                f"max_road_wheel_angle_rad = {vehicle.max_road_wheel_angle_rad:.3f} rad"
            )
        if clearance < course.cone_radius_m:
            raise UserError(
                f"{where}: no path of the family passes cone {cone}: {clearance:.3f} m to its axis, must be above "
                f"cone_radius_m = {course.cone_radius_m:.2f} m; {self._preventing(numbers)} prevents it"
            )
        return PathDesign(path, fit, waypoints, clearance, cone, angle_rad, tuple(float(number) for number in numbers))

    def _preventing(self, numbers: Floats) -> str:
        """Return the dimension of the car whose change by a tenth would win the most."""
        factors = {
            "body_width_m": 0.9,
            "front_overhang_m": 0.9,
            "rear_overhang_m": 0.9,
            "wheelbase_m": 0.9,
            "max_road_wheel_angle_rad": 1.1,
        }
        if self.vehicle.mirror_width_m > self.vehicle.body_width_m:
            factors["mirror_width_m"] = 0.9

        def cost_with(name: str) -> float:
            value = factors[name] * float(getattr(self.vehicle, name))
            overlay = {name: value}
            if name == "mirror_width_m":
                overlay[name] = max(value, self.vehicle.body_width_m)
            elif name == "body_width_m" and self.vehicle.mirror_width_m <= self.vehicle.body_width_m:
                overlay["mirror_width_m"] = value
            judge = _Judge(self.vehicle.with_overlay(overlay), self.course, self.price_m)
            return _improve(judge, numbers, ROUNDS // 2)[1]

        return min(factors, key=cost_with)


def _improve(judge: _Judge, numbers: Floats, rounds: int) -> tuple[Floats, float]:
    """Return the local optimum that a start leads to, and its cost."""
    from scipy.optimize import linprog  # noqa: PLC0415 -- heavy

    try:
        view = judge.view(numbers)
    except UserError:
        return numbers, _REFUSED_M
    cost = judge.cost_of(view)
    reach = 0.05
    change: _View | None = None
    for _ in range(rounds):
        if change is None:
            change = _change(judge, numbers, view)
        matrix, side = _linear(judge, view, change)
        box = reach * _STEP
        bounds = [
            *zip(np.maximum(-box, _LOW - numbers), np.minimum(box, _HIGH - numbers), strict=True),
            (None, None),
            (0.0, None),
            (0.0, None),
        ]
        goal = np.concatenate([np.zeros(len(numbers)), [-1.0, judge.price_m, _ANGLE_PENALTY_M]])
        answer = linprog(goal, A_ub=matrix, b_ub=side, bounds=bounds, method="highs")
        if answer.status != 0:
            break
        promised = cost - float(answer.fun)
        if promised < 1e-7 or reach < 1e-7:
            break
        candidate = np.clip(numbers + answer.x[: len(numbers)], _LOW, _HIGH)
        try:
            seen: _View | None = judge.view(candidate)
        except UserError:
            seen = None
        won = cost - judge.cost_of(seen) if seen is not None else -_REFUSED_M
        if seen is not None and won > 0.0:
            numbers, view, cost, change = candidate, seen, cost - won, None
        if won > 0.5 * promised:
            reach = min(2.0 * reach, 0.3)
        elif won < 0.2 * promised:
            reach *= 0.4
    return numbers, cost


def _change(judge: _Judge, numbers: Floats, view: _View) -> _View:
    """Return the derivatives of a view by the search's numbers, each of shape (points, numbers), by differences."""
    columns: list[_View] = []
    for index in range(len(numbers)):
        step = 1e-6 if numbers[index] + 1e-6 < _HIGH[index] else -1e-6
        moved = numbers.copy()
        moved[index] += step
        other = judge.view(moved)
        columns.append(_View(*((new - old) / step for new, old in zip(other, view, strict=True))))
    return _View(*(np.stack(parts, axis=1) for parts in zip(*columns, strict=True)))


def _linear(judge: _Judge, view: _View, change: _View) -> tuple[Floats, Floats]:
    """Return the constraints of one step's linear programme, over (step, clearance, slope, angle beyond)."""
    near = view.clearance_m < view.clearance_m.min() + 0.08
    steep = np.abs(view.slope_radpm) > 0.4 * np.abs(view.slope_radpm).max()
    bent = np.abs(view.angle_rad) > 0.7 * judge.angle_rad
    rows, sides = [], []
    for column, jacobian, side in (
        (0, -change.clearance_m[near], view.clearance_m[near]),
        (1, np.sign(view.slope_radpm[steep])[:, None] * change.slope_radpm[steep], -np.abs(view.slope_radpm[steep])),
        (
            2,
            np.sign(view.angle_rad[bent])[:, None] * change.angle_rad[bent],
            judge.angle_rad - np.abs(view.angle_rad[bent]),
        ),
    ):
        extra = np.zeros((len(jacobian), 3))
        extra[:, column] = 1.0 if column == 0 else -1.0
        rows.append(np.hstack([jacobian, extra]))
        sides.append(side)
    return np.vstack(rows), np.concatenate(sides)


def max_road_wheel_slope(design: PathDesign, wheelbase_m: float) -> float:
    """Largest change of the road-wheel angle per metre of the design's path, rad/m."""
    return float(np.abs(road_wheel_slope(design.path, wheelbase_m)).max())
