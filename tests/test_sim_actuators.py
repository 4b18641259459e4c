"""Steering, drive and brake: each effect by hand."""

from __future__ import annotations

import math
import random
import types
from typing import Any

import pytest

import sim.actuators
from sim.actuators import SteeringParameters, SteeringState, steering_target, step_speed, step_steering

MS = 1.0e-3
IDEAL = SteeringParameters(0.5, 0.59, 0.0, 1.0, 0.0, 0.0, 0.0)
REST = SteeringState(0.0, 0.0, 0.0)


def steer(p: SteeringParameters, s: SteeringState, target: float, seconds: float, h: float = MS) -> SteeringState:
    for _ in range(round(seconds / h)):
        s = step_steering(p, s, target, h)
    return s


# ---------------------------------------------------------------------------------------------------------- steering


@pytest.mark.parametrize(("command", "expected"), [(0.3, 0.3), (0.9, 0.5), (-0.9, -0.5)])
def test_the_greatest_angle_limits_the_command(command: float, expected: float) -> None:
    assert steering_target(IDEAL, command) == expected


def test_gain_acts_after_the_limit() -> None:
    assert steering_target(IDEAL._replace(gain=0.95), 0.9) == pytest.approx(0.475)


@pytest.mark.parametrize(("command", "steps"), [(0.0, 0), (0.00016, 0), (0.00018, 1), (-0.00016, 0), (-0.00018, -1)])
def test_the_converter_rounds_to_its_steps(command: float, steps: int) -> None:
    assert steering_target(IDEAL._replace(resolution_rad=0.00034), command) == pytest.approx(steps * 0.00034, abs=1e-15)


def test_the_rate_limit_is_a_ramp_that_ends_on_the_target() -> None:
    assert steer(IDEAL, REST, 0.4, 0.5).rack_rad == pytest.approx(0.59 * 0.5)
    assert steer(IDEAL, REST, -0.4, 0.5).rack_rad == pytest.approx(-0.59 * 0.5)
    assert steer(IDEAL, REST, 0.4, 0.7).rack_rad == 0.4


def test_the_lag_is_first_order_whatever_the_step() -> None:
    p = IDEAL._replace(lag_s=0.1, max_rate_radps=1e6)
    for h in (1e-3, 1e-4, 0.02):
        # One step of the demand takes h at this rate; from then on it is an exponential.
        s = steer(p, REST, 0.2, h, h)
        first = s.rack_rad
        s = steer(p, s, 0.2, 0.1, h)
        assert 0.2 - s.rack_rad == pytest.approx((0.2 - first) * math.exp(-1.0), rel=1e-9)


def test_the_lag_of_a_ramp_is_exact() -> None:
    """A ramp of rate r behind a lag T, from rest: r (t - T (1 - exp(-t/T)))."""
    p = IDEAL._replace(lag_s=0.1)
    for t in (0.05, 0.2, 0.6):
        expected = 0.59 * (t - 0.1 * (1.0 - math.exp(-t / 0.1)))
        assert steer(p, REST, 0.5, t).rack_rad == pytest.approx(expected, rel=1e-9)
        assert steer(p, REST, 0.5, t, 1e-2).rack_rad == pytest.approx(expected, rel=1e-9)


def test_the_rack_never_exceeds_the_rate_limit() -> None:
    p = IDEAL._replace(lag_s=0.1)
    rng = random.Random(3)
    s, target = REST, 0.0
    for i in range(20000):
        if i % 37 == 0:
            target = rng.uniform(-0.5, 0.5)
        after = step_steering(p, s, target, MS)
        assert abs(after.rack_rad - s.rack_rad) <= 0.59 * MS * (1 + 1e-9)
        assert abs(after.wheel_rad - s.wheel_rad) <= 0.59 * MS * (1 + 1e-9)
        s = after


def test_backlash_has_its_whole_width_once() -> None:
    """0.01 rad of play: the wheel follows 0.005 behind, and stays where it is for 0.01 of the rack's way back."""
    p = IDEAL._replace(half_backlash_rad=0.005)
    s = steer(p, REST, 0.1, 1.0)
    assert (s.rack_rad, s.wheel_rad) == pytest.approx((0.1, 0.095))
    s = steer(p, s, 0.0901, 1.0)
    assert s.wheel_rad == pytest.approx(0.095)
    s = steer(p, s, 0.05, 1.0)
    assert s.wheel_rad == pytest.approx(0.055)
    assert steer(p, REST, 0.004, 1.0).wheel_rad == 0.0


def test_a_settled_rack_costs_no_new_state() -> None:
    s = SteeringState(0.2, 0.2, 0.2)
    assert step_steering(IDEAL, s, 0.2, MS) is s


# -------------------------------------------------------------------------------------------------- drive and brake


def run(
    speed: float, decel: float, speed_target: float, decel_target: float, seconds: float, h: float = MS
) -> tuple[float, float]:
    for _ in range(round(seconds / h)):
        speed, decel = step_speed(0.3, 0.1, speed, decel, speed_target, decel_target, h)
    return speed, decel


