"""The search for a path: no cone hides between poses, as good as promised, at an optimum; the ride's details."""

import numpy as np
import pytest

from sim.body import clearance_array_m, outline_of
from sim.data_files import load_course, load_vehicle
from sim.errors import UserError
from tools.design.families import FreeWaypoints, Turn, fit_waypoints
from tools.design.optimise import CHOSEN, FIRST_GUESSES, optimise_path
from tools.design.path import coarse, sample
from tools.design.search import SEARCH_STEP_M, Judge, improve
from tools.design.speed_profile import plan_speed, profile_jerk, station_limit
from tools.design.tables import MAX_SPEED_MPS, speed_limits

OHIO = load_course("ohio")
PAPER = load_vehicle("paper")
TURN = Turn(OHIO.start_pose(PAPER), OHIO.stop_pose(PAPER))
FREE = FreeWaypoints(TURN.start, TURN.stop)
JUDGE = Judge(PAPER, OHIO, CHOSEN.angle_share * PAPER.max_road_wheel_angle_rad, CHOSEN.slope_price_m)


def test_a_cone_cannot_hide_between_two_poses_of_a_long_segment():
    """With a number of poses a segment instead of even steps, cuts like these win 4 cm that are not there."""
    for lengths in ((2.05, 0.71, 0.17), (4.0, 0.1, 0.1), (0.1, 4.0, 0.1), (0.1, 0.1, 0.1)):
        numbers = np.array([*FIRST_GUESSES[0][:4], *lengths])
        fit = fit_waypoints(TURN.waypoints(numbers))
        outline, cones = outline_of(PAPER), OHIO.cones_xy()
        rough, fine = coarse(fit, SEARCH_STEP_M), sample(fit)
        seen_m = clearance_array_m(outline, rough.x_m, rough.y_m, rough.yaw_rad, cones).min()
        true_m = clearance_array_m(outline, fine.x_m, fine.y_m, fine.yaw_rad, cones).min()
        assert seen_m == pytest.approx(true_m, abs=2e-3)
        seen_slope, true_slope = (np.abs(points.curvature_slope_1pm2).max() for points in (rough, fine))
        assert seen_slope == pytest.approx(true_slope, rel=0.05)


def test_the_numbers_of_a_design_make_its_path_again_without_a_search():
    for numbers in (
        FIRST_GUESSES[0],
        tuple(FREE.numbers_of(fit_waypoints(TURN.waypoints(np.array(FIRST_GUESSES[0]))))),
    ):
        design = optimise_path(PAPER, OHIO, numbers=numbers)
        again = optimise_path(PAPER, OHIO, numbers=design.numbers)
        assert design.numbers == numbers
        assert np.array_equal(design.path.x_m, again.path.x_m)
    with pytest.raises(UserError, match="3 numbers given; it takes 20 or 7"):
        optimise_path(PAPER, OHIO, numbers=(0.3, 0.0, 0.5))


@pytest.mark.parametrize("lengths", [(1.0, 1.0, 1.0, 1.0), (2.9, 1.1, 0.6, 0.4)])
def test_free_waypoints_tell_a_path_of_the_family_as_it_is(lengths):
    """To a millimetre: the spline through them is not the polynomials themselves."""
    fit = fit_waypoints(TURN.waypoints(np.array(FIRST_GUESSES[0])))
    numbers = FREE.numbers_of(fit)
    again = fit_waypoints(FREE.waypoints(numbers))
    assert again.length_m == pytest.approx(fit.length_m)
    here, there = sample(fit), sample(again)
    assert np.interp(here.x_m, there.x_m, there.y_m) == pytest.approx(here.y_m, abs=1e-3)
    cut = FREE.numbers_of(fit, np.array(lengths))
    assert cut[: len(lengths)] / cut[: len(lengths)].sum() == pytest.approx(np.array(lengths) / sum(lengths))
    assert cut[len(lengths) :] == pytest.approx(numbers[len(lengths) :])


