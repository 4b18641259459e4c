"""The project's emulator and the plant written from the text alone: the same frames in, the same states out.

Where they differ, one of them or dbc/CONVENTIONS.md is wrong. Only at standstill: the two cars move differently.
"""

from __future__ import annotations

import random
from collections import Counter
from pathlib import Path

import pytest
from outside_plant import DRIVE, GEAR_NONE, PARK, REVERSE, Frame, OutsidePlant, decode, encode

from sim.data_files import load_course, load_scenario, load_vehicle
from sim.emulator import Emulator

DBC_FOLDER = Path(__file__).resolve().parent.parent / "dbc"
DBC = DBC_FOLDER / "parking.dbc"
TICK_NS = 10_000_000
COMPARED = {0x020: "VEH_SysRpt", 0x100: "VEH_SteerRpt", 0x102: "VEH_LongRpt", 0x310: "VEH_Version"}
NOT_COMPARED = {"road_wheel_angle_meas_rad", "steer_limiting_rate", *(f"{name}_crc" for name in COMPARED.values())}


class RandomController:
    """Sends what a controller may send and much that it should not, by fits and starts."""

    def __init__(self, seed: int, dbc_hash: int, vehicle_hash: int) -> None:
        self.rng = random.Random(seed)
        self.hashes = (dbc_hash, vehicle_hash)
        self.counters: Counter[str] = Counter()
        self.enable = self.clear = self.estop = self.follow = self.park_brake = 0
        self.gear = GEAR_NONE
        self.wrong_hash = 0
        self.silent: set[str] = set()
        self.last: dict[str, Frame] = {}

    def frames(self, tick: int) -> list[Frame]:
        rng = self.rng
        if rng.random() < 0.04:
            self.enable = rng.choice([0, 1, 1])
        if rng.random() < 0.03:
            self.clear = rng.choice([0, 1])
        if rng.random() < 0.02:
            self.gear = rng.choice([GEAR_NONE, PARK, REVERSE, DRIVE, 7])
            self.park_brake, self.follow = rng.choice([0, 1]), rng.choice([0, 1, 1])
        if rng.random() < 0.01:
            self.estop = rng.choice([0, 0, 1])
        if rng.random() < 0.004:
            self.wrong_hash = rng.choice([0, 0, 0, 1, 2])
        if rng.random() < 0.01:
            names = ["CTRL_SysCmd", "CTRL_SteerCmd", "CTRL_LongCmd", "CTRL_Version", "OPER_Cmd"]
            self.silent = set(rng.sample(names, rng.choice([0, 0, 1, 2])))
        dbc_hash, vehicle_hash = self.hashes
        wanted = {
            "CTRL_SteerCmd": {"road_wheel_angle_cmd_rad": rng.randint(-9000, 9000), "steer_enable": self.follow},
            "CTRL_LongCmd": {
                "brake_decel_cmd_mps2": 150,
                "gear_cmd": self.gear,
                "park_brake_cmd": self.park_brake,
                "long_enable": self.follow,
            },
            "CTRL_SysCmd": {"enable_request": self.enable, "clear_request": self.clear},
        }
        if tick % 10 == 0:
            wanted["CTRL_Version"] = {
                "ctrl_protocol": 1,
                "ctrl_dbc_hash": dbc_hash ^ (self.wrong_hash & 1),
                "ctrl_vehicle_hash": vehicle_hash ^ (self.wrong_hash >> 1),
            }
        if tick % 2 == 0:
            wanted["OPER_Cmd"] = {"oper_estop": self.estop}
        return [self.frame(name, raws) for name, raws in wanted.items() if name not in self.silent]

    def frame(self, name: str, raws: dict[str, int]) -> Frame:
        accident = self.rng.random()
        step = 1 if accident > 0.02 else self.rng.choice([0, 2, 4, 6, 9])
        self.counters[name] = (self.counters[name] + step) % 15
        number, data = encode(name, raws, self.counters[name])
        if accident > 0.98:
            data = data[:4] + bytes([data[4] ^ 1]) + data[5:]
        elif accident > 0.97:
            data = data[: self.rng.randint(0, 7)]
        return number, data


@pytest.mark.parametrize("seed", [1, 2])
def test_both_plants_say_the_same(seed: int) -> None:
    emulator = Emulator(load_vehicle("paper"), load_course("ohio"), load_scenario("ideal"), "left", 1, DBC, 0)
    outsider = OutsidePlant(DBC_FOLDER, "paper", "ohio", 0)
    outsider.vehicle_hash = emulator.vehicle_hash24  # the scenario's overlay: no dead times
    controller = RandomController(seed, outsider.dbc_hash, outsider.vehicle_hash)
    seen: Counter[tuple[int, int]] = Counter()
    gears: set[int] = set()
    for tick in range(4000):
        now_ns = tick * TICK_NS + TICK_NS // 2
        for frame in controller.frames(tick):
            emulator.receive(now_ns, *frame)
            outsider.receive(now_ns, *frame)
        reports = [dict(plant.reports((tick + 1) * TICK_NS)) for plant in (emulator, outsider)]
        for number, name in COMPARED.items():
            assert (number in reports[0]) == (number in reports[1]), (tick, name)
            if number in reports[0]:
                theirs, ours = (
                    {key: raw for key, raw in decode(name, report[number]).items() if key not in NOT_COMPARED}
                    for report in reports
                )
                assert theirs == ours, f"tick {tick}, emulator {emulator.reason.name}, outsider {outsider.reason}"
        status = decode("VEH_SysRpt", reports[0][0x020])
        seen[status["vehicle_state"], status["vehicle_reason"]] += 1
        gears.add(decode("VEH_LongRpt", reports[0][0x102])["gear_rpt"])
    assert {state for state, _ in seen} == {0, 1, 2, 3}, "every state was visited"
    assert len(seen) >= 8, f"and most reasons: {seen}"
    assert {GEAR_NONE, PARK} < gears
