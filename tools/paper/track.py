"""The path as the simulation rides it: finely sampled, in either direction, with the projection of a point on it."""

from typing import NamedTuple

import numpy as np

from tools.design.path import Path
from tools.design.waypoints import Floats
from tools.paper.plant import FORWARD


class Track(NamedTuple):
    """A path in the direction of travel: stations m from its start, heading of travel rad, arrays (n + 1,)."""

    station_m: Floats
    x_m: Floats
    y_m: Floats
    yaw_rad: Floats
    curvature_1pm: Floats
    curvature_slope_1pm2: Floats

    @property
    def length_m(self) -> float:
        """Arc length."""
        return float(self.station_m[-1])


def track_of(path: Path, direction: str) -> Track:
    """The forward path itself, or the same path from its end: curvature flipped and inverted, heading turned by pi."""
    if direction == FORWARD:
        return Track(*path)
    return Track(
        path.station_m,
        path.x_m[::-1],
        path.y_m[::-1],
        path.yaw_rad[::-1] + np.pi,
        -path.curvature_1pm[::-1],
        path.curvature_slope_1pm2[::-1],
    )


def curvature_at(track: Track, station_m: Floats) -> Floats:
    """Curvature at stations, cubic between the samples (value and slope are both exact there); ends held."""
    from scipy.interpolate import CubicHermiteSpline  # noqa: PLC0415

    curve = CubicHermiteSpline(track.station_m, track.curvature_1pm, track.curvature_slope_1pm2)
    return np.asarray(curve(np.clip(station_m, 0.0, track.length_m)))


class Projection(NamedTuple):
    """Nearest point of the path: station m, distance m (left positive), heading of the path rad; arrays."""

    station_m: Floats
    cross_track_error_m: Floats
    yaw_rad: Floats


def project(track: Track, x_m: Floats, y_m: Floats, around_m: Floats) -> Projection:
    """Project points on the path, beginning near the stations `around_m`; beyond its ends it goes on straight."""
    station = np.array(around_m, dtype=float)
    length = track.length_m
    aside, yaw = np.zeros_like(station), np.zeros_like(station)
    for _ in range(6):
        held = np.clip(station, 0.0, length)
        yaw = np.interp(held, track.station_m, track.yaw_rad)
        c, s = np.cos(yaw), np.sin(yaw)
        beyond = station - held
        dx = x_m - np.interp(held, track.station_m, track.x_m) - beyond * c
        dy = y_m - np.interp(held, track.station_m, track.y_m) - beyond * s
        ahead, aside = dx * c + dy * s, dy * c - dx * s
        bend = np.where(beyond == 0.0, np.interp(held, track.station_m, track.curvature_1pm), 0.0)
        # A point far off, at the centre of the path's circle, has no nearest point: the step stays bounded there.
        station = station + ahead / np.maximum(1.0 - bend * aside, 0.2)
    return Projection(station, aside, yaw)
