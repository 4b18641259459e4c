"""Gain schedules: the linear model is the firmware's, the Kalman gains are a Riccati recursion's, the PID is chosen."""

import math
import random
from itertools import pairwise

import numpy as np
import pytest
from design_support import (
    PERIOD_S,
    FirmwareLaw,
    StraightRoad,
    car_table,
    designed,
    row_at,
    station_state,
    straight_leg,
    vehicle_of,
)

from firmware_py.core.motion import PathState, advance
from firmware_py.core.schedule import gains_at
from firmware_py.core.tables import GainTable
from firmware_py.table_file import GAINS_COLUMNS
from sim.errors import UserError
from tools.design import gains as design
from tools.design import model

WHEELBASE_M = 4.0
DIRECTIONS = (1.0, -1.0)


def rows_of(table, direction):
    return [model.Row(*row) for row in table if row[0] == direction]


# The linear model


@pytest.mark.parametrize("direction", DIRECTIONS)
@pytest.mark.parametrize("lag_s", [0.0, 0.1, 0.27])
def test_the_observers_model_is_the_firmwares_motion_linearised(direction, lag_s):
    leg, car = straight_leg(direction), car_table(model.Nominal(lag_s, 2))
    f, g = model.motion(0.7, direction, lag_s)
    tiny = 1e-6

    def moved(values, command):
        e, heading, disturbance, curvature = values
        state = PathState(100.0, e, heading, disturbance, math.atan(WHEELBASE_M * curvature))
        after = station_state(advance(leg, car, state, math.atan(WHEELBASE_M * command), 0.7, PERIOD_S))
        return np.array([*after[:3], math.tan(after[3]) / WHEELBASE_M])

    for column in range(4):
        change = tiny * np.eye(4)[column]
        assert (moved(change, 0.0) - moved(-change, 0.0)) / (2 * tiny) == pytest.approx(f[:, column], abs=1e-9)
    assert (moved(np.zeros(4), tiny) - moved(np.zeros(4), -tiny)) / (2 * tiny) == pytest.approx(g, abs=1e-9)


@pytest.mark.parametrize("direction", DIRECTIONS)
@pytest.mark.parametrize(("lag_s", "latency"), [(0.1, 2.3), (0.0, 0.0), (0.0, 0.3), (0.27, 5.0), (0.2, 0.8)])
def test_the_cars_model_is_a_car_driven_in_small_steps(direction, lag_s, latency):
    corner = model.Corner("", lag_s, latency, 0.9)
    system = model.car(corner, 0.8, direction)
    road = StraightRoad(corner, 0.8, direction)
    rng = random.Random(3)
    state = np.zeros((len(system.a), 1))
    for _ in range(200):
        assert (system.c @ state)[:, 0] == pytest.approx([road.e_m, road.heading_rad], rel=3e-3, abs=2e-8)
        curvature = rng.uniform(-1e-3, 1e-3)
        road.drive(math.atan(WHEELBASE_M * curvature))
        state = system.a @ state + system.b * curvature
    assert abs(road.e_m) > 1e-5


@pytest.mark.parametrize("direction", DIRECTIONS)
@pytest.mark.parametrize("law", design.LAWS)
@pytest.mark.parametrize("nominal", [model.Nominal(0.1, 2), model.Nominal(0.0, 0), model.Nominal(0.27, 25)])
def test_the_controllers_model_answers_as_the_firmware_does(direction, law, nominal):
    predicts = law in design.PREDICTING_LAWS
    row = row_at(designed()[law], direction, 0.6)
    system = model.controller(row, nominal, predicts)
    firmware = FirmwareLaw(row, nominal, predicts)
    rng = random.Random(4)
    state = np.zeros((len(system.a), 1))
    largest = 0.0
    for _ in range(300):
        pose = np.array([[rng.uniform(-1e-4, 1e-4)], [rng.uniform(-1e-5, 1e-5)]])
        wanted = (system.c @ state + system.d @ pose).item()
        given = math.tan(firmware.command_rad(*pose[:, 0])) / WHEELBASE_M
        assert given == pytest.approx(wanted, rel=1e-4, abs=1e-9)
        state = system.a @ state + system.b @ pose
        largest = max(largest, abs(wanted))
    assert largest > 1e-5


