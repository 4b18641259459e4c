"""The plant's body and tyres: geometry, understeer, energy, reverse, standstill, stability, and convergence."""

from __future__ import annotations

import math
import types
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import sim.tyre
import sim.vehicle
from sim.tyre import brush_factor
from sim.vehicle import PlantParameters, PlantState, plant_parameters, rear_axle_pose, state_at_rest, step

PAPER = plant_parameters(3000.0, 5113.0, 4.0, 2.0, 3e5, 3e5, 0.8, 0.4)
WHEELBASE = 4.0
MS = 1.0e-3


def drive(p: PlantParameters, s: PlantState, speed: float, angle: float, seconds: float, h: float = MS) -> PlantState:
    for _ in range(round(seconds / h)):
        s = step(p, s, speed, angle, h)
    return s


def at_rest(p: PlantParameters = PAPER) -> PlantState:
    return state_at_rest(p, 0.0, 0.0, 0.0)


# ------------------------------------------------------------------------------------------------------ steady state


@pytest.mark.parametrize("speed", [1.0, 0.1, 0.01, -0.01, -0.1, -1.0])
@pytest.mark.parametrize("angle", [-0.5, -0.1, 0.3, 0.5])
def test_the_turn_radius_is_that_of_the_geometry(speed: float, angle: float) -> None:
    """Yaw rate over signed speed = tan(angle) / wheelbase, with its sign in both directions; slip takes 0.1 %."""
    s = drive(PAPER, at_rest(), speed, angle, 6.0)
    curvature = s.yaw_rate_radps / speed
    assert curvature == pytest.approx(math.tan(angle) / WHEELBASE, rel=1.5e-3 * speed * speed + 2e-6)
    assert s.lateral_accel_mps2 == pytest.approx(speed * s.yaw_rate_radps, rel=1e-6)


def test_the_rear_axle_runs_on_a_circle_of_that_radius() -> None:
    angle = 0.4
    radius = WHEELBASE / math.tan(angle)
    s = drive(PAPER, at_rest(), 0.1, angle, 1.0)
    x, y, yaw = rear_axle_pose(PAPER, s)
    centre = x - radius * math.sin(yaw), y + radius * math.cos(yaw)
    for _ in range(5):
        s = drive(PAPER, s, 0.1, angle, 20.0, 4 * MS)
        x, y, _ = rear_axle_pose(PAPER, s)
        assert math.hypot(x - centre[0], y - centre[1]) == pytest.approx(radius, rel=2e-5)


@pytest.mark.parametrize(("rear_share", "sign"), [(0.6, -1.0), (0.5, 0.0), (0.4, 1.0)])
def test_understeer_gradient(rear_share: float, sign: float) -> None:
    """Equal stiffnesses: the car understeers when the front axle carries more (centre of gravity ahead)."""
    cg_to_rear = WHEELBASE * (1.0 - rear_share)
    p = plant_parameters(3000.0, 5113.0, WHEELBASE, cg_to_rear, 3e5, 3e5, 5.0, 0.4)
    gradient = 3000.0 * (cg_to_rear / 3e5 - (WHEELBASE - cg_to_rear) / 3e5) / WHEELBASE
    assert math.copysign(1.0, gradient) == sign or abs(gradient) < 1e-12
    angle, speed = 0.02, 6.0
    s = drive(p, at_rest(p), speed, angle, 8.0)
    accel = speed * s.yaw_rate_radps
    # angle = wheelbase * curvature + gradient * lateral acceleration (small angles; brush share near 1 by friction 5)
    assert angle == pytest.approx(WHEELBASE * accel / speed**2 + gradient * accel, rel=4e-3)


def test_slip_carries_the_lateral_force() -> None:
    s = drive(PAPER, at_rest(), 1.0, 0.3, 4.0)
    force = 0.5 * 3000.0 * s.lateral_accel_mps2  # half on each axle
    friction = PAPER.friction_rear_n
    assert -s.slip_rear_rad * 3e5 * brush_factor(3e5 * s.slip_rear_rad, friction) == pytest.approx(force, rel=1e-4)
    assert s.slip_rear_rad < 0.0 < force


