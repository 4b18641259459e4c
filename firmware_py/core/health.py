"""From inputs to conditions: how old each report is, and whether what it says is plausible.

A rejected frame never arrives here: the age of its value grows instead. Ages count the loop's own cycles, so a
controller that was late itself does not take its peers for silent; its own lateness is a condition of its own.
"""

from typing import NamedTuple

from firmware_py.core import conditions as c
from firmware_py.core.signals import (
    MODE_ACTIVE,
    MODE_FAULT,
    MODE_READY,
    NO_COUNTER,
    QUALITY_FIXED,
    Inputs,
)
from firmware_py.core.tables import Tables

PROTOCOL = 1
"""Version of the rules of the bus (CONVENTIONS.md) that the controller follows."""

NEVER_US = 60_000_000
"""Age of a report that was never received."""

START_POSITION_M = 0.15
START_HEADING_RAD = 0.10
"""Greatest distance from the start pose at which the manoeuvre may begin: a third of the clearance to a cone."""

OFF_PATH_M = 0.20
OFF_PATH_HEADING_RAD = 0.25
"""Beyond this the clearance that the path was designed for is used up."""

OVER_SPEED_SHARE = 1.2
OVER_SPEED_MPS = 0.2

STEERING_GAP_RAD = 0.08
STEERING_GAP_US = 300_000
"""The measured angle may differ from the nominal actuator's by what the slowest rack of the vehicle file explains."""

SPEED_GAP_MPS = 0.25
SPEED_GAP_US = 300_000
"""Faster than planned at the car's place by so much for so long: the drive does not obey."""

STUCK_MPS = 0.01
STUCK_US = 3_000_000
"""Asked to drive and not moving for so long: it would set off when whatever holds it gives way."""

BEYOND_END_M = 0.10
"""Past the end of the leg by so much: the stop has failed."""

ROLLING_MPS = 0.03

WRONG_DIRECTION_MPS = 0.03
WRONG_DIRECTION_US = 60_000

STANDSTILL_MPS = 0.005

JUMPS_IN_A_ROW = 3

OVERRUNS_AT_ONCE = 9
"""Skipped periods in one stall that are a fault: at ten the vehicle's watchdog (100 ms) stops the car anyway."""

OVERRUN_BUCKET = 25
"""Skipped periods that are a fault when they come together; one leaks away every OVERRUN_LEAK_CYCLES good cycles."""

OVERRUN_LEAK_CYCLES = 10

REJECTED_US = 60_000
SETTLED_POSES = 50
"""Poses to average at standstill before the start: brings 1 cm of noise below 2 mm."""


class Ages(NamedTuple):
    """How long ago each report last brought a usable value, microseconds of own cycles."""

    sys_us: int
    steer_us: int
    motion_us: int
    long_us: int
    pose_us: int
    oper_us: int
    version_us: int


class HealthState(NamedTuple):
    """Ages of the reports, how long each implausibility has lasted, and what edges need of the last cycle."""

    ages: Ages
    steering_gap_us: int
    speed_gap_us: int
    wrong_direction_us: int
    rejected_us: int
    overrun_bucket: int
    overrun_leak: int
    stuck_us: int
    start_was_pressed: int
    clear_was_pressed: int
    pose_is_new: int


class Believed(NamedTuple):
    """What the law believes of itself, for comparison with the reports."""

    mode: int
    direction_sigma: float
    driving: int
    stopping: int
    planned_mps: float
    beyond_end_m: float
    cross_track_error_m: float
    heading_error_rad: float
    station_m: float
    disbelieved: int
    averaged: int
    model_angle_rad: float


def begin() -> HealthState:
    """Return the state before the first cycle: nothing was ever received."""
    never = Ages(
        sys_us=NEVER_US,
        steer_us=NEVER_US,
        motion_us=NEVER_US,
        long_us=NEVER_US,
        pose_us=NEVER_US,
        oper_us=NEVER_US,
        version_us=NEVER_US,
    )
    return HealthState(
        ages=never,
        steering_gap_us=0,
        speed_gap_us=0,
        wrong_direction_us=0,
        rejected_us=0,
        overrun_bucket=0,
        overrun_leak=0,
        stuck_us=0,
        start_was_pressed=0,
        clear_was_pressed=0,
        pose_is_new=0,
    )


def _pose_is_new(inputs: Inputs) -> bool:
    """Return whether a usable pose arrived: position and yaw of one sample (equal counters), both of full quality."""
    return (
        inputs.used.used_position_counter != NO_COUNTER
        and inputs.used.used_position_counter == inputs.used.used_attitude_counter
        and inputs.position.position_quality == QUALITY_FIXED
        and inputs.attitude.yaw_quality == QUALITY_FIXED
    )


