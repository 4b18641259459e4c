"""Outline and clearance: hand-computed facts, and a brute-force search along the outline."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest

from sim.body import Outline, clearance_array_m, clearance_m, outline_of, polygon
from sim.data_files import load_course, load_vehicle

PLAIN = Outline(-1.0, 4.0, 1.0, 2.9, 3.1, 1.0)
WITH_MIRRORS = Outline(-1.0, 4.0, 1.0, 2.0, 2.2, 1.3)


def test_outline_of_a_shipped_car() -> None:
    outline = outline_of(load_vehicle("fusion"))
    assert outline.front_m - outline.rear_m == pytest.approx(4.87)
    assert 2.0 * outline.half_width_m == pytest.approx(1.85)
    assert 2.0 * outline.mirror_half_width_m == pytest.approx(2.12)
    assert 0.5 * (outline.mirror_front_m + outline.mirror_rear_m) == pytest.approx(2.10)


@pytest.mark.parametrize(
    ("cone", "expected"),
    [
        ((7.0, 0.0), 3.0),  # ahead of the front bumper
        ((-1.5, 0.5), 0.5),  # behind the rear bumper
        ((2.0, 1.25), 0.25),  # on the left
        ((2.0, -1.25), 0.25),  # on the right
        ((7.0, 5.0), 5.0),  # off the corner: 3, 4, 5
        ((4.0, 1.0), 0.0),  # on the corner
        ((3.9, 0.0), -0.1),  # inside, behind the front bumper
        ((1.0, 0.7), -0.3),  # inside, near the left side
    ],
)
def test_clearance_by_hand(cone: tuple[float, float], expected: float) -> None:
    assert clearance_m(PLAIN, 0.0, 0.0, 0.0, [cone])[0] == pytest.approx(expected, abs=1e-12)


def test_clearance_follows_the_pose() -> None:
    """The car at (10, 5) heads along +y: its front bumper lies at y = 9, its left side at x = 9."""
    assert clearance_m(PLAIN, 10.0, 5.0, math.pi / 2, [(10.0, 12.0)])[0] == pytest.approx(3.0)
    assert clearance_m(PLAIN, 10.0, 5.0, math.pi / 2, [(8.5, 6.0)])[0] == pytest.approx(0.5)


def test_mirrors_count_where_they_are_and_only_there() -> None:
    assert clearance_m(WITH_MIRRORS, 0.0, 0.0, 0.0, [(2.1, 1.5)])[0] == pytest.approx(0.2)
    assert clearance_m(WITH_MIRRORS, 0.0, 0.0, 0.0, [(0.0, 1.5)])[0] == pytest.approx(0.5)
    assert clearance_m(PLAIN, 0.0, 0.0, 0.0, [(2.1, 1.5)])[0] == pytest.approx(0.5)
    assert clearance_m(WITH_MIRRORS, 0.0, 0.0, 0.0, [(2.1, 1.2)])[0] == pytest.approx(-0.1)


def test_the_nearest_cone_is_named() -> None:
    cones = [(9.0, 0.0), (4.5, 0.0), (-9.0, 0.0)]
    assert clearance_m(PLAIN, 0.0, 0.0, 0.0, cones) == (0.5, 1)
    assert clearance_m(PLAIN, 0.0, 0.0, 0.0, []) == (math.inf, -1)


def along(corners: list[tuple[float, float]], n: int = 400) -> np.ndarray:
    """Points along a closed polygon."""
    ends = np.array(corners)
    share = np.linspace(0.0, 1.0, n)[:, None]
    return np.concatenate([a + share * (b - a) for a, b in zip(ends, np.roll(ends, -1, axis=0), strict=True)])


@pytest.mark.parametrize("outline", [PLAIN, WITH_MIRRORS])
def test_against_a_search_along_the_polygon(outline: Outline) -> None:
    rng = random.Random(1)
    outside = 0
    for _ in range(300):
        pose = rng.uniform(-5, 5), rng.uniform(-5, 5), rng.uniform(-4, 4)
        cone = rng.uniform(-8, 8), rng.uniform(-8, 8)
        clearance, _ = clearance_m(outline, *pose, [cone])
        points = along(polygon(outline, *pose))
        nearest = float(np.min(np.hypot(points[:, 0] - cone[0], points[:, 1] - cone[1])))
        if clearance > 0.0:
            outside += 1
            assert clearance == pytest.approx(nearest, abs=2e-3)
        else:
            assert -clearance <= nearest + 2e-3
    assert outside > 150


def test_the_array_form_gives_the_same_for_every_cone() -> None:
    rng = np.random.default_rng(2)
    x, y, yaw = rng.uniform(-3, 12, 200), rng.uniform(-2, 2, 200), rng.uniform(-3, 3, 200)
    cones = load_course("ohio").cones_xy()
    for outline in (PLAIN, WITH_MIRRORS):
        table = clearance_array_m(outline, x, y, yaw, cones)
        assert table.shape == (200, 5)
        for i in range(200):
            for j, cone in enumerate(cones):
                assert table[i, j] == pytest.approx(clearance_m(outline, x[i], y[i], yaw[i], [cone])[0], abs=1e-12)
    assert clearance_array_m(PLAIN, 0.0, 0.0, 0.0, [(7.0, 0.0)]).tolist() == [[3.0]]


def test_the_polygon_runs_counter_clockwise_and_encloses_the_area() -> None:
    for outline, area in ((PLAIN, 5.0 * 2.0), (WITH_MIRRORS, 5.0 * 2.0 + 2 * 0.2 * 0.3)):
        corners = polygon(outline, 3.0, -2.0, 0.7)
        shoelace = sum(a[0] * b[1] - b[0] * a[1] for a, b in zip(corners, [*corners[1:], corners[0]], strict=True))
        assert 0.5 * shoelace == pytest.approx(area)