def test_slip_relaxes_over_distance_not_time() -> None:
    """The steady state is approached over the same few relaxation lengths at any speed."""
    shares = []
    for speed in (0.2, 0.4):
        s, steady = at_rest(), drive(PAPER, at_rest(), speed, 0.2, 4.0 / speed)
        s = drive(PAPER, s, speed, 0.2, 0.6 / speed)
        assert s.yaw_rate_radps == pytest.approx(steady.yaw_rate_radps, rel=0.02)
        shares.append(s.slip_rear_rad / steady.slip_rear_rad)
    assert shares[0] == pytest.approx(shares[1], rel=0.2)


def test_tyres_saturate_at_the_friction_limit() -> None:
    """At 12 m/s with the wheels hard over the car slides: lateral acceleration stays below friction times g."""
    s = drive(PAPER, at_rest(), 12.0, 0.4, 3.0)
    assert 0.6 * 0.8 * 9.81 < abs(s.lateral_accel_mps2) < 0.8 * 9.81 * 1.01
    assert abs(s.yaw_rate_radps / 12.0) < 0.6 * math.tan(0.4) / WHEELBASE


def test_brush_factor_by_hand() -> None:
    assert brush_factor(0.0, 1.0) == 1.0
    assert brush_factor(1.0, 1.0) == pytest.approx(1.0 - 1.0 / 3.0 + 1.0 / 27.0)
    assert brush_factor(-1.0, 1.0) == brush_factor(1.0, 1.0)
    assert brush_factor(3.0, 1.0) == pytest.approx(1.0 / 3.0)  # sliding begins: the whole friction force
    assert 9.0 * brush_factor(9.0, 1.0) == pytest.approx(1.0)
    below, above = 3.0 - 1e-9, 3.0 + 1e-9
    assert below * brush_factor(below, 1.0) == pytest.approx(above * brush_factor(above, 1.0), abs=1e-8)


# --------------------------------------------------------------------------------------------------------- reversing


def test_reverse_retraces_the_forward_path() -> None:
    """Slow, with the same wheel angle: the rear axle goes back where it came from."""
    s = drive(PAPER, at_rest(), 0.2, 0.3, 5.0)
    far = rear_axle_pose(PAPER, s)
    assert math.hypot(far[0], far[1]) > 0.9
    s = drive(PAPER, s, -0.2, 0.3, 5.0)
    x, y, yaw = rear_axle_pose(PAPER, s)
    assert (x, y, yaw) == pytest.approx((0.0, 0.0, 0.0), abs=2e-3)
    assert s.speed_mps == -0.2


def test_left_and_right_are_mirror_images() -> None:
    left, right = at_rest(), at_rest()
    for i in range(4000):
        angle = 0.4 * math.sin(2e-3 * i)
        left, right = step(PAPER, left, 0.8, angle, MS), step(PAPER, right, 0.8, -angle, MS)
    mirrored = right._replace(
        y_m=-right.y_m,
        yaw_rad=-right.yaw_rad,
        lateral_velocity_mps=-right.lateral_velocity_mps,
        yaw_rate_radps=-right.yaw_rate_radps,
        slip_front_rad=-right.slip_front_rad,
        slip_rear_rad=-right.slip_rear_rad,
        lateral_accel_mps2=-right.lateral_accel_mps2,
    )
    assert left == mirrored  # exactly


def test_reversing_a_symmetric_car_is_driving_it_forward_steered_at_the_rear() -> None:
    """Seen from the rear, a reversing car is one with rear steering: its front swings out.

    Turning in: the front axle of a car that goes backwards with the wheels to the left moves to its right first.
    """
    s = drive(PAPER, at_rest(), -0.5, 0.3, 0.5)
    front = s.lateral_velocity_mps + 2.0 * s.yaw_rate_radps
    assert s.yaw_rate_radps < 0.0  # wheels left, backwards: clockwise
    assert front < 0.0
    rear = s.lateral_velocity_mps - 2.0 * s.yaw_rate_radps
    assert abs(rear) < 0.02 * abs(front)


