"""The law that the paper's plant needs in reverse: the rear axle tracked on eq. 11, as a continuous reference.

The tyres are eq. 11's (side slip and yaw rate, either sign of the steering), the way of the car is exact: position from
heading and side slip. The reference point is the rear-axle centre, from which the car is minimum phase in both
directions; gains are per metre of travel. Feedforward of the curvature with the tyres' slip, PID on the error at the
preview point, and a disturbance observer of (error, heading error, curvature disturbance).
"""

import math
from typing import NamedTuple

import numpy as np

from sim.data_files import Course, Vehicle
from tools.design.path import Path, sample
from tools.design.path_fit import fit_path, pins
from tools.design.waypoints import Floats, Waypoints, interpolate
from tools.paper.path_study import FOOT_M, SAMPLE_M
from tools.paper.plant import FORWARD, Plant, matrices, steady_angle_per_curvature
from tools.paper.speed import Motion
from tools.paper.track import Track, curvature_at, project

TURN_FT = (6.0, 33.0)
"""Where the rear axle's lane change begins and ends on the paper's course, from the box centre (for clearance)."""

KP, KI, KD = 3.0, 0.3, 3.0
"""Per metre of travel: 1/m^2, 1/m^3, 1/m."""
OBSERVER_POLE_1PM = 3.0
"""Threefold pole of the observer, per metre of travel."""


def rear_axle_waypoints(vehicle: Vehicle, course: Course) -> Waypoints:
    """Waypoints of a lane change for the rear axle; straight ends are marked by two waypoints each."""
    start, stop = course.start_pose(vehicle), course.stop_pose(vehicle)
    begin, end = (FOOT_M * turn for turn in TURN_FT)
    begin = min(max(begin, start.x_m + 1.0), stop.x_m - 3.0)
    end = min(max(end, begin + 1.0), stop.x_m - 1.0)
    x = (start.x_m, 0.5 * (start.x_m + begin), begin, 0.5 * (begin + end), end, 0.5 * (end + stop.x_m), stop.x_m)
    y = (start.y_m,) * 3 + (0.5 * (start.y_m + stop.y_m),) + (stop.y_m,) * 3
    cuts = tuple(float(s) for s in np.linspace(x[0], x[-1], 5)[1:-1])
    return Waypoints(x, y, cuts, start.yaw_rad, stop.yaw_rad)


def rear_axle_path(vehicle: Vehicle, course: Course) -> Path:
    """The path of the rear axle: four segments of order 6, scaled and pinned."""
    waypoints = rear_axle_waypoints(vehicle, course)
    fit = fit_path(
        interpolate(waypoints),
        start=pins(waypoints.x_m[0], waypoints.y_m[0], waypoints.start_yaw_rad),
        stop=pins(waypoints.x_m[-1], waypoints.y_m[-1], waypoints.stop_yaw_rad),
    )
    return sample(fit, SAMPLE_M)


class RearAxleRun(NamedTuple):
    """Histories (n,): rear-axle error m and heading error rad, steering angle, pose of the rear axle in travel."""

    travelled_m: Floats
    cross_track_error_m: Floats
    heading_error_rad: Floats
    steer_rad: Floats
    x_m: Floats
    y_m: Floats
    yaw_rad: Floats


