"""What latency a law bears that it does not know of: the search for it, the runs, and the claim made of it."""

from __future__ import annotations

import io
import math
import re
from dataclasses import replace

import pytest
from compare_support import driver, numbers_of
from rich.console import Console

from sim.data_files import load_scenario, load_vehicle
from sim.data_files.vehicle import Criteria
from tools.compare.latency import (
    MOST_SAMPLES,
    RUNS,
    TOLERATED_M,
    Borne,
    borne_samples,
    is_borne,
    most_borne,
    most_samples,
    with_latency,
)
from tools.compare.rows import Both
from tools.compare.runs import CONTROLLERS, Driver, LegFigures, RunFigures
from tools.compare.table import print_tables, samples_cell
from tools.compare.verdicts import Verdict, line_of, verdicts

SEEDS = range(2_000_000, 2_000_000 + RUNS)
ASKED = 10.0


@pytest.mark.parametrize("most", [0, 1, 7, 24, 100])
def test_the_bisection_finds_every_answer_in_few_steps(most: int) -> None:
    for answer in range(-1, most + 1):
        tried: list[int] = []

        def survives(samples: int, answer: int = answer, tried: list[int] = tried) -> bool:
            tried.append(samples)
            return samples <= answer

        assert most_borne(survives, most) == (answer if answer >= 0 else None)
        assert len(set(tried)) == len(tried) <= math.ceil(math.log2(most + 2))
        assert all(0 <= samples <= most for samples in tried)


def figures(error_m: float, *, completed: bool = True) -> RunFigures:
    leg = LegFigures(error_m, error_m**2, 1.0, 0.0, 0.0, 0.3, 0.0)
    return RunFigures((leg._replace(max_cross_track_m=0.0), leg), completed)


def test_a_run_is_borne_that_comes_to_its_end_near_the_path() -> None:
    assert is_borne(figures(TOLERATED_M))
    assert not is_borne(figures(1.01 * TOLERATED_M))
    assert not is_borne(figures(0.001, completed=False))


def test_as_many_are_tried_as_the_vehicle_file_asks_for_and_the_plant_has_room_for() -> None:
    paper = load_vehicle("paper")
    assert most_samples(paper) == MOST_SAMPLES
    assert most_samples(replace(paper, criteria=Criteria(least_delay_margin_samples=30.5))) == 31
    assert most_samples(paper.with_overlay({"command_latency_samples": 90.5})) == 9


def test_the_added_latency_is_the_cars_alone_and_none_added_is_the_scenario_itself() -> None:
    setting = driver().setting
    later = with_latency(setting, 3)
    assert later.shared is setting.shared
    assert later.scenario.plant.unknown == {"command_latency_samples": (4.0, 4.0)}  # 1 is nominal
    assert setting.scenario == load_scenario("car")
    law = CONTROLLERS["car"].law
    plain, none, added = (
        Driver(one).run(law, (), "estimator", SEEDS[3]) for one in (setting, with_latency(setting, 0), later)
    )
    assert none == plain
    assert added != plain


def test_the_shipped_law_bears_what_its_design_asks_for_and_more_than_one_that_is_blind_to_delay() -> None:
    def bears(name: str) -> int | None:
        law = CONTROLLERS[name].law
        return borne_samples(driver().setting, law, numbers_of(name, "estimator"), "estimator", SEEDS)

    shipped, blind = bears("car"), bears("lqr")
    assert shipped is not None
    assert blind is not None
    assert shipped >= load_vehicle("paper").criteria.least_delay_margin_samples >= 10
    assert shipped > blind

    def greatest_m(added_samples: int) -> float:
        slower = Driver(with_latency(driver().setting, added_samples))
        runs = [slower.run(CONTROLLERS["lqr"].law, numbers_of("lqr", "estimator"), "estimator", seed) for seed in SEEDS]
        return max(leg.max_cross_track_m for run in runs for leg in run.legs)

    assert greatest_m(blind) <= TOLERATED_M < greatest_m(blind + 1)


def test_a_law_that_is_off_the_path_as_it_is_bears_nothing() -> None:
    ahead = (0.1,)
    assert borne_samples(driver().setting, CONTROLLERS["ff"].law, ahead, "raw", SEEDS[:1]) is None


