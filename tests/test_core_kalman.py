"""The estimator's Kalman filter: its uncertainty is honest, and its gains are those that belong to it."""

import math
import random

import cantools.database
import numpy as np
import pytest
from core_support import DBC, TABLES, shipped_codec, shipped_tables, standing_inputs

from firmware_py.core import conditions, controller, estimator, kalman, manoeuvre
from firmware_py.core.schedule import gains_at
from firmware_py.core.signals import MODE_MANUAL, MODE_READY
from firmware_py.node import ControllerNode
from sim.data_files import load_course, load_scenario, load_vehicle
from tools.design.model import straight_leg
from tools.figures import load_path, project, truth_of_rows
from tools.lockstep import COMPUTE_NS, PHASE_MS, run_lockstep

SEEDS = range(640_000, 640_006)
AGE_S = PHASE_MS * 1e-3 + COMPUTE_NS * 1e-9
"""Of what an estimate speaks of, when its frame is sent."""

DATABASE = cantools.database.load_file(DBC)


def cross_track_of(scenario_name, seed):
    """Return error and standard deviation of the estimated cross-track error while the car drives, arrays in m."""
    side = ("left", "right")[seed % 2]
    run = run_lockstep(
        load_vehicle("paper"), load_course("ohio"), load_scenario(scenario_name), side, seed, "car", TABLES, record=True
    )  # fmt: skip
    assert run.controller["completed"]
    said = {}
    for time_s, number, data in run.frames:
        message = DATABASE.get_message_by_frame_id(number)
        if message.name in ("CTRL_Track", "CTRL_Estimate"):
            said.setdefault(round(time_s - AGE_S, 4), {}).update(message.decode(data))
    truth = truth_of_rows(run.truth)
    true_m = project(load_path(TABLES, side), truth.x_m, truth.y_m, truth.yaw_rad).cross_track_error_m
    rows = [
        (said[at]["cross_track_error_est_m"] - error_m, said[at]["cross_track_sigma_m"])
        for at, error_m, speed_mps in zip(truth.t_s.round(4), true_m, truth.speed_mps, strict=True)
        if speed_mps != 0.0 and "cross_track_sigma_m" in said.get(at, {})
    ]
    assert len(rows) > 250
    return np.array(rows).T


@pytest.mark.parametrize("scenario_name", ["car", "car-quiet", "car-drift", "car-drift-3mm"])
def test_the_true_error_lies_within_two_standard_deviations(scenario_name, record_property):
    """As often as it would for a normal distribution (95.4 %); a slow noise is drawn but twice a run."""
    errors_m, sigmas_m = np.hstack([cross_track_of(scenario_name, seed) for seed in SEEDS])
    within = float(np.mean(np.abs(errors_m) <= 2.0 * sigmas_m))
    ratio = float(np.sqrt(np.mean(errors_m**2) / np.mean(sigmas_m**2)))
    record_property("within_2_sigma", within)
    record_property("rms_error_over_rms_sigma", ratio)
    assert within >= 0.92
    assert ratio <= 1.25
    if scenario_name == "car-quiet":
        # A localisation without noise states 1 mm, the least that it can: more than that is not claimed of it.
        assert np.sqrt(np.mean(sigmas_m**2)) < 1e-3
    else:
        assert ratio >= 0.5


# ------------------------------------------------------------------------------------------------------ the recursion

WHITE = kalman.SeenNoise(1e-4, 3e-6, kalman.COMPARED_MAX, 0.0, 0.0, 0.0, 0)
SLOW = kalman.SeenNoise(4e-8, 1e-9, kalman.COMPARED_MAX, 0.0, 0.0, 0.0, 0)
WALKS = kalman.Walks(0.5e-3, 2e-3, 5e-3)


def matrix_of(known):
    """The six errors' covariance as a matrix, shape (6, 6)."""
    upper = np.zeros((6, 6))
    upper[np.triu_indices(6)] = known
    return upper + np.triu(upper, 1).T


