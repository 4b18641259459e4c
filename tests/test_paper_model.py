"""The paper's model and laws against other ways to compute the same."""

from __future__ import annotations

import math

import control
import numpy as np
import pytest

from sim.errors import UserError
from tools.paper import frequency, laws, sampled
from tools.paper.laws import BOTH, DOB, FEEDFORWARD, LAWS, PID, Gains, Law, Observer, close_loop
from tools.paper.plant import (
    CORRECTED,
    FORWARD,
    PRINTED,
    REVERSE,
    TABLE_4,
    PaperCar,
    Plant,
    matrices,
    numerator,
    steady_angle_per_curvature,
    transfer_function,
    zeros_and_poles,
)  # fmt: skip

GAINS = Gains(60.0, 10.0, 0.5)
OTHER = PaperCar("other", 9e4, 1.2, 1.1e5, 1.5, 1600.0, 2600.0)
PLANTS = [
    Plant(car, *way)
    for car in (TABLE_4, OTHER)
    for way in ((FORWARD, PRINTED), (REVERSE, PRINTED), (REVERSE, CORRECTED))
]


@pytest.mark.parametrize("plant", PLANTS, ids=lambda plant: f"{plant.car.name}-{plant.name}")
@pytest.mark.parametrize("speed", [0.1, 0.5, 1.0])
def test_transfer_function_is_that_of_the_state_space(plant: Plant, speed: float) -> None:
    a, b, _, c = matrices(plant, speed)
    for s in (0.03 + 0.4j, 2.0j, -1.0 + 30.0j, 900.0j):
        wanted = c @ np.linalg.solve(s * np.eye(4) - a, b)
        assert transfer_function(plant, speed)(s) == pytest.approx(wanted, rel=1e-9)


def test_zeros_as_in_the_notes_and_the_printed_reverse_is_a_copy_of_forward() -> None:
    slow = {v: zeros_and_poles(Plant(TABLE_4), v).zeros[0].real for v in (0.1, 0.5, 1.0)}
    assert slow == pytest.approx({0.1: -0.0488, 0.5: -0.222, 1.0: -0.400}, abs=5e-4)
    right = {v: zeros_and_poles(Plant(TABLE_4, REVERSE, CORRECTED), v).zeros[0].real for v in (0.1, 0.5, 1.0)}
    assert right == pytest.approx({0.1: 0.0513, 0.5: 0.286, 1.0: 0.666}, abs=1e-3)
    assert np.array_equal(numerator(Plant(TABLE_4, REVERSE, PRINTED), 0.7), numerator(Plant(TABLE_4), 0.7))
    poles = zeros_and_poles(Plant(TABLE_4), 1.0).poles
    assert sorted(p.real for p in poles) == pytest.approx([-469.39, -200.0, 0.0, 0.0], abs=0.01)


def test_the_corrected_sign_is_that_of_a_car_driving_backwards() -> None:
    """Eq. 11's tyres against forces and moments written down in the body's own frame at a negative speed."""
    car, v, beta_body, yaw_rate, angle = OTHER, -0.8, 0.03, 0.11, 0.2
    lateral = v * math.tan(beta_body)
    # A tyre's force opposes its own sideways motion; reversed rolling turns the angle between wheel and velocity.
    front = -car.front_stiffness * ((lateral + car.front_m * yaw_rate) / abs(v) - angle * v / abs(v))
    rear = -car.rear_stiffness * (lateral - car.rear_m * yaw_rate) / abs(v)
    yaw_acceleration = (car.front_m * front - car.rear_m * rear) / car.inertia_kgm2
    # In travel: everything turned by pi, so the side slip velocity changes its sign and yaw rate does not.
    a, b, _, _ = matrices(Plant(car, REVERSE, CORRECTED), abs(v))
    state = np.array([-lateral / abs(v), yaw_rate])
    assert a[1, :2] @ state + b[1] * angle == pytest.approx(yaw_acceleration, rel=1e-9)
    beta_rate = (-(front + rear) / car.mass_kg) / abs(v) - yaw_rate
    assert a[0, :2] @ state + b[0] * angle == pytest.approx(beta_rate, rel=1e-9)


def test_steady_turn() -> None:
    assert steady_angle_per_curvature(Plant(TABLE_4), 0.6) == pytest.approx(4.0)
    assert steady_angle_per_curvature(Plant(TABLE_4, REVERSE, CORRECTED), 0.6) == pytest.approx(-4.0)


