"""The vehicle's side of the handshake, its watchdog and its faults, through frames."""

from __future__ import annotations

import pytest
from sim_support import MS, PHASE, TICK, Bench, Frame, scenario

from sim.drive_by_wire import BRAKE_DECEL_MPS2, Gear, Reason, State

MANUAL, READY, ACTIVE, FAULT = State.MANUAL, State.READY, State.ACTIVE, State.FAULT


# --------------------------------------------------------------------------------------------------------- handshake


def test_alone_on_the_bus_it_is_a_parked_car_that_hears_nothing() -> None:
    bench = Bench()
    bench.lost = {"CTRL_SysCmd", "CTRL_SteerCmd", "CTRL_LongCmd", "CTRL_Version", "OPER_Cmd"}
    bench.tick(20)
    assert bench.state == (MANUAL, Reason.NO_COMMAND)
    expected = {"gear_rpt": Gear.PARK, "park_brake_applied": 1, "standstill": 1, "long_cmd_timeout": 1}
    expected |= {"speed_echo_mps": 0, "brake_decel_echo_mps2": 0, "brake_override": 0, "long_fault": 0}
    assert {name: bench.seen["VEH_LongRpt"][name] for name in expected} == expected
    assert bench.seen["VEH_SysRpt"]["sys_cmd_timeout"] == 1
    assert bench.seen["VEH_SteerRpt"]["steer_cmd_timeout"] == 1
    assert bench.emulator.is_safe
    assert bench.emulator.is_parked


def test_the_version_goes_out_every_100_ms_and_the_rest_every_10() -> None:
    bench = Bench()
    ids = [[arbitration_id for arbitration_id, _ in bench.emulator.reports(i * TICK)] for i in range(25)]
    fast = {0x020, 0x100, 0x101, 0x102, 0x600, 0x601}
    assert all(set(frame_ids) - {0x310} == fast for frame_ids in ids)
    assert [i for i, frame_ids in enumerate(ids) if 0x310 in frame_ids] == [0, 10, 20]


def test_it_tells_its_own_hashes() -> None:
    bench = Bench().tick(1)
    assert bench.seen["VEH_Version"]["veh_protocol"] == 1
    assert bench.seen["VEH_Version"]["veh_dbc_hash"] == bench.wire.dbc_hash24
    assert bench.seen["VEH_Version"]["veh_vehicle_hash"] == bench.emulator.vehicle_hash24


def test_ready_then_active_on_the_edge() -> None:
    bench = Bench().tick(2)
    assert bench.state == (READY, Reason.NONE)
    bench.sys["enable_request"] = 1
    bench.tick(2)
    assert bench.state == (ACTIVE, Reason.NONE)


@pytest.mark.parametrize(
    ("field", "reason"),
    [
        ("ctrl_protocol", Reason.DBC_HASH_MISMATCH),
        ("ctrl_dbc_hash", Reason.DBC_HASH_MISMATCH),
        ("ctrl_vehicle_hash", Reason.VEHICLE_HASH_MISMATCH),
    ],
)
def test_another_hash_or_protocol_keeps_it_manual(field: str, reason: Reason) -> None:
    bench = Bench()
    bench.version[field] ^= 1
    bench.sys["enable_request"] = 0
    bench.tick(30)
    assert bench.state == (MANUAL, reason)
    bench.sys["enable_request"] = 1
    bench.tick(10)
    assert bench.state == (MANUAL, reason)


def test_a_scenarios_known_overlay_is_in_the_hash_and_unknown_parameters_are_not() -> None:
    plain = Bench(scenario()).emulator.vehicle_hash24
    assert Bench(scenario(vehicle_overlay={"steering_lag_s": 0.27})).emulator.vehicle_hash24 != plain
    assert Bench(scenario(plant={"unknown": {"steering_lag_s": 0.15}})).emulator.vehicle_hash24 == plain


def test_without_a_version_it_stays_manual() -> None:
    bench = Bench()
    bench.lost = {"CTRL_Version"}
    bench.tick(50)
    assert bench.state == (MANUAL, Reason.NO_COMMAND)


def test_a_ready_car_goes_back_to_manual_when_the_controller_falls_silent() -> None:
    bench = Bench().until_ready()
    bench.lost = {"CTRL_SysCmd"}
    bench.tick(11)
    assert bench.state == (MANUAL, Reason.NO_COMMAND)
    bench.lost = set()
    bench.tick(2)
    assert bench.state == (READY, Reason.NONE)


