"""The tables as files: fresh where they come with the project, whole or not there, stale once anything changes."""

import json
import re
import shutil

import pytest
from core_support import TABLES

from firmware_py.core.controller import PERIOD_S
from firmware_py.table_file import load_tables
from sim.data_files import load_course, load_scenario, load_vehicle
from sim.errors import UserError
from tools import cli
from tools.design import tables


@pytest.fixture(scope="module")
def report():
    return tables.run_design(load_vehicle("paper"), load_course("ohio"), tables.recorded_numbers(TABLES))


@pytest.mark.parametrize(("vehicle", "course"), tables.SHIPPED)
def test_the_shipped_tables_are_fresh(vehicle, course):
    folder = tables.tables_folder(load_vehicle(vehicle), load_course(course))
    assert folder is not None, "run `parkctl design --update`"
    assert tables.stale_inputs(folder, load_vehicle(vehicle), load_course(course)) == []


def test_made_again_they_are_the_same(report):
    assert tables.differences(tables.table_texts(report), TABLES) == []


def test_a_written_folder_is_what_the_firmware_reads(report, tmp_path):
    folder = tmp_path / "a" / "tables"
    tables.write_tables(report, folder)
    tables.write_tables(report, folder)  # replaces a folder that is there
    assert sorted(file.name for file in folder.iterdir()) == sorted(tables.table_texts(report))
    assert [entry.name for entry in folder.parent.iterdir()] == ["tables"], "nothing half-made is left"
    loaded = load_tables(folder, "right", "car", PERIOD_S)
    assert loaded.vehicle_hash24 == load_vehicle("paper").hash24
    assert loaded.legs[0].length_m == pytest.approx(report.design.path.length_m)
    assert loaded.legs[0].y_m[-1] == pytest.approx(-report.design.path.y_m[-1])


def test_a_folder_that_cannot_be_written_is_one_line(report, tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(UserError, match="cannot be written"):
        tables.write_tables(report, tmp_path / "file" / "tables")


def test_another_car_of_the_same_name_has_no_shipped_tables(tmp_path):
    course = load_course("ohio")
    file = tmp_path / "paper.toml"
    shipped = (TABLES.parents[2] / "dbc" / "vehicles" / "paper.toml").read_text()
    file.write_text(shipped + "\n# another one\n")
    assert tables.tables_folder(load_vehicle(file), course) is None
    overlaid = load_vehicle("paper", load_scenario("ideal").vehicle_overlay)
    assert tables.tables_folder(overlaid, course) is None
    assert tables.tables_folder(load_vehicle("fusion"), load_course("paper")) is None


def test_every_kind_of_change_is_found(report, tmp_path):
    folder = tmp_path / "tables"
    shutil.copytree(TABLES, folder)
    vehicle, course = load_vehicle("paper"), load_course("ohio")
    texts = tables.table_texts(report)
    (folder / "path.csv").write_text(texts["path.csv"].replace("0.01", "0.02", 1))
    (folder / "speed.csv").unlink()
    (folder / "notes.txt").write_text("mine")
    assert tables.stale_inputs(folder, vehicle, course) == ["path.csv", "speed.csv"]
    found = "\n".join(tables.differences(texts, folder))
    assert "path.csv:" in found
    assert "speed.csv: missing" in found
    assert "notes.txt: not one of the tables" in found
    assert tables.stale_inputs(tmp_path / "nowhere", vehicle, course) == ["manifest.toml"]


def test_rounding_is_no_change_but_a_figure_is(report, tmp_path):
    folder = tmp_path / "tables"
    shutil.copytree(TABLES, folder)
    texts = tables.table_texts(report)
    lines = texts["gains_car.csv"].splitlines()
    fields = lines[-1].split(",")
    for relative, expected in ((1e-11, 0), (1e-6, 1)):
        fields[3] = repr(float(lines[-1].split(",")[3]) * (1.0 + relative))
        (folder / "gains_car.csv").write_text("\n".join([*lines[:-1], ",".join(fields)]) + "\n")
        assert len(tables.differences(texts, folder)) == expected


def test_the_command_writes_tables_and_figures(tmp_path, capsys):
    folder, figures = tmp_path / "tables", tmp_path / "design.json"
    arguments = ["design", "--vehicle", "fusion", "--tables", str(folder), "--json", str(figures)]
    assert cli.main(arguments) == 0
    shown = capsys.readouterr().out
    assert "min_clearance_m" in shown
    found = json.loads(figures.read_text())
    for name, of in {"car": found["certificate"], **found["certificate"]["others"]}.items():
        disk, delay = f"{of['min_disk_margin']:.2f}", f"{of['min_delay_margin_samples']:.1f}"
        assert re.search(rf"│{re.escape(name)} *│ *{disk}│ *{delay}│", shown), name
    assert 0.5 < found["gains"]["steering_gain_rate_1pm"] <= 1.5
    assert set(found["path"]) >= {"max_curvature_1pm", "min_clearance_m", "length_m"}
    assert set(found["certificate"]) >= {"min_delay_margin_samples", "min_disk_margin", "all_d_stable", "worst"}
    assert load_tables(folder, "left", "pid+ff", PERIOD_S).vehicle == "fusion"


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--vehicle", "nosuch"], "nosuch"),
        (["--check", "--vehicle", "nosuch"], "no shipped tables for nosuch"),
        (["--update", "--tables", "x"], "leave out --tables"),
        (["--update", "--check"], "not allowed with"),
    ],
)
def test_a_mistake_is_one_line_and_status_2(arguments, says, capsys):
    assert cli.main(["design", *arguments]) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1
