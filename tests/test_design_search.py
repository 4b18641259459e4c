"""The search for a path: no cone hides between poses, as good as promised, at an optimum; the ride's details."""

import numpy as np
import pytest

from sim.body import clearance_array_m, outline_of
from sim.data_files import load_course, load_vehicle
from sim.errors import UserError
from tools.design import optimise
from tools.design.optimise import FIRST_GUESSES, fit_waypoints, max_road_wheel_slope, optimise_path, waypoints_of
from tools.design.path import coarse, sample
from tools.design.speed_profile import plan_speed, profile_jerk, station_limit
from tools.design.tables import MAX_SPEED_MPS, speed_limits

OHIO = load_course("ohio")
PAPER = load_vehicle("paper")


def test_a_cone_cannot_hide_between_two_poses_of_a_long_segment():
    """With a number of poses a segment instead of even steps, cuts like these win 4 cm that are not there."""
    for lengths in ((2.05, 0.71, 0.17), (4.0, 0.1, 0.1), (0.1, 4.0, 0.1), (0.1, 0.1, 0.1)):
        numbers = np.array([*FIRST_GUESSES[0][:4], *lengths])
        fit = fit_waypoints(waypoints_of(numbers, PAPER, OHIO))
        outline, cones = outline_of(PAPER), OHIO.cones_xy()
        rough, fine = coarse(fit, optimise.SEARCH_STEP_M), sample(fit)
        seen_m = clearance_array_m(outline, rough.x_m, rough.y_m, rough.yaw_rad, cones).min()
        true_m = clearance_array_m(outline, fine.x_m, fine.y_m, fine.yaw_rad, cones).min()
        assert seen_m == pytest.approx(true_m, abs=2e-3)
        seen_slope, true_slope = (np.abs(points.curvature_slope_1pm2).max() for points in (rough, fine))
        assert seen_slope == pytest.approx(true_slope, rel=0.05)


@pytest.mark.parametrize(
    ("vehicle", "least_m", "most_slope_radpm"),
    [
        (PAPER, 0.325, 0.40),
        (load_vehicle("fusion"), 0.305, 0.30),
        (load_vehicle("fusion").with_overlay({"mirror_width_m": 1.85}), 0.41, 0.60),
    ],
    ids=["paper", "fusion", "fusion without mirrors"],
)
def test_room_and_softness_of_the_best_path(vehicle, least_m, most_slope_radpm):
    design = optimise_path(vehicle, OHIO)
    assert design.clearance_m >= least_m
    assert max_road_wheel_slope(design, vehicle.wheelbase_m) <= most_slope_radpm


def test_the_numbers_of_a_design_make_its_path_again_without_a_search():
    numbers = tuple(FIRST_GUESSES[0])
    design = optimise_path(PAPER, OHIO, numbers=numbers)
    again = optimise_path(PAPER, OHIO, numbers=design.numbers)
    assert design.numbers == numbers
    assert np.array_equal(design.path.x_m, again.path.x_m)
    with pytest.raises(UserError, match="3 numbers given; it takes 7"):
        optimise_path(PAPER, OHIO, numbers=(0.3, 0.0, 0.5))


def test_the_local_search_ends_at_an_optimum():
    judge = optimise._Judge(PAPER, OHIO, optimise.SLOPE_PRICE_M)
    start = np.array(FIRST_GUESSES[0]) + np.array([0.02, 0.0, -0.03, 0.02, -0.5, -0.5, 0.3])
    numbers, cost = optimise._improve(judge, start, optimise.ROUNDS)
    assert cost == pytest.approx(judge.cost(numbers), abs=1e-12)
    assert cost < judge.cost(start) - 0.005
    rng = np.random.default_rng(3)
    around = numbers + rng.normal(0.0, 2e-4, (60, len(numbers)))
    inside = np.clip(around, optimise._LOW, optimise._HIGH)
    assert min(judge.cost(point) for point in inside) > cost - 2e-4


@pytest.mark.parametrize("rate_radps", [0.59, 0.2])
@pytest.mark.parametrize("direction", [1, -1])
def test_the_ride_starts_gently_and_keeps_its_jerk_and_steering_rate_everywhere(rate_radps, direction):
    vehicle = PAPER.with_overlay({"max_road_wheel_rate_radps": rate_radps})
    path = sample(fit_waypoints(waypoints_of(np.array(FIRST_GUESSES[0]), vehicle, OHIO)))
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