def test_a_ready_car_goes_back_to_manual_without_versions_for_their_timeout() -> None:
    bench = Bench().until_ready()
    bench.lost = {"CTRL_Version"}
    bench.tick(95)
    assert bench.state == (READY, Reason.NONE)
    bench.tick(10)
    assert bench.state == (MANUAL, Reason.NO_COMMAND)


def test_a_request_held_from_before_does_not_enable() -> None:
    bench = Bench()
    bench.sys["enable_request"] = 1
    bench.tick(20)
    assert bench.state == (MANUAL, Reason.ENABLE_HELD_AT_START)
    bench.sys["enable_request"] = 0
    bench.tick(2)
    assert bench.state == (READY, Reason.NONE)
    bench.sys["enable_request"] = 1
    bench.tick(2)
    assert bench.state == (ACTIVE, Reason.NONE)


def test_disabling_while_driving_brakes_to_standstill_and_holds() -> None:
    bench = Bench().until_active().go(0.8)
    bench.sys["enable_request"] = 0
    bench.tick(2)
    assert bench.state == (READY, Reason.DISABLED_BY_CONTROLLER)
    moving = bench.truth
    bench.sys["enable_request"] = 1
    bench.tick(2)
    assert bench.state == (READY, Reason.NOT_AT_STANDSTILL)  # an edge while it moves is lost
    bench.tick(100)
    assert bench.truth.speed_mps == 0.0
    assert bench.truth.x_m - moving.x_m < 0.8 * 0.11 + 0.8**2 / (2 * BRAKE_DECEL_MPS2)
    assert bench.state == (READY, Reason.NOT_AT_STANDSTILL)
    stopped = bench.truth.x_m
    bench.tick(100)
    assert bench.truth.x_m == stopped
    assert bench.emulator.is_parked


# ---------------------------------------------------------------------------------------------------------- watchdog


@pytest.mark.parametrize("lost", ["CTRL_SysCmd", "CTRL_SteerCmd", "CTRL_LongCmd"])
def test_the_watchdog_bites_100_ms_after_the_last_command_and_stops_the_car(lost: str) -> None:
    bench = Bench().until_active().go(0.8)
    last_ns = bench.now_ns - TICK + PHASE
    bench.lost = {lost}
    bench.emulator.advance(last_ns + 100 * MS - 1)
    assert bench.emulator.state is ACTIVE
    bench.emulator.advance(last_ns + 100 * MS)
    assert bench.emulator.state is FAULT
    assert bench.emulator.reason is Reason.COMMAND_TIMEOUT
    at_bite = bench.emulator._motion.body.x_m  # the instant lies between two reports
    bench.now_ns += 10 * TICK
    bench.tick(150)
    assert bench.truth.speed_mps == 0.0
    way = bench.emulator._motion.body.x_m - at_bite
    assert way == pytest.approx(0.8 * 0.1 + 0.8**2 / (2 * BRAKE_DECEL_MPS2), abs=0.015)
    assert bench.state == (FAULT, Reason.COMMAND_TIMEOUT)
    assert bench.emulator.is_safe


@pytest.mark.parametrize(("silence_ms", "state"), [(99, ACTIVE), (100, FAULT)])
def test_99_ms_of_silence_are_forgiven(silence_ms: int, state: State) -> None:
    bench = Bench().until_active().go(0.5)
    bench.now_ns += silence_ms * MS - TICK
    bench.tick(3)
    assert bench.emulator.state is state


def test_commands_that_never_came_count_from_becoming_active() -> None:
    bench = Bench()
    bench.lost = {"CTRL_SteerCmd"}
    bench.until_ready()
    bench.sys["enable_request"] = 1
    bench.tick(2)
    assert bench.state == (ACTIVE, Reason.NONE)
    bench.tick(10)
    assert bench.state == (FAULT, Reason.COMMAND_TIMEOUT)


