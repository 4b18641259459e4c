"""The tables' loader refuses what is missing, malformed, changed or stale, in one line that says what to run."""

import hashlib
import shutil

import pytest
from core_support import ROOT, TABLES

from firmware_py.core.controller import PERIOD_S
from firmware_py.core.tables import LAW_CAR, LAW_PLAIN
from firmware_py.errors import UserError
from firmware_py.table_file import FORMAT, load_tables


@pytest.fixture
def folder(tmp_path):
    copy = tmp_path / "tables"
    shutil.copytree(TABLES, copy)
    return copy


def refused(folder, law="car", dbc_folder=None):
    with pytest.raises(UserError) as caught:
        load_tables(folder, "left", law, PERIOD_S, dbc_folder)
    text = str(caught.value)
    assert "\n" not in text
    assert text.endswith("run `parkctl design --update`")
    return text


def rewrite(folder, name, edit):
    """Change a table as somebody would who also mends the manifest, so that the change itself is judged."""
    file = folder / name
    before = file.read_bytes()
    file.write_text(edit(before.decode()))
    manifest = folder / "manifest.toml"
    old, new = (hashlib.sha256(data).hexdigest() for data in (before, file.read_bytes()))
    manifest.write_text(manifest.read_text().replace(old, new))


def test_the_shipped_tables_load_and_are_fresh():
    tables = load_tables(TABLES, "left", "car", PERIOD_S, ROOT / "dbc")
    assert (tables.vehicle, tables.course, tables.law) == ("paper", "ohio", LAW_CAR)
    assert load_tables(TABLES, "left", "pid+ff", PERIOD_S).law == LAW_PLAIN


def test_missing_folder_and_missing_file(folder, tmp_path):
    assert "no such folder" in refused(tmp_path / "nowhere")
    (folder / "speed.csv").unlink()
    assert "speed.csv: cannot be read" in refused(folder)


@pytest.mark.parametrize("name", ["path.csv", "speed.csv", "gains_car.csv", "car.toml"])
def test_a_table_changed_by_hand_is_refused(folder, name):
    file = folder / name
    file.write_text(file.read_text().replace("1", "2", 1))
    assert f"{name}: changed since" in refused(folder)


def test_a_changed_source_makes_the_tables_stale(folder, tmp_path):
    dbc = tmp_path / "dbc"
    shutil.copytree(ROOT / "dbc", dbc)
    load_tables(folder, "left", "car", PERIOD_S, dbc)
    vehicle = dbc / "vehicles" / "paper.toml"
    vehicle.write_text(vehicle.read_text() + "\n# one more line\n")
    assert "tables are stale" in refused(folder, dbc_folder=dbc)


def test_malformed_manifest(folder):
    manifest = folder / "manifest.toml"
    text = manifest.read_text()
    manifest.write_text(text.replace(f"format = {FORMAT}", "format = 9"))
    assert "format 9" in refused(folder)
    manifest.write_text(text.replace("vehicle_hash24", "vehicle_hash"))
    assert "key vehicle_hash24 is missing" in refused(folder)
    manifest.write_text("= nothing")
    assert "not a TOML file" in refused(folder)


def test_malformed_rows(folder):
    rewrite(folder, "path.csv", lambda text: text.replace("\n", ",7\n", 40))
    assert "path.csv: " in refused(folder)


@pytest.mark.parametrize("bad", ["nan", "inf", "1.0e999", "x", ""])
def test_a_value_that_is_no_finite_number(folder, bad):
    def edit(text):
        lines = text.splitlines()
        lines[-1] = ",".join([bad, *lines[-1].split(",")[1:]])
        return "\n".join(lines) + "\n"

    rewrite(folder, "speed.csv", edit)
    assert "finite numbers" in refused(folder)


def test_wrong_columns(folder):
    rewrite(folder, "gains_car.csv", lambda text: text.replace(",kp,", ",kq,"))
    assert "columns are" in refused(folder)


def test_speeds_of_the_schedule_must_be_the_same_in_both_directions(folder):
    rewrite(folder, "gains_car.csv", lambda text: "\n".join(text.splitlines()[:-1]) + "\n")
    assert "directions +1 and -1" in refused(folder)


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("wheelbase_m", "0.0", "wheelbase_m is 0.0, must be a number from 1.0 to 10.0"),
        ("max_road_wheel_rate_radps", '"fast"', "max_road_wheel_rate_radps is fast"),
        ("pose_latency_samples", "47", "pose_latency_samples is 47, must be a number from 0 to 31"),
    ],
)
def test_values_of_the_car_out_of_range(folder, key, value, says):
    def edit(text):
        return "\n".join(f"{key} = {value}" if line.startswith(key) else line for line in text.splitlines())

    rewrite(folder, "car.toml", edit)
    assert says in refused(folder)


def test_unknown_key_of_the_car(folder):
    rewrite(folder, "car.toml", lambda text: text + "\nwheel_base_m = 4.0\n")
    assert "unknown key wheel_base_m" in refused(folder)