def any_covariance(seed):
    """One that is positive definite, with everything in it, in the sizes that occur."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(6, 6)) * np.array([[3e-3], [1e-3], [2e-3], [0.1], [8e-3], [1e-3]])
    full = root @ root.T
    return kalman.Covariance(*(float(value) for value in full[np.triu_indices(6)]))


@pytest.mark.parametrize("body_m", [0.04, -0.04])
@pytest.mark.parametrize("with_yaw_rate", [1, 0])
@pytest.mark.parametrize("standstill", [0, 1])
def test_a_prediction_is_the_textbooks(body_m, with_yaw_rate, standstill):
    before, half_s, kept = any_covariance(3), 0.05, math.exp(-0.05 / kalman.SLOW_S)
    turn = 0.0 if standstill else -half_s if with_yaw_rate else body_m
    slipped_m = 2e-4
    f = np.diag([1.0, 1.0, 1.0, 1.0, kept, kept])
    f[0, 1], f[0, 2], f[0, 3], f[1, 2] = body_m, 0.5 * body_m * turn, slipped_m, turn
    way_m = abs(body_m)
    yaw_rate = kalman.HEADING_WALK**2 * way_m + kalman.YAW_RATE_NOISE_RADPS**2 * kalman.PERIOD_S * half_s
    noises = (kalman.SIDE_SLIP**2 * way_m, yaw_rate, kalman.YAW_RATE_WALK**2 * half_s)
    if not with_yaw_rate:
        noises = tuple(walk**2 * way_m for walk in WALKS)
    if standstill:
        stood = kalman.STANDING_WALK_M**2 * half_s
        noises = (stood, kalman.YAW_PER_POSITION_RADPM**2 * stood, 0.0)
    slip2 = 0.0 if standstill else kalman.SLIP_WALK**2 * way_m
    q = np.diag([*noises, slip2, (1.0 - kept**2) * 1e-4, (1.0 - kept**2) * 3e-6])
    # Half of what came to the heading on the way is in the place, as is half of what came to x in the heading.
    q[0, 1] = q[1, 0] = 0.5 * body_m * noises[1]
    q[1, 2] = q[2, 1] = 0.5 * turn * noises[2]
    after = kalman.predict(before, body_m, slipped_m, standstill, WALKS, with_yaw_rate, 1e-4, 3e-6)
    assert matrix_of(after) == pytest.approx(f @ matrix_of(before) @ f.T + q, rel=1e-12, abs=1e-20)


def test_gains_and_correction_are_the_textbooks():
    before = any_covariance(4)
    h = np.array([[1.0, 0.0, 0.0, 0.0, 1.0, 0.0], [0.0, 1.0, 0.0, 0.0, 0.0, 1.0]])
    p, r = matrix_of(before), np.diag([1e-4, 3e-6])
    gains = p @ h.T @ np.linalg.inv(h @ p @ h.T + r)
    found = kalman.gains_of(before, 1e-4, 3e-6)
    assert np.array(found).reshape(6, 2) == pytest.approx(gains, rel=1e-9)
    kept = np.eye(6) - gains @ h
    joseph = kept @ p @ kept.T + gains @ r @ gains.T
    assert matrix_of(kalman.correct(before, found)) == pytest.approx(joseph, rel=1e-7, abs=1e-18)


def moving(way_m=0.09, poses=10, with_yaw_rate=1, slipped_m=0.0):
    return kalman.Interval(way_m, slipped_m, poses, 0.01, 300, 300, 0, with_yaw_rate)


def standing(averaged, poses=10):
    return kalman.Interval(0.0, 0.0, poses, 0.01, averaged, averaged, 1, 1)


def after_standing(noise, averaged=200):
    """The filter of a car that has stood for so many poses."""
    state = kalman.begin()
    for count in range(10, averaged + 1, 10):
        state = kalman.advance(state, WALKS, noise, standing(count))
    return state


@pytest.mark.parametrize("with_yaw_rate", [1, 0])
@pytest.mark.parametrize("sigma", [1, -1])
@pytest.mark.parametrize("noise", [WHITE, SLOW])
def test_it_is_the_covariance_of_many_cars_that_are_corrected_so(noise, sigma, with_yaw_rate):
    """They slip, turn and are seen at random, pose by pose, with the noises that the filter assumes."""
    rng, cars, way_m, dt_s = np.random.default_rng(1), 20_000, sigma * 0.009, kalman.PERIOD_S
    state = after_standing(noise)
    state = kalman.advance(state, WALKS, noise, moving(10 * way_m, 0, with_yaw_rate))
    white_m2, white_rad2, slow_m2, slow_rad2 = kalman.split(noise, 0.01)
    turn = -dt_s if with_yaw_rate else way_m
    start = matrix_of(state.covariance)
    # Errors of the estimates: true less estimated.
    e_m, p_rad, x, slip, s_m, t_rad = rng.multivariate_normal(np.zeros(6), start, cars).T
    way_root = math.sqrt(abs(way_m))
    if with_yaw_rate:
        side, walk, other = kalman.SIDE_SLIP * way_root, kalman.HEADING_WALK * way_root, kalman.YAW_RATE_WALK * 0.1
        walk = math.hypot(walk, kalman.YAW_RATE_NOISE_RADPS * dt_s)
    else:
        side, walk, other = (value * way_root for value in WALKS)
    left = 1.0 - kalman.KEPT**2
    slipped_m = -3e-5  # 3 mrad of slip, as at 1 m/s in a sharp bend
    for interval in range(30):
        poses = 10 if interval % 7 else 3
        g = state.gains
        for cycle in range(10):
            e_m += way_m * (p_rad + 0.5 * turn * x) + slipped_m * slip + rng.normal(0.0, side, cars)
            p_rad += turn * x + rng.normal(0.0, walk, cars)
            x += rng.normal(0.0, other, cars)
            slip += rng.normal(0.0, kalman.SLIP_WALK * way_root, cars)
            s_m = kalman.KEPT * s_m + rng.normal(0.0, math.sqrt(left * slow_m2), cars)
            t_rad = kalman.KEPT * t_rad + rng.normal(0.0, math.sqrt(left * slow_rad2), cars)
            if cycle < poses:
                new_m = e_m + s_m + rng.normal(0.0, math.sqrt(white_m2), cars)
                new_rad = p_rad + t_rad + rng.normal(0.0, math.sqrt(white_rad2), cars)
                e_m -= g.ee * new_m + g.ep * new_rad
                p_rad -= g.pe * new_m + g.pp * new_rad
                x -= g.xe * new_m + g.xp * new_rad
                slip -= g.ce * new_m + g.cp * new_rad
                s_m -= g.se * new_m + g.sp * new_rad
                t_rad -= g.te * new_m + g.tp * new_rad
        state = kalman.advance(state, WALKS, noise, moving(10 * way_m, poses, with_yaw_rate, 10 * slipped_m))
    known = state.covariance
    assert math.sqrt(known.cc) == pytest.approx(float(np.std(slip)), rel=0.1)
    assert math.sqrt(known.ee) == pytest.approx(float(np.std(e_m)), rel=0.1)
    assert math.sqrt(known.pp) == pytest.approx(float(np.std(p_rad)), rel=0.1)
    assert math.sqrt(known.xx) == pytest.approx(float(np.std(x)), rel=0.1)
    if noise is SLOW:
        assert math.sqrt(known.ss) == pytest.approx(float(np.std(s_m)), rel=0.1)
        assert known.es / known.ee == pytest.approx(float(np.mean(e_m * s_m) / np.var(e_m)), abs=0.1)


def test_at_standstill_white_noise_falls_with_the_root_of_the_poses():
    for poses in (20, 50, 100, 200, 400):
        cross_m, heading_rad = kalman.deviations(after_standing(WHITE, poses).covariance, 0.0, 0.01)
        # Besides, what nobody states: it is slow, and so a part of it stays.
        unstated_rad = kalman.YAW_PER_POSITION_RADPM * kalman.UNSTATED_M
        for sigma, white, unstated in (
            (cross_m, 0.01, kalman.UNSTATED_M),
            (heading_rad, math.sqrt(3e-6), unstated_rad),
        ):
            # After the average it also takes the car to move a little.
            most = 1.02 if poses <= kalman.AVERAGED_POSES else 1.25
            assert white / math.sqrt(poses) < sigma < most * math.hypot(white / math.sqrt(poses), unstated)
    forever = [kalman.deviations(after_standing(WHITE, poses).covariance, 0.0, 0.01)[0] for poses in (3000, 6000)]
    assert forever[1] == pytest.approx(forever[0], rel=0.02)
    assert 0.01 / math.sqrt(400) < forever[0] < 0.01 / math.sqrt(150)


def test_at_standstill_slow_noise_falls_with_the_seconds():
    """As that of the best mean of a first-order process: by 2 over 2 and the time in units of its own."""
    for poses in (600, 1000, 2000):
        cross_m, _ = kalman.deviations(after_standing(SLOW, poses).covariance, 0.0, 0.01)
        seconds = (poses - kalman.AVERAGED_POSES) * kalman.PERIOD_S
        best_m = 0.01 * math.sqrt(2.0 / (2.0 + seconds / kalman.SLOW_S))
        assert best_m < cross_m < 1.04 * best_m  # it also takes the car to move a little


def after_a_bend():
    """The filter of a car that has driven 3 m with slip."""
    state = after_standing(WHITE)
    for _ in range(33):
        state = kalman.advance(state, WALKS, WHITE, moving(slipped_m=3e-4))
    return state


def test_what_is_known_of_the_slip_stays_at_standstill_and_is_forgotten_with_the_way():
    state = after_a_bend()
    before = state.covariance
    assert math.sqrt(before.cc) < 0.6 * kalman.SLIP_UNKNOWN
    stood = kalman.advance(state, WALKS, WHITE, standing(300, 0)).covariance
    assert (stood.cc, stood.ec, stood.pc) == (before.cc, before.ec, before.pc)
    assert stood.xc == 0.0 != before.xc  # at standstill the bias is its own average
    assert kalman.advance(state, WALKS, WHITE, standing(4, 4)).covariance.cc == before.cc
    for _ in range(10):
        state = kalman.advance(state, WALKS, WHITE, moving(0.1, 0))
    assert state.covariance.cc == pytest.approx(before.cc + kalman.SLIP_WALK**2, rel=1e-9)
    for _ in range(10_000):
        state = kalman.advance(state, WALKS, WHITE, moving(0.1))
    assert state.covariance.cc == pytest.approx(kalman.SLIP_UNKNOWN**2, rel=1e-9)


def test_the_heading_error_is_as_sure_as_yaw_and_slip_together():
    known = after_a_bend().covariance
    against = np.array([0.0, 1.0, 0.0, -0.9e-3, 0.0, 0.0])
    sigma_rad = math.sqrt(against @ matrix_of(known) @ against)
    assert kalman.deviations(known, 0.9e-3, 0.01)[1] == pytest.approx(sigma_rad, rel=1e-9)
    assert sigma_rad > 1.1 * math.sqrt(known.pp)


def test_an_average_begun_anew_forgets_what_was_known():
    state = kalman.advance(after_standing(WHITE), WALKS, WHITE, standing(4, 4))
    assert state.covariance.ee == pytest.approx(1e-4 / 4, rel=0.02)


def test_without_poses_it_grows_with_the_way():
    state = after_standing(WHITE)
    before = state.covariance
    for _ in range(100):
        state = kalman.advance(state, WALKS, WHITE, moving(0.1, 0))
    gyro_rad = math.hypot(10.0 * math.sqrt(before.xx), math.sqrt(1000) * kalman.YAW_RATE_NOISE_RADPS * 0.01)
    heading_rad2 = before.pp + 10.0 * kalman.HEADING_WALK**2 + gyro_rad**2 + kalman.YAW_RATE_WALK**2 * 10.0**3 / 3
    assert state.covariance.pp == pytest.approx(heading_rad2, rel=0.01)
    assert state.covariance.ee > before.ee + 10.0 * kalman.SIDE_SLIP**2 + 10.0**2 * before.pp
    # With gains for the next pose that are the greater.
    assert state.gains.ee > 3.0 * after_standing(WHITE).gains.ee


def followed(noise, jump_m):
    """The share of a lasting jump of the poses to the left that a car's place has followed after 0.1, 1 and 10 s."""
    tables = shipped_tables()
    leg, station_m = straight_leg(1.0), 500.0
    state = estimator.begin()._replace(
        x_m=station_m, station_m=station_m, averaged=300, bias_averaged=300, noise=noise, filter=after_standing(noise)
    )
    shares = []
    for _ in range(1000):
        station_m += 0.006
        motion = estimator.Motion(0.006, 0.01, 0.0, 0.0, 1, 0.0, 1, 0, 1)
        gains = gains_at(tables.gains, 0, 0.6)
        state = estimator.estimate(
            leg, tables.car, gains, state, motion, 1, station_m, jump_m, 0.0, 0, 0.01, 1
        )  # fmt: skip
        shares.append(state.cross_track_error_m / jump_m)
    assert state.disbelieved == 0
    return shares[9], shares[99], shares[999]