def test_an_old_command_does_not_move_a_newly_enabled_car() -> None:
    bench = Bench().until_ready()
    bench.long |= {"speed_cmd_mps": 0.5, "brake_decel_cmd_mps2": 0.0, "long_enable": 1, "gear_cmd": Gear.DRIVE}
    bench.tick(1)
    bench.lost = {"CTRL_LongCmd"}
    bench.tick(100)
    bench.sys["enable_request"] = 1
    bench.tick(9)
    assert bench.state == (ACTIVE, Reason.NONE)
    assert bench.seen["VEH_LongRpt"]["gear_rpt"] == Gear.PARK
    assert bench.seen["VEH_LongRpt"]["park_brake_applied"] == 1
    bench.tick(5)
    assert bench.state == (FAULT, Reason.COMMAND_TIMEOUT)


def corrupt_crc(_name: str, frame: Frame) -> list[Frame]:
    return [(frame[0], bytes([frame[1][0] ^ 1]) + frame[1][1:])]


def test_commands_with_a_wrong_crc_are_silence_with_a_reason() -> None:
    bench = Bench().until_active().go(0.5)
    rejected = bench.seen["VEH_SysRpt"]["sys_cmd_rejected_count"]
    bench.mangle = lambda name, frame: corrupt_crc(name, frame) if name == "CTRL_LongCmd" else [frame]
    bench.tick(3)
    assert bench.seen["VEH_LongRpt"]["long_cmd_bad_crc"] == 1
    assert bench.seen["VEH_SteerRpt"]["steer_cmd_bad_crc"] == 0
    assert bench.state[0] == ACTIVE
    bench.tick(10)
    assert bench.state == (FAULT, Reason.BAD_CRC)
    assert bench.seen["VEH_SysRpt"]["sys_cmd_rejected_count"] >= rejected + 10
    assert bench.seen["VEH_LongRpt"]["long_cmd_timeout"] == 1


def test_commands_that_are_repeated_are_silence_with_a_reason() -> None:
    bench = Bench().until_active().go(0.5)
    kept: dict[str, Frame] = {}
    bench.mangle = lambda name, frame: [kept.setdefault(name, frame)]
    bench.tick(13)
    assert bench.state == (FAULT, Reason.BAD_COUNTER)
    assert bench.seen["VEH_SysRpt"]["sys_cmd_bad_counter"] == 1


def test_a_replayed_frame_does_not_feed_the_watchdog_nor_move_the_wheels() -> None:
    bench = Bench().until_active()
    old = bench.wire.encode("CTRL_SteerCmd", {"road_wheel_angle_cmd_rad": 0.4, "steer_enable": 1})
    bench.emulator.receive(bench.now_ns, *old)
    bench.tick(30)
    before = bench.seen["VEH_SteerRpt"]["road_wheel_angle_echo_rad"]
    assert before == 0.0
    bench.emulator.receive(bench.now_ns - 1, *old)
    bench.tick(1)
    assert bench.seen["VEH_SteerRpt"]["road_wheel_angle_echo_rad"] == 0.0


def test_foreign_frames_and_wrong_lengths_do_nothing() -> None:
    bench = Bench().until_active().go(0.5)
    before = bench.emulator.rejected_count
    bench.emulator.receive(bench.now_ns, 0x7FF, bytes(8))
    bench.emulator.receive(bench.now_ns, 0x100, bytes(8))  # one of its own
    assert bench.emulator.rejected_count == before
    arbitration_id, data = bench.wire.encode("CTRL_LongCmd", bench.long)
    bench.emulator.receive(bench.now_ns, arbitration_id, data[:7])
    assert bench.emulator.rejected_count == before + 1
    bench.tick(20)
    assert bench.state == (ACTIVE, Reason.NONE)


# ------------------------------------------------------------------------------------------------- faults and clearing


def test_the_operators_emergency_stop_stops_at_once_and_stays() -> None:
    bench = Bench().until_active().go(0.8)
    bench.oper["oper_estop"] = 1
    if bench.ticks % 2:
        bench.tick(1)
    x = bench.truth.x_m
    bench.tick(80)
    assert bench.state == (FAULT, Reason.EMERGENCY_STOP)
    assert bench.truth.speed_mps == 0.0
    assert bench.truth.x_m - x < 0.8 * 0.11 + 0.8**2 / (2 * BRAKE_DECEL_MPS2) + 0.01
    bench.oper["oper_estop"] = 0
    bench.tick(50)
    assert bench.state == (FAULT, Reason.EMERGENCY_STOP)


def cleared(bench: Bench) -> tuple[int, int]:
    """State after the sequence of the conventions: enable 0 with clear 1, then clear 0."""
    bench.sys |= {"enable_request": 0, "clear_request": 1}
    bench.tick(3)
    bench.sys["clear_request"] = 0
    bench.tick(2)
    return bench.state


