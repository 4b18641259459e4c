"""The law: signs by direction, symmetry of the sides, tables by (direction, speed), nothing moves at standstill."""

import math
import random

import pytest
from core_support import shipped_tables, standing_inputs

from firmware_py.core import controller, motion, observer, pid, predictor
from firmware_py.core import signals as s
from firmware_py.core.path import feedforward_at, feedforward_curvature_1pm, locate, pose_error, wrap_angle
from firmware_py.core.schedule import gains_at
from firmware_py.core.tables import GAIN_COLUMNS, KP

FORWARD, REVERSE = 0, 1


def test_angles_wrap_into_minus_pi_to_pi():
    for turns in range(-3, 4):
        for angle in (-math.pi, -1.0, 0.0, 1.0, 3.1):
            assert wrap_angle(angle + 2 * math.pi * turns) == pytest.approx(angle, abs=1e-12)


@pytest.mark.parametrize("direction", [FORWARD, REVERSE])
def test_error_signs_are_the_bodys_in_both_directions(direction):
    leg = shipped_tables().leg[direction]
    point = locate(leg, 0.5 * leg.length_m)
    left = (point.x_m - 0.1 * math.sin(point.yaw_rad), point.y_m + 0.1 * math.cos(point.yaw_rad))
    body_yaw_rad = point.yaw_rad + point.slip_heading_rad
    error = pose_error(point, leg.sigma, *left, body_yaw_rad + 0.05)
    assert error.cross_track_error_m == pytest.approx(0.1), "left of the path, seen along the body, is positive"
    assert error.heading_error_rad == pytest.approx(0.05), "turned to the left is positive"
    ahead = (point.x_m + 0.1 * math.cos(point.yaw_rad), point.y_m + 0.1 * math.sin(point.yaw_rad))
    assert pose_error(point, leg.sigma, *ahead, body_yaw_rad).along_m == pytest.approx(0.1 * leg.sigma)


@pytest.mark.parametrize("direction", [FORWARD, REVERSE])
def test_the_path_goes_on_straight_beyond_its_ends(direction):
    leg = shipped_tables().leg[direction]
    for station_m, inside_m in ((-0.3, 0.0), (leg.length_m + 0.3, leg.length_m)):
        out, at = locate(leg, station_m), locate(leg, inside_m)
        along_m = leg.sigma * (station_m - inside_m)
        assert out.x_m == pytest.approx(at.x_m + along_m * math.cos(at.yaw_rad), abs=1e-12)
        assert out.yaw_rad == at.yaw_rad
        assert feedforward_curvature_1pm(leg, station_m) == out.feedforward_curvature_1pm


@pytest.mark.parametrize("direction", [FORWARD, REVERSE])
def test_the_two_lookups_of_the_feedforward_agree(direction):
    leg = shipped_tables().leg[direction]
    rng = random.Random(2)
    for _ in range(500):
        station_m = rng.uniform(-0.1, leg.length_m + 0.1)
        assert feedforward_curvature_1pm(leg, station_m) == locate(leg, station_m).feedforward_curvature_1pm


@pytest.mark.parametrize("direction", [FORWARD, REVERSE])
def test_the_model_on_the_path_with_the_feedforward_stays_on_the_path(direction):
    tables = shipped_tables()
    leg = tables.leg[direction]
    car = tables.car._replace(lag_alpha=1.0, lag_mean_weight=0.0, max_road_wheel_rate_radps=10.0)
    state = motion.PathState(0.0, 0.0, 0.0, 0.0, 0.0)
    worst_m = 0.0
    while state.station_m < leg.length_m - 0.02:
        curvature = feedforward_curvature_1pm(leg, state.station_m + 0.005)
        state = motion.advance(leg, car, state, math.atan(car.wheelbase_m * curvature), 1.0, 0.01)
        worst_m = max(worst_m, abs(state.cross_track_error_m))
    assert worst_m < 1e-4
    # and the model notices a curvature disturbance on the side where it acts
    pushed = motion.advance(leg, car, motion.PathState(0.0, 0.0, 0.0, 0.01, 0.0), 0.0, 1.0, 0.01)
    assert pushed.heading_error_rad * leg.sigma > 0


@pytest.mark.parametrize("direction", [FORWARD, REVERSE])
def test_feedback_brings_the_car_back_to_the_path_in_both_directions(direction):
    tables = shipped_tables()
    leg = tables.leg[direction]
    car = tables.car
    for start_m, start_rad in ((0.05, 0.0), (-0.05, 0.02), (0.0, -0.03)):
        state = motion.PathState(0.0, start_m, start_rad, 0.0, 0.0)
        queue = (0.0,) * predictor.QUEUE_LENGTH
        for _ in range(800):
            gains = gains_at(tables.gains, direction, 0.8)
            ahead = predictor.predict(leg, car, state, queue, 0.8, 0.01)
            feedback = pid.feedback_1pm(ahead.cross_track_error_m, ahead.heading_error_rad, 0.0, gains, leg.sigma)
            curvature, slope = feedforward_at(leg, ahead.station_m)
            leads = car.steering_lag_s * 0.8 * car.wheelbase_m * slope / (1.0 + (car.wheelbase_m * curvature) ** 2)
            angle = math.atan(car.wheelbase_m * (curvature - feedback)) + leads
            latency = car.pose_latency_samples + car.command_latency_samples
            state = motion.advance(leg, car, state, ([angle, *queue])[latency], 0.8, 0.01)
            queue = (angle, *queue[:-1])
        assert abs(state.cross_track_error_m) < 0.2 * max(abs(start_m), 0.02)


