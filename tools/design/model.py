"""The sampled steering loop as matrices: the car, the controller as the firmware runs it, and the loop they close.

Everything is linear about a straight path at a constant speed; of a bend that is put in which changes the loop there.
The controller's matrices are those of the firmware's own functions (`firmware_py.core`: estimator, predictor, PID,
disturbances), taken by differences, so that observer, predictor and remembered commands are in them as they run; limits
are not reached. The car is a single-track model with linear tyres behind a lagging steering with dead time, sampled
exactly.

Where the loop is cut for the margins is the steering command on its way to the car: what the controller remembers as
sent stays inside the controller. A cycle begins with the vehicle's reports; the pose in them is older by its latency,
and the command that they lead to acts LOOP_AGE_S and the command's latency after them.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from firmware_py.core import estimator, kalman, pid, predictor
from firmware_py.core.motion import QUEUE_LENGTH, lag_weights
from firmware_py.core.schedule import gains_at
from firmware_py.core.tables import CarTable, GainTable, LegTable
from sim.data_files import Vehicle
from tools.design.filter import settled

Floats = npt.NDArray[np.float64]
Complexes = npt.NDArray[np.complex128]

PERIOD_S = 0.01
"""Cycle of the controller."""

LOOP_AGE_S = 0.0035
"""Latency of every loop besides the car's own: reports are 3 ms old when a cycle begins and its commands leave 0.5 ms
after it."""

LEAST_LAG_S = 1e-3
"""A steering quicker than this is taken to have this lag."""

OUTPUTS = 4
"""Of the car: cross-track error (m) and heading (rad) of the pose, yaw rate (rad/s), measured angle (rad)."""


class Row(NamedTuple):
    """One row of a gain table, in the order and units of its columns (`firmware_py.core.schedule.Gains`)."""

    direction: float
    speed_mps: float
    preview_m: float
    kp: float
    ki: float
    kd: float
    l_o: float
    l_g: float
    l_dr: float
    w_e: float
    w_p: float
    w_d: float


class Nominal(NamedTuple):
    """What the controller believes of the car: wheelbase in m, lag in s, latencies in whole samples, largest angle."""

    wheelbase_m: float
    steering_lag_s: float
    pose_latency_samples: int
    command_latency_samples: int
    max_road_wheel_angle_rad: float


class Corner(NamedTuple):
    """A car that may come true; `steering_gain` is the angle that it makes over the angle that was commanded."""

    name: str
    steering_lag_s: float
    pose_latency_samples: int
    command_latency_samples: float
    steering_gain: float
    wheelbase_m: float
    cg_to_rear_axle_m: float
    mass_kg: float
    yaw_inertia_kgm2: float
    stiffness_front_n_per_rad: float
    stiffness_rear_n_per_rad: float


class Mode(NamedTuple):
    """How the controller runs: predicting or not (`pid+ff`), with a fresh yaw rate or without, with whose poses, where.

    `localisation` is a key of `tools.design.filter.LOCALISATIONS`. `in_bend`: with the wheels as far from straight
    as they go. There the estimator takes a gap between measured and nominal angle for the steering's gain at once, and
    a radian turns the car by more than on the straight.
    """

    predicts: bool = True
    with_yaw_rate: bool = True
    localisation: str = "white"
    in_bend: bool = False


class StateSpace(NamedTuple):
    """Discrete-time system with the controller's period: x' = a x + b u, y = c x + d u."""

    a: Floats
    b: Floats
    c: Floats
    d: Floats


def nominal_of(vehicle: Vehicle) -> Nominal:
    """What the controller is told of a vehicle; its latencies are rounded to whole cycles."""
    return Nominal(
        vehicle.wheelbase_m,
        vehicle.steering_lag_s,
        round(vehicle.pose_latency_samples),
        round(vehicle.command_latency_samples),
        vehicle.max_road_wheel_angle_rad,
    )


# --------------------------------------------------------------------------------------------------------------------
# The car
# --------------------------------------------------------------------------------------------------------------------


def _held(corner: Corner, velocity_mps: float, time_s: float) -> tuple[Floats, Floats]:
    """Exact motion over `time_s` with the command held: matrix (5, 5) and vector (5,).

    State: place of the rear axle to the left (m), yaw (rad), lateral velocity of the centre of gravity (m/s), yaw rate
    (rad/s), road-wheel angle (rad). In reverse the velocity is negative and the tyres still push against their slip.
    """
    from scipy.linalg import expm  # noqa: PLC0415  (heavy, and only the design needs it)

    rear = corner.cg_to_rear_axle_m
    front = corner.wheelbase_m - rear
    mass, inertia = corner.mass_kg, corner.yaw_inertia_kgm2
    v, pace = velocity_mps, abs(velocity_mps)
    cf, cr = corner.stiffness_front_n_per_rad / pace, corner.stiffness_rear_n_per_rad / pace
    lag = max(corner.steering_lag_s, LEAST_LAG_S)
    system = np.zeros((6, 6))
    system[0, 1:4] = v, 1.0, -rear
    system[1, 3] = 1.0
    system[2, 2:5] = -(cf + cr) / mass, -(cf * front - cr * rear) / mass - v, cf * v / mass
    system[3, 2:5] = (
        -(cf * front - cr * rear) / inertia,
        -(cf * front * front + cr * rear * rear) / inertia,
        cf * front * v / inertia,
    )
    system[4, 4] = -1.0 / lag
    system[4, 5] = corner.steering_gain / lag
    both = expm(system * time_s)
    return both[:5, :5], both[:5, 5]


class _Sampled(NamedTuple):
    """The car over one cycle: x' = a x + newer u[k - whole] + older u[k - whole - 1]."""

    a: Floats
    newer: Floats
    older: Floats
    whole: int


