"""Vehicle, course and scenario files: what is shipped is right, and every mistake gives its one line."""

from __future__ import annotations

import hashlib
import math
import random
import re
from collections.abc import Callable
from pathlib import Path
from typing import get_args

import pytest

from sim.data_files import (
    FOLDERS,
    PARAMETERS,
    PlantDeviation,
    Pose,
    Sensors,
    StartOffset,
    check_fit,
    find_file,
    load_course,
    load_scenario,
    load_vehicle,
    shipped_names,
    true_vehicle,
)
from sim.errors import UserError
from sim.faults import FaultEvent, FaultKind

PAPER = FOLDERS["vehicle"] / "paper.toml"
OHIO = FOLDERS["course"] / "ohio.toml"
CAR = FOLDERS["scenario"] / "car.toml"
LOADERS: dict[str, Callable[[str | Path], object]] = {
    "vehicle": load_vehicle,
    "course": load_course,
    "scenario": load_scenario,
}


def one_line(error: pytest.ExceptionInfo[UserError]) -> str:
    text = str(error.value)
    assert "\n" not in text
    return text


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


# ---------------------------------------------------------------------------------------------------- finding files


def test_a_name_is_shipped_and_a_path_is_a_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mine = tmp_path / "mine.toml"
    mine.write_text(PAPER.read_text())
    monkeypatch.chdir(tmp_path)
    assert find_file("vehicle", "paper") == PAPER
    assert find_file("vehicle", "mine.toml") == Path("mine.toml")
    assert find_file("vehicle", str(mine)) == mine
    assert find_file("vehicle", mine) == mine


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("papper", "no vehicle is called 'papper'; there are NAMES, or give the path of a .toml file"),
        ("", "no vehicle is called ''; there are NAMES, or give the path of a .toml file"),
        ("x.toml", "x.toml: no such vehicle file; give the path of a .toml file or one of the names NAMES"),
        ("no/x", "no/x: no such vehicle file; give the path of a .toml file or one of the names NAMES"),
        ("/", "/: no such vehicle file; give the path of a .toml file or one of the names NAMES"),
    ],
)
def test_a_file_that_is_not_there(name: str, message: str) -> None:
    with pytest.raises(UserError) as error:
        load_vehicle(name)
    assert one_line(error) == message.replace("NAMES", "compact, fusion, paper, pickup")


