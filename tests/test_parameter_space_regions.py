"""The admissible set and its boundaries against poles found another way: eigenvalues of the loop's state matrices."""

import math

import control
import numpy as np
import pytest

from sim.errors import UserError
from tools.design.parameter_space import (
    RULES,
    Case,
    Characteristic,
    DRegion,
    Pid,
    Window,
    admissible_region,
    boundaries,
    case_of,
    cases_over,
    characteristic,
    closed_loop_poles,
    plane_of,
    plant_of,
    poles_outside,
)
from tools.design.parameter_space.loop import Plant

GRID = 25


def paper_plant(speed_mps, mass_kg=3000.0, stiffness=3e5, rear_sign=None):
    """Equation 11 from front (or, with a sign, rear) steering to the preview error; preview 0.5 s."""
    c, m, v, inertia, arm = stiffness, mass_kg, speed_mps, 5113.0, 2.0
    a = [
        [-2 * c / (m * v), -1.0, 0, 0],
        [0, -2 * c * arm**2 / (inertia * v), 0, 0],
        [0, 1, 0, 0],
        [v, 0.5 * v, v, 0],
    ]
    turn = c * arm / inertia
    b = [[c / (m * v)], [turn if rear_sign is None else rear_sign * turn], [0], [0]]
    return control.ss(a, b, [[0, 0, 0, 1]], 0)


def eigenvalues(plant, gains, delay_s=0.0, nodes=14):
    """Poles of the PID loop from matrices of the plant as given; with a delay by collocation of the delay equation.

    x' = A x - B (kp C + kd C A) x(t-T) - B ki z(t-T), z' = C x; kd on plants of relative degree two or more only.
    The delay equation's generator on Chebyshev nodes: Breda, Maset, Vermiglio, SIAM J. Sci. Comput. 27 (2005).
    """
    state = control.ss(plant)
    a, b, c = state.A, state.B, state.C
    assert not np.any(state.D)
    kp, ki, kd = gains["kp"], gains.get("ki", 0.0), gains["kd"]
    cb = float((c @ b)[0, 0])
    assert kd == 0.0 or delay_s == 0.0 or abs(cb) < 1e-9
    order = len(a)
    now, late = np.zeros((order + 1, order + 1)), np.zeros((order + 1, order + 1))
    now[:order, :order] = a
    now[order, :order] = c[0]
    feedback = np.hstack([kp * c + kd * (c @ a), [[ki]]]) / (1.0 + kd * cb)
    late[:order] = -b @ feedback
    if "ki" not in gains:
        now, late = now[:order, :order], late[:order, :order]
    if delay_s == 0.0:
        return np.linalg.eigvals(now + late)
    size = len(now)
    theta = 0.5 * delay_s * (np.cos(np.pi * np.arange(nodes + 1) / nodes) - 1.0)
    weights = np.concatenate([[2.0], np.ones(nodes - 1), [2.0]]) * (-1.0) ** np.arange(nodes + 1)
    gaps = theta[:, None] - theta[None, :] + np.eye(nodes + 1)
    slope = np.outer(weights, 1.0 / weights) / gaps
    slope -= np.diag(slope.sum(axis=1))
    generator = np.kron(slope, np.eye(size))
    generator[:size] = 0.0
    generator[:size, :size] = now
    generator[:size, -size:] = late
    return np.linalg.eigvals(generator)


def gains_of(plane, x, y):
    """Gains of a point; a plane without ki has no integrator where ki is fixed at zero."""
    gains = plane.gains(x, y)
    if plane.third_name == "ki" and plane.third == 0.0:
        del gains["ki"]
    return gains


def admissible_by_eigenvalues(plant, plane, region, x, y, delay_s=0.0):
    """Worst depth of any pole at each point of a grid, shape (ny, nx)."""
    far = 10.0 / delay_s if delay_s else math.inf  # beyond, the eigenvalues of the collocation are its own
    depth = np.empty((len(y), len(x)))
    for row, second in enumerate(y):
        for column, first in enumerate(x):
            poles = eigenvalues(plant, gains_of(plane, first, second), delay_s)
            depth[row, column] = region.depth_radps(poles[np.abs(poles) < far]).min()
    return depth


