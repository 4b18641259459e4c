"""Vehicle, course and scenario files: what is shipped is right, and every mistake gives its one line."""

from __future__ import annotations

import hashlib
import math
import random
from pathlib import Path

import pytest
from data_file_support import LOADERS, OHIO, PAPER, one_line

from sim.data_files import (
    Pose,
    check_fit,
    load_course,
    load_scenario,
    load_vehicle,
    shipped_names,
    true_vehicle,
)
from sim.errors import UserError

# ---------------------------------------------------------------------------------------------------------- shipped


def test_what_is_shipped() -> None:
    assert shipped_names("vehicle") == ["compact", "fusion", "paper", "pickup"]
    assert shipped_names("course") == ["ohio", "paper"]
    assert set(shipped_names("scenario")) >= {
        "ideal",
        "quantised",
        "car-quiet",
        "car",
        "car-unknown-lag",
        "car-drift",
        "car-drift-3mm",
        "slow-rack",
        "slow-rack-unknown",
        "start-offset",
    }


@pytest.mark.parametrize("kind", LOADERS)
def test_every_shipped_file_loads_under_its_own_name(kind: str) -> None:
    for name in shipped_names(kind):
        assert LOADERS[kind](name).name == name  # type: ignore[attr-defined]


@pytest.mark.parametrize("vehicle", shipped_names("vehicle"))
@pytest.mark.parametrize("course", shipped_names("course"))
def test_every_shipped_vehicle_fits_every_shipped_course(vehicle: str, course: str) -> None:
    check_fit(load_vehicle(vehicle), load_course(course))


@pytest.mark.parametrize("vehicle", shipped_names("vehicle"))
@pytest.mark.parametrize("scenario", shipped_names("scenario"))
def test_no_scenario_takes_a_car_out_of_its_box_by_more_than_it_says(vehicle: str, scenario: str) -> None:
    """Corners and unknown parameters of `car*` stay in low..high: the design must survive them."""
    nominal = load_vehicle(vehicle)
    drawn = load_scenario(scenario)
    if scenario.startswith("slow-rack"):
        return
    for seed in range(16):
        true = true_vehicle(nominal, drawn, seed, random.Random(seed))
        for key, (low, high) in nominal.box.items():
            assert low - 1e-6 * abs(low) <= getattr(true, key) <= high + 1e-6 * abs(high), key


def test_the_papers_car_and_the_fusion() -> None:
    paper, fusion = load_vehicle("paper"), load_vehicle("fusion")
    assert (paper.wheelbase_m, paper.mass_kg, paper.yaw_inertia_kgm2, paper.cg_to_rear_axle_m) == (4, 3000, 5113, 2)
    assert paper.front_overhang_m + paper.wheelbase_m + paper.rear_overhang_m == pytest.approx(5.8)
    assert paper.body_width_m == 2.0
    assert (paper.max_road_wheel_angle_rad, paper.max_road_wheel_rate_radps) == (0.50, 0.59)
    assert paper.box["steering_lag_s"] == (0.05, 0.20)
    latencies = paper.box["pose_latency_samples"], paper.box["command_latency_samples"]
    assert [sum(pair) for pair in zip(*latencies, strict=True)] == [1.0, 3.0]
    assert fusion.front_overhang_m + fusion.wheelbase_m + fusion.rear_overhang_m == pytest.approx(4.87)
    assert (fusion.wheelbase_m, fusion.body_width_m, fusion.mirror_width_m) == (2.85, 1.85, 2.12)
    assert fusion.max_road_wheel_rate_radps == pytest.approx(math.radians(500.0) / fusion.steering_ratio, abs=5e-4)


@pytest.mark.parametrize(("name", "length_m", "mirrors_m"), [("compact", 4.255, 2.03), ("pickup", 5.89, 2.12)])
def test_the_compact_and_the_pickup(name: str, length_m: float, mirrors_m: float) -> None:
    car = load_vehicle(name)
    assert car.front_overhang_m + car.wheelbase_m + car.rear_overhang_m == pytest.approx(length_m, abs=3e-3)
    assert car.mirror_width_m == mirrors_m
    assert car.max_road_wheel_rate_radps == pytest.approx(math.radians(500.0) / car.steering_ratio, abs=1e-3)
    low, high = car.box["wheelbase_m"]
    assert (low, high) == pytest.approx((0.95 * car.wheelbase_m, 1.05 * car.wheelbase_m), abs=1e-3)
    sums = [sum(pair) for pair in zip(car.box["pose_latency_samples"], car.box["command_latency_samples"], strict=True)]
    assert sums == [1.0, 3.0]


