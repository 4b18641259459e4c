"""`parkctl demo --lockstep` from the command line to the run's folder."""

from __future__ import annotations

import json
import math
import shutil
from functools import partial
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from PIL import Image

from sim.body import clearance_m, outline_of
from sim.data_files import FOLDERS, load_course, load_vehicle
from sim.errors import UserError
from tools import cli, lockstep
from tools.estimates import load_estimates
from tools.figures import FORWARD, REVERSE, load_path, load_truth, split_legs


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def demo(*arguments: str, out: str = "run", expected: int = 0) -> Any:
    """Run it; return its figures."""
    assert cli.main(["demo", "--lockstep", "--out", out, *arguments]) == expected
    return json.loads((Path(out) / "figures.json").read_text())


def test_a_passed_test_and_what_it_leaves(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    figures = demo("--side", "right", "--json", "run/mine.json")
    shown = capsys.readouterr()
    assert shown.err == ""
    assert "PASS" in shown.out
    assert json.loads((here / "run" / "mine.json").read_text()) == figures
    assert (figures["passed"], figures["score"], figures["cones_touched"], figures["why"]) == (True, 100, 0, None)
    assert figures["side"] == "right"
    assert figures["loop"]["scheduler"] == "virtual time"
    assert figures["loop"]["wake_p99_us"] is None  # nothing is late in virtual time, and nothing is claimed
    for name in ("swept_body.png", "signals.png"):
        with Image.open(Path("run") / name) as picture:
            assert min(picture.size) > 600
            assert len(picture.convert("RGB").getcolors(1 << 24) or []) > 100, "the picture is not empty"
    ids = {message.arbitration_id for message in can.LogReader(Path("run") / "bus.log")}
    assert {0x10, 0x20, 0x30, 0x200, 0x600} <= ids
    assert {file.name for file in (Path("run") / "tables").iterdir()} == {f.name for f in _shipped("paper").iterdir()}


def test_the_same_seed_gives_the_same_run_and_another_seed_another() -> None:
    first, again = demo("--seed", "5", "--no-plots", out="a"), demo("--seed", "5", "--no-plots", out="b")
    other = demo("--seed", "6", "--no-plots", out="c")
    assert first == again
    assert (Path("a") / "truth.csv").read_bytes() == (Path("b") / "truth.csv").read_bytes()
    assert (Path("a") / "bus.log").read_bytes() == (Path("b") / "bus.log").read_bytes()
    assert first["legs"] != other["legs"]


def test_the_figures_agree_with_the_plants_truth() -> None:
    """Clearance and duration computed anew from the true poses, apart from the examiner and the figures' code."""
    figures = demo("--no-plots")
    truth = load_truth(Path("run") / "truth.csv")
    vehicle, course = load_vehicle("paper"), load_course("ohio")
    outline, cones = outline_of(vehicle), course.cones_xy("left")
    nearest = min(
        clearance_m(outline, *pose, cones)[0] for pose in zip(truth.x_m, truth.y_m, truth.yaw_rad, strict=True)
    )
    assert min(leg["min_clearance_m"] for leg in figures["legs"]) == pytest.approx(nearest, abs=1e-9)
    moving_s = 0.01 * int((truth.speed_mps != 0.0).sum())
    assert sum(leg["duration_s"] for leg in figures["legs"]) == pytest.approx(moving_s, abs=0.05)
    stop = course.stop_pose(vehicle, "left")
    forward = figures["legs"][0]
    at_rest = int((truth.speed_mps > 0.0).nonzero()[0][-1]) + 1
    ahead = truth.x_m[at_rest] - stop.x_m
    assert forward["final_station_error_m"] == pytest.approx(ahead, abs=1e-4)  # the path ends along x
    assert forward["final_cross_track_m"] == pytest.approx(truth.y_m[at_rest] - stop.y_m, abs=1e-4)
    assert forward["final_heading_error_rad"] == pytest.approx(truth.yaw_rad[at_rest], abs=1e-4)
    assert math.isclose(forward["max_speed_mps"], float(truth.speed_mps.max()))


def test_a_car_that_stands_a_metre_off_does_not_start(
    here: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lockstep, "run_lockstep", partial(lockstep.run_lockstep, longest_s=3.0))
    scenario = (FOLDERS["scenario"] / "car.toml").read_text() + "\n[start]\nahead_m = -1.0\n"
    (here / "off.toml").write_text(scenario)
    figures = demo("--scenario", "off.toml", expected=1)
    assert capsys.readouterr().err.startswith("parkctl: not passed: the car did not start: the car does not stand at")
    assert figures["legs"] == []
    assert figures["passed"] is False
    assert (Path("run") / "swept_body.png").is_file()


def test_a_car_of_the_users_own_gets_tables_of_its_own(here: Path) -> None:
    text = (FOLDERS["vehicle"] / "paper.toml").read_text().replace('name = "paper"', 'name = "mine"')
    before, after = (f"wheelbase_m = {{ nominal = {v}, low = 3.8, high = 4.2" for v in ("4.0", "3.9"))
    assert before in text
    (here / "mine.toml").write_text(text.replace(before, after))
    figures = demo("--vehicle", "mine.toml", "--no-plots")
    assert figures["vehicle"] == "mine"
    assert figures["passed"] is True
    assert (Path("run") / "tables" / "path.csv").is_file()
    assert 'vehicle = "mine"' in (Path("run") / "tables" / "manifest.toml").read_text()


def test_tables_for_another_car_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["demo", "--lockstep", "--vehicle", "fusion", "--tables", str(_shipped("paper"))]) == 2
    error = capsys.readouterr().err
    assert "made for another car than fusion" in error
    assert error.count("\n") == 1
    assert not Path("runs").exists()


