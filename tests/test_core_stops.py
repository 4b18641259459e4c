"""Stops that must not come undone, and cars that do not do what they are told: over the whole core, cycle by cycle."""

import pytest
from core_support import shipped_codec, shipped_tables, standing_inputs

from firmware_py.core import conditions as c
from firmware_py.core import controller, supervisor
from firmware_py.core import signals as s
from firmware_py.node import FAILED_CYCLES, ControllerNode

TABLES = shipped_tables()


class Bench:
    """A core with a car that reports what a test says; the steering follows at once."""

    def __init__(self):
        self.state = controller.begin()
        self.cycle = 0
        self.outputs = None
        self.report = {}

    def step(self, cycles=1, lost=(), **report):
        self.report |= report
        for _ in range(cycles):
            inputs = standing_inputs(TABLES, self.cycle, self.report.get("vehicle_state", s.MODE_READY))
            angle_rad = self.outputs.steer.road_wheel_angle_cmd_rad if self.outputs else 0.0
            speed_mps = self.report.get("speed_mps", 0.0)
            inputs = inputs._replace(
                oper=inputs.oper._replace(**self.report.get("oper", {})),
                steer=inputs.steer._replace(road_wheel_angle_meas_rad=angle_rad),
                motion=inputs.motion._replace(speed_meas_mps=speed_mps),
                long=inputs.long._replace(
                    gear_rpt=self.report.get("gear", s.GEAR_PARK),
                    park_brake_applied=self.report.get("park_brake", 1),
                    standstill=1 if speed_mps == 0.0 else 0,
                ),
                version=inputs.version._replace(**self.report.get("version", {})),
                used=inputs.used._replace(**dict.fromkeys(lost, s.NO_COUNTER)),
            )
            if "along_m" in self.report:
                along_m = inputs.position.position_x_m + self.report["along_m"]
                inputs = inputs._replace(position=inputs.position._replace(position_x_m=along_m))
            self.state, self.outputs = controller.step(TABLES, self.state, inputs)
            self.cycle += 1
        return self.outputs

    def arm(self):
        self.step(60)
        self.step(1, oper={"oper_start": 1})
        self.step(1, vehicle_state=s.MODE_ACTIVE)
        assert self.outputs.sys.control_mode == s.MODE_ACTIVE
        return self

    def drive(self):
        self.arm().step(20, gear=s.GEAR_DRIVE, park_brake=0)
        assert self.state.manoeuvre.driving == 1
        return self

    @property
    def why(self):
        return self.outputs.sys.control_mode, self.outputs.sys.control_reason


def follows(outputs):
    return (outputs.sys.enable_request, outputs.steer.steer_enable, outputs.long.long_enable)


@pytest.mark.parametrize("lost", ["used_long_counter", "used_motion_counter"])
def test_a_car_that_has_stood_in_a_fault_is_not_enabled_again(lost):
    bench = Bench().drive()
    bench.step(5, oper={"oper_stop": 1})
    assert bench.why == (s.MODE_FAULT, c.OPERATOR_STOP)
    assert follows(bench.outputs) == (0, 0, 0)
    bench.step(1, vehicle_state=s.MODE_READY, oper={})
    for _ in range(60):
        assert follows(bench.step(1, lost=[lost])) == (0, 0, 0)
    for _ in range(60):
        assert follows(bench.step(1)) == (0, 0, 0)
    assert bench.outputs.sys.control_mode == s.MODE_FAULT