def test_a_jump_of_slow_noise_is_followed_a_little_and_one_of_white_noise_after_a_time():
    at_once, soon, late = followed(WHITE, 0.01)
    assert at_once < 0.1
    assert 0.1 < soon < late
    assert late > 0.7
    at_once, soon, late = followed(SLOW, 0.03)
    assert at_once < 0.1
    assert soon < 0.2
    assert late < 0.7
    # Twice the jump is not followed at twice the pace, as what is far beyond the usual is no car's.
    assert followed(SLOW, 0.06)[0] < 0.7 * at_once


def test_gains_and_covariance_in_reverse_are_those_of_forward_mirrored():
    ahead = back = after_standing(WHITE)
    for _ in range(40):
        ahead = kalman.advance(ahead, WALKS, WHITE, moving(0.09))
        back = kalman.advance(back, WALKS, WHITE, moving(-0.09))
    for name, sign in zip(kalman.PoseGains._fields, (1, -1, -1, 1, -1, 1, 0, 0, 1, -1, -1, 1), strict=True):
        assert getattr(back.gains, name) == pytest.approx(sign * getattr(ahead.gains, name), rel=1e-9), name


def test_where_the_yaw_rate_goes_missing_the_road_is_known_as_it_has_shown_it():
    state = after_standing(WHITE)
    unseen = kalman.advance(state, WALKS, WHITE, moving(with_yaw_rate=0))
    assert unseen.covariance.xx == pytest.approx(kalman.ROAD_UNKNOWN_1PM**2, rel=0.2)
    for _ in range(60):
        state = kalman.advance(state, WALKS, WHITE, moving())
    blind = kalman.advance(state, WALKS, WHITE, moving(with_yaw_rate=0))
    assert (state.with_yaw_rate, blind.with_yaw_rate) == (1, 0)
    grown = WALKS.road**2 * 0.09
    assert blind.covariance.xx == pytest.approx(kalman.ROAD_SEEN_1PM**2 + grown, rel=0.2)
    assert blind.gains.xp > 0.0 > state.gains.xp  # a car turned left: more road to the left, or less bias
    again = kalman.advance(blind, WALKS, WHITE, moving())
    assert again.covariance.xx == pytest.approx(kalman.YAW_RATE_NOISE_RADPS**2 / 300, rel=0.5)
    assert again.road_1pm2 < blind.covariance.xx