def _shipped(vehicle: str) -> Path:
    import firmware_py  # noqa: PLC0415

    return Path(firmware_py.__file__).parent / "tables" / f"{vehicle}-ohio"


def test_a_run_keeps_the_tables_that_it_began_with(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tables that are made anew while a car drives by the old ones must not be mixed into its figures."""
    shutil.copytree(_shipped("paper"), "mine")
    plain_run = lockstep.run_lockstep

    def remade_meanwhile(*arguments: Any, **options: Any) -> lockstep.LockstepRun:
        shutil.rmtree("mine")
        return plain_run(*arguments, **options)

    monkeypatch.setattr(lockstep, "run_lockstep", remade_meanwhile)
    assert demo("--tables", "mine", "--no-plots")["passed"] is True


def test_an_interrupt_leaves_no_folder(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def interrupt(*_arguments: Any, **_options: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(lockstep, "run_lockstep", interrupt)
    assert cli.main(["demo", "--lockstep"]) == 130
    assert capsys.readouterr().err == "parkctl: interrupted\n"
    assert not list(Path().rglob("run.json"))


def test_what_the_controller_believed_is_read_from_the_bus_log() -> None:
    """On the picture the estimate lies where the car truly is on its path, in both legs, and nearly always within."""
    demo("--seed", "3", "--no-plots")
    truth, path = load_truth(Path("run") / "truth.csv"), load_path(_shipped("paper"), "left")
    estimates = load_estimates(Path("run") / "bus.log", lockstep.DBC, path.length_m)
    assert set(estimates) == {FORWARD, REVERSE}
    for leg in split_legs(truth, path, None):
        believed, station_m = estimates[leg.direction], leg.on_path.station_m
        order = np.argsort(station_m)
        true_m = np.interp(believed.station_m, station_m[order], leg.on_path.cross_track_error_m[order])
        within = np.abs(believed.cross_track_error_m - true_m) <= 2.0 * believed.cross_track_sigma_m
        assert len(within) > 140
        assert np.mean(within) > 0.85


def test_what_is_no_frame_of_ours_in_a_bus_log_is_passed_over_and_no_log_is_one_line() -> None:
    Path("bus.log").write_text("(1.0) vcan0 204#00\n(1.1) vcan0 123#R\n(1.2) vcan0 204##1AA\n(1.3) vc")
    assert load_estimates(Path("bus.log"), lockstep.DBC, 12.0) == {}
    Path("bus.log").write_text("(1.0) vcan0 204#00\u00e4\n")
    with pytest.raises(UserError) as error:
        load_estimates(Path("bus.log"), lockstep.DBC, 12.0)
    assert str(error.value) == "bus.log: cannot be read: not a bus log"