# -------------------------------------------------------------------------------------------------------- standstill


def test_at_standstill_nothing_moves_at_all() -> None:
    s = drive(PAPER, at_rest(), 1.0, 0.3, 2.0)
    s = step(PAPER, s, 0.0, 0.3, MS)
    stopped = step(PAPER, s, 0.0, 0.3, MS)
    for angle in (0.3, -0.5, 0.5, 0.0):
        after = drive(PAPER, stopped, 0.0, angle, 1.0)
        assert after == stopped
    assert (stopped.speed_mps, stopped.yaw_rate_radps, stopped.lateral_velocity_mps) == (0.0, 0.0, 0.0)
    assert stopped.lateral_accel_mps2 == 0.0


def test_wheels_turned_at_standstill_act_from_the_first_millimetre_on() -> None:
    s = at_rest()
    for i in range(200):
        s = step(PAPER, s, 5e-6 * (i + 1), 0.4, MS)
    moved = s.x_m - 2.0
    assert 1e-5 < moved < 2e-4
    assert s.yaw_rate_radps / s.speed_mps == pytest.approx(math.tan(0.4) / WHEELBASE, rel=0.02)


# ------------------------------------------------------------------------------------------- stability and accuracy


@pytest.mark.parametrize("speed", [0.001, 0.01, 0.1, 1.0, -0.01, -1.0])
@pytest.mark.parametrize("relaxation", [0.02, 0.4, 3.0])
@pytest.mark.parametrize("h", [1e-3, 1e-4])
def test_a_disturbed_car_settles_at_any_walking_speed(speed: float, relaxation: float, h: float) -> None:
    """An explicit step blows up here at 1 ms; this one loses the sway of a shove."""
    p = plant_parameters(3000.0, 5113.0, 4.0, 2.0, 3e5, 3e5, 0.8, relaxation)
    s = state_at_rest(p, 0.0, 0.0, 0.0)._replace(speed_mps=speed, lateral_velocity_mps=0.05, yaw_rate_radps=0.05)
    peak = 0.0
    for _ in range(round(1.5 / h)):
        s = step(p, s, speed, 0.0, h)
        peak = max(peak, abs(s.lateral_velocity_mps), abs(s.yaw_rate_radps))
    assert peak < 0.1
    assert abs(s.lateral_velocity_mps) < 2e-3
    assert abs(s.yaw_rate_radps) < 2e-3


def test_the_tyres_only_take_energy() -> None:
    """Kinetic energy of the sway and elastic energy of the tyres together never rise while the car rolls straight."""
    for speed in (1e-9, 0.05, 1.0):
        s = at_rest()._replace(speed_mps=speed, lateral_velocity_mps=0.03, yaw_rate_radps=-0.02)
        last = math.inf
        for _ in range(1500):
            s = step(PAPER, s, speed, 0.0, MS)
            # The centripetal term moves energy between sway and the drive that holds the speed; it is small here.
            elastic = 0.5 * 3e5 * 0.4 * (s.slip_front_rad**2 + s.slip_rear_rad**2)
            energy = 0.5 * 3000.0 * s.lateral_velocity_mps**2 + 0.5 * 5113.0 * s.yaw_rate_radps**2 + elastic
            assert energy <= last * (1.0 + 1e-4 * speed) + 1e-12
            last = energy
        assert last < 1e-3


def profile(t: float) -> tuple[float, float]:
    """Speed and wheel angle of a hard manoeuvre with a reversal: 0.8 m/s ahead, back, and 0.5 rad both ways."""
    return 0.8 * math.sin(0.5 * t), 0.5 * math.sin(1.3 * t)


def by_steps(h: float, seconds: float, p: PlantParameters = PAPER) -> PlantState:
    s = state_at_rest(p, 0.0, 0.0, 0.0)
    for i in range(round(seconds / h)):
        s = step(p, s, *profile((i + 1) * h), h)
    return s