@pytest.mark.parametrize("kind", LOADERS)
@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"name = \n", "not valid TOML: Invalid value (at line 1, column 8)"),
        (b"a = 1\na = 2\n", "not valid TOML: Cannot overwrite a value (at line 2, column 6)"),
        (b"\xff\xfe", "not a text file in UTF-8 (byte 0)"),
        (b"", "name: missing (and "),
    ],
)
def test_a_file_that_is_no_toml(kind: str, content: bytes, message: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.toml"
    path.write_bytes(content)
    with pytest.raises(UserError) as error:
        LOADERS[kind](path)
    assert one_line(error).startswith(f"{path}: {message}")


# ------------------------------------------------------------------------------------------- mistakes inside a file


def mistake(kind: str, original: Path, old: str, new: str, tmp_path: Path) -> str:
    """What the loader says of a shipped file in which `old` (found once) has become `new`."""
    text = original.read_text()
    assert text.count(old) == 1, f"{old!r} stands {text.count(old)} times in {original.name}"
    path = tmp_path / "changed.toml"
    path.write_text(text.replace(old, new))
    with pytest.raises(UserError) as error:
        LOADERS[kind](path)
    line = one_line(error)
    assert line.startswith(f"{path}: ")
    return line.removeprefix(f"{path}: ")


MASS = "mass_kg = { nominal = 3000.0, low = 2100.0, high = 3900.0"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "mass_kg =",
            "weight_kg =",
            "parameters.weight_kg: unknown key; a vehicle has wheelbase_m, front_overhang_m, ",
        ),
        (MASS, "mass_kg = { nominal = 3000.0, low = 2100.0, hihg = 3900.0", "parameters.mass_kg.hihg: unknown key"),
        (MASS, "mass_kg = { nominal = 3000.0, low = 2100.0", "parameters.mass_kg.high: missing"),
        (
            MASS,
            'mass_kg = { nominal = "heavy", low = 2100.0, high = 3900.0',
            "parameters.mass_kg.nominal = 'heavy': input should be a valid number",
        ),
        (
            MASS,
            "mass_kg = { nominal = true, low = 2100.0, high = 3900.0",
            "parameters.mass_kg.nominal = True: input should be a valid number",
        ),
        (
            MASS,
            "mass_kg = { nominal = nan, low = 2100.0, high = 3900.0",
            "parameters.mass_kg.nominal = nan: input should be a finite number",
        ),
        (
            MASS,
            "mass_kg = { nominal = 3000.0, low = 3100.0, high = 3900.0",
            "parameters.mass_kg: low <= nominal <= high does not hold for 3100.0, 3000.0, 3900.0",
        ),
        (
            MASS,
            "mass_kg = { nominal = 3000.0, low = 2100.0, high = 2900.0",
            "parameters.mass_kg: low <= nominal <= high does not hold for 2100.0, 3000.0, 2900.0",
        ),
        (
            MASS,
            "mass_kg = { nominal = 3000.0, low = 5.0, high = 3900.0",
            "parameters.mass_kg.low = 5.0: must be from 50 to 60000 kg",
        ),
        (MASS + ', unit = "kg"', MASS + ', unit = "t"', "parameters.mass_kg.unit = 't': must be 'kg'"),
        (MASS + ', unit = "kg"', MASS, "parameters.mass_kg.unit: missing"),
        (
            "nominal = 0.50, low = 0.50, high = 0.50",
            "nominal = 28.6, low = 0.50, high = 28.6",
            "parameters.max_road_wheel_angle_rad.nominal = 28.6: must be from 0.05 to 1.2 rad",
        ),
        (
            'source = "paper, Table 4; -/+30 % for the load"',
            'source = ""',
            "parameters.mass_kg.source = '': string should have at least 1 character",
        ),
        (
            'name = "paper"',
            'name = "Paper Car"',
            "name = 'Paper Car': string should match pattern '^[a-z0-9][a-z0-9_-]{0,39}$'",
        ),
        (
            "[parameters]",
            "colour = 1\n[parameters]",
            "colour: unknown key; known here: name, description, parameters, design",
        ),
        (
            "cg_to_rear_axle_m = { nominal = 2.0, low = 2.0, high = 2.0",
            "cg_to_rear_axle_m = { nominal = 4.5, low = 2.0, high = 4.5",
            "parameters.cg_to_rear_axle_m = 4.5: must be less than wheelbase_m = 4.0",
        ),
        (
            "mirror_width_m = { nominal = 2.0, low = 2.0, high = 2.0",
            "mirror_width_m = { nominal = 1.9, low = 1.9, high = 2.0",
            "parameters.mirror_width_m = 1.9: is the width over the mirrors, so at least body_width_m = 2.0",
        ),
        (
            "slowest_pole_1pm = -0.08",
            "slowest_pole_1pm = 0.08",
            "design.slowest_pole_1pm = 0.08: input should be less than 0",
        ),
        (
            "least_damping = 0.1",
            "damping = 0.1",
            "design.damping: unknown key; known here: slowest_pole_1pm, least_damping, least_disk_margin, "
            "least_delay_margin_samples",
        ),
    ],
)
def test_mistakes_in_a_vehicle_file(old: str, new: str, message: str, tmp_path: Path) -> None:
    line = mistake("vehicle", PAPER, old, new, tmp_path)
    assert line == message or (message.endswith((", ", "key")) and line.startswith(message))


