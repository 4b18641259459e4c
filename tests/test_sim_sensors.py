"""Sensors: statistics of each noise, quantisation, scale, drop-out, repeatability."""

from __future__ import annotations

import math
import statistics
from typing import Any

import pytest

from sim.data_files import Sensors, load_scenario
from sim.sensors import Measured, SensorSet, quantise, wrap

POSE = (3.0, -1.0, 0.2)


def samples(n: int, seed: int = 1, dt_s: float = 0.01, **config: Any) -> list[Measured]:
    sensors = SensorSet(Sensors(**config), seed)
    return [sensors.sample(dt_s, POSE, 0.8, 0.1, 0.3) for _ in range(n)]


def test_without_errors_the_truth_comes_through_untouched() -> None:
    assert samples(3) == [Measured(3.0, -1.0, 0.2, True, 0.8, 0.1, 0.3)] * 3


def test_white_pose_noise_has_its_deviation_no_mean_and_no_memory() -> None:
    all_of = samples(8000, position_noise_m=0.01, yaw_noise_rad=0.0017453)
    for values, truth, sigma in (
        ([m.x_m for m in all_of], 3.0, 0.01),
        ([m.y_m for m in all_of], -1.0, 0.01),
        ([m.yaw_rad for m in all_of], 0.2, 0.0017453),
    ):
        errors = [value - truth for value in values]
        assert statistics.stdev(errors) == pytest.approx(sigma, rel=0.03)
        assert statistics.mean(errors) == pytest.approx(0.0, abs=4 * sigma / math.sqrt(8000))
        assert abs(statistics.correlation(errors[1:], errors[:-1])) < 0.05
    dx, dy = [m.x_m - 3.0 for m in all_of], [m.y_m + 1.0 for m in all_of]
    assert abs(statistics.correlation(dx, dy)) < 0.05


@pytest.mark.parametrize("dt_s", [0.01, 0.02])
def test_correlated_noise_has_its_time_constant_whatever_the_pace(dt_s: float) -> None:
    """Autocorrelation exp(-dt/tau) from sample to sample, and the full deviation from the first one on."""
    errors = [m.x_m - 3.0 for m in samples(60000, dt_s=dt_s, position_noise_m=0.01, pose_noise_correlation_s=0.2)]
    assert statistics.stdev(errors) == pytest.approx(0.01, rel=0.05)
    for lag in (1, 10):
        expected = math.exp(-lag * dt_s / 0.2)
        assert statistics.correlation(errors[lag:], errors[:-lag]) == pytest.approx(expected, abs=0.04)
    first = [samples(1, seed, position_noise_m=0.01, pose_noise_correlation_s=5.0)[0].x_m - 3.0 for seed in range(500)]
    assert statistics.stdev(first) == pytest.approx(0.01, rel=0.12)


def test_correlated_noise_moves_slowly() -> None:
    drift = [m.x_m for m in samples(500, position_noise_m=0.01, pose_noise_correlation_s=5.0)]
    white = [m.x_m for m in samples(500, position_noise_m=0.01)]
    jumps = [statistics.mean(abs(a - b) for a, b in zip(v[1:], v[:-1], strict=True)) for v in (drift, white)]
    assert jumps[0] < 0.1 * jumps[1]


def test_the_gyros_noise_is_white_and_its_bias_walks() -> None:
    white = [m.yaw_rate_radps - 0.1 for m in samples(5000, gyro_noise_radps=3.5e-4)]
    assert statistics.stdev(white) == pytest.approx(3.5e-4, rel=0.04)
    ends = [samples(100, seed, gyro_bias_walk_radps_per_root_s=3.5e-5)[-1].yaw_rate_radps - 0.1 for seed in range(300)]
    assert statistics.stdev(ends) == pytest.approx(3.5e-5 * math.sqrt(100 * 0.01), rel=0.12)
    walk = [m.yaw_rate_radps for m in samples(100, gyro_bias_walk_radps_per_root_s=3.5e-5)]
    assert max(abs(a - b) for a, b in zip(walk[1:], walk[:-1], strict=True)) < 3.5e-5 * 0.1 * 5


def test_odometry_reads_too_much_and_in_steps() -> None:
    assert samples(1, odometry_scale=(0.01, 0.01))[0].speed_mps == pytest.approx(0.808)
    assert samples(1, odometry_scale=(0.01, 0.01), speed_resolution_mps=0.005)[0].speed_mps == pytest.approx(0.810)
    scales = {samples(1, seed, odometry_scale=(-0.01, 0.01))[0].speed_mps / 0.8 - 1.0 for seed in range(100)}
    assert -0.01 <= min(scales) < -0.009
    assert 0.009 < max(scales) <= 0.01


def test_speed_noise() -> None:
    errors = [m.speed_mps - 0.8 for m in samples(5000, speed_noise_mps=0.01)]
    assert statistics.stdev(errors) == pytest.approx(0.01, rel=0.04)
    still = SensorSet(Sensors(speed_noise_mps=0.01), 1)
    assert [still.sample(0.01, POSE, 0.0, 0.0, 0.0).speed_mps for _ in range(5)] == [0.0] * 5


def test_resolutions_round_to_the_nearest_step() -> None:
    m = samples(1, position_resolution_m=0.07, yaw_resolution_rad=0.015, steering_resolution_rad=0.00034)[0]
    assert (m.x_m, m.y_m) == pytest.approx((3.01, -0.98))
    assert m.yaw_rad == pytest.approx(0.195)
    assert m.road_wheel_angle_rad == pytest.approx(0.3, abs=0.00017)
    assert round(m.road_wheel_angle_rad / 0.00034) == pytest.approx(m.road_wheel_angle_rad / 0.00034)
    assert [quantise(v, 0.5) for v in (0.24, 0.25, -0.25, -0.26, 7.3)] == [0.0, 0.5, 0.0, -0.5, 7.5]
    assert quantise(0.123, 0.0) == 0.123


def test_dropped_samples_have_their_share_and_do_not_stop_the_noise() -> None:
    share = statistics.mean(not m.pose_is_sent for m in samples(4000, pose_drop_probability=0.1))
    assert share == pytest.approx(0.1, abs=0.02)
    assert not any(m.pose_is_sent for m in samples(50, pose_drop_probability=1.0))
    assert all(m.pose_is_sent for m in samples(50))


def test_yaw_stays_in_the_dbc_s_range() -> None:
    assert wrap(math.pi) == pytest.approx(-math.pi)
    assert wrap(-math.pi) == pytest.approx(-math.pi)
    assert wrap(7.0) == pytest.approx(7.0 - 2.0 * math.pi)
    for angle in (-9.0, -3.2, 0.0, 3.2, 9.0):
        assert -math.pi <= wrap(angle) < math.pi
        assert math.cos(wrap(angle)) == pytest.approx(math.cos(angle))


def test_the_seed_decides_all() -> None:
    config = load_scenario("car").sensors
    runs = [[SensorSet(config, seed).sample(0.01, POSE, 0.8, 0.1, 0.3) for _ in range(1)] for seed in (4, 4, 5)]
    assert runs[0] == runs[1] != runs[2]