def test_a_gyro_that_was_never_heard_standing_is_not_known():
    unheard = moving()._replace(bias_averaged=0)
    blind = kalman.advance(after_standing(WHITE), WALKS, WHITE, moving(with_yaw_rate=0))
    state = kalman.advance(blind, WALKS, WHITE, unheard)
    # Ten poses have told of it by then.
    assert 0.8 * kalman.BIAS_UNKNOWN_RADPS < math.sqrt(state.covariance.xx) < kalman.BIAS_UNKNOWN_RADPS


# ------------------------------------------------------------------------------------------------- the noise of a pose


def seen(position_m, yaw_rad, pairs=400):
    """Noise as so many standing poses with white noise show it."""
    noise, rng = kalman.begin_noise(), random.Random(1)
    for number in range(pairs + 1):
        pose = (rng.gauss(0.0, position_m), rng.gauss(0.0, position_m), rng.gauss(0.0, yaw_rad))
        noise = kalman.compare(noise, *pose, number == 0)
    return noise


def test_what_does_not_show_from_pose_to_pose_stays():
    white = seen(0.01, 0.00175)
    assert white.compared == 400
    assert math.sqrt(white.position_m2) == pytest.approx(0.01, rel=0.1)
    assert math.sqrt(white.yaw_rad2) == pytest.approx(0.00175, rel=0.1)
    assert [math.sqrt(value) for value in kalman.split(white, 0.01)] == pytest.approx(
        [0.01, 0.00175, kalman.UNSTATED_M, kalman.YAW_PER_POSITION_RADPM * kalman.UNSTATED_M], rel=0.1
    )
    slow = seen(3e-4, 5e-5)
    assert [math.sqrt(value) for value in kalman.split(slow, 0.01)] == pytest.approx(
        [4.2e-4, 7.3e-5, 0.01, 0.001745], rel=0.1
    )
    # Ten times what the localisation states: it does not know itself, and nothing of it is slow.
    assert kalman.split(white, 0.001)[2] == kalman.UNSTATED_M**2