@pytest.mark.parametrize("key", PARAMETERS)
def test_every_parameter_must_be_there(key: str, tmp_path: Path) -> None:
    lines = [line for line in PAPER.read_text().splitlines() if not line.startswith(f"{key} =")]
    path = tmp_path / "v.toml"
    path.write_text("\n".join(lines))
    with pytest.raises(UserError) as error:
        load_vehicle(path)
    unit = PARAMETERS[key].unit
    assert one_line(error) == (
        f'{path}: parameters.{key}: missing; write {key} = {{ nominal = , low = , high = , unit = "{unit}", '
        f'source = "" }}'
    )


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("cone_radius_m = 0.10", "cone_radius_m = -0.10", "cone_radius_m = -0.1: input should be greater than 0"),
        (
            "cone_radius_m = 0.10",
            "cone_radius = 0.10",
            "cone_radius: unknown key; known here: name, description, source, frame, cone_radius_m, cones, "
            "start, stop, tolerances, score (and 1 more)",
        ),
        (
            'name = "point"\nx_m = 9.144',
            'name = "point"\nx = 9.144',
            "cones[5].x: unknown key; known here: name, x_m, y_m (and 1 more)",
        ),
        (
            'name = "point"\nx_m = 9.144',
            'name = "point"\nx_m = 915',
            "cones[5].x_m = 915: input should be less than or equal to 150",
        ),
        ('name = "point"', 'name = "rear-left"', "cones: the name 'rear-left' stands twice"),
        (
            'rule = "front_bumper_x"',
            'rule = "rear_bumper_x"',
            "start.rule = 'rear_bumper_x': must be 'front_bumper_x', 'reference_point'",
        ),
        ('rule = "front_bumper_x"\n', "", "start.rule: missing"),
        (
            "lateral_shift_m = 1.3716",
            "lateral_shift_m = -1.3716",
            "stop.lateral_shift_m = -1.3716: input should be greater than 0",
        ),
        (
            "lateral_shift_m = 1.3716",
            "aside_m = 1.3716",
            "stop.aside_m: unknown key; known here: rule, x_m, lateral_shift_m (and 1 more)",
        ),
        (
            "parallel_rad = 0.05236",
            "parallel_rad = 3.0",
            "tolerances.parallel_rad = 3.0: input should be less than or equal to 0.8",
        ),
        ("full = 100", "full = 100.5", "score.full = 100.5: input should be a valid integer"),
        ("pass = 75", "pass = 175", "score: pass = 175 is more than full = 100"),
        (
            'rule = "cone_bumped"',
            'rule = "cone_kissed"',
            "score.mistakes[2].rule = 'cone_kissed': input should be 'stop_to_check_progress', 'cone_bumped', "
            "'stop_distance_misjudged', 'not_parallel', 'cone_knocked_down', 'wrong_side' or 'not_completed'",
        ),
        ('rule = "cone_bumped"', 'rule = "not_parallel"', "score: the mistake not_parallel stands twice"),
    ],
)
def test_mistakes_in_a_course_file(old: str, new: str, message: str, tmp_path: Path) -> None:
    assert mistake("course", OHIO, old, new, tmp_path) == message


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "steering_gain = 0.95",
            "steering_gain = 9.5",
            "plant.steering_gain: 9.5 must be from 0.5 to 1.5, the lower end first",
        ),
        (
            "steering_gain = 0.95",
            "steering_gain = [1.1, 0.9]",
            "plant.steering_gain: [1.1, 0.9] must be from 0.5 to 1.5, the lower end first",
        ),
        ("steering_gain = 0.95", "steering_gain = [1.1]", "plant.steering_gain: [1.1] must be a number or [low, high]"),
        (
            "steering_gain = 0.95",
            "steering_gain = nan",
            "plant.steering_gain: nan must be from 0.5 to 1.5, the lower end first",
        ),
        (
            "steering_gain = 0.95",
            "steering_gian = 0.95",
            "plant.steering_gian: unknown key; known here: model, reverse_sign, steering_gain, steering_bias_rad, "
            "steering_backlash_rad, steering_command_resolution_rad, longitudinal_latency_samples, unknown, "
            "corners",
        ),
        (
            "steering_gain = 0.95",
            'model = "eq12"',
            "plant.model = 'eq12': input should be 'nonlinear' or 'eq11'",
        ),
        (
            "steering_gain = 0.95",
            'model = "eq11"\nreverse_sign = "minus"',
            "plant.reverse_sign = 'minus': input should be 'corrected' or 'printed'",
        ),
        (
            "steering_gain = 0.95",
            'reverse_sign = "printed"',
            "plant.reverse_sign = 'printed': is for plant.model = \"eq11\" only",
        ),
        (
            "[plant]",
            'course = "moon"\n[plant]',
            "course = 'moon': must be the name of a shipped course: ohio, paper",
        ),
        ("mass_kg = 0.3", "mass = 0.3", "plant.corners.mass: unknown key; a vehicle has "),
        ("mass_kg = 0.3", "mass_kg = 1.3", "plant.corners.mass_kg = 1.3: input should be less than or equal to 0.9"),
        (
            "odometry_scale = 0.01",
            "odometry_scale = 1.01",
            "sensors.odometry_scale: 1.01 must be from -0.2 to 0.2, the lower end first",
        ),
        (
            "position_noise_m = 0.01",
            "position_noise_m = -0.01",
            "sensors.position_noise_m = -0.01: input should be greater than or equal to 0",
        ),
        (
            "[sensors]",
            "[sensor]",
            "sensor: unknown key; known here: name, description, course, vehicle_overlay, plant, sensors, start, "
            "faults",
        ),
        (
            "[sensors]",
            "[vehicle_overlay]\nsteering_lag_s = 5.0\n[sensors]",
            "vehicle_overlay.steering_lag_s = 5.0: must be from 0 to 2 s",
        ),
        ("[sensors]", "[vehicle_overlay]\nlag = 5.0\n[sensors]", "vehicle_overlay.lag: unknown key; a vehicle has "),
        (
            "[sensors]",
            "[plant.unknown]\nsteering_lag_s = [0.2, 0.1]\n[sensors]",
            "plant.unknown.steering_lag_s = [0.2, 0.1]: the lower end comes first",
        ),
        (
            "[sensors]",
            "[plant.unknown]\nsteering_lag_s = [0.1, 9.0]\n[sensors]",
            "plant.unknown.steering_lag_s = 9.0: must be from 0 to 2 s",
        ),
        (
            "[sensors]",
            "[start]\naside_m = 100\n[sensors]",
            "start.aside_m: 100.0 must be from -20 to 20, the lower end first",
        ),
        (
            "[sensors]",
            '[[faults]]\nkind = "earthquake"\nat_s = 1.0\n[sensors]',
            "faults[1].kind = 'earthquake': input should be 'stop_message', 'freeze_counter', 'corrupt_crc', "
            "'delay_message', 'stick_signal', 'offset_signal', 'driver_override', 'emergency_stop' or "
            "'steering_frozen'",
        ),
        ("[sensors]", '[[faults]]\nkind = "emergency_stop"\n[sensors]', "faults[1].at_s: missing"),
        (
            "[sensors]",
            '[[faults]]\nkind = "emergency_stop"\nat_s = -1.0\n[sensors]',
            "faults[1].at_s = -1.0: input should be greater than or equal to 0",
        ),
        (
            "[sensors]",
            '[[faults]]\nkind = "stop_message"\nat_s = 1.0\n[sensors]',
            "faults[1]: stop_message needs the key message",
        ),
        (
            "[sensors]",
            '[[faults]]\nkind = "stop_message"\nat_s = 1.0\nmessage = "VEH_Rpt"\n[sensors]',
            "faults[1]: message 'VEH_Rpt' is not known; stop_message takes VEH_SysRpt, VEH_SteerRpt, "
            "VEH_MotionRpt, VEH_LongRpt, VEH_Version, LOC_Position, LOC_Attitude, CTRL_SysCmd, CTRL_SteerCmd, "
            "CTRL_LongCmd, CTRL_Version, OPER_Cmd",
        ),
        (
            "[sensors]",
            '[[faults]]\nkind = "emergency_stop"\nat_s = 1.0\ndelay_s = 0.1\n[sensors]',
            "faults[1]: emergency_stop has no key delay_s",
        ),
    ],
)
def test_mistakes_in_a_scenario_file(old: str, new: str, message: str, tmp_path: Path) -> None:
    line = mistake("scenario", CAR, old, new, tmp_path)
    assert line == message or (message.endswith("has ") and line.startswith(message))


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


