"""`parkctl bench`: the table's rows, what cannot be measured, and mistakes in what is given."""

import argparse
import json
import os
import shutil
import subprocess
import time

import pytest
from rich.console import Console

from sim.errors import UserError
from tools import cli, plots
from tools.bench import command, rows, wake
from tools.bench.recording import record
from tools.bench.rows import LIMITS, Row, quantile, row_of

NAMES = [
    "wake_p50_fifo",
    "wake_p99_fifo",
    "wake_p50_fifo_loaded",
    "wake_p99_fifo_loaded",
    "wake_p99_normal_loaded",
    "tick_cold_p50",
    "tick_cold_p99_of_period",
    "tick_hot",
    "codec_frame",
    "turnaround_loopbus",
    "turnaround_vcan",
    "campaign_rate",
    "startup_s",
    "rss_mib",
]


def parsed(*arguments):
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    return parser.parse_args(arguments)


def test_the_rows_that_others_read_are_there():
    assert set(LIMITS) >= set(NAMES)
    assert set(Row("tick_hot").as_dict()) >= {"name", "value", "unit", "floor", "ratio", "must", "aim"}


def test_a_row_is_the_median_over_rounds_and_its_ratio_that_of_the_rounds():
    row = row_of("tick_cold_p50", [30.0, 10.0, 20.0], [10.0, 10.0, 40.0])
    assert (row.value, row.floor, row.ratio) == (20.0, 10.0, 1.0)


@pytest.mark.parametrize(
    ("name", "value", "floor", "verdict"),
    [
        ("tick_cold_p50", 1.4, 1.0, "aim"),
        ("tick_cold_p50", 2.0, 1.0, "must"),
        ("tick_cold_p50", 2.1, 1.0, "over"),
        ("rss_mib", 61.0, None, "over"),
        ("rss_mib", 44.0, None, "aim"),
        ("lockstep_ratio", 19.0, None, "over"),
        ("lockstep_ratio", 21.0, None, "must"),
        ("lockstep_ratio", 30.0, None, "aim"),
        ("tick_hot", 9.0, 1.0, ""),
    ],
)
def test_a_verdict_is_by_the_ratio_or_where_there_is_no_floor_by_the_value(name, value, floor, verdict):
    assert row_of(name, [value], [floor] if floor else ()).verdict == verdict


def test_quantiles_are_samples():
    samples = [float(value) for value in range(100, 0, -1)]
    assert (quantile(samples, 0.5), quantile(samples, 0.99), quantile([7.0], 0.99)) == (50.0, 99.0, 7.0)


