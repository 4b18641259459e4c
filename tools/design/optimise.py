"""The path with the most room to the cones that a car can steer, within the paper's polynomial family.

More clearance costs steeper steering, which costs speed and tracking; so the cost trades clearance against the
steering's slope, and the angle keeps a reserve for feedback (`Weights`). The search has two stages. The first is over
the few numbers of a turn, from many starts, because the cuts of the segments have many local optima. The second sets
the waypoints free, from the best turn cut in a few ways, and wins what the turn's shape cannot tell: 5 to 15 mm. No
part of it is random from run to run.
"""

from typing import NamedTuple

import numpy as np

from sim.body import clearance_array_m
from sim.data_files import Course, Vehicle, check_fit
from sim.errors import UserError
from tools.design.families import Family, FreeWaypoints, Turn, fit_waypoints
from tools.design.path import Path, sample
from tools.design.path_fit import FitResult
from tools.design.search import Judge, improve
from tools.design.speed_profile import road_wheel_slope
from tools.design.waypoints import Floats, Waypoints


class Weights(NamedTuple):
    """What a path is chosen by, besides its clearance.

    angle_share: share of the car's road-wheel angle that the path may use; the rest is for feedback and for errors of
    the steering (one that makes 5 % too little and stands 1 degree aside needs 0.513 rad for 0.47). slope_price_m:
    clearance (m) that a rad/m of steering slope must buy.
    """

    angle_share: float = 0.88
    slope_price_m: float = 0.02


CHOSEN = Weights()
"""The shipped choice: see the trade curve of `parkctl design --trade`."""

MOST_CLEARANCE = Weights(angle_share=0.998, slope_price_m=0.001)
"""The clearest path of all; the price only decides between paths of the same clearance."""

FIRST_GUESSES = (
    (0.350, -0.011, 0.876, 0.980, 2.76, 4.00, 2.67),
    (0.253, 0.007, 0.907, 0.988, 2.46, 3.08, 1.82),
    (0.287, -0.013, 0.612, 0.974, 2.12, 3.89, 1.12),
    (0.282, -0.011, 0.690, 1.089, 3.03, 1.19, 3.08),
)
"""Turns that the search begins with besides random ones: what searches with many more starts found for a long van, a
saloon and the longer course. They are relative to the distance between start and stop, so they are fair guesses for any
car; the result is the search's."""

SCREENED = 300
STARTS = 6
"""Turns drawn to start from, and how many of the best are followed."""

TURN_ROUNDS = 15
CUTS = ((1.0, 1.0, 1.0, 1.0), (1.2, 1.0, 1.0, 0.8), (0.8, 1.0, 1.4, 0.8))
"""Relative lengths of the segments from which the free waypoints start."""

TRIAL_ROUNDS, FINAL_ROUNDS = 40, 150
"""Steps of a local search over free waypoints from each start, and from the best one on."""

NUMBERS_DECIMALS = 6
"""Decimals of the search's numbers that are kept: micrometres of path."""


class PathDesign(NamedTuple):
    """A designed path of the left side and what it was judged by.

    clearance_m: from the outline with mirrors to the nearest cone's axis; body_clearance_m: from the body alone.
    `numbers` are what the search found, rounded: with them, the path is made again without a search.
    """

    path: Path
    fit: FitResult
    waypoints: Waypoints
    clearance_m: float
    body_clearance_m: float
    nearest_cone: str
    max_road_wheel_angle_rad: float
    numbers: tuple[float, ...]


def optimise_path(
    vehicle: Vehicle,
    course: Course,
    *,
    weights: Weights = CHOSEN,
    numbers: tuple[float, ...] | None = None,
    near: tuple[tuple[float, ...], ...] = (),
) -> PathDesign:
    """Return the best path of the left side for a car on a course; the same for the same files on the same machine.

    numbers: those of a former design, to make its path again on any machine; None searches. On another machine a search
    rounds differently on its way and may end at a neighbouring optimum that is as good. near: numbers of former designs
    for other weights: the search begins at these alone.
    Raises UserError where the car does not fit between the cones or cannot steer any path of the family, and says
    which dimension prevents it.
    """
    check_fit(vehicle, course)
    if numbers is not None:
        return checked(make_path(vehicle, course, numbers), vehicle, course)
    judge = Judge(vehicle, course, weights.angle_share * vehicle.max_road_wheel_angle_rad, weights.slope_price_m)
    free = FreeWaypoints(course.start_pose(vehicle), course.stop_pose(vehicle))
    starts = [np.array(point) for point in near] or _starts(judge, free)
    tried = (improve(judge, free, start, TRIAL_ROUNDS) for start in starts)
    nearly, _ = min(tried, key=lambda pair: pair[1])
    best, _ = improve(judge, free, nearly, FINAL_ROUNDS)
    found = tuple(float(number) for number in np.round(best, NUMBERS_DECIMALS))
    return checked(make_path(vehicle, course, found), vehicle, course)