def _age_us(age_us: int, is_new: bool, passed_us: int) -> int:
    if is_new:
        return 0
    age_us += passed_us
    if age_us > NEVER_US:
        age_us = NEVER_US
    return age_us


def _older(ages: Ages, inputs: Inputs, pose_is_new: bool, passed_us: int) -> Ages:
    """Return the ages one cycle later; a report that says itself that it is invalid ages on."""
    used = inputs.used
    steer_is_new = used.used_steer_counter != NO_COUNTER and inputs.steer.steer_angle_valid != 0
    motion_is_new = used.used_motion_counter != NO_COUNTER and inputs.motion.speed_valid != 0
    return Ages(
        _age_us(ages.sys_us, used.used_sys_counter != NO_COUNTER, passed_us),
        _age_us(ages.steer_us, steer_is_new, passed_us),
        _age_us(ages.motion_us, motion_is_new, passed_us),
        _age_us(ages.long_us, used.used_long_counter != NO_COUNTER, passed_us),
        _age_us(ages.pose_us, pose_is_new, passed_us),
        _age_us(ages.oper_us, used.used_oper_counter != NO_COUNTER, passed_us),
        _age_us(ages.version_us, used.used_veh_version_counter != NO_COUNTER, passed_us),
    )


def _lasting_us(lasting_us: int, is_present: bool, passed_us: int) -> int:
    if not is_present:
        return 0
    lasting_us += passed_us
    if lasting_us > NEVER_US:
        lasting_us = NEVER_US
    return lasting_us


