"""The emulator in virtual time: latencies to the nanosecond, the whole actuator chain, reports, repeatability."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import pytest
from sim_support import DBC, LAGLESS, MS, PHASE, TICK, Bench, scenario

from sim.data_files import load_course, load_scenario, load_vehicle, shipped_names
from sim.drive_by_wire import Gear, State
from sim.emulator import Emulator
from sim.errors import UserError


def driving(world: Any = None, speed: float = 0.5, **keys: Any) -> Bench:
    gear = Gear.DRIVE if speed > 0 else Gear.REVERSE
    bench = Bench(world, **keys).until_active(gear)
    return bench.go(speed)


def rack(bench: Bench) -> float:
    """The rack's angle at the emulator's present instant, which may lie between reports."""
    return bench.emulator._motion.steer.rack_rad


# ----------------------------------------------------------------------------------------------------------- latency


@pytest.mark.parametrize("samples", [0.0, 0.5, 1.0, 1.37, 24.0])
def test_a_steering_command_acts_after_its_dead_time_to_the_nanosecond(samples: float) -> None:
    bench = driving(scenario(vehicle_overlay={**LAGLESS, "command_latency_samples": samples}))
    arrival_ns = bench.now_ns + 4_321_987
    bench.lost = {"CTRL_SteerCmd"}
    bench.send(arrival_ns, "CTRL_SteerCmd", {"road_wheel_angle_cmd_rad": 0.3, "steer_enable": 1})
    acts_ns = arrival_ns + round(samples * TICK)
    bench.emulator.advance(acts_ns)
    assert rack(bench) == 0.0
    bench.emulator.advance(acts_ns + 1000)
    assert rack(bench) == pytest.approx(0.59 * 1e-6, rel=1e-6)
    assert bench.emulator.now_ns == acts_ns + 1000


def test_commands_queue_up_during_a_long_dead_time() -> None:
    """Ten commands are on their way at once; each acts in its turn."""
    slow = driving(scenario(vehicle_overlay={**LAGLESS, "command_latency_samples": 10.0}))
    fast = driving(scenario(vehicle_overlay=LAGLESS))
    history: dict[str, list[float]] = {"slow": [], "fast": []}
    for i in range(60):
        for name, bench in (("slow", slow), ("fast", fast)):
            bench.steer["road_wheel_angle_cmd_rad"] = 0.05 * math.sin(0.2 * i)
            bench.tick(1)
            history[name].append(bench.truth.road_wheel_angle_rad)
    assert history["slow"][10:] == pytest.approx(history["fast"][:-10], abs=1e-12)
    assert max(history["fast"]) > 0.04


def test_speed_and_brake_have_a_dead_time_of_their_own() -> None:
    for samples in (0.0, 3.0):
        bench = driving(scenario(vehicle_overlay=LAGLESS, plant={"longitudinal_latency_samples": samples}))
        arrival_ns = bench.now_ns + PHASE
        bench.send(arrival_ns, "CTRL_LongCmd", {**bench.long, "brake_decel_cmd_mps2": 2.0})
        acts_ns = arrival_ns + round(samples * TICK)
        bench.emulator.advance(acts_ns)
        assert bench.emulator._motion.decel_mps2 == 0.0
        bench.emulator.advance(acts_ns + MS)
        assert bench.emulator._motion.decel_mps2 == pytest.approx(2.0 * (1.0 - math.exp(-0.01)))


@pytest.mark.parametrize("samples", [0.0, 1.0, 1.25, 3.0])
def test_the_pose_is_that_of_its_latency_ago(samples: float) -> None:
    bench = driving(scenario(vehicle_overlay={**LAGLESS, "pose_latency_samples": samples}))
    bench.steer["road_wheel_angle_cmd_rad"] = 0.2
    bench.tick(100)
    row = bench.truth
    late_s = samples * 0.01
    ahead, turn = row.speed_mps * late_s, row.speed_mps * math.tan(0.2) / 4.0 * late_s
    yaw = row.yaw_rad - turn
    assert bench.seen["LOC_Attitude"]["yaw_rad"] == pytest.approx(yaw, abs=2e-6)
    assert bench.seen["LOC_Position"]["position_x_m"] == pytest.approx(
        row.x_m - ahead * math.cos(row.yaw_rad - turn / 2), abs=1.5e-5
    )
    assert bench.seen["LOC_Position"]["position_y_m"] == pytest.approx(
        row.y_m - ahead * math.sin(row.yaw_rad - turn / 2), abs=1.5e-5
    )
    assert bench.seen["LOC_Attitude"]["pose_latency_ms"] == pytest.approx(10.0 * samples)


def test_whole_samples_of_pose_latency_give_an_earlier_row_of_the_truth() -> None:
    bench = driving(scenario(vehicle_overlay={**LAGLESS, "pose_latency_samples": 2.0}))
    bench.steer["road_wheel_angle_cmd_rad"] = -0.3
    bench.tick(57)
    row = bench.emulator.truth[-3]
    assert bench.seen["LOC_Position"]["position_x_m"] == pytest.approx(row.x_m, abs=0.51e-5)
    assert bench.seen["LOC_Position"]["position_y_m"] == pytest.approx(row.y_m, abs=0.51e-5)
    assert bench.seen["LOC_Attitude"]["yaw_rad"] == pytest.approx(row.yaw_rad, abs=0.21e-6)


def test_the_localiser_tells_the_latency_that_it_believes_in() -> None:
    """An unknown latency is unknown to it too."""
    bench = Bench(scenario(plant={"unknown": {"pose_latency_samples": 2.0}})).tick(2)
    assert bench.seen["LOC_Attitude"]["pose_latency_ms"] == pytest.approx(10.0)


def test_reports_of_the_car_have_no_latency() -> None:
    bench = driving()
    bench.long["speed_cmd_mps"] = 0.9
    for _ in range(20):
        bench.tick(1)
        row = bench.truth
        assert bench.seen["VEH_MotionRpt"]["speed_meas_mps"] == pytest.approx(row.speed_mps, abs=0.51e-4)
    assert bench.truth.speed_mps > 0.65


# -------------------------------------------------------------------------------------------- the actuators in place


def test_bias_is_on_the_wheel_and_not_on_the_sensor() -> None:
    bench = driving(scenario(vehicle_overlay=LAGLESS, plant={"steering_bias_rad": 0.0175}))
    assert bench.truth.road_wheel_angle_rad == pytest.approx(0.0175)
    assert bench.seen["VEH_SteerRpt"]["road_wheel_angle_meas_rad"] == 0.0
    assert bench.seen["VEH_MotionRpt"]["yaw_rate_meas_radps"] == pytest.approx(0.5 * math.tan(0.0175) / 4.0, rel=0.01)


def test_gain_and_backlash_in_place() -> None:
    world = scenario(vehicle_overlay=LAGLESS, plant={"steering_gain": 0.95, "steering_backlash_rad": 0.004})
    bench = driving(world)
    bench.steer["road_wheel_angle_cmd_rad"] = 0.2
    bench.tick(80)
    assert bench.seen["VEH_SteerRpt"]["road_wheel_angle_meas_rad"] == pytest.approx(0.19, abs=2.1e-5)
    assert bench.seen["VEH_SteerRpt"]["road_wheel_angle_echo_rad"] == pytest.approx(0.2)
    assert bench.truth.road_wheel_angle_rad == pytest.approx(0.188, abs=1e-9)


def test_the_limit_bits() -> None:
    bench = driving()
    for i in range(40):  # 0.5 rad/s: below the limit of 0.59
        bench.steer["road_wheel_angle_cmd_rad"] = 0.005 * i
        bench.tick(1)
        assert bench.seen["VEH_SteerRpt"]["steer_limiting_rate"] == 0
    for i in range(20):
        bench.steer["road_wheel_angle_cmd_rad"] = 0.2 + 0.007 * i
        bench.tick(1)
    assert bench.seen["VEH_SteerRpt"]["steer_limiting_rate"] == 1
    assert bench.seen["VEH_SteerRpt"]["steer_limiting_value"] == 0
    bench.steer["road_wheel_angle_cmd_rad"] = 0.5
    bench.tick(100)
    assert bench.seen["VEH_SteerRpt"]["steer_limiting_value"] == 0
    bench.steer["road_wheel_angle_cmd_rad"] = 0.7
    bench.tick(3)
    assert bench.seen["VEH_SteerRpt"]["steer_limiting_value"] == 1
    assert bench.seen["VEH_SteerRpt"]["road_wheel_angle_meas_rad"] == pytest.approx(0.5)
    assert max(row.road_wheel_rate_radps for row in bench.emulator.truth) <= 0.59 * (1 + 1e-9)


@pytest.mark.parametrize("speed", [0.4, -0.4])
def test_it_drives_a_circle_in_both_directions(speed: float) -> None:
    bench = driving(speed=speed)
    bench.steer["road_wheel_angle_cmd_rad"] = 0.3
    bench.tick(200)
    first = bench.truth
    bench.tick(100)
    last = bench.truth
    curvature = (last.yaw_rad - first.yaw_rad) / (speed * 1.0)
    assert curvature == pytest.approx(math.tan(0.3) / 4.0, rel=1e-3)
    assert last.accel_y_mps2 == pytest.approx(speed * speed * curvature, rel=1e-3)


def test_a_stop_is_exact_and_held() -> None:
    bench = driving(speed=0.6).brake(1.0, 1.5)
    stopped = bench.truth
    assert (stopped.speed_mps, stopped.accel_x_mps2) == (0.0, 0.0)
    assert bench.seen["VEH_LongRpt"]["standstill"] == 1
    assert bench.seen["VEH_MotionRpt"]["speed_meas_mps"] == 0.0
    bench.steer["road_wheel_angle_cmd_rad"] = 0.4
    bench.tick(100)
    after = bench.truth
    assert (after.x_m, after.y_m, after.yaw_rad) == (stopped.x_m, stopped.y_m, stopped.yaw_rad)
    assert after.road_wheel_angle_rad == pytest.approx(0.4)


def test_longitudinal_acceleration_in_the_truth_is_the_slope_of_the_speed() -> None:
    bench = driving(speed=0.6)
    bench.long["speed_cmd_mps"] = 0.9
    bench.tick(30)
    rows = bench.emulator.truth[-20:]
    for a, b in pairwise(rows):
        assert 0.5 * (a.accel_x_mps2 + b.accel_x_mps2) == pytest.approx((b.speed_mps - a.speed_mps) / 0.01, rel=0.02)


# ------------------------------------------------------------------------------------------------------ the sensors


def test_the_car_scenario_on_the_wire() -> None:
    bench = driving(load_scenario("car"), speed=1.0)
    xs, yaws, speeds = [], [], []
    for _ in range(200):
        bench.tick(1)
        row = bench.emulator.truth[-2]
        xs.append(bench.seen["LOC_Position"]["position_x_m"] - row.x_m)
        yaws.append(bench.seen["LOC_Attitude"]["yaw_rad"] - row.yaw_rad)
        speeds.append(bench.seen["VEH_MotionRpt"]["speed_meas_mps"])
    assert math.sqrt(sum(x * x for x in xs) / 200) == pytest.approx(0.01, rel=0.25)
    assert math.sqrt(sum(a * a for a in yaws) / 200) == pytest.approx(0.0017453, rel=0.25)
    assert speeds[-1] == pytest.approx(1.01, abs=6e-4)
    assert all(speed == pytest.approx(round(speed, 3), abs=1e-9) for speed in speeds)
    assert bench.seen["LOC_Attitude"]["position_sigma_m"] == pytest.approx(0.01)
    assert bench.seen["LOC_Position"]["position_quality"] == 3


def test_position_and_attitude_carry_the_same_counter_and_are_dropped_together() -> None:
    bench = Bench(scenario(sensors={"pose_drop_probability": 0.3}))
    pairs, dropped = 0, 0
    for i in range(200):
        frames = dict(bench.emulator.reports(i * TICK))
        assert (0x600 in frames) == (0x601 in frames)
        if 0x600 in frames:
            assert frames[0x600][1] & 0x0F == frames[0x601][1] & 0x0F == pairs % 15
            pairs += 1
        else:
            dropped += 1
    assert 30 < dropped < 90


# ----------------------------------------------------------------------------------------------- time and repeatability


def manoeuvre(seed: int = 3, start_ns: int = 0, world: str = "car", **keys: Any) -> Bench:
    """A few seconds of lively driving."""
    bench = Bench(load_scenario(world), seed=seed, start_ns=start_ns, **keys).until_active()
    bench.go(0.5, 0.2)
    for i in range(150):
        bench.steer["road_wheel_angle_cmd_rad"] = 0.3 * math.sin(0.05 * i)
        bench.tick(1)
    return bench.brake(1.0, 0.5)


def test_the_same_seed_gives_the_same_run_bit_for_bit_and_another_does_not() -> None:
    first, second, other = manoeuvre(), manoeuvre(), manoeuvre(seed=4)
    assert first.emulator.truth == second.emulator.truth
    assert first.seen == second.seen
    assert first.emulator.truth != other.emulator.truth


def test_the_run_does_not_depend_on_the_epoch() -> None:
    early, late = manoeuvre().emulator.truth, manoeuvre(start_ns=123_456_789_000_000_000).emulator.truth
    assert [row[1:] for row in early] == [row[1:] for row in late]
    assert [row.t_s for row in early] == pytest.approx([row.t_s for row in late], abs=1e-9)


def test_extra_calls_of_advance_change_next_to_nothing() -> None:
    """Steps are cut at other instants; the plant is the same to well below a tenth of a millimetre."""
    plain = manoeuvre()
    chopped = Bench(load_scenario("car"), seed=3)
    receive = chopped.emulator.receive

    def chop(now_ns: int, arbitration_id: int, data: bytes) -> None:
        for share in range(1, 8):
            chopped.emulator.advance(now_ns - PHASE + share * PHASE // 8)
        receive(now_ns, arbitration_id, data)

    chopped.emulator.receive = chop  # type: ignore[method-assign]
    chopped.until_active()
    chopped.go(0.5, 0.2)
    for i in range(150):
        chopped.steer["road_wheel_angle_cmd_rad"] = 0.3 * math.sin(0.05 * i)
        chopped.tick(1)
    chopped.brake(1.0, 0.5)
    a, b = plain.truth, chopped.truth
    assert (a.x_m, a.y_m, a.yaw_rad) == pytest.approx((b.x_m, b.y_m, b.yaw_rad), abs=3e-5)
    assert a.x_m - plain.emulator.truth[0].x_m > 0.5


def test_time_that_is_gone_is_gone() -> None:
    """A frame with an instant in the past acts now; an advance into the past does nothing."""
    bench = driving()
    now_ns = bench.emulator.now_ns
    state = bench.emulator._motion.body
    bench.emulator.advance(now_ns - 5 * MS)
    assert (bench.emulator.now_ns, bench.emulator._motion.body) == (now_ns, state)
    bench.send(now_ns - 5 * MS, "CTRL_SteerCmd", {"road_wheel_angle_cmd_rad": 0.3, "steer_enable": 1})
    bench.emulator.advance(now_ns + MS)
    assert rack(bench) == pytest.approx(0.59e-3)


def test_no_step_is_longer_than_a_millisecond(monkeypatch: pytest.MonkeyPatch) -> None:
    import sim.plant  # noqa: PLC0415

    steps: list[float] = []
    original = sim.plant.step

    def watched(*args: Any) -> Any:
        steps.append(args[-1])
        return original(*args)

    monkeypatch.setattr(sim.plant, "step", watched)
    bench = driving(period_ns=13_700_003)
    assert max(steps) <= 1e-3
    assert sum(steps) == pytest.approx(1e-9 * bench.emulator.now_ns, rel=1e-6)


def test_a_row_of_truth_for_every_call_of_reports() -> None:
    bench = Bench(start_ns=5 * TICK).tick(7)
    assert [row.t_s for row in bench.emulator.truth] == pytest.approx([0.01 * i for i in range(7)])
    row = bench.emulator.truth[0]
    assert (row.x_m, row.y_m, row.yaw_rad) == load_course("ohio").start_pose(load_vehicle("paper"))
    assert (row.gear, row.state, row.speed_mps) == (Gear.PARK, State.MANUAL, 0.0)
    assert row.min_clearance_m == pytest.approx(1.3716 - 1.0)


def test_the_truth_forgets_what_is_older_than_an_hour(monkeypatch: pytest.MonkeyPatch) -> None:
    import sim.emulator  # noqa: PLC0415

    monkeypatch.setattr(sim.emulator, "MAX_TRUTH_ROWS", 50)
    bench = Bench().tick(120)
    assert 45 <= len(bench.emulator.truth) <= 50
    assert bench.truth.t_s == pytest.approx(1.19)


# ---------------------------------------------------------------------------------------------------------- starting


@pytest.mark.parametrize("name", shipped_names("scenario"))
@pytest.mark.parametrize("side", ["left", "right"])
def test_every_scenario_starts_on_its_course(name: str, side: Any) -> None:
    world = load_scenario(name)
    bench = Bench(world, side=side, seed=6).tick(3)
    start = load_course("ohio").start_pose(load_vehicle("paper"), side)
    row = bench.truth
    if name == "start-offset":
        assert 0.0 < math.hypot(row.x_m - start.x_m, row.y_m - start.y_m) <= 0.05
        assert 0.0 < abs(row.yaw_rad) <= math.radians(1.0) + 1e-6
    else:
        assert (row.x_m, row.y_m, row.yaw_rad) == start
    assert bench.emulator.state is State.READY


def test_a_car_that_does_not_fit_is_refused() -> None:
    wide = scenario(vehicle_overlay={"body_width_m": 2.6, "mirror_width_m": 2.6})
    with pytest.raises(
        UserError, match=r"^vehicle paper does not fit course ohio: at the start its outline is 0\.072 m"
    ):
        Bench(wide)


def test_an_unreadable_dbc_is_one_line() -> None:
    with pytest.raises(UserError, match=r"no\.dbc"):
        Emulator(load_vehicle("paper"), load_course("ohio"), scenario(), "left", 0, DBC.with_name("no.dbc"), 0)


def test_the_hash_covers_the_overlay_whoever_applies_it() -> None:
    world = load_scenario("slow-rack")
    once = Bench(world).emulator.vehicle_hash24
    assert Bench(world, vehicle=load_vehicle("paper", world.vehicle_overlay)).emulator.vehicle_hash24 == once
    assert once != Bench(load_scenario("car")).emulator.vehicle_hash24