def drive(plant: Plant, track: Track, motion: Motion) -> RearAxleRun:
    """Drive the rear axle along a track; the errors are those of the pose, projected on the path."""
    n, dt = len(motion.time_s), motion.step_s
    arm = plant.car.rear_m if plant.direction == FORWARD else -plant.car.rear_m  # CG ahead of the axle, in travel
    speeds, index = np.unique(np.round(motion.mid_speed_mps, 9), return_inverse=True)
    tyre = _tyre_steps(plant, speeds, dt)
    angle_of = np.array([steady_angle_per_curvature(plant, float(v)) for v in speeds])
    slip_of = np.array([_steady_slip(plant, float(v), arm) for v in speeds])
    reach = 1e-3  # for the slope of the curvature
    rho = curvature_at(track, motion.station_m)
    slope = (curvature_at(track, motion.station_m + reach) - curvature_at(track, motion.station_m - reach)) / (
        2 * reach
    )
    l1, l2, l3 = 3.0 * OBSERVER_POLE_1PM, 3.0 * OBSERVER_POLE_1PM**2, OBSERVER_POLE_1PM**3

    beta = yaw_rate = 0.0
    x, y, yaw = float(track.x_m[0]), float(track.y_m[0]), float(track.yaw_rad[0])
    e = heading = e_hat = heading_hat = disturbance = integral = 0.0
    history = np.zeros((n, 6))
    for k in range(n - 1):
        v, row = float(motion.mid_speed_mps[k]), int(index[k])
        slip = float(slip_of[row]) * float(rho[k])
        # Heading of the rear axle's velocity against the path, less what steady slip gives it.
        course = heading + slip
        wanted = float(rho[k]) - float(slip_of[row]) * float(slope[k])
        preview = e + plant.preview_time_s * v * math.sin(course)
        curvature = wanted - KP * preview - KD * math.sin(course) - KI * integral - disturbance
        steer = float(angle_of[row]) * curvature
        history[k] = e, heading, steer, x, y, yaw
        (p11, p12, p21, p22), (g1, g2) = tyre[row]
        beta, yaw_rate, before = (
            p11 * beta + p12 * yaw_rate + g1 * steer,
            p21 * beta + p22 * yaw_rate + g2 * steer,
            yaw_rate,
        )
        turn = 0.5 * (before + yaw_rate) * dt
        axle_slip = beta - arm * yaw_rate / v
        direction = yaw + 0.5 * turn + axle_slip
        x, y, yaw = x + v * dt * math.cos(direction), y + v * dt * math.sin(direction), yaw + turn
        # The observer: the nominal car driven by the same command, corrected by the errors.
        ds = v * dt
        miss = e - e_hat
        e_hat += ds * (math.sin(heading_hat) + l1 * miss)
        heading_hat += ds * (curvature + disturbance - wanted + l2 * miss)
        disturbance += ds * l3 * miss
        integral += ds * preview
        on_path = _near(track, x, y, float(motion.station_m[k + 1]))
        e, heading = on_path[0], yaw - on_path[1]
    history[-1] = e, heading, steer, x, y, yaw
    check = project(track, history[:, 3], history[:, 4], motion.station_m)
    return RearAxleRun(motion.station_m, check.cross_track_error_m, history[:, 1], *history[:, 2:].T)


def _near(track: Track, x: float, y: float, station_m: float) -> tuple[float, float]:
    """Distance from the path and its heading at the foot point, near a station; scalars, for the loop."""
    step = track.length_m / (len(track.station_m) - 1)
    station = station_m
    last = len(track.station_m) - 2
    aside = yaw = 0.0
    for _ in range(3):
        row = min(max(int(station / step), 0), last)
        share = min(max(station / step - row, 0.0), 1.0)
        yaw = float(track.yaw_rad[row] + share * (track.yaw_rad[row + 1] - track.yaw_rad[row]))
        c, s = math.cos(yaw), math.sin(yaw)
        held = (row + share) * step
        dx = x - float(track.x_m[row] + share * (track.x_m[row + 1] - track.x_m[row]))
        dy = y - float(track.y_m[row] + share * (track.y_m[row + 1] - track.y_m[row]))
        aside = dy * c - dx * s
        station = held + (dx * c + dy * s) / max(1.0 - float(track.curvature_1pm[row]) * aside, 0.2)
    return aside, yaw


def _tyre_steps(
    plant: Plant, speeds_mps: Floats, step_s: float
) -> list[tuple[tuple[float, float, float, float], tuple[float, float]]]:
    """Exact steps of side slip and yaw rate with the angle held, one a speed."""
    from scipy.linalg import expm  # noqa: PLC0415

    whole = np.zeros((len(speeds_mps), 3, 3))
    for row, v in enumerate(speeds_mps):
        a, b, _, _ = matrices(plant, float(v))
        whole[row, :2, :2], whole[row, :2, 2] = a[:2, :2] * step_s, b[:2] * step_s
    return [
        ((float(s[0, 0]), float(s[0, 1]), float(s[1, 0]), float(s[1, 1])), (float(s[0, 2]), float(s[1, 2])))
        for s in expm(whole)
    ]


def _steady_slip(plant: Plant, speed_mps: float, arm_m: float) -> float:
    """Slip angle of the rear axle's centre in a steady turn, per curvature of 1/m."""
    a, b, _, _ = matrices(plant, speed_mps)
    angle = steady_angle_per_curvature(plant, speed_mps)
    beta = -(a[0, 1] * speed_mps + b[0] * angle) / a[0, 0]
    return float(beta - arm_m)
