"""`parkctl compare` as a user runs it, and the firmware in it against the firmware in lock-step."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest
from campaign_support import TABLES
from compare_support import driver, numbers_of

from sim.data_files import load_course, load_scenario, load_vehicle
from tools import cli
from tools.compare.runs import CONTROLLERS, LegFigures, RunFigures, side_of
from tools.compare.verdicts import verdicts
from tools.figures import leg_figures, load_path, split_legs, truth_of_rows
from tools.lockstep import run_lockstep

FIELDS = {
    "controller", "inputs", "scenario", "vehicle", "direction", "seeds", "max_cross_track_m", "p95_cross_track_m",
    "rms_cross_track_m", "final_cross_track_m", "final_heading_error_rad", "min_clearance_m", "command_jitter_rad",
    "tick_us", "stopped_runs", "latency_borne_samples",
}  # fmt: skip
SEED = 2_000_008  # driven on the right side


def test_the_shipped_law_is_the_firmware_as_it_runs_in_lock_step() -> None:
    ours = driver().run(CONTROLLERS["car"].law, (), "raw", SEED)
    side = side_of(SEED)
    assert side == "right"
    run = run_lockstep(load_vehicle("paper"), load_course("ohio"), load_scenario("car"), side, SEED, "car", TABLES)
    truth, path = truth_of_rows(run.truth), load_path(TABLES, side)
    theirs = [leg_figures(leg, truth, path) for leg in split_legs(truth, path, None)]
    assert ours.completed
    assert len(theirs) == 2
    for leg, told in zip(ours.legs, theirs, strict=True):
        assert leg.max_cross_track_m == pytest.approx(told["max_cross_track_m"], abs=1e-9)
        assert leg.final_cross_track_m == pytest.approx(told["final_cross_track_m"], abs=1e-9)
        assert leg.min_clearance_m == pytest.approx(told["min_clearance_m"], abs=1e-9)
        assert (leg.sum_of_squares_m2 / leg.samples) ** 0.5 == pytest.approx(told["rms_cross_track_m"], abs=1e-6)


@pytest.mark.parametrize("inputs", ["raw", "estimator"])
@pytest.mark.parametrize("name", ["pure-pursuit", "lqr-preview", "mpc", "dob+pid"])
def test_another_law_drives_both_legs_and_is_repeatable(name: str, inputs: str) -> None:
    law, numbers = CONTROLLERS[name].law, numbers_of(name, inputs)
    first = driver().run(law, numbers, inputs, SEED)
    shipped = driver().run(CONTROLLERS["car"].law, (), inputs, SEED)
    assert first.completed
    assert all(0.0 < leg.max_cross_track_m < 0.1 and leg.samples > 1000 for leg in first.legs)
    assert first.legs != shipped.legs
    if name != "mpc":
        assert driver().run(law, numbers, inputs, SEED) == first


def test_a_law_that_goes_far_off_is_driven_to_the_end() -> None:
    beyond = driver().run(CONTROLLERS["ff"].law, (0.1,), "raw", 3)
    assert beyond.completed
    assert max(leg.max_cross_track_m for leg in beyond.legs) > 0.2  # where the firmware alone would have stopped


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    driver()
    folder = tmp_path_factory.mktemp("compare")
    options = ["--scenario", "car", "--controller", "car", "--controller", "pid+ff", "--seeds", "5", "--jobs"]
    files = []
    for jobs in (1, 2):
        file, picture = folder / f"{jobs}.json", folder / f"{jobs}.png"
        assert cli.main(["compare", *options, str(jobs), "--json", str(file), "--plot", str(picture)]) == 0
        files.append(json.loads(file.read_text()))
    for rows in (files[0]["rows"], files[1]["rows"]):
        for row in rows:
            assert row.pop("tick_us") > 0.0
    assert files[0]["rows"] == files[1]["rows"]
    return files[0], picture


def test_rows_have_the_agreed_fields(told: tuple[dict[str, Any], Path]) -> None:
    rows = told[0]["rows"]
    assert len(rows) == 2 * 2 * 2
    assert all(set(row) | {"tick_us"} == FIELDS for row in rows)
    assert {(row["controller"], row["inputs"], row["direction"]) for row in rows} == {
        (name, inputs, direction)
        for name in ("car", "pid+ff")
        for inputs in ("raw", "estimator")
        for direction in ("forward", "reverse")
    }
    for row in rows:
        assert (row["scenario"], row["vehicle"], row["seeds"], row["stopped_runs"]) == ("car", "paper", 5, 0)
        assert row["rms_cross_track_m"] < row["p95_cross_track_m"] <= row["max_cross_track_m"]
        assert row["final_cross_track_m"] <= row["max_cross_track_m"]
        assert 0.2 < row["min_clearance_m"] < 0.4
    shipped = [{k: v for k, v in row.items() if k != "inputs"} for row in rows if row["controller"] == "car"]
    assert shipped[:2] == shipped[2:]  # it brings its estimator along


def test_rows_tell_the_latency_that_is_borne_and_a_claim_is_made_of_it(told: tuple[dict[str, Any], Path]) -> None:
    borne = {(row["controller"], row["inputs"]): row["latency_borne_samples"] for row in told[0]["rows"]}
    assert borne["car", "estimator"] >= 10
    assert 0 <= borne["pid+ff", "estimator"] < 10
    assert borne["pid+ff", "raw"] != borne["pid+ff", "estimator"]
    claim = told[0]["claims"][-1]
    assert claim["claim"].startswith("car: no worse than the best other that bears 10 samples of latency more")
    assert (claim["best_other"], claim["bears_itself"], claim["holds"]) == (None, True, True)


def test_the_latency_is_measured_in_its_scenario_only(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    driver()
    file = tmp_path / "rows.json"
    options = ["--controller", "car", "--controller", "pid+ff", "--inputs", "estimator", "--seeds", "1", "--jobs", "1"]
    scenarios = ["--scenario", "car", "--scenario", "car-quiet"]
    assert cli.main(["compare", *options, *scenarios, "--json", str(file)]) == 0
    rows = json.loads(file.read_text())["rows"]
    assert all((row["latency_borne_samples"] is None) == (row["scenario"] == "car-quiet") for row in rows)
    printed = capsys.readouterr().out
    header = next(line for line in printed.splitlines() if "car-quiet" in line)
    assert [cell.strip() for cell in header.strip("┃").split("┃")] == ["", "car", "latency", "car-quiet", "us"]
    assert "latency: added samples of 10 ms" in printed
    assert cli.main(["compare", *options, "--scenario", "car-quiet", "--json", str(file)]) == 0
    content = json.loads(file.read_text())
    assert {row["latency_borne_samples"] for row in content["rows"]} == {None}
    assert content["claims"] == []
    assert "latency" not in capsys.readouterr().out


def test_the_shipped_law_has_at_most_half_the_error_of_pid_ff_on_raw_inputs(told: tuple[dict[str, Any], Path]) -> None:
    claims = {claim["claim"]: claim for claim in told[0]["claims"]}
    raw = claims["car: at most half of the best other on raw inputs"]
    assert raw["best_other"] == "pid+ff"
    assert raw["holds"]
    assert raw["car_m"] <= 0.5 * raw["best_other_m"]


def test_the_picture_is_one(told: tuple[dict[str, Any], Path]) -> None:
    assert told[1].read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


def test_a_claim_that_does_not_hold_is_said_not_to() -> None:
    def runs(error_m: float) -> list[RunFigures]:
        leg = LegFigures(error_m, error_m**2, 1.0, 0.0, 0.0, 0.3, 0.0)
        return [RunFigures((leg, leg), True)]

    judged = verdicts(
        {
            ("car", "car", "raw"): runs(0.003),
            ("car", "lqr", "raw"): runs(0.005),
            ("car", "mpc", "raw"): runs(0.009),
            ("car-unknown-lag", "car", "raw"): runs(0.003),
            ("car-unknown-lag", "lqr", "raw"): runs(0.004),
        }
    )
    assert [(verdict.best_other, verdict.holds) for verdict in judged] == [("lqr", False), ("lqr", True)]


def test_beside_a_verdict_stands_the_mean_difference_of_a_run_with_its_error() -> None:
    def runs(*errors_m: float) -> list[RunFigures]:
        legs = [LegFigures(error_m, error_m**2, 1.0, 0.0, 0.0, 0.3, 0.0) for error_m in errors_m]
        return [RunFigures((leg, leg._replace(max_cross_track_m=0.0)), True) for leg in legs]

    own, other = runs(0.003, 0.001, 0.001, 0.001), runs(0.002, 0.002, 0.002, 0.001)
    (verdict,) = verdicts({("car", "car", "estimator"): own, ("car", "lqr", "estimator"): other})
    assert not verdict.holds
    assert verdict.mean_difference_m == pytest.approx(-0.25e-3)
    assert verdict.standard_error_m == pytest.approx(1e-3 * math.sqrt((1.25**2 + 2 * 0.75**2 + 0.25**2) / 3 / 4))
    assert (verdict.smaller_in, verdict.runs) == (2, 4)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--controller", "lqg"], "--controller lqg: there is no such one; there are ff, pure-pursuit"),
        (["--scenario", "carr"], "carr"),
        (["--seeds", "0"], "--seeds 0: must be from 1 to 10000"),
        (["--seeds", "many"], "--seeds"),
        (["--budget", "0"], "--budget 0: must be from 1 to 1000"),
        (["--seed", "5"], "--seed 5: must be at least 1000"),
        (["--jobs", "0"], "--jobs 0: must be from 1 to 256"),
        (["--inputs", "cooked"], "--inputs"),
        (["--vehicle", "tank"], "tank"),
        (["--tunings", "none.json"], "--tunings none.json: cannot be read"),
        (["--json", "no/such/x.json"], "there is no folder no/such"),
        (["--plot", "x.pdf"], "--plot x.pdf: name a file that ends in .png"),
    ],
)
def test_a_mistake_gives_one_clear_line(
    options: list[str], said: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main(["compare", "--scenario", "car", *options]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())