def test_1_ms_agrees_with_a_tenth_of_it() -> None:
    coarse, fine = by_steps(1e-3, 12.0), by_steps(1e-4, 12.0)
    for a, b in zip(rear_axle_pose(PAPER, coarse), rear_axle_pose(PAPER, fine), strict=True):
        assert a == pytest.approx(b, abs=3e-5)
    half = by_steps(5e-4, 12.0)
    error, smaller = (math.dist(rear_axle_pose(PAPER, s)[:2], rear_axle_pose(PAPER, fine)[:2]) for s in (coarse, half))
    assert smaller < 0.7 * error  # it converges


def independent(p: PlantParameters) -> Callable[[float, np.ndarray], list[float]]:
    """The same physics written down anew: wheel-frame velocities, forces, Newton and Euler in the ground frame."""
    m, inertia, lf, lr, cf, cr, mu_f, mu_r, sigma, df, dr = p[:11]

    def force(stiffness: float, damping: float, limit: float, slip: float, slip_rate: float) -> float:
        z = stiffness * slip / limit
        share = 1 - abs(z) / 3 + z * z / 27 if abs(z) < 3 else 1 / abs(z)
        return -share * (stiffness * slip + damping * sigma * slip_rate)

    def rates(t: float, q: np.ndarray) -> list[float]:
        _, _, psi, vy, r, af, ar = q
        vx, delta = profile(t)
        front = np.array([vx, vy + lf * r])
        wheel = np.array([math.cos(delta), math.sin(delta)])
        across = np.array([-wheel[1], wheel[0]])
        af_rate = (front @ across - abs(front @ wheel) * af) / sigma
        ar_rate = (vy - lr * r - abs(vx) * ar) / sigma
        front_force = force(cf, df, mu_f, af, af_rate) * across[1]
        rear_force = force(cr, dr, mu_r, ar, ar_rate)
        return [
            vx * math.cos(psi) - vy * math.sin(psi),
            vx * math.sin(psi) + vy * math.cos(psi),
            r,
            (front_force + rear_force) / m - vx * r,
            (lf * front_force - lr * rear_force) / inertia,
            af_rate,
            ar_rate,
        ]

    return rates


@pytest.mark.parametrize(
    "p",
    [PAPER, plant_parameters(1800.0, 3300.0, 2.85, 1.55, 1.2e5, 1.3e5, 0.8, 0.35)],
    ids=["paper", "fusion"],
)
def test_against_an_independent_integration(p: PlantParameters) -> None:
    seconds = 12.0
    begin = [p.cg_to_rear_axle_m, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    answer = solve_ivp(independent(p), (0.0, seconds), begin, method="LSODA", rtol=1e-9, atol=1e-11, max_step=0.02)
    assert answer.success
    x, y, yaw, vy, r, af, ar = answer.y[:, -1]
    ours = by_steps(MS, seconds, p)
    assert (ours.x_m, ours.y_m, ours.yaw_rad) == pytest.approx((x, y, yaw), abs=5e-5)
    assert (ours.lateral_velocity_mps, ours.yaw_rate_radps) == pytest.approx((vy, r), abs=3e-4)
    assert (ours.slip_front_rad, ours.slip_rear_rad) == pytest.approx((af, ar), abs=2e-5)
    assert math.hypot(x - begin[0], y) > 0.05  # it did go somewhere


# --------------------------------------------------------------------------------------------------------- compiling


def compiled(function: Callable[..., Any], **replaced: Any) -> Callable[..., Any]:
    numba = pytest.importorskip("numba")
    copy = types.FunctionType(function.__code__, {**function.__globals__, **replaced}, function.__name__)
    result: Callable[..., Any] = numba.njit(copy)
    return result


def test_the_step_compiles_and_gives_the_same_bits() -> None:
    fast = compiled(
        sim.vehicle.step,
        brush_factor=compiled(sim.tyre.brush_factor),
        step_eq11=compiled(sim.vehicle.step_eq11),
    )
    plain = quick = at_rest()
    for i in range(3000):
        speed, angle = profile(i * 2e-3)
        plain, quick = step(PAPER, plain, speed, angle, MS), fast(PAPER, quick, speed, angle, MS)
        assert tuple(plain) == tuple(quick)
