"""The paper's laws as tables: fresh in every shipped folder, the path for the rear axle, what the loader refuses."""

from __future__ import annotations

import hashlib
import shutil
from pathlib import Path

import numpy as np
import pytest
from core_support import ROOT, TABLES

from firmware_py.core.controller import PERIOD_S
from firmware_py.core.tables import LAW_PAPER
from firmware_py.errors import UserError
from firmware_py.table_file import PAPER_COLUMNS, load_tables
from sim.data_files import load_course, load_scenario, load_vehicle
from tools import design_cmd
from tools.design import gains, tables
from tools.paper import firmware_tables, fit
from tools.paper.firmware_law import NAMES, tables_of
from tools.paper.laws import Law
from tools.paper.path_study import AS_PRINTED, all_variants
from tools.paper.plant import FORWARD, car_of
from tools.paper.track import Track, project, track_of

STUDY = firmware_tables.study_folder()


@pytest.fixture(scope="module")
def printed() -> Track:
    return track_of(all_variants(fit.load_fit().waypoints)[AS_PRINTED].path, FORWARD)


# ------------------------------------------------------------------------------------------------------------- fresh


@pytest.mark.parametrize(("vehicle", "course"), tables.SHIPPED)
def test_the_shipped_laws_are_what_the_fit_gives(vehicle: str, course: str) -> None:
    folder = tables.SHIPPED_FOLDER / f"{vehicle}-{course}"
    for name, text in firmware_tables.law_texts(load_vehicle(vehicle)).items():
        assert not [line for line in tables.differences({name: text}, folder) if line.startswith(name)]


