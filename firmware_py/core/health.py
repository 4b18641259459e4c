"""From inputs to conditions: how old each report is, and whether what it says is plausible.

A rejected frame never arrives here: the age of its value grows instead. Ages count the loop's own cycles, so a
controller that was late itself does not take its peers for silent; its own lateness is a condition of its own.
"""

from typing import NamedTuple

from firmware_py.core import conditions as c
from firmware_py.core.estimator import EstimatorState
from firmware_py.core.path import plan_at
from firmware_py.core.signals import (
    MODE_ACTIVE,
    MODE_FAULT,
    MODE_READY,
    NO_COUNTER,
    QUALITY_FIXED,
    Inputs,
)
from firmware_py.core.tables import LegTable, Tables

PROTOCOL = 1
"""Version of the rules of the bus (CONVENTIONS.md) that the controller follows."""

NEVER_US = 60_000_000
"""Age of a report that was never received."""

START_POSITION_M = 0.10
START_HEADING_RAD = 0.025
"""Greatest distance from the start pose at which the manoeuvre may begin. Both at once bring the front corner of a car
whose front is 5 m ahead of the rear axle 0.23 m nearer to a cone of the box, and the bounded correction lets it go on
aside for 1 cm more: less than the clearance."""

OFF_PATH_M = 0.20
OFF_PATH_HEADING_RAD = 0.25
"""Beyond this the clearance that the path was designed for is used up."""

OVER_SPEED_SHARE = 1.2
OVER_SPEED_MPS = 0.2

STEERING_GAP_RAD = 0.08
STEERING_GAP_US = 300_000
"""The measured angle may differ from the nominal actuator's by what the slowest rack of the vehicle file explains, with
the swing that it brings. With a lag of 0.27 s where 0.1 s is known it is 0.09 rad at most, and above the limit for less
than STEERING_GAP_US."""

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
POSITION_SIGMA_MAX_M = 0.05
"""Standard deviation that the localisation may state: with more of it the poses would hardly correct the car any more,
and the room to the cones is not much more than three times as large."""

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


NEW = (0, False)
"""Age of a report that this cycle brought, and that it is not lost."""


def _older_us(age_us: int, passed_us: int) -> int:
    """Return an age or a duration that goes on, held at NEVER_US."""
    age_us += passed_us
    if age_us > NEVER_US:
        age_us = NEVER_US
    return age_us


def _older(age_us: int, passed_us: int, timeout_us: int) -> tuple[int, bool]:
    """Return the age of a report that this cycle did not bring, and whether it is lost."""
    age_us = _older_us(age_us, passed_us)
    return age_us, age_us >= timeout_us