def test_a_stop_whose_standstill_cannot_be_seen_ends_all_the_same():
    bench = Bench().drive()
    bench.step(20, speed_mps=0.2)
    bench.step(11, lost=["used_motion_counter"])
    assert bench.why == (s.MODE_FAULT, c.MOTION_REPORT_TIMEOUT)
    station_m = bench.outputs.track.station_m
    bench.step(supervisor.LONGEST_STOP_US // 10_000 + 2, lost=["used_motion_counter", "used_position_counter"])
    assert follows(bench.outputs) == (0, 0, 0)
    assert bench.outputs.track.station_m - station_m < 0.3, "no phantom drive along the path"


def test_a_controlled_stop_that_does_not_stop_gets_the_emergency_brake():
    bench = Bench().drive()
    bench.step(5, oper={"oper_stop": 1}, speed_mps=0.3)
    assert bench.outputs.long.brake_decel_cmd_mps2 == pytest.approx(1.0)
    bench.step(supervisor.CONTROLLED_STOP_US // 10_000 + 1)
    assert bench.outputs.long.brake_decel_cmd_mps2 == pytest.approx(2.4)


def test_a_car_that_does_not_move_is_noticed():
    bench = Bench().drive()
    bench.step(270)
    assert bench.outputs.sys.control_mode == s.MODE_ACTIVE
    bench.step(40)
    assert bench.why == (s.MODE_FAULT, c.SPEED_NOT_FOLLOWING)


def test_a_car_that_is_faster_than_planned_is_noticed():
    bench = Bench().drive()
    bench.step(35, speed_mps=0.8)
    assert bench.outputs.sys.control_mode == s.MODE_FAULT
    assert bench.outputs.sys.control_reason in (c.SPEED_NOT_FOLLOWING, c.POSE_JUMP)


@pytest.mark.parametrize("speed_mps", [0.2, -0.2])
def test_a_car_that_rolls_while_it_is_to_be_held_is_noticed(speed_mps):
    bench = Bench().arm()
    bench.step(8, speed_mps=speed_mps)
    assert bench.why == (s.MODE_FAULT, c.WRONG_DIRECTION)


def test_a_pose_that_jumps_while_the_gear_changes_is_not_believed():
    bench = Bench().arm()
    bench.step(10, along_m=0.4)
    assert bench.why == (s.MODE_FAULT, c.POSE_JUMP)
    assert abs(bench.state.estimator.station_m) < 0.05


@pytest.mark.parametrize(
    ("version", "reason"),
    [
        ({"veh_protocol": 2}, c.DBC_HASH_MISMATCH),
        ({"veh_dbc_hash": 1}, c.DBC_HASH_MISMATCH),
        ({"veh_vehicle_hash": 1}, c.VEHICLE_HASH_MISMATCH),
    ],
)
def test_another_vehicle_on_the_way_is_a_fault(version, reason):
    bench = Bench().drive()
    bench.step(2, version=version)
    assert bench.why == (s.MODE_FAULT, reason)


class TestFailingCore:
    """A core that raises: emergency stop for a car that was being driven, nothing at all for one that was not."""

    @pytest.fixture
    def node(self, monkeypatch):
        node = ControllerNode(shipped_codec(), TABLES)
        node.cycle(0, [], 0)

        def broken(*_):
            raise ZeroDivisionError

        monkeypatch.setattr(controller, "step", broken)
        return node

    def enabled(self, node, cycle):
        codec = shipped_codec()
        frames = dict(node.cycle(cycle * 10_000_000, [], 0))
        sys = codec.unpack["CTRL_SysCmd"](frames[codec.messages["CTRL_SysCmd"].frame_id])
        return sys.enable_request

    def test_a_car_that_was_not_driven_is_not_enabled(self, node):
        assert [self.enabled(node, cycle) for cycle in range(1, 20)] == [0] * 19

    def test_a_car_that_was_driven_is_stopped_and_then_released(self, node):
        node._outputs = node._outputs._replace(steer=node._outputs.steer._replace(steer_enable=1))
        enabled = [self.enabled(node, cycle) for cycle in range(1, FAILED_CYCLES + 20)]
        assert enabled == [1] * FAILED_CYCLES + [0] * 19
        assert not node.is_driving

    def test_the_driver_keeps_the_car(self, node):
        released = node._state.supervisor._replace(mode=s.MODE_FAULT, reaction=supervisor.STOP_RELEASE)
        node._state = node._state._replace(supervisor=released)
        node._outputs = node._outputs._replace(steer=node._outputs.steer._replace(steer_enable=1))
        assert self.enabled(node, 1) == 0