@pytest.mark.parametrize("law", design.LAWS)
@pytest.mark.parametrize("nominal", [model.Nominal(0.1, 2), model.Nominal(0.0, 0)])
def test_frequency_responses_are_those_of_the_matrices(law, nominal):
    predicts = law in design.PREDICTING_LAWS
    z = design.on_circle(design.frequencies(0.5, 25))
    row = row_at(designed()[law], -1.0, 0.5)

    def response(system):
        return np.array([(system.c @ np.linalg.solve(s * np.eye(len(system.a)) - system.a, system.b)) for s in z])

    for corner in (model.Corner("", 0.1, 2.35, 1.1), model.Corner("", 0.0, 0.0, 1.0), model.Corner("", 0.2, 3.0, 0.9)):
        loop = model.loop_response(row, nominal, [corner], z, predicts)[0]
        assert loop == pytest.approx(response(model.open_loop(row, nominal, corner, predicts))[:, 0, 0], rel=1e-5)


def test_in_reverse_the_loop_is_the_same_loop():
    nominal, corner = model.Nominal(0.1, 2), model.Corner("", 0.2, 3.0, 1.1)
    forward, reverse = (
        np.sort_complex(
            model.poles_1pm(model.closed_loop(row_at(designed()["car"], d, 0.8), nominal, corner), 0.8).round(3)
        )[-6:]
        for d in DIRECTIONS
    )
    assert forward == pytest.approx(reverse)
    mixed = row_at(designed()["car"], 1.0, 0.8)._replace(direction=-1.0)
    assert not model.is_stable(model.closed_loop(mixed, nominal, corner)), "forward's gains belong to forward"


# The observer


def riccati_recursion(direction, speed_mps, noise, cycles):
    """Kalman gains after so many cycles from a wide start, by the textbook's recursion."""
    f, h, q, r = design.observer_model(direction, speed_mps, noise)
    covariance = np.diag([1.0, 0.1, 0.01])
    gain = np.zeros((3, 2))
    for _ in range(cycles):
        gain = covariance @ h.T @ np.linalg.inv(h @ covariance @ h.T + r)
        kept = np.eye(3) - gain @ h
        # Joseph's form keeps the covariance symmetric and positive.
        covariance = kept @ covariance @ kept.T + gain @ r @ gain.T
        covariance = f @ covariance @ f.T + q
    return gain


@pytest.mark.parametrize(("direction", "speed_mps"), [(1.0, 1.0), (-1.0, 1.0), (1.0, 0.1), (-1.0, 0.035)])
def test_kalman_gains_are_what_the_riccati_recursion_settles_at(direction, speed_mps):
    noise = design.observer_noise(design.OBSERVER_PACES[0])
    recursion = riccati_recursion(direction, speed_mps, noise, 12000)
    solved = design.observer_gains(direction, speed_mps, noise)
    assert solved == pytest.approx(recursion, rel=1e-5, abs=1e-9)
    assert np.abs(solved).max() > 0.01


def test_the_tables_hold_the_observer_and_nothing_at_standstill():
    for direction in DIRECTIONS:
        for row in rows_of(designed()["car"], direction):
            if row.speed_mps == 0.0:
                assert row[6:] == (0.0,) * 6
            else:
                expected = design.observer_gains(
                    direction, row.speed_mps, design.observer_noise(design.OBSERVER_PACES[0])
                )
                assert row[6:] == pytest.approx(tuple(expected.reshape(-1)))
        assert all(row[6:] == (1.0, 0.0, 0.0, 1.0, 0.0, 0.0) for row in rows_of(designed()["pid_ff"], direction))


# The tables


def test_tables_have_the_firmwares_form():
    assert design.COLUMNS == GAINS_COLUMNS
    assert set(designed()) == set(design.LAWS)
    for table in designed().values():
        assert [row[:2] for row in table] == [(d, v) for d in DIRECTIONS for v in design.SPEED_GRID_MPS]
        assert all(isinstance(value, float) and math.isfinite(value) for row in table for value in row)
    assert design.SPEED_GRID_MPS[0] == 0.0
    assert design.SPEED_GRID_MPS[-1] == 1.0
    assert 14 <= len(design.SPEED_GRID_MPS) <= 20


def test_in_reverse_only_the_observers_cross_terms_change_their_sign():
    for table in designed().values():
        for ahead, back in zip(rows_of(table, 1.0), rows_of(table, -1.0), strict=True):
            signs = (-1, 1, 1, 1, 1, 1, 1, -1, -1, 1, 1, -1)
            assert back == pytest.approx(tuple(s * v for s, v in zip(signs, ahead, strict=True)), rel=1e-6, abs=1e-12)