# ----------------------------------------------------------------------------------------------- whatever is written


ODD_VALUES = (
    '"text"',
    '""',
    "true",
    "-1",
    "0",
    "1e400",
    "-1e300",
    "nan",
    "inf",
    "9" * 400,
    "[]",
    "[1, 2]",
    "[[1], {}]",
    "{}",
    "{ a = 1 }",
    "2026-01-01",
    '"""a\nb"""',
    "[" + "1, " * 500 + "]",
    '1\n"a\\nb" = 2',
)


def complaint(kind: str, path: Path) -> str:
    """What the loader says of a file, nothing if it takes it; anything but a UserError passes through."""
    try:
        LOADERS[kind](path)
    except UserError as error:
        return str(error)
    return ""


@pytest.mark.parametrize("kind", LOADERS)
def test_an_odd_value_anywhere_is_one_line_or_accepted(kind: str, tmp_path: Path) -> None:
    """Every value of a shipped file becomes a third of the odd ones in turn; every line is left out, doubled, cut."""
    lines = {"vehicle": PAPER, "course": OHIO, "scenario": CAR}[kind].read_text().splitlines()
    path = tmp_path / "odd.toml"
    refused = 0
    for number, line in enumerate(lines):
        key, separator, value = line.partition(" = ")
        texts = (
            [f"{key} = {odd}" for odd in ODD_VALUES[number % 3 :: 3]] if separator and not line.startswith("#") else []
        )
        if value.startswith("{"):
            texts = [
                line.replace(part, f"{part.partition('=')[0]}= {ODD_VALUES[number % len(ODD_VALUES)]}")
                for part in value.strip("{} ").split(", ")[:4]
            ]
        for changed in [*texts, "", f"{line}\n{line}", line[: len(line) // 2]]:
            path.write_text("\n".join([*lines[:number], changed, *lines[number + 1 :]]))
            text = complaint(kind, path)
            refused += bool(text)
            assert "\n" not in text
            assert not text or text.startswith(f"{path}: ")
            assert len(text) < 1000
    assert refused > len(lines)


def test_deep_nesting_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "deep.toml"
    path.write_text("a = " + "[" * 100_000)
    with pytest.raises(UserError) as error:
        load_scenario(path)
    assert one_line(error) == f"{path}: not valid TOML: nested too deeply"


def test_the_guide_to_scenario_files_names_every_key_and_no_other() -> None:
    guide = (FOLDERS["scenario"] / "README.md").read_text()
    named = set(re.findall(r"^\| `([a-z0-9_-]+)` \|", guide, re.MULTILINE))
    tables = (PlantDeviation, Sensors, StartOffset, FaultEvent)
    keys = {key for table in tables for key in table.model_fields} | {"vehicle_overlay", "course"}
    assert named == keys | set(get_args(FaultKind)) | set(shipped_names("scenario"))


def test_the_guides_example_loads(tmp_path: Path) -> None:
    guide = (FOLDERS["scenario"] / "README.md").read_text()
    path = tmp_path / "mine.toml"
    path.write_text(guide.partition("```toml\n")[2].partition("```")[0])
    scenario = load_scenario(path)
    assert scenario.faults
    assert scenario.vehicle_overlay
    assert scenario.plant.unknown