def _sampled(corner: Corner, velocity_mps: float) -> _Sampled:
    latency = corner.command_latency_samples + LOOP_AGE_S / PERIOD_S
    whole = math.floor(latency + 1e-9)
    part = max(latency - whole, 0.0)
    late, late_b = _held(corner, velocity_mps, (1.0 - part) * PERIOD_S)
    early, early_b = _held(corner, velocity_mps, part * PERIOD_S)
    return _Sampled(late @ early, late_b, late @ early_b, whole)


def car(corner: Corner, speed_mps: float, direction: float) -> StateSpace:
    """From the commanded angle (rad) to what the reports say, `OUTPUTS` of them.

    State: the five of the car, the poses on their way, newest first, then the commands on their way, newest first.
    """
    sampled = _sampled(corner, direction * speed_mps)
    poses, waiting = corner.pose_latency_samples, sampled.whole + 1
    size = 5 + 2 * poses + waiting
    line = 5 + 2 * poses
    a = np.zeros((size, size))
    b = np.zeros((size, 1))
    a[:5, :5] = sampled.a
    for index in range(poses):
        at = 5 + 2 * index
        before = 0 if index == 0 else at - 2
        a[at : at + 2, before : before + 2] = np.eye(2)
    if sampled.whole == 0:
        b[:5, 0] = sampled.newer
    else:
        a[:5, line + sampled.whole - 1] = sampled.newer
    a[:5, line + sampled.whole] += sampled.older
    b[line, 0] = 1.0
    a[line + 1 :, line:-1] = np.eye(waiting - 1)
    c = np.zeros((OUTPUTS, size))
    pose = 0 if poses == 0 else 5 + 2 * (poses - 1)
    c[0, pose] = c[1, pose + 1] = c[2, 3] = c[3, 4] = 1.0
    return StateSpace(a, b, c, np.zeros((OUTPUTS, 1)))


def car_response(corner: Corner, speed_mps: float, direction: float, z: Complexes) -> Complexes:
    """Frequency response of `car` at the points z, shape (len(z), OUTPUTS)."""
    sampled = _sampled(corner, direction * speed_mps)
    drive = (sampled.newer + np.outer(1.0 / z, sampled.older)) * (z**-sampled.whole)[:, None]
    state = np.linalg.solve(z[:, None, None] * np.eye(5) - sampled.a, drive[:, :, None])[:, :, 0]
    late = z**-corner.pose_latency_samples
    return np.stack([late * state[:, 0], late * state[:, 1], state[:, 3], state[:, 4]], axis=1)


