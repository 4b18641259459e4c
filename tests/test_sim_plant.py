"""The plant's records: rings that wrap and overflow, and noise that does not depend on how it is drawn."""

from __future__ import annotations

import math

import pytest
from sim_support import LAGLESS, TICK, scenario

from sim import drive_by_wire as dbw
from sim import plant
from sim.data_files import load_course, load_vehicle
from sim.sensors import BLOCK_ROWS, NORMALS, NoiseRows

TIMEOUTS = (100_000_000, 100_000_000, 100_000_000, 1_000_000_000)


def standing(**overlay: float) -> tuple[plant.Car, plant.Memory, plant.Motion]:
    world = scenario(vehicle_overlay={**LAGLESS, **overlay})
    setup = plant.set_up(load_vehicle("paper"), load_course("ohio"), world, "left", 1, TIMEOUTS)
    memory = plant.begin_memory(0)
    motion = plant.begin(setup.car, memory, setup.start, 0)
    memory.system[dbw.STATE] = dbw.ACTIVE
    memory.system[dbw.PARK_BRAKE_APPLIED] = 0
    memory.system[dbw.GEAR] = dbw.DRIVE
    return setup.car, memory, motion


def test_more_commands_than_places_push_out_the_oldest() -> None:
    car, memory, motion = standing(command_latency_samples=100.0)
    too_many = 20
    for number in range(plant.PENDING + too_many):
        plant.accept_steer(car, motion, memory, 1e-3 * number, 1)
    assert memory.number[plant.STEER_COUNT] == plant.PENDING
    first = memory.number[plant.STEER_FIRST]
    assert memory.value[plant.STEER_RAD + first] == pytest.approx(1e-3 * too_many)
    plant.advance(car, motion, memory, 100 * TICK, dbw.NEVER)
    assert memory.number[plant.STEER_COUNT] == 0
    assert memory.value[plant.STEER_TARGET_RAD] == pytest.approx(car.steering.max_angle_rad)


def test_speed_commands_are_a_ring_too() -> None:
    car, memory, motion = standing()
    car = car._replace(long_latency_ns=100 * TICK)
    for number in range(plant.PENDING + 3):
        plant.accept_long(car, motion, memory, 1e-3 * number, 0.0, 4, 0, 1)
    assert memory.number[plant.LONG_COUNT] == plant.PENDING
    memory.system[dbw.NEXT_EVENT_NS] = dbw.NEVER
    motion = plant.advance(car, motion, memory, 200 * TICK, dbw.NEVER)
    assert memory.value[plant.SPEED_CMD_MPS] == pytest.approx(1e-3 * (plant.PENDING + 2))
    assert motion.body.speed_mps > 0.0


def test_the_past_is_right_when_its_ring_has_wrapped_many_times() -> None:
    """At a constant speed straight on, the pose of 0.4 s ago is 0.4 s behind, whatever the place in the ring."""
    car, memory, motion = standing(pose_latency_samples=40.0)
    now_ns = 0
    seen = []
    for _ in range(plant.HISTORY // 10 * 3):
        now_ns += TICK
        plant.accept_long(car, motion, memory, 1.0, 0.0, 4, 0, 1)
        plant.accept_steer(car, motion, memory, 0.0, 1)
        dbw.accept(memory.system, dbw.SYS, now_ns)
        motion = plant.advance(car, motion, memory, now_ns, dbw.NEVER)
        seen.append((plant.pose_at(car, memory, now_ns - car.pose_latency_ns), motion.body.x_m))
        assert memory.number[plant.PAST_COUNT] <= plant.HISTORY
    (x, y, yaw), now_x = seen[-1]
    assert now_x - car.body.cg_to_rear_axle_m - x == pytest.approx(0.4, abs=1e-6)
    assert (y, yaw) == (0.0, 0.0)


def test_noise_is_the_same_by_rows_and_in_one_piece_and_another_seeds_is_another() -> None:
    count = 2 * BLOCK_ROWS + 7
    by_rows = NoiseRows(7)
    rows = [by_rows.row() for _ in range(count)]
    assert rows == NoiseRows(7).array(count).tolist()
    assert len(rows[0]) == NORMALS
    assert len({NoiseRows(seed).row()[0] for seed in (7, 8, -7, 0)}) == 4
    flat = [value for row in rows for value in row]
    assert abs(sum(flat) / len(flat)) < 4.0 / math.sqrt(len(flat))