HIGH_ORDER = control.tf([1.0], np.poly([-1, -1.5, -2, -3, -4, -6, -0.5]))
UNSTABLE = control.tf([1.0, 4.0], np.poly([1.0, -2.0, -5.0]))
NON_MINIMUM = control.tf([-1.0, 1.0], np.poly([-1.0, -2.0, -0.4]))
SLOW = control.tf([2.0], np.poly([-1.0, -0.4, -3.0]))

CASES = {
    "paper 0.1 m/s, kp-ki": (paper_plant(0.1), "kp-ki", 0.5, DRegion(0.02, 0.6), 0.0),
    "paper 1 m/s, kp-ki": (paper_plant(1.0), "kp-ki", 0.5, DRegion(0.13, 0.7), 0.0),
    "paper 1 m/s, kp-kd": (paper_plant(1.0), "kp-kd", 2.0, DRegion(0.2, 0.7, 600.0), 0.0),
    "paper 0.5 m/s, ki-kd": (paper_plant(0.5), "ki-kd", 8.0, DRegion(0.1, 0.6), 0.0),
    "paper reverse, true sign": (paper_plant(1.0, rear_sign=-1.0), "kp-kd", 0.0, DRegion(0.05, 0.2), 0.0),
    "textbook, kp-ki": (control.tf([1], [1, 3, 2, 0]), "kp-ki", 2.0, DRegion(), 0.0),
    "textbook, ki-kd": (control.tf([1], [1, 3, 2, 0]), "ki-kd", 3.0, DRegion(), 0.0),
    "seventh order, kp-ki": (HIGH_ORDER, "kp-ki", 40.0, DRegion(0.12, 0.3), 0.0),
    "seventh order, ki-kd": (HIGH_ORDER, "ki-kd", 120.0, DRegion(), 0.0),
    "seventh order, kp-kd": (HIGH_ORDER, "kp-kd", 20.0, DRegion(0.05, 0.2, 9.0), 0.0),
    "unstable, kp-ki": (UNSTABLE, "kp-ki", 0.5, DRegion(0.2, 0.35), 0.0),
    "unstable, ki-kd": (UNSTABLE, "ki-kd", 12.0, DRegion(), 0.0),
    "non-minimum phase, kp-ki": (NON_MINIMUM, "kp-ki", 0.2, DRegion(0.05, 0.4), 0.0),
    "non-minimum phase, ki-kd": (NON_MINIMUM, "ki-kd", 0.8, DRegion(), 0.0),
    "delay, kp-ki": (SLOW, "kp-ki", 0.0, DRegion(0.1, 0.35, zeta_within_radps=4.0), 0.6),
    "delay, kp-kd": (SLOW, "kp-kd", 0.3, DRegion(0.1), 0.6),
    "delay, ki-kd": (SLOW, "ki-kd", 0.8, DRegion(), 0.6),
    "delay, unstable": (control.tf([1.0], np.poly([0.3, -2.0])), "kp-kd", 0.1, DRegion(), 0.4),
    "delay, seventh order": (HIGH_ORDER, "kp-ki", 30.0, DRegion(0.08, 0.2, zeta_within_radps=3.0), 0.5),
}


@pytest.mark.parametrize("name", CASES)
def test_the_set_is_that_of_brute_force_and_changes_at_its_boundaries_only(name):
    plant, plane_name, third, region, delay_s = CASES[name]
    plane = plane_of(plane_name, third)
    found = admissible_region(
        [case_of(name, plant, plane, region, delay_s=delay_s)], plane, cells=13 if delay_s else GRID
    )
    depth = admissible_by_eigenvalues(plant, plane, region, found.x, found.y, delay_s)
    clear = np.abs(depth) > 1e-6 * (1.0 + np.abs(depth).max())
    assert clear.mean() > 0.9
    assert np.array_equal(found.inside[clear], (depth >= 0.0)[clear])
    assert 0.02 < found.inside.mean() < 0.98
    # Two neighbours of which one is admissible have a boundary between them: no boundary is missing.
    crossed = crossings(found)
    for axis in (0, 1):
        change = np.diff(found.inside.astype(int), axis=axis) != 0
        assert change.any()
        assert np.all(crossed[axis][change])


