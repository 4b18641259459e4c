"""The last gate and the law's own limits: never exceeded, untouched inside, and no number that is none gets out."""

import itertools
import math
from typing import NamedTuple

import pytest
from core_support import shipped_tables

from firmware_py.core import gate, limits
from firmware_py.core import signals as s
from firmware_py.core.speed import HOLD_DECEL_MPS2
from firmware_py.core.supervisor import STOP_CONTROLLED, STOP_EMERGENCY, STOP_NONE

PERIOD_S = 0.01
LSB_RAD = 4e-5
CAR = shipped_tables().car
STEP_RAD = CAR.max_road_wheel_rate_radps * PERIOD_S
TOP_RAD = CAR.max_road_wheel_angle_rad


class Passed(NamedTuple):
    """What the gate returns, by name."""

    angle_rad: float
    angle_carry_rad: float
    speed_mps: float
    brake_decel_mps2: float
    follow: int


def passed(angle_rad, speed_mps=0.5, brake_mps2=0.0, *, previous_rad=0.0, carry_rad=0.0, sigma=1.0, **how):
    how = {"mode": s.MODE_ACTIVE, "reaction": STOP_NONE, "released": 0, **how}
    result = gate.gate(
        CAR,
        LSB_RAD,
        how["mode"],
        how["reaction"],
        how["released"],
        sigma,
        angle_rad,
        speed_mps,
        brake_mps2,
        previous_rad,
        carry_rad,
        PERIOD_S,
    )
    return Passed(*result)


def around(limit):
    """Values dense around a limit, on both sides of zero."""
    near = [0.0, 0.5 * limit, limit - LSB_RAD, limit - 1e-9, limit, limit + 1e-9, limit + LSB_RAD, 2 * limit, 1e9]
    return sorted({sign * value for value in near for sign in (1, -1)})


@pytest.mark.parametrize("previous_rad", [0.0, 0.3, -0.3, TOP_RAD, -TOP_RAD])
def test_angle_and_rate_are_never_exceeded_and_untouched_inside(previous_rad):
    previous_rad = math.floor(previous_rad / LSB_RAD) * LSB_RAD
    for offset in around(STEP_RAD):
        wanted_rad = previous_rad + offset
        result = passed(wanted_rad, previous_rad=previous_rad)
        assert abs(result.angle_rad) <= TOP_RAD
        assert abs(result.angle_rad - previous_rad) <= STEP_RAD
        if abs(offset) <= STEP_RAD - 2 * LSB_RAD and abs(wanted_rad) <= TOP_RAD - 2 * LSB_RAD:
            assert abs(result.angle_rad - wanted_rad) <= 0.5 * LSB_RAD + 1e-12


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_what_is_no_number_holds_the_wheels_and_brakes_and_does_not_stay(bad):
    for angle_rad, speed_mps, brake_mps2 in ((bad, 0.5, 0.0), (0.1, bad, 0.0), (0.1, 0.5, bad)):
        result = passed(angle_rad, speed_mps, brake_mps2, previous_rad=0.1)
        assert all(math.isfinite(value) for value in result)
        if angle_rad is bad:
            assert result.angle_rad == pytest.approx(0.1, abs=LSB_RAD)
        else:
            assert (result.speed_mps, result.brake_decel_mps2) == (0.0, CAR.controlled_decel_mps2)
        after = passed(0.1, 0.5, 0.0, previous_rad=result.angle_rad, carry_rad=result.angle_carry_rad)
        assert after.angle_rad == pytest.approx(0.1, abs=LSB_RAD)
        assert after.speed_mps == 0.5


@pytest.mark.parametrize("sigma", [1.0, -1.0])
def test_speed_is_within_the_car_and_has_the_sign_of_the_leg(sigma):
    for speed_mps in around(CAR.max_speed_mps):
        result = passed(0.0, speed_mps, sigma=sigma)
        assert 0.0 <= sigma * result.speed_mps <= CAR.max_speed_mps
        if 0.0 <= speed_mps <= CAR.max_speed_mps:
            assert result.speed_mps == sigma * speed_mps


def test_brake_and_drive_are_never_asked_for_together():
    result = passed(0.0, 0.5, 0.4)
    assert (result.speed_mps, result.brake_decel_mps2) == (0.0, 0.4)
    assert passed(0.0, 0.5, -3.0).brake_decel_mps2 == 0.0
    assert passed(0.0, 0.5, 99.0).brake_decel_mps2 == CAR.emergency_decel_mps2


@pytest.mark.parametrize("mode", [s.MODE_MANUAL, s.MODE_READY])
def test_nothing_is_followed_before_active(mode):
    result = passed(0.1, 0.5, 0.0, mode=mode)
    assert (result.follow, result.speed_mps, result.brake_decel_mps2) == (0, 0.0, HOLD_DECEL_MPS2)


def test_a_fault_brakes_by_its_reaction_and_steers_on_until_it_is_released():
    expected = {STOP_CONTROLLED: CAR.controlled_decel_mps2, STOP_EMERGENCY: CAR.emergency_decel_mps2}
    for reaction, released in itertools.product(expected, (0, 1)):
        result = passed(0.005, 0.5, 0.0, mode=s.MODE_FAULT, reaction=reaction, released=released)
        assert result.follow == 1 - released
        assert (result.speed_mps, result.brake_decel_mps2) == (0.0, expected[reaction])
        assert result.angle_rad == pytest.approx(0.0 if released else 0.005, abs=LSB_RAD)


def test_the_rounding_remainder_is_carried_so_that_the_mean_is_exact():
    wanted_rad = 0.1 + 0.3 * LSB_RAD
    previous_rad, carry_rad, total_rad = 0.1, 0.0, 0.0
    cycles = 1000
    for _ in range(cycles):
        result = passed(wanted_rad, previous_rad=previous_rad, carry_rad=carry_rad)
        previous_rad, carry_rad = result.angle_rad, result.angle_carry_rad
        assert previous_rad == pytest.approx(round(previous_rad / LSB_RAD) * LSB_RAD, abs=1e-12)
        total_rad += previous_rad
    assert total_rad / cycles == pytest.approx(wanted_rad, abs=LSB_RAD / cycles)


def test_the_laws_own_limits_cut_and_say_so():
    for previous_rad in (0.0, 0.2, -0.2):
        for offset in around(STEP_RAD):
            angle_rad, limited = limits.limit_angle(CAR, previous_rad + offset, previous_rad, PERIOD_S)
            assert abs(angle_rad - previous_rad) <= limits.RATE_SHARE * STEP_RAD + 1e-12
            inside = abs(offset) <= limits.RATE_SHARE * STEP_RAD
            assert limited == (0 if inside else 1)
            if inside:
                assert angle_rad == pytest.approx(previous_rad + offset, abs=1e-15)
    assert limits.limit_angle(CAR, TOP_RAD + 0.1, TOP_RAD, PERIOD_S) == (TOP_RAD, 1)
