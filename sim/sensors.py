"""Sensors: from the plant's truth to what the reports say. Latency of the pose is the plant's (it keeps history).

`measure` is a pure function on floats and NamedTuples; the standard normals that it consumes are drawn before, a row a
sample (`NoiseRows`), so that the same noise comes out wherever it runs, live or compiled.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from math import exp, floor, inf, pi, sqrt
from statistics import NormalDist
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from sim.data_files import Sensors

# Columns of a row of normals.
FOR_X, FOR_Y, FOR_YAW, FOR_DROP, FOR_SPEED, FOR_GYRO_WALK, FOR_GYRO = range(7)
NORMALS = 7
BLOCK_ROWS = 256


class SensorParameters(NamedTuple):
    """Errors of all sensors, as `sim.data_files.Sensors` describes them.

    `odometry_factor` is measured over true speed; a pose is dropped where its normal lies below `drop_below`.
    """

    position_noise_m: float
    yaw_noise_rad: float
    pose_noise_correlation_s: float
    drop_below: float
    position_resolution_m: float
    yaw_resolution_rad: float
    steering_resolution_rad: float
    speed_resolution_mps: float
    speed_noise_mps: float
    odometry_factor: float
    gyro_noise_radps: float
    gyro_bias_walk_radps_per_root_s: float


class SensorState(NamedTuple):
    """Correlated pose noise in standard deviations, and the gyro's bias in rad/s."""

    noise_x: float
    noise_y: float
    noise_yaw: float
    gyro_bias_radps: float


class Measured(NamedTuple):
    """One sample of all sensors; `pose_is_sent` is False where the localiser dropped its sample."""

    x_m: float
    y_m: float
    yaw_rad: float
    pose_is_sent: bool
    speed_mps: float
    yaw_rate_radps: float
    road_wheel_angle_rad: float


def wrap(angle_rad: float) -> float:
    """Return the angle in [-pi, pi), untouched where it lies there."""
    if -pi <= angle_rad < pi:
        return angle_rad
    return (angle_rad + pi) % (2.0 * pi) - pi


def quantise(value: float, resolution: float) -> float:
    """Nearest multiple of the resolution, halves upward; the value itself where the resolution is 0."""
    return resolution * floor(value / resolution + 0.5) if resolution > 0.0 else value


def parameters_of(config: Sensors, seed: int) -> SensorParameters:
    """Return the parameters of one run; the odometry's scale is drawn by the seed."""
    drop = config.pose_drop_probability
    below = -inf if drop <= 0.0 else inf if drop >= 1.0 else NormalDist().inv_cdf(drop)
    return SensorParameters(
        position_noise_m=config.position_noise_m,
        yaw_noise_rad=config.yaw_noise_rad,
        pose_noise_correlation_s=config.pose_noise_correlation_s,
        drop_below=below,
        position_resolution_m=config.position_resolution_m,
        yaw_resolution_rad=config.yaw_resolution_rad,
        steering_resolution_rad=config.steering_resolution_rad,
        speed_resolution_mps=config.speed_resolution_mps,
        speed_noise_mps=config.speed_noise_mps,
        odometry_factor=1.0 + random.Random(f"sensors {seed}").uniform(*config.odometry_scale),
        gyro_noise_radps=config.gyro_noise_radps,
        gyro_bias_walk_radps_per_root_s=config.gyro_bias_walk_radps_per_root_s,
    )


def first_state(normals: Sequence[float]) -> SensorState:
    """Return the state before the first sample, from the first row of normals: correlated noise has no run-up."""
    return SensorState(normals[FOR_X], normals[FOR_Y], normals[FOR_YAW], 0.0)


def measure(
    p: SensorParameters,
    s: SensorState,
    normals: Sequence[float],
    dt_s: float,
    pose: tuple[float, float, float],
    speed_mps: float,
    yaw_rate_radps: float,
    rack_angle_rad: float,
) -> tuple[SensorState, Measured]:
    """Measure, `dt_s` after the last sample. Pose is that of the rear-axle centre, already delayed (m, m, rad)."""
    x, y, yaw = pose
    noise_x, noise_y, noise_yaw, gyro_bias = s
    if p.position_noise_m > 0.0 or p.yaw_noise_rad > 0.0:
        keep = 0.0
        if p.pose_noise_correlation_s > 0.0:
            keep = exp(-dt_s / p.pose_noise_correlation_s)
        add = sqrt(1.0 - keep * keep)
        noise_x = keep * noise_x + add * normals[FOR_X]
        noise_y = keep * noise_y + add * normals[FOR_Y]
        noise_yaw = keep * noise_yaw + add * normals[FOR_YAW]
        x += p.position_noise_m * noise_x
        y += p.position_noise_m * noise_y
        yaw += p.yaw_noise_rad * noise_yaw
    speed = speed_mps * p.odometry_factor
    if speed_mps != 0.0:  # wheels that stand still count nothing
        speed += p.speed_noise_mps * normals[FOR_SPEED]
    gyro_bias += p.gyro_bias_walk_radps_per_root_s * sqrt(dt_s) * normals[FOR_GYRO_WALK]
    yaw_rate = yaw_rate_radps + p.gyro_noise_radps * normals[FOR_GYRO]
    yaw_rate += gyro_bias
    measured = Measured(
        quantise(x, p.position_resolution_m),
        quantise(y, p.position_resolution_m),
        quantise(wrap(yaw), p.yaw_resolution_rad),
        normals[FOR_DROP] >= p.drop_below,
        quantise(speed, p.speed_resolution_mps),
        yaw_rate,
        quantise(rack_angle_rad, p.steering_resolution_rad),
    )
    return SensorState(noise_x, noise_y, noise_yaw, gyro_bias), measured


class NoiseRows:
    """The standard normals of one run, row by row; the same seed gives the same rows whatever the blocks."""

    def __init__(self, seed: int) -> None:
        import numpy as np  # noqa: PLC0415 -- the pure functions above need none

        # Any integer is a seed; numpy's seeds are never negative.
        self._rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence([abs(seed), int(seed < 0)])))
        self._block: list[list[float]] = []
        self._next = 0

    def array(self, rows: int) -> Any:
        """Return the next rows as a float64 array of shape (rows, NORMALS); not after `row`, which draws ahead."""
        return self._rng.standard_normal((rows, NORMALS))

    def row(self) -> list[float]:
        """Return the next row as floats of Python's own."""
        if self._next == len(self._block):
            self._block = self.array(BLOCK_ROWS).tolist()
            self._next = 0
        self._next += 1
        return self._block[self._next - 1]


class SensorSet:
    """All sensors of car and localiser with their noise; the same seed and calls give the same samples."""

    def __init__(self, config: Sensors, seed: int) -> None:
        self._parameters = parameters_of(config, seed)
        self._noise = NoiseRows(seed)
        self._state = first_state(self._noise.row())

    def sample(
        self,
        dt_s: float,
        pose: tuple[float, float, float],
        speed_mps: float,
        yaw_rate_radps: float,
        rack_angle_rad: float,
    ) -> Measured:
        """Measure with the next row of noise; see `measure`."""
        self._state, measured = measure(
            self._parameters, self._state, self._noise.row(), dt_s, pose, speed_mps, yaw_rate_radps, rack_angle_rad
        )
        return measured
