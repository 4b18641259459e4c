"""The path with the most room to the cones that a car can steer, within the paper's polynomial family.

The search is over the few numbers that place the waypoints and cut the segments. More clearance costs steeper steering,
which costs speed and tracking; so the cost trades clearance against the steering's slope, and the angle keeps a reserve
for feedback.
"""

from typing import NamedTuple

import numpy as np

from sim.body import clearance_array_m, outline_of
from sim.data_files import Course, Vehicle, check_fit
from sim.errors import UserError
from tools.design.path import Path, coarse, sample
from tools.design.path_fit import FitResult, fit_path, pins
from tools.design.waypoints import Floats, Waypoints, interpolate, turn_waypoints

ANGLE_SHARE = 0.94
"""Share of the car's road-wheel angle that the path may use; the rest is for feedback and steering errors."""

SLOPE_PRICE_M = 0.012
"""Clearance (m) that a rad/m of steering slope must buy: the knee of the trade for a 5.8 m car in a 9 ft box."""

SEARCH_POINTS = 25
"""Points a segment at which the search evaluates a path; the result is checked on the fine grid."""

FIRST_GUESSES = (
    (0.3593, 0.7002, 0.6409, 0.7500, 0.0632, 0.0647, 0.5328, 2.6339, 0.2950),
    (0.2587, 0.7831, 0.4561, 0.4516, 0.0111, 0.1336, 1.4023, 1.8622, 1.3247),
)
"""Where the search begins besides random points: what long searches found for a long van and for a saloon. They are
relative to the distance between start and stop, so they are fair guesses for any car; the result is the search's."""

POPULATION = 60
GENERATIONS = 40

_REFUSED = 100.0


class PathDesign(NamedTuple):
    """A designed path of the left side and what it was judged by; clearance in m, to the nearest cone's axis."""

    path: Path
    fit: FitResult
    waypoints: Waypoints
    clearance_m: float
    nearest_cone: str
    max_road_wheel_angle_rad: float


_LOW = np.array([0.03, 0.25, 0.25, 0.25, 0.01, 0.01, 0.1, 0.1, 0.1])
_HIGH = np.array([0.50, 0.90, 0.75, 0.85, 0.20, 0.20, 4.0, 4.0, 4.0])
"""Bounds of the search's numbers: turn in, turn length, middle (x, y), guards (in, out), segment lengths relative to
the last; the first six are shares of the distance between start and stop."""


def waypoints_of(numbers: Floats, vehicle: Vehicle, course: Course) -> Waypoints:
    """Return the waypoints that a point of the search stands for; shape of `numbers`: (9,)."""
    start, stop = course.start_pose(vehicle), course.stop_pose(vehicle)
    ahead_m, aside_m = stop.x_m - start.x_m, stop.y_m - start.y_m
    turn_in, turn_length, middle_x, middle_y, guard_in, guard_out, *relative = numbers
    in_m = start.x_m + ahead_m * turn_in
    out_m = in_m + ahead_m * min(turn_length, 0.97 - turn_in)
    lengths = np.array([*relative, 1.0])
    cuts = start.x_m + ahead_m * np.cumsum(lengths)[:-1] / lengths.sum()
    guards = (ahead_m * min(guard_in, 0.9 * turn_in), min(ahead_m * guard_out, 0.9 * (stop.x_m - out_m)))
    middle = (in_m + (out_m - in_m) * middle_x, start.y_m + aside_m * middle_y)
    return turn_waypoints(start, stop, in_m, out_m, middle, guards, tuple(float(cut) for cut in cuts))


def fit_waypoints(waypoints: Waypoints, per_segment: int = 41) -> FitResult:
    """Return the fit of the waypoints, position, heading and curvature (zero) pinned at both ends."""
    dense = interpolate(waypoints, per_segment)
    return fit_path(
        dense,
        start=pins(waypoints.x_m[0], waypoints.y_m[0], waypoints.start_yaw_rad),
        stop=pins(waypoints.x_m[-1], waypoints.y_m[-1], waypoints.stop_yaw_rad),
    )


