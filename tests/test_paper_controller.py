"""The paper's laws in the real controller: eq. 11 as the emulator's plant, Tables 5 and 6, one sample more.

Bounds come from what is known beforehand: the continuous study's figures, the paper's claim (40 times), and a delay
margin of PID + DOB (7 to 18 ms, by `parkctl paper`) that one sample of 10 ms exceeds.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm

from firmware_py.codec import load_codec
from firmware_py.core import paper_law
from firmware_py.core.controller import PERIOD_S
from firmware_py.core.tables import Tables
from firmware_py.node import build_tables
from firmware_py.table_file import load_tables
from sim import vehicle as plant_model
from sim.data_files import load_scenario, load_vehicle
from sim.vehicle import EQ11, PlantParameters, PlantState, plant_parameters, state_at_rest, step
from tools import cli
from tools.compiled import compile_modules
from tools.lockstep import DBC
from tools.paper import fit, in_lockstep, page_live
from tools.paper.firmware_law import NAMES, UNBOUNDED
from tools.paper.firmware_tables import SCENARIO, study_folder, study_pair
from tools.paper.in_lockstep import BUS, CAR, LATE, LegRow, Manoeuvre, Runs
from tools.paper.laws import Law
from tools.paper.path_study import AS_PRINTED, all_variants
from tools.paper.plant import CORRECTED, FORWARD, PRINTED, REVERSE, TABLE_4, PaperCar, Plant, matrices
from tools.paper.simulate import Figures, Steps, figures_of, simulate
from tools.paper.speed import TABLE_3, motion
from tools.paper.track import track_of

UNEVEN = PaperCar("uneven", 2.4e5, 1.7, 3.1e5, 2.3, 2800.0, 4700.0)
"""Neither axle like the other, so that a mix-up shows."""


def parameters(car: PaperCar, reverse_moment: float = 1.0) -> PlantParameters:
    return plant_parameters(
        car.mass_kg, car.inertia_kgm2, car.wheelbase_m, car.rear_m, car.front_stiffness, car.rear_stiffness, 0.8, 0.4,
        EQ11, reverse_moment,
    )  # fmt: skip


# -------------------------------------------------------------------------------------------------------------- plant


@pytest.mark.parametrize(("direction", "sign"), [(FORWARD, PRINTED), (REVERSE, CORRECTED), (REVERSE, PRINTED)])
@pytest.mark.parametrize("speed_mps", [0.15, 1.0])
def test_the_emulators_plant_is_equation_11(direction: str, sign: str, speed_mps: float) -> None:
    """Side slip and yaw rate after a step of steering, against the matrix exponential of eq. 11 as the study has it."""
    p = parameters(UNEVEN, -1.0 if sign == PRINTED else 1.0)
    a, b, _, _ = matrices(Plant(UNEVEN, direction, sign), speed_mps)
    whole = np.zeros((3, 3))
    whole[:2, :2], whole[:2, 2] = a[:2, :2], b[:2]
    way = 1.0 if direction == FORWARD else -1.0
    h = 2e-6
    for seconds in (0.002, 0.02):
        state = PlantState(0.0, 0.0, 0.0, way * speed_mps, 0.0, 0.0, 0.0, 0.0, 0.0)
        for _ in range(round(seconds / h)):
            state = step(p, state, way * speed_mps, 0.1, h)
        beta, yaw_rate = 0.1 * expm(whole * seconds)[:2, 2]
        # In travel as in the body: side slip is velocity aside over velocity ahead, both turn sign in reverse.
        assert state.lateral_velocity_mps / state.speed_mps == pytest.approx(beta, rel=5e-3, abs=1e-6)
        assert state.yaw_rate_radps == pytest.approx(yaw_rate, rel=5e-3)


def test_steps_of_a_millisecond_end_in_the_same_turn() -> None:
    """Poles to -4700 rad/s: the implicit step has no trouble with them, and the steady turn is the exact one."""
    for speed in (0.1, 1.0):
        a, b, _, _ = matrices(Plant(UNEVEN), speed)
        beta, yaw_rate = np.linalg.solve(-a[:2, :2], 0.2 * b[:2])
        state = PlantState(0.0, 0.0, 0.0, speed, 0.0, 0.0, 0.0, 0.0, 0.0)
        for _ in range(1000):
            state = step(parameters(UNEVEN), state, speed, 0.2, 1e-3)
        assert state.lateral_velocity_mps / speed == pytest.approx(beta, rel=1e-9)
        assert state.yaw_rate_radps == pytest.approx(yaw_rate, rel=1e-9)
        assert state.lateral_accel_mps2 == pytest.approx(speed * yaw_rate, rel=1e-9)


def test_the_pose_is_exact_and_a_car_that_stands_does_not_move() -> None:
    """Ten seconds of a steady turn: the centre of gravity goes round a circle of speed over yaw rate."""
    p = parameters(TABLE_4)
    state = state_at_rest(p, 0.0, 0.0, 0.3)
    for _ in range(50):
        state = step(p, state, 0.0, 0.4, 1e-3)
    assert state == state_at_rest(p, 0.0, 0.0, 0.3)
    for _ in range(1000):
        state = step(p, state, 1.0, 0.4, 1e-3)
    first = state
    for _ in range(10_000):
        state = step(p, state, 1.0, 0.4, 1e-3)
    turned = state.yaw_rad - first.yaw_rad
    radius = math.hypot(1.0, first.lateral_velocity_mps) / first.yaw_rate_radps
    assert math.hypot(state.x_m - first.x_m, state.y_m - first.y_m) == pytest.approx(
        2.0 * radius * abs(math.sin(0.5 * turned)), rel=1e-6
    )
    for speed in (0.05, 0.0):
        state = step(p, state, speed, 0.4, 1e-3)
    state = step(p, state, 0.0, 0.4, 1e-3)
    assert (state.lateral_velocity_mps, state.yaw_rate_radps) == (0.0, 0.0)


def test_compiled_and_plain_plant_agree_bit_for_bit() -> None:
    fast = compile_modules("sim.tyre", "sim.vehicle")["sim.vehicle"].step
    for moment in (1.0, -1.0):
        p = parameters(UNEVEN, moment)
        plain = quick = state_at_rest(p, 0.0, 0.0, 0.1)
        for k in range(2000):
            speed, angle = math.sin(2e-3 * k), 0.5 * math.sin(7e-3 * k)
            plain, quick = step(p, plain, speed, angle, 1e-3), fast(p, quick, speed, angle, 1e-3)
            assert tuple(plain) == tuple(quick)
    assert TABLE_3.min_speed_mps == plant_model.LEAST_SPEED_MPS


# ------------------------------------------------------------------------------------------------- Tables 5 and 6


@pytest.fixture(scope="module")
def setting() -> Manoeuvre:
    path = all_variants(fit.load_fit().waypoints)[AS_PRINTED].path
    vehicle, course = study_pair()
    tracks = {direction: track_of(path, direction) for direction in (FORWARD, REVERSE)}
    return Manoeuvre(vehicle, course, load_scenario(SCENARIO), study_folder(), tracks)


@pytest.fixture(scope="module")
def runs(setting: Manoeuvre) -> list[in_lockstep.LegRun]:
    cases = (
        ("dob", PRINTED, BUS), ("pid", PRINTED, BUS), ("paper", PRINTED, BUS), ("paper", PRINTED, LATE),
        ("pid", PRINTED, LATE), ("paper", CORRECTED, BUS), (CAR, CORRECTED, BUS), (CAR, CORRECTED, LATE),
    )  # fmt: skip
    return [run for case in cases for run in in_lockstep.drive(setting, *case)]


@pytest.fixture(scope="module")
def with_part(setting: Manoeuvre) -> list[in_lockstep.LegRun]:
    """Forward with the first and the last of the real parts."""
    parts = list(in_lockstep.real_parts(load_vehicle("paper")).items())
    return [
        leg
        for part, changes in (parts[0], parts[-1])
        for law in ("pid", "paper")
        for leg in in_lockstep.drive(setting, law, CORRECTED, BUS, part=part, changes=changes)
    ]


@pytest.fixture(scope="module")
def continuous(setting: Manoeuvre) -> dict[tuple[str, str], Figures]:
    found = {}
    for direction, track in setting.tracks.items():
        plan = motion(track.station_m, track.curvature_1pm, TABLE_3, 2e-3)
        for name, law in NAMES.items():
            steps = Steps(Plant(TABLE_4, direction), Law(law, fit.load_fit().gains), 2e-3)
            found[(name, direction)] = figures_of(simulate(steps, track, plan))
    return found


def row(runs: list[in_lockstep.LegRun], law: str, sign: str, delay: in_lockstep.Delay, direction: str) -> LegRow:
    leg = in_lockstep.find(runs, law, sign, delay, direction)
    assert leg is not None
    return leg.row


@pytest.mark.parametrize("direction", [FORWARD, REVERSE])
@pytest.mark.parametrize("law", NAMES)
def test_what_is_left_of_tables_5_and_6(
    runs: list[in_lockstep.LegRun], continuous: dict[tuple[str, str], Figures], law: str, direction: str
) -> None:
    """By the size of the continuous study's cells: sampled and 3.5 ms late nothing is better, and not twice as bad."""
    ours, exact = row(runs, law, PRINTED, BUS, direction), continuous[(law, direction)]
    assert ours.is_complete
    assert 0.9 < ours.max_e_y_after_start_m / exact.max_e_y_m < 2.0
    assert 0.9 < ours.rms_e_y_m / exact.rms_e_y_m < 2.0
    assert ours.max_steer_rad == pytest.approx(exact.max_steer_rad, rel=0.1)
    assert ours.max_cross_track_m == pytest.approx(exact.max_cross_track_m, rel=0.15)


