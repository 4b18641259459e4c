"""The law: signs by direction, symmetry of the sides, tables by (direction, speed), nothing moves at standstill."""

import math
import random

import pytest
from core_support import shipped_tables, standing_inputs

from firmware_py.core import controller, motion, pid
from firmware_py.core import signals as s
from firmware_py.core.path import feedforward_at, feedforward_curvature_1pm, pose_at, wrap_angle
from firmware_py.core.schedule import gains_at
from firmware_py.core.tables import GAIN_COLUMNS, KP

FORWARD, REVERSE = 0, 1


def test_angles_wrap_into_minus_pi_to_pi():
    for turns in range(-3, 4):
        for angle in (-math.pi, -1.0, 0.0, 1.0, 3.1):
            assert wrap_angle(angle + 2 * math.pi * turns) == pytest.approx(angle, abs=1e-12)


@pytest.mark.parametrize("direction", [FORWARD, REVERSE])
def test_the_path_goes_on_straight_beyond_its_ends(direction):
    leg = shipped_tables().leg[direction]
    for station_m, inside_m in ((-0.3, 0.0), (leg.length_m + 0.3, leg.length_m)):
        x_m, y_m, yaw_rad, *slip = pose_at(leg, station_m)
        at_x_m, at_y_m, at_yaw_rad, *at_slip = pose_at(leg, inside_m)
        along_m = leg.sigma * (station_m - inside_m)
        assert x_m == pytest.approx(at_x_m + along_m * math.cos(at_yaw_rad), abs=1e-12)
        assert y_m == pytest.approx(at_y_m + along_m * math.sin(at_yaw_rad), abs=1e-12)
        assert (yaw_rad, slip) == (at_yaw_rad, at_slip)
        assert feedforward_curvature_1pm(leg, station_m) == feedforward_at(leg, inside_m)[0]


@pytest.mark.parametrize("direction", [FORWARD, REVERSE])
def test_between_two_rows_the_path_is_blended(direction):
    leg = shipped_tables().leg[direction]
    columns = (leg.x_m, leg.y_m, leg.yaw_rad, leg.slip_heading_rad, leg.slip_curvature_1pm)
    for row in (0, 17, leg.last_row - 1):
        found = pose_at(leg, (row + 0.25) * leg.step_m)
        for value, column in zip(found, columns, strict=True):
            assert value == pytest.approx(0.75 * column[row] + 0.25 * column[row + 1], abs=1e-12)


@pytest.mark.parametrize("direction", [FORWARD, REVERSE])
def test_the_two_lookups_of_the_feedforward_agree(direction):
    leg = shipped_tables().leg[direction]
    rng = random.Random(2)
    for _ in range(500):
        station_m = rng.uniform(-0.1, leg.length_m + 0.1)
        assert feedforward_curvature_1pm(leg, station_m) == feedforward_at(leg, station_m)[0]


@pytest.mark.parametrize("direction", [FORWARD, REVERSE])
def test_the_model_on_the_path_with_the_feedforward_stays_on_the_path(direction):
    tables = shipped_tables()
    leg = tables.leg[direction]
    car = tables.car._replace(lag_alpha=1.0, lag_mean_weight=0.0, max_road_wheel_rate_radps=10.0)
    station_m = cross_m = heading_rad = angle_rad = worst_m = 0.0
    while station_m < leg.length_m - 0.02:
        target_rad = math.atan(car.wheelbase_m * feedforward_curvature_1pm(leg, station_m + 0.005))
        station_m, cross_m, heading_rad, angle_rad = motion.advance(
            leg, car, station_m, cross_m, heading_rad, angle_rad, target_rad, 0.0, 1.0, 0.01
        )
        worst_m = max(worst_m, abs(cross_m))
    assert worst_m < 1e-4
    # and the model turns to the side to which a disturbance turns the wheels
    pushed = motion.advance(leg, car, 0.0, 0.0, 0.0, 0.0, 0.0, 0.04, 1.0, 0.01)
    assert pushed[2] * leg.sigma > 0


