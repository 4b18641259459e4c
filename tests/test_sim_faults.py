"""Scripted faults: each does what it says, from its instant to its end, and nothing else."""

from __future__ import annotations

import math
from typing import Any

import pytest
from sim_support import DBC, LAGLESS, MS, Bench, Frame, scenario

from sim.can_side import CanSide
from sim.drive_by_wire import Reason, State
from sim.errors import UserError
from sim.faults import FaultEvent, FaultInjector, crc8

NAMES = {
    0x020: "VEH_SysRpt",
    0x100: "VEH_SteerRpt",
    0x101: "VEH_MotionRpt",
    0x102: "VEH_LongRpt",
    0x310: "VEH_Version",
    0x600: "LOC_Position",
    0x601: "LOC_Attitude",
}


def world(*faults: dict[str, Any]) -> Any:
    return scenario(vehicle_overlay=LAGLESS, faults=list(faults))


class Listener(Bench):
    """A bench that keeps the frames of each tick as they came, and whether its own receiver took them."""

    def __init__(self, *args: Any, **keys: Any) -> None:
        self.frames: list[list[Frame]] = []
        self.taken: list[set[str]] = []
        super().__init__(*args, **keys)

    def hear(self, frames: list[Frame]) -> None:
        self.frames.append(frames)
        taken = set()
        for frame in frames:
            heard = self.wire.decode(self.now_ns, *frame)
            if heard is not None:
                self.seen[heard[0]] = heard[1]
                taken.add(heard[0])
        self.taken.append(taken)

    def sent(self, tick: int) -> list[str]:
        return [NAMES[arbitration_id] for arbitration_id, _ in self.frames[tick]]


def ticks_without(bench: Listener, message: str) -> list[int]:
    return [i for i in range(len(bench.frames)) if message not in bench.sent(i)]


# ----------------------------------------------------------------------------------------------------------- reports


def test_a_stopped_message_is_missing_for_its_time_and_the_others_are_not() -> None:
    bench = Listener(world({"kind": "stop_message", "message": "VEH_LongRpt", "at_s": 0.1, "duration_s": 0.03}))
    bench.tick(30)
    assert ticks_without(bench, "VEH_LongRpt") == [10, 11, 12]
    for other in ("VEH_SysRpt", "VEH_SteerRpt", "VEH_MotionRpt", "LOC_Position", "LOC_Attitude"):
        assert ticks_without(bench, other) == []
    assert "VEH_LongRpt" in bench.taken[13]  # three lost frames are within what a receiver accepts


def test_without_a_duration_it_stays() -> None:
    bench = Listener(world({"kind": "stop_message", "message": "LOC_Position", "at_s": 0.05})).tick(200)
    assert ticks_without(bench, "LOC_Position") == list(range(5, 200))


def test_a_frozen_counter_is_rejected_by_the_peer_and_the_values_go_on() -> None:
    bench = Listener(world({"kind": "freeze_counter", "message": "VEH_MotionRpt", "at_s": 0.1, "duration_s": 0.05}))
    bench.tick(30)
    counters = [data[1] & 0x0F for frames in bench.frames for arbitration_id, data in frames if arbitration_id == 0x101]
    assert counters[10:15] == [counters[10]] * 5
    assert counters[:10] == [i % 15 for i in range(10)]
    assert [i for i in range(30) if "VEH_MotionRpt" not in bench.taken[i]] == [11, 12, 13, 14]
    for frames in bench.frames:
        assert all(crc8(arbitration_id, data[1:]) == data[0] for arbitration_id, data in frames)


def test_a_corrupt_crc_is_rejected_and_the_counter_goes_on() -> None:
    bench = Listener(world({"kind": "corrupt_crc", "message": "VEH_SteerRpt", "at_s": 0.1, "duration_s": 0.03}))
    bench.tick(20)
    assert [i for i in range(20) if "VEH_SteerRpt" not in bench.taken[i]] == [10, 11, 12]
    assert ticks_without(bench, "VEH_SteerRpt") == []


def test_a_delayed_message_comes_late_and_in_order() -> None:
    bench = Listener(
        world({"kind": "delay_message", "message": "LOC_Attitude", "at_s": 0.1, "duration_s": 0.1, "delay_s": 0.04})
    )
    bench.tick(40)
    assert ticks_without(bench, "LOC_Attitude") == [10, 11, 12, 13]
    counters = [data[1] & 0x0F for frames in bench.frames for arbitration_id, data in frames if arbitration_id == 0x601]
    # Back on time at tick 20 while four late ones are still on their way: two a tick until they are through.
    assert [bench.sent(i).count("LOC_Attitude") for i in range(18, 26)] == [1, 1, 2, 2, 2, 2, 1, 1]
    assert sorted(counters) == sorted(i % 15 for i in range(40))
    assert counters[:16] == [i % 15 for i in range(16)]