def crossings(found):
    """Whether any boundary passes between neighbouring points of the grid, with a thousandth of a cell of room."""
    width, height = found.x[1] - found.x[0], found.y[1] - found.y[0]
    shape = found.inside.shape
    passed = [np.zeros((shape[0] - 1, shape[1]), bool), np.zeros((shape[0], shape[1] - 1), bool)]
    for boundary in found.boundaries:
        u, v = (boundary.x - found.x[0]) / width, (boundary.y - found.y[0]) / height
        for axis, along, across in ((0, v, u), (1, u, v)):
            for start, stop, low, high in zip(across[:-1], across[1:], along[:-1], along[1:], strict=True):
                if math.isnan(start + stop + low + high):
                    continue
                first, last = math.ceil(min(start, stop) - 1e-3), math.floor(max(start, stop) + 1e-3)
                for line in range(max(first, 0), min(last, passed[axis].shape[1 - axis] - 1) + 1):
                    share = 0.5 if start == stop else min(max((line - start) / (stop - start), 0.0), 1.0)
                    at = low + share * (high - low)
                    for cell in {math.floor(at - 1e-3), math.floor(at + 1e-3)}:
                        if 0 <= cell < passed[axis].shape[axis]:
                            passed[axis][(cell, line) if axis == 0 else (line, cell)] = True
    return passed


