"""The journal: whatever it is cut at, what was whole before is there, once; and what a campaign draws."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from sim.data_files import FOLDERS, SIDES, load_scenario, load_vehicle
from sim.errors import UserError
from tools.campaign.draws import DRAWN_FROM_BOX, TABLE, draw, drawn_names, text_of_table
from tools.campaign.journal import HEAD, Journal, journal_of
from tools.campaign.parquet import read_rows, write_rows
from tools.campaign.results import COLUMNS, Rows, summarise, worst_first
from tools.campaign.work import chunk_runs_of


def chunk_rows(chunk: int, runs: int = 3) -> Rows:
    rng = np.random.default_rng(chunk)
    rows = rng.normal(size=(runs, len(COLUMNS)))
    for place, name in enumerate(COLUMNS):
        if name in ("seed", "run", "cones_touched", "completed", "cycles"):
            rows[:, place] = np.arange(runs) + runs * chunk if name in ("seed", "run") else 1
    return rows


@pytest.fixture
def path(tmp_path: Path) -> Path:
    journal = Journal.begin(journal_of(tmp_path / "c.parquet"), {"runs": 12, "seed": 5})
    for chunk in (2, 0, 1):
        journal.append(chunk, chunk_rows(chunk))
    journal.close()
    return journal.path


def test_it_gives_back_what_was_appended_in_order_of_the_runs(path: Path) -> None:
    journal = Journal.resume(path)
    assert journal.about["runs"] == 12
    assert sorted(journal.done) == [0, 1, 2]
    assert np.array_equal(journal.rows(), np.concatenate([chunk_rows(chunk) for chunk in range(3)]))


def test_cut_at_any_byte_it_keeps_the_whole_records_and_goes_on(path: Path) -> None:
    content = path.read_bytes()
    head = content.index(b"\n") + 1
    record = HEAD.size + chunk_rows(0).nbytes
    for length in [*range(head, len(content), 97), head + record - 1, head + record, len(content) - 1]:
        path.write_bytes(content[:length])
        journal = Journal.resume(path)
        whole = (length - head) // record
        assert list(journal.done) == [2, 0, 1][:whole]
        journal.append(3, chunk_rows(3))
        journal.close()
        again = Journal.resume(path)
        assert list(again.done) == [*[2, 0, 1][:whole], 3]
        again.close()


def test_a_flipped_bit_costs_the_record_and_what_follows_but_nothing_wrong_comes_back(path: Path) -> None:
    content = bytearray(path.read_bytes())
    record = HEAD.size + chunk_rows(0).nbytes
    content[content.index(b"\n") + 1 + record + HEAD.size + 100] ^= 4
    path.write_bytes(content)
    assert list(Journal.resume(path).done) == [2]


def test_a_chunk_that_stands_twice_counts_once(path: Path) -> None:
    journal = Journal.resume(path)
    journal.append(1, chunk_rows(1))
    journal.close()
    assert len(Journal.resume(path).rows()) == 9


def test_two_at_once_are_refused(path: Path) -> None:
    journal = Journal.resume(path)
    with pytest.raises(UserError, match="another campaign is writing"):
        Journal.resume(path)
    journal.close()
    Journal.resume(path).close()


@pytest.mark.parametrize("content", [b"", b"\n", b"{}\n", b"PAR1\x00\x01", b"[1]\n", b'{"format": 0, "columns": []}\n'])
def test_what_is_no_journal_is_refused_in_one_line_and_left_alone(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "c.parquet.journal"
    path.write_bytes(content)
    with pytest.raises(UserError, match=r"c\.parquet\.journal: (not the journal|of another version)"):
        Journal.resume(path)
    assert path.read_bytes() == content


def test_parquet_gives_the_rows_back_and_refuses_others(tmp_path: Path) -> None:
    rows = chunk_rows(1)
    for name in ("right_side", "reason", "cones_knocked_down", "nearest_cone", "legs", "stops"):
        rows[:, COLUMNS.index(name)] = 2
    file = tmp_path / "c.parquet"
    write_rows(file, rows, {"seed": 5})
    read, about = read_rows(file)
    assert np.array_equal(read, rows)
    assert about == {"seed": 5}
    assert [path.name for path in tmp_path.iterdir()] == ["c.parquet"]
    for content in (b"nonsense", file.read_bytes()[:-9]):
        file.write_bytes(content)
        with pytest.raises(UserError, match=r"c\.parquet: not the Parquet file of a campaign"):
            read_rows(file)


def test_the_worst_come_first_touched_before_stopped_before_near() -> None:
    rows = np.zeros((5, len(COLUMNS)))
    for name, values in {
        "run": [0, 1, 2, 3, 4],
        "seed": [10, 11, 12, 13, 14],
        "completed": [1, 1, 0, 1, 1],
        "cones_touched": [0, 0, 0, 2, 0],
        "min_clearance_m": [0.3, 0.28, 0.33, 0.31, 0.28],
    }.items():
        rows[:, COLUMNS.index(name)] = values
    assert worst_first(rows) == [3, 2, 1, 4, 0]
    summary = summarise(rows)
    assert (summary.runs, summary.completed, summary.cones_touched, summary.worst_seed) == (5, 4, 2, 11)
    assert summary.worst_clearance_m == 0.28
    assert summary.quantiles["min_clearance_m"]["p100"] == 0.33
    assert json.loads(json.dumps(summary._asdict()))["runs"] == 5


# ------------------------------------------------------------------------------------------------------------- draws


def test_draws_fill_the_box_and_are_decided_by_the_seed_alone() -> None:
    vehicle, scenario = load_vehicle("paper"), load_scenario("car")
    runs = [draw(vehicle, scenario, seed) for seed in range(400)]
    assert draw(vehicle, scenario, 7) == runs[7]
    assert [run.side for run in runs[:4]] == [*SIDES, *SIDES]
    names = drawn_names(vehicle, scenario)
    assert {"mass_kg", "steering_lag_s", "pose_latency_samples", "command_latency_samples"} <= set(names)
    for name in names:
        low, high = vehicle.box[name]
        values = [run.scenario.plant.unknown[name][0] for run in runs]
        assert low <= min(values) < low + 0.03 * (high - low)
        assert high - 0.03 * (high - low) < max(values) <= high
    gains = [run.scenario.plant.steering_gain for run in runs]
    assert all(low == high and 0.9 <= low <= 1.1 for low, high in gains)
    biases = [run.scenario.plant.steering_bias_rad[0] for run in runs]
    assert min(biases) < -0.017 < 0.017 < max(biases)
    assert all(run.scenario.plant.corners.keys().isdisjoint(names) for run in runs)
    assert all(abs(run.scenario.start.aside_m[0]) <= 0.01 for run in runs)


def test_what_the_scenario_decides_is_left_to_it() -> None:
    slow = load_scenario("slow-rack")
    vehicle = load_vehicle("paper", slow.vehicle_overlay)
    assert not {"steering_lag_s", "command_latency_samples"} & set(drawn_names(vehicle, slow))
    unknown = load_scenario("car-unknown-lag")
    drawn = draw(load_vehicle("paper"), unknown, 3).scenario.plant.unknown
    for name, (low, high) in unknown.plant.unknown.items():
        assert low <= drawn[name][0] <= high
    offset = load_scenario("start-offset")
    starts = [draw(load_vehicle("paper"), offset, seed).scenario.start.aside_m[0] for seed in range(100)]
    assert max(starts) > 0.03
    assert set(drawn) <= set(DRAWN_FROM_BOX)


def test_the_table_of_draws_stands_in_the_help_and_in_the_scenarios_text() -> None:
    text = (FOLDERS["scenario"] / "README.md").read_text()
    for part, what, how in TABLE:
        assert f"| {part} | {what} | {how} |" in text
        assert how in " ".join(text_of_table().split())


def test_chunks_do_not_depend_on_who_drives_them() -> None:
    assert [chunk_runs_of(runs) for runs in (1, 15, 48, 400, 10_000)] == [1, 1, 3, 25, 25]
