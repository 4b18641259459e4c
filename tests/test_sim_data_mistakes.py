"""Mistakes in vehicle, course and scenario files: each gives its one line, whatever is written."""

from __future__ import annotations

import re
from pathlib import Path
from typing import get_args

import pytest
from data_file_support import CAR, LOADERS, OHIO, PAPER, one_line

from sim.data_files import (
    FOLDERS,
    PARAMETERS,
    PlantDeviation,
    Sensors,
    StartOffset,
    find_file,
    load_scenario,
    load_vehicle,
    shipped_names,
)
from sim.errors import UserError
from sim.faults import FaultEvent, FaultKind

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