def test_poses_on_the_ohio_course_are_set_by_the_bumpers() -> None:
    vehicle, course = load_vehicle("fusion"), load_course("ohio")
    start = course.start_pose(vehicle)
    assert start.x_m + vehicle.wheelbase_m + vehicle.front_overhang_m == pytest.approx(3.048)
    assert (start.y_m, start.yaw_rad) == (0.0, 0.0)
    left, right = course.stop_pose(vehicle, "left"), course.stop_pose(vehicle, "right")
    assert left.x_m - vehicle.rear_overhang_m == pytest.approx(9.144)
    assert (left.y_m, right.y_m) == (1.3716, -1.3716)
    assert left.x_m == right.x_m


def test_poses_on_the_papers_course_are_set_by_the_centre_of_gravity() -> None:
    vehicle, course = load_vehicle("paper"), load_course("paper")
    assert course.start_pose(vehicle) == Pose(-2.0, 0.0, 0.0)
    assert course.stop_pose(vehicle, "right") == pytest.approx(Pose(13.24, -1.3716, 0.0))


def test_the_right_side_mirrors_the_cones_too(tmp_path: Path) -> None:
    path = tmp_path / "c.toml"
    path.write_text(
        OHIO.read_text().replace('name = "point"\nx_m = 9.144\ny_m = 0.0', 'name = "point"\nx_m = 9.144\ny_m = 0.5')
    )
    course = load_course(path)
    assert course.cones_xy("left")[-1] == (9.144, 0.5)
    assert course.cones_xy("right")[-1] == (9.144, -0.5)


# ------------------------------------------------------------------------------------------------- hash and overlay


def test_the_hash_is_the_documented_one(tmp_path: Path) -> None:
    raw = PAPER.read_bytes()
    assert load_vehicle("paper").hash24 == int.from_bytes(hashlib.sha256(raw).digest()[:3], "big")
    windows = tmp_path / "v.toml"
    windows.write_bytes(raw.replace(b"\n", b"\r\n"))
    assert load_vehicle(windows).hash24 == load_vehicle("paper").hash24
    overlaid = load_vehicle("paper", {"steering_lag_s": 0.27, "command_latency_samples": 24})
    text = b"command_latency_samples=24.0\nsteering_lag_s=0.27\n"
    assert overlaid.hash24 == int.from_bytes(hashlib.sha256(raw + text).digest()[:3], "big")


def test_an_overlay_moves_the_nominal_and_widens_the_box() -> None:
    vehicle = load_vehicle("paper", {"steering_lag_s": 0.27})
    assert vehicle.steering_lag_s == 0.27
    assert vehicle.box["steering_lag_s"] == (0.05, 0.27)
    assert load_vehicle("paper").steering_lag_s == 0.10


def test_the_same_overlay_twice_is_the_same_car_and_two_add_up() -> None:
    once = load_vehicle("paper", {"steering_lag_s": 0.0})
    assert once.with_overlay({"steering_lag_s": 0.0}) == once
    assert once.with_overlay({"steering_lag_s": 0.0}).hash24 == once.hash24
    both = once.with_overlay({"drive_lag_s": 0.2})
    assert both.overlay == {"steering_lag_s": 0.0, "drive_lag_s": 0.2}
    assert both.hash24 not in {once.hash24, load_vehicle("paper").hash24}


@pytest.mark.parametrize(
    ("overlay", "message"),
    [
        ({"steering_lag": 0.1}, "overlay: steering_lag: unknown key; a vehicle has wheelbase_m, "),
        ({"steering_lag_s": 3.0}, "overlay: steering_lag_s = 3.0: must be from 0 to 2 s"),
        ({"steering_lag_s": math.nan}, "overlay: steering_lag_s = nan: must be from 0 to 2 s"),
        ({"cg_to_rear_axle_m": 4.0}, "overlay: cg_to_rear_axle_m = 4.0: must be less than wheelbase_m = 4.0"),
    ],
)
def test_a_wrong_overlay_is_one_line(overlay: dict[str, float], message: str) -> None:
    with pytest.raises(UserError) as error:
        load_vehicle("paper").with_overlay(overlay)
    assert one_line(error).startswith(message)