@pytest.mark.parametrize("name", CASES)
def test_on_every_boundary_a_pole_is_on_the_edge_that_names_it(name):
    plant, plane_name, third, region, delay_s = CASES[name]
    plane = plane_of(plane_name, third)
    found = admissible_region([case_of(name, plant, plane, region, delay_s=delay_s)], plane, cells=5)
    kinds = set()
    for boundary in found.boundaries:
        kinds.add(boundary.kind)
        known = np.flatnonzero(~np.isnan(boundary.x))
        for at in known[:: max(1, len(known) // 7)]:
            s = boundary.s[at]
            if boundary.kind == "IRB" or (delay_s and abs(s) > 5.0 / delay_s):
                continue
            poles = eigenvalues(plant, gains_of(plane, boundary.x[at], boundary.y[at]), delay_s)
            size = np.abs(s) + 1e-3 * (np.abs(poles).min() + 1.0)
            assert np.abs(poles - s).min() < 2e-4 * size
            edge = {"d1": s.real + region.sigma_radps, "d3": abs(s) - region.radius_radps}
            edge["d2"] = -s.real / abs(s) - region.zeta if boundary.piece == "d2" else 0.0
            if boundary.piece == "d2" and abs(edge["d2"]) > 1e-9:  # the arc that ends the wedge
                edge["d2"] = abs(s) - region.zeta_within_radps
            assert abs(edge[boundary.piece]) < 1e-9 * (1.0 + abs(s))
    assert "CRB" in kinds


def test_the_textbook_region_is_the_analytic_one():
    """1/(s (s+1) (s+2)): Routh gives ki > 0 and kp (3 (2 + kd) - kp) > 9 ki; in the ki-kd plane straight lines."""
    plant = control.tf([1], [1, 3, 2, 0])
    plane = plane_of("ki-kd", 3.0)
    found = admissible_region([case_of("textbook", plant, plane, DRegion())], plane, Window(-1.03, 6, -3, 6), cells=60)
    ki, kd = np.meshgrid(found.x, found.y)
    assert np.array_equal(found.inside, (ki > 0.0) & (ki < kd + 1.0))
    (line,) = found.named("CRB d1")
    assert line.line == pytest.approx((1.0, -1.0, -1.0))
    assert line.s[0] == pytest.approx(1j)  # omega^2 = kp / 3
    assert found.named("RRB d1")[0].line == pytest.approx((1.0, 0.0, 0.0))
    plane = plane_of("kp-ki", 1.0)
    found = admissible_region(
        [case_of("textbook", plant, plane, DRegion())], plane, Window(-2.03, 12, -1.01, 4), cells=60
    )
    kp, ki = np.meshgrid(found.x, found.y)
    assert np.array_equal(found.inside, (ki > 0.0) & (kp * (9.0 - kp) > 9.0 * ki))
    (curve,) = found.named("CRB d1")
    known = ~np.isnan(curve.x)
    assert curve.x[known] * (9.0 - curve.x[known]) == pytest.approx(9.0 * curve.y[known], abs=1e-9)
    assert curve.x[known].max() > 8.9


def test_a_delay_has_its_analytic_ultimate_gain():
    """Integrator with dead time T under P: stable for 0 < kp < pi / (2 T), exactly."""
    plane = plane_of("kp-kd", 0.0)
    case = case_of("water", control.tf([1], [1, 0]), plane, DRegion(), Pid(derivative_lag_s=0.1), delay_s=0.5)
    kp = np.array([-0.01, 0.01, 1.0, math.pi - 1e-3, math.pi + 1e-3, 10.0, 13.1 * math.pi])
    counted = poles_outside(case.loop, DRegion(), kp, np.zeros(len(kp)))
    # Pairs cross at kp T = pi/2 + 2 pi n.
    assert counted.tolist() == [1, 0, 0, 0, 2, 2, 8]
    found = admissible_region([case], plane, Window(-0.5, 4.0, -0.5, 0.5))
    curve = found.named("CRB d1")[0]
    assert found.point(math.pi, 0.0).distances["CRB d1"].distance < 1e-4
    assert np.nanmin(np.hypot(curve.x - math.pi, curve.y)) < 0.02


def test_the_count_with_a_delay_is_that_of_the_eigenvalues():
    plant, plane_name, third, region, delay_s = CASES["delay, kp-ki"]
    plane = plane_of(plane_name, third)
    loop = case_of("slow", plant, plane, region, delay_s=delay_s).loop
    x, y = (grid.ravel() for grid in np.meshgrid(np.linspace(-1, 9, 9), np.linspace(-0.5, 4, 9)))
    counted = poles_outside(loop, region, x, y)
    for index in range(len(x)):
        poles = eigenvalues(plant, gains_of(plane, x[index], y[index]), delay_s)
        depth = region.depth_radps(poles[np.abs(poles) < 10.0 / delay_s])
        if np.abs(depth).min() > 1e-6:
            assert counted[index] == (depth < 0.0).sum()
    assert len(set(counted)) >= 4


def test_neutral_and_infinite_boundaries():
    first_order = control.tf([2.0], [1.0, 1.0])
    plane = plane_of("kp-kd", 0.0)
    found = admissible_region([case_of("fast", first_order, plane, DRegion())], plane, Window(-2.01, 2, -2.01, 2))
    (line,) = found.named("IRB")  # s (1 + 2 kd) + ...: kd = -1/2
    assert -line.line[2] / line.line[1] == pytest.approx(-0.5)
    kp, kd = np.meshgrid(found.x, found.y)
    assert np.array_equal(found.inside, (1.0 + 2.0 * kd) * (1.0 + 2.0 * kp) > 0.0)
    # With dead time the derivative closes a loop of gain 2 kd at infinite frequency: |2 kd| < exp(-sigma T).
    late = case_of("late", first_order, plane, DRegion(0.5), delay_s=0.3)
    found = admissible_region([late], plane, Window(-1, 2, -1, 1), cells=41)
    limits = sorted(-line.line[2] / line.line[1] for line in found.named("IRB"))
    assert limits == pytest.approx([-0.5 * math.exp(-0.15), 0.5 * math.exp(-0.15)])
    assert np.abs(found.y[found.inside.any(axis=1)]).max() < limits[1]


def test_a_boundary_that_does_not_exist_says_why():
    plane = plane_of("kp-ki", 0.5)
    found = admissible_region([case_of("car", paper_plant(1.0), plane, DRegion(0.1))], plane)
    with pytest.raises(UserError, match=r"boundary IRB does not exist .* leading power is s\^5"):
        found.named("IRB")
    with pytest.raises(UserError, match=r"boundary CRB d3 does not exist .* does not pass through the window"):
        found.named("CRB d3")
    plane = plane_of("kp-kd", 0.5)
    found = admissible_region([case_of("car", paper_plant(1.0), plane, DRegion())], plane)
    with pytest.raises(UserError, match=r"RRB d1 does not exist .* the gains have no effect there"):
        found.named("RRB d1")


def test_speeds_and_corners_are_an_intersection():
    plane = plane_of("kp-kd", 0.0)
    window = Window(0, 30, -2, 40)
    cases = cases_over(
        paper_plant,
        (0.1, 0.5, 1.0),
        plane,
        lambda speed: DRegion(0.25 * speed, 0.6),
        box={"mass_kg": (2100.0, 3900.0), "stiffness": (2.1e5, 3.9e5)},
    )
    assert len(cases) == 12
    assert cases[1].name == "0.1 m/s, mass_kg low, stiffness high"
    together = admissible_region(cases, plane, window, cells=31)
    alone = [admissible_region([case], plane, window, cells=31).inside for case in cases]
    assert np.array_equal(together.inside, np.all(alone, axis=0))
    assert together.inside.sum() < min(inside.sum() for inside in alone)
    assert set(together.poles(5.0, 5.0)) == {case.name for case in cases}


def test_the_chosen_point_and_its_distances():
    plane = plane_of("kp-ki", 1.0)
    window = Window(-2, 12, -1, 4)
    case = case_of("textbook", control.tf([1], [1, 3, 2, 0]), plane, DRegion())
    found = admissible_region([case], plane, window)
    for rule in RULES:
        point = found.choose(rule)
        assert point.inside or abs(point.margin) < 1e-3
        assert list(point.distances) == sorted(point.distances, key=lambda name: point.distances[name].distance)
        assert set(point.distances) == {"CRB d1", "RRB d1"}
    point = found.point(4.0, 1.0)
    assert point.distances["RRB d1"].distance == pytest.approx(1.0 / 5.0, abs=1e-6)  # ki = 0, over the height
    kp = np.linspace(-2, 12, 200001)
    curve = np.hypot((kp - 4.0) / 14.0, (kp * (9.0 - kp) / 9.0 - 1.0) / 5.0).min()
    assert point.distances["CRB d1"].distance == pytest.approx(curve, rel=1e-3)
    assert found.choose("smallest").x < found.choose("centre").x
    assert found.choose("smallest on CRB d1").distances["CRB d1"].distance < 1e-6


def test_the_outline_follows_the_boundaries():
    plane = plane_of("kp-ki", 1.0)
    case = case_of("textbook", control.tf([1], [1, 3, 2, 0]), plane, DRegion())
    found = admissible_region([case], plane, Window(-2, 12, -1, 4))
    (outline,) = found.outline
    kp, ki = outline.T
    off = np.minimum(np.abs(ki), np.abs(kp * (9.0 - kp) / 9.0 - ki))
    assert off.max() < 0.1
    assert kp.max() == pytest.approx(9.0, abs=0.2)


def test_a_sampled_loop_agrees_with_its_eigenvalues():
    period = 0.1
    plant = control.sample_system(control.tf([1.0], [1.0, 1.0, 0.0]), period)
    plane = plane_of("kp-kd", 0.0)
    region = DRegion(0.3, 0.4)
    case = case_of("sampled", plant, plane, region)
    found = admissible_region([case], plane, Window(-0.3, 3.5, -1.3, 30.0), cells=13)
    z = control.tf([1, 0], [1], period)
    expected = np.empty_like(found.inside)
    for row, kd in enumerate(found.y):
        for column, kp in enumerate(found.x):
            law = kp + kd * (z - 1) / (period * z)
            poles = control.feedback(control.ss(plant) * control.ss(law)).poles().astype(complex)
            poles = poles[np.abs(poles) > 1e-6]
            expected[row, column] = region.depth_radps(np.log(poles) / period).min() >= 0.0
    assert np.array_equal(found.inside, expected)
    assert {boundary.name for boundary in found.boundaries} >= {"CRB d2", "RRB d1"}
    assert "sampled" in found.absent["IRB"]


def test_zeros_of_a_state_space_are_those_of_the_plant():
    plant = plant_of(paper_plant(0.1))
    assert plant.relative_degree == 2
    assert np.sort(plant.zeros().real) == pytest.approx([-4545.0, -0.0488], rel=2e-3)
    s = np.array([0.3j, 4.0j, 900.0j])
    assert np.polyval(plant.num, s) / np.polyval(plant.den, s) == pytest.approx(paper_plant(0.1)(s), rel=1e-8)
    reverse = plant_of(paper_plant(1.0, rear_sign=-1.0))
    assert reverse.zeros().real.max() == pytest.approx(0.666, abs=2e-3)


def test_any_loop_affine_in_two_parameters():
    """A mass with spring x and damper y: s^2 + y s + x; the wedge is x = y^2 / (4 zeta^2)."""
    loop = Characteristic(np.array([1.0, 0, 0]), np.zeros(1), np.array([1.0]), np.array([1.0, 0.0]))
    region = DRegion(0.0, 0.5, 4.0)
    found, absent = boundaries(loop, region, Window(-1, 20, -1, 9))
    wedge = next(boundary for boundary in found if boundary.name == "CRB d2")
    known = ~np.isnan(wedge.x)
    assert wedge.x[known] == pytest.approx(wedge.y[known] ** 2, abs=1e-9)
    rrb = next(boundary for boundary in found if boundary.name == "RRB d3")
    assert np.array(rrb.line) / rrb.line[0] == pytest.approx([1.0, -4.0, 16.0])
    assert "radius" in absent["IRB"]
    inside = admissible_region([Case("mass", loop, region)], plane_of("kp-kd"), Window(-1, 20, -1, 9)).inside
    assert inside.any()


def test_the_derivatives_filter_and_a_compensator_are_in_the_loop():
    plant = control.tf([1.0], [1.0, 0.5, 0.0])
    lead = control.tf([1.0, 1.0], [0.1, 1.0])
    pid = Pid(0.05, plant_of(lead, name="lead"))
    loop = characteristic(plant_of(plant), plane_of("kp-kd", 0.7), pid)
    s = control.tf("s")
    law = 2.0 + 0.7 / s + 0.4 * s / (0.05 * s + 1.0)
    expected = np.sort_complex(control.feedback(plant * lead * law).poles())
    assert np.sort_complex(closed_loop_poles(loop, [2.0], [0.4])[0]) == pytest.approx(expected, rel=1e-6)


TEXTBOOK = control.tf([1], [1, 3, 2, 0])


@pytest.mark.parametrize(
    ("action", "text"),
    [
        (lambda: plant_of(([1, 0, 0], [1, 1])), r"plant: improper: num has degree 2, den 1"),
        (lambda: plant_of(control.tf([1, 2, 1], [1, 1])), r"plant: improper"),
        (lambda: plant_of([1, 2, 3]), "a TransferFunction or StateSpace .* not list"),
        (lambda: plant_of(control.ss(np.eye(2), np.eye(2), np.eye(2), np.zeros((2, 2)))), "has 2 inputs and 2 outputs"),
        (lambda: plant_of(([0.0], [1, 1])), "num is zero"),
        (lambda: plant_of(([1.0], [0.0])), "den is zero"),
        (lambda: plant_of(([1.0, math.nan], [1.0, 1.0])), "not a finite number"),
        (lambda: plant_of(([[1.0]], [1.0, 1.0])), "num: must be one list of numbers"),
        (lambda: plant_of(("one", [1.0, 1.0])), "num: must be a list of numbers"),
        (lambda: plant_of(TEXTBOOK, delay_s=-1.0), "delay_s = -1.0"),
        (lambda: plant_of(control.tf([1], [1, 1], True)), "its period is not given"),
        (lambda: plant_of(control.tf([1], [1, 0.5], 0.1), delay_s=0.25), "not a whole number of periods"),
        (lambda: plant_of(UNSTABLE, name="filter", must_be_stable=True), r"filter: unstable \(pole at 1\)"),
        (lambda: plant_of(control.ss([[0.0]], [[0.0]], [[1.0]], 0)), "does not depend on its input"),
        (lambda: plane_of("kp-kp"), "plane 'kp-kp': must be two of kp, ki, kd"),
        (lambda: plane_of("kp-ki", math.inf), "finite number"),
        (lambda: DRegion(-1.0), "sigma_radps = -1.0"),
        (lambda: DRegion(zeta=1.0), "zeta = 1.0"),
        (lambda: DRegion(2.0, radius_radps=1.0), "radius_radps = 1.0"),
        (lambda: DRegion(zeta_within_radps=0.0), "zeta_within_radps = 0.0"),
        (lambda: region_of(TEXTBOOK, DRegion(3.0)), r"loop: no admissible gains .* farthest left .* Re s = -0\.\d+"),
        (lambda: region_of(TEXTBOOK, DRegion(), Window(3, 1, 0, 1)), "must be kp low < high"),
        (
            lambda: region_of(TEXTBOOK, DRegion(0.1, radius_radps=4.0), delay_s=0.1),
            "no radius can be kept with a delay",
        ),
        (lambda: region_of(TEXTBOOK, DRegion(0.1, 0.5), delay_s=0.1), "zeta_within_radps"),
        (lambda: region_of(control.tf([1, -1], [1, 1, -2]), DRegion()), r"no gain moves the pole at s = 1"),
        (lambda: region_of(control.tf([1, 1], [1, 2]), DRegion(), delay_s=0.1, plane="kp-kd"), "never stable"),
        (lambda: admissible_region([], plane_of("kp-ki")), "at least one case"),
        (lambda: region_of(TEXTBOOK, DRegion()).choose("best"), "rule 'best': must be one of centre, smallest"),
        (lambda: characteristic(plant_of(TEXTBOOK), plane_of("kp-ki"), Pid(-0.1)), "derivative_lag_s = -0.1"),
    ],
)
def test_a_mistake_is_one_line(action, text):
    with pytest.raises(UserError, match=text) as caught:
        action()
    assert "\n" not in str(caught.value)


def region_of(plant, region, window=None, delay_s=0.0, plane="kp-ki"):
    chosen = plane_of(plane, 0.0)
    return admissible_region([case_of("loop", plant, chosen, region, delay_s=delay_s)], chosen, window, cells=15)


def test_the_intersection_may_be_empty_where_each_alone_is_not():
    plane = plane_of("kp-kd", 0.0)
    up, down = (
        case_of(name, control.tf([sign], [1, 1, 0]), plane, DRegion(0.1)) for name, sign in (("up", 1), ("down", -1))
    )
    with pytest.raises(UserError, match="for all of up, down at once, though for each alone"):
        admissible_region([up, down], plane, Window(-5, 5, -5, 5))
    with pytest.raises(UserError, match="for all of up, down at once, though for each alone"):
        admissible_region([up, down], plane)


def test_a_plant_is_a_plant_already():
    plant = plant_of(TEXTBOOK, name="oven")
    assert isinstance(plant, Plant)
    assert plant_of(plant, delay_s=0.2).delay_s == 0.2
    assert plant.with_delay(0.3).delay_s == 0.3