# --------------------------------------------------------------------------------------------------------------------
# The controller
# --------------------------------------------------------------------------------------------------------------------

_STATION_M = 500.0
_TINY = 1e-4


def straight_leg(direction: float) -> LegTable:
    """A leg of 1000 m along x, driven with yaw 0, forward or backwards."""
    length = 2.0 * _STATION_M
    zero = (0.0, 0.0)
    return LegTable(
        sigma=direction,
        step_m=length,
        length_m=length,
        last_row=1,
        x_m=(0.0, length) if direction > 0.0 else (length, 0.0),
        y_m=zero,
        yaw_rad=zero,
        slip_heading_rad=zero,
        slip_curvature_1pm=zero,
        feedforward_curvature_1pm=zero,
        feedforward_slope_1pm2=zero,
        speed_mps=(1.0, 1.0),
        accel_mps2=zero,
    )


def nominal_car(nominal: Nominal) -> CarTable:
    """The firmware's table of a nominal car whose limits are out of the way."""
    lag = nominal.steering_lag_s
    alpha, mean_weight, late_weight = lag_weights(lag, PERIOD_S)
    return CarTable(
        wheelbase_m=nominal.wheelbase_m,
        steering_lag_s=lag,
        lag_alpha=alpha,
        lag_mean_weight=mean_weight,
        late_weight=late_weight,
        pose_latency_samples=nominal.pose_latency_samples,
        command_latency_samples=nominal.command_latency_samples,
        drive_lag_s=0.3,
        brake_lag_s=0.1,
        gear_change_s=0.5,
        max_road_wheel_angle_rad=1.0,
        max_road_wheel_rate_radps=100.0,
        max_speed_mps=10.0,
        controlled_decel_mps2=1.0,
        emergency_decel_mps2=2.4,
    )


def filter_of(row: Row, mode: Mode) -> kalman.Filter:
    """The estimator's filter as it is in the long run at the speed of a row."""
    walks = (row.w_e, row.w_p, row.w_d)
    return settled(row.direction, row.speed_mps, mode.with_yaw_rate, walks, mode.localisation)


