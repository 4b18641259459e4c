"""Figures of a run: projection onto the path, legs, what is read from tables and truth."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from sim.errors import UserError
from tools.figures import (
    FORWARD,
    REVERSE,
    PathTable,
    Preview,
    Truth,
    command_rate,
    leg_figures,
    load_path,
    load_preview,
    load_truth,
    project,
    run_figures,
    split_legs,
    truth_of_rows,
)

CURVATURE = 0.12
STEP = 0.0103


def arc(curvature: float = CURVATURE, length_m: float = 9.0) -> PathTable:
    """A circular arc that begins at (1, 2) with heading 0.3 rad."""
    station = np.arange(round(length_m / STEP) + 1) * STEP
    yaw = 0.3 + curvature * station
    x = 1.0 + (np.sin(yaw) - math.sin(0.3)) / curvature
    y = 2.0 - (np.cos(yaw) - math.cos(0.3)) / curvature
    return PathTable(station, x, y, yaw, np.full_like(station, curvature))


def beside(path: PathTable, station: float, error: float, heading: float) -> tuple[float, float, float]:
    """The exact pose at a station of the arc, `error` to its left and turned by `heading`."""
    yaw = 0.3 + CURVATURE * station
    x = 1.0 + (math.sin(yaw) - math.sin(0.3)) / CURVATURE - error * math.sin(yaw)
    y = 2.0 - (math.cos(yaw) - math.cos(0.3)) / CURVATURE + error * math.cos(yaw)
    return x, y, yaw + heading


@pytest.mark.parametrize("error", [0.0, 0.004, -0.004, 0.35, -0.35])
@pytest.mark.parametrize("heading", [0.0, 0.05, -0.05])
def test_projection_is_exact_between_the_grid_points(error: float, heading: float) -> None:
    path = arc()
    stations = np.linspace(0.05, 8.9, 997)
    poses = np.array([beside(path, station, error, heading) for station in stations]).T
    found = project(path, *poses)
    np.testing.assert_allclose(found.cross_track_error_m, error, atol=1e-8)
    np.testing.assert_allclose(found.station_m, stations, atol=1e-6)
    np.testing.assert_allclose(found.heading_error_rad, heading, atol=1e-6)


def test_left_of_the_path_is_positive_in_both_directions_of_the_axes() -> None:
    straight = PathTable(np.arange(3.0), np.zeros(3), np.arange(3.0), np.full(3, math.pi / 2), np.zeros(3))
    found = project(straight, np.array([-0.2]), np.array([1.4]), np.array([math.pi / 2 + 0.1]))
    assert found.cross_track_error_m[0] == pytest.approx(0.2)
    assert found.heading_error_rad[0] == pytest.approx(0.1)
    assert found.station_m[0] == pytest.approx(1.4)


def test_the_mirrored_pose_on_the_mirrored_path_has_the_opposite_errors() -> None:
    path = arc()
    mirrored = path._replace(y_m=-path.y_m, yaw_rad=-path.yaw_rad, curvature_1pm=-path.curvature_1pm)
    x, y, yaw = (np.array([value]) for value in beside(path, 4.0, 0.03, 0.02))
    left, right = project(path, x, y, yaw), project(mirrored, x, -y, -yaw)
    assert left.cross_track_error_m[0] == pytest.approx(0.03, abs=1e-8)
    assert right.cross_track_error_m[0] == pytest.approx(-0.03, abs=1e-8)
    assert right.heading_error_rad[0] == pytest.approx(-0.02, abs=1e-7)


@pytest.mark.parametrize("beyond", [-0.7, 0.7])
def test_the_path_goes_on_straight_beyond_its_ends(beyond: float) -> None:
    path = arc()
    end = 0 if beyond < 0 else -1
    yaw = path.yaw_rad[end]
    x = path.x_m[end] + beyond * math.cos(yaw) - 0.01 * math.sin(yaw)
    y = path.y_m[end] + beyond * math.sin(yaw) + 0.01 * math.cos(yaw)
    found = project(path, np.array([x]), np.array([y]), np.array([yaw]))
    assert found.station_m[0] == pytest.approx(path.station_m[end] + beyond)
    assert found.cross_track_error_m[0] == pytest.approx(0.01)


def straight_run(*, overshoot_m: float = 0.012, return_error_m: float = -0.02, aside_m: float = 0.003) -> Truth:
    """Along x: 1 s of standstill, 4 m forward, 1 s of standstill with the wheels turned, back in reverse, standstill.

    `return_error_m`: where it comes to rest behind (negative: before) the start, measured in x.
    """
    forward = np.linspace(0.0, 4.0 + overshoot_m, 401)
    back = np.linspace(4.0 + overshoot_m, return_error_m, 401)
    x = np.concatenate([np.zeros(100), forward, np.full(100, forward[-1]), back, np.full(50, back[-1])])
    speed = np.concatenate([np.diff(x) / 0.01, [0.0]])
    n = len(x)
    angle = np.zeros(n)
    angle[520:580] = 0.2  # turned while it stands between the legs
    zeros = np.zeros(n)
    rate = np.gradient(angle, 0.01)
    return Truth(
        t_s=0.01 * np.arange(n), x_m=x, y_m=np.full(n, aside_m), yaw_rad=np.full(n, 0.01), speed_mps=speed,
        accel_x_mps2=zeros, accel_y_mps2=zeros, road_wheel_angle_rad=angle, road_wheel_rate_radps=rate,
        road_wheel_angle_cmd_rad=angle, min_clearance_m=np.linspace(0.5, 0.3, n),
    )  # fmt: skip


def straight_path() -> PathTable:
    station = np.linspace(0.0, 4.0, 401)
    return PathTable(station, station, np.zeros(401), np.zeros(401), np.zeros(401))


PREVIEW = Preview(
    {d: np.array([0.0, 2.0]) for d in (FORWARD, REVERSE)}, {d: np.array([0.0, 1.0]) for d in (FORWARD, REVERSE)}
)


def test_legs_and_their_figures() -> None:
    truth, path = straight_run(), straight_path()
    forward, reverse = split_legs(truth, path, PREVIEW)
    assert (forward.direction, reverse.direction) == (FORWARD, REVERSE)
    ahead, back = leg_figures(forward, truth, path), leg_figures(reverse, truth, path)
    assert ahead["max_cross_track_m"] == pytest.approx(0.003)
    assert ahead["final_station_error_m"] == pytest.approx(0.012)  # stopped beyond the end
    assert back["final_station_error_m"] == pytest.approx(0.02)  # went 20 mm too far back
    assert ahead["final_heading_error_rad"] == pytest.approx(0.01)
    # preview 0.5 V, V about 1 m/s: ahead of the axle when forward, behind it in reverse
    assert ahead["max_preview_error_m"] == pytest.approx(0.003 + 0.5 * 1.003 * math.sin(0.01), abs=2e-5)
    assert back["max_preview_error_m"] == pytest.approx(0.003)  # where it stands; while it moves 0.003 - 0.005
    assert ahead["duration_s"] == pytest.approx(4.0)
    assert ahead["min_clearance_m"] > back["min_clearance_m"]


def test_turning_the_wheels_at_standstill_counts_for_the_leg_that_follows() -> None:
    truth, path = straight_run(), straight_path()
    forward, reverse = (leg_figures(leg, truth, path) for leg in split_legs(truth, path, PREVIEW))
    assert forward["max_road_wheel_angle_rad"] == 0.0
    assert reverse["max_road_wheel_angle_rad"] == pytest.approx(0.2)
    assert reverse["max_road_wheel_rate_cmd_radps"] == pytest.approx(20.0)


def test_command_rate_has_a_value_a_row() -> None:
    truth = straight_run()
    assert len(command_rate(truth, slice(0, 10))) == 10
    assert command_rate(truth, slice(519, 521))[1] == pytest.approx(20.0)
    assert len(command_rate(truth, slice(0, 0))) == 0


def test_a_run_without_motion_has_no_legs() -> None:
    truth = straight_run()
    still = truth._replace(speed_mps=np.zeros_like(truth.speed_mps))
    assert split_legs(still, straight_path(), PREVIEW) == []


def test_each_change_of_direction_begins_a_leg_and_a_stop_on_the_way_does_not() -> None:
    truth = straight_run()
    speed = truth.speed_mps.copy()
    speed[200:220] = 0.0  # a stop on the way
    speed[-5:-1] = 0.1  # and forward again in the end
    legs = split_legs(truth._replace(speed_mps=speed), straight_path(), PREVIEW)
    assert [leg.direction for leg in legs] == [FORWARD, REVERSE, FORWARD]
    assert all(a.rows.stop <= b.rows.start + 1 for a, b in pairwise(legs))


def test_a_run_that_ends_in_the_first_leg_has_one() -> None:
    truth = straight_run()
    cut = Truth(*(column[:300] for column in truth))
    (leg,) = split_legs(cut, straight_path(), PREVIEW)
    assert leg.rows.stop == 300
    assert leg_figures(leg, cut, straight_path())["final_station_error_m"] < -1.0


def test_truth_of_rows_and_of_a_file_are_the_same(tmp_path: Path) -> None:
    truth = straight_run()
    names = Truth._fields
    lines = [",".join(("extra", *names))]
    lines += [",".join(("9", *(repr(float(value)) for value in row))) for row in zip(*truth, strict=True)]
    (tmp_path / "truth.csv").write_text("# comment\n" + "\n".join(lines) + "\n")
    read = load_truth(tmp_path / "truth.csv")
    for name in names:
        np.testing.assert_array_equal(getattr(read, name), getattr(truth, name))

    class Row:
        def __init__(self, index: int) -> None:
            for name in names:
                setattr(self, name, float(getattr(truth, name)[index]))

    np.testing.assert_array_equal(truth_of_rows([Row(i) for i in range(5)]).x_m, truth.x_m[:5])
    assert len(truth_of_rows([]).t_s) == 0


def test_path_table_is_mirrored_for_the_right_side(tmp_path: Path) -> None:
    (tmp_path / "path.csv").write_text(
        "# made\nstation_m,x_m,y_m,yaw_rad,curvature_1pm,curvature_slope_1pm2\n0,0,0,0,0.1,0\n1,1,0.5,0.2,0.2,0\n"
    )
    left, right = load_path(tmp_path, "left"), load_path(tmp_path, "right")
    assert left.length_m == 1.0
    np.testing.assert_array_equal(right.y_m, -left.y_m)
    np.testing.assert_array_equal(right.yaw_rad, -left.yaw_rad)
    np.testing.assert_array_equal(right.curvature_1pm, -left.curvature_1pm)


def test_preview_comes_from_the_laws_own_table(tmp_path: Path) -> None:
    text = "direction,speed_mps,preview_m,kp\n1,0,0.1,2\n1,1,0.6,2\n-1,0,0.2,2\n-1,1,0.7,2\n"
    (tmp_path / "gains_pid_ff.csv").write_text(text)
    preview = load_preview(tmp_path, "pid+ff")
    np.testing.assert_array_equal(preview.preview_m[FORWARD], [0.1, 0.6])
    np.testing.assert_array_equal(preview.preview_m[REVERSE], [0.2, 0.7])


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (None, "cannot be read"),
        ("a,b\n1,2\n", "column station_m is missing"),
        ("station_m,x_m,y_m,yaw_rad,curvature_1pm\n", "has no rows"),
        ("station_m,x_m,y_m,yaw_rad,curvature_1pm\n0,0,zero,0,0\n", "not a number"),
        ("station_m,x_m,y_m,yaw_rad,curvature_1pm\n0,0\n", "not a number"),
    ],
)
def test_a_malformed_table_is_refused_in_one_line(tmp_path: Path, content: str | None, says: str) -> None:
    if content is not None:
        (tmp_path / "path.csv").write_text(content)
    with pytest.raises(UserError, match=says) as caught:
        load_path(tmp_path, "left")
    assert "path.csv" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_run_figures_hold_what_is_promised() -> None:
    truth, path = straight_run(), straight_path()
    figures = run_figures(
        setup={"scenario": "car", "bus": {"interface": "loopbus", "channel": "29500"}},
        legs=[leg_figures(leg, truth, path) for leg in split_legs(truth, path, PREVIEW)],
        exam={"cones_touched": ["point"], "score": 95},
        controller={"cycles": 4000, "frames_lost": 0},
        why=None,
    )
    promised = (
        "direction max_cross_track_m rms_cross_track_m max_preview_error_m final_cross_track_m final_station_error_m "
        "final_heading_error_rad max_road_wheel_angle_rad max_road_wheel_rate_radps min_clearance_m duration_s"
    )
    assert set(promised.split()) <= set(figures["legs"][0])
    assert figures["cones_touched"] == 1
    assert figures["passed"] is True
    loop = "cycles overruns wake_p50_us wake_p99_us wake_p999_us step_p50_us step_p99_us turnaround_p50_us"
    assert set(loop.split()) | {"turnaround_p99_us", "scheduler"} <= set(figures["loop"])
    assert {"sent", "received", "lost", "rejected"} <= set(figures["frames"])