def test_a_fault_is_cleared_at_standstill_once_its_cause_is_gone() -> None:
    bench = Bench().until_active().go(0.8)
    bench.oper["oper_estop"] = 1
    bench.tick(2)
    assert cleared(bench) == (FAULT, Reason.EMERGENCY_STOP)  # moving, and still pressed
    bench.tick(100)
    assert cleared(bench) == (FAULT, Reason.EMERGENCY_STOP)  # still pressed
    bench.oper["oper_estop"] = 0
    bench.tick(2)
    bench.sys |= {"enable_request": 1, "clear_request": 1}
    bench.tick(3)
    assert bench.state == (FAULT, Reason.EMERGENCY_STOP)  # not with the request on
    assert cleared(bench) == (READY, Reason.NONE)
    bench.sys["enable_request"] = 1
    bench.tick(2)
    assert bench.state == (ACTIVE, Reason.NONE)


def test_a_fault_is_not_cleared_while_the_car_moves() -> None:
    bench = Bench().until_active().go(0.8)
    bench.emulator.press_emergency_stop(True)
    bench.emulator.press_emergency_stop(False)
    assert cleared(bench) == (FAULT, Reason.EMERGENCY_STOP)
    assert bench.truth.speed_mps > 0.1
    bench.tick(100)
    assert cleared(bench) == (READY, Reason.NONE)


def test_the_driver_gets_the_wheel_at_once() -> None:
    bench = Bench().until_active().go(0.5)
    bench.steer["road_wheel_angle_cmd_rad"] = 0.1
    bench.tick(30)
    bench.emulator.driver("steering", True)
    bench.steer["road_wheel_angle_cmd_rad"] = -0.3
    bench.tick(100)
    assert bench.state == (FAULT, Reason.DRIVER_OVERRIDE)
    report = bench.seen["VEH_SteerRpt"]
    assert report["steer_override"] == 1
    assert report["steering_wheel_torque_nm"] == 5.0
    assert report["road_wheel_angle_meas_rad"] == pytest.approx(0.1, abs=1e-4)
    assert bench.seen["VEH_SysRpt"]["driver_override"] == 1
    assert bench.truth.speed_mps == 0.0
    assert cleared(bench)[0] == FAULT
    bench.emulator.driver("steering", False)
    bench.tick(1)
    assert bench.seen["VEH_SteerRpt"]["steer_override"] == 0
    assert bench.seen["VEH_SysRpt"]["driver_override"] == 1  # latched
    assert cleared(bench) == (READY, Reason.NONE)
    assert bench.seen["VEH_SysRpt"]["driver_override"] == 0


def test_the_drivers_brake() -> None:
    bench = Bench().until_active().go(0.5)
    bench.emulator.driver("brake", True)
    bench.tick(60)
    assert bench.seen["VEH_LongRpt"]["brake_override"] == 1
    assert bench.state == (FAULT, Reason.DRIVER_OVERRIDE)
    assert bench.truth.speed_mps == 0.0


def test_a_second_fault_does_not_change_the_reason() -> None:
    bench = Bench().until_active().go(0.5)
    bench.emulator.driver("brake", True)
    bench.emulator.press_emergency_stop(True)
    bench.tick(2)
    assert bench.state == (FAULT, Reason.DRIVER_OVERRIDE)


def test_in_a_fault_the_steering_goes_on_following_until_standstill_and_beyond() -> None:
    bench = Bench().until_active().go(0.8)
    bench.oper["oper_estop"] = 1
    bench.tick(2)
    for i in range(40):
        bench.steer["road_wheel_angle_cmd_rad"] = 0.005 * i
        bench.tick(1)
    assert bench.state[0] == FAULT
    assert bench.seen["VEH_SteerRpt"]["road_wheel_angle_meas_rad"] > 0.18