@pytest.mark.parametrize("pairs", [kalman.COMPARED_LEAST, 100, 200, 400])
def test_white_noise_is_hardly_ever_taken_for_slow(pairs):
    """Of many stays, each with so many pairs of poses; their mean square scatters the less the more they are."""
    steps = np.random.default_rng(2).normal(0.0, 0.01, (pairs + 1, 2, 4000))
    shown_m2 = 0.25 * np.mean(np.sum(np.diff(steps, axis=0) ** 2, axis=1), axis=0)
    taken = [
        kalman.split(kalman.begin_noise()._replace(position_m2=m2, yaw_rad2=1.0, compared=pairs), 0.01)[2]
        for m2 in shown_m2
    ]
    assert np.mean(np.array(taken) > kalman.SLOW_NOISE_M**2) < 0.002


def test_before_enough_poses_are_seen_all_noise_is_taken_for_white():
    noise = seen(3e-4, 5e-5, kalman.COMPARED_LEAST - 1)
    assert kalman.split(noise, 0.01) == pytest.approx((1e-4, 0.001745**2, 9e-8, 2.74e-9), rel=0.01)


def test_a_localisation_that_does_not_know_is_not_taken_for_a_perfect_one():
    noise = seen(3e-4, 5e-5)
    assert kalman.split(noise, 0.0) == pytest.approx((1e-4, 0.001745**2, 9e-8, 2.74e-9), rel=0.01)
    sure = after_standing(WHITE).covariance
    assert kalman.deviations(sure, 0.0, 0.0)[0] > kalman.UNKNOWN_SIGMA_M > 10.0 * kalman.deviations(sure, 0.0, 0.01)[0]


