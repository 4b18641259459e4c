"""Gain schedules: the linear model is the firmware's, its filter settles at a Riccati equation's, the PID is chosen."""

import math
import random
from itertools import pairwise

import numpy as np
import pytest
from design_support import NOMINAL, FirmwareLaw, corner, designed, row_at, vehicle_of
from scipy.linalg import solve_discrete_are

from firmware_py.core import estimator, kalman
from firmware_py.core.schedule import gains_at
from firmware_py.core.tables import GAIN_COLUMNS, GainTable
from firmware_py.table_file import GAINS_COLUMNS
from sim import vehicle as plant
from sim.errors import UserError
from tools.design import gains as design
from tools.design import model
from tools.design.box import corners
from tools.design.filter import HEADING_NOISE_RAD, POSITION_NOISE_M, settled
from tools.design.margins import disk_margin, frequencies, on_circle

DIRECTIONS = (1.0, -1.0)
RUNS = [(law, mode) for law, modes in design.MODES.items() for mode in modes.values()]


def rows_of(table, direction):
    return [model.Row(*row) for row in table if row[0] == direction]


# The linear model


class PlantInSmallSteps:
    """The emulator's single-track plant behind a lag and a dead time, in steps of 0.5 ms."""

    STEPS = 20

    def __init__(self, car, velocity_mps):
        self.car, self.velocity_mps = car, velocity_mps
        self.parameters = plant.plant_parameters(
            car.mass_kg,
            car.yaw_inertia_kgm2,
            car.wheelbase_m,
            car.cg_to_rear_axle_m,
            car.stiffness_front_n_per_rad,
            car.stiffness_rear_n_per_rad,
            10.0,
            1e-4,
        )
        self.state = plant.state_at_rest(self.parameters, 0.0, 0.0, 0.0)._replace(speed_mps=velocity_mps)
        self.rack_rad = 0.0
        self.line = [0.0] * round((car.command_latency_samples + 0.35) * self.STEPS)
        self.poses = [(0.0, 0.0)] * (car.pose_latency_samples + 1)

    def reports(self):
        return (*self.poses[-1 - self.car.pose_latency_samples], self.state.yaw_rate_radps, self.rack_rad)

    def drive(self, command_rad):
        h = model.PERIOD_S / self.STEPS
        self.line += [self.car.steering_gain * command_rad] * self.STEPS
        for target in self.line[: self.STEPS]:
            self.rack_rad += (target - self.rack_rad) * (1.0 - math.exp(-h / self.car.steering_lag_s))
            self.state = plant.step(self.parameters, self.state, self.velocity_mps, self.rack_rad, h)
        del self.line[: self.STEPS]
        _, y_m, yaw_rad = plant.rear_axle_pose(self.parameters, self.state)
        self.poses.append((y_m, yaw_rad))


@pytest.mark.parametrize("direction", DIRECTIONS)
@pytest.mark.parametrize("speed_mps", [1.0, 0.3])
@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"pose_latency_samples": 0, "command_latency_samples": 0.0, "steering_lag_s": 0.05},
        {"pose_latency_samples": 2, "command_latency_samples": 3.0, "mass_kg": 3900.0, "steering_gain": 0.9},
    ],
)
def test_the_cars_model_is_the_emulators_plant_driven_in_small_steps(direction, speed_mps, changes):
    car = corner(**changes)
    system = model.car(car, speed_mps, direction)
    small = PlantInSmallSteps(car, direction * speed_mps)
    rng = random.Random(3)
    state = np.zeros((len(system.a), 1))
    largest = np.zeros(4)
    command = 0.0
    for cycle in range(300):
        found, expected = (system.c @ state)[:, 0], np.array(small.reports())
        largest = np.maximum(largest, np.abs(expected))
        assert found == pytest.approx(expected, abs=0.03 * np.max(largest) + 1e-9), cycle
        assert np.all(np.abs(found - expected) <= 0.03 * largest + 1e-9), cycle
        if cycle % 10 == 0:
            command = rng.choice((-1e-4, 1e-4))
        small.drive(command)
        state = system.a @ state + system.b * command
    assert np.all(largest > 1e-8)


