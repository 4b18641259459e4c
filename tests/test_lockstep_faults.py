"""What happens when the frame does not come, or comes wrong: the car stops on the path, touches nothing, says why."""

import numpy as np
import pytest
from core_support import TABLES

from firmware_py.core import conditions as c
from firmware_py.core import signals as s
from firmware_py.reasons import TEXT
from sim.data_files import load_course, load_scenario, load_vehicle
from sim.faults import FaultEvent
from tools.figures import load_path, project, truth_of_rows
from tools.lockstep import run_lockstep

STOPPING_CROSS_TRACK_M = 0.05
AT_S = 8.0  # at full speed, in the turn


def run_with(*faults, scenario_name="car", side="left", **options):
    scenario = load_scenario(scenario_name).model_copy(update={"faults": list(faults)})
    return run_lockstep(
        load_vehicle("paper"), load_course("ohio"), scenario, side, 1, "car", TABLES, longest_s=60.0, **options
    )


def fault(kind, at_s=AT_S, **keys):
    return FaultEvent(kind=kind, after="moving", at_s=at_s, **keys)


def judged(run, side="left"):
    """Distance from the fault to the stop, and the greatest true cross-track error of the run."""
    truth = truth_of_rows(run.truth)
    moving = np.flatnonzero(np.abs(truth.speed_mps) > 0.0)
    began = truth.t_s[moving[0]] + AT_S
    after = truth.t_s >= began
    distance_m = float(np.sum(np.abs(truth.speed_mps[after])) * 0.01)
    on_path = project(load_path(TABLES, side), truth.x_m, truth.y_m, truth.yaw_rad)
    return distance_m, float(np.max(np.abs(on_path.cross_track_error_m)))


LOST = {
    "VEH_SysRpt": c.SYS_REPORT_TIMEOUT,
    "VEH_SteerRpt": c.STEER_REPORT_TIMEOUT,
    "VEH_MotionRpt": c.MOTION_REPORT_TIMEOUT,
    "VEH_LongRpt": c.LONG_REPORT_TIMEOUT,
    "LOC_Position": c.POSE_TIMEOUT,
    "LOC_Attitude": c.POSE_TIMEOUT,
    "OPER_Cmd": None,  # lost on its way to the vehicle only: the controller still hears it
}


def assert_stopped(run, reason, distance_m, side="left"):
    assert run.controller["mode"] == s.MODE_FAULT, run.controller["reason_text"]
    if reason is not None:
        assert run.controller["reason"] == reason, f"said {run.controller['reason_text']}, meant {TEXT[reason]}"
    assert run.exam.cones_touched == ()
    stopped_m, cross_m = judged(run, side)
    assert stopped_m <= distance_m
    assert cross_m <= STOPPING_CROSS_TRACK_M
    assert run.truth[-1].speed_mps == 0.0


@pytest.mark.parametrize("message", [name for name, reason in LOST.items() if reason is not None])
@pytest.mark.parametrize("kind", ["stop_message", "freeze_counter", "corrupt_crc"])
def test_each_report_lost_or_spoiled_stops_the_car_within_its_timeout(message, kind):
    """100 ms at 1 m/s, then 1 m/s^2 with 0.1 s of brake lag: 0.70 m and a little for the drive's lag."""
    assert_stopped(run_with(fault(kind, message=message)), LOST[message], 0.80)


@pytest.mark.parametrize("message", ["LOC_Position", "VEH_MotionRpt", "VEH_SteerRpt"])
@pytest.mark.parametrize("kind", ["stop_message", "corrupt_crc"])
def test_two_lost_frames_are_driven_through(message, kind):
    run = run_with(fault(kind, message=message, duration_s=0.02))
    assert run.controller["completed"], run.controller["reason_text"]
    assert run.exam.score == 100
    assert judged(run)[1] <= 0.008


@pytest.mark.parametrize("message", ["CTRL_SteerCmd", "CTRL_LongCmd", "CTRL_SysCmd"])
def test_a_command_that_does_not_arrive_makes_the_vehicle_stop_by_itself(message):
    run = run_with(fault("stop_message", message=message))
    assert_stopped(run, None, 0.55)
    assert run.controller["reason"] in (c.VEHICLE_FAULT, c.COMMAND_REJECTED)


def test_the_driver_gets_the_car_at_once():
    run = run_with(fault("driver_override", control="steering"))
    assert run.controller["reason"] == c.DRIVER_OVERRIDE
    assert run.exam.cones_touched == ()


def test_an_emergency_stop_takes_the_hardest_brake():
    run = run_with(fault("emergency_stop"))
    assert run.controller["mode"] == s.MODE_FAULT
    assert judged(run)[0] <= 0.40
    assert run.exam.cones_touched == ()


def test_a_rack_that_does_not_follow_is_noticed():
    run = run_with(fault("steering_frozen"))
    assert run.controller["mode"] == s.MODE_FAULT
    assert run.controller["reason"] in (c.STEERING_NOT_FOLLOWING, c.VEHICLE_FAULT)
    assert run.exam.cones_touched == ()


@pytest.mark.parametrize(("offset_m", "reason"), [(0.10, None), (0.5, c.POSE_JUMP), (2.0, c.POSE_JUMP)])
def test_a_pose_jump_is_blended_or_refused(offset_m, reason):
    jump = fault("offset_signal", message="LOC_Position", signal="position_y_m", offset=offset_m, duration_s=0.5)
    run = run_with(jump)
    assert run.exam.cones_touched == ()
    if reason is None:
        assert run.controller["completed"]
    else:
        assert (run.controller["mode"], run.controller["reason"]) == (s.MODE_FAULT, reason)
        assert judged(run)[0] <= 0.80
    command = np.array([row.road_wheel_angle_cmd_rad for row in run.truth])
    assert np.abs(np.diff(command)).max() <= 0.0060, "no steering step beyond the car's rate"


def test_slow_rack_that_the_tables_do_not_know_is_stopped_before_a_cone():
    run = run_with(scenario_name="slow-rack-unknown")
    assert run.exam.cones_touched == ()
    assert run.controller["mode"] == s.MODE_FAULT
    assert run.controller["reason"] == c.STEERING_NOT_FOLLOWING
