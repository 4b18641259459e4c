"""`parkctl parameter-space` and its explorer page: what a user gives, gets, and sees move."""

import html
import json
import math
import re
import shutil
import subprocess

import control
import numpy as np
import pytest

from sim.errors import UserError
from tools import cli
from tools.design.parameter_space import (
    DRegion,
    Window,
    admissible_region,
    boundaries,
    case_of,
    closed_loop_poles,
    plane_of,
)
from tools.design.parameter_space.command import CONTENT
from tools.design.parameter_space.explorer import Units, explorer_page
from tools.plots import parameter_space as plots

SPEEDS = (0.3, 0.5, 1.0)
WINDOW = Window(-1.0, 21.0, -1.0, 34.0)
CELLS = 41
DELAYED = control.tf([2.0], np.poly([-1.0, -0.4, -3.0]))


def car(speed_mps, lag_s=0.1):
    """From steering to the error ahead, with the rack's lag."""
    v = speed_mps
    return control.tf([0.5 * v * v, v * v], [4.0 * lag_s, 4.0, 0.0, 0.0])


def car_page():
    return explorer_page(
        "Car </script> & rack",
        car,
        SPEEDS,
        [plane_of("kp-kd"), plane_of("kp-ki", 20.0)],
        DRegion(0.4, 0.5, 30.0),
        sigma_per_metre=True,
        windows={"kp-kd": WINDOW, "kp-ki": Window(0.0, 80.0, 0.0, 60.0)},
        points={"kp-ki": (30.0, 10.0)},
        box={"lag_s": (0.05, 0.15)},
        cells=CELLS,
        units=Units("rad", "m"),
    )


def delayed_page():
    region = DRegion(0.1, 0.35, zeta_within_radps=4.0)
    return explorer_page("Delay", lambda _: DELAYED, [1.0], [plane_of("kp-ki")], region, delay_s=0.6, cells=CELLS)


PROBE = """
<script>
const seen = [];
function note(name) {
  const plane = D.planes[state.plane];
  const lines = boundaries(plane.frames[state.v].loops[0], region(state.v), plane.window).found.map(
    b => [b.name, b.points.filter((q, i) => i % 29 === 0)]);
  seen.push({ name, hash: location.hash, ...document.body.dataset, text: $("share").textContent, lines,
    gains: state.points[state.plane], sigma: region(state.v).sigma, zeta: state.zeta, radius: state.radius });
}
function move(id, value) { const e = $(id); if (e.type === "checkbox") e.checked = value; else e.value = value;
  e.dispatchEvent(new Event("input", {bubbles: true})); }
try { PROGRAMME } catch (error) { seen.push({ name: "error", text: String(error) + error.stack }); }
const report = document.createElement("pre");
report.id = "report"; report.textContent = JSON.stringify(seen); document.body.append(report);
</script>
"""


