"""The estimator: signs, what it learns from what, and what it does when a report is missing."""

import math
import random

import pytest
from core_support import shipped_tables

from firmware_py.core import estimator, kalman
from firmware_py.core.path import pose_at
from firmware_py.core.schedule import gains_at

FORWARD, REVERSE = 0, 1
PERIOD_S = 0.01
NOISE = kalman.begin_noise()._replace(position_m2=1e-4, yaw_rad2=3e-6, compared=kalman.COMPARED_MAX)
WALKS = kalman.Walks(0.4e-3, 1e-3, 1e-3)


class Drive:
    """A car that follows the path at constant speed, and an estimator that hears of it."""

    def __init__(self, direction=FORWARD, speed_mps=0.8, **car):
        self.tables = shipped_tables()
        self.leg, self.car = self.tables.leg[direction], self.tables.car
        self.direction, self.speed_mps = direction, speed_mps
        self.steering_gain = car.get("steering_gain", 1.0)
        self.extra_lag_s = car.get("extra_lag_s", 0.0)
        self.alignment_rad = car.get("alignment_rad", 0.0)
        self.gyro_bias_radps = car.get("gyro_bias_radps", 0.0)
        self.odometry_scale = car.get("odometry_scale", 1.0)
        self.slip_scale = car.get("slip_scale", 1.0)
        self.noise = car.get("noise", 0.0)
        self.stated_m = car.get("stated_m", 0.01)
        self.rng = random.Random(1)
        self.station_m = 1.0
        self.poses = [self.pose()]
        x_m, y_m, yaw_rad = self.pose()
        rack_rad = self.rack_rad = self.wheels_rad() - self.alignment_rad
        self.state = estimator.begin()._replace(
            x_m=x_m,
            y_m=y_m,
            yaw_rad=yaw_rad,
            station_m=self.station_m,
            yaw_rate_radps=self.leg.sigma * speed_mps * self.curvature(),
            road_wheel_angle_rad=rack_rad,
            modelled_angle_rad=rack_rad / self.steering_gain,
            averaged=estimator.MOVING_PRIOR,
            bias_averaged=estimator.MOVING_PRIOR,
            noise=NOISE,
            filter=self.filter(),
        )

    def filter(self):
        """The filter of a car that has stood long and begins to drive."""
        known = kalman.begin()._replace(
            covariance=kalman.averaged(300, NOISE.position_m2, NOISE.yaw_rad2, 0.0, 0.0, 0.25)
        )
        body_m = self.leg.sigma * self.speed_mps * PERIOD_S * kalman.GAINS_EVERY
        interval = kalman.Interval(body_m, 0.0, 0, 0.01, estimator.MOVING_PRIOR, estimator.MOVING_PRIOR, 0, 1)
        return kalman.advance(known, WALKS, NOISE, interval)

    def pose(self):
        """The car's pose on the path, body turned by its slip."""
        x_m, y_m, yaw_rad, slip_rad, _ = pose_at(self.leg, self.station_m)
        return x_m, y_m, yaw_rad + self.slip_scale * slip_rad

    def curvature(self):
        """Curvature that the wheels must make, by difference of the body's yaw."""
        h = 0.005
        at = [pose_at(self.leg, self.station_m + d) for d in (-h, h)]
        yaw = [yaw_rad + self.slip_scale * slip_rad for _, _, yaw_rad, slip_rad, _ in at]
        return self.leg.sigma * (yaw[1] - yaw[0]) / (2 * h)

    def wheels_rad(self):
        """Angle at which the wheels must stand for it, tyre slip included."""
        return math.atan(
            self.car.wheelbase_m * (self.curvature() + self.slip_scale * pose_at(self.leg, self.station_m)[4])
        )

    def cycles(self, count, with_yaw_rate=1, with_angle=1, with_pose=1, offset_m=0.0, turned_rad=0.0, follows=1):
        for _ in range(count):
            ds_m = self.speed_mps * PERIOD_S
            self.station_m += ds_m
            after = self.pose()
            self.poses.append(after)
            yaw_rate_radps = self.leg.sigma * self.speed_mps * self.curvature()
            last_rad, rack_rad = self.rack_rad, self.wheels_rad() - self.alignment_rad
            self.rack_rad = rack_rad
            # The command that acts on the nominal actuator so that the wheels stand as they do.
            modelled = (rack_rad + self.extra_lag_s * (rack_rad - last_rad) / PERIOD_S) / self.steering_gain
            alpha = self.car.lag_alpha
            acted = self.state.modelled_angle_rad + (modelled - self.state.modelled_angle_rad) / alpha
            latency = self.car.pose_latency_samples
            x_m, y_m, yaw_rad = self.poses[-1 - latency] if len(self.poses) > latency else after
            gauss = self.rng.gauss
            motion = estimator.Motion(
                self.odometry_scale * ds_m,
                PERIOD_S,
                acted,
                rack_rad,
                with_angle,
                yaw_rate_radps + self.gyro_bias_radps,
                with_yaw_rate,
                0,
                follows,
            )
            self.state = estimator.estimate(
                self.leg,
                self.car,
                gains_at(self.tables.gains, self.direction, self.speed_mps),
                self.state,
                motion,
                with_pose,
                x_m + gauss(0.0, self.noise) - offset_m * math.sin(yaw_rad),
                y_m + gauss(0.0, self.noise) + offset_m * math.cos(yaw_rad),
                yaw_rad + turned_rad + gauss(0.0, 0.17 * self.noise),
                latency,
                self.stated_m,
                1,
            )
        return self.state


