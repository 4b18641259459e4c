"""The textbook laws, plain: right on the path, back to it from beside it, in both directions and on both sides."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from compare_support import tables

from firmware_py.core.path import feedforward_curvature_1pm, plan_at, pose_at
from firmware_py.core.tables import LegTable
from tools.compare import gains, laws, mpc
from tools.compare.laws import LAW_SLOTS, PERIOD_S, Seen, on_path
from tools.compare.mpc import STEP_S, Mpc, no_solver
from tools.compare.rows import seen_at
from tools.compare.runs import CONTROLLERS, gain_table
from tools.design.model import straight_leg

OTHERS = [name for name in CONTROLLERS if name != "car"]
STEERING_BACK = [name for name in OTHERS if name != "ff"]
DIRECTIONS = (0, 1)


class Law:
    """A law with the numbers of its guess as it is called plain, with its gains, solver and memory."""

    def __init__(self, name: str, side: Any = "left") -> None:
        self.law = CONTROLLERS[name].law
        self.numbers = CONTROLLERS[name].guess
        self.car, self.legs = tables(side).car, tables(side).leg
        self.table = gain_table(self.law, self.numbers, tables(side)).tolist()
        self.memory = [0.0] * LAW_SLOTS
        self.solver = Mpc(self.car, self.legs, self.numbers) if self.law == laws.MPC else None

    def __call__(self, leg: LegTable, seen: Seen) -> float:
        solve = self.solver.solve if self.solver else no_solver
        return laws.steer(self.law, self.numbers, self.table, leg, self.car, seen, self.memory, solve)


@pytest.mark.parametrize("direction", DIRECTIONS)
@pytest.mark.parametrize("name", [name for name in OTHERS if name != "pid"])
def test_on_the_path_a_law_steers_what_the_path_asks_for(name: str, direction: int) -> None:
    # PID without feedforward asks for nothing there. The others differ by what they see of the path ahead.
    leg = tables().leg[direction]
    worst = 0.0
    for station in np.linspace(0.5, leg.length_m - 1.5, 25):
        law = Law(name)
        seen = seen_at(tables(), direction, float(station), 0.0, 0.0)
        asked = math.atan(law.car.wheelbase_m * feedforward_curvature_1pm(leg, float(station)))
        worst = max(worst, abs(law(leg, seen) - asked))
    assert worst < (0.12 if name == "pure-pursuit" else 0.06), worst


@pytest.mark.parametrize("name", OTHERS)
def test_the_right_side_is_the_mirror(name: str) -> None:
    for direction in DIRECTIONS:
        left, right = Law(name), Law(name, "right")
        for station in (2.0, 5.0, 8.0):
            seen = seen_at(tables(), direction, station, 0.01, -0.004)
            mirrored = seen_at(tables("right"), direction, station, -0.01, 0.004)
            angle, other = left(left.legs[direction], seen), right(right.legs[direction], mirrored)
            assert other == pytest.approx(-angle, abs=2e-5)


@pytest.mark.parametrize("direction", DIRECTIONS)
@pytest.mark.parametrize("name", STEERING_BACK)
def test_a_law_brings_the_car_back_to_the_path(name: str, direction: int) -> None:
    """A kinematic car of the test's own, 3 cm left of the path: it comes nearer, and it stays near."""
    law = Law(name)
    leg = law.legs[direction]
    x, y, yaw, slip, _ = pose_at(leg, 0.0)
    x, y, yaw = x - 0.03 * math.sin(yaw), y + 0.03 * math.cos(yaw), yaw + slip
    station = 0.0
    errors = []
    angle = 0.0
    for _ in range(3000):
        station, cross, heading = on_path(leg, station, x, y, yaw)
        if station > leg.length_m - 0.3:
            break
        errors.append(cross)
        speed = max(plan_at(leg, station)[0], 0.1)
        velocity = leg.sigma * speed
        rate = velocity * math.tan(angle) / law.car.wheelbase_m
        ahead = (station, cross, heading, angle)
        seen = Seen(
            x, y, yaw, station, cross, heading, *ahead, speed, speed * PERIOD_S, rate, angle, angle, 0
        )  # fmt: skip
        angle = max(min(law(leg, seen), 0.5), -0.5)
        turned = velocity * math.tan(angle) / law.car.wheelbase_m * PERIOD_S
        course = yaw + 0.5 * turned - pose_at(leg, station)[3]
        x += velocity * PERIOD_S * math.cos(course)
        y += velocity * PERIOD_S * math.sin(course)
        yaw += turned
    assert station > leg.length_m - 0.3
    # Without feedforward the path's own bends are errors of 0.1 m.
    assert max(map(abs, errors)) < (0.15 if name == "pid" else 0.045)
    assert abs(errors[-1]) < (0.05 if name in ("pid", "stanley") else 0.012)
    if law.solver is not None:
        assert law.solver.failures == 0


def test_feedforward_alone_does_not_steer_back() -> None:
    law = Law("ff")
    leg = law.legs[0]
    beside = law(leg, seen_at(tables(), 0, 5.0, 0.05, 0.02))
    assert beside == law(leg, seen_at(tables(), 0, 5.0, 0.0, 0.0))


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_pure_pursuit_arc_meets_its_goal(direction: int) -> None:
    leg, car = tables().leg[direction], tables().car
    seen = seen_at(tables(), direction, 4.0, 0.03, 0.01)
    angle = laws.pure_pursuit_rad(leg, car, seen, 1.0, 0.0)
    goal_x, goal_y, _, _, _ = pose_at(leg, 5.0)
    _, _, _, slip, slip_curvature = pose_at(leg, 4.0)
    curvature = math.tan(angle) / car.wheelbase_m - slip_curvature
    course = seen.yaw_rad - slip
    centre_x = seen.x_m - math.sin(course) / curvature
    centre_y = seen.y_m + math.cos(course) / curvature
    assert math.hypot(goal_x - centre_x, goal_y - centre_y) == pytest.approx(1.0 / abs(curvature), abs=1e-9)