@pytest.mark.parametrize("direction", [FORWARD, REVERSE])
def test_both_beat_either_alone_by_40_times_and_one_sample_ends_that(
    runs: list[in_lockstep.LegRun], direction: str
) -> None:
    together = row(runs, "paper", PRINTED, BUS, direction)
    alone = [row(runs, law, PRINTED, BUS, direction) for law in ("dob", "pid")]
    assert min(a.max_e_y_after_start_m for a in alone) > 40.0 * together.max_e_y_after_start_m
    late, pid_late = (row(runs, law, PRINTED, LATE, direction) for law in ("paper", "pid"))
    assert late.rms_e_y_m > 40.0 * together.rms_e_y_m
    assert late.rms_e_y_m > pid_late.rms_e_y_m
    assert late.max_steer_rate_cmd_after_start_radps > 9.0  # at the limit of 10 rad/s
    assert pid_late.rms_e_y_m == pytest.approx(row(runs, "pid", PRINTED, BUS, direction).rms_e_y_m, rel=0.01)


def test_the_late_loop_swings(runs: list[in_lockstep.LegRun]) -> None:
    """A loop driven out of its delay margin does not drift off: e_y goes through zero again and again."""
    leg = in_lockstep.find(runs, "paper", PRINTED, LATE, FORWARD)
    assert leg is not None
    large = leg.e_y_m[np.abs(leg.e_y_m) > 1e-3]
    assert np.count_nonzero(np.diff(np.sign(large))) > 50