def test_a_stuck_value_stands_still_while_the_counter_lives() -> None:
    fault = {"kind": "stick_signal", "message": "VEH_MotionRpt", "signal": "speed_meas_mps"}
    bench = Listener(world({**fault, "after": "moving", "at_s": 0.2, "duration_s": 0.3})).until_active()
    bench.long |= {"speed_cmd_mps": 0.8, "brake_decel_cmd_mps2": 0.0}
    speeds, truths = [], []
    for _ in range(100):
        bench.tick(1)
        speeds.append(bench.seen["VEH_MotionRpt"]["speed_meas_mps"])
        truths.append(bench.truth.speed_mps)
    begin = next(i for i in range(99) if speeds[i] == speeds[i + 1] and truths[i] > 0.1)
    assert speeds[begin : begin + 30] == [speeds[begin]] * 30
    assert speeds[begin] == pytest.approx(truths[begin], abs=1e-4)
    assert speeds[begin + 32] == pytest.approx(truths[begin + 32], abs=1e-4)
    assert truths[begin + 29] > truths[begin] + 0.1
    assert all("VEH_MotionRpt" in taken for taken in bench.taken)


def test_an_offset_jumps_and_goes() -> None:
    fault = {"kind": "offset_signal", "message": "LOC_Position", "signal": "position_y_m", "offset": 0.5}
    bench = Listener(world({**fault, "at_s": 0.1, "duration_s": 0.05}))
    y = []
    for _ in range(30):
        bench.tick(1)
        y.append(bench.seen["LOC_Position"]["position_y_m"])
    assert y == pytest.approx([0.0] * 10 + [0.5] * 5 + [0.0] * 15)
    assert bench.truth.y_m == 0.0


def test_a_lost_command_bites_like_a_silent_controller() -> None:
    bench = Bench(world({"kind": "stop_message", "message": "CTRL_SteerCmd", "after": "active", "at_s": 1.0}))
    bench.until_active()
    bench.tick(100)
    assert bench.state == (State.FAULT, Reason.COMMAND_TIMEOUT)
    assert bench.seen["VEH_SteerRpt"]["steer_cmd_timeout"] == 1
    assert bench.seen["VEH_LongRpt"]["long_cmd_timeout"] == 0


# --------------------------------------------------------------------------------------------------------- in the car


@pytest.mark.parametrize(("control", "message", "flag"), [
    ("steering", "VEH_SteerRpt", "steer_override"),
    ("brake", "VEH_LongRpt", "brake_override"),
])  # fmt: skip
def test_the_driver_takes_over_at_an_instant(control: str, message: str, flag: str) -> None:
    fault = {"kind": "driver_override", "control": control, "after": "moving", "at_s": 0.5, "duration_s": 0.4}
    bench = Bench(world(fault)).until_active().go(0.5, 0.4)
    assert bench.emulator.state is State.ACTIVE
    bench.tick(20)
    assert bench.state == (State.FAULT, Reason.DRIVER_OVERRIDE)
    assert bench.seen[message][flag] == 1
    bench.tick(60)
    assert bench.seen[message][flag] == 0
    assert bench.seen["VEH_SysRpt"]["driver_override"] == 1
    assert bench.truth.speed_mps == 0.0


def test_the_button_in_the_car_acts_at_its_instant_to_the_nanosecond() -> None:
    bench = Bench(world({"kind": "emergency_stop", "after": "start", "at_s": 1.2345})).until_active()
    bench.tick(50)
    bench.emulator.advance(1_234_500_000 - 1)
    assert bench.emulator.state is State.ACTIVE
    bench.emulator.advance(1_234_500_000)
    assert bench.emulator.state is State.FAULT
    assert bench.emulator.reason is Reason.EMERGENCY_STOP