@pytest.mark.parametrize("direction", [FORWARD, REVERSE])
def test_a_car_on_the_path_is_seen_on_the_path(direction):
    drive = Drive(direction)
    for _ in range(10):
        state = drive.cycles(100)
        assert abs(state.cross_track_error_m) < 2e-4
        assert abs(state.heading_error_rad) < 2e-4
        assert state.station_m == pytest.approx(drive.station_m, abs=2e-3)


@pytest.mark.parametrize("direction", [FORWARD, REVERSE])
def test_left_of_the_path_and_turned_left_are_positive_in_both_directions(direction):
    leg = shipped_tables().leg[direction]
    x_m, y_m, yaw_rad, slip_rad, _ = pose_at(leg, 4.0)
    left = (x_m - 0.1 * math.sin(yaw_rad), y_m + 0.1 * math.cos(yaw_rad))
    still = estimator.Motion(0.0, PERIOD_S, 0.0, 0.0, 1, 0.0, 1, 1, 0)
    state = estimator.begin()._replace(station_m=4.0)
    gains = gains_at(shipped_tables().gains, direction, 0.0)
    state = estimator.estimate(
        leg, shipped_tables().car, gains, state, still, 1, *left, yaw_rad + slip_rad + 0.05, 1, 0.01, 1
    )
    assert state.cross_track_error_m == pytest.approx(0.1, abs=1e-9)
    assert state.heading_error_rad == pytest.approx(0.05, abs=1e-9)
    assert state.station_m == pytest.approx(4.0, abs=1e-9)


@pytest.mark.parametrize("direction", [FORWARD, REVERSE])
@pytest.mark.parametrize("with_yaw_rate", [1, 0])
def test_a_false_alignment_is_learnt_with_its_sign(direction, with_yaw_rate):
    drive = Drive(direction, alignment_rad=0.0175)
    state = drive.cycles(1100, with_yaw_rate)
    assert state.road_disturbance_rad == pytest.approx(0.0175, abs=0.002 if with_yaw_rate else 0.006)
    assert abs(state.steering_offset_rad) < 1e-3


def test_the_yaw_rate_shows_an_alignment_within_a_metre():
    drive = Drive(alignment_rad=0.0175)
    assert drive.cycles(125).road_disturbance_rad == pytest.approx(0.0175, rel=0.1)


def test_a_weak_steering_is_learnt_as_a_gain():
    drive = Drive(steering_gain=0.94)
    state = drive.cycles(1300)
    assert state.steering_gain == pytest.approx(0.94, abs=0.012)
    assert abs(state.road_disturbance_rad) < 2e-3


def test_a_weak_steering_is_known_before_the_first_bend_is_over():
    drive = Drive(steering_gain=0.95)
    while drive.station_m < 5.0:
        state = drive.cycles(1)
    assert state.steering_gain == pytest.approx(0.95, abs=0.01)


def test_a_slow_steering_is_known_where_the_wheels_stand_in_a_bend():
    """With 0.1 s more lag than nominal: known where they stand in a bend, and what turning back taught ends the leg."""
    drive = Drive(extra_lag_s=0.1)
    seen = {}
    while drive.station_m < 10.3:
        state = drive.cycles(1)
        seen[drive.station_m] = state.steering_gain
    assert min(gain for station_m, gain in seen.items() if station_m < 4.5) < 0.95
    assert max(gain for station_m, gain in seen.items() if 6.5 < station_m < 8.0) > 1.05
    assert drive.cycles(200).steering_gain > 1.03
    steady = [gain for station_m, gain in seen.items() if 5.6 < station_m < 6.0 or station_m > 9.0]
    assert steady == pytest.approx([1.0] * len(steady), abs=0.02)