def test_the_true_sign_ends_it_in_reverse_and_the_law_for_the_rear_axle_drives_it(
    runs: list[in_lockstep.LegRun],
) -> None:
    diverged = row(runs, "paper", CORRECTED, BUS, REVERSE)
    assert not diverged.is_complete
    assert "off the path" in in_lockstep.reason_text(diverged)
    assert diverged.travelled_m < 6.0  # the continuous study: 5.6 m until the room between the cones is used up
    assert row(runs, "paper", CORRECTED, BUS, FORWARD).max_e_y_m == row(runs, "paper", PRINTED, BUS, FORWARD).max_e_y_m
    for delay in (BUS, LATE):
        for direction in (FORWARD, REVERSE):
            ours = row(runs, CAR, CORRECTED, delay, direction)
            assert ours.is_complete
            assert ours.max_rear_cross_track_m <= 1e-3


def test_what_a_car_has_beside_equation_11_is_too_much_for_the_observer_not_for_the_pid(
    runs: list[in_lockstep.LegRun], with_part: list[in_lockstep.LegRun]
) -> None:
    """A bandwidth of 100 rad/s beside 20 ms of lag, and beside tyres that relax over 0.4 m, 0.4 s at 1 m/s."""
    assert [(leg.row.law, leg.row.part.split()[0]) for leg in with_part] == [
        ("pid", "a"), ("paper", "a"), ("pid", "its"), ("paper", "its")
    ]  # fmt: skip
    for pid, together in (with_part[:2], with_part[2:]):
        alone = row(runs, "pid", PRINTED, BUS, FORWARD)
        assert pid.row.rms_e_y_m == pytest.approx(alone.rms_e_y_m, rel=0.1)
        assert together.row.rms_e_y_m > 40.0 * row(runs, "paper", PRINTED, BUS, FORWARD).rms_e_y_m


def test_the_section_of_the_page_holds_them(
    runs: list[in_lockstep.LegRun],
    with_part: list[in_lockstep.LegRun],
    continuous: dict[tuple[str, str], Figures],
) -> None:
    class Result:
        def __init__(self, figures: Figures) -> None:
            self.figures = figures

    class Study:
        lockstep = Runs(runs, with_part)
        results = {  # noqa: RUF012
            table: {law: Result(continuous[(name, direction)]) for name, law in NAMES.items()}
            for table, direction in (("table5", FORWARD), ("table6", REVERSE))
        }

    text = page_live.controller(Study(), lambda name, _caption: f'<figure id="{name}">')  # type: ignore[arg-type]
    assert 'id="in_controller"' in text
    assert "PID+DOB, reverse" in text
    assert "stopped after" in text
    assert "nan" not in text
    together = row(runs, "paper", PRINTED, BUS, REVERSE)
    assert f"{1e3 * together.max_e_y_m:.3g} / {1e3 * together.rms_e_y_m:.3g}" in text


