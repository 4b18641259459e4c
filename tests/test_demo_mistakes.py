"""Mistakes of the user: one line that names the culprit, exit status 2, nothing started, nothing written."""

from __future__ import annotations

import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from sim.data_files import FOLDERS
from tools import cli

PAPER = (FOLDERS["vehicle"] / "paper.toml").read_text()
OHIO = (FOLDERS["course"] / "ohio.toml").read_text()
CAR = (FOLDERS["scenario"] / "car.toml").read_text()


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def no_children(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Any process that is started fails the test."""

    def refuse(*arguments: object, **_options: object) -> None:
        raise AssertionError(f"a process was started: {arguments}")

    with monkeypatch.context() as patch:
        patch.setattr(subprocess, "Popen", refuse)
        yield


def refused(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """Run the demo, which must refuse; return its one line. Nothing may be left in the folder but what was there."""
    before = sorted(Path().rglob("*"))
    assert cli.main(["demo", *arguments]) == 2
    error = capsys.readouterr().err
    assert error.startswith("parkctl: error: ")
    assert error.count("\n") == 1, error
    assert sorted(Path().rglob("*")) == before
    return error


@pytest.mark.parametrize("kind", ["vehicle", "course", "scenario"])
@pytest.mark.parametrize("name", ["nosuch", "nosuch.toml", "./folder/nosuch.toml"])
@pytest.mark.usefixtures("no_children")
def test_a_file_that_is_not_there(kind: str, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert "nosuch" in refused([f"--{kind}", name], capsys)


@pytest.mark.parametrize(
    ("kind", "content", "says"),
    [
        ("vehicle", "wheelbase", "mine.toml"),
        ("vehicle", PAPER.replace("wheelbase_m =", "wheelbase ="), "wheelbase"),
        ("vehicle", PAPER + '\nwings = { nominal = 2.0, low = 2.0, high = 2.0, unit = "1", source = "x" }\n', "wings"),
        ("vehicle", PAPER.replace('unit = "kg"', 'unit = "lb"'), "lb"),
        ("vehicle", PAPER.replace("wheelbase_m = { nominal = 4.0", "wheelbase_m = { nominal = -4.0"), "wheelbase_m"),
        ("vehicle", PAPER.replace("body_width_m = { nominal = 2.0", "body_width_m = { nominal = 2.8"), "body_width_m"),
        ("course", "[[cones", "mine.toml"),
        ("course", OHIO.replace("cone_radius_m = 0.10", "cone_radius_m = -1.0"), "cone_radius_m"),
        ("course", OHIO.replace("cone_radius_m", "cone_size_m"), "cone_size_m"),
        ("scenario", CAR.replace("steering_gain", "steering_gian"), "steering_gian"),
        ("scenario", CAR.replace("position_noise_m = 0.01", 'position_noise_m = "much"'), "position_noise_m"),
        ("scenario", "\x00", "mine.toml"),
    ],
)
@pytest.mark.usefixtures("no_children")
def test_a_file_that_is_wrong(
    kind: str, content: str, says: str, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (here / "mine.toml").write_text(content)
    assert says in refused([f"--{kind}", "mine.toml"], capsys)


@pytest.mark.usefixtures("no_children")
def test_a_car_that_does_not_fit_between_the_cones(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wide = PAPER
    for name in ("body_width_m", "mirror_width_m"):
        line = next(line for line in PAPER.splitlines() if line.startswith(name))
        wide = wide.replace(line, f'{name} = {{ nominal = 2.6, low = 2.6, high = 2.6, unit = "m", source = "a bus" }}')
    (here / "bus.toml").write_text(wide)
    error = refused(["--vehicle", "bus.toml"], capsys)
    assert "fit" in error
    assert "rear-left" in error or "rear-right" in error or "front-" in error


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--seed", "-1"], "--seed"),
        (["--json", "nowhere/figures.json"], "nowhere"),
        (["--json", "."], "is a folder"),
        (["--out", "taken"], "taken"),
        (["--tables", "notables", "-c", "28240"], "notables"),
        (["--lockstep", "-c", "29500"], "--lockstep"),
        (["-i", "socketcan"], "name the channel"),
        (["-i", "virtual", "-c", "0"], "virtual"),
        (["-c", "can0"], "-c can0"),
        (["-i", "socketcan", "-c", "vcan97"], "vcan97"),
        (["-i", "nosuch", "-c", "0"], "nosuch"),
        (["-c", "70000"], "70000"),
    ],
)
@pytest.mark.usefixtures("no_children")
def test_an_option_that_is_wrong(
    arguments: list[str], says: str, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (here / "taken").write_text("a file")
    assert says in refused(arguments, capsys)


@pytest.mark.usefixtures("no_children")
def test_all_ports_taken(capsys: pytest.CaptureFixture[str]) -> None:
    with ExitStack() as stack:
        for port in range(28200, 28208):
            taken = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            taken.bind(("127.0.0.1", port))
        error = refused(["-c", "28200"], capsys)
    assert "28200 to 28207" in error


@pytest.mark.parametrize("process", ["drive", "emulate", "operate"])
@pytest.mark.parametrize("content", [None, "this is no DBC"])
def test_a_dbc_that_is_missing_or_malformed(process: str, content: str | None, here: Path) -> None:
    if content is not None:
        (here / "my.dbc").write_text(content)
    answer = subprocess.run(
        [sys.executable, "-m", "tools.cli", process, "-i", "loopbus", "-c", "28220", "--dbc", "my.dbc"]
        + (["--auto"] if process == "operate" else []),
        capture_output=True,
        text=True,
        check=False,
        stdin=subprocess.DEVNULL,
        timeout=60,
    )
    assert answer.returncode == 2, answer.stderr
    assert "my.dbc" in answer.stderr
    assert answer.stderr.startswith("parkctl: error: ")
    assert answer.stderr.count("\n") == 1, answer.stderr


def test_operating_by_keys_needs_a_terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stdin, "isatty", lambda: False, raising=False)
    assert cli.main(["operate", "-c", "28230"]) == 2
    assert "--auto" in capsys.readouterr().err