class _Cycle:
    """One cycle of the firmware's law on a straight leg at constant speed, as a function of flat numbers.

    State: place, yaw, road disturbance, steering offset, gyro's bias, road-wheel angle, modelled angle, last yaw rate,
    the pose's slow noise (sideways, yaw), the way gone of the last cycles (place, then yaw, relative to now), the
    commands sent, the integral.
    """

    def __init__(self, row: Row, nominal: Nominal, mode: Mode) -> None:
        self.leg = straight_leg(row.direction)
        self.car = nominal_car(nominal)
        self.mode = mode
        self.speed_mps = row.speed_mps
        table = GainTable((row.speed_mps, row.speed_mps + 1.0), 1, ((row[2:], row[2:]),) * 2)
        self.gains = gains_at(table, 0, row.speed_mps)
        self.filter = filter_of(row, mode)
        if mode.in_bend:
            # At a large angle a change of the learnt gain moves the command as one of the offset does; of the gap it
            # takes this share at most. What a radian turns the car by there is 1 / cos^2 of that on the straight: the
            # feedback divides by it, but what turns the car is learnt from as much more. That counts where poses teach
            # it; by the yaw rate it is learnt at once either way.
            slope = 1.0 / math.cos(nominal.max_road_wheel_angle_rad) ** 2
            gains = self.gains
            self.gains = gains._replace(offset=gains.offset + gains.gain, dr=slope * gains.dr)
            if not mode.with_yaw_rate:
                known = self.filter.gains
                self.filter = self.filter._replace(gains=known._replace(xe=slope * known.xe, xp=slope * known.xp))
        self.memory = nominal.pose_latency_samples if mode.predicts else 0
        self.sent = nominal.command_latency_samples + 2
        self.size = 10 + 2 * self.memory + self.sent + 1

    def __call__(self, state: Floats, report: Floats) -> tuple[Floats, float]:
        """Next state and command (rad) from a state and a report, `OUTPUTS` numbers."""
        leg, car, sigma = self.leg, self.car, self.leg.sigma
        ds_m = self.speed_mps * PERIOD_S
        n = self.memory
        y, yaw, road, offset, bias, angle, modelled, yaw_rate, slow_y, slow_yaw = (float(v) for v in state[:10])
        rest = [float(v) for v in state[10:]]
        way_y, way_yaw, sent, integral = rest[:n], rest[n : 2 * n], rest[2 * n : -1], rest[-1]
        way = estimator.ODOMETRY_LENGTH
        believed = estimator.begin()._replace(
            x_m=_STATION_M,
            y_m=y,
            yaw_rad=yaw,
            station_m=_STATION_M,
            road_disturbance_rad=road,
            steering_offset_rad=offset,
            gyro_bias_radps=bias,
            road_wheel_angle_rad=angle,
            modelled_angle_rad=modelled,
            yaw_rate_radps=yaw_rate,
            odometry_y_m=(0.0, *way_y, *(0.0,) * (way - 1 - n)),
            odometry_yaw_rad=(0.0, *way_yaw, *(0.0,) * (way - 1 - n)),
            slow_cross_m=slow_y,
            slow_heading_rad=slow_yaw,
            filter=self.filter,
        )
        # The command that acts between two reports, as the controller has it.
        oldest = len(sent) - 1
        acted = sent[oldest - 1] + car.late_weight * (sent[oldest] - sent[oldest - 1])
        motion = estimator.Motion(
            ds_m, PERIOD_S, acted, float(report[3]), 1, float(report[2]), int(self.mode.with_yaw_rate), 0, 1
        )
        body_m = sigma * ds_m
        seen = estimator.estimate(
            leg,
            car,
            self.gains,
            believed,
            motion,
            1,
            _STATION_M + (body_m if n == 0 else 0.0),
            float(report[0]),
            float(report[1]),
            n,
            0.0,
            int(self.mode.predicts),
        )
        assert seen.disbelieved == 0
        queue = (*sent, *(0.0,) * (QUEUE_LENGTH - len(sent)))
        _, cross_m, heading_rad, angle_rad = predictor.predict(leg, car, seen, queue, self.speed_mps, PERIOD_S)
        if not self.mode.predicts:
            cross_m, heading_rad = seen.cross_track_error_m, seen.heading_error_rad
        preview_m = pid.preview_error_m(cross_m, heading_rad, self.gains.preview_m, sigma)
        feedback_1pm = pid.feedback_1pm(preview_m, heading_rad, integral, self.gains, sigma)
        wanted = math.atan(-car.wheelbase_m * feedback_1pm) - seen.road_disturbance_rad
        if self.mode.predicts:
            wanted += pid.push_rad(wanted - angle_rad, car)
        command = wanted - seen.steering_offset_rad
        integral = pid.integrate_m2(integral, preview_m, ds_m, self.gains, 0)
        odometry_y, odometry_yaw = seen.odometry_y_m, seen.odometry_yaw_rad
        after = [
            seen.y_m,
            seen.yaw_rad,
            seen.road_disturbance_rad,
            seen.steering_offset_rad,
            seen.gyro_bias_radps,
            seen.road_wheel_angle_rad,
            seen.modelled_angle_rad,
            seen.yaw_rate_radps,
            seen.slow_cross_m,
            seen.slow_heading_rad,
            *(odometry_y[i] - odometry_y[0] for i in range(1, n + 1)),
            *(odometry_yaw[i] - odometry_yaw[0] for i in range(1, n + 1)),
            command,
            *sent[:-1],
            integral,
        ]
        return np.array(after), command


