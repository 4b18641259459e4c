"""The path as the firmware gets it: a uniform grid of arc length with exact curvature and slope, and its checks.

Reference point is the rear-axle centre; forward travel, left side. Units m, rad, 1/m, 1/m^2.
"""

import math
from typing import NamedTuple

import numpy as np

from tools.design.path_fit import FitResult, Geometry, geometry
from tools.design.waypoints import Floats

GRID_M = 0.01
"""Wanted step of the station grid; the true one divides the path's length."""


class Path(NamedTuple):
    """A path on a uniform grid of stations, arrays of shape (n + 1,); see path.csv."""

    station_m: Floats
    x_m: Floats
    y_m: Floats
    yaw_rad: Floats
    curvature_1pm: Floats
    curvature_slope_1pm2: Floats

    @property
    def length_m(self) -> float:
        """Arc length from the start to the stop pose."""
        return float(self.station_m[-1])

    @property
    def step_m(self) -> float:
        """Distance of two stations."""
        return float(self.station_m[-1]) / (len(self.station_m) - 1)


def sample(fit: FitResult, step_m: float = GRID_M) -> Path:
    """Points at equal steps of arc length (the step nearest to `step_m` that divides the length)."""
    m = len(fit.length_m)
    pieces = max(16, math.ceil(float(np.max(fit.length_m)) / 0.05))
    node, weight = np.polynomial.legendre.leggauss(10)
    node, weight = 0.5 * (node + 1.0), 0.5 * weight
    segment = np.repeat(np.arange(m), pieces)
    left = np.tile(np.arange(pieces) / pieces, m)
    inner = left[:, None] + node[None, :] / pieces
    speed = geometry(fit, np.broadcast_to(segment[:, None], inner.shape), inner).speed_m
    arc = np.concatenate([[0.0], np.cumsum((speed * weight).sum(axis=1) / pieces)])
    length_m = float(arc[-1])
    count = max(2, round(length_m / step_m))
    station = np.arange(count + 1) * (length_m / count)

    piece = np.clip(np.searchsorted(arc, station, side="right") - 1, 0, m * pieces - 1)
    start, rest = left[piece], station - arc[piece]
    width = rest / (arc[piece + 1] - arc[piece]) / pieces
    for _ in range(6):  # Newton on the arc length within the piece; the integrand is nearly constant
        at = start[:, None] + width[:, None] * node[None, :]
        covered = (geometry(fit, np.broadcast_to(segment[piece][:, None], at.shape), at).speed_m * weight).sum(
            axis=1
        ) * width
        width += (rest - covered) / geometry(fit, segment[piece], start + width).speed_m
    lambda_ = start + width
    # The ends are pinned: no rounding of the inversion may move them.
    lambda_[0], lambda_[-1] = 0.0, 1.0
    points = geometry(fit, segment[piece], lambda_)
    return Path(
        np.asarray(station, dtype=np.float64),
        points.x_m,
        points.y_m,
        points.yaw_rad,
        points.curvature_1pm,
        points.curvature_slope_1pm2,
    )


def coarse(fit: FitResult, step_m: float) -> Geometry:
    """Points at equal steps of the waypoints' parameter over the whole path, then the joints; for the optimiser.

    Steps are equal over all segments: with a number of points a segment, a search would soon hide a cone between two
    points of a long one. At the joints the curvature's slope has its peaks.
    """
    border = np.concatenate([[0.0], np.cumsum(fit.length_m)])
    # The number of steps must not hang on the last digit of the length: an optimiser compares paths point by point.
    even = np.linspace(0.0, border[-1], max(2, math.ceil(border[-1] / step_m - 1e-6) + 1))
    parameter = np.concatenate([even, border[1:-1]])
    segment = np.clip(np.searchsorted(border, parameter, side="right") - 1, 0, len(fit.length_m) - 1)
    return geometry(fit, segment, (parameter - border[segment]) / fit.length_m[segment])


def mirrored(path: Path) -> Path:
    """The same path to the other side: y, heading, curvature and slope negated, exactly."""
    return Path(path.station_m, path.x_m, -path.y_m, -path.yaw_rad, -path.curvature_1pm, -path.curvature_slope_1pm2)