@pytest.mark.parametrize("angle_rad", [0.4, 0.1, -0.25])
@pytest.mark.parametrize("gap_rad", [0.002, -0.003])
def test_a_gap_teaches_the_gain_by_the_tables_share(angle_rad, gap_rad):
    """At most that share of the gap as an angle: all of it at large angles, half at 0.1 rad; none at standstill."""
    drive = Drive(speed_mps=1.0)
    gains = gains_at(drive.tables.gains, FORWARD, 1.0)._replace(gain=0.012)
    state = drive.state._replace(modelled_angle_rad=angle_rad)
    motion = estimator.Motion(0.01, PERIOD_S, angle_rad, angle_rad + gap_rad, 1, 0.0, 0, 0, 1)
    args = (drive.leg, drive.car, gains, state, motion, 0, 0.0, 0.0, 0.0, 1, 0.01, 1)
    learnt = estimator.estimate(*args).steering_gain - 1.0
    share = angle_rad * angle_rad / (angle_rad * angle_rad + 0.01)
    assert learnt * angle_rad == pytest.approx(0.012 * share * gap_rad, rel=1e-9)
    assert gains_at(drive.tables.gains, FORWARD, 0.0).gain == 0.0


def test_a_gyro_that_drifts_while_driving_is_corrected_by_the_poses():
    drive = Drive(gyro_bias_radps=1e-3)
    state = drive.cycles(1300)
    assert abs(state.heading_error_rad) < 2e-3
    assert 0.1e-3 < state.gyro_bias_radps < 1.5e-3


def test_the_odometrys_scale_is_learnt():
    drive = Drive(odometry_scale=1.02)
    state = drive.cycles(1300)
    assert state.odometry_scale == pytest.approx(1.0 / 1.02, abs=0.006)
    assert state.station_m == pytest.approx(drive.station_m, abs=3e-3)


def test_the_pose_is_carried_over_its_latency():
    """A pose one cycle old of a car at 0.8 m/s is 8 mm behind: the estimate is not."""
    drive = Drive()
    state = drive.cycles(400)
    x_m, y_m, _ = drive.pose()
    assert math.hypot(state.x_m - x_m, state.y_m - y_m) < 1e-3
    behind = drive.poses[-2]
    assert math.hypot(x_m - behind[0], y_m - behind[1]) == pytest.approx(0.008, abs=1e-4)


def test_noise_of_the_poses_is_averaged_away():
    drive = Drive(noise=0.01)
    errors = [drive.cycles(1).cross_track_error_m for _ in range(1200)]
    rms_m = math.sqrt(sum(e * e for e in errors[200:]) / len(errors[200:]))
    assert rms_m < 1.2e-3


def test_without_poses_yaw_rate_and_odometry_carry_on():
    drive = Drive()
    drive.cycles(200)
    state = drive.cycles(300, with_pose=0)
    assert abs(state.cross_track_error_m) < 1e-3
    assert state.station_m == pytest.approx(drive.station_m, abs=5e-3)


def test_losing_the_yaw_rate_and_its_return_make_no_jump():
    drive = Drive(alignment_rad=0.0175)
    before = drive.cycles(300)
    seen = [drive.cycles(1, with_yaw_rate=0) for _ in range(300)] + [drive.cycles(1) for _ in range(300)]
    for earlier, later in zip([before, *seen], seen, strict=False):
        assert abs(later.cross_track_error_m - earlier.cross_track_error_m) < 1e-4
        assert abs(later.heading_error_rad - earlier.heading_error_rad) < 2e-4
        assert abs(later.road_disturbance_rad - earlier.road_disturbance_rad) < 1.5e-3


def test_without_the_measured_angle_the_nominal_actuator_stands_in():
    drive = Drive(steering_gain=0.94)
    drive.cycles(900)
    learnt = drive.state.steering_gain
    state = drive.cycles(100, with_angle=0)
    assert state.steering_gain == learnt
    assert abs(state.cross_track_error_m) < 1e-3


@pytest.mark.parametrize("with_yaw_rate", [1, 0])
def test_nothing_drifts_at_standstill(with_yaw_rate):
    tables = shipped_tables()
    state = Drive(alignment_rad=0.01).cycles(300)
    still = estimator.Motion(0.0, PERIOD_S, 0.0, 0.0, 0, 0.003, with_yaw_rate, 1, 1)
    gains = gains_at(tables.gains, FORWARD, 0.0)
    after = state
    for _ in range(200):
        after = estimator.estimate(tables.leg[0], tables.car, gains, after, still, 0, 0.0, 0.0, 0.0, 1, 0.01, 1)
    kept = ("x_m", "y_m", "yaw_rad", "road_disturbance_rad", "steering_gain", "steering_offset_rad", "odometry_scale")
    assert [getattr(after, name) for name in kept] == [getattr(state, name) for name in kept]
    assert after.cross_track_error_m == pytest.approx(state.cross_track_error_m, abs=1e-5)