@pytest.mark.parametrize("law", design.LAWS)
@pytest.mark.parametrize("direction", DIRECTIONS)
def test_gains_are_smooth_over_speed(law, direction):
    rows = rows_of(designed("paper", "slow-rack")[law], direction)
    for low, high in pairwise(rows[1:]):
        for name in ("kp", "ki", "kd", "l_ee", "l_ep", "l_pe", "l_pp", "l_de", "l_dp"):
            a, b = getattr(low, name), getattr(high, name)
            assert abs(b - a) <= 0.62 * max(abs(a), abs(b)), (name, low.speed_mps)


@pytest.mark.parametrize("direction", [0, 1])
def test_between_two_rows_the_firmware_has_nearly_the_observer_of_that_speed(direction):
    table = designed()["car"]
    grid = design.SPEED_GRID_MPS
    gain = tuple(tuple(tuple(row[2:]) for row in rows_of(table, d)) for d in DIRECTIONS)
    firmware = GainTable(grid, len(grid) - 1, gain)
    for low, high in pairwise(grid[1:]):
        speed = 0.5 * (low + high)
        exact = design.observer_gains(
            DIRECTIONS[direction], speed, design.observer_noise(design.OBSERVER_PACES[0])
        ).reshape(-1)
        assert np.array(gains_at(firmware, direction, speed)[4:]) == pytest.approx(exact, rel=0.05)


# The choice


def test_the_choice_is_the_fastest_that_keeps_the_margin_and_the_next_faster_does_not():
    vehicle = vehicle_of("paper", "slow-rack")
    nominal, cars = model.nominal_of(vehicle), design.corners(vehicle)
    row = row_at(designed("paper", "slow-rack")["car"], 1.0, 1.0)
    pace = row.kd / 2.5
    assert design.SLOWEST_PACE < pace < design.FASTEST_PACE["car"], "the margins decide here, not the ends"
    z = design.on_circle(design.frequencies(1.0))

    def least(pace):
        kp, ki, kd = design.pid_gains(pace)
        return design.disk_margin(model.loop_response(row._replace(kp=kp, ki=ki, kd=kd), nominal, cars, z)).min()

    assert least(pace) >= design.LEAST_DISK_MARGIN > least(1.02 * pace)


@pytest.mark.parametrize("scenario", [None, "ideal", "slow-rack"])
def test_every_overlay_has_gains_that_hold_in_its_whole_box(scenario):
    vehicle = vehicle_of("paper", scenario)
    nominal, cars = model.nominal_of(vehicle), design.corners(vehicle)
    for law, table in designed("paper", scenario).items():
        for row in (row for row in map(model.Row._make, table) if row.speed_mps in (0.05, 0.5, 1.0)):
            for car in cars:
                matrix = model.closed_loop(row, nominal, car, law in design.PREDICTING_LAWS)
                assert design.d_stable(matrix, row.speed_mps), (law, row.direction, row.speed_mps, car.name)


def test_a_wider_box_gives_softer_gains_at_speed():
    known = row_at(designed()["car"], 1.0, 1.0)
    slow = row_at(designed("paper", "slow-rack")["car"], 1.0, 1.0)
    assert slow.kp < 0.5 * known.kp
    assert slow.kd < 0.7 * known.kd


def test_the_design_is_the_same_when_made_again_and_for_another_wheelbase():
    again = design.design_gains(vehicle_of())
    assert again == designed()
    short = design.design_gains(vehicle_of("fusion"))
    assert short == designed(), "gains are for curvature; these two cars have the same steering chain"


def test_a_slower_car_is_checked_only_at_the_speeds_it_has():
    assert design.checked_speeds(vehicle_of()) == design.SPEED_GRID_MPS[1:]
    assert design.checked_speeds(vehicle_of(max_speed_mps=0.45))[-1] == 0.5
    assert design.checked_speeds(vehicle_of(max_speed_mps=0.5))[-1] == 0.5
    lame = vehicle_of(max_speed_mps=0.3, steering_lag_s=0.9)
    assert len(design.design_gains(lame)["car"]) == 2 * len(design.SPEED_GRID_MPS)


@pytest.mark.parametrize(
    ("overlay", "named"),
    [
        ({"steering_lag_s": 2.0}, "steering_lag_s"),
        ({"wheelbase_m": 12.0}, "wheelbase_m"),
        ({"command_latency_samples": 60.0}, "pose_latency_samples + command_latency_samples"),
    ],
)
def test_a_car_that_no_gains_can_hold_is_refused_in_one_line_that_names_the_dimension(overlay, named):
    with pytest.raises(UserError) as caught:
        design.design_gains(vehicle_of(**overlay))
    text = str(caught.value)
    assert "\n" not in text
    assert text.startswith("vehicle paper: ")
    assert named in text.split("=", maxsplit=1)[0]