@pytest.mark.parametrize("h", [1e-3, 1e-2, 1e-4])
@pytest.mark.parametrize("target", [1.0, -1.0])
def test_speed_follows_its_command_with_the_drive_lag(h: float, target: float) -> None:
    assert run(0.0, 0.0, target, 0.0, 0.3, h)[0] == pytest.approx(target * (1.0 - math.exp(-1.0)), rel=1e-9)


@pytest.mark.parametrize("h", [1e-3, 1e-2, 1e-4])
@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_the_brake_takes_its_lag_and_then_its_deceleration(h: float, direction: float) -> None:
    """Lost speed = a (t - T (1 - exp(-t/T)))."""
    speed, decel = run(direction, 0.0, direction, 2.4, 0.3, h)
    assert decel == pytest.approx(2.4 * (1.0 - math.exp(-3.0)), rel=1e-9)
    assert speed == pytest.approx(direction * (1.0 - 2.4 * (0.3 - 0.1 * (1.0 - math.exp(-3.0)))), rel=1e-9)


def test_the_stopping_distance_is_that_of_the_lag_and_the_deceleration() -> None:
    """v T + v^2 / 2a less a small term: DESIGN's rule adds v times the brake lag."""
    speed, decel, way = 1.0, 0.0, 0.0
    while speed > 0.0:
        before = speed
        speed, decel = step_speed(0.3, 0.1, speed, decel, 1.0, 2.4, MS)
        way += 0.5 * (before + speed) * MS
    assert way == pytest.approx(1.0 * 0.1 + 1.0 / (2 * 2.4), abs=0.015)


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_the_brake_stops_at_exactly_zero_and_holds(direction: float) -> None:
    speed, decel = run(direction, 0.0, direction, 1.0, 3.0)
    assert speed == 0.0
    speed, decel = run(speed, decel, direction, 1.0, 3.0)
    assert speed == 0.0
    assert decel == pytest.approx(1.0)


def test_without_the_brake_a_zero_command_also_ends_at_exactly_zero() -> None:
    assert run(0.5, 0.0, 0.0, 0.0, 1.5)[0] > 0.0
    assert run(0.5, 0.0, 0.0, 0.0, 2.5)[0] == 0.0


def test_a_brake_that_is_let_go_drags_until_it_is_released() -> None:
    held, decel = run(0.0, 2.4, 0.1, 0.0, 0.05)
    assert held == 0.0  # 0.1 / 0.3 m/s^2 of drive against more than 1 m/s^2 of brake
    assert 1.0 < decel < 2.4
    speed, decel = run(0.0, 2.4, 0.1, 0.0, 2.0)
    assert decel == 0.0
    assert speed == pytest.approx(0.1, rel=0.01)


def test_no_lag_means_at_once() -> None:
    assert step_speed(0.0, 0.0, 0.0, 0.0, 0.7, 0.0, MS) == (0.7, 0.0)
    assert step_speed(0.0, 0.0, 0.7, 0.0, 0.7, 2.0, MS) == (pytest.approx(0.698), 2.0)


@pytest.mark.parametrize("speed", [1e-4, -1e-4, 1.5e-3, -1.5e-3])
def test_a_hard_brake_does_not_overshoot(speed: float) -> None:
    assert step_speed(0.3, 0.0, speed, 4.0, speed, 4.0, MS)[0] == 0.0


def test_drive_and_brake_never_change_the_direction() -> None:
    rng = random.Random(5)
    speed, decel = 0.5, 0.0
    for _ in range(5000):
        after, decel = step_speed(0.3, 0.1, speed, decel, speed, rng.choice((0.5, 4.0)), rng.uniform(1e-5, MS))
        assert 0.0 <= after <= speed
        speed = after
    assert speed == 0.0


# --------------------------------------------------------------------------------------------------------- compiling


def test_the_actuators_compile_and_give_the_same_values() -> None:
    numba = pytest.importorskip("numba")

    def fast(function: Any) -> Any:
        return numba.njit(types.FunctionType(function.__code__, function.__globals__, function.__name__))

    target, rack, speed = (fast(f) for f in (steering_target, step_steering, step_speed))
    p = sim.actuators.SteeringParameters(0.5, 0.59, 0.1, 0.95, 0.017, 0.002, 0.00034)
    plain = quick = REST
    v = w = (0.0, 0.0)
    for i in range(2000):
        command = 0.6 * math.sin(0.01 * i)
        assert target(p, command) == steering_target(p, command)
        plain = step_steering(p, plain, steering_target(p, command), MS)
        quick = rack(p, quick, target(p, command), MS)
        brake = 0.0 if i % 500 < 300 else 2.4
        v = step_speed(0.3, 0.1, *v, 0.5, brake, MS)
        w = speed(0.3, 0.1, *w, 0.5, brake, MS)
        assert tuple(quick) == pytest.approx(tuple(plain), abs=1e-14)
        assert w == pytest.approx(v, abs=1e-14)
