"""One whole manoeuvre without a bus: core, plant, operator and examiner in one function that compiles.

The same source runs plain and through numba. What a run goes through is what lock-step does with frames
(`tools.lockstep.run_lockstep`), in the same order and at the same instants; a test compares the two bit for bit.
"""

from collections.abc import MutableSequence, Sequence
from math import cos, pi, sin, sqrt
from typing import Any, NamedTuple

from firmware_py.core import conditions as c
from firmware_py.core import controller
from firmware_py.core.signals import (
    MODE_ACTIVE,
    MODE_FAULT,
    MODE_MANUAL,
    MODE_READY,
    NO_COUNTER,
    Attitude,
    Inputs,
    OperatorCommand,
    Position,
    UsedCounters,
    VehicleVersion,
)
from firmware_py.core.tables import Tables
from sim import drive_by_wire as dbw
from sim import examiner, plant
from sim.examiner import Notes
from sim.plant import Memory, Motion, TruthRow
from sim.sensors import first_state
from tools.campaign import tick
from tools.campaign.tick import Command, World

PERIOD_NS = 10_000_000
COUNTERS = 15
"""Values of a rolling counter."""

LEG_FIGURES = 2
"""Legs whose errors are measured: the first forward and the first reverse one."""

# Slots of the record of errors, so many a leg.
MAX_ERROR_M, SUM_OF_SQUARES_M2, SAMPLES, FINAL_ERROR_M, FINAL_HEADING_RAD, FINAL_STATION_M = range(6)
ERRORS_A_LEG = 6

# Slots of the record of how a run ended.
CYCLES, ROWS, MODE, REASON, COMPLETED, RAN_OUT, MAX_RATE_CMD_RADPS = range(7)
END_SLOTS = 7

MAX_TRACE_COLUMNS = len(TruthRow._fields)


class Path(NamedTuple):
    """The forward path on a uniform grid of `step_m`, for the side that is driven: m, rad, 1/m."""

    step_m: float
    x_m: Sequence[float]
    y_m: Sequence[float]
    yaw_rad: Sequence[float]
    curvature_1pm: Sequence[float]


class Timetable(NamedTuple):
    """When what happens, as on the bus and in lock-step; times in ns, `*_every` in cycles."""

    phase_ns: int
    compute_ns: int
    longest_ns: int
    after_end_cycles: int
    start_hold_ns: int
    heartbeat_ns: int
    controller_version_every: int
    vehicle_version_every: int
    protocol: int


class Records(NamedTuple):
    """What a run fills: errors of the legs, and how it ended; lists, or arrays of float64 when compiled.

    `trace`: rows for the truth of each tick, as many as fit; none for a campaign.
    """

    error: MutableSequence[float]
    end: MutableSequence[float]
    trace: Sequence[MutableSequence[float]]


class Projected(NamedTuple):
    """A pose on the path: grid row nearest to it, station in m, errors in m and rad (left positive)."""

    row: int
    station_m: float
    cross_track_error_m: float
    heading_error_rad: float