def judged(errors_m: dict[str, float], samples: dict[str, int | None]) -> Verdict:
    """Return the claim that asks for latency."""
    runs = {("car", name, "estimator"): [figures(error_m)] * 2 for name, error_m in errors_m.items()}
    borne = Borne({(name, "estimator"): of for name, of in samples.items()}, MOST_SAMPLES, ASKED)
    *others, last = verdicts(runs, borne)
    assert others == verdicts(runs)  # the other claims know nothing of latency
    assert last.claim == (
        "car: no worse than the best other that bears 10 samples of latency more, behind the same estimator"
    )
    return last


ERRORS_M = {"car": 0.003, "lqr": 0.002, "mpc": 0.004, "stanley": 0.02}


@pytest.mark.parametrize(
    ("samples", "best", "holds", "said"),
    [
        ({"car": 20, "lqr": 9, "mpc": 10, "stanley": 24}, "mpc", True, "yes  car"),
        ({"car": 20, "lqr": None, "mpc": None, "stanley": 10}, "stanley", True, ", stanley 20.00 mm"),
        ({"car": 10, "lqr": 10, "mpc": 10, "stanley": 10}, "lqr", False, "NO   car"),
        ({"car": 20, "lqr": 9, "mpc": None, "stanley": 0}, None, True, "3.00 mm; no other bears it"),
        ({"car": 9, "lqr": 9, "mpc": 10, "stanley": 24}, "mpc", False, "2 of 2; car does not bear it itself"),
        ({"car": 9, "lqr": 9, "mpc": 9, "stanley": 9}, None, False, "; no other bears it; car does not bear it itself"),
        ({"car": None, "lqr": 0, "mpc": 24, "stanley": 9}, "mpc", False, "; car does not bear it itself"),
    ],
)
def test_only_laws_that_bear_it_are_held_against_the_shipped_one_which_has_to_bear_it_too(
    samples: dict[str, int | None], best: str | None, holds: bool, said: str
) -> None:
    verdict = judged(ERRORS_M, samples)
    assert (verdict.best_other, verdict.holds) == (best, holds)
    assert verdict.best_other_m == (None if best is None else ERRORS_M[best])
    assert (verdict.car_m, verdict.runs) == (ERRORS_M["car"], 2)
    line = line_of(verdict)
    assert said in line
    assert line.startswith("yes" if holds else "NO ")
    assert ("no other bears it" in line) == (best is None)


def test_without_a_latency_or_another_law_nothing_is_claimed_of_it() -> None:
    runs = {("car", name, "estimator"): [figures(0.001)] for name in ("car", "lqr")}
    assert [verdict.bears_itself for verdict in verdicts(runs)] == [None]
    alone = {("car", "car", "estimator"): [figures(0.001)]}
    assert verdicts(alone, Borne({("car", "estimator"): 20}, MOST_SAMPLES, ASKED)) == []


def test_the_table_tells_none_and_the_most_that_is_tried() -> None:
    assert [samples_cell(samples, 24) for samples in (None, 0, 23, 24)] == ["-", "0", "23", "24+"]


@pytest.mark.parametrize("width", [80, 120])
def test_no_figure_of_the_tables_is_cut_short(width: int) -> None:
    names = ["pure-pursuit", "stanley", "car"]
    scenarios = ["ideal", "quantised", "car-quiet", "car", "car-unknown-lag", "car-drift"]
    both = {
        (scenario, name, inputs): Both(2.211 + place, 0.0, 0.5621 + place, 0.0, 0.0, place)
        for scenario in scenarios
        for place, name in enumerate(names)
        for inputs in ("raw", "estimator")
    }
    ticks = {(name, inputs): 93.0 for name in names for inputs in ("raw", "estimator")}
    borne = Borne(dict.fromkeys(ticks, 18), MOST_SAMPLES, ASKED)
    file = io.StringIO()
    print_tables(Console(file=file, width=width), {name: name for name in scenarios}, both, ticks, borne)
    shown = file.getvalue()
    assert "…" not in shown
    assert max(map(len, shown.splitlines())) <= width
    for figure in ("2211", "562", "3211", "1562*", "4211", "2562*"):
        found = re.findall(rf"(?<![\d.]){re.escape(figure)}(?![\d.])", shown)
        assert len(found) == 2 * len(scenarios), figure
    assert len(re.findall(r"(?<![\d.])18(?![\d.])", shown)) == 2 * len(names)