def controller(row: Row, nominal: Nominal, mode: Mode = Mode()) -> StateSpace:  # noqa: B008  (immutable)
    """From a report (`OUTPUTS`) to the commanded angle, rad, as the firmware runs it; linear by central differences.

    A state that nothing changes and that keeps its value, like an integral without gain, is no state of the loop and is
    left out.
    """
    cycle = _Cycle(row, nominal, mode)
    size = cycle.size
    columns = np.zeros((size + 1, size + OUTPUTS))
    for index in range(size + OUTPUTS):
        point = np.zeros(size + OUTPUTS)
        point[index] = _TINY
        ahead, command = cycle(point[:size], point[size:])
        behind, command_behind = cycle(-point[:size], -point[size:])
        columns[:size, index] = (ahead - behind) / (2.0 * _TINY)
        columns[size, index] = (command - command_behind) / (2.0 * _TINY)
    columns[np.abs(columns) < 1e-13] = 0.0
    idle = [index for index in range(size) if columns[index, index] == 1.0 and np.count_nonzero(columns[index]) == 1]
    keep = [index for index in range(size) if index not in idle]
    return StateSpace(
        columns[np.ix_(keep, keep)],
        columns[np.ix_(keep, range(size, size + OUTPUTS))],
        columns[np.ix_([size], keep)],
        columns[size:, size:],
    )


def response(system: StateSpace, z: Complexes) -> Complexes:
    """Frequency response of a system at the points z, shape (len(z), outputs, inputs)."""
    state = np.linalg.solve(
        z[:, None, None] * np.eye(len(system.a)) - system.a, np.broadcast_to(system.b, (len(z), *system.b.shape))
    )
    return np.asarray(system.c @ state + system.d)


# --------------------------------------------------------------------------------------------------------------------
# The loop
# --------------------------------------------------------------------------------------------------------------------


def open_loop(law: StateSpace, plant: StateSpace) -> StateSpace:
    """The loop cut at the steering command, from the command that the car gets to minus the one that comes back.

    Negative feedback: the loop is closed by u = -y, its characteristic is 1 + L.
    """
    n, m = len(plant.a), len(law.a)
    a = np.zeros((n + m, n + m))
    a[:n, :n] = plant.a
    a[n:, :n] = law.b @ plant.c
    a[n:, n:] = law.a
    b = np.vstack([plant.b, np.zeros((m, 1))])
    c = -np.hstack([law.d @ plant.c, law.c])
    return StateSpace(a, b, c, np.zeros((1, 1)))


def closed_loop(law: StateSpace, plant: StateSpace) -> Floats:
    """State matrix of the closed loop."""
    loop = open_loop(law, plant)
    return np.asarray(loop.a - loop.b @ loop.c)


def loops(law: StateSpace, answers: Complexes, z: Complexes) -> Complexes:
    """L of `open_loop` at the points z, shape (cars, len(z)), for cars whose `car_response` is given."""
    return np.asarray(-np.sum(response(law, z)[:, 0, :] * answers, axis=-1))


def loop_response(law: StateSpace, row: Row, corners: Sequence[Corner], z: Complexes) -> Complexes:
    """The same for several cars under one controller, shape (len(corners), len(z))."""
    return loops(law, np.stack([car_response(corner, row.speed_mps, row.direction, z) for corner in corners]), z)


def is_stable(matrix: Floats) -> bool:
    """Whether the states of a cycle's matrix decay."""
    return bool(np.abs(np.linalg.eigvals(matrix)).max() < 1.0)


def poles_1pm(matrix: Floats, speed_mps: float) -> Complexes:
    """Eigenvalues of a cycle's matrix as poles per metre of travel, ln(z) / ds; dead-beat ones are left out."""
    z = np.linalg.eigvals(matrix).astype(np.complex128)
    # A chain of n samples has n eigenvalues at 0, which rounding spreads to eps^(1/n).
    z = z[np.abs(z) > 1e-12]
    return np.asarray(np.log(z) / (speed_mps * PERIOD_S))