def test_the_papers_own_manoeuvre_is_fresh_and_the_same_when_made_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Path, speeds, car and the paper's laws; the gains of the other laws have the design's own tests."""
    monkeypatch.setattr(gains, "design_gains", lambda _vehicle: {})
    vehicle, course = firmware_tables.study_pair()
    assert tables.tables_folder(vehicle, course) == STUDY, "run `parkctl design --update`"
    texts = tables.table_texts(firmware_tables.study_report(vehicle, course))
    assert set(texts) >= {"path.csv", "speed.csv", "car.toml", "gains_paper.csv", "gains_dob.csv", "gains_pid.csv"}
    found = tables.differences(texts, STUDY)
    assert found == ["gains_car.csv: not one of the tables", "gains_pid_ff.csv: not one of the tables"]


def test_design_check_looks_at_them_too(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(gains, "design_gains", lambda _vehicle: {})
    assert design_cmd._paper_study(update=False) == 1  # without the gains
    assert "paper-study: gains_car.csv: not one of the tables" in capsys.readouterr().out


# -------------------------------------------------------------------------------------------------------------- path


def test_the_centre_of_gravity_goes_along_the_papers_path_while_the_rear_axle_is_on_the_table(printed: Track) -> None:
    table = load_tables(STUDY, "left", "paper", PERIOD_S)
    assert table.law == LAW_PAPER
    reference, leg = table.reference, table.legs[0]
    x, y, yaw = (np.array(column[0]) for column in reference[1:])
    nearest = np.array([np.argmin(np.hypot(printed.x_m - a, printed.y_m - b)) for a, b in zip(x, y, strict=True)])
    found = project(printed, x, y, printed.station_m[nearest])
    assert np.abs(found.cross_track_error_m).max() < 5e-6
    assert np.abs(yaw - found.yaw_rad).max() < 2e-5
    assert (x[0], y[0]) == pytest.approx((printed.x_m[0], printed.y_m[0]), abs=1e-9)
    assert (x[-1], y[-1]) == pytest.approx((printed.x_m[-1], printed.y_m[-1]), abs=1e-6)
    assert leg.yaw_rad[0] == 0.0  # eq. 20
    # In reverse the same points, from the other end.
    assert reference.x_m[1] == pytest.approx(reference.x_m[0][::-1], abs=1e-12)
    assert reference.yaw_rad[1] == pytest.approx(reference.yaw_rad[0][::-1], abs=1e-12)


def test_the_rear_axles_path_is_one(printed: Track) -> None:
    """It turns by its curvature, runs where it points, and its slope is that of its curvature."""
    path, _ = firmware_tables.rear_axle_path(printed, 2.0)
    h = path.step_m
    middle = slice(1, -1)

    def central(values: np.ndarray) -> np.ndarray:
        return np.asarray(values[2:] - values[:-2]) / (2.0 * h)

    assert central(path.x_m) == pytest.approx(np.cos(path.yaw_rad[middle]), abs=2e-5)
    assert central(path.y_m) == pytest.approx(np.sin(path.yaw_rad[middle]), abs=2e-5)
    assert central(path.yaw_rad) == pytest.approx(path.curvature_1pm[middle], abs=5e-5)
    assert central(path.curvature_1pm) == pytest.approx(path.curvature_slope_1pm2[middle], abs=2e-3)


def test_the_right_side_is_the_mirror() -> None:
    left, right = (load_tables(STUDY, side, "paper", PERIOD_S).reference for side in ("left", "right"))
    assert right.x_m == left.x_m
    assert right.y_m == tuple(tuple(-y for y in column) for column in left.y_m)
    assert right.yaw_rad == tuple(tuple(-yaw for yaw in column) for column in left.yaw_rad)


# ------------------------------------------------------------------------------------------------------------ loading


@pytest.mark.parametrize("law", NAMES)
def test_a_law_reads_back_as_it_was_made(law: str) -> None:
    vehicle = load_vehicle("fusion")
    made = tables_of(car_of(vehicle), Law(NAMES[law], fit.gains_for(car_of(vehicle), fit.load_fit())))
    read = load_tables(tables.SHIPPED_FOLDER / "fusion-ohio", "left", law, PERIOD_S).paper
    assert (read.uses_pid, read.uses_observer) == (made.uses_pid, made.uses_observer)
    assert read.speed_grid_mps == pytest.approx(made.speed_grid_mps)
    for ours, theirs in zip(read.row, made.row, strict=True):
        for row, other in zip(ours, theirs, strict=True):
            assert row[0] == pytest.approx(other[0])
            assert row[1:4] == pytest.approx(other[1:4] if made.uses_pid else (0.0,) * 3)
            assert row[4:] == pytest.approx(other[4:] if made.uses_observer else (0.0,) * 2)
    if made.uses_observer:
        assert read[3:7] == pytest.approx(made[3:7])


def test_the_other_laws_carry_an_empty_one() -> None:
    table = load_tables(TABLES, "left", "car", PERIOD_S)
    assert (table.paper.uses_pid, table.paper.uses_observer, table.reference.ahead_m) == (0, 0, 0.0)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    copy = tmp_path / "tables"
    shutil.copytree(TABLES, copy)
    return copy


def refused(folder: Path, column: str | None, value: str, rows: slice = slice(None)) -> str:
    """Put a value into a column of gains_paper.csv, mend the manifest, and return the line that refuses it."""
    file = folder / "gains_paper.csv"
    before = file.read_bytes()
    comments, lines = before.decode().splitlines()[:3], [line.split(",") for line in before.decode().splitlines()[3:]]
    if column is not None:
        for line in lines[rows]:
            line[PAPER_COLUMNS.index(column)] = value
    else:
        del lines[rows]
    file.write_text("\n".join([*comments, *(",".join(line) for line in lines)]) + "\n")
    manifest = folder / "manifest.toml"
    old, new = (hashlib.sha256(data).hexdigest() for data in (before, file.read_bytes()))
    manifest.write_text(manifest.read_text().replace(old, new))
    with pytest.raises(UserError) as caught:
        load_tables(folder, "left", "paper", PERIOD_S)
    text = str(caught.value)
    assert text.startswith(str(file))
    assert text.endswith("run `parkctl design --update`")
    assert "\n" not in text
    return text


@pytest.mark.parametrize(
    ("column", "value", "rows", "says"),
    [
        ("kp", "-1", slice(3, 4), "row 4: kp is -1, must not be negative"),
        ("preview_m", "-0.1", slice(0, 1), "row 1: preview_m is -0.1, must not be negative"),
        ("kd", "nan", slice(5, 6), "row 6 does not hold 12 finite numbers"),
        ("ki", "much", slice(0, 1), "row 1 does not hold 12 finite numbers"),
        ("inverse_pole", "1.0", slice(2, 3), "row 3: inverse_pole is 1, must be between -1 and 1"),
        ("q_a2", "0.1", slice(9, 10), "row 10: q_b1 to q_a2 must be the same in every row"),
        ("q_a2", "1.2", slice(None), "q_b1 to q_a2 must be a stable filter of gain 1"),
        ("q_b1", "0.9", slice(None), "q_b1 to q_a2 must be a stable filter of gain 1"),
        ("speed_mps", "0.05", slice(0, 4), "speed_mps must increase, none below 0, in direction +1"),
        ("speed_mps", "-0.05", slice(0, 1), "speed_mps must increase, none below 0, in direction +1"),
        ("direction", "1", slice(-1, None), "speed_mps must increase"),
        (None, "", slice(-1, None), "directions +1 and -1 must have the same speeds and no other rows"),
    ],
)
def test_bad_rows_of_the_papers_law(folder: Path, column: str | None, value: str, rows: slice, says: str) -> None:
    assert says in refused(folder, column, value, rows)


def test_a_missing_table_and_wrong_columns(folder: Path) -> None:
    file = folder / "gains_dob.csv"
    manifest = folder / "manifest.toml"
    text = file.read_text()
    file.write_text(text.replace(",kp,", ",kq,"))
    manifest.write_text("".join(line for line in manifest.read_text().splitlines(True) if "gains_dob" not in line))
    with pytest.raises(UserError, match=r"gains_dob\.csv: columns are .*kq.*, must be "):
        load_tables(folder, "left", "dob", PERIOD_S)
    file.unlink()
    with pytest.raises(UserError, match=r"gains_dob\.csv: cannot be read"):
        load_tables(folder, "left", "dob", PERIOD_S)


def test_the_scenario_names_its_course_and_overlays_the_car() -> None:
    scenario = load_scenario("paper")
    assert scenario.course == load_course("paper").name
    assert (scenario.plant.model, scenario.plant.reverse_sign) == ("eq11", "corrected")
    car = load_vehicle("paper", scenario.vehicle_overlay)
    assert (car.steering_lag_s, car.pose_latency_samples, car.command_latency_samples) == (0.0, 0.0, 0.0)
    guide = (ROOT / "sim" / "scenarios" / "README.md").read_text()
    assert "eq11" in guide