def test_only_poses_of_one_stay_are_compared_and_a_turn_past_pi_is_small():
    noise = kalman.compare(kalman.begin_noise(), 0.0, 0.0, math.pi - 1e-4, False)
    assert noise.compared == 0
    noise = kalman.compare(noise, 0.0, 0.02, -math.pi + 1e-4, False)
    assert (noise.compared, noise.position_m2) == (1, pytest.approx(0.25 * 0.02**2))
    assert noise.yaw_rad2 == pytest.approx(0.5 * 2e-4**2)
    assert kalman.compare(noise, 3.0, 0.0, 0.0, True).position_m2 == noise.position_m2
    elsewhere = kalman.compare(kalman.moved(noise), 3.0, 0.0, 0.0, False)
    assert (elsewhere.compared, elsewhere.position_m2) == (1, noise.position_m2)


def test_the_estimator_compares_standing_poses_that_it_believes_and_no_others():
    tables = shipped_tables()
    leg = tables.leg[0]

    def cycle(state, x_m, standstill, follows):
        motion = estimator.Motion(0.0, 0.01, 0.0, 0.0, 1, 0.0, 1, standstill, follows)
        gains = gains_at(tables.gains, 0, 0.0)
        return estimator.estimate(
            leg, tables.car, gains, state, motion, 1, x_m, leg.y_m[0], leg.yaw_rad[0], 1, 0.01, 1
        )  # fmt: skip

    start_m = leg.x_m[0]
    state = cycle(estimator.begin(), start_m, 1, 0)
    state = cycle(state, start_m + 0.02, 1, 0)
    assert state.noise.compared == 1
    refused = cycle(state, start_m + 3.0, 1, 1)
    assert (refused.disbelieved, refused.noise.compared) == (1, 1)
    carried = cycle(state, start_m + 3.0, 1, 0)
    assert (carried.averaged, carried.noise.compared) == (1, 1)
    driving = cycle(state, start_m + 0.02, 0, 1)
    assert (driving.noise.stood, driving.noise.compared) == (0, 1)


# -------------------------------------------------------------------------------------------------- what follows of it