# ---------------------------------------------------------------------------------------------------- does it fit?


@pytest.mark.parametrize(
    ("overlay", "message"),
    [
        (
            {"body_width_m": 2.6, "mirror_width_m": 2.6},
            "vehicle paper does not fit course ohio: at the start its outline is 0.072 m from the axis of cone "
            "front-left, and must be 0.100 m or more; body_width_m = 2.600 prevents it (2.522 would do)",
        ),
        (
            {"mirror_width_m": 2.8, "mirror_from_rear_axle_m": 4.85},
            "vehicle paper does not fit course ohio: at the start its outline is -0.028 m from the axis of "
            "cone front-left, and must be 0.100 m or more; mirror_width_m = 2.800 prevents it (2.520 would do)",
        ),
    ],
)
def test_a_car_that_is_too_wide(overlay: dict[str, float], message: str) -> None:
    with pytest.raises(UserError) as error:
        check_fit(load_vehicle("paper", overlay), load_course("ohio"))
    assert one_line(error) == message


def test_a_car_that_is_so_long_that_the_stop_lies_behind_the_start(tmp_path: Path) -> None:
    path = tmp_path / "c.toml"
    path.write_text(OHIO.read_text().replace("x_m = 9.144\nlateral", "x_m = -9.144\nlateral"))
    with pytest.raises(UserError) as error:
        check_fit(load_vehicle("paper"), load_course(path))
    assert one_line(error) == "vehicle paper does not fit course ohio: the stop would lie 6.392 m behind the start"


# ------------------------------------------------------------------------------------------------------------ draws


def test_corners_follow_the_lowest_bits_of_the_seed() -> None:
    vehicle, car = load_vehicle("paper"), load_scenario("car")
    seen = set()
    for seed in range(8):
        true = true_vehicle(vehicle, car, seed, random.Random(0))
        mass, front, rear = (
            true.mass_kg / 3000.0,
            true.cornering_stiffness_front_n_per_rad / 3e5,
            true.cornering_stiffness_rear_n_per_rad / 3e5,
        )
        assert [mass, front, rear] == pytest.approx([1.3 if seed >> bit & 1 else 0.7 for bit in range(3)])
        seen.add((mass, front, rear))
        assert true_vehicle(vehicle, car, seed + 8, random.Random(0)).mass_kg == true.mass_kg
    assert len(seen) == 8


def test_unknown_parameters_are_drawn_over_their_whole_range_and_leave_the_hash_alone() -> None:
    vehicle, scenario = load_vehicle("paper"), load_scenario("car-unknown-lag")
    cars = [true_vehicle(vehicle, scenario, 0, random.Random(seed)) for seed in range(400)]
    ranges = {"steering_lag_s": (0.05, 0.20), "pose_latency_samples": (1, 2), "command_latency_samples": (0, 1)}
    for key, (low, high) in ranges.items():
        values = [getattr(car, key) for car in cars]
        assert low <= min(values) < low + 0.03 * (high - low)
        assert high - 0.03 * (high - low) < max(values) <= high
    assert vehicle.hash24 == load_vehicle("paper", scenario.vehicle_overlay).hash24


def test_a_start_offset_is_in_the_cars_own_frame() -> None:
    scenario = load_scenario("start-offset")
    rng = random.Random(0)
    starts = [scenario.start.apply(Pose(1.0, 2.0, math.pi / 2), rng) for _ in range(300)]
    assert all(abs(start.x_m - 1.0) <= 0.05 and start.y_m == pytest.approx(2.0) for start in starts)
    assert max(start.x_m for start in starts) > 1.045
    assert max(abs(start.yaw_rad - math.pi / 2) for start in starts) == pytest.approx(math.radians(1.0), rel=0.02)
    assert load_scenario("car").start.apply(Pose(1.0, 2.0, 0.5), rng) == Pose(1.0, 2.0, 0.5)
