"""The paper's speed and preview profile (Table 3, Figure 7): constant accelerations between 0.1 m/s and 1 m/s."""

import math
from typing import NamedTuple

import numpy as np

from sim.errors import UserError
from tools.design.speed_profile import GRAVITY_MPS2
from tools.design.waypoints import Floats


class Schedule(NamedTuple):
    """Table 3. Accelerations in parts of g, speeds in m/s, preview constant K in s."""

    lateral_g: float = 0.05
    longitudinal_g: float = 0.05
    max_speed_mps: float = 1.0
    min_speed_mps: float = 0.1
    preview_time_s: float = 0.5


TABLE_3 = Schedule()


class Motion(NamedTuple):
    """Speed and station at even times, arrays (n + 1,); `mid_speed_mps` (n,) is that in the middle of each step."""

    time_s: Floats
    station_m: Floats
    speed_mps: Floats
    mid_speed_mps: Floats

    @property
    def step_s(self) -> float:
        """Distance of two instants."""
        return float(self.time_s[1])


def speed_squared(station_m: Floats, curvature_1pm: Floats, schedule: Schedule) -> Floats:
    """Highest v^2 at each station within Table 3: linear in the station where an acceleration is what limits it."""
    floor = schedule.min_speed_mps**2
    lateral = schedule.lateral_g * GRAVITY_MPS2 / np.maximum(np.abs(curvature_1pm), 1e-12)
    cap = np.minimum(lateral, schedule.max_speed_mps**2)
    if cap.min() < floor:
        raise UserError(
            f"speed profile: a curvature of {np.abs(curvature_1pm).max():.3g} 1/m at {schedule.lateral_g:g} g allows "
            f"less than the lowest speed of {schedule.min_speed_mps:g} m/s; the waypoints turn too sharply"
        )
    slope = 2.0 * schedule.longitudinal_g * GRAVITY_MPS2
    gain = slope * station_m
    from_start = np.minimum.accumulate(np.concatenate([[floor], (cap - gain)[1:]])) + gain
    left = gain[-1] - gain
    to_stop = np.minimum.accumulate(np.concatenate([[floor], (cap - left)[:-1][::-1]]))[::-1] + left
    return np.asarray(np.minimum(np.minimum(from_start, to_stop), cap))


def motion(station_m: Floats, curvature_1pm: Floats, schedule: Schedule, step_s: float) -> Motion:
    """Drive along the stations at the scheduled speed; the last instant is the last whole step before the stop."""
    square = speed_squared(station_m, curvature_1pm, schedule)
    v = np.sqrt(square)
    # Constant acceleration between stations: the time of each is exact.
    at = np.concatenate([[0.0], np.cumsum(2.0 * np.diff(station_m) / (v[1:] + v[:-1]))])
    count = math.floor(at[-1] / step_s)
    fine = np.arange(2 * count + 1) * (0.5 * step_s)
    piece = np.clip(np.searchsorted(at, fine, side="right") - 1, 0, len(at) - 2)
    since = fine - at[piece]
    accel = np.diff(square)[piece] / (2.0 * np.diff(station_m)[piece])
    speed = v[piece] + accel * since
    station = station_m[piece] + (v[piece] + 0.5 * accel * since) * since
    return Motion(fine[::2], station[::2], speed[::2], speed[1::2])
