"""`parkctl paper`: what it writes, and one clear line for each mistake."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from sim.data_files import Vehicle
from tools import cli
from tools.design import gains as design_gains
from tools.design import tables
from tools.paper import figures, fit, in_lockstep, loops, rates, sampled_run, study
from tools.paper.fit import STORED
from tools.paper.laws import LAWS
from tools.paper.plant import PRINTED
from tools.paper.sampled_run import SampledRun
from tools.plots import paper_diagrams

GOOD = STORED.read_text(encoding="utf-8")
SVG = '<svg xmlns="http://www.w3.org/2000/svg" width="1" height="1"/>'


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        (r"x_m = \[0.0, 3.81,", "x_m = [3.9, 3.81,", "waypoint 2"),
        (r"x_m = .*\]", "x_m = [0.0, 1.0]", "2 x but 7 y"),
        (r"split_x_m = .*\]", "split_x_m = [3.81, 7.62, 99.0]", "cuts must increase"),
        (r"x_m = \[0.0, 3.81", 'x_m = [0.0, "far"', "list of numbers"),
        (r"kp = .*", "kp = nan", "finite"),
        (r"kd = .*", "", "kd is missing"),
        (r"\[gains\]", "[gains", "line"),
    ],
)
def test_a_wrong_fit_file_is_told_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, says: str
) -> None:
    file = tmp_path / "mine.toml"
    text = re.sub(old, new, GOOD, count=1)
    assert text != GOOD
    file.write_text(text, encoding="utf-8")
    assert cli.main(["paper", "--fit-file", str(file)]) == 2
    error = capsys.readouterr().err.strip()
    assert says in error
    assert "mine.toml" in error
    assert error.count("\n") == 0


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--fit-file", "nowhere.toml"], "nowhere.toml"),
        (["--vehicle", "tank"], "no vehicle is called 'tank'"),
        (["--course", "moon"], "no course is called 'moon'"),
        (["--json", "no/folder/here.json"], "there is no folder"),
        (["--out", "pyproject.toml"], "is a file"),
        (["--out", "tests"], "not of this command"),
    ],
)
def test_mistakes(capsys: pytest.CaptureFixture[str], arguments: list[str], says: str) -> None:
    assert cli.main(["paper", *arguments]) == 2
    error = capsys.readouterr().err.strip()
    assert says in error
    assert error.count("\n") == 0


def test_the_stored_fit_reads_back_as_written() -> None:
    stored = fit.load_fit()
    assert fit.to_toml(stored) == GOOD
    assert stored.provenance["command"] == "parkctl paper --fit"


def test_diagrams_are_drawn(tmp_path: Path) -> None:
    for name in ("figure_6", "figure_8", "figure_9", "figure_10"):
        getattr(paper_diagrams, name)(tmp_path / name)
        assert (tmp_path / f"{name}.png").stat().st_size > 10_000
        assert (tmp_path / f"{name}.svg").read_text().count("<path") > 20
    assert not list(tmp_path.glob(".*"))


def test_the_whole_command_for_another_car(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """All sections and figures on one page without an outside resource; nothing printed stands beside another car."""

    def quick_run(_plant: object, law: object, _track: object, path: object) -> SampledRun:
        none = np.zeros(0)
        return SampledRun(law.name, law.observer.bandwidth_radps, path, 1e-3, 5e-4, 0.4, none, none, none)  # type: ignore[attr-defined,arg-type]

    def quick_pictures(folder: Path, results: object, found: object) -> list[str]:
        names = list(figures.catalogue(results, found))  # type: ignore[arg-type]
        for name in names:
            (folder / f"{name}.svg").write_text(SVG)
        return names

    def shipped_gains(vehicle: Vehicle) -> dict[str, list[list[float]]]:
        folder = tables.SHIPPED_FOLDER / f"{vehicle.name}-ohio"
        texts = {law: (folder / f"gains_{law}.csv").read_text().splitlines()[3:] for law in design_gains.LAWS}
        return {law: [[float(cell) for cell in line.split(",")] for line in lines] for law, lines in texts.items()}

    for module in (
        study,
        rates,
    ):  # four times the step: a quarter of the time, and figures that differ in the 4th digit
        monkeypatch.setattr(module, "STEP_S", 4e-3)
    monkeypatch.setattr(rates, "KICK_STEPS_S", (1e-4, 4e-3))
    monkeypatch.setattr(sampled_run, "run", quick_run)
    monkeypatch.setattr(loops, "highest_stable_bandwidth", lambda *_: 50.0)
    monkeypatch.setattr(figures, "draw_all", quick_pictures)
    monkeypatch.setattr(loops, "EXPLORER_CELLS", 11)
    monkeypatch.setattr(design_gains, "design_gains", shipped_gains)
    monkeypatch.setattr(in_lockstep, "CASES", (("paper", PRINTED, in_lockstep.BUS),))
    monkeypatch.setattr(in_lockstep, "real_parts", lambda _vehicle: {})
    out, file = tmp_path / "out", tmp_path / "paper.json"
    status = cli.main(["paper", "--vehicle", "fusion", "--out", str(out), "--json", str(file)])
    content = json.loads(file.read_text())
    assert status == (0 if all(check["holds"] for check in content["checks"]) else 1)
    for table in ("table5", "table6", "table6_corrected"):
        assert list(content[table]) == list(LAWS)
        for column in content[table].values():
            assert {"max_e_y_m", "rms_e_y_m", "max_steer_rad", "max_steer_rate_radps", "max_cross_track_m"} <= set(
                column
            )
            for cell in column.values():
                assert cell["paper"] is None
                assert isinstance(cell["ours"], float)
    assert content["table4"]["M_kg"]["paper"] is None
    assert content["steering_rates"]["step_that_gives_the_printed_rate_s"] == {"forward": None, "reverse": None}
    assert len(content["firmware_law"]) == 18
    assert [(row["law"], row["direction"]) for row in content["lockstep"]] == [
        ("paper", "forward"),
        ("paper", "reverse"),
    ]
    assert all(row["max_e_y_after_start_m"] < 1e-3 and row["is_complete"] for row in content["lockstep"])
    assert content["table1"]["m"] == {"paper": 4, "ours": 4}
    assert all(content["rear_axle_law"][way]["max_cross_track_m"] <= 1e-3 for way in ("forward", "reverse"))
    page = (out / "index.html").read_text()
    for number in range(1, 20):
        assert f'id="figure_{number:02d}"' in page, number
    for table in range(1, 7):
        assert f"Table {table}" in page
    outside = re.findall(r'(?:src|href)="(?!data:|#)([^"]*)"', page)
    assert not outside
    assert page.count("<iframe") == 1
    assert "srcdoc=" in page
    assert "@import" not in page
    assert "url(" not in page
    assert "the paper has" not in page
    assert json.loads((out / "paper.json").read_text()) == content
    assert "corrected sign, reverse, DOB" in capsys.readouterr().out