def drive(
    tables: Tables,
    state: Any,
    times: Timetable,
    world: World,
    path: Path,
    motion: Motion,
    m: Memory,
    notes: Notes,
    normals: Sequence[Sequence[float]],
    records: Records,
) -> None:
    """Drive both legs, or until the car stands in a fault; the records tell how it went.

    `state`: the controller's, before its first cycle (`controller.begin`, which does not compile).
    `normals`: a row for the sensors' first state, then one a cycle; where they run out, the run ends with RAN_OUT.
    """
    end = records.end
    sensors = first_state(normals[0])
    version = VehicleVersion(times.protocol, tables.dbc_hash24, tables.vehicle_hash24)
    oper = OperatorCommand(0, 0, 0, 0)
    position = Position(0.0, 0.0, 0)
    attitude = Attitude(0.0, 0, 0.0, 0.0)
    poses = 0
    heartbeats = 0
    heartbeat_due_ns = 0
    start_pressed = 0
    ready_ns = 0
    has_driven = False
    completed = False
    after_end = 0
    cycle = 0
    path_row = 0
    last_command_rad = 0.0
    since_ns = 2 * PERIOD_NS - times.phase_ns
    mode = MODE_MANUAL
    reason = 0
    now_ns = PERIOD_NS
    while now_ns < times.longest_ns and after_end < times.after_end_cycles:
        if cycle + 1 >= len(normals):
            end[RAN_OUT] = 1.0
            return
        # The plant's reports, and what is true.
        motion, sensors, reports, truth = tick.sense(
            world, motion, sensors, m, now_ns - times.phase_ns, since_ns, normals[cycle + 1]
        )
        since_ns = PERIOD_NS
        was_moving = notes.number[examiner.IS_MOVING] != 0
        examiner.observe(world.yardstick, notes, truth.t_s, truth.x_m, truth.y_m, truth.yaw_rad, truth.speed_mps)
        if was_moving or truth.speed_mps != 0.0:
            projected = project(path, path_row, truth.x_m, truth.y_m, truth.yaw_rad)
            path_row = projected.row
            note_error(records.error, notes, path, projected)
        rate = abs(truth.road_wheel_angle_cmd_rad - last_command_rad) * (1.0e9 / PERIOD_NS)
        end[MAX_RATE_CMD_RADPS] = max(end[MAX_RATE_CMD_RADPS], rate)
        last_command_rad = truth.road_wheel_angle_cmd_rad
        if cycle < len(records.trace):
            note_truth(records.trace[cycle], truth)

        # The operator's heartbeat, as lock-step sends it: between reports and cycle.
        oper_counter = NO_COUNTER
        if now_ns - 1 >= heartbeat_due_ns:
            heartbeat_due_ns += times.heartbeat_ns
            if heartbeat_due_ns <= now_ns - 1:
                heartbeat_due_ns = now_ns - 1 + times.heartbeat_ns
            oper = OperatorCommand(start_pressed, 0, 0, 0)
            oper_counter = heartbeats % COUNTERS
            heartbeats += 1

        # The controller.
        counter = cycle % COUNTERS
        pose_counter = NO_COUNTER
        if reports.pose_is_new != 0:
            position = reports.position
            attitude = reports.attitude
            pose_counter = poses % COUNTERS
            poses += 1
        version_counter = NO_COUNTER
        if cycle % times.vehicle_version_every == 0:
            version_counter = (cycle // times.vehicle_version_every) % COUNTERS
        used = UsedCounters(
            counter, counter, counter, counter, pose_counter, pose_counter, oper_counter, version_counter, 0
        )
        inputs = Inputs(
            now_ns // 1000,
            used,
            reports.sys,
            reports.steer,
            reports.motion,
            reports.long,
            position,
            attitude,
            oper,
            version,
            0,
        )
        state, outputs = controller.step(tables, state, inputs)

        # Its commands, and the heartbeat, at the plant.
        if oper_counter != NO_COUNTER:
            motion = plant.advance(world.car, motion, m, now_ns, dbw.NEVER)
            dbw.accept_operator(world.car.system, m.system, 0)
        command = Command(
            outputs.steer.road_wheel_angle_cmd_rad,
            outputs.long.speed_cmd_mps,
            outputs.long.brake_decel_cmd_mps2,
            outputs.long.gear_cmd,
            outputs.long.park_brake_cmd,
            outputs.steer.steer_enable,
            outputs.long.long_enable,
            outputs.sys.enable_request,
            outputs.sys.clear_request,
            outputs.sys.control_leg,
        )
        motion = tick.obey(world, motion, m, now_ns + times.compute_ns, command)
        if cycle % times.controller_version_every == 0:
            dbw.accept(m.system, dbw.VERSION, now_ns + times.compute_ns)
            m.system[dbw.VERSION_REASON] = dbw.NO_REASON

        # The operator presses start each time the controller becomes Ready, until it has driven.
        mode = outputs.sys.control_mode
        reason = outputs.sys.control_reason
        if after_end == 0:
            has_driven = has_driven or mode == MODE_ACTIVE
            if mode != MODE_READY or has_driven:
                ready_ns = 0
            elif ready_ns == 0:
                ready_ns = now_ns
            start_pressed = 0
            if ready_ns != 0 and now_ns - ready_ns < times.start_hold_ns:
                start_pressed = 1
        completed = completed or (mode == MODE_MANUAL and reason == c.COMPLETE)
        supervised = state.supervisor
        driving = supervised.mode == MODE_ACTIVE or (supervised.mode == MODE_FAULT and supervised.released == 0)
        if completed or (mode == MODE_FAULT and not driving):
            after_end += 1
        else:
            after_end = 0
        cycle += 1
        now_ns += PERIOD_NS
    end[CYCLES] = cycle
    end[ROWS] = cycle
    end[MODE] = mode
    end[REASON] = reason
    if completed:
        end[REASON] = c.COMPLETE
        end[COMPLETED] = 1.0


def note_truth(row: MutableSequence[float], truth: TruthRow) -> None:
    """Write a row of the truth into a row of numbers."""
    row[0] = truth.t_s
    row[1] = truth.x_m
    row[2] = truth.y_m
    row[3] = truth.yaw_rad
    row[4] = truth.speed_mps
    row[5] = truth.accel_x_mps2
    row[6] = truth.accel_y_mps2
    row[7] = truth.road_wheel_angle_rad
    row[8] = truth.road_wheel_rate_radps
    row[9] = truth.road_wheel_angle_cmd_rad
    row[10] = truth.gear
    row[11] = truth.brake
    row[12] = truth.state
    row[13] = truth.min_clearance_m


def note_error(error: MutableSequence[float], notes: Notes, path: Path, at: Projected) -> None:
    """Add one sample to the errors of the leg that is driven."""
    leg = notes.number[examiner.LEGS] - 1
    if leg < 0 or leg >= LEG_FIGURES:
        return
    first = leg * ERRORS_A_LEG
    size = abs(at.cross_track_error_m)
    error[first + MAX_ERROR_M] = max(error[first + MAX_ERROR_M], size)
    error[first + SUM_OF_SQUARES_M2] += size * size
    error[first + SAMPLES] += 1.0
    error[first + FINAL_ERROR_M] = at.cross_track_error_m
    error[first + FINAL_HEADING_RAD] = at.heading_error_rad
    length_m = path.step_m * (len(path.x_m) - 1)
    if notes.number[examiner.LEG_COUNTS + leg * examiner.COUNTS_A_LEG + examiner.DIRECTION] > 0:
        error[first + FINAL_STATION_M] = at.station_m - length_m
    else:
        error[first + FINAL_STATION_M] = -at.station_m


def project(path: Path, near_row: int, x_m: float, y_m: float, yaw_rad: float) -> Projected:
    """Return where a pose lies on the path, searched from a row near it; beyond its ends the path goes on straight.

    From the nearest grid point one Newton step along the osculating circle, as in `tools.figures.project`.
    """
    last = len(path.x_m) - 1
    row = near_row
    nearest = _distance2(path, row, x_m, y_m)
    going = True
    while going:
        going = False
        for step in (1, -1):
            other = row + step
            if 0 <= other <= last:
                distance = _distance2(path, other, x_m, y_m)
                if distance < nearest:
                    nearest = distance
                    row = other
                    going = True
    yaw = path.yaw_rad[row]
    curvature = path.curvature_1pm[row]
    dx = x_m - path.x_m[row]
    dy = y_m - path.y_m[row]
    ahead = cos(yaw) * dx + sin(yaw) * dy
    aside = cos(yaw) * dy - sin(yaw) * dx
    if (row == 0 and ahead < 0.0) or (row == last and ahead > 0.0):
        curvature = 0.0
    along = ahead / (1.0 - curvature * aside)
    turned = curvature * along
    half = _sinc(0.5 * turned)
    foot_ahead = along * _sinc(turned)
    foot_aside = 0.5 * turned * along * half * half
    error = cos(turned) * (aside - foot_aside) - sin(turned) * (ahead - foot_ahead)
    heading = (yaw_rad - yaw - turned + pi) % (2.0 * pi) - pi
    return Projected(row, row * path.step_m + along, error, heading)


def _distance2(path: Path, row: int, x_m: float, y_m: float) -> float:
    dx = x_m - path.x_m[row]
    dy = y_m - path.y_m[row]
    return dx * dx + dy * dy


def _sinc(angle_rad: float) -> float:
    if -1.0e-4 < angle_rad < 1.0e-4:
        return 1.0 - angle_rad * angle_rad / 6.0
    return sin(angle_rad) / angle_rad


def root_mean_square(sum_of_squares: float, samples: float) -> float:
    """Return the root of the mean; 0 where there is no sample."""
    return sqrt(sum_of_squares / samples) if samples > 0.0 else 0.0