# --------------------------------------------------------------------------------------------------------- controller


@pytest.fixture(scope="module")
def tables() -> Tables:
    return build_tables(load_tables(study_folder(), "right", "paper", PERIOD_S), load_codec(DBC))


def steered(tables: Tables, state: paper_law.PaperState, direction: int, station_m: float, aside_m: float) -> float:
    """Angle for a car on the path but for `aside_m` to the body's left of the centre's path, at 0.5 m/s."""
    leg, reference = tables.leg[direction], tables.reference
    at = round(station_m / leg.step_m)
    yaw = leg.yaw_rad[at]
    path_yaw = reference.yaw_rad[direction][at]
    x = reference.x_m[direction][at] - aside_m * math.sin(path_yaw) - reference.ahead_m * math.cos(yaw)
    y = reference.y_m[direction][at] + aside_m * math.cos(path_yaw) - reference.ahead_m * math.sin(yaw)
    after, angle = paper_law.steer(
        tables.paper, reference, leg, UNBOUNDED, state, direction, 0.5, station_m + 0.04, x, y, yaw, 0.0, 0.0
    )
    assert after.cross_track_error_m == pytest.approx(aside_m, abs=2e-6)
    assert abs(after.heading_error_rad) < 1e-9
    return angle


@pytest.mark.parametrize("direction", [0, 1])
def test_it_steers_back_to_the_path_in_travel(tables: Tables, direction: int) -> None:
    """Left of the path in travel the wheels go to the right; in reverse the left of travel is the body's right."""
    begin = paper_law.begin()
    at = 2.0  # straight: what is left is the answer to the error
    left_of_travel = 0.001 if direction == 0 else -0.001
    on_path = steered(tables, begin, direction, at, 0.0)
    assert steered(tables, begin, direction, at, left_of_travel) < on_path
    assert steered(tables, begin, direction, at, -left_of_travel) > on_path


def test_at_standstill_it_keeps_the_wheels_and_forgets(tables: Tables) -> None:
    state = paper_law.PaperState(paper_law.clear()._replace(integral_ms=1.0, has_last=1), 0.1, 0.1)
    after, angle = paper_law.steer(
        tables.paper, tables.reference, tables.leg[0], tables.car, state, 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.12, 0.3
    )
    assert (after, angle) == (paper_law.begin(), 0.12)


def test_a_body_that_stands_across_is_off_the_path(tables: Tables) -> None:
    """Beyond the side slip that the path itself asks for, either way; so the car is stopped."""
    leg, reference = tables.leg[1], tables.reference
    at = max(range(len(leg.yaw_rad)), key=lambda i: abs(reference.yaw_rad[1][i] - leg.yaw_rad[i]))
    slip = reference.yaw_rad[1][at] - leg.yaw_rad[at]
    assert abs(slip) > 0.2
    for turned, expected in ((-slip, 0.0), (slip, 0.0), (abs(slip) + 0.3, 0.3), (-abs(slip) - 0.3, -0.3)):
        yaw = reference.yaw_rad[1][at] + turned
        x = reference.x_m[1][at] - reference.ahead_m * math.cos(yaw)
        y = reference.y_m[1][at] - reference.ahead_m * math.sin(yaw)
        after, _ = paper_law.steer(
            tables.paper, reference, leg, tables.car, paper_law.begin(), 1, 0.5, at * leg.step_m, x, y, yaw, 0.0, 0.0
        )
        assert after.heading_error_rad == pytest.approx(expected, abs=1e-6)


# --------------------------------------------------------------------------------------------------------------- demo


def test_the_demo_drives_it_and_the_card_says_that_the_point_cone_was_touched(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    arguments = ["demo", "--law", "paper", "--scenario", "paper", "--lockstep", "--no-plots", "--out", str(out)]
    assert cli.main(arguments) == 1
    shown = capsys.readouterr()
    assert "cone point: test failed" in shown.out
    assert "made now" not in shown.out  # its tables are shipped
    assert shown.err.count("\n") == 1
    figures = json.loads((out / "figures.json").read_text())
    assert (figures["law"], figures["course"]) == ("paper", "paper")
    assert json.loads((out / "exam.json").read_text())["cones_touched"] == ["point"]
    forward, reverse = figures["legs"]
    assert forward["max_cross_track_m"] < 0.1 < reverse["max_cross_track_m"]
