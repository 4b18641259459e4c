"""The trade curve, its clearest end against an independent search, the sheet, and cars that cannot pass."""

import json

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sim.body import clearance_m, outline_of
from sim.data_files import load_course, load_vehicle
from sim.errors import UserError
from tools import cli
from tools.design import finer, optimise, refusal, tables, trade
from tools.design.certificate import Certificate
from tools.design.gains import MODES
from tools.design.optimise import CHOSEN, MOST_CLEARANCE, Weights, make_path, optimise_path
from tools.design.speed_profile import plan_speed
from tools.design.tables import SHIPPED_FOLDER, recorded_numbers, speed_limits

OHIO = load_course("ohio")
PAPER = load_vehicle("paper")
PNG = b"\x89PNG\r\n\x1a\n"


def shipped(name):
    numbers = recorded_numbers(SHIPPED_FOLDER / f"{name}-ohio")
    return make_path(load_vehicle(name), OHIO, numbers)


@pytest.mark.parametrize(
    ("name", "least_m", "least_body_m"),
    [("paper", 0.32, 0.32), ("fusion", 0.31, 0.42), ("compact", 0.35, 0.46), ("pickup", 0.30, 0.30)],
)
def test_the_shipped_paths_have_room(name, least_m, least_body_m):
    design = shipped(name)
    assert design.clearance_m >= least_m
    assert design.body_clearance_m >= least_body_m
    vehicle = load_vehicle(name)
    assert design.max_road_wheel_angle_rad <= (CHOSEN.angle_share + 0.002) * vehicle.max_road_wheel_angle_rad


# ---------------------------------------------------------------------------------------- the independent search


def test_an_independent_finer_search_finds_at_most_a_centimetre_more(monkeypatch):
    """Without mirrors, whose clearance no path can better: it is that of standing in the box.

    With fewer starts and rounds than `parkctl design --trade DIR --finer 50`, for time.
    """
    monkeypatch.setattr(optimise, "TRIAL_ROUNDS", 0)
    monkeypatch.setattr(optimise, "FINAL_ROUNDS", 80)
    for vehicle, starts in ((PAPER, 3), (load_vehicle("fusion").with_overlay({"mirror_width_m": 1.85}), 2)):
        angle_rad = MOST_CLEARANCE.angle_share * vehicle.max_road_wheel_angle_rad
        independent = finer.clearest(vehicle, OHIO, angle_rad, starts=starts)
        near = shipped("paper" if vehicle is PAPER else "fusion").numbers
        ours = optimise_path(vehicle, OHIO, weights=MOST_CLEARANCE, near=(near,))
        assert independent.clearance_m <= ours.clearance_m + 0.01
        assert independent.clearance_m >= ours.clearance_m - 0.01, "the search that checks is itself a good one"


def test_the_independent_search_measures_as_the_plant_does():
    rng = np.random.default_rng(4)
    for name in ("paper", "fusion"):
        vehicle = load_vehicle(name)
        x, y, yaw = rng.uniform(-3, 12, 60), rng.uniform(-2, 3, 60), rng.uniform(-0.6, 0.6, 60)
        own = finer._distances(finer._rectangles(vehicle, True), x, y, yaw, np.array(OHIO.cones_xy()))
        outline = outline_of(vehicle)
        theirs = [clearance_m(outline, *pose, OHIO.cones_xy())[0] for pose in zip(x, y, yaw, strict=True)]
        assert own == pytest.approx(theirs, abs=1e-9)


# ------------------------------------------------------------------------------------------------- the curve itself


@pytest.fixture
def short(monkeypatch):
    """A curve of three paths with little search: what it says is checked, not how far it gets."""
    monkeypatch.setattr(trade, "SWEEP", (MOST_CLEARANCE, CHOSEN, Weights(0.8, 0.1)))
    for name, few in (("SCREENED", 8), ("STARTS", 1), ("TURN_ROUNDS", 6), ("TRIAL_ROUNDS", 4), ("FINAL_ROUNDS", 20)):
        monkeypatch.setattr(optimise, name, few)


@pytest.mark.usefixtures("short")
def test_the_command_draws_the_curve_and_marks_the_choice(tmp_path, capsys):
    arguments = ["design", "--trade", str(tmp_path / "curve"), "--seeds", "0", "--finer", "1"]
    assert cli.main(arguments) == 0
    assert (tmp_path / "curve" / "trade.png").read_bytes().startswith(PNG)
    found = json.loads((tmp_path / "curve" / "trade.json").read_text())
    points = found["points"]
    assert [point["chosen"] for point in points] == [False, True, False]
    assert points[0]["min_clearance_m"] > points[1]["min_clearance_m"] > points[2]["min_clearance_m"]
    assert points[0]["max_road_wheel_angle_rad"] > points[1]["max_road_wheel_angle_rad"]
    assert found["tracking"] is None
    assert abs(found["finer"]["more_than_the_curve_m"]) < 0.02
    for point in points:
        design = make_path(PAPER, OHIO, tuple(point["path_numbers"]))
        assert design.clearance_m == pytest.approx(point["min_clearance_m"])
        assert point["leg_duration_s"] == pytest.approx(
            plan_speed(design.path, PAPER.wheelbase_m, speed_limits(PAPER), 1).duration_s
        )
        assert point["max_road_wheel_rate_radps"] <= speed_limits(PAPER).road_wheel_rate_radps * 1.001
    assert "the path that the tables take" in capsys.readouterr().out


