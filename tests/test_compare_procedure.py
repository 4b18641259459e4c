"""One procedure for all: the same budget, the same runs, the same search; and tunings that say when they are stale."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path

import pytest
from campaign_support import TABLES
from compare_support import stored

from sim.data_files import load_course, load_vehicle
from sim.errors import UserError
from tools.compare import command, procedure, tunings
from tools.compare.procedure import EVALUATIONS, SCENARIOS, SEEDS, cost_m, tune
from tools.compare.runs import CONTROLLERS, INPUTS, LegFigures, RunFigures

TUNED = [name for name, controller in CONTROLLERS.items() if controller.box]


@pytest.mark.parametrize("name", TUNED)
def test_every_controller_gets_the_same_budget_and_runs(name: str) -> None:
    seen: dict[tuple[float, ...], list[tuple[str, int]]] = {}

    def evaluate(numbers: tuple[float, ...], scenario: str, seed: int) -> float:
        seen.setdefault(numbers, []).append((scenario, seed))
        return 0.01

    found = tune(name, evaluate)
    assert found.evaluations == EVALUATIONS
    order = [(scenario, seed) for seed in SEEDS for scenario in SCENARIOS]
    first, *rest = seen.values()
    assert first == order  # the guess is driven to the end
    assert all(runs == order[: len(runs)] for runs in rest)
    box = CONTROLLERS[name].box
    assert next(iter(seen)) == pytest.approx(CONTROLLERS[name].guess)
    for numbers in seen:
        for value, (low, high) in zip(numbers, box.values(), strict=True):
            assert low * (1.0 - 1e-9) <= value <= high * (1.0 + 1e-9)


def test_all_but_the_shipped_law_are_tuned_for_both_inputs_by_this_procedure() -> None:
    content = json.loads(tunings.STORED.read_text())
    assert set(content["tunings"]) == set(CONTROLLERS) - {"car"}
    budget = content["procedure"]["evaluations"]
    assert content["procedure"]["version"] == procedure.VERSION
    assert (content["procedure"]["scenarios"], content["procedure"]["seeds"]) == (list(SCENARIOS), list(SEEDS))
    for by_inputs in content["tunings"].values():
        assert set(by_inputs) == set(INPUTS)
        assert {found["evaluations"] for found in by_inputs.values()} == {budget}


def test_the_shipped_tunings_belong_to_the_shipped_code_car_and_path() -> None:
    assert stored().stale == []


def test_the_search_finds_a_minimum() -> None:
    goal = [math.log(0.7), math.log(3.0)]

    def evaluate(numbers: tuple[float, ...], scenario: str, seed: int) -> float:
        return 0.001 + sum((math.log(value) - wanted) ** 2 for value, wanted in zip(numbers, goal, strict=True))

    found = tune("rear-wheel", evaluate)
    assert found.numbers["k_e_1pm2"] == pytest.approx(0.7, rel=0.15)
    assert found.numbers["k_theta_1pm"] == pytest.approx(3.0, rel=0.15)
    assert found.runs < EVALUATIONS * len(SEEDS) * len(SCENARIOS)  # what is worse is dropped early


def figures(error_m: float, *, completed: bool = True) -> RunFigures:
    leg = LegFigures(error_m, 100.0 * error_m * error_m, 100.0, 0.0, 0.0, 0.3, 0.0)
    return RunFigures((leg, leg), completed)


def test_the_cost_is_max_and_twice_rms_and_a_stopped_run_costs_most() -> None:
    assert cost_m(figures(0.01)) == pytest.approx(0.03)
    assert cost_m(figures(0.01, completed=False)) == 1.0
    assert cost_m(figures(5.0)) == 1.0


def test_training_and_measured_seeds_are_apart() -> None:
    assert max(SEEDS) < 1000 < command.FIRST_SEED


def test_another_path_or_car_makes_the_tunings_stale(tmp_path: Path) -> None:
    other = tmp_path / "tables"
    shutil.copytree(TABLES, other)
    lines = (other / "path.csv").read_text().splitlines()
    header = next(index for index, line in enumerate(lines) if line.startswith("station_m"))
    for shift, changed in ((0.05, False), (0.3, True)):
        moved = [line.split(",") for line in lines[header + 1 :]]
        moved = [[row[0], row[1], str(float(row[2]) + shift), *row[3:]] for row in moved]
        (other / "path.csv").write_text("\n".join([lines[header], *map(",".join, moved)]) + "\n")
        found = tunings.load(tunings.STORED, load_vehicle("paper"), load_course("ohio"), other)
        assert ("the path changed" in found.stale) is changed
    found = tunings.load(tunings.STORED, load_vehicle("fusion"), load_course("ohio"), TABLES)
    assert {"the vehicle changed", "made for paper on ohio"} <= set(found.stale)


def test_the_digest_is_of_the_code_not_of_its_comments(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in tunings.SOURCES:
        shutil.copy(tunings.STORED.with_name(name), tmp_path / name)
    before = tunings.code_digest()
    monkeypatch.setattr(tunings, "STORED", tmp_path / "tunings.json")
    laws = tmp_path / "laws.py"
    text = laws.read_text()
    laws.write_text(text.replace("import math\n", "import math  # of course\n", 1))
    assert tunings.code_digest() == before
    laws.write_text(text.replace("PREVIEW_S = 0.5", "PREVIEW_S = 0.6"))
    assert tunings.code_digest() != before


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda content: content["tunings"].pop("lqr"), "tunings.lqr.raw"),
        (lambda content: content["tunings"]["pid"]["raw"]["numbers"].pop("kp"), "tunings.pid.raw"),
        (lambda content: content["tunings"]["mpc"]["raw"]["numbers"].update(q_e=-1.0), "tunings.mpc.raw"),
    ],
)
def test_a_file_of_tunings_that_lacks_something_is_refused(tmp_path: Path, change: object, named: str) -> None:
    content = json.loads(tunings.STORED.read_text())
    change(content)  # type: ignore[operator]
    file = tmp_path / "t.json"
    file.write_text(json.dumps(content))
    with pytest.raises(UserError, match=named):
        tunings.load(file, load_vehicle("paper"), load_course("ohio"), TABLES)