def test_a_frozen_rack_does_not_follow_and_comes_back() -> None:
    fault = {"kind": "steering_frozen", "after": "active", "at_s": 1.0, "duration_s": 0.5}
    bench = Bench(scenario(faults=[fault])).until_active()  # with the rack's lag
    bench.go(0.4, 0.2)
    angles, commands = [], []
    for i in range(150):
        bench.steer["road_wheel_angle_cmd_rad"] = command = 0.2 * math.sin(0.03 * i)
        bench.tick(1)
        commands.append(command)
        angles.append(bench.seen["VEH_SteerRpt"]["road_wheel_angle_meas_rad"])
    still = [i for i in range(5, 150) if angles[i] == angles[i - 1]]
    assert 48 <= len(still) <= 51
    assert still == list(range(still[0], still[-1] + 1))
    assert abs(angles[-1] - commands[-2]) < 0.08  # lag and latency of a moving command


# ------------------------------------------------------------------------------------------------------- the schedule


def injector(*events: dict[str, Any]) -> FaultInjector:
    return FaultInjector([FaultEvent.model_validate(event) for event in events], 1000 * MS)


def test_phases_begin_once() -> None:
    faults = injector({"kind": "emergency_stop", "after": "active", "at_s": 0.5, "duration_s": 0.1})
    assert faults.next_edge_ns > 1 << 60
    faults.begin("active", 3000 * MS)
    faults.begin("active", 9000 * MS)
    assert faults.next_edge_ns == 3500 * MS
    assert faults.at(3499 * MS) == []
    [(event, begins)] = faults.at(3500 * MS)
    assert (event.kind, begins) == ("emergency_stop", True)
    assert faults.next_edge_ns == 3600 * MS
    [(_, begins)] = faults.at(3600 * MS)
    assert not begins
    assert faults.next_edge_ns > 1 << 60
    assert faults.at(9000 * MS) == []
    assert faults.is_quiet


def test_two_faults_at_once_and_one_after_the_other() -> None:
    bench = Listener(
        world(
            {"kind": "stop_message", "message": "VEH_LongRpt", "at_s": 0.10, "duration_s": 0.05},
            {"kind": "stop_message", "message": "LOC_Position", "at_s": 0.12, "duration_s": 0.05},
            {"kind": "stop_message", "message": "VEH_LongRpt", "at_s": 0.20, "duration_s": 0.02},
        )
    ).tick(30)
    assert ticks_without(bench, "VEH_LongRpt") == [10, 11, 12, 13, 14, 20, 21]
    assert ticks_without(bench, "LOC_Position") == [12, 13, 14, 15, 16]


def test_the_crc_is_the_standards() -> None:
    """CRC-8/GSM-A: 0x37 over "123456789"; here the first two bytes go through the data id."""
    assert crc8(int.from_bytes(b"12", "little"), b"3456789") == 0x37
    side = CanSide(DBC)
    frame_id, data = side.encode("VEH_Version", {"veh_protocol": 1, "veh_dbc_hash": 2, "veh_vehicle_hash": 3})
    assert crc8(frame_id, data[1:]) == data[0]


def test_an_unknown_signal_is_refused_at_the_start() -> None:
    fault = {"kind": "stick_signal", "message": "VEH_MotionRpt", "signal": "speed", "at_s": 1.0}
    with pytest.raises(UserError) as error:
        Bench(world(fault))
    assert str(error.value) == (
        "scenario bench: [[faults]] stick_signal: message VEH_MotionRpt has no signal 'speed'; it has "
        "speed_meas_mps, speed_valid, yaw_rate_meas_radps, yaw_rate_valid"
    )


@pytest.mark.parametrize(
    ("keys", "text"),
    [
        ({"kind": "stop_message"}, "stop_message needs the key message"),
        ({"kind": "stick_signal", "message": "VEH_SysRpt"}, "stick_signal needs the key signal"),
        ({"kind": "offset_signal", "message": "VEH_SysRpt", "signal": "x"}, "offset_signal needs the key offset"),
        ({"kind": "delay_message", "message": "VEH_SysRpt"}, "delay_message needs the key delay_s"),
        ({"kind": "driver_override"}, "driver_override needs the key control"),
        ({"kind": "emergency_stop", "control": "brake"}, "emergency_stop has no key control"),
        ({"kind": "freeze_counter", "message": "CTRL_SysCmd"}, "message 'CTRL_SysCmd' is not known; freeze_counter"),
    ],
)
def test_keys_must_fit_the_kind(keys: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        FaultEvent.model_validate({"at_s": 1.0, **keys})


def test_a_scenario_without_faults_is_not_slowed_by_them() -> None:
    bench = Bench()
    assert bench.emulator._faults.is_quiet
    assert bench.emulator._faults.next_edge_ns > 1 << 60
