"""Speed by station: from standstill to standstill within limits of speed, acceleration, jerk and steering rate.

The unknown is b = v^2 on the path's grid, in which acceleration b'/2 is linear. The jerk v b''/2 is not, but its limit
|b''| <= 2 j / sqrt(b) may be replaced by the tangent at a former solution: sqrt's reciprocal is convex, so the tangent
lies below it, every solution of the linear programme keeps the true limit, and repeating it only makes the ride faster.
"""

from typing import NamedTuple

import numpy as np

from sim.errors import UserError
from tools.design.path import Path
from tools.design.waypoints import Floats

GRAVITY_MPS2 = 9.80665


class SpeedLimits(NamedTuple):
    """Limits of the ride; all magnitudes, in the units of their names."""

    speed_mps: float
    accel_x_mps2: float
    accel_y_mps2: float
    jerk_mps3: float
    road_wheel_rate_radps: float
    floor_mps: float = 0.05


class SpeedProfile(NamedTuple):
    """Speed and acceleration along travel at each station of a leg; arrays of shape (n + 1,)."""

    station_m: Floats
    speed_mps: Floats
    accel_mps2: Floats
    duration_s: float


def road_wheel_slope(path: Path, wheelbase_m: float) -> Floats:
    """Change of the road-wheel angle atan(L k) per metre of path, rad/m."""
    bend = wheelbase_m * path.curvature_1pm
    return np.asarray(wheelbase_m * path.curvature_slope_1pm2 / (1.0 + bend * bend))


def station_limit(path: Path, wheelbase_m: float, limits: SpeedLimits) -> Floats:
    """Highest speed at each station that keeps the lateral acceleration and the steering rate; shape (n + 1,), m/s."""
    tiny = 1e-12
    lateral = np.sqrt(limits.accel_y_mps2 / np.maximum(np.abs(path.curvature_1pm), tiny))
    steering = limits.road_wheel_rate_radps / np.maximum(np.abs(road_wheel_slope(path, wheelbase_m)), tiny)
    return np.asarray(np.minimum(np.minimum(lateral, steering), limits.speed_mps))


def plan_speed(path: Path, wheelbase_m: float, limits: SpeedLimits, direction: int) -> SpeedProfile:
    """Fastest profile within the limits for one leg, from and to standstill.

    path: the forward path; direction -1 rides it backwards, stations then count from the forward leg's end.
    The firmware needs a speed above zero to leave a station at all, so speeds below the floor are raised to it; the
    stop itself is the controller's. Raises UserError where the limits force a speed below the floor on the way.
    """
    cap = station_limit(path, wheelbase_m, limits)
    if cap.min() < limits.floor_mps:
        where = float(path.station_m[int(cap.argmin())])
        raise UserError(
            f"speed profile: at station {where:.2f} m the steering rate limit {limits.road_wheel_rate_radps:.3g} rad/s"
            f" (from max_road_wheel_rate_radps) allows {cap.min():.3f} m/s, less than the floor of"
            f" {limits.floor_mps:g} m/s"
        )
    if direction < 0:
        cap = cap[::-1]
    # No ride from rest without a step of the acceleration is faster than v = j t^2 / 2. It ends with a step: the
    # controller's brake stops the car from a speed at which the drive cannot be felt any more.
    from_rest = 0.5 * limits.jerk_mps3 * np.cbrt(6.0 * path.station_m / limits.jerk_mps3) ** 2
    energy = _optimise(np.minimum(cap, from_rest), path.step_m, limits)
    speed = np.maximum(np.sqrt(energy), limits.floor_mps)
    accel = np.gradient(0.5 * energy, path.step_m)
    accel[np.sqrt(energy) <= limits.floor_mps] = 0.0
    duration = float(np.sum(path.step_m / (0.5 * (speed[1:] + speed[:-1]))))
    return SpeedProfile(path.station_m, speed, accel, duration)


def _optimise(cap_mps: Floats, step_m: float, limits: SpeedLimits, rounds: int = 8) -> Floats:
    """Largest sum of b = v^2 within cap, acceleration and jerk limits; zero at both ends."""
    from scipy.optimize import linprog  # noqa: PLC0415
    from scipy.sparse import diags_array, vstack  # noqa: PLC0415

    n = len(cap_mps)
    upper = cap_mps * cap_mps
    upper[0] = upper[-1] = 0.0
    first = diags_array([-np.ones(n - 1), np.ones(n - 1)], offsets=[0, 1], shape=(n - 1, n))
    second = diags_array([np.ones(n - 2), -2.0 * np.ones(n - 2), np.ones(n - 2)], offsets=[0, 1, 2], shape=(n - 2, n))
    accel = np.full(n - 1, 2.0 * limits.accel_x_mps2 * step_m)
    around = np.maximum(upper, limits.floor_mps**2)
    b = np.zeros(n)
    bounds = np.stack([np.zeros(n), upper], axis=1)
    for _ in range(rounds):
        # |b''| <= 2 j / sqrt(b), tangent at `around`: 2 j / sqrt(a) (1.5 - 0.5 b / a)
        rate = 2.0 * limits.jerk_mps3 * step_m**2 / np.sqrt(around[1:-1])
        pull = diags_array([0.5 * rate / around[1:-1]], offsets=[1], shape=(n - 2, n))
        matrix = vstack([first, -first, second + pull, -second + pull]).tocsr()
        side = np.concatenate([accel, accel, 1.5 * rate, 1.5 * rate])
        answer = linprog(-np.ones(n), A_ub=matrix, b_ub=side, bounds=bounds, method="highs")
        if answer.status != 0:  # pragma: no cover  (b = 0 always satisfies the programme)
            raise UserError(f"speed profile: no solution within the limits ({answer.message})")
        gain = float(np.max(np.abs(answer.x - b)))
        b = np.minimum(np.maximum(answer.x, 0.0), upper)
        around = np.maximum(b, limits.floor_mps**2)
        if gain < 1e-4:
            break
    return np.asarray(b)


def profile_jerk(profile: SpeedProfile) -> Floats:
    """Jerk between stations from the tabulated speeds, m/s^3, shape (n - 1,); for tests and plots."""
    step = float(profile.station_m[1] - profile.station_m[0])
    accel = np.diff(profile.speed_mps**2) / (2.0 * step)
    return np.asarray(np.diff(accel) / step * profile.speed_mps[1:-1])
