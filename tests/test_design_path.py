"""Path and speed profile: exact constraints, pinned ends, limits kept, and clear words where nothing fits."""

import numpy as np
import pytest

from sim.body import clearance_m, outline_of
from sim.data_files import load_course, load_vehicle
from sim.errors import UserError
from tools.design import optimise
from tools.design.families import fit_waypoints
from tools.design.optimise import CHOSEN, optimise_path
from tools.design.path import mirrored, sample
from tools.design.path_fit import fit_path, joint_jumps, pins
from tools.design.speed_profile import plan_speed, profile_jerk, road_wheel_slope
from tools.design.tables import speed_limits
from tools.design.waypoints import Waypoints, interpolate

FT_M = 0.3048
PAPER_LIKE = Waypoints(
    x_m=tuple(FT_M * x for x in (0.0, 12.65, 16.57, 24.56, 32.2, 35.91, 50.0)),
    y_m=tuple(FT_M * y for y in (0.0, 0.0, 0.0, 2.0, 4.5, 4.5, 4.5)),
    split_x_m=tuple(FT_M * x for x in (14.69, 23.66, 36.05)),
)


@pytest.fixture(scope="module", params=["paper", "fusion"])
def designed(request):
    vehicle, course = load_vehicle(request.param), load_course("ohio")
    return vehicle, course, optimise_path(vehicle, course)


def test_the_fit_keeps_its_constraints_to_rounding():
    fit = fit_waypoints(PAPER_LIKE)
    assert fit.constraint_residual <= 1e-10
    assert max(joint_jumps(fit)) <= 1e-9
    path = sample(fit)
    assert (path.x_m[0], path.y_m[0]) == pytest.approx((0.0, 0.0), abs=1e-10)
    assert (path.x_m[-1], path.y_m[-1]) == pytest.approx((15.24, 1.3716), abs=1e-10)
    for at_end in (0, -1):
        assert path.yaw_rad[at_end] == pytest.approx(0.0, abs=1e-10)
        assert path.curvature_1pm[at_end] == pytest.approx(0.0, abs=1e-9)


def test_the_fit_is_the_minimum_subject_to_its_constraints():
    """Against a KKT system solved directly: another way to the same least squares."""
    dense = interpolate(PAPER_LIKE)
    fit = fit_path(dense, start=pins(0.0, 0.0, 0.0), stop=pins(15.24, 1.3716, 0.0))
    m, order = 4, 6
    share = (dense.x_m - dense.x_m[:, :1]) / fit.length_m[:, None]
    phi = np.zeros((share.size, m * (order + 1)))
    for i in range(m):
        rows = slice(i * share.shape[1], (i + 1) * share.shape[1])
        phi[rows, i * (order + 1) : (i + 1) * (order + 1)] = np.vander(share[i], order + 1, increasing=True)
    theta = fit.coefficients[:, :, 1].ravel()
    gradient = phi.T @ (phi @ theta - dense.y_m.ravel())
    # At the constrained minimum the gradient lies in the row space of the constraints: any admissible move costs.
    rng = np.random.default_rng(0)
    base = np.sum((phi @ theta - dense.y_m.ravel()) ** 2)
    other = fit_path(dense._replace(y_m=dense.y_m + rng.normal(0, 1e-3, dense.y_m.shape)),
                     start=pins(0.0, 0.0, 0.0), stop=pins(15.24, 1.3716, 0.0))  # fmt: skip
    move = other.coefficients[:, :, 1].ravel() - theta
    assert np.linalg.norm(move) > 1e-4
    assert abs(gradient @ move) < 1e-8 * np.linalg.norm(phi @ move)
    assert np.sum((phi @ (theta + move) - dense.y_m.ravel()) ** 2) > base


def test_free_ends_and_raw_parameter_are_worse_where_segments_differ_in_length():
    unequal = PAPER_LIKE._replace(split_x_m=tuple(FT_M * x for x in (6.0, 20.0, 34.0)))
    dense = interpolate(unequal)
    scaled = fit_path(dense, length_scaled=True)
    raw = fit_path(dense, length_scaled=False)
    assert scaled.fit_rms_m[0] < 1e-6
    assert raw.fit_rms_m[0] > 1e-3


def test_curvature_and_slope_are_the_derivatives_of_the_sampled_path():
    fit = fit_waypoints(PAPER_LIKE)
    path = sample(fit)
    step_m = path.step_m
    assert np.hypot(np.diff(path.x_m), np.diff(path.y_m)) == pytest.approx(step_m, rel=1e-5)
    assert np.gradient(np.unwrap(path.yaw_rad), step_m)[1:-1] == pytest.approx(path.curvature_1pm[1:-1], abs=2e-4)
    # A difference over two steps cannot follow the kink that the slope has at a joint: there, each side by itself.
    error = np.abs(np.gradient(path.curvature_1pm, step_m) - path.curvature_slope_1pm2)
    joints = np.searchsorted(path.x_m, PAPER_LIKE.split_x_m)
    inner = np.ones(len(error), dtype=bool)
    inner[[0, -1, *joints, *(joints - 1)]] = False
    assert error[inner].max() < 1e-3
    k, dk = path.curvature_1pm, path.curvature_slope_1pm2
    for at, sign in [*((joint, 1) for joint in joints), *((joint - 1, -1) for joint in joints)]:
        one_sided = sign * (-1.5 * k[at] + 2.0 * k[at + sign] - 0.5 * k[at + 2 * sign]) / step_m
        assert one_sided == pytest.approx(dk[at], abs=1e-3)