def _starts(judge: Judge, free: FreeWaypoints) -> list[Floats]:
    """Return where the free waypoints start: on the best turn, cut in several ways."""
    turn = Turn(free.start, free.stop)
    rng = np.random.default_rng(1)
    guesses = np.array(FIRST_GUESSES)
    anywhere = turn.low + (turn.high - turn.low) * rng.random((SCREENED // 2, len(turn.low)))
    near = guesses[rng.integers(len(guesses), size=SCREENED // 2)]
    near = near + rng.normal(0.0, 0.15, near.shape) * turn.step * np.array([0.5, 0.2, 1.0, 0.3, 3.0, 3.0, 3.0])
    drawn = np.clip(np.concatenate([anywhere, near]), turn.low, turn.high)
    order = np.argsort([judge.cost(turn, point) for point in drawn], kind="stable")
    followed = (improve(judge, turn, start, TURN_ROUNDS) for start in (*guesses, *drawn[order[:STARTS]]))
    best, _ = min(followed, key=lambda pair: pair[1])
    fit = fit_waypoints(turn.waypoints(best))
    return [free.numbers_of(fit, np.array(lengths)) for lengths in CUTS]


def make_path(vehicle: Vehicle, course: Course, numbers: tuple[float, ...]) -> PathDesign:
    """Return the path that the numbers of a family stand for, on the fine grid, whether the car can drive it or not."""
    start, stop = course.start_pose(vehicle), course.stop_pose(vehicle)
    families: tuple[Family, ...] = (FreeWaypoints(start, stop), Turn(start, stop))
    family = next((family for family in families if len(family.low) == len(numbers)), None)
    if family is None:
        counts = " or ".join(str(len(family.low)) for family in families)
        raise UserError(f"path: {len(numbers)} numbers given; it takes {counts}")
    waypoints = family.waypoints(np.array(numbers))
    fit = fit_waypoints(waypoints)
    path = sample(fit)
    judge = Judge(vehicle, course, vehicle.max_road_wheel_angle_rad, 0.0)
    pose = (path.x_m, path.y_m, path.yaw_rad)
    distances = clearance_array_m(judge.outline, *pose, judge.cones)
    return PathDesign(
        path,
        fit,
        waypoints,
        float(distances.min()),
        float(clearance_array_m(judge.body, *pose, judge.cones).min()),
        course.cones[int(distances.min(axis=0).argmin())].name,
        float(np.arctan(np.abs(vehicle.wheelbase_m * path.curvature_1pm).max())),
        tuple(float(number) for number in numbers),
    )


def checked(design: PathDesign, vehicle: Vehicle, course: Course) -> PathDesign:
    """Return the design; UserError where the car cannot drive it, with the dimension that prevents it."""
    angle_rad, most_rad = design.max_road_wheel_angle_rad, vehicle.max_road_wheel_angle_rad
    if angle_rad <= most_rad and design.clearance_m >= course.cone_radius_m:
        return design
    if angle_rad > most_rad:
        what = f"the path needs {angle_rad:.3f} rad at the road wheels, more than max_road_wheel_angle_rad"
        what += f" = {most_rad:.3f} rad"
    else:
        what = (
            f"no path of the family passes cone {design.nearest_cone}: {design.clearance_m:.3f} m to its axis, must be"
            f" above cone_radius_m = {course.cone_radius_m:.2f} m"
        )
    from tools.design.refusal import preventing  # noqa: PLC0415 -- it needs this module

    raise UserError(f"vehicle {vehicle.name} on course {course.name}: {what}; {preventing(vehicle, course, design)}")


def max_road_wheel_slope(design: PathDesign, wheelbase_m: float) -> float:
    """Largest change of the road-wheel angle per metre of the design's path, rad/m."""
    return float(np.abs(road_wheel_slope(design.path, wheelbase_m)).max())