def assess(
    tables: Tables,
    state: HealthState,
    inputs: Inputs,
    leg: LegTable,
    mode: int,
    driving: int,
    stopping: int,
    estimated: EstimatorState,
    cross_track_error_m: float,
    heading_error_rad: float,
    period_us: int,
) -> tuple[HealthState, int]:
    """Return the next state and the conditions present in this cycle (bits of `conditions`).

    `mode` to `heading_error_rad` are what the last cycle left: what the controller believes of itself and of the car's
    place on the leg, for comparison with the reports.
    """
    _now_us, used, sys, steer, motion, long, position, attitude, oper, version, second_controller = inputs
    timeouts = tables.timeouts
    station_m = estimated.station_m
    speed_mps = motion.speed_meas_mps
    magnitude_mps = abs(speed_mps)
    vehicle_state = sys.vehicle_state
    active = mode == MODE_ACTIVE
    moving_allowed = active and driving != 0
    present = 0

    # How old each report is: 0 with a new frame that does not say itself that it is invalid.
    sys_n, steer_n, motion_n, long_n, position_n, attitude_n, oper_n, version_n, overruns = used
    sys_us, steer_us, motion_us, long_us, pose_us, oper_us, version_us = state.ages
    steer_is_new = steer_n != NO_COUNTER and steer.steer_angle_valid != 0
    motion_is_new = motion_n != NO_COUNTER and motion.speed_valid != 0
    # A pose is position and yaw of one sample (equal counters), both of full quality.
    pose_poor = (
        position.position_quality != QUALITY_FIXED
        or attitude.yaw_quality != QUALITY_FIXED
        or attitude.position_sigma_m > POSITION_SIGMA_MAX_M
    )
    pose_is_new = position_n != NO_COUNTER and position_n == attitude_n and not pose_poor
    sys_us, sys_lost = NEW if sys_n != NO_COUNTER else _older(sys_us, period_us, timeouts.sys_us)
    steer_us, steer_lost = NEW if steer_is_new else _older(steer_us, period_us, timeouts.steer_us)
    motion_us, motion_lost = NEW if motion_is_new else _older(motion_us, period_us, timeouts.motion_us)
    long_us, long_lost = NEW if long_n != NO_COUNTER else _older(long_us, period_us, timeouts.long_us)
    pose_us, pose_lost = NEW if pose_is_new else _older(pose_us, period_us, timeouts.pose_us)
    oper_us, oper_lost = NEW if oper_n != NO_COUNTER else _older(oper_us, period_us, timeouts.oper_us)
    version_us, version_lost = NEW if version_n != NO_COUNTER else _older(version_us, period_us, timeouts.version_us)
    if sys_lost or steer_lost or motion_lost or long_lost or pose_lost or version_lost:
        present |= 1 << c.WAITING_FOR_REPORTS
        if sys_lost:
            present |= 1 << c.SYS_REPORT_TIMEOUT
        if steer_lost:
            present |= 1 << c.STEER_REPORT_TIMEOUT
        if motion_lost:
            present |= 1 << c.MOTION_REPORT_TIMEOUT
        if long_lost:
            present |= 1 << c.LONG_REPORT_TIMEOUT
        if pose_lost and pose_poor:
            present |= 1 << c.POSE_INVALID
        if pose_lost and not pose_poor:
            present |= 1 << c.POSE_TIMEOUT
    if oper_lost:
        present |= 1 << c.WAITING_FOR_OPERATOR
        present |= 1 << c.OPERATOR_TIMEOUT
    if not version_lost:
        if version.veh_dbc_hash != tables.dbc_hash24 or version.veh_protocol != PROTOCOL:
            present |= 1 << c.DBC_HASH_MISMATCH
        if version.veh_vehicle_hash != tables.vehicle_hash24:
            present |= 1 << c.VEHICLE_HASH_MISMATCH

    # What a driven car may not do for long.
    steering_gap_us = 0
    speed_gap_us = 0
    wrong_direction_us = 0
    rejected_us = 0
    stuck_us = 0
    if active:
        travel_mps = leg.sigma * speed_mps
        if abs(steer.road_wheel_angle_meas_rad - estimated.modelled_angle_rad) > STEERING_GAP_RAD:
            steering_gap_us = _older_us(state.steering_gap_us, period_us)
            if steering_gap_us >= STEERING_GAP_US:
                present |= 1 << c.STEERING_NOT_FOLLOWING
        if driving != 0:
            planned_mps, _accel_mps2 = plan_at(leg, station_m)
            if travel_mps > planned_mps + SPEED_GAP_MPS:
                speed_gap_us = _older_us(state.speed_gap_us, period_us)
            if stopping == 0 and magnitude_mps < STUCK_MPS:
                stuck_us = _older_us(state.stuck_us, period_us)
            if speed_gap_us >= SPEED_GAP_US or stuck_us >= STUCK_US:
                present |= 1 << c.SPEED_NOT_FOLLOWING
        if travel_mps < -WRONG_DIRECTION_MPS or (driving == 0 and magnitude_mps > ROLLING_MPS):
            wrong_direction_us = _older_us(state.wrong_direction_us, period_us)
            if wrong_direction_us >= WRONG_DIRECTION_US:
                present |= 1 << c.WRONG_DIRECTION
        if sys.sys_cmd_timeout != 0 or steer.steer_cmd_timeout != 0 or long.long_cmd_timeout != 0:
            rejected_us = _older_us(state.rejected_us, period_us)
            if rejected_us >= REJECTED_US:
                present |= 1 << c.COMMAND_REJECTED

    # Where the car is, and how fast.
    away_m = abs(cross_track_error_m)
    turned_rad = abs(heading_error_rad)
    if not motion_lost and not long_lost and long.standstill != 0 and magnitude_mps < STANDSTILL_MPS:
        present |= 1 << c.STANDSTILL
    else:
        present |= 1 << c.NOT_AT_STANDSTILL
    if away_m > START_POSITION_M or abs(station_m) > START_POSITION_M or turned_rad > START_HEADING_RAD:
        present |= 1 << c.POSE_NOT_AT_START
    if away_m > OFF_PATH_M or turned_rad > OFF_PATH_HEADING_RAD:
        present |= 1 << c.OFF_PATH
    if moving_allowed and station_m - leg.length_m > BEYOND_END_M:
        present |= 1 << c.OFF_PATH
    if estimated.averaged < SETTLED_POSES:
        present |= 1 << c.POSE_SETTLING
    if estimated.disbelieved >= JUMPS_IN_A_ROW:
        present |= 1 << c.POSE_JUMP
    if magnitude_mps > OVER_SPEED_SHARE * tables.car.max_speed_mps + OVER_SPEED_MPS:
        present |= 1 << c.OVER_SPEED

    # What the vehicle says of itself, and who may interfere.
    if vehicle_state != MODE_READY:
        present |= 1 << c.VEHICLE_NOT_READY
    if not sys_lost and vehicle_state == MODE_ACTIVE:
        present |= 1 << c.VEHICLE_ACTIVE
    if vehicle_state == MODE_FAULT or steer.steer_fault != 0 or long.long_fault != 0:
        present |= 1 << c.VEHICLE_FAULT
    if active and not sys_lost and vehicle_state != MODE_ACTIVE:
        present |= 1 << c.VEHICLE_FAULT
    if sys.driver_override != 0 or steer.steer_override != 0 or long.brake_override != 0:
        present |= 1 << c.DRIVER_OVERRIDE
    if second_controller != 0:
        present |= 1 << c.SECOND_CONTROLLER
    start, stop, emergency_stop, clear = oper
    if stop != 0:
        present |= 1 << c.OPERATOR_STOP
    if emergency_stop != 0:
        present |= 1 << c.EMERGENCY_STOP
    # A press is an edge, seen while the operator is heard.
    if start != 0 and state.start_was_pressed == 0 and not oper_lost:
        present |= 1 << c.START_PRESSED
    if clear != 0 and state.clear_was_pressed == 0 and not oper_lost:
        present |= 1 << c.CLEAR_PRESSED

    # Whether this controller keeps its own time.
    bucket = state.overrun_bucket + overruns
    leak = state.overrun_leak + 1
    if leak >= OVERRUN_LEAK_CYCLES:
        leak = 0
        if bucket > 0:
            bucket -= 1
    if overruns >= OVERRUNS_AT_ONCE or bucket > OVERRUN_BUCKET:
        present |= 1 << c.CYCLE_OVERRUN
    next_state = HealthState(
        Ages(sys_us, steer_us, motion_us, long_us, pose_us, oper_us, version_us),
        steering_gap_us,
        speed_gap_us,
        wrong_direction_us,
        rejected_us,
        bucket,
        leak,
        stuck_us,
        start,
        clear,
        1 if pose_is_new else 0,
    )
    return next_state, present