def test_the_derivatives_of_free_waypoints_are_those_of_the_fit():
    numbers = FREE.numbers_of(fit_waypoints(TURN.waypoints(np.array(FIRST_GUESSES[0]))))
    moved = FREE.moved(numbers)
    assert len(moved) == len(numbers)
    base = fit_waypoints(FREE.waypoints(numbers))
    for index in (0, 3, 4, 11, len(numbers) - 1):
        step, fit = moved[index]
        other = numbers.copy()
        other[index] += step
        direct = fit_waypoints(FREE.waypoints(other))
        assert np.abs(fit.coefficients - direct.coefficients).max() < 1e-9
        assert np.abs(fit.coefficients - base.coefficients).max() > 1e-8


@pytest.mark.parametrize("family", [TURN, FREE], ids=["turn", "free waypoints"])
def test_the_local_search_ends_at_an_optimum(family):
    start = np.array(FIRST_GUESSES[0]) + np.array([0.02, 0.0, -0.03, 0.02, -0.5, -0.5, 0.3])
    if family is FREE:
        start = FREE.numbers_of(fit_waypoints(TURN.waypoints(start)))
    numbers, cost = improve(JUDGE, family, start, 100)
    assert cost == pytest.approx(JUDGE.cost(family, numbers), abs=1e-12)
    assert cost < JUDGE.cost(family, start) - 0.005
    rng = np.random.default_rng(3)
    around = numbers + rng.normal(0.0, 2e-4, (60, len(numbers)))
    inside = np.clip(around, family.low, family.high)
    assert min(JUDGE.cost(family, point) for point in inside) > cost - 2e-4


def test_free_waypoints_win_what_a_turn_cannot_tell():
    turn = min(improve(JUDGE, TURN, np.array(guess), 30)[1] for guess in FIRST_GUESSES[:2])
    start = FREE.numbers_of(fit_waypoints(TURN.waypoints(np.array(FIRST_GUESSES[0]))), np.ones(4))
    assert improve(JUDGE, FREE, start, 40)[1] < turn - 0.002


def test_mirrors_count_half():
    """A cost that takes mirrors for the body would give up 2 cm of the body's room for a millimetre of theirs."""
    fusion = load_vehicle("fusion")
    narrow = fusion.with_overlay({"mirror_width_m": fusion.body_width_m})
    fit = fit_waypoints(Turn(OHIO.start_pose(fusion), OHIO.stop_pose(fusion)).waypoints(np.array(FIRST_GUESSES[1])))
    whole, body = (Judge(car, OHIO, 0.5, 0.0) for car in (fusion, narrow))
    view = whole.view(fit)
    assert np.array_equal(view.body_clearance_m, body.view(fit).clearance_m)
    assert view.clearance_m.min() < view.body_clearance_m.min() - 0.03
    assert whole.cost_of(view) == pytest.approx(-0.5 * (view.clearance_m.min() + view.body_clearance_m.min()))


@pytest.mark.parametrize("rate_radps", [0.59, 0.2])
@pytest.mark.parametrize("direction", [1, -1])
def test_the_ride_starts_gently_and_keeps_its_jerk_and_steering_rate_everywhere(rate_radps, direction):
    vehicle = PAPER.with_overlay({"max_road_wheel_rate_radps": rate_radps})
    path = sample(fit_waypoints(TURN.waypoints(np.array(FIRST_GUESSES[0]))))
    limits = speed_limits(vehicle)
    profile = plan_speed(path, vehicle.wheelbase_m, limits, direction)
    cap = station_limit(path, vehicle.wheelbase_m, limits)[::direction]
    moving = profile.speed_mps > 0.15
    assert np.all(profile.speed_mps <= np.maximum(cap, limits.floor_mps) + 1e-9)
    jerk = np.abs(profile_jerk(profile))[moving[1:-1]]
    assert jerk.max() <= 1.001 * limits.jerk_mps3
    assert jerk.max() >= 0.99 * limits.jerk_mps3  # the limit is used
    first = profile.speed_mps[profile.station_m < 0.02]
    assert first.max() < 0.11
    assert np.abs(profile.accel_mps2).max() <= limits.accel_x_mps2 * (1.0 + 1e-6)
    assert profile.speed_mps.max() < MAX_SPEED_MPS
    assert (cap.min() < 0.45) == (rate_radps < 0.3)
