"""What the numbers of a search for a path stand for: a turn told by a few numbers, or many free waypoints.

Both end in the paper's family: waypoints, interpolated, cut into segments, fitted by polynomials with equality
constraints, position, heading and curvature (zero) pinned at both ends. The turn has few numbers and each has a plain
meaning, so a search can begin anywhere; the free waypoints can tell every path of the polynomial family over x, and a
search through them ends higher, but has to begin at a good one.
"""

from typing import NamedTuple, Protocol

import numpy as np

from sim.data_files import Pose
from tools.design.path_fit import FitResult, fit_changes, fit_path, geometry, pins
from tools.design.waypoints import JOIN_SHARE, Floats, Waypoints, interpolate, spline_changes, turn_waypoints

PER_SEGMENT = 41
SEGMENTS = 4
"""As in the paper's Table 1."""

FREE_WAYPOINTS = 16
"""Waypoints between the ends: more than the ten degrees of freedom that four polynomials of order 6 keep, so that cuts
may lie anywhere."""

_DIFFERENCE = 1e-6


class Family(Protocol):
    """A way to tell a path by numbers; `step` is what a step of the search means for each, relative to the others."""

    @property
    def low(self) -> Floats: ...  # noqa: D102
    @property
    def high(self) -> Floats: ...  # noqa: D102
    @property
    def step(self) -> Floats: ...  # noqa: D102

    def waypoints(self, numbers: Floats) -> Waypoints:
        """Return the waypoints that the numbers stand for."""

    def moved(self, numbers: Floats) -> list[tuple[float, FitResult]]:
        """Return for each number how far it was moved, and the path after that."""


def fit_waypoints(waypoints: Waypoints, per_segment: int = PER_SEGMENT) -> FitResult:
    """Return the fit of the waypoints, position, heading and curvature (zero) pinned at both ends."""
    return fit_path(interpolate(waypoints, per_segment), start=_start_pins(waypoints), stop=_stop_pins(waypoints))


def _start_pins(waypoints: Waypoints) -> Floats:
    return pins(waypoints.x_m[0], waypoints.y_m[0], waypoints.start_yaw_rad)


def _stop_pins(waypoints: Waypoints) -> Floats:
    return pins(waypoints.x_m[-1], waypoints.y_m[-1], waypoints.stop_yaw_rad)


def _moved_one_by_one(family: Family, numbers: Floats, indices: range) -> list[tuple[float, FitResult]]:
    found = []
    for index in indices:
        step = _DIFFERENCE if numbers[index] + _DIFFERENCE < family.high[index] else -_DIFFERENCE
        other = numbers.copy()
        other[index] += step
        found.append((step, fit_waypoints(family.waypoints(other))))
    return found


class Turn(NamedTuple):
    """A lane change by seven numbers: swing and middle (ahead, aside), segment lengths relative to the last.

    Ahead are shares of the distance between start and stop (the middle's: between the swing and the joining with the
    stop's line), aside shares of the lateral shift.
    """

    start: Pose
    stop: Pose
    low: Floats = np.array([0.05, -0.15, 0.20, 0.10, 0.1, 0.1, 0.1])
    high: Floats = np.array([0.60, 0.15, 0.95, 1.30, 4.0, 4.0, 4.0])
    step: Floats = np.array([0.5, 0.2, 0.5, 0.5, 1.0, 1.0, 1.0])

    def waypoints(self, numbers: Floats) -> Waypoints:
        """Return the waypoints that the numbers stand for; shape of `numbers`: (7,)."""
        start, stop = self.start, self.stop
        ahead_m, aside_m = stop.x_m - start.x_m, stop.y_m - start.y_m
        swing_x, swing_y, middle_x, middle_y, *relative = (float(number) for number in numbers)
        swing_m = start.x_m + ahead_m * swing_x
        joined_m = stop.x_m - JOIN_SHARE * ahead_m
        middle = (swing_m + (joined_m - swing_m) * middle_x, start.y_m + aside_m * middle_y)
        cuts = _cuts(start, stop, np.array([*relative, 1.0]))
        return turn_waypoints(start, stop, (swing_m, aside_m * swing_y), middle, cuts)

    def moved(self, numbers: Floats) -> list[tuple[float, FitResult]]:
        """Return for each number how far it was moved, and the path after that."""
        return _moved_one_by_one(self, numbers, range(len(numbers)))


