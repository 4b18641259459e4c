"""The controller drives a plant that was written from the folder dbc/ alone, in virtual time; see outside_plant.py."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import cantools
import pytest
from core_support import shipped_codec, shipped_tables
from outside_plant import ACTIVE, FAULT, LAYOUT, MANUAL, PARK, READY, Frame, OutsidePlant, decode, encode

from firmware_py.node import ControllerNode

DBC_FOLDER = Path(__file__).resolve().parent.parent / "dbc"
MS = 1_000_000
TICK_NS = 10 * MS
REPORT_PHASE_NS = 7 * MS
COMPUTE_NS = MS // 2
SYS_CMD = cantools.database.load_file(DBC_FOLDER / "parking.dbc").get_message_by_name("CTRL_SysCmd")
REASONS = SYS_CMD.get_signal_by_name("control_reason").choices


class Seen(NamedTuple):
    """One tick: the controller's mode, leg and reason from the bus, the plant's state, reason and pose."""

    mode: int
    leg: int
    reason: str
    state: int
    vehicle_reason: str
    gear: int
    speed_mps: float
    x_m: float
    y_m: float
    yaw_rad: float


class Bus:
    """Controller, plant and operator on one line of virtual time; `spoil` may change what both hear."""

    def __init__(self) -> None:
        self.plant = OutsidePlant(DBC_FOLDER, "paper", "ohio", 0)
        self.node: ControllerNode | None = ControllerNode(shipped_codec(), shipped_tables())
        self.operator = True
        self.buttons: dict[str, int] = {}
        self.press_start = True
        self.spoil: Callable[[Frame], list[Frame]] = lambda frame: [frame]
        self.ticks = 0
        self.seen: list[Seen] = []
        self._heard: list[Frame] = []
        self._oper_counter = 0
        self._status = {"control_mode": 0, "control_leg": 0, "control_reason": 0}

    def tick(self) -> Seen:
        now_ns = self.ticks * TICK_NS
        commands: list[Frame] = []
        if self.node:
            commands = self.node.cycle(now_ns, self._heard, 0)
        self._heard = []
        for number, data in commands:
            if number == LAYOUT["CTRL_SysCmd"][0]:
                self._status = decode("CTRL_SysCmd", data)
            for frame in self.spoil((number, data)):
                self.plant.receive(now_ns + COMPUTE_NS, *frame)
        if self.operator and self.ticks % 2 == 0:
            buttons = {"oper_start": int(self.press_start and self._status["control_mode"] == READY), **self.buttons}
            frame = encode("OPER_Cmd", buttons, self._oper_counter)
            self._oper_counter = (self._oper_counter + 1) % 15
            self._heard.append(frame)
            self.plant.receive(now_ns + MS, *frame)
        for report in self.plant.reports(now_ns + REPORT_PHASE_NS):
            self._heard += self.spoil(report)
        self.ticks += 1
        plant, status = self.plant, self._status
        self.seen.append(
            Seen(
                status["control_mode"],
                status["control_leg"],
                str(REASONS[status["control_reason"]]),
                plant.state,
                plant.reason,
                plant.gear,
                plant.speed_mps,
                plant.x_m,
                plant.y_m,
                plant.yaw_rad,
            )
        )
        return self.seen[-1]

    def run_until(self, condition: Callable[[Seen], bool], within_s: float) -> Seen:
        for _ in range(round(within_s * 100)):
            seen = self.tick()
            if condition(seen):
                return seen
        raise AssertionError(f"not within {within_s} s; last seen: {self.seen[-1]}")


def moving(seen: Seen) -> bool:
    return seen.speed_mps > 0.5


def test_the_whole_manoeuvre() -> None:
    bus = Bus()
    assert bus.node
    end = bus.run_until(lambda s: s.reason == "Complete" and s.state == READY, 90.0)
    assert (end.mode, end.leg, end.vehicle_reason, end.gear) == (MANUAL, 4, "DisabledByController", PARK)
    legs = [leg for i, leg in enumerate(s.leg for s in bus.seen) if i == 0 or leg != bus.seen[i - 1].leg]
    assert legs == [0, 1, 2, 3, 4]
    assert [s for s in bus.seen if FAULT in (s.state, s.mode)] == []
    start = bus.seen[0]
    turn = next(s for s in bus.seen if s.leg == 2)
    assert (turn.x_m, turn.y_m) == (pytest.approx(10.044, abs=0.03), pytest.approx(1.3716, abs=0.01))
    assert (end.x_m, end.y_m) == (pytest.approx(start.x_m, abs=0.03), pytest.approx(0.0, abs=0.01))
    assert abs(turn.yaw_rad) < math.radians(0.3)
    assert abs(end.yaw_rad) < math.radians(0.3)
    assert bus.plant.rejected == 0
    mailbox = bus.node.mailbox
    assert (mailbox.rejected_crc, mailbox.rejected_counter, mailbox.rejected_length, mailbox.lost) == (0, 0, 0, 0)
    assert mailbox.foreign == 0


def test_without_an_operator_both_wait_and_say_why() -> None:
    bus = Bus()
    bus.operator = False
    for _ in range(200):
        seen = bus.tick()
    assert (seen.mode, seen.reason) == (MANUAL, "WaitingForOperator")
    assert (seen.state, seen.vehicle_reason) == (READY, "None")


def test_without_a_controller_the_plant_waits() -> None:
    bus = Bus()
    bus.node = None
    for _ in range(100):
        seen = bus.tick()
    assert (seen.state, seen.vehicle_reason, seen.speed_mps) == (MANUAL, "NoCommand", 0.0)


def test_ready_within_a_second_of_the_first_frame() -> None:
    bus = Bus()
    bus.press_start = False
    bus.run_until(lambda s: s.mode == READY and s.state == READY, 1.0)


def test_another_vehicle_s_hash_keeps_both_from_arming() -> None:
    bus = Bus()
    bus.plant.vehicle_hash ^= 1
    for _ in range(200):
        seen = bus.tick()
    assert (seen.mode, seen.reason) == (MANUAL, "VehicleHashMismatch")
    assert (seen.state, seen.vehicle_reason) == (MANUAL, "VehicleHashMismatch")


def test_a_controller_that_dies_leaves_a_car_that_stops() -> None:
    bus = Bus()
    bus.run_until(moving, 30.0)
    bus.node = None
    at = bus.seen[-1]
    end = bus.run_until(lambda s: s.speed_mps == 0.0, 1.0)
    assert (end.state, end.vehicle_reason) == (FAULT, "CommandTimeout")
    assert math.dist((at.x_m, at.y_m), (end.x_m, end.y_m)) < 0.55


def test_an_emergency_stop_stops_and_a_clear_brings_both_back() -> None:
    bus = Bus()
    bus.run_until(moving, 30.0)
    bus.buttons = {"oper_estop": 1, "oper_start": 0}
    end = bus.run_until(lambda s: s.speed_mps == 0.0, 1.0)
    assert (end.state, end.vehicle_reason) == (FAULT, "EmergencyStop")
    assert (end.mode, end.reason) == (FAULT, "EmergencyStop")
    bus.buttons = {"oper_start": 0}
    for _ in range(50):
        assert bus.tick().state == FAULT
    bus.buttons = {"oper_start": 0, "oper_clear": 1}
    bus.run_until(lambda s: s.mode == MANUAL and s.state == READY, 1.0)


def test_single_bad_frames_are_rejected_and_the_car_drives_on() -> None:
    """A repeat, a flipped bit, a short frame: now and then, in both directions."""
    bus = Bus()
    count = 0

    def spoil(frame: Frame) -> list[Frame]:
        nonlocal count
        count += 1
        number, data = frame
        if count % 97 == 0:
            return [frame, frame]
        if count % 101 == 0:
            return [(number, data[:5] + bytes([data[5] ^ 0x10]) + data[6:])]
        if count % 103 == 0:
            return [(number, data[:7])]
        return [frame]

    bus.spoil = spoil
    end = bus.run_until(lambda s: s.reason == "Complete" and s.state == READY, 90.0)
    assert bus.node
    mailbox = bus.node.mailbox
    assert min(bus.plant.rejected, mailbox.rejected_crc, mailbox.rejected_counter, mailbox.rejected_length) > 50
    assert [s for s in bus.seen if FAULT in (s.state, s.mode)] == []
    assert end.y_m == pytest.approx(0.0, abs=0.02)


def test_a_frozen_counter_stops_the_car() -> None:
    bus = Bus()
    bus.run_until(moving, 30.0)
    last: dict[int, Frame] = {}

    def spoil(frame: Frame) -> list[Frame]:
        return [last.setdefault(frame[0], frame)] if frame[0] == LAYOUT["CTRL_SteerCmd"][0] else [frame]

    bus.spoil = spoil
    bus.run_until(lambda s: s.state == FAULT, 0.2)
    end = bus.run_until(lambda s: s.speed_mps == 0.0, 1.0)
    assert end.vehicle_reason == "BadCounter"
    assert bus.plant.state != ACTIVE
