"""Lock-step through real frames, the campaign's loop in plain Python, and compiled: the same bits, tick by tick."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from campaign_support import TABLES, compiled_runner, shared

from firmware_py.core import controller
from sim.data_files import Scenario, load_course, load_scenario, load_vehicle
from sim.examiner import LEGS, MIN_CLEARANCE_M, TOUCHED
from sim.sensors import NoiseRows, first_state
from tools.campaign import manoeuvre, tick
from tools.campaign import world as plant_world
from tools.campaign.draws import draw
from tools.campaign.single import Outcome, Runner
from tools.campaign.tick import Command
from tools.figures import leg_figures, load_path, split_legs, truth_of_rows
from tools.lockstep import LockstepRun, run_lockstep

ROWS = 9000


def rough() -> Scenario:
    """`car` with what it lacks: poses that are not sent, correlated noise, noisy odometry, odd latencies."""
    car = load_scenario("car")
    sensors = {"pose_drop_probability": 0.05, "pose_noise_correlation_s": 0.5, "speed_noise_mps": 0.002}
    return car.model_copy(
        update={
            "sensors": car.sensors.model_copy(update=sensors),
            "plant": car.plant.model_copy(
                update={"unknown": {"pose_latency_samples": (1.37, 1.37), "command_latency_samples": (0.0, 0.0)}}
            ),
        }
    )


CASES = {
    "car-left": (lambda: load_scenario("car"), "left", 3),
    "drawn-right": (lambda: draw(load_vehicle("paper"), load_scenario("car"), 77).scenario, "right", 77),
    "rough-right": (rough, "right", 8),
}


@pytest.fixture(scope="module", params=CASES)
def case(request: pytest.FixtureRequest) -> tuple[Scenario, Any, int]:
    make, side, seed = CASES[request.param]
    return make(), side, seed


@pytest.fixture(scope="module")
def plain(case: tuple[Scenario, Any, int]) -> Outcome:
    return Runner(shared(), compiled=False).run(*case, trace_rows=ROWS)


@pytest.fixture(scope="module")
def by_frames(case: tuple[Scenario, Any, int]) -> tuple[LockstepRun, list[Any]]:
    scenario, side, seed = case
    inputs: list[Any] = []
    step = controller.step

    def recording(tables: Any, state: Any, seen: Any) -> Any:
        inputs.append(seen)
        return step(tables, state, seen)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(controller, "step", recording)
        run = run_lockstep(load_vehicle("paper"), load_course("ohio"), scenario, side, seed, "car", TABLES)
    return run, inputs


def test_the_plain_loop_is_lock_step_without_the_bytes(
    case: tuple[Scenario, Any, int], plain: Outcome, by_frames: tuple[LockstepRun, list[Any]]
) -> None:
    run, heard = by_frames
    cycles = int(plain.end[manoeuvre.CYCLES])
    assert cycles == run.controller["cycles"] == len(run.truth) > 1000
    for tick_number, row in enumerate(run.truth):
        assert tuple(plain.trace[tick_number]) == tuple(map(float, row)), f"tick {tick_number}"
    assert plain.end[manoeuvre.REASON] == run.controller["reason"]
    assert plain.end[manoeuvre.COMPLETED] == run.controller["completed"]
    assert plain.notes.value[MIN_CLEARANCE_M] == run.exam.min_clearance_m
    assert plain.notes.number[TOUCHED].bit_count() == len(run.exam.cones_touched)
    assert plain.notes.number[LEGS] == len(run.exam.legs)

    inputs: list[Any] = []
    step = controller.step
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(controller, "step", lambda *given: (inputs.append(given[2]), step(*given))[1])
        Runner(shared(), compiled=False).run(*case)
    assert len(inputs) == len(heard)
    for cycle, (here, there) in enumerate(zip(inputs, heard, strict=True)):
        assert here == there, f"inputs of cycle {cycle}"


def test_the_compiled_loop_has_the_bits_of_the_plain_one(case: tuple[Scenario, Any, int], plain: Outcome) -> None:
    compiled = compiled_runner().run(*case, trace_rows=ROWS)
    different = np.flatnonzero((compiled.trace != plain.trace).any(axis=1))
    assert not len(different), f"first in tick {different[0]}"
    assert compiled.end == plain.end
    assert compiled.error == plain.error
    assert compiled.notes == plain.notes


def test_the_errors_are_those_that_a_demo_shows(
    plain: Outcome, case: tuple[Scenario, Any, int], by_frames: Any
) -> None:
    _, side, _ = case
    path = load_path(TABLES, side)
    truth = truth_of_rows(by_frames[0].truth)
    legs = [leg_figures(leg, truth, path) for leg in split_legs(truth, path, None)]
    assert len(legs) == 2
    for number, leg in enumerate(legs):
        error = plain.error[number * manoeuvre.ERRORS_A_LEG :]
        assert error[manoeuvre.MAX_ERROR_M] == pytest.approx(leg["max_cross_track_m"], abs=1e-9)
        rms = manoeuvre.root_mean_square(error[manoeuvre.SUM_OF_SQUARES_M2], error[manoeuvre.SAMPLES])
        assert rms == pytest.approx(leg["rms_cross_track_m"], abs=1e-9)
        assert error[manoeuvre.FINAL_ERROR_M] == pytest.approx(leg["final_cross_track_m"], abs=1e-9)
        assert error[manoeuvre.FINAL_HEADING_RAD] == pytest.approx(leg["final_heading_error_rad"], abs=1e-9)
        assert error[manoeuvre.FINAL_STATION_M] == pytest.approx(leg["final_station_error_m"], abs=1e-9)


def test_noise_that_runs_out_is_drawn_further_and_changes_nothing() -> None:
    scenario = load_scenario("car")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tools.campaign.single.ROWS", 700)
        short = compiled_runner().run(scenario, "left", 3)
    assert short.end[manoeuvre.CYCLES] > 700
    assert short == compiled_runner().run(scenario, "left", 3)._replace(trace=short.trace)


def test_the_plant_alone_is_the_same_compiled_and_plain() -> None:
    """For loops that are closed in Python: armed, forward, stop, reverse gear, back."""
    given = (load_vehicle("paper"), load_course("ohio"), rough(), "left", 5)
    compiled = plant_world.CompiledPlant(*given)  # type: ignore[arg-type]
    beginning = plant_world.begin(*given)  # type: ignore[arg-type]
    plant_world.arm(beginning.memory)
    world, motion, memory, _ = beginning
    noise = NoiseRows(5)
    sensors = first_state(noise.row())
    since_ns = 2 * 10_000_000 - compiled.PHASE_NS
    gears = set()
    for cycle in range(900):
        reports = compiled.sense()
        now_ns = compiled.now_ns
        motion, sensors, expected, truth = tick.sense(
            world, motion, sensors, memory, now_ns - compiled.PHASE_NS, since_ns, noise.row()
        )
        since_ns = 10_000_000
        assert (reports, compiled.truth) == (expected, truth), f"cycle {cycle}"
        gears.add(reports.long.gear_rpt)
        forward = cycle < 400
        braked = 300 <= cycle < 500
        command = Command(
            road_wheel_angle_rad=0.2 if forward else -0.1,
            speed_mps=0.0 if braked else 0.5 if forward else -0.5,
            brake_decel_mps2=1.5 if braked else 0.0,
            gear=4 if forward else 2,
            park_brake=0,
            steer_enable=1,
            long_enable=1,
            enable_request=1,
            clear_request=0,
            control_leg=1,
        )
        compiled.obey(command)
        motion = tick.obey(world, motion, memory, now_ns + compiled.COMPUTE_NS, command)
    assert gears == {4, 0, 2}
    assert truth.speed_mps < -0.4