def test_lqr_without_lag_is_the_lqr_with_a_lag_of_nothing() -> None:
    car = tables().car._replace(steering_lag_s=0.0)
    blind, aware = gains.lqr_rows(4.0, 2.0), gains.lqr_preview_rows(car, 4.0, 2.0)
    assert np.allclose(aware[:, :2], blind, rtol=1e-6)
    assert np.allclose(aware[:, 2], 0.0, atol=1e-9)


@pytest.mark.parametrize("speed", [0.05, 1.0])
def test_preview_gains_are_the_optimum(speed: float) -> None:
    """Least squares over a long horizon, the path's steps known: the first input is that of the gains."""
    car = tables().car
    q_e, q_theta, horizon = 4.0, 2.0, 12_00
    row = gains.lqr_preview_rows(car, q_e, q_theta)[round(speed / 0.05) - 1]
    a, b, d = gains.lagging_model(speed, car.steering_lag_s, PERIOD_S)
    ds = speed * PERIOD_S
    rng = np.random.default_rng(3)
    steps = np.zeros(horizon)
    steps[: laws.PREVIEW_CYCLES] = 1e-3 * rng.standard_normal(laws.PREVIEW_CYCLES)
    start = np.array([0.01, -0.004, 0.003])
    # Dynamic programming with the affine term, backwards.
    p = gains.riccati(a, b, ds * np.diag([q_e, q_theta, 0.0]), ds)
    pull = np.zeros((3, 1))
    for step in steps[::-1]:
        inverse = np.linalg.inv(ds + b.T @ p @ b)
        gain, offset = inverse @ b.T @ p @ a, inverse @ b.T @ (p @ d * step + pull)
        pull = (a - b @ gain).T @ (p @ d * step + pull)
    wanted = -float((gain @ start)[0] + offset[0, 0])
    ours = -float(row[:3] @ start + row[3:] @ steps[: laws.PREVIEW_CYCLES])
    assert ours == pytest.approx(wanted, rel=1e-6)


@pytest.mark.parametrize("sigma", [1.0, -1.0])
def test_mpc_far_from_its_limits_is_the_lqr_of_its_model(sigma: float) -> None:
    car = tables().car
    leg = straight_leg(sigma)
    numbers = (4.0, 2.0, 1e-6)
    solver = Mpc(car, (leg, straight_leg(-sigma)), numbers)
    speed, state = 0.8, np.array([2e-3, 1e-3, 5e-4])
    a, b, _ = gains.lagging_model(speed, car.steering_lag_s, STEP_S)
    ds = speed * STEP_S
    p = gains.riccati(a, b, ds * np.diag([4.0, 2.0, 0.0]), ds)
    k = np.linalg.solve(ds + b.T @ p @ b, b.T @ p @ a)[0]
    angle = math.atan(car.wheelbase_m * state[2])
    command = solver.solve(sigma, 500.0, speed, state[0], state[1], angle, angle)
    assert math.tan(command) / car.wheelbase_m == pytest.approx(-float(k @ state), rel=5e-3)
    assert solver.failures == 0


def test_mpc_keeps_the_rate_and_the_angle() -> None:
    car = tables().car
    leg = straight_leg(1.0)
    solver = Mpc(car, (leg, straight_leg(-1.0)), (100.0, 2.0, 1e-6))
    step = car.max_road_wheel_rate_radps * STEP_S
    assert solver.solve(1.0, 500.0, 0.8, -0.5, 0.0, 0.0, 0.0) == pytest.approx(step, rel=0.03)
    near = car.max_road_wheel_angle_rad - 0.2 * step
    assert solver.solve(1.0, 500.0, 0.8, -0.9, 0.0, near, near) == pytest.approx(
        car.max_road_wheel_angle_rad, abs=0.1 * step
    )


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_the_observer_finds_a_steering_bias(direction: int) -> None:
    """A car that turns by 0.004 1/m more than its wheels say, straight path, wheels held straight."""
    car = tables().car
    leg = straight_leg(1.0 - 2.0 * direction)
    memory = [0.0] * LAW_SLOTS
    bias, cross, theta, ds = 0.004, 0.0, 0.0, 0.008
    found = 0.0
    for _ in range(800):
        zero = (500.0, cross, leg.sigma * theta)
        seen = Seen(500.0, cross, leg.sigma * theta, *zero, *zero, 0.0, 0.8, ds, 0.0, 0.0, 0.0, 0)
        found = laws._dob_1pm(leg, car, seen, 0.8, memory)
        cross += ds * theta
        theta += ds * bias
    assert found == pytest.approx(bias, rel=0.03)


def test_the_solver_is_called_from_compiled_code_and_its_error_comes_out() -> None:
    import numba  # noqa: PLC0415

    def fails(*_numbers: float) -> float:
        raise ValueError("no")

    @numba.njit
    def call(solve: Any, x: float) -> float:
        return solve(x, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

    good, bad = mpc.callback(lambda *numbers: 2.0 * numbers[0]), mpc.callback(fails)
    assert call(good, 3.0) == 6.0
    assert good.error is None
    assert math.isnan(call(bad, 3.0))
    assert isinstance(bad.error, ValueError)