class FreeWaypoints(NamedTuple):
    """Relative lengths of the four segments, then how far aside each waypoint lies, at even steps ahead.

    Aside is a share of the lateral shift.
    """

    start: Pose
    stop: Pose
    low: Floats = np.array([0.25] * SEGMENTS + [-0.5] * FREE_WAYPOINTS)
    high: Floats = np.array([3.0] * SEGMENTS + [1.5] * FREE_WAYPOINTS)
    step: Floats = np.array([0.5] * SEGMENTS + [0.2] * FREE_WAYPOINTS)

    def waypoints(self, numbers: Floats) -> Waypoints:
        """Return the waypoints that the numbers stand for; shape of `numbers`: (SEGMENTS + FREE_WAYPOINTS,)."""
        start, stop = self.start, self.stop
        x_m = np.linspace(start.x_m, stop.x_m, FREE_WAYPOINTS + 2)
        y_m = start.y_m + (stop.y_m - start.y_m) * numbers[SEGMENTS:]
        return Waypoints(
            tuple(x_m.tolist()),
            (start.y_m, *y_m.tolist(), stop.y_m),
            _cuts(start, stop, numbers[:SEGMENTS]),
            start.yaw_rad,
            stop.yaw_rad,
            "spline",
        )

    def moved(self, numbers: Floats) -> list[tuple[float, FitResult]]:
        """Return for each number how far it was moved, and the path after that; exact in the waypoints."""
        waypoints = self.waypoints(numbers)
        dense = interpolate(waypoints, PER_SEGMENT)
        fit = fit_path(dense, start=_start_pins(waypoints), stop=_stop_pins(waypoints))
        step = _DIFFERENCE * (self.stop.y_m - self.start.y_m)
        changes = fit_changes(dense.parameter_m, step * spline_changes(waypoints, dense.parameter_m.ravel()))
        found = _moved_one_by_one(self, numbers, range(SEGMENTS))
        for index in range(FREE_WAYPOINTS):
            coefficients = fit.coefficients.copy()
            coefficients[:, :, 1] += changes[:, :, index]
            found.append((_DIFFERENCE, fit._replace(coefficients=coefficients)))
        return found

    def numbers_of(self, fit: FitResult, lengths: Floats | None = None) -> Floats:
        """Return the numbers of a path that is given over x, cut as it is or into segments of other lengths."""
        relative = fit.length_m if lengths is None else lengths
        x_m = np.linspace(self.start.x_m, self.stop.x_m, FREE_WAYPOINTS + 2)[1:-1]
        border = np.concatenate([[0.0], np.cumsum(fit.length_m)])
        parameter = x_m - self.start.x_m
        segment = np.clip(np.searchsorted(border, parameter, side="right") - 1, 0, len(fit.length_m) - 1)
        y_m = geometry(fit, segment, (parameter - border[segment]) / fit.length_m[segment]).y_m
        aside = (y_m - self.start.y_m) / (self.stop.y_m - self.start.y_m)
        return np.asarray(np.clip(np.concatenate([relative / relative.mean(), aside]), self.low, self.high))


def _cuts(start: Pose, stop: Pose, lengths: Floats) -> tuple[float, ...]:
    """Return where along x segments of such relative lengths are cut."""
    cuts = start.x_m + (stop.x_m - start.x_m) * np.cumsum(lengths)[:-1] / lengths.sum()
    return tuple(float(cut) for cut in cuts)