@pytest.mark.parametrize("direction", DIRECTIONS)
@pytest.mark.parametrize(("law", "mode"), [run for run in RUNS if not run[1].in_bend])
@pytest.mark.parametrize(
    "nominal", [NOMINAL, model.Nominal(2.8, 0.0, 0, 0, 0.6), model.Nominal(4.0, 0.27, 3, 24, 0.45)]
)
def test_the_controllers_model_answers_as_the_firmware_does(direction, law, mode, nominal):
    row = row_at(designed()[law], direction, 0.6)
    system = model.controller(row, nominal, mode)
    firmware = FirmwareLaw(row, nominal, mode)
    rng = random.Random(4)
    state = np.zeros((len(system.a), 1))
    largest = 0.0
    for _ in range(200):
        report = np.array([[rng.uniform(-w, w)] for w in (1e-4, 1e-5, 1e-5, 1e-5)])
        wanted = (system.c @ state + system.d @ report).item()
        given = firmware.command_rad(*report[:, 0])
        assert given == pytest.approx(wanted, rel=1e-3, abs=1e-8)
        state = system.a @ state + system.b @ report
        largest = max(largest, abs(wanted))
    assert largest > 1e-5


@pytest.mark.parametrize(("law", "mode"), RUNS)
def test_frequency_responses_are_those_of_the_matrices(law, mode):
    z = on_circle(frequencies(0.5, 25))
    row = row_at(designed()[law], -1.0, 0.5)
    system = model.controller(row, NOMINAL, mode)
    for car in (corner(), corner(steering_lag_s=0.0, pose_latency_samples=0, command_latency_samples=0.0)):
        own = model.car(car, 0.5, -1.0)
        assert model.car_response(car, 0.5, -1.0, z) == pytest.approx(model.response(own, z)[:, :, 0], rel=1e-6)
        loop = model.loop_response(system, row, [car], z)[0]
        assert loop == pytest.approx(model.response(model.open_loop(system, own), z)[:, 0, 0], rel=1e-5)


@pytest.mark.parametrize("with_yaw_rate", [True, False])
@pytest.mark.parametrize("direction", DIRECTIONS)
def test_in_a_bend_the_road_is_learnt_from_what_a_radian_turns_the_car_by_there(direction, with_yaw_rate):
    """The firmware's estimator in the bend, against the row of the model's matrix on the straight and in the bend."""
    angle_rad, push_rad = 0.5, 1e-5
    slope = 1.0 / math.cos(angle_rad) ** 2
    row = row_at(designed()["car"], direction, 1.0)
    mode = model.Mode(localisation="exact", with_yaw_rate=with_yaw_rate, in_bend=True)
    inputs = {
        bend_rad: model.controller(row, NOMINAL._replace(max_road_wheel_angle_rad=bend_rad), mode).b
        for bend_rad in (0.0, angle_rad)
    }
    road = 2  # its place in the state
    assert np.count_nonzero(inputs[0.0][road]) >= 2
    assert inputs[angle_rad][road] == pytest.approx(slope * inputs[0.0][road], rel=1e-6)
    others = [0, 1, *range(3, 10)]  # of the estimator; command and integral see the road disturbance at once
    assert inputs[angle_rad][others] == pytest.approx(inputs[0.0][others], rel=1e-6, abs=1e-12)

    def turned_rad(wheels_rad):
        law = FirmwareLaw(row, NOMINAL, mode)
        state = law.state._replace(road_wheel_angle_rad=wheels_rad, modelled_angle_rad=wheels_rad)
        motion = estimator.Motion(0.01, model.PERIOD_S, wheels_rad, wheels_rad, 1, 0.0, 0, 0, 1)
        seen = estimator.estimate(law.leg, law.car, law.gains, state, motion, 0, 0.0, 0.0, 0.0, 1, 0.0, 1)
        return seen.yaw_rad

    by_a_radian = [(turned_rad(at + push_rad) - turned_rad(at)) / push_rad for at in (0.0, angle_rad)]
    assert by_a_radian[1] == pytest.approx(slope * by_a_radian[0], rel=1e-3)


def test_forwards_gains_belong_to_forward():
    car = corner(steering_lag_s=0.2)
    right = row_at(designed()["car"], 1.0, 0.8)
    mixed = right._replace(direction=-1.0)
    assert model.is_stable(model.closed_loop(model.controller(right, NOMINAL), model.car(car, 0.8, 1.0)))
    assert not model.is_stable(model.closed_loop(model.controller(mixed, NOMINAL), model.car(car, 0.8, -1.0)))


# The estimator


def steady_gains(f, q):
    """Kalman gains per pose of (cross-track error, heading error, x) by scipy's Riccati equation, shape (3, 2)."""
    h, r = np.eye(2, 3), np.diag([POSITION_NOISE_M**2, HEADING_NOISE_RAD**2])
    unit = np.array([POSITION_NOISE_M, HEADING_NOISE_RAD, max(30.0 * math.sqrt(q[2, 2]), 1e-9)])
    before = solve_discrete_are(
        (f * unit / unit[:, None]).T, (h * unit / unit[:2, None]).T, q / np.outer(unit, unit), np.eye(2)
    ) * np.outer(unit, unit)
    return before @ h.T @ np.linalg.inv(h @ before @ h.T + r)