def test_gains_are_exactly_those_of_the_row_and_held_beyond_the_grid():
    table = shipped_tables().gains
    for direction in (FORWARD, REVERSE):
        for row, speed_mps in enumerate(table.speed_grid_mps):
            assert tuple(gains_at(table, direction, speed_mps)) == pytest.approx(table.gain[direction][row], abs=1e-15)
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
        assert gains_at(changed, FORWARD, speed_mps) == gains_at(table, FORWARD, speed_mps)
        before, after = gains_at(table, REVERSE, speed_mps), gains_at(changed, REVERSE, speed_mps)
        difference = [b - a for a, b in zip(before, after, strict=True)]
        inside = grid[row - 1] < speed_mps < grid[row + 1]
        assert (difference[column] > 1e-9) == inside
        assert all(abs(value) < 1e-12 for i, value in enumerate(difference) if i != column)


def test_the_controller_uses_the_row_of_its_direction():
    """A forward-only change of kp changes a forward command and leaves the reverse model untouched."""
    tables = shipped_tables()
    louder = tuple(tuple(3.0 * v if i == KP else v for i, v in enumerate(row)) for row in tables.gains.gain[FORWARD])
    forward_changed = tables._replace(gains=tables.gains._replace(gain=(louder, tables.gains.gain[REVERSE])))
    reverse_changed = tables._replace(gains=tables.gains._replace(gain=(tables.gains.gain[FORWARD], louder)))

    def command(used_tables):
        state = controller.begin()
        angle_rad = 0.0
        for cycle in range(140):
            inputs = standing_inputs(used_tables, cycle, s.MODE_READY if cycle < 61 else s.MODE_ACTIVE)
            inputs = inputs._replace(
                oper=inputs.oper._replace(oper_start=1 if cycle >= 60 else 0),
                position=inputs.position._replace(position_y_m=0.005),
                long=inputs.long._replace(gear_rpt=s.GEAR_DRIVE, park_brake_applied=0),
                steer=inputs.steer._replace(road_wheel_angle_meas_rad=angle_rad),
            )
            state, outputs = controller.step(used_tables, state, inputs)
            angle_rad = outputs.steer.road_wheel_angle_cmd_rad
        assert outputs.sys.control_mode == s.MODE_ACTIVE
        return angle_rad

    assert command(tables) < -0.01, "left of the path, driving forward: steer to the right"
    assert command(forward_changed) < 2.0 * command(tables)
    assert command(reverse_changed) == command(tables)


def test_nothing_drifts_at_standstill():
    tables = shipped_tables()
    leg = tables.leg[FORWARD]
    state = observer.begin(0.0, 0.0)
    state = state._replace(path=state.path._replace(cross_track_error_m=0.03, curvature_disturbance_1pm=0.004))
    after = observer.predict_to_pose(leg, tables.car, state, 0.0, 0.0, 0.01)
    assert after.path == state.path
    gains = gains_at(tables.gains, FORWARD, 0.0)
    assert pid.integrate_m2(0.01, 0.03, 0.0, gains, 0) == 0.01
    corrected = observer.correct_moving(state, gains, observer.PoseError(0.0, 0.02, 0.01))
    assert corrected.path.curvature_disturbance_1pm == state.path.curvature_disturbance_1pm


def test_standing_poses_are_averaged_to_their_mean():
    tables = shipped_tables()
    leg = tables.leg[FORWARD]
    rng = random.Random(3)
    state = observer.begin(0.0, 0.0)
    start = locate(leg, 0.0)
    poses = [(start.x_m + rng.gauss(0, 0.01), rng.gauss(0.02, 0.01), rng.gauss(0, 0.002)) for _ in range(100)]
    for pose in poses:
        state = observer.correct_standing(state, observer.innovation(leg, state, *pose))
    mean_m = sum(pose[1] for pose in poses) / len(poses)
    assert state.path.cross_track_error_m == pytest.approx(mean_m, abs=2e-4)


def test_turning_round_keeps_the_bodys_errors_and_counts_station_from_the_end():
    leg = shipped_tables().leg[REVERSE]
    before = observer.ObserverState(motion.PathState(leg.length_m - 0.02, 0.003, -0.002, 0.004, 0.1), 7, 1)
    after = observer.turn_round(leg, before)
    assert after.path == before.path._replace(station_m=pytest.approx(0.02))


def test_a_pose_beyond_the_gate_is_not_believed_and_counted():
    tables = shipped_tables()
    gains = gains_at(tables.gains, FORWARD, 0.5)
    state = observer.begin(1.0, 0.0)
    inside = observer.correct_moving(state, gains, observer.PoseError(0.0, observer.GATE_CROSS_M, 0.0))
    assert inside.disbelieved == 0
    assert inside.path != state.path
    outside = observer.correct_moving(state, gains, observer.PoseError(0.0, observer.GATE_CROSS_M + 1e-9, 0.0))
    assert (outside.disbelieved, outside.path) == (1, state.path)


def test_the_integral_stands_still_while_limited_and_stays_within_its_authority():
    gains = gains_at(shipped_tables().gains, FORWARD, 0.5)._replace(ki=0.4)
    assert pid.integrate_m2(0.01, 0.05, 0.01, gains, 1) == 0.01
    integral = 0.0
    for _ in range(100_000):
        integral = pid.integrate_m2(integral, 0.05, 0.01, gains, 0)
    assert gains.ki * integral == pytest.approx(pid.INTEGRAL_AUTHORITY_1PM)


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
