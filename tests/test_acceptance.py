"""What the law `car` must hold with the paper's car on the shipped path, over 200 runs of each scenario.

The runs are lock-step's, compiled (`tests/test_campaign_bits.py` holds both against each other, tick by tick). Errors
are true ones of the rear axle against the plant's own pose. The numbers of estimator and PID were chosen on other seeds
and on a campaign, but for three things that were seen on these: how a start off the path is corrected (first 30), the
tyres' side slip in the filter (after `car`'s final heading) and the wait before a leg (after `car-drift`'s maximum).
"""

from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from core_support import TABLES

from sim import examiner
from sim.data_files import SIDES, load_course, load_scenario, load_vehicle
from sim.examiner import TOUCHED
from sim.plant import TruthRow
from tools.campaign import manoeuvre
from tools.campaign.draws import draw
from tools.campaign.single import Runner, share
from tools.design.tables import design_tables
from tools.figures import load_path, project

FIRST_SEED = 500_000
SEEDS = 100
"""Each driven to both sides."""

NOISE_FREE = {"ideal", "quantised"}
"""Nothing is drawn: all seeds are one run."""


class Bounds(NamedTuple):
    """Greatest cross-track error of all runs, 95 % of the runs' greatest, pooled rms, final error (mm) and heading."""

    max_mm: float
    p95_mm: float | None = None
    rms_mm: float | None = None
    final_mm: float | None = None
    final_deg: float | None = None


BOUNDS = {
    "ideal": Bounds(0.25),
    "quantised": Bounds(0.30),
    "car-quiet": Bounds(3.0),
    "car": Bounds(4.5, rms_mm=1.2, final_mm=3.0, final_deg=0.1),
    "car-unknown-lag": Bounds(6.0),
    "car-drift": Bounds(30.0, 25.0, 8.0),
    "car-drift-3mm": Bounds(10.0, rms_mm=3.0),
    "slow-rack": Bounds(10.0, rms_mm=3.5),
}


@pytest.fixture(scope="session")
def runner_of(tmp_path_factory):
    """Return what drives a scenario: compiled, with the shipped tables or, for an overlay, tables made for it."""

    @cache
    def of(scenario_name):
        overlay = load_scenario(scenario_name).vehicle_overlay
        vehicle, course = load_vehicle("paper", overlay), load_course("ohio")
        folder = TABLES
        if overlay:
            folder = tmp_path_factory.mktemp(scenario_name) / "tables"
            design_tables(vehicle, course, folder)
        return Runner(share(vehicle, course, "car", folder))

    return of


def runs_of(runner, scenario_name, seeds, **options):
    scenario = load_scenario(scenario_name)
    for seed in range(FIRST_SEED, FIRST_SEED + seeds):
        for side in SIDES:
            yield f"{scenario_name}, {side}, seed {seed}", runner.run(scenario, side, seed, **options)


@pytest.mark.parametrize("scenario_name", list(BOUNDS))
def test_figures_of_a_scenario(runner_of, record_property, scenario_name):
    largest_mm, squares_mm2, samples, final_mm, final_deg = [], 0.0, 0.0, 0.0, 0.0
    for what, outcome in runs_of(runner_of(scenario_name), scenario_name, 1 if scenario_name in NOISE_FREE else SEEDS):
        assert outcome.end[manoeuvre.COMPLETED], f"{what}: reason {outcome.end[manoeuvre.REASON]:.0f}"
        assert outcome.notes.number[TOUCHED] == 0, what
        legs = np.array(outcome.error).reshape(manoeuvre.LEG_FIGURES, manoeuvre.ERRORS_A_LEG)
        largest_mm.append(1e3 * legs[:, manoeuvre.MAX_ERROR_M].max())
        squares_mm2 += 1e6 * legs[:, manoeuvre.SUM_OF_SQUARES_M2].sum()
        samples += legs[:, manoeuvre.SAMPLES].sum()
        final_mm = max(final_mm, 1e3 * np.abs(legs[:, manoeuvre.FINAL_ERROR_M]).max())
        final_deg = max(final_deg, np.degrees(np.abs(legs[:, manoeuvre.FINAL_HEADING_RAD]).max()))
    p95_mm, rms_mm = float(np.quantile(largest_mm, 0.95)), float(np.sqrt(squares_mm2 / samples))
    found = Bounds(*(float(value) for value in (max(largest_mm), p95_mm, rms_mm, final_mm, final_deg)))
    record_property("found", found._asdict())  # plain floats: they travel between processes
    for name, bound in BOUNDS[scenario_name]._asdict().items():
        assert bound is None or getattr(found, name) <= bound, f"{scenario_name}: {name} of {found}"


def test_clearance_is_kept(runner_of):
    least_m = min(
        outcome.notes.value[examiner.MIN_CLEARANCE_M] for _, outcome in runs_of(runner_of("car"), "car", SEEDS)
    )
    assert least_m >= 0.30


def test_cars_that_leave_the_sharpest_bend_at_full_lock_keep_their_room(runner_of):
    """Steering gain near 0.9, long wheelbase: 0.5 rad is not enough for the path, and the wheels then swing over."""
    vehicle, scenario = load_vehicle("paper"), load_scenario("car")
    for seed in (1004203, 1004453, 1004465, 1006390, 1006920, 1007528, 1007604, 1009169):
        drawn = draw(vehicle, scenario, seed)
        assert drawn.scenario.plant.unknown["wheelbase_m"][0] > 4.1
        outcome = runner_of("car").run(drawn.scenario, drawn.side, seed)
        assert outcome.end[manoeuvre.COMPLETED], seed
        assert outcome.notes.value[examiner.MIN_CLEARANCE_M] >= 0.25, seed


@pytest.mark.parametrize("side", SIDES)
def test_a_start_off_the_path_is_corrected_within_four_metres(runner_of, side):
    runner, scenario, path = runner_of("start-offset"), load_scenario("start-offset"), load_path(TABLES, side)
    largest_start_m = 0.0
    for seed in range(FIRST_SEED, FIRST_SEED + 30):
        outcome = runner.run(scenario, side, seed, trace_rows=1500)
        what = f"start-offset, {side}, seed {seed}"
        assert outcome.end[manoeuvre.COMPLETED], what
        assert outcome.notes.number[TOUCHED] == 0, what
        assert outcome.notes.value[examiner.MIN_CLEARANCE_M] >= 0.20, what
        truth = TruthRow(*outcome.trace[outcome.trace[:, TruthRow._fields.index("t_s")] > 0.0].T)
        on_path = project(path, truth.x_m, truth.y_m, truth.yaw_rad)
        largest_start_m = max(largest_start_m, abs(on_path.cross_track_error_m[0]))
        corrected = np.argmax(on_path.station_m > on_path.station_m[0] + 4.0)
        assert np.abs(on_path.cross_track_error_m[corrected:]).max() <= 5e-3, what
    assert largest_start_m > 0.04


def test_a_slow_rack_that_the_tables_do_not_know_is_noticed_and_the_car_stops_before_a_cone(runner_of):
    for what, outcome in runs_of(runner_of("slow-rack-unknown"), "slow-rack-unknown", SEEDS):
        assert not outcome.end[manoeuvre.COMPLETED], what
        assert outcome.notes.number[TOUCHED] == 0, what
