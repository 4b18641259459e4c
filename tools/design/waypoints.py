"""From a few waypoints to many: modified Akima interpolation, as the paper generates its waypoints.

The few waypoints lie on the start's straight line (two), in the middle of the lane change (one) and on the stop's
straight line (two), with the start and the stop pose at the ends: five numbers shape the path, three more cut it into
segments. All lengths in m, angles in rad, in the course frame (x ahead, y left).
"""

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim.errors import UserError

MIN_WAYPOINTS = 4
"""Fewer leave no room for a turn and a counter-turn between two straight ends."""

Floats = NDArray[np.float64]


class Waypoints(NamedTuple):
    """A few waypoints and the stations (along x) at which the path is cut into polynomial segments.

    x_m, y_m: shape (k,), m, x strictly increasing. split_x_m: shape (m - 1,), m, strictly inside, strictly increasing.
    start_yaw_rad, stop_yaw_rad: headings of the body at both ends.
    """

    x_m: tuple[float, ...]
    y_m: tuple[float, ...]
    split_x_m: tuple[float, ...]
    start_yaw_rad: float = 0.0
    stop_yaw_rad: float = 0.0


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
    """Span many waypoints between the few by modified Akima interpolation of y over x.

    Each segment gets `per_segment` waypoints at equal steps of x, the joints belong to both neighbours; so the result
    is a smooth function of the waypoints and the cuts, which an optimiser needs. Source: paper, figure 2 and 3.
    Raises UserError for waypoints that are out of order, too few or not finite.
    """
    from scipy.interpolate import Akima1DInterpolator  # noqa: PLC0415  (heavy, and only the design needs it)

    check_waypoints(waypoints)
    borders = np.array([waypoints.x_m[0], *waypoints.split_x_m, waypoints.x_m[-1]])
    share = np.linspace(0.0, 1.0, per_segment)
    x_m = borders[:-1, None] + np.diff(borders)[:, None] * share[None, :]
    x_m[:, -1] = borders[1:]
    curve = Akima1DInterpolator(np.array(waypoints.x_m), np.array(waypoints.y_m), method="makima")
    return DenseWaypoints(x_m, x_m, curve(x_m))


def turn_waypoints(
    start: tuple[float, float, float],
    stop: tuple[float, float, float],
    turn_in_m: float,
    turn_out_m: float,
    middle: tuple[float, float],
    guard_m: tuple[float, float],
    split_x_m: tuple[float, ...],
) -> Waypoints:
    """Waypoints of one lane change between two poses (x, y, yaw).

    The turn begins at x = `turn_in_m` on the start's straight line and ends at x = `turn_out_m` on the stop's; `middle`
    is the waypoint between. `guard_m` are the distances before the turn and after it of one more waypoint each on the
    straight lines: the further away, the softer makima leaves and meets the straight.
    """
    xa, xb = turn_in_m, turn_out_m
    slope_a, slope_b = math.tan(start[2]), math.tan(stop[2])
    x = (start[0], xa - guard_m[0], xa, middle[0], xb, xb + guard_m[1], stop[0])
    y_a = [start[1] + slope_a * (x_m - start[0]) for x_m in x[:3]]
    y_b = [stop[1] + slope_b * (x_m - stop[0]) for x_m in x[4:]]
    return Waypoints(x, (*y_a, middle[1], *y_b), split_x_m, start[2], stop[2])