def test_the_gyros_bias_is_learnt_at_standstill():
    tables = shipped_tables()
    rng = random.Random(4)
    state = estimator.begin()
    gains = gains_at(tables.gains, FORWARD, 0.0)
    for _ in range(400):
        still = estimator.Motion(0.0, PERIOD_S, 0.0, 0.0, 1, 0.002 + rng.gauss(0.0, 3.5e-4), 1, 1, 0)
        state = estimator.estimate(tables.leg[0], tables.car, gains, state, still, 0, 0.0, 0.0, 0.0, 1, 0.01, 1)
    assert state.gyro_bias_radps == pytest.approx(0.002, abs=6e-5)


def test_standing_poses_are_averaged_to_their_mean():
    tables = shipped_tables()
    rng = random.Random(3)
    state = estimator.begin()
    leg = tables.leg[FORWARD]
    gains = gains_at(tables.gains, FORWARD, 0.0)
    still = estimator.Motion(0.0, PERIOD_S, 0.0, 0.0, 1, 0.0, 1, 1, 0)
    poses = [(leg.x_m[0] + rng.gauss(0, 0.01), rng.gauss(0.02, 0.01), rng.gauss(0, 0.002)) for _ in range(100)]
    for pose in poses:
        state = estimator.estimate(leg, tables.car, gains, state, still, 1, *pose, 1, 0.01, 1)
    mean_m = sum(pose[1] for pose in poses) / len(poses)
    assert state.y_m == pytest.approx(mean_m, abs=2e-4)
    assert state.averaged == 100


def test_turning_round_keeps_the_body_and_counts_station_from_the_end():
    state = Drive(alignment_rad=0.01).cycles(300)
    leg = shipped_tables().leg[REVERSE]
    after = estimator.turn_round(leg, state)
    assert after == state._replace(station_m=leg.length_m - state.station_m)


def test_a_pose_beyond_the_gate_is_not_believed_and_counted():
    drive = Drive()
    drive.cycles(100)
    inside = drive.cycles(1, offset_m=0.9 * estimator.GATE_CROSS_M)
    assert inside.disbelieved == 0
    outside = drive.cycles(1, offset_m=1.1 * estimator.GATE_CROSS_M)
    assert outside.disbelieved == 1
    assert abs(outside.cross_track_error_m) < 0.01
    assert drive.cycles(1).disbelieved == 0


@pytest.mark.parametrize("direction", [FORWARD, REVERSE])
@pytest.mark.parametrize("slip_scale", [0.5, 1.9])
def test_the_rear_tyres_slip_is_learnt_from_where_the_poses_lie(direction, slip_scale):
    """Within a leg most of it; and it stays for the leg back."""
    drive = Drive(direction, slip_scale=slip_scale)
    state = drive.cycles(1200)
    assert abs(state.slip_scale - slip_scale) < 0.5 * abs(1.0 - slip_scale)
    assert abs(state.cross_track_error_m) < 0.7e-3
    assert estimator.turn_round(drive.leg, state).slip_scale == state.slip_scale


@pytest.mark.parametrize("direction", [FORWARD, REVERSE])
def test_the_heading_error_is_that_against_a_body_that_slips_so(direction):
    drive = Drive(direction, slip_scale=1.9)
    drive.state = drive.state._replace(slip_scale=1.9)
    slips_rad = []
    for _ in range(9):
        state = drive.cycles(100)
        slips_rad.append(abs(pose_at(drive.leg, drive.station_m)[3]))
        assert abs(state.heading_error_rad) < 0.03e-3
        assert abs(state.cross_track_error_m) < 0.05e-3
        assert state.slip_scale == pytest.approx(1.9, abs=0.1)
    assert max(slips_rad) > 0.5e-3


def test_a_slip_that_no_car_has_is_not_learnt():
    assert Drive(slip_scale=12.0).cycles(1200).slip_scale == estimator.SLIP_SCALE_MOST
    assert Drive(slip_scale=-10.0).cycles(1200).slip_scale == estimator.SLIP_SCALE_LEAST


def test_no_slip_is_learnt_while_a_driver_steers():
    """He drives as fast and as sharply as he likes; the nominal slip is that of the plan."""
    driven = Drive(slip_scale=1.9).cycles(600, follows=0)
    assert (driven.slip_scale, driven.slipped_m) == (1.0, 0.0)


def test_an_innovation_is_shared_out_by_the_gains():
    drive = Drive()
    drive.cycles(9)
    gains = kalman.PoseGains(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 2.0, 30.0, 0.0, 0.0, 0.0, 0.0)
    drive.state = drive.state._replace(filter=drive.state.filter._replace(gains=gains), slip_scale=1.0)
    assert drive.cycles(1, offset_m=0.01).slip_scale == pytest.approx(1.02, abs=2e-3)
    drive.state = drive.state._replace(slip_scale=1.0)
    assert drive.cycles(1, turned_rad=0.002).slip_scale == pytest.approx(1.06, abs=2e-3)