@pytest.mark.parametrize(("direction", "speed_mps"), [(1.0, 1.0), (-1.0, 1.0), (-1.0, 0.2), (1.0, 0.05)])
@pytest.mark.parametrize("with_yaw_rate", [True, False])
def test_the_filter_settles_nearly_where_the_riccati_equation_says(direction, speed_mps, with_yaw_rate):
    """Nearly, as it takes ten poses at once and knows of a slow noise of 0.3 mm: within a fifth of the main gains."""
    walks = design.observer_noise(0.5)
    ds, dt = speed_mps * model.PERIOD_S, model.PERIOD_S
    if with_yaw_rate:
        f = np.array([[1.0, direction * ds, -0.5 * direction * ds * dt], [0.0, 1.0, -dt], [0.0, 0.0, 1.0]])
        heading = kalman.HEADING_WALK**2 * ds + (kalman.YAW_RATE_NOISE_RADPS * dt) ** 2
        q = np.diag([kalman.SIDE_SLIP**2 * ds, heading, kalman.YAW_RATE_WALK**2 * dt])
    else:
        turn = direction * ds
        f = np.array([[1.0, turn, 0.5 * ds * ds], [0.0, 1.0, turn], [0.0, 0.0, 1.0]])
        q = np.diag([walk * walk * ds for walk in walks])
    expected = steady_gains(f, q)
    found = settled(direction, speed_mps, with_yaw_rate, walks).gains
    own = np.array([[found.ee, found.ep], [found.pe, found.pp], [found.xe, found.xp]])
    # What a pose's noise of one standard deviation brings: of the smaller of two, a share of the larger is enough.
    noise = np.array([POSITION_NOISE_M, HEADING_NOISE_RAD])
    largest = np.abs(expected * noise).max(axis=1, keepdims=True)
    assert np.all(np.abs((own - expected) * noise) <= 0.2 * largest)


def test_the_road_gain_is_what_its_recursion_settles_at():
    ds = 0.5 * model.PERIOD_S
    noise = (design.YAW_RATE_NOISE_RADPS * model.PERIOD_S) ** 2
    variance = 1.0
    for _ in range(5000):
        gain = variance * ds / (variance * ds * ds + noise)
        variance = (1.0 - gain * ds) * variance + design.ROAD_WALK_1PM**2 * ds
    assert design.road_gain(1.0, 0.5) == pytest.approx(gain, rel=1e-9)
    assert design.road_gain(-1.0, 0.5) == -design.road_gain(1.0, 0.5)


def test_the_tables_hold_the_estimators_noises():
    for direction in DIRECTIONS:
        rows = rows_of(designed()["car"], direction)
        for row in rows:
            assert row.l_dr == design.road_gain(direction, row.speed_mps)
            assert row[9:] == rows[0][9:]
            assert (row.l_o > 0.0) == (row.speed_mps > 0.0)
            assert row.l_g == pytest.approx(design.GAIN_RATE_MAX_1PM * row.speed_mps * model.PERIOD_S)
        assert row[9:] in [design.observer_noise(pace) for pace in design.OBSERVER_PACES]
        for row in rows_of(designed()["pid_ff"], direction):
            assert row[6:] == (0.0,) * 6


def test_a_steering_that_bears_less_is_learnt_more_slowly():
    """So that the loop keeps its margins in a bend, as the certificate asks."""
    fast = design.GAIN_RATE_MAX_1PM * model.PERIOD_S
    slow_rack = row_at(designed("paper", "slow-rack")["car"], 1.0, 1.0)
    assert 0.2 * fast < slow_rack.l_g < 0.8 * fast
    assert row_at(designed("paper", "slow-rack")["car"], 1.0, 0.1).l_g == pytest.approx(0.1 * fast)


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


def test_in_reverse_only_the_road_gain_changes_its_sign():
    signs = dict.fromkeys(design.COLUMNS, 1.0)
    signs |= dict.fromkeys(("direction", "l_dr"), -1.0)
    for table in designed().values():
        for ahead, back in zip(rows_of(table, 1.0), rows_of(table, -1.0), strict=True):
            mirrored = tuple(sign * value for sign, value in zip(signs.values(), ahead, strict=True))
            assert back == pytest.approx(mirrored, rel=1e-6, abs=1e-12)