def assess(
    tables: Tables, state: HealthState, inputs: Inputs, believed: Believed, period_us: int
) -> tuple[HealthState, int]:
    """Return the next state and the conditions present in this cycle (bits of `conditions`)."""
    used = inputs.used
    timeouts = tables.timeouts
    car = tables.car
    active = believed.mode == MODE_ACTIVE
    moving_allowed = active and believed.driving != 0
    speed_mps = inputs.motion.speed_meas_mps

    overruns = used.overruns_before_cycle
    bucket = state.overrun_bucket + overruns
    leak = state.overrun_leak + 1
    if leak >= OVERRUN_LEAK_CYCLES:
        leak = 0
        if bucket > 0:
            bucket -= 1

    rejecting = (
        inputs.sys.sys_cmd_timeout != 0 or inputs.steer.steer_cmd_timeout != 0 or inputs.long.long_cmd_timeout != 0
    )
    pose_is_new = _pose_is_new(inputs)
    ages = _older(state.ages, inputs, pose_is_new, period_us)
    steering_gap = active and abs(inputs.steer.road_wheel_angle_meas_rad - believed.model_angle_rad) > STEERING_GAP_RAD
    speed_gap = moving_allowed and speed_mps * believed.direction_sigma > believed.planned_mps + SPEED_GAP_MPS
    stuck = moving_allowed and believed.stopping == 0 and abs(speed_mps) < STUCK_MPS
    wrong_direction = active and (
        speed_mps * believed.direction_sigma < -WRONG_DIRECTION_MPS
        or (believed.driving == 0 and abs(speed_mps) > ROLLING_MPS)
    )
    pose_is_new_flag = 1 if pose_is_new else 0
    next_state = HealthState(
        ages,
        _lasting_us(state.steering_gap_us, steering_gap, period_us),
        _lasting_us(state.speed_gap_us, speed_gap, period_us),
        _lasting_us(state.wrong_direction_us, wrong_direction, period_us),
        _lasting_us(state.rejected_us, active and rejecting, period_us),
        bucket,
        leak,
        _lasting_us(state.stuck_us, stuck, period_us),
        inputs.oper.oper_start,
        inputs.oper.oper_clear,
        pose_is_new_flag,
    )

    sys, steer, long, oper = inputs.sys, inputs.steer, inputs.long, inputs.oper
    sys_lost = ages.sys_us >= timeouts.sys_us
    steer_lost = ages.steer_us >= timeouts.steer_us
    motion_lost = ages.motion_us >= timeouts.motion_us
    long_lost = ages.long_us >= timeouts.long_us
    pose_lost = ages.pose_us >= timeouts.pose_us
    pose_poor = inputs.position.position_quality != QUALITY_FIXED or inputs.attitude.yaw_quality != QUALITY_FIXED
    oper_lost = ages.oper_us >= timeouts.oper_us
    version_lost = ages.version_us >= timeouts.version_us
    standstill = not motion_lost and not long_lost and long.standstill != 0 and abs(speed_mps) < STANDSTILL_MPS
    away_from_start = (
        abs(believed.cross_track_error_m) > START_POSITION_M
        or abs(believed.station_m) > START_POSITION_M
        or abs(believed.heading_error_rad) > START_HEADING_RAD
    )
    off_path = (
        abs(believed.cross_track_error_m) > OFF_PATH_M
        or abs(believed.heading_error_rad) > OFF_PATH_HEADING_RAD
        or (moving_allowed and believed.beyond_end_m > BEYOND_END_M)
    )
    over_speed = abs(speed_mps) > OVER_SPEED_SHARE * car.max_speed_mps + OVER_SPEED_MPS
    overrun = overruns >= OVERRUNS_AT_ONCE or bucket > OVERRUN_BUCKET

    present = 0
    if sys_lost or steer_lost or motion_lost or long_lost or pose_lost or version_lost:
        present |= 1 << c.WAITING_FOR_REPORTS
    if oper_lost:
        present |= 1 << c.WAITING_FOR_OPERATOR
    if not version_lost and (
        inputs.version.veh_dbc_hash != tables.dbc_hash24 or inputs.version.veh_protocol != PROTOCOL
    ):
        present |= 1 << c.DBC_HASH_MISMATCH
    if not version_lost and inputs.version.veh_vehicle_hash != tables.vehicle_hash24:
        present |= 1 << c.VEHICLE_HASH_MISMATCH
    if away_from_start:
        present |= 1 << c.POSE_NOT_AT_START
    if believed.averaged < SETTLED_POSES:
        present |= 1 << c.POSE_SETTLING
    if not standstill:
        present |= 1 << c.NOT_AT_STANDSTILL
    if standstill:
        present |= 1 << c.STANDSTILL
    if sys.vehicle_state != MODE_READY:
        present |= 1 << c.VEHICLE_NOT_READY
    if not sys_lost and sys.vehicle_state == MODE_ACTIVE:
        present |= 1 << c.VEHICLE_ACTIVE
    if oper.oper_stop != 0:
        present |= 1 << c.OPERATOR_STOP
    if oper.oper_estop != 0:
        present |= 1 << c.EMERGENCY_STOP
    if sys.driver_override != 0 or steer.steer_override != 0 or long.brake_override != 0:
        present |= 1 << c.DRIVER_OVERRIDE
    if (
        sys.vehicle_state == MODE_FAULT
        or steer.steer_fault != 0
        or long.long_fault != 0
        or (active and not sys_lost and sys.vehicle_state != MODE_ACTIVE)
    ):
        present |= 1 << c.VEHICLE_FAULT
    if sys_lost:
        present |= 1 << c.SYS_REPORT_TIMEOUT
    if steer_lost:
        present |= 1 << c.STEER_REPORT_TIMEOUT
    if motion_lost:
        present |= 1 << c.MOTION_REPORT_TIMEOUT
    if long_lost:
        present |= 1 << c.LONG_REPORT_TIMEOUT
    if pose_lost and not pose_poor:
        present |= 1 << c.POSE_TIMEOUT
    if oper_lost:
        present |= 1 << c.OPERATOR_TIMEOUT
    if pose_lost and pose_poor:
        present |= 1 << c.POSE_INVALID
    if believed.disbelieved >= JUMPS_IN_A_ROW:
        present |= 1 << c.POSE_JUMP
    if off_path:
        present |= 1 << c.OFF_PATH
    if over_speed:
        present |= 1 << c.OVER_SPEED
    if next_state.steering_gap_us >= STEERING_GAP_US:
        present |= 1 << c.STEERING_NOT_FOLLOWING
    if next_state.speed_gap_us >= SPEED_GAP_US or next_state.stuck_us >= STUCK_US:
        present |= 1 << c.SPEED_NOT_FOLLOWING
    if next_state.wrong_direction_us >= WRONG_DIRECTION_US:
        present |= 1 << c.WRONG_DIRECTION
    if overrun:
        present |= 1 << c.CYCLE_OVERRUN
    if next_state.rejected_us >= REJECTED_US:
        present |= 1 << c.COMMAND_REJECTED
    if inputs.second_controller != 0:
        present |= 1 << c.SECOND_CONTROLLER
    if oper.oper_start != 0 and state.start_was_pressed == 0 and not oper_lost:
        present |= 1 << c.START_PRESSED
    if oper.oper_clear != 0 and state.clear_was_pressed == 0 and not oper_lost:
        present |= 1 << c.CLEAR_PRESSED
    return next_state, present