def optimise_path(vehicle: Vehicle, course: Course, *, slope_price_m: float = SLOPE_PRICE_M) -> PathDesign:
    """Return the best path of the left side for a car on a course; the same for the same files on the same machine.

    Raises UserError where the car does not fit between the cones or cannot steer any path of the family, and says
    which dimension prevents it.
    """
    from scipy.optimize import differential_evolution, minimize  # noqa: PLC0415 -- heavy

    check_fit(vehicle, course)
    judge = _Judge(vehicle, course, slope_price_m)
    bounds = list(zip(_LOW, _HIGH, strict=True))
    rng = np.random.default_rng(1)
    guesses = np.array(FIRST_GUESSES)
    near = guesses[rng.integers(len(guesses), size=POPULATION // 3)] * rng.normal(
        1.0, 0.1, (POPULATION // 3, len(_LOW))
    )
    anywhere = _LOW + (_HIGH - _LOW) * rng.random((POPULATION - len(guesses) - len(near), len(_LOW)))
    first = np.clip(np.concatenate([guesses, near, anywhere]), _LOW, _HIGH)
    found = differential_evolution(judge.cost, bounds, init=first, rng=rng, maxiter=GENERATIONS, tol=1e-7, polish=False)
    polished = minimize(
        judge.cost,
        found.x,
        method="Nelder-Mead",
        bounds=bounds,
        options={"maxiter": 900, "xatol": 1e-5, "fatol": 1e-7},
    )
    best = polished.x if polished.fun < found.fun else found.x
    return judge.design(np.asarray(best))


class _Judge:
    """The cost of a point of the search, and the checked design it stands for."""

    def __init__(self, vehicle: Vehicle, course: Course, slope_price_m: float) -> None:
        self._vehicle = vehicle
        self._course = course
        self._price_m = slope_price_m
        self._outline = outline_of(vehicle)
        self._cones = course.cones_xy()
        self._stop_x_m = course.stop_pose(vehicle).x_m

    def cost(self, numbers: Floats) -> float:
        """Return the cost in metres of clearance; large where the point stands for no path at all."""
        try:
            fit = fit_waypoints(waypoints_of(numbers, self._vehicle, self._course), SEARCH_POINTS)
        except UserError:
            return _REFUSED
        points = coarse(fit, SEARCH_POINTS)
        wheelbase_m = self._vehicle.wheelbase_m
        bend = wheelbase_m * points.curvature_1pm
        angle_rad = float(np.arctan(np.abs(bend).max()))
        slope = float(np.abs(wheelbase_m * points.curvature_slope_1pm2 / (1.0 + bend * bend)).max())
        clearance = float(clearance_array_m(self._outline, points.x_m, points.y_m, points.yaw_rad, self._cones).min())
        if not np.isfinite(clearance + slope) or np.any(np.diff(points.x_m) < -1e-9):
            return _REFUSED
        beyond_rad = max(0.0, angle_rad - ANGLE_SHARE * self._vehicle.max_road_wheel_angle_rad)
        return -clearance + self._price_m * slope + 10.0 * beyond_rad

    def design(self, numbers: Floats) -> PathDesign:
        """Return the design of a point, checked on the fine grid; UserError where the car cannot drive it."""
        vehicle = self._vehicle
        waypoints = waypoints_of(numbers, vehicle, self._course)
        fit = fit_waypoints(waypoints)
        path = sample(fit)
        distances = clearance_array_m(self._outline, path.x_m, path.y_m, path.yaw_rad, self._cones)
        clearance = float(distances.min())
        cone = self._course.cones[int(distances.min(axis=0).argmin())].name
        angle_rad = float(np.arctan(np.abs(vehicle.wheelbase_m * path.curvature_1pm).max()))
        design = PathDesign(path, fit, waypoints, clearance, cone, angle_rad)
        self._check(design)
        return design

    def _check(self, design: PathDesign) -> None:
        vehicle, course = self._vehicle, self._course
        where = f"vehicle {vehicle.name} on course {course.name}"
        if design.max_road_wheel_angle_rad > vehicle.max_road_wheel_angle_rad:
            raise UserError(
                f"{where}: the path needs {design.max_road_wheel_angle_rad:.3f} rad at the road wheels, more than "
                f"max_road_wheel_angle_rad = {vehicle.max_road_wheel_angle_rad:.3f} rad"
            )
        if design.clearance_m < course.cone_radius_m:
            raise UserError(
                f"{where}: no path of the family passes cone {design.nearest_cone}: {design.clearance_m:.3f} m to its "
                f"axis, must be above cone_radius_m = {course.cone_radius_m:.2f} m; "
                f"{self._preventing_dimension()} prevents it"
            )

    def _preventing_dimension(self) -> str:
        """Return the dimension of the car whose reduction by a tenth gives the most clearance on this course."""
        names = ("body_width_m", "front_overhang_m", "rear_overhang_m", "wheelbase_m")
        return max(names, key=self._gain_of)

    def _gain_of(self, name: str) -> float:
        vehicle = self._vehicle
        smaller = vehicle.with_overlay({name: 0.9 * float(getattr(vehicle, name))})
        judge = _Judge(smaller, self._course, self._price_m)
        return -min(judge.cost(np.array(guess)) for guess in FIRST_GUESSES)