def shown(page, programme, tmp_path, fragment=""):
    """What the page says at the steps of a programme, by their names, in a real browser from a file."""
    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("chromium is not installed")
    file = tmp_path / "page.html"
    file.write_text(page.replace("</body>", PROBE.replace("PROGRAMME", programme) + "</body>"), encoding="utf-8")
    answer = subprocess.run(
        [
            browser, "--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage",
            "--window-size=1300,1000",
            f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom", f"file://{file}{fragment}",
        ],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    report = re.search(r'<pre id="report">(.*?)</pre>', answer.stdout, re.DOTALL)
    assert report, answer.stderr[-2000:]
    steps = {step["name"]: step for step in json.loads(html.unescape(report.group(1)))}
    assert "error" not in steps, steps["error"]["text"]
    return steps


def expected_inside(speed, sigma, zeta, radius):
    plane = plane_of("kp-kd")
    region = DRegion(sigma, zeta, radius)
    x, y = np.meshgrid(np.linspace(*WINDOW[:2], CELLS), np.linspace(*WINDOW[2:], CELLS))
    loops = [case_of(str(lag), car(speed, lag), plane, region).loop for lag in (0.05, 0.1, 0.15)]
    poles = np.hstack([closed_loop_poles(loop, x.ravel(), y.ravel()) for loop in loops])
    return (region.depth_radps(poles) >= 0.0).all(axis=1)


def test_moving_a_slider_moves_the_set_to_where_the_poles_say(tmp_path):
    programme = """note("start"); move("speed", 0); note("slow"); move("speed", 2); note("fast");
      move("sigma", 0.704); note("deep"); move("zeta", 0.6); note("damped"); move("radius", 1); note("unbounded");
      move("all", true); note("all"); move("sigma", 1.6); move("speed", 0); note("slow and deep");
      move("plane-choice", 1); note("other plane");"""
    steps = shown(car_page(), programme, tmp_path)
    counts = {name: int(step["count"]) for name, step in steps.items()}
    # Rounding to sixteen bits may move a point of the grid that lies on an edge.
    slack = 0.003 * CELLS**2
    speed_of = {"start": 0.5, "slow": 0.3}
    for name in ("start", "slow", "fast", "deep", "damped", "unbounded"):
        speed, step = speed_of.get(name, 1.0), steps[name]
        radius = step["radius"] or math.inf  # JSON has no infinity
        assert abs(counts[name] - expected_inside(speed, step["sigma"], step["zeta"], radius).sum()) <= slack, name
        assert f"{100 * counts[name] / CELLS**2:.1f} %" in step["text"]
    step = steps["all"]
    everywhere = np.all([expected_inside(v, step["sigma"] * v, step["zeta"], math.inf) for v in SPEEDS], axis=0)
    assert abs(counts["all"] - everywhere.sum()) <= slack
    assert len({counts[name] for name in ("start", "slow", "fast", "deep", "damped", "all")}) == 6
    assert counts["deep"] < counts["fast"]
    assert counts["damped"] < counts["deep"]
    assert counts["damped"] < counts["unbounded"]
    assert "CRB d3" in steps["start"]["boundaries"] or "RRB d3" in steps["start"]["boundaries"]
    assert "d3" not in steps["unbounded"]["boundaries"]
    assert "plane=1" in steps["other plane"]["hash"]


def test_the_pages_boundaries_and_poles_are_the_tools(tmp_path):
    steps = shown(
        car_page(), 'note("start"); move("speed", 2); note("fast"); move("radius", 1); note("open");', tmp_path
    )
    plane = plane_of("kp-kd")
    for name, speed in (("start", 0.5), ("fast", 1.0), ("open", 1.0)):
        step = steps[name]
        region = DRegion(step["sigma"], step["zeta"], step["radius"] or math.inf)
        case = case_of(name, car(speed), plane, region)
        corners = [case_of(str(lag), car(speed, lag), plane, region) for lag in (0.05, 0.15)]
        found = [line for one in (case, *corners) for line in boundaries(one.loop, region, WINDOW)[0]]
        visible = set()
        for boundary in found:
            inside = (boundary.x >= WINDOW.x_low) & (boundary.x <= WINDOW.x_high)
            inside &= (boundary.y >= WINDOW.y_low) & (boundary.y <= WINDOW.y_high)
            visible |= {boundary.name} if inside.any() else set()
        assert set(step["boundaries"].split(",")) == visible
        for _, points in step["lines"]:
            x, y = np.array(points).T
            poles = closed_loop_poles(case.loop, x, y)
            assert np.abs(region.depth_radps(poles)).min(axis=1).max() < 1e-6
        told = [complex(*map(float, pair.split(","))) for pair in step["poles"].split()]
        mine = closed_loop_poles(case.loop, *(np.array([gain]) for gain in step["gains"]))[0]
        assert np.sort_complex(told) == pytest.approx(np.sort_complex(mine), rel=1e-4)


def test_a_delayed_loops_page_is_true_and_its_address_sets_the_sliders(tmp_path):
    page = delayed_page()
    steps = shown(page, 'note("start"); move("zeta", 0.6); note("damped");', tmp_path, "#sigma=0.2&x=0.5&y=0.2")
    assert steps["start"]["gains"] == [0.5, 0.2]
    assert steps["start"]["sigma"] == pytest.approx(0.2)
    plane = plane_of("kp-ki")
    window = Window(*json.loads(re.search(r'"window":(\[[^]]*\])', page).group(1)))
    for name in ("start", "damped"):
        region = DRegion(steps[name]["sigma"], steps[name]["zeta"], zeta_within_radps=4.0)
        case = case_of(name, DELAYED, plane, region, delay_s=0.6)
        found = admissible_region([case], plane, window, cells=CELLS)
        assert abs(int(steps[name]["count"]) - found.inside.sum()) <= 0.003 * CELLS**2
        for _, points in steps[name]["lines"]:
            x, y = np.array(points).T
            poles = closed_loop_poles(case.loop, x, y)
            depth = np.where(np.isnan(poles), 1.0, region.depth_radps(np.where(np.isnan(poles), 0.0, poles)))
            assert np.abs(depth).min(axis=1).max() < 1e-5
        told = {complex(*map(float, pair.split(","))) for pair in steps[name]["poles"].split()}
        mine = closed_loop_poles(case.loop, np.array([0.5]), np.array([0.2]))[0]
        for pole in mine[np.abs(mine) < 10.0]:
            assert min(abs(pole - other) for other in told) < 1e-4 * abs(pole)
    assert int(steps["damped"]["count"]) < int(steps["start"]["count"])


def test_the_page_needs_nothing_else():
    page = car_page()
    assert not re.search(r"(src|href)\s*=|@import|url\(|https?://|fetch\(|XMLHttp", page)
    assert "Car &lt;/script&gt; &amp; rack" in page
    assert page.count("</script>") == 2
    data = json.loads(re.search(r'type="application/json" id="data">(.*?)</script>', page, re.DOTALL).group(1))
    assert [plane["name"] for plane in data["planes"]] == ["kp-kd", "kp-ki"]
    assert data["planes"][0]["x"] == "kp (rad/m)"
    assert data["planes"][0]["y"] == "kd (rad s/m)"
    assert len(data["planes"][0]["frames"]) == 3
    assert len(data["planes"][0]["frames"][0]["loops"]) == 3


def test_the_command_writes_pictures_page_and_figures(tmp_path, capsys):
    out, file = tmp_path / "out", tmp_path / "figures.json"
    plant = tmp_path / "oven.toml"
    plant.write_text('name = "oven"\nnum = [1]\nden = [1, 3, 2, 0]\ninput_unit = "W"\noutput_unit = "K"\n')
    arguments = ["--plane", "kp-ki", "--fixed", "1", "--sigma", "0.1", "--zeta", "0.5", "--cells", "31"]
    status = cli.main(["parameter-space", "--plant", str(plant), *arguments, "--json", str(file), "--out", str(out)])
    assert status == 0
    printed = capsys.readouterr().out
    assert "CRB d2" in printed
    assert "IRB does not exist: the gains reach s^1 at most and the leading power is s^4" in printed
    assert sorted(path.name for path in out.iterdir()) == sorted(CONTENT)
    figures = json.loads(file.read_text("utf-8"))
    assert figures == json.loads((out / "parameter_space.json").read_text("utf-8"))
    assert figures["point"]["inside"] is True
    assert figures["point"]["gains"]["kd"] == 1.0
    assert set(figures["point"]["distances_scaled"]) == {"CRB d1", "CRB d2", "RRB d1"}
    assert len(figures["admissible"]["inside"]) == 31
    window = figures["window"]
    assert figures["scale"] == [window["x_high"] - window["x_low"], window["y_high"] - window["y_low"]]
    assert "ki (W/(K s))" in (out / "explorer.html").read_text("utf-8")
    # The same folder may be used again.
    again = ["--point", "1.0", "0.2", "--cells", "21", "--out", str(out)]
    assert cli.main(["parameter-space", "--plant", "1 / 1 3 2 0", *arguments[:-2], *again]) == 0
    assert json.loads((out / "parameter_space.json").read_text("utf-8"))["point"]["gains"]["ki"] == 0.2


def test_several_plants_are_kept_at_once(tmp_path, capsys):
    plants = [
        {"name": f"{v} m/s", "speed_mps": v, "A": [[0, v], [0, 0]], "B": [0.0, v / 4], "C": [1.0, 0.5], "delay_s": 0.05}
        for v in (0.5, 1.0)
    ]
    file = tmp_path / "car.json"
    file.write_text(json.dumps({"plants": plants, "input_unit": "rad", "output_unit": "m"}))
    out = tmp_path / "out"
    arguments = ["--sigma", "0.05", "--zeta", "0.5", "--zeta-within", "10", "--plane", "kp-ki", "--cells", "15"]
    assert cli.main(["parameter-space", "--plant", str(file), *arguments, "--out", str(out)]) == 0
    figures = json.loads((out / "parameter_space.json").read_text("utf-8"))
    assert figures["cases"] == ["0.5 m/s", "1.0 m/s"]
    assert set(figures["point"]["poles"]) == {"0.5 m/s", "1.0 m/s"}
    assert '"speeds":[0.5,1.0]' in (out / "explorer.html").read_text("utf-8")
    capsys.readouterr()


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--plant", "1 2 3"], 'must be "num / den"'),
        (["--plant", "1 / x"], "den 'x': must be numbers"),
        (["--plant", "1 0 0 / 1 1"], "plant: improper: num has degree 2, den 1"),
        (["--plant", "nowhere.toml"], "nowhere.toml: cannot be read: No such file"),
        (["--plant", "1 / 1 1", "--plane", "kp-kx"], "plane 'kp-kx': must be two of kp, ki, kd"),
        (["--plant", "1 / 1 1", "--zeta", "1.5"], "region: zeta = 1.5"),
        (["--plant", "1 / 1 1", "--delay", "0.1", "--radius", "9"], "no radius can be kept with a delay"),
        (["--plant", "1 / 1 3 2 0", "--sigma", "3"], "no admissible gains with kp in"),
        (["--plant", "1 / 1 1", "--compensator", "1 / 1 -1"], "unstable (pole at 1)"),
        (["--plant", "1 / 1 1", "--choose", "best"], "--choose 'best': must be one of centre"),
        (["--plant", "1 / 1 1", "--window", "1", "0", "0", "1"], "must be kp low < high"),
        (["--plant", "1 / 1 1", "--cells", "1000"], "--cells 1000: must be 400 or less"),
        (["--plant", "1 / 1 1", "--cells", "2"], "cells = 2: must be 3 or more"),
        (["--plant", "1 / 1 1", "--json", "/nowhere/x.json"], "there is no folder /nowhere"),
        (["--plant", "1 / 1 1", "--out", __file__], "is a file; name a folder"),
    ],
)
def test_a_mistake_is_one_line(arguments, text, capsys):
    assert cli.main(["parameter-space", *arguments]) == cli.STATUS_USER_ERROR
    error = capsys.readouterr().err
    assert text in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ("num = [1]\nden = [1, 1]\ngain = 2\n", "gain: unknown key; known here: A, B"),
        ("num = [1]\n", "give either num and den, or A, B, C"),
        ("num = [1]\nden = [1, 'x']\n", "den: must be a list of numbers"),
        ("num = [1]\nden = [1, 1]\ndelay_s = 'x'\n", "delay_s = 'x': must be a finite number"),
        ("num = [1]\nden = [1, 0.5]\nperiod_s = 0\n", "period_s = 0.0: must be above 0"),
        ("A = [[0, 1]]\nB = [1, 0]\nC = [1, 0]\n", "the shapes do not fit"),
        ("A = [[0, 1], [0, 0]]\nB = [[1, 0], [0, 1]]\nC = [1, 0]\n", "has 2 inputs and 1 outputs"),
        ("A = 'x'\nB = [1]\nC = [1]\n", "A: must be a matrix of numbers"),
        (
            "num = [1]\nden = [1, 1]\n[[plants]]\nnum = [1]\nden = [1, 1]\n",
            "den, num: belongs into each of the [[plants]]",
        ),
        ("plants = 3\n", "plants: must be tables"),
        (
            "[[plants]]\nspeed_mps = 1\nnum = [1]\nden = [1, 1]\n[[plants]]\nnum = [1]\nden = [1, 1]\n",
            "for all plants or",
        ),
        ("num = [1\n", "not valid TOML"),
    ],
)
def test_a_mistake_in_the_plants_file_names_file_and_key(content, text, tmp_path, capsys):
    file = tmp_path / "plant.toml"
    file.write_text(content)
    assert cli.main(["parameter-space", "--plant", str(file)]) == cli.STATUS_USER_ERROR
    error = capsys.readouterr().err
    assert text in error
    assert error.count("\n") == 1


def test_an_explorer_without_speeds_is_refused():
    with pytest.raises(UserError, match="at least one plane and one speed"):
        explorer_page("x", car, [], [plane_of("kp-kd")], DRegion())


def test_the_pictures_take_any_region(tmp_path):
    plane = plane_of("kp-kd")
    region = DRegion(0.2, 0.5, 30.0)
    found = admissible_region([case_of("car", car(1.0), plane, region)], plane, WINDOW, cells=15)
    point = found.choose("centre")
    plots.parameter_plane(tmp_path / "plane.png", found, {"chosen": point}, title="car")
    plots.poles_in_region(tmp_path / "poles.png", region, found.poles(point.x, point.y))
    plots.poles_in_region(tmp_path / "region.png", DRegion(0.0, 0.0), {})
    assert all((tmp_path / f"{name}.png").stat().st_size > 5000 for name in ("plane", "poles", "region"))
