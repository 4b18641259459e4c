"""Sensors: from the plant's truth to what the reports say. Latency of the pose is the emulator's (it keeps history)."""

import random
from math import exp, floor, pi, sqrt
from typing import NamedTuple

from sim.data_files import Sensors


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


class SensorSet:
    """All sensors of car and localiser with their random state; the same seed and calls give the same samples."""

    def __init__(self, config: Sensors, seed: int) -> None:
        rng = random.Random(f"sensors {seed}")
        self._rng = rng
        self._config = config
        self._scale = 1.0 + rng.uniform(*config.odometry_scale)
        self._noisy_pose = config.position_noise_m > 0.0 or config.yaw_noise_rad > 0.0
        self._noise_x = rng.gauss(0.0, 1.0)
        self._noise_y = rng.gauss(0.0, 1.0)
        self._noise_yaw = rng.gauss(0.0, 1.0)
        self._gyro_bias = 0.0
        self._last_dt_s = -1.0
        self._keep = 0.0
        self._add = 1.0
        self._walk = 0.0

    def _pace(self, dt_s: float) -> None:
        """Coefficients of the correlated noises for a time between samples."""
        self._last_dt_s = dt_s
        correlation = self._config.pose_noise_correlation_s
        self._keep = exp(-dt_s / correlation) if correlation > 0.0 else 0.0
        self._add = sqrt(1.0 - self._keep * self._keep)
        self._walk = self._config.gyro_bias_walk_radps_per_root_s * sqrt(dt_s)

    def sample(
        self,
        dt_s: float,
        pose: tuple[float, float, float],
        speed_mps: float,
        yaw_rate_radps: float,
        rack_angle_rad: float,
    ) -> Measured:
        """Measure, `dt_s` after the last sample. Pose is that of the rear-axle centre, already delayed (m, m, rad)."""
        config = self._config
        gauss = self._rng.gauss
        if dt_s != self._last_dt_s:
            self._pace(dt_s)
        x, y, yaw = pose
        if self._noisy_pose:
            keep, add = self._keep, self._add
            self._noise_x = keep * self._noise_x + add * gauss(0.0, 1.0)
            self._noise_y = keep * self._noise_y + add * gauss(0.0, 1.0)
            self._noise_yaw = keep * self._noise_yaw + add * gauss(0.0, 1.0)
            x += config.position_noise_m * self._noise_x
            y += config.position_noise_m * self._noise_y
            yaw += config.yaw_noise_rad * self._noise_yaw
        drop = config.pose_drop_probability
        is_sent = drop <= 0.0 or self._rng.random() >= drop
        speed = speed_mps * self._scale
        if config.speed_noise_mps > 0.0 and speed_mps != 0.0:  # wheels that stand still count nothing
            speed += gauss(0.0, config.speed_noise_mps)
        yaw_rate = yaw_rate_radps
        if self._walk > 0.0:
            self._gyro_bias += gauss(0.0, self._walk)
        if config.gyro_noise_radps > 0.0:
            yaw_rate += gauss(0.0, config.gyro_noise_radps)
        yaw_rate += self._gyro_bias
        return Measured(
            quantise(x, config.position_resolution_m),
            quantise(y, config.position_resolution_m),
            quantise(wrap(yaw), config.yaw_resolution_rad),
            is_sent,
            quantise(speed, config.speed_resolution_mps),
            yaw_rate,
            quantise(rack_angle_rad, config.steering_resolution_rad),
        )