@pytest.mark.parametrize("law", design.LAWS)
@pytest.mark.parametrize("direction", DIRECTIONS)
def test_gains_are_smooth_over_speed(law, direction):
    rows = rows_of(designed("paper", "slow-rack")[law], direction)
    for low, high in pairwise(rows[1:]):
        assert (low.kp, low.ki, low.kd) == pytest.approx(design.pid_gains(law, math.sqrt(low.kp / 3.0)))
        for name in design.COLUMNS[5:]:  # kp and ki are powers of the pace, and kd is as the pace up to its greatest
            a, b = getattr(low, name), getattr(high, name)
            share = 0.35 if name == "kd" else 0.62
            assert abs(b - a) <= share * max(abs(a), abs(b)) + 1e-6, (name, low.speed_mps)


@pytest.mark.parametrize("direction", [0, 1])
def test_between_two_rows_the_firmware_has_nearly_the_estimator_of_that_speed(direction):
    table = designed()["car"]
    grid = design.SPEED_GRID_MPS
    gain = tuple(tuple(tuple(row[2:]) for row in rows_of(table, d)) for d in DIRECTIONS)
    firmware = GainTable(grid, len(grid) - 1, gain)
    assert len(design.COLUMNS) - 2 == GAIN_COLUMNS
    for low, high in pairwise(grid[1:]):
        speed = 0.5 * (low + high)
        found = gains_at(firmware, direction, speed)
        assert found.dr == pytest.approx(design.road_gain(DIRECTIONS[direction], speed), rel=0.05)


def test_each_column_of_a_table_comes_to_the_gain_of_its_name():
    fields = {
        "preview_m": "preview_m",
        "kp": "kp",
        "ki": "ki",
        "kd": "kd",
        "l_o": "offset",
        "l_g": "gain",
        "l_dr": "dr",
        "w_e": "cross_walk",
        "w_p": "heading_walk",
        "w_d": "road_walk",
    }
    numbers = {name: 100.0 + index for index, name in enumerate(GAINS_COLUMNS[2:])}
    row = tuple(numbers.values())
    found = gains_at(GainTable((0.0, 1.0), 1, ((row, row),) * 2), 0, 0.3)
    assert {name: getattr(found, field) for name, field in fields.items()} == pytest.approx(numbers)
    assert set(fields.values()) == set(found._fields)


# The choice


def test_the_choice_is_the_fastest_that_keeps_the_margin_and_the_next_faster_does_not():
    vehicle = vehicle_of("paper", "slow-rack")
    nominal, cars = model.nominal_of(vehicle), corners(vehicle, softest_tyres=True)
    row = row_at(designed("paper", "slow-rack")["car"], 1.0, 1.0)
    pace = math.sqrt(row.kp / 3.0)
    assert design.SLOWEST_PACE < pace < design.FASTEST_PACE["car"], "the margins decide here, not the ends"
    z = on_circle(frequencies(1.0))

    def least(pace):
        kp, ki, kd = design.pid_gains("car", pace)
        faster = row._replace(kp=kp, ki=ki, kd=kd)
        return disk_margin(model.loop_response(model.controller(faster, nominal), faster, cars, z)).min()

    assert least(pace) >= design.demand_of(vehicle, "car", model.Mode()).disk_margin > least(1.03 * pace)


def test_a_wider_box_gives_softer_gains_at_speed():
    known = row_at(designed()["car"], 1.0, 1.0)
    slow = row_at(designed("paper", "slow-rack")["car"], 1.0, 1.0)
    assert slow.kp < 0.7 * known.kp
    assert slow.kd < 0.85 * known.kd


def test_the_design_is_the_same_when_made_again():
    assert design.design_gains(vehicle_of()) == designed()


def test_a_slower_car_is_checked_only_at_the_speeds_it_has():
    assert design.checked_speeds(vehicle_of()) == design.SPEED_GRID_MPS[1:]
    assert design.checked_speeds(vehicle_of(max_speed_mps=0.45))[-1] == 0.5
    assert design.checked_speeds(vehicle_of(max_speed_mps=0.5))[-1] == 0.5
    lame = vehicle_of(max_speed_mps=0.3, steering_lag_s=0.9)
    assert len(design.design_gains(lame)["car"]) == 2 * len(design.SPEED_GRID_MPS)


@pytest.mark.parametrize(
    ("overlay", "named"),
    [
        ({"steering_lag_s": 2.0, "command_latency_samples": 10.0}, "steering_lag_s"),
        ({"wheelbase_m": 12.0}, "wheelbase_m"),
        ({"command_latency_samples": 60.0}, "command_latency_samples"),
    ],
)
def test_a_car_that_no_gains_can_hold_is_refused_in_one_line_that_names_the_dimension(overlay, named):
    with pytest.raises(UserError) as caught:
        design.design_gains(vehicle_of(**overlay))
    text = str(caught.value)
    assert "\n" not in text
    assert text.startswith("vehicle paper: ")
    assert named in text.split("=", maxsplit=1)[0]