def test_the_mirrored_path_is_exact():
    path = sample(fit_waypoints(PAPER_LIKE))
    mirror = mirrored(path)
    assert np.array_equal(mirror.x_m, path.x_m)
    for name in ("y_m", "yaw_rad", "curvature_1pm", "curvature_slope_1pm2"):
        assert np.array_equal(getattr(mirror, name), -getattr(path, name))


def test_the_designed_path_starts_and_stops_where_the_course_says(designed):
    vehicle, course, design = designed
    path = design.path
    for row, pose in ((0, course.start_pose(vehicle)), (-1, course.stop_pose(vehicle))):
        assert (path.x_m[row], path.y_m[row], path.yaw_rad[row]) == pytest.approx(pose, abs=1e-9)
    assert design.fit.constraint_residual <= 1e-10
    assert max(joint_jumps(design.fit)) <= 1e-9


def test_the_designed_path_has_room_and_can_be_steered(designed):
    vehicle, course, design = designed
    path, outline, cones = design.path, outline_of(vehicle), course.cones_xy()
    brute_m = min(clearance_m(outline, *pose, cones)[0] for pose in zip(path.x_m, path.y_m, path.yaw_rad, strict=True))
    assert design.clearance_m == pytest.approx(brute_m, abs=1e-12)
    least_m, least_body_m = {"paper": (0.32, 0.32), "fusion": (0.31, 0.42)}[vehicle.name]
    assert design.clearance_m >= least_m
    assert design.body_clearance_m >= least_body_m
    narrow = outline_of(vehicle.with_overlay({"mirror_width_m": vehicle.body_width_m}))
    body_m = min(clearance_m(narrow, *pose, cones)[0] for pose in zip(path.x_m, path.y_m, path.yaw_rad, strict=True))
    assert design.body_clearance_m == pytest.approx(body_m, abs=1e-12)
    assert design.max_road_wheel_angle_rad <= (CHOSEN.angle_share + 0.002) * vehicle.max_road_wheel_angle_rad


def test_the_search_is_repeatable(monkeypatch):
    """With less patience than the design's, which changes no more than how far it gets."""
    for name, least in (("SCREENED", 20), ("STARTS", 1), ("TURN_ROUNDS", 3), ("TRIAL_ROUNDS", 3), ("FINAL_ROUNDS", 5)):
        monkeypatch.setattr(optimise, name, least)
    vehicle, course = load_vehicle("paper"), load_course("ohio")
    first, again = (optimise_path(vehicle, course) for _ in range(2))
    assert np.array_equal(first.path.x_m, again.path.x_m)
    assert first.numbers == again.numbers


@pytest.mark.parametrize("direction", [1, -1])
def test_the_speed_profile_keeps_every_limit(designed, direction):
    vehicle, _, design = designed
    limits = speed_limits(vehicle)
    path = design.path
    profile = plan_speed(path, vehicle.wheelbase_m, limits, direction)
    curvature = path.curvature_1pm[::direction]
    steering = road_wheel_slope(path, vehicle.wheelbase_m)[::direction]
    assert profile.speed_mps.max() <= limits.speed_mps + 1e-9
    assert profile.speed_mps.min() >= limits.floor_mps
    assert profile.speed_mps[[0, -1]] == pytest.approx(limits.floor_mps)
    assert np.abs(profile.speed_mps**2 * curvature).max() <= limits.accel_y_mps2 * 1.0001
    assert np.abs(profile.speed_mps * steering).max() <= limits.road_wheel_rate_radps * 1.0001
    assert np.abs(profile.accel_mps2).max() <= limits.accel_x_mps2 * 1.0001
    moving = profile.speed_mps[1:-1] > 0.15  # below, the floor takes the place of the profile
    assert np.abs(profile_jerk(profile)[moving]).max() <= 1.001 * limits.jerk_mps3
    assert profile.speed_mps.max() > 0.9


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"x_m": (0.0, 2.0, 1.0, 5.0, 6.0, 7.0, 9.0)}, "waypoint 3 .* is not ahead of waypoint 2"),
        ({"x_m": (0.0, 1.0, 2.0), "y_m": (0.0, 0.0, 1.0)}, "3 given; .* needs 4"),
        ({"x_m": (0.0, 1.0, 2.0, 3.0)}, "4 x but 7 y"),
        ({"y_m": (0.0, 0.0, float("nan"), 1.0, 1.0, 1.0, 1.0)}, "waypoint 3 is .*finite"),
        ({"split_x_m": (3.0, 2.0, 8.0)}, "the cuts must increase"),
        ({"split_x_m": (3.0, 5.0, 99.0)}, "the cuts must increase and lie between"),
    ],
)
def test_bad_waypoints_are_one_line(changes, says):
    with pytest.raises(UserError, match=says) as caught:
        fit_waypoints(PAPER_LIKE._replace(**changes))
    assert "\n" not in str(caught.value)


def test_more_conditions_than_coefficients_is_one_line():
    dense = interpolate(PAPER_LIKE)
    with pytest.raises(UserError, match="conditions"):
        fit_path(dense, p=3, q=3, start=pins(0.0, 0.0, 0.0), stop=pins(15.24, 1.3716, 0.0))