def test_without_cyclictest_the_wake_rows_say_why(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(wake.shutil, "which", lambda name: None)
    file = tmp_path / "bench.json"
    assert command.run(parsed("--quick", "--only", "wake", "--json", str(file))) == 0
    found = {row["name"]: row for row in json.loads(file.read_text("utf-8"))["rows"]}
    assert list(found) == list(LIMITS)
    for name in NAMES[:5]:
        assert found[name]["value"] is None
        assert "rt-tests" in found[name]["why"]
    assert found["rss_mib"]["why"] == "not asked for (--only)"
    assert "rt-tests" in capsys.readouterr().out


@pytest.mark.live
def test_the_wake_rows_are_measured_beside_cyclictest(monkeypatch, tmp_path):
    if shutil.which("cyclictest") is None:
        assert os.environ.get("CI") != "true", "CI installs it"
        pytest.skip("cyclictest is not installed (rt-tests)")
    why = wake.why_no_cyclictest()  # no right to SCHED_FIFO here
    monkeypatch.setattr(command, "QUICK", command.QUICK._replace(rounds=1, wake_s=0.5))
    file = tmp_path / "bench.json"
    assert command.run(parsed("--quick", "--only", "wake", "--json", str(file))) == 0
    found = {row["name"]: row for row in json.loads(file.read_text("utf-8"))["rows"]}
    for name in NAMES[:5]:
        row = found[name]
        if why:
            assert (row["value"], row["why"]) == (None, why)
            continue
        assert row["value"] >= 0.0, row
        assert row["floor"] > 0.0, row
        assert row["ratio"] == pytest.approx(row["value"] / row["floor"])


def test_the_table_shows_value_limits_and_verdict_in_80_columns(capsys):
    measured = {
        name: row_of(name, [13773.4], [100.0] if limit.against else ()) for name, limit in LIMITS.items() if limit.must
    }
    measured |= {"tick_cold_p50": row_of("tick_cold_p50", [261.5], [39.5]), "rss_mib": row_of("rss_mib", [35.5])}
    command._print(Console(width=80), [measured.get(name, Row(name, why="not here")) for name in LIMITS])
    shown = capsys.readouterr().out
    line = next(line for line in shown.splitlines() if "tick_cold_p50" in line)
    for text in ("262 us", "39.5", "6.62", "≤ 2", "≤ 1.4", "OVER"):
        assert text in line
    assert "35.5 MiB" in shown
    assert "the same source compiled" in shown
    assert "not measured: not here" in shown
    assert "…" not in shown


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--json", "/nowhere/bench.json"], "there is no folder /nowhere"),
        (["--out", __file__], "is a file; name a folder"),
        (["--out", os.path.dirname(__file__)], "holds files that are not of a bench"),
        (["--only", "speed"], "invalid choice: 'speed'"),
    ],
)
def test_a_mistake_is_one_line_and_nothing_is_measured(arguments, text, monkeypatch, capsys):
    def measure(bench):
        raise AssertionError("measured")

    monkeypatch.setattr(command.Bench, "measure", measure)
    assert cli.main(["bench", *arguments]) == cli.STATUS_USER_ERROR
    error = capsys.readouterr().err
    assert text in error
    assert error.count("\n") == 1


def test_hogs_are_ended_by_id_even_after_an_error():
    def in_trouble(pids):
        with wake.hogs() as started:
            pids += started
            for pid in pids:
                os.kill(pid, 0)
            raise UserError("in the middle")

    pids: list[int] = []
    with pytest.raises(UserError, match="in the middle"):
        in_trouble(pids)
    assert len(pids) == wake.HOGS
    for pid in pids:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


def test_a_hog_ends_by_itself_when_its_parent_is_gone():
    program = "import os; from tools.bench import wake\nwith wake.hogs(1) as p:\n print(p[0], flush=True)\n os._exit(0)"
    done = subprocess.run([os.sys.executable, "-c", program], stdout=subprocess.PIPE, text=True, check=True)
    end = time.monotonic() + 20.0
    while os.path.exists(f"/proc/{int(done.stdout)}"):
        with open(f"/proc/{int(done.stdout)}/stat") as file:
            if file.read().rsplit(")", 1)[1].split()[0] == "Z":
                break
        assert time.monotonic() < end, "the hog still runs"
        time.sleep(0.05)


def test_histograms_are_drawn(tmp_path):
    plots.histogram(tmp_path / "h.png", "title", {"one": [1.0, 2.0, 3.0], "other": [0.0, 100.0]})
    assert (tmp_path / "h.png").read_bytes().startswith(b"\x89PNG")
    assert [path.name for path in tmp_path.iterdir()] == ["h.png"]


def test_a_recording_is_the_run_itself_cycle_by_cycle():
    recording = record(6.0)
    assert recording.active
    assert len(recording.frames) == len(recording.inputs) == len(recording.outputs) == len(recording.states) - 1
    assert {len(frames) for frames in recording.frames} <= {5, 6, 7, 8}
    moving = recording.inputs[-1]
    assert moving.motion.speed_meas_mps > 0.05
    assert moving.used.used_position_counter != 15


def test_every_limit_that_has_a_floor_says_against_what():
    for name, limit in rows.LIMITS.items():
        assert limit.unit, name
        if name.startswith(("wake", "codec", "turnaround", "tick_hot", "tick_cold_p50")):
            assert limit.against, name
