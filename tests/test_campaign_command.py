"""`parkctl campaign` as a user runs it: workers, kills, a Dask cluster, the worst again, and mistakes."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from campaign_support import TABLES, compiled_runner

from tools import cli
from tools.campaign import work
from tools.campaign.journal import Journal
from tools.campaign.parquet import read_rows
from tools.campaign.results import COLUMNS

RUNS = 48
PARKCTL = [sys.executable, "-P", "-m", "tools.cli"]
ROOT = Path(__file__).resolve().parent.parent


def campaign(*options: object) -> list[str]:
    return ["campaign", *map(str, options)]


def parkctl(*options: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*PARKCTL, *campaign(*options)], capture_output=True, text=True, check=False, cwd=ROOT, timeout=300
    )


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any], str]:
    """A campaign by two workers that nobody disturbed."""
    compiled_runner()
    folder = tmp_path_factory.mktemp("whole")
    file, figures = folder / "c.parquet", folder / "c.json"
    done = parkctl("--runs", RUNS, "--tables", TABLES, "--out", file, "--json", figures, "--workers", 2, "--worst", 1)
    assert done.returncode == 0, done.stderr
    return file, json.loads(figures.read_text()), done.stdout


def rows_of(file: Path) -> Any:
    return read_rows(file)[0]


@pytest.mark.live
def test_a_campaign_from_end_to_end(whole: tuple[Path, dict[str, Any], str]) -> None:
    file, figures, said = whole
    rows = rows_of(file)
    assert rows.shape == (RUNS, len(COLUMNS))
    assert rows[:, COLUMNS.index("run")].tolist() == list(range(RUNS))
    assert rows[:, COLUMNS.index("seed")].tolist() == list(range(1_000_000, 1_000_000 + RUNS))
    assert rows[:, COLUMNS.index("right_side")].tolist() == [0, 1] * (RUNS // 2)
    assert (figures["runs"], figures["completed"], figures["cones_touched"]) == (RUNS, RUNS, 0)
    assert figures["runs_per_s"] > 0.0
    clearance = rows[:, COLUMNS.index("min_clearance_m")]
    assert figures["worst_clearance_m"] == clearance.min() > 0.1
    assert figures["quantiles"]["min_clearance_m"]["p50"] == np.median(clearance)
    assert not file.with_name("c.parquet.journal").exists()
    assert "cones touched 0" in said
    assert "final cross-track, mm" in said
    assert "…" not in said, "no figure is cut short"


@pytest.mark.live
def test_the_worst_run_is_the_same_through_real_frames_and_has_its_pictures(
    whole: tuple[Path, dict[str, Any], str],
) -> None:
    file, figures, said = whole
    (worst,) = figures["worst"]
    assert worst["same"]
    assert worst["seed"] == figures["worst_seed"]
    assert worst["min_clearance_m"] == figures["worst_clearance_m"]
    folder = file.parent / "c-worst" / f"seed-{worst['seed']}"
    for picture in ("swept_body.png", "signals.png"):
        assert (folder / picture).read_bytes().startswith(b"\x89PNG")
    assert json.loads((folder / "figures.json").read_text())["exam"]["completed"]
    assert "the same in lock-step" in said


@pytest.mark.live
def test_killed_and_resumed_by_another_number_of_workers_it_is_the_same_file(
    whole: tuple[Path, dict[str, Any], str], tmp_path: Path
) -> None:
    file = tmp_path / "k.parquet"
    journal = tmp_path / "k.parquet.journal"
    options = ("--runs", RUNS, "--tables", TABLES, "--out", file, "--workers", 1)
    process = subprocess.Popen([*PARKCTL, *campaign(*options)], cwd=ROOT, stderr=subprocess.PIPE)
    begun_s = time.monotonic()
    first_size = 0
    while time.monotonic() - begun_s < 240.0 and process.poll() is None:
        size = journal.stat().st_size if journal.exists() else 0
        first_size = first_size or size
        if first_size and size > first_size:
            break
        time.sleep(0.002)
    process.kill()
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    assert not file.exists()
    with journal.open("ab") as torn:
        torn.write(b"RUN1\x07\x00")
    half = Journal.resume(journal)
    kept = len(half.rows())
    half.close()
    assert 0 < kept < RUNS
    again = parkctl("--resume", file, "--workers", 2, "--json", tmp_path / "k.json")
    assert again.returncode == 0, again.stderr
    assert np.array_equal(rows_of(file), rows_of(whole[0]))
    assert not journal.exists()
    once_more = parkctl("--resume", file)
    assert once_more.returncode == 0
    assert f"is complete, {RUNS} runs" in once_more.stderr


# ------------------------------------------------------------------------------------------------------ a Dask cluster


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture
def cluster() -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """A real scheduler and two workers on 127.0.0.1, each a process of its own, without dashboards."""
    pytest.importorskip("distributed", reason="needs dask.distributed (parkctl[cluster])")
    address = f"tcp://127.0.0.1:{free_port()}"
    environment = {**os.environ, "DASK_DISTRIBUTED__ADMIN__LOG_LEVEL": "error"}
    quiet: dict[str, Any] = {
        "cwd": ROOT, "env": environment, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL,
    }  # fmt: skip
    module = [sys.executable, "-P", "-m"]
    where = ["--host", "127.0.0.1", "--no-dashboard"]
    port = address.rpartition(":")[2]
    scheduler = subprocess.Popen([*module, "distributed.cli.dask_scheduler", *where, "--port", port], **quiet)
    worker = [*module, "distributed.cli.dask_worker", address, *where, "--nthreads", "1", "--no-nanny"]
    workers = [subprocess.Popen([*worker, "--death-timeout", "60"], **quiet) for _ in range(2)]
    try:
        yield address, workers
    finally:
        for process in (*workers, scheduler):
            process.kill()
            process.wait()


@pytest.mark.live
def test_a_dask_cluster_that_loses_a_worker_gives_the_same_rows(
    whole: tuple[Path, dict[str, Any], str], cluster: tuple[str, list[subprocess.Popen[bytes]]], tmp_path: Path
) -> None:
    address, workers = cluster
    file = tmp_path / "d.parquet"
    journal = tmp_path / "d.parquet.journal"
    options = ("--runs", RUNS, "--tables", TABLES, "--out", file, "--scheduler", address)
    process = subprocess.Popen([*PARKCTL, *campaign(*options)], cwd=ROOT, stderr=subprocess.PIPE, text=True)
    begun_s = time.monotonic()
    first_size = 0
    while time.monotonic() - begun_s < 240.0 and process.poll() is None:
        size = journal.stat().st_size if journal.exists() else 0
        first_size = first_size or size
        if first_size and size > first_size:
            break
        time.sleep(0.002)
    workers[0].kill()
    was_running = process.poll() is None
    _, complaint = process.communicate(timeout=240)
    assert process.returncode == 0, complaint
    assert was_running, "the campaign was over before the worker was killed: nothing was tried"
    assert np.array_equal(rows_of(file), rows_of(whole[0]))


# ------------------------------------------------------------------------------------------------------------ mistakes


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ((), "name how many runs with --runs N"),
        (("--runs", 0), r"--runs 0: must be from 1 to"),
        (("--runs", -3), r"--runs -3: must be from 1 to"),
        (("--runs", "many"), "argument --runs: invalid int value: 'many'"),
        (("--runs", 5, "--scenario", "nowhere"), "no scenario is called 'nowhere'"),
        (("--runs", 5, "--vehicle", "tank.toml"), "tank.toml: no such vehicle file"),
        (("--runs", 5, "--law", "mpc"), "argument --law: invalid choice: 'mpc'"),
        (("--runs", 5, "--seed", -1), "--seed -1: must not be negative"),
        (("--runs", 5, "--workers", 0), "--workers 0: must be from 1"),
        (("--runs", 5, "--worst", -1), "--worst -1: must not be negative"),
        (("--runs", 5, "--workers", 2, "--scheduler", "tcp://127.0.0.1:1"), "a cluster brings its own"),
        (("--runs", 5, "--out", "{tmp}/no/c.parquet"), "there is no folder"),
        (("--runs", 5, "--out", "{tmp}"), "is a folder; name a file"),
        (("--runs", 5, "--tables", "{tmp}/none"), "none"),
        (("--resume", "{tmp}/none.parquet"), "there is neither this file nor none.parquet.journal"),
        (("--resume", "{tmp}"), "is a folder"),
        (("--resume", "{tmp}/x.parquet", "--out", "{tmp}/y.parquet"), "leave --out out"),
    ],
)
def test_a_mistake_is_one_line(
    options: tuple[object, ...], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status = cli.main(campaign(*[str(option).replace("{tmp}", str(tmp_path)) for option in options]))
    complaint = capsys.readouterr().err
    assert status == cli.STATUS_USER_ERROR
    assert says in complaint
    assert complaint.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("address", ["nonsense", "tcp://127.0.0.1:9", "127.0.0.1"])
def test_no_scheduler_at_the_address_is_one_line_and_leaves_nothing(
    address: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("distributed", reason="needs dask.distributed (parkctl[cluster])")
    monkeypatch.setattr(work, "CLUSTER_TIMEOUT_S", 1.0)
    options = ("--runs", 2, "--tables", TABLES, "--out", tmp_path / "c.parquet", "--scheduler", address)
    assert cli.main(campaign(*options)) == cli.STATUS_USER_ERROR
    complaint = [line for line in capsys.readouterr().err.splitlines() if line.startswith("parkctl: error")]
    assert len(complaint) == 1
    assert f"--scheduler {address}: no Dask scheduler answers there" in complaint[0]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.live
def test_resuming_something_else_is_refused(
    whole: tuple[Path, dict[str, Any], str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, about = read_rows(whole[0])
    file = tmp_path / "c.parquet"
    Journal.begin(tmp_path / "c.parquet.journal", about).close()
    for option, value, says in (
        ("--seed", "7", "--seed 7: {file} was begun with 1000000; leave --seed out"),
        ("--runs", "9", f"--runs 9: {{file}} was begun with {RUNS}; leave --runs out"),
        ("--scenario", "ideal", "--scenario ideal: {file} was begun with car; leave --scenario out"),
    ):
        assert cli.main(campaign("--resume", file, option, value)) == cli.STATUS_USER_ERROR
        assert says.format(file=file) in capsys.readouterr().err
    for what, named in (("code", "parkctl itself"), ("vehicle", "the vehicle"), ("scenario", "the scenario")):
        changed = {**about, "digest": {**about["digest"], what: "0" * 24}}
        (tmp_path / "c.parquet.journal").unlink()
        Journal.begin(tmp_path / "c.parquet.journal", changed).close()
        assert cli.main(campaign("--resume", file)) == cli.STATUS_USER_ERROR
        assert f"--resume {file}: {named} is no longer what the campaign was begun with" in capsys.readouterr().err
    assert cli.main(campaign("--runs", 3, "--tables", TABLES, "--out", file)) == cli.STATUS_USER_ERROR
    assert f"a campaign was begun there; go on with --resume {file}" in capsys.readouterr().err