def test_tracking_of_a_point_is_that_of_lock_step_runs():
    report = tables.run_design(PAPER, OHIO, recorded_numbers(SHIPPED_FOLDER / "paper-ohio"))
    told = []
    tracking = trade._track(report, (0,), told.append)
    assert tracking.completed == tracking.runs == len(told) == 1
    assert 0.0002 < tracking.rms_cross_track_m < tracking.max_cross_track_m < 0.006
    assert report.design.clearance_m - 0.01 < tracking.min_clearance_m < report.design.clearance_m + 0.002


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--trade", "x", "--seeds", "-1"], "--seeds -1: must be from 0"),
        (["--trade", "x", "--finer", "1001"], "--finer 1001: must be from 0 to 1000"),
        (["--trade", "FILE/x", "--seeds", "0"], "no folder can be made there"),
        (["--check", "--out", "x"], "leave out --out"),
    ],
)
def test_a_mistake_is_one_line(arguments, says, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "FILE").write_text("in the way")
    assert cli.main(["design", *arguments]) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1


def test_the_sheet_is_drawn(tmp_path):
    from tools.design import sheet  # noqa: PLC0415 -- matplotlib

    report = tables.run_design(PAPER, OHIO, recorded_numbers(SHIPPED_FOLDER / "paper-ohio"))
    by_speed = [(sign, speed, 1.0 - 0.4 * speed, 20.0 / speed) for speed in (0.1, 0.5, 1.0) for sign in (1.0, -1.0)]
    bends = {
        name: {"min_disk_margin": 0.52, "min_delay_margin_samples": 11.0}
        for name, mode in MODES["car"].items()
        if mode.in_bend
    }
    certificate = Certificate(20.0, 0.6, 3.0, 0.5, True, True, [], "lag 0.2 s, 1 m/s", bends, by_speed)
    assert [entry["disk"] for entry in sheet.margins_over_speed(certificate)] == [pytest.approx([0.96, 0.8, 0.6])] * 2
    sheet.draw(report, certificate, tmp_path / "design.png")
    assert (tmp_path / "design.png").read_bytes().startswith(PNG)
    assert len(list(tmp_path.iterdir())) == 1


# ------------------------------------------------------------------------------------------------- cars that cannot


@pytest.fixture
def impatient(monkeypatch):
    """Less search: a car that passes with room to spare, or cannot at all, is told so all the same."""
    for name, few in (("SCREENED", 8), ("STARTS", 1), ("TURN_ROUNDS", 5), ("TRIAL_ROUNDS", 3), ("FINAL_ROUNDS", 12)):
        monkeypatch.setattr(optimise, name, few)
    monkeypatch.setattr(refusal, "CHANGES", (0.25, 0.55))


def why_not(vehicle):
    """Return why a car cannot do the course, None where it can."""
    try:
        design = optimise_path(vehicle, OHIO)
        profiles = [plan_speed(design.path, vehicle.wheelbase_m, speed_limits(vehicle), sign) for sign in (1, -1)]
    except UserError as error:
        return str(error)
    assert design.clearance_m >= OHIO.cone_radius_m
    assert design.max_road_wheel_angle_rad <= vehicle.max_road_wheel_angle_rad
    assert all(np.all(np.isfinite(profile.speed_mps)) for profile in profiles)
    return None


BUS = {"wheelbase_m": 7.5, "front_overhang_m": 2.5, "rear_overhang_m": 3.0, "cg_to_rear_axle_m": 3.5}


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize(
    ("overlay", "says"),
    [
        (BUS, "wheelbase_m + front_overhang_m + rear_overhang_m = 13"),
        ({"body_width_m": 2.6, "mirror_width_m": 2.6}, "body_width_m = 2.600 prevents it"),
        ({"max_road_wheel_angle_rad": 0.15}, "max_road_wheel_angle_rad = 0.150"),
        ({"max_road_wheel_rate_radps": 0.02}, "max_road_wheel_rate_radps"),
    ],
    ids=["too long", "too wide", "too small an angle", "too slow a rack"],
)
def test_a_bus_is_told_which_dimension_prevents_it(overlay, says):
    told = why_not(PAPER.with_overlay(overlay))
    assert told is not None
    assert says in told
    assert "\n" not in told


@pytest.mark.usefixtures("impatient")
@settings(max_examples=4, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(
    wheelbase_m=st.floats(1.8, 6.0),
    front_overhang_m=st.floats(0.4, 1.5),
    rear_overhang_m=st.floats(0.3, 2.0),
    body_width_m=st.floats(1.3, 2.55),
    mirrors_m=st.floats(0.0, 0.4),
    angle_rad=st.floats(0.2, 0.8),
    rate_radps=st.floats(0.05, 1.5),
)
def test_any_plausible_car_passes_or_is_told_why(
    wheelbase_m, front_overhang_m, rear_overhang_m, body_width_m, mirrors_m, angle_rad, rate_radps
):
    overlay = {
        "wheelbase_m": wheelbase_m,
        "cg_to_rear_axle_m": 0.5 * wheelbase_m,
        "front_overhang_m": front_overhang_m,
        "rear_overhang_m": rear_overhang_m,
        "body_width_m": body_width_m,
        "mirror_width_m": body_width_m + mirrors_m,
        "mirror_from_rear_axle_m": 0.75 * wheelbase_m,
        "max_road_wheel_angle_rad": angle_rad,
        "max_road_wheel_rate_radps": rate_radps,
    }
    told = why_not(PAPER.with_overlay(overlay))
    if told is not None:
        assert "\n" not in told
        assert any(name in told for name in overlay), told
