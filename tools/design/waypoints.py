"""From a few waypoints to many: modified Akima interpolation, as the paper generates its waypoints, or a cubic spline.

A turn is told by six waypoints: two are the start and the stop pose, one more lies on the straight line of each;
between them lie the swing that begins the lane change and the middle of it. Four numbers shape such a path, three more
cut it into segments; Akima's interpolation keeps its straights straight. Many waypoints at even steps can tell any path
of the polynomial family; through them goes a spline, which, unlike Akima's, is a linear function of them.
All lengths in m, angles in rad, in the course frame (x ahead, y left).
"""

import math
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim.errors import UserError

MIN_WAYPOINTS = 4
"""Fewer leave no room for a turn and a counter-turn between two straight ends."""

CALM_SHARE = 0.4
"""Share of the way to the swing at which the start's straight line gets a waypoint."""

JOIN_SHARE = 0.03
"""Share of the way to the stop, before it, at which the stop's straight line gets a waypoint."""

Floats = NDArray[np.float64]


class Waypoints(NamedTuple):
    """A few waypoints and the stations (along x) at which the path is cut into polynomial segments.

    x_m, y_m: shape (k,), m, x strictly increasing. split_x_m: shape (m - 1,), m, strictly inside, strictly increasing.
    start_yaw_rad, stop_yaw_rad: headings of the body at both ends. method: what runs through the waypoints.
    """

    x_m: tuple[float, ...]
    y_m: tuple[float, ...]
    split_x_m: tuple[float, ...]
    start_yaw_rad: float = 0.0
    stop_yaw_rad: float = 0.0
    method: Literal["makima", "spline"] = "makima"


class DenseWaypoints(NamedTuple):
    """Interpolated waypoints in segments: each `parameter_m`, `x_m`, `y_m` has shape (m, n), ends shared."""

    parameter_m: Floats
    x_m: Floats
    y_m: Floats


def check_waypoints(waypoints: Waypoints) -> None:
    """Raise UserError, one line that names the waypoint, unless the waypoints can be interpolated and cut."""
    x, y, split = waypoints.x_m, waypoints.y_m, waypoints.split_x_m
    if len(x) != len(y):
        raise UserError(f"waypoints: {len(x)} x but {len(y)} y; each waypoint needs both")
    if len(x) < MIN_WAYPOINTS:
        raise UserError(f"waypoints: {len(x)} given; a path with a turn and a counter-turn needs {MIN_WAYPOINTS}")
    for index, (x_m, y_m) in enumerate(zip(x, y, strict=True)):
        if not (math.isfinite(x_m) and math.isfinite(y_m)):
            raise UserError(f"waypoints: waypoint {index + 1} is ({x_m}, {y_m}); both must be finite numbers in m")
        if index and x_m <= x[index - 1]:
            raise UserError(
                f"waypoints: waypoint {index + 1} (x = {x_m:g} m) is not ahead of waypoint {index}"
                f" (x = {x[index - 1]:g} m); give them in the order of forward travel"
            )
    borders = (x[0], *split, x[-1])
    for before, after in pairwise(borders):
        if not after > before:
            raise UserError(
                f"waypoints: segments are cut at x = {', '.join(f'{s:g}' for s in split)} m; the cuts must increase"
                f" and lie between the ends {x[0]:g} m and {x[-1]:g} m"
            )


def interpolate(waypoints: Waypoints, per_segment: int = 41) -> DenseWaypoints:
    """Span many waypoints between the few by interpolation of y over x.

    Each segment gets `per_segment` waypoints at equal steps of x, the joints belong to both neighbours; so the result
    is a smooth function of the waypoints and the cuts, which an optimiser needs. Source: paper, figure 2 and 3.
    Raises UserError for waypoints that are out of order, too few or not finite.
    """
    check_waypoints(waypoints)
    borders = np.array([waypoints.x_m[0], *waypoints.split_x_m, waypoints.x_m[-1]])
    share = np.linspace(0.0, 1.0, per_segment)
    x_m = borders[:-1, None] + np.diff(borders)[:, None] * share[None, :]
    x_m[:, -1] = borders[1:]
    return DenseWaypoints(x_m, x_m, _curve(waypoints, np.array(waypoints.y_m), x_m))


def _curve(waypoints: Waypoints, y_m: Floats, at_m: Floats) -> Floats:
    """Return the curve through the waypoints' x and `y_m`, shape (k, ...), at `at_m`."""
    from scipy.interpolate import Akima1DInterpolator, CubicSpline  # noqa: PLC0415  (heavy, and only the design needs it)

    x_m = np.array(waypoints.x_m)
    if waypoints.method == "makima":
        return np.asarray(Akima1DInterpolator(x_m, y_m, method="makima")(at_m))
    ends = tuple(
        (1, np.full(y_m.shape[1:], math.tan(yaw))) for yaw in (waypoints.start_yaw_rad, waypoints.stop_yaw_rad)
    )
    return np.asarray(CubicSpline(x_m, y_m, bc_type=ends)(at_m))


def spline_changes(waypoints: Waypoints, at_m: Floats) -> Floats:
    """Change of a spline at `at_m`, shape (n,), for a unit change of each waypoint but the ends; shape (n, k - 2)."""
    straight = waypoints._replace(start_yaw_rad=0.0, stop_yaw_rad=0.0)
    return _curve(straight, np.eye(len(waypoints.x_m))[:, 1:-1], at_m)


def turn_waypoints(
    start: tuple[float, float, float],
    stop: tuple[float, float, float],
    swing: tuple[float, float],
    middle: tuple[float, float],
    split_x_m: tuple[float, ...],
) -> Waypoints:
    """Waypoints of one lane change between two poses (x, y, yaw).

    `swing` is where the turn begins: x, and how far it lies to the left of the start's straight line; a little to the
    right, away from the turn, makes room for the body's inner side. `middle` is (x, y) of the waypoint on the way to
    the stop's straight line, which is joined 3 % of the distance before the stop.
    """
    calm_m = start[0] + CALM_SHARE * (swing[0] - start[0])
    joined_m = stop[0] - JOIN_SHARE * (stop[0] - start[0])
    slope_a, slope_b = math.tan(start[2]), math.tan(stop[2])
    x = (start[0], calm_m, swing[0], middle[0], joined_m, stop[0])
    calm, turn = (start[1] + slope_a * (x_m - start[0]) for x_m in x[1:3])
    y = (start[1], calm, turn + swing[1], middle[1], stop[1] + slope_b * (joined_m - stop[0]), stop[1])
    return Waypoints(x, y, split_x_m, start[2], stop[2])