@pytest.mark.parametrize("speed", [0.0, -1.0, math.nan])
def test_no_model_at_standstill(speed: float) -> None:
    with pytest.raises(UserError, match="divides by the speed"):
        matrices(Plant(TABLE_4), speed)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("plant", PLANTS, ids=lambda plant: f"{plant.car.name}-{plant.name}")
def test_closed_loop_is_the_block_diagram(plant: Plant, law: str) -> None:
    """e_y over curvature: (Gd + G F)(1 - Q) / ((1 - Q) + G C + Q / 1.01), from the diagram of Figures 9 and 10."""
    speed, observer = 0.6, Observer(80.0, 0.6, 1.1)
    loop = close_loop(plant, Law(law, GAINS, observer), speed)
    a, b, e, c = matrices(plant, speed)
    for s in (0.3j, 5.0j, 60.0j, 500.0j):
        inverse = np.linalg.inv(s * np.eye(4) - a)
        g, gd = c @ inverse @ b, c @ inverse @ e
        w = observer.bandwidth_radps
        q = w * w / (s * s + 2.0 * observer.damping * w * s + w * w) if law in (DOB, BOTH) else 0.0
        pid = GAINS.kp + GAINS.ki / s + GAINS.kd * s if law != DOB else 0.0
        ahead = steady_angle_per_curvature(plant, speed) if law == FEEDFORWARD else 0.0
        # The derivative of eq. 19 acts on the whole of e_y, so that C needs no case of its own.
        wanted = (gd + g * ahead) * (1.0 - q) / ((1.0 - q) + g * pid + q / observer.nominal_factor)
        found = np.linalg.solve(s * np.eye(laws.STATES) - loop.a, loop.e)[laws.ERROR]
        assert found == pytest.approx(wanted, rel=1e-6)


def test_margins_are_those_of_python_control() -> None:
    plant = transfer_function(Plant(TABLE_4), 1.0)
    loop = plant * control.TransferFunction([GAINS.kd, GAINS.kp, GAINS.ki], [1.0, 0.0])
    _, phase, _, crossover = control.margin(loop)
    found = frequency.margins_over_speed(Plant(TABLE_4), Law(PID, GAINS), np.array([1.0]))[0]
    assert found.phase_deg == pytest.approx(phase, abs=0.01)
    assert found.crossover_radps == pytest.approx(crossover, rel=1e-4)
    assert found.delay_s == pytest.approx(math.radians(phase) / crossover, rel=1e-3)


def test_the_dobs_delay_margin_goes_with_its_bandwidth_and_not_with_the_speed() -> None:
    rows = [
        frequency.margins_over_speed(Plant(TABLE_4), Law(DOB, GAINS, Observer(w)), np.array([0.1, 1.0]))
        for w in (10.0, 100.0)
    ]
    products = [w * m.delay_s for w, row in zip((10.0, 100.0), rows, strict=True) for m in row]
    assert products == pytest.approx([1.80] * 4, abs=0.01)


def test_sampled_loop_at_the_papers_bandwidth() -> None:
    plant, law = Plant(TABLE_4), Law(BOTH, GAINS)
    free = {m: sampled.spectral_radius(plant, law, 1.0, m, sampled.Path()) for m in sampled.METHODS}
    late = {m: sampled.spectral_radius(plant, law, 1.0, m, sampled.Path(1)) for m in sampled.METHODS}
    assert free.pop(sampled.FORWARD_EULER) > 2.0
    assert all(radius < 1.0 for radius in free.values())
    assert late.pop(sampled.MATCHED) < 1.0
    assert all(radius > 1.05 for radius in late.values())


def test_highest_stable_bandwidth_lies_between_a_stable_and_an_unstable_one() -> None:
    plant, law, path = Plant(TABLE_4), Law(BOTH, GAINS), sampled.Path(2)
    found = sampled.highest_stable_bandwidth(plant, law, sampled.TUSTIN, path)
    assert 25.0 < found < 40.0
    above = law._replace(observer=Observer(found * 1.2))
    assert max(sampled.spectral_radius(plant, above, v, sampled.TUSTIN, path) for v in sampled.SPEEDS_MPS) > 1.0