class Standing:
    """A car at the start, and an estimator that hears white poses of it."""

    def __init__(self, noise_m=0.01):
        self.tables = shipped_tables()
        self.leg, self.rng, self.noise_m = self.tables.leg[0], random.Random(5), noise_m
        self.state = estimator.begin()

    def stand(self, seconds, aside_m=0.0, follows=0, stated_m=0.01):
        leg, gauss = self.leg, self.rng.gauss
        gains = gains_at(self.tables.gains, 0, 0.0)
        yaw_rad = leg.yaw_rad[0]
        for _ in range(round(100 * seconds)):
            motion = estimator.Motion(0.0, 0.01, 0.0, 0.0, 1, gauss(0.0, 3.5e-4), 1, 1, follows)
            x_m = leg.x_m[0] - aside_m * math.sin(yaw_rad) + gauss(0.0, self.noise_m)
            y_m = leg.y_m[0] + aside_m * math.cos(yaw_rad) + gauss(0.0, self.noise_m)
            pose = (x_m, y_m, yaw_rad + leg.slip_heading_rad[0] + gauss(0.0, 0.175 * self.noise_m))
            self.state = estimator.estimate(
                leg, self.tables.car, gains, self.state, motion, 1, *pose, 1, stated_m, 1
            )  # fmt: skip
        return self.state


def test_a_car_pushed_aside_after_a_long_stay_is_seen_where_it_stands():
    """Whether it is far enough to begin a new average, or not, or the vehicle follows and the car should not move."""
    for aside_m, follows, seconds, least in ((0.08, 0, 1.0, 0.95), (0.03, 0, 6.0, 0.6), (0.08, 1, 6.0, 0.6)):
        car = Standing()
        assert abs(car.stand(60.0, follows=0).cross_track_error_m) < 2e-3
        state = car.stand(seconds, aside_m, follows)
        assert least * aside_m < state.cross_track_error_m < 1.1 * aside_m


def test_noise_alone_begins_no_new_average():
    for noise_m, stated_m in ((0.01, 0.01), (0.03, 0.03)):
        assert Standing(noise_m).stand(30.0, stated_m=stated_m).averaged == estimator.AVERAGING_MAX


def test_poses_of_which_too_much_noise_is_stated_stop_the_car():
    tables = shipped_tables()
    for sigma_m, reason in (
        (0.05, conditions.NONE),
        (0.051, conditions.POSE_INVALID),
        (1.023, conditions.POSE_INVALID),
    ):
        state = controller.begin()
        for cycle in range(100):
            inputs = standing_inputs(tables, cycle)
            inputs = inputs._replace(attitude=inputs.attitude._replace(position_sigma_m=sigma_m))
            state, outputs = controller.step(tables, state, inputs)
        assert outputs.sys.control_mode == (MODE_READY if reason == conditions.NONE else MODE_MANUAL), sigma_m
        assert outputs.sys.control_reason in (reason, conditions.WAITING_FOR_REPORTS)


def test_a_car_that_stands_and_hears_no_pose_claims_nothing():
    node = ControllerNode(shipped_codec(), shipped_tables())
    for cycle in range(1, 31):
        node.cycle(cycle * 10_000_000, [], 0)
    said = node._estimate(node._inputs)
    assert said.cross_track_sigma_m >= 1.0
    assert said.heading_sigma_rad >= 0.1
    assert said.steering_gain_est == estimator.begin().steering_gain


@pytest.mark.parametrize("slow", [False, True])
def test_before_a_leg_slow_noise_is_waited_for(slow):
    car = shipped_tables().car
    for leg in (manoeuvre.LEG_FORWARD, manoeuvre.LEG_DIRECTION_CHANGE):
        state = manoeuvre.begin()._replace(leg=leg)
        waited_us = 0
        while not state.driving:
            state = manoeuvre.proceed(state, car, manoeuvre.gear_of(leg), 0, True, 0, 0.0, slow, 10_000)
            waited_us += 10_000
            assert waited_us < 60_000_000
        assert waited_us == (manoeuvre.SETTLE_US + 10_000 if slow else 10_000)


def test_after_a_cycle_that_failed_no_uncertainty_is_told(monkeypatch):
    node = ControllerNode(shipped_codec(), shipped_tables())
    number = shipped_codec().messages["CTRL_Estimate"].frame_id

    def sent(first, last):
        return [n for cycle in range(first, last) for n, _ in node.cycle(cycle * 10_000_000, [], 0)].count(number)

    assert sent(1, 21) == 2
    monkeypatch.setattr("firmware_py.core.controller.step", lambda *_: 1 / 0)
    assert sent(21, 41) == 0