def test_gains_are_exactly_those_of_the_row_and_held_beyond_the_grid():
    table = shipped_tables().gains
    for direction in (FORWARD, REVERSE):
        for row, speed_mps in enumerate(table.speed_grid_mps):
            found = gains_at(table, direction, speed_mps)
            assert list(found) == pytest.approx(table.gain[direction][row], abs=1e-13)
        assert gains_at(table, direction, 99.0) == gains_at(table, direction, table.speed_grid_mps[-1])


@pytest.mark.parametrize("column", range(GAIN_COLUMNS))
def test_changing_one_row_of_one_direction_changes_nothing_else(column):
    table = shipped_tables().gains
    row = table.last_row // 2
    changed_row = tuple(v + (1.0 if i == column else 0.0) for i, v in enumerate(table.gain[REVERSE][row]))
    reverse = tuple(changed_row if i == row else r for i, r in enumerate(table.gain[REVERSE]))
    changed = table._replace(gain=(table.gain[FORWARD], reverse))
    grid = table.speed_grid_mps
    for step in range(1101):
        speed_mps = step * 1e-3
        inside = grid[row - 1] < speed_mps < grid[row + 1]
        assert gains_at(changed, FORWARD, speed_mps) == gains_at(table, FORWARD, speed_mps)
        before, after = gains_at(table, REVERSE, speed_mps), gains_at(changed, REVERSE, speed_mps)
        for of_column, (one, other) in enumerate(zip(before, after, strict=True)):
            assert (abs(other - one) > 1e-9) == (inside and of_column == column)


def command_beside_the_path_rad(used_tables, left_m):
    """The command to a car that is about to drive forward, so far left of the path."""
    state = controller.begin()
    angle_rad = 0.0
    for cycle in range(140):
        inputs = standing_inputs(used_tables, cycle, s.MODE_READY if cycle < 61 else s.MODE_ACTIVE)
        inputs = inputs._replace(
            oper=inputs.oper._replace(oper_start=1 if cycle >= 60 else 0),
            position=inputs.position._replace(position_y_m=left_m),
            long=inputs.long._replace(gear_rpt=s.GEAR_DRIVE, park_brake_applied=0),
            steer=inputs.steer._replace(road_wheel_angle_meas_rad=angle_rad),
        )
        state, outputs = controller.step(used_tables, state, inputs)
        angle_rad = outputs.steer.road_wheel_angle_cmd_rad
    assert outputs.sys.control_mode == s.MODE_ACTIVE
    return angle_rad


def test_the_controller_uses_the_row_of_its_direction():
    """A forward-only change of kp changes a forward command and leaves the reverse model untouched."""
    tables = shipped_tables()
    louder = tuple(tuple(3.0 * v if i == KP else v for i, v in enumerate(row)) for row in tables.gains.gain[FORWARD])
    forward_changed = tables._replace(gains=tables.gains._replace(gain=(louder, tables.gains.gain[REVERSE])))
    reverse_changed = tables._replace(gains=tables.gains._replace(gain=(tables.gains.gain[FORWARD], louder)))
    command_rad = command_beside_the_path_rad(tables, 0.0015)
    assert command_rad < -0.01, "left of the path, driving forward: steer to the right"
    assert command_beside_the_path_rad(forward_changed, 0.0015) < 2.0 * command_rad
    assert command_beside_the_path_rad(reverse_changed, 0.0015) == command_rad


def test_the_feedback_is_linear_near_the_path_and_bounded_far_from_it():
    tables = shipped_tables()
    near_rad, twice_rad, far_rad, farther_rad = (
        command_beside_the_path_rad(tables, left_m) for left_m in (0.001, 0.002, 0.02, 0.05)
    )
    assert twice_rad == pytest.approx(2.0 * near_rad, rel=0.05)
    most_rad = math.atan(tables.car.wheelbase_m * pid.CORRECTION_MAX_1PM)
    assert far_rad == farther_rad == pytest.approx(-most_rad, abs=1e-3)


def test_the_integral_stands_still_while_limited_and_stays_within_its_authority():
    gains = gains_at(shipped_tables().gains, FORWARD, 0.5)._replace(ki=0.4)
    assert pid.integrate_m2(0.01, 0.05, 0.01, gains, 1) == 0.01
    integral = 0.0
    for _ in range(100_000):
        integral = pid.integrate_m2(integral, 0.05, 0.01, gains, 0)
    assert gains.ki * integral == pytest.approx(pid.INTEGRAL_AUTHORITY_1PM)