def test_not_active_it_follows_nothing() -> None:
    bench = Bench().until_ready()
    bench.steer |= {"road_wheel_angle_cmd_rad": 0.3, "steer_enable": 1}
    bench.long |= {"speed_cmd_mps": 0.5, "brake_decel_cmd_mps2": 0.0, "gear_cmd": Gear.DRIVE, "long_enable": 1}
    bench.tick(100)
    assert bench.seen["VEH_SteerRpt"]["road_wheel_angle_meas_rad"] == 0.0
    assert bench.seen["VEH_SteerRpt"]["road_wheel_angle_echo_rad"] == pytest.approx(0.3)
    assert bench.seen["VEH_LongRpt"]["gear_rpt"] == Gear.PARK
    assert bench.seen["VEH_LongRpt"]["speed_echo_mps"] == pytest.approx(0.5)
    assert bench.truth.speed_mps == 0.0


def test_the_enables_of_steering_and_drive_hold_each() -> None:
    bench = Bench().until_active().go(0.5)
    bench.steer |= {"road_wheel_angle_cmd_rad": 0.2, "steer_enable": 0}
    bench.tick(30)
    assert bench.seen["VEH_SteerRpt"]["road_wheel_angle_meas_rad"] == 0.0
    bench.long["long_enable"] = 0
    bench.tick(60)
    assert bench.truth.speed_mps == 0.0
    assert bench.state == (ACTIVE, Reason.NONE)


# --------------------------------------------------------------------------------------------------- gear, park brake


def test_the_gear_takes_its_time_and_is_none_meanwhile() -> None:
    bench = Bench().until_ready()
    bench.sys["enable_request"] = bench.long["long_enable"] = 1
    bench.long["gear_cmd"] = Gear.DRIVE
    bench.tick(1)
    shown = []
    for _ in range(60):
        bench.tick(1)
        shown.append(bench.seen["VEH_LongRpt"]["gear_rpt"])
    assert shown[:50] == [Gear.NONE] * 50
    assert shown[51:] == [Gear.DRIVE] * 9
    assert shown[50] in (Gear.NONE, Gear.DRIVE)


def test_the_gear_changes_only_at_standstill() -> None:
    bench = Bench().until_active().go(0.5)
    bench.long["gear_cmd"] = Gear.REVERSE
    bench.tick(50)
    assert bench.seen["VEH_LongRpt"]["gear_rpt"] == Gear.DRIVE
    assert bench.truth.speed_mps > 0.4
    bench.brake(seconds=1.8)
    assert bench.seen["VEH_LongRpt"]["gear_rpt"] == Gear.REVERSE


def test_gear_none_keeps_the_gear() -> None:
    bench = Bench().until_active()
    bench.long["gear_cmd"] = Gear.NONE
    bench.tick(100)
    assert bench.seen["VEH_LongRpt"]["gear_rpt"] == Gear.DRIVE


@pytest.mark.parametrize(
    ("gear", "speed", "moves"),
    [
        (Gear.DRIVE, 0.3, True),
        (Gear.DRIVE, -0.3, False),
        (Gear.REVERSE, -0.3, True),
        (Gear.REVERSE, 0.3, False),
        (Gear.NEUTRAL, 0.3, False),
        (Gear.PARK, 0.3, False),
    ],
)
def test_it_drives_only_where_the_gear_fits_the_sign(gear: Gear, speed: float, moves: bool) -> None:
    bench = Bench().until_active(gear).go(speed, 2.0)
    if moves:
        assert bench.truth.speed_mps == pytest.approx(speed, rel=0.01)
    else:
        assert bench.truth.speed_mps == 0.0


def test_the_park_brake_holds_and_is_applied_only_at_standstill() -> None:
    bench = Bench().until_active()
    bench.long["park_brake_cmd"] = 1
    bench.go(0.5, 1.0)
    assert bench.seen["VEH_LongRpt"]["park_brake_applied"] == 1
    assert bench.truth.speed_mps == 0.0
    bench.long["park_brake_cmd"] = 0
    bench.go(0.5, 1.0)
    assert bench.seen["VEH_LongRpt"]["park_brake_applied"] == 0
    bench.long["park_brake_cmd"] = 1
    bench.go(0.5, 0.5)
    assert bench.seen["VEH_LongRpt"]["park_brake_applied"] == 0
    assert bench.truth.speed_mps > 0.3
    bench.brake()
    assert bench.seen["VEH_LongRpt"]["park_brake_applied"] == 1


def test_the_brake_is_limited_to_what_the_car_can() -> None:
    bench = Bench().until_active().go(1.0)
    bench.brake(9.0, 0.6)
    assert max(row.brake for row in bench.emulator.truth) <= 4.0
    assert bench.truth.brake == pytest.approx(4.0, abs=0.02)