@pytest.mark.parametrize("lag_s", [0.05, 0.1, 0.3])
def test_the_push_makes_steerings_of_any_lag_as_much_faster(lag_s):
    """A step of the wanted angle by a steering with a lag that the tables do not know."""
    car = shipped_tables().car
    angle_rad, pushed_rad = 0.0, 0.0
    step_s = 1e-4
    for _ in range(round(lag_s / step_s)):
        angle_rad += step_s / lag_s * (0.01 - angle_rad)
        pushed_rad += step_s / lag_s * (0.01 + pid.push_rad(0.01 - pushed_rad, car) - pushed_rad)
    assert angle_rad == pytest.approx(0.01 * (1.0 - math.exp(-1.0)), rel=1e-2)
    assert pushed_rad == pytest.approx(0.01 * (1.0 - math.exp(-1.82)), rel=1e-2)


def test_wheels_that_stand_as_wanted_and_a_steering_without_lag_get_no_push():
    car = shipped_tables().car
    assert pid.push_rad(0.0, car) == 0.0
    assert pid.push_rad(0.01, car) > 0.0
    assert pid.push_rad(0.01, car._replace(lag_alpha=1.0)) == 0.0


def test_the_push_is_what_the_nominal_actuator_would_still_lack_when_a_command_begins_to_act():
    car = shipped_tables().car
    for samples in (0, 1, 24):
        left = math.exp(-(samples + 1) * controller.PERIOD_S / car.steering_lag_s)
        assert pid.push_rad(-0.02, car._replace(command_latency_samples=samples)) == pytest.approx(-0.02 * left)


@pytest.mark.parametrize("sigma", [1.0, -1.0])
def test_a_car_far_off_comes_back_at_an_angle_of_about_one_and_a_half_degrees(sigma):
    """At that angle the feedback changes its sign, however far off the car is."""
    gains = gains_at(shipped_tables().gains, FORWARD, 1.0)
    for e_m in (0.03, 0.05, 0.5):
        for heading_rad, sign in ((math.radians(1.0), 1.0), (math.radians(1.8), -1.0)):
            error_m = pid.preview_error_m(e_m, -sigma * heading_rad, gains.preview_m, sigma)
            assert sign * pid.feedback_1pm(error_m, -sigma * heading_rad, 0.0, gains, sigma) > 0.0


def test_the_right_side_is_the_exact_mirror_of_the_left():
    left, right = shipped_tables("left"), shipped_tables("right")
    rng = random.Random(5)
    states = {side: controller.begin() for side in ("left", "right")}
    for cycle in range(400):
        mode = s.MODE_READY if cycle < 61 else s.MODE_ACTIVE
        inputs = standing_inputs(left, cycle, mode)
        noise_m, noise_rad, speed_mps = rng.gauss(0, 0.01), rng.gauss(0, 0.002), max(0.0, (cycle - 150) * 0.002)
        inputs = inputs._replace(
            oper=inputs.oper._replace(oper_start=1 if cycle >= 60 else 0),
            long=inputs.long._replace(
                gear_rpt=s.GEAR_DRIVE, park_brake_applied=0, standstill=1 if speed_mps == 0.0 else 0
            ),
            motion=inputs.motion._replace(speed_meas_mps=speed_mps),
        )
        angles = {}
        for side, sign, tables in (("left", 1.0, left), ("right", -1.0, right)):
            mirrored = inputs._replace(
                position=inputs.position._replace(position_y_m=sign * noise_m),
                attitude=inputs.attitude._replace(yaw_rad=sign * noise_rad),
            )
            states[side], outputs = controller.step(tables, states[side], mirrored)
            angles[side] = outputs.steer.road_wheel_angle_cmd_rad
        assert angles["right"] == pytest.approx(-angles["left"], abs=2 * left.road_wheel_angle_lsb_rad)
    assert abs(angles["left"]) > 1e-3
