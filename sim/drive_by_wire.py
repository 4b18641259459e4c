"""The vehicle's drive-by-wire system: its states, its watchdog, the gear, and which commands it follows.

Decides, but moves nothing: the plant asks it what the actuators are to do. All times are nanoseconds of the
emulator's clock. States, reasons and the handshake are those of dbc/parking.dbc and dbc/CONVENTIONS.md.

The system lives in a record, a mutable row of integers whose slots are named below; the functions work on it in place.
In the live emulator the record is a list, compiled it is an array of int64: the same source for both.
"""

from collections.abc import MutableSequence
from enum import IntEnum
from typing import NamedTuple

BRAKE_DECEL_MPS2 = 2.4
"""Deceleration with which the vehicle brakes by itself, and holds itself at standstill."""

PROTOCOL_VERSION = 1
NS = 1_000_000_000


class State(IntEnum):
    """VEH_SysRpt.vehicle_state."""

    MANUAL = 0
    READY = 1
    ACTIVE = 2
    FAULT = 3


class Reason(IntEnum):
    """VEH_SysRpt.vehicle_reason."""

    NONE = 0
    NO_COMMAND = 1
    DBC_HASH_MISMATCH = 2
    VEHICLE_HASH_MISMATCH = 3
    NOT_AT_STANDSTILL = 4
    ENABLE_HELD_AT_START = 5
    DISABLED_BY_CONTROLLER = 6
    COMMAND_TIMEOUT = 7
    BAD_CRC = 8
    BAD_COUNTER = 9
    DRIVER_OVERRIDE = 10
    EMERGENCY_STOP = 11
    ACTUATOR_FAULT = 12


class Gear(IntEnum):
    """VEH_LongRpt.gear_rpt and CTRL_LongCmd.gear_cmd; NONE is "while it changes" and "keep"."""

    NONE = 0
    PARK = 1
    REVERSE = 2
    NEUTRAL = 3
    DRIVE = 4


# The same as plain integers: a compiler knows no enumerations.
MANUAL, READY, ACTIVE, FAULT = (int(state) for state in State)
NO_REASON = int(Reason.NONE)
NO_COMMAND = int(Reason.NO_COMMAND)
NOT_AT_STANDSTILL = int(Reason.NOT_AT_STANDSTILL)
ENABLE_HELD_AT_START = int(Reason.ENABLE_HELD_AT_START)
DISABLED_BY_CONTROLLER = int(Reason.DISABLED_BY_CONTROLLER)
COMMAND_TIMEOUT = int(Reason.COMMAND_TIMEOUT)
DRIVER_OVERRIDE = int(Reason.DRIVER_OVERRIDE)
EMERGENCY_STOP = int(Reason.EMERGENCY_STOP)
NO_GEAR, PARK, REVERSE, NEUTRAL, DRIVE = (int(gear) for gear in Gear)

WATCHED = ("CTRL_SysCmd", "CTRL_SteerCmd", "CTRL_LongCmd")
"""Commands without which an Active vehicle stops."""

TIMED = (*WATCHED, "CTRL_Version")
"""Messages whose age is known; the indices below are places in this row."""

SYS, STEER, LONG, VERSION = range(4)

NEVER = 1 << 62

# Slots of the record.
(
    STATE,
    REASON,
    GEAR,
    PARK_BRAKE_APPLIED,
    OVERRIDE_LATCHED,
    STEERING_OVERRIDE,
    BRAKE_OVERRIDE,
    BUTTON_PRESSED,  # the emergency-stop button in the car
    OPERATOR_ESTOP,
    FIRST_ACTIVE_NS,  # NEVER until then
    ACTIVE_SINCE_NS,
    CONTROL_LEG,
    # Next instant at which `at` must be called: the end of a gear change, or the earliest at which the watchdog may
    # bite; commands that come meanwhile only postpone it, so `at` then looks again.
    NEXT_EVENT_NS,
    GEAR_WANTED,
    GEAR_DONE_NS,
    ENABLE,  # the request in the last CTRL_SysCmd, -1 before the first
    VERSION_REASON,  # what the last CTRL_Version gives reason to: NONE where it fits
    LAST_VALID_NS,  # of CTRL_SysCmd; the three after it of the other messages in TIMED
) = range(18)
REJECTED_FOR = LAST_VALID_NS + len(TIMED)
"""First of three slots: why the last frame of each watched message was rejected, NONE where it was not."""

SLOTS = REJECTED_FOR + len(WATCHED)

Record = MutableSequence[int]


class DriveByWire(NamedTuple):
    """Constants of the system: timeouts in the order of TIMED, and what a change of gear takes."""

    timeout_ns: tuple[int, int, int, int]
    gear_change_ns: int


def begin(start_ns: int) -> list[int]:
    """Return the record of a parked car that has heard nothing."""
    record = [0] * SLOTS
    record[STATE], record[REASON] = MANUAL, NO_COMMAND
    record[GEAR] = record[GEAR_WANTED] = PARK
    record[PARK_BRAKE_APPLIED] = 1
    record[FIRST_ACTIVE_NS] = record[NEXT_EVENT_NS] = record[GEAR_DONE_NS] = NEVER
    record[ACTIVE_SINCE_NS] = start_ns
    record[ENABLE] = -1
    record[VERSION_REASON] = NO_COMMAND
    for message in range(len(TIMED)):
        record[LAST_VALID_NS + message] = -NEVER
    return record


# -- what the plant asks ----------------------------------------------------------------------------------------------


def follows_steering(w: Record) -> bool:
    """Steering keeps to valid commands while Active, and after a fault until the driver has the wheel."""
    return w[STATE] == ACTIVE or (w[STATE] == FAULT and w[OVERRIDE_LATCHED] == 0)


def follows_speed(w: Record) -> bool:
    """Speed, brake, gear and park brake are the controller's only while Active."""
    return w[STATE] == ACTIVE


def may_drive(w: Record, speed_mps: float) -> bool:
    """Return whether gear and park brake let the car move with a speed command of this sign."""
    if w[PARK_BRAKE_APPLIED] != 0:
        return False
    return (speed_mps > 0.0 and w[GEAR] == DRIVE) or (speed_mps < 0.0 and w[GEAR] == REVERSE)


def is_timed_out(p: DriveByWire, w: Record, message: int, now_ns: int) -> bool:
    """Return whether no valid frame of the message (index in TIMED) has come for its timeout."""
    return now_ns - w[LAST_VALID_NS + message] >= p.timeout_ns[message]


def _deadline_ns(p: DriveByWire, w: Record, message: int) -> int:
    # A command that was silent before counts from the moment at which the vehicle became Active.
    return max(w[LAST_VALID_NS + message], w[ACTIVE_SINCE_NS]) + p.timeout_ns[message]


def _schedule(p: DriveByWire, w: Record) -> None:
    event_ns = w[GEAR_DONE_NS]
    if w[STATE] == ACTIVE:
        for message in range(3):
            event_ns = min(event_ns, _deadline_ns(p, w, message))
    w[NEXT_EVENT_NS] = event_ns


# -- what happens -----------------------------------------------------------------------------------------------------


def at(p: DriveByWire, w: Record, now_ns: int, at_standstill: bool) -> None:
    """Let time pass to `now_ns`: watchdog, gear change, and the way from Manual to Ready."""
    if now_ns >= w[GEAR_DONE_NS]:
        w[GEAR] = w[GEAR_WANTED]
        w[GEAR_DONE_NS] = NEVER
    if now_ns >= w[NEXT_EVENT_NS]:
        if w[STATE] == ACTIVE:
            _watch(p, w, now_ns)
        _schedule(p, w)
    if w[STATE] == MANUAL or w[STATE] == READY:
        _judge_ready(p, w, now_ns, at_standstill)


def _watch(p: DriveByWire, w: Record, now_ns: int) -> None:
    for message in range(3):
        if now_ns >= _deadline_ns(p, w, message):
            rejected_for = w[REJECTED_FOR + message]
            fault(p, w, rejected_for if rejected_for != NO_REASON else COMMAND_TIMEOUT)
            return


def _judge_ready(p: DriveByWire, w: Record, now_ns: int, at_standstill: bool) -> None:
    if is_timed_out(p, w, SYS, now_ns) or is_timed_out(p, w, VERSION, now_ns):
        reason = NO_COMMAND
    elif w[VERSION_REASON] != NO_REASON:
        reason = w[VERSION_REASON]
    elif w[STATE] == MANUAL and not at_standstill:
        reason = NOT_AT_STANDSTILL
    elif w[STATE] == MANUAL and w[ENABLE] == 1:
        reason = ENABLE_HELD_AT_START
    else:
        if w[STATE] == MANUAL:
            w[STATE] = READY
            w[REASON] = NO_REASON
        return
    w[STATE] = MANUAL
    w[REASON] = reason


def fault(p: DriveByWire, w: Record, reason: int) -> None:
    """Become Fault for a reason; the first reason stays."""
    if w[STATE] != FAULT:
        w[STATE] = FAULT
        w[REASON] = reason
        _schedule(p, w)


def accept(w: Record, message: int, now_ns: int) -> None:
    """Note a valid frame of a message (index in TIMED); `at` must have been called for `now_ns` before."""
    w[LAST_VALID_NS + message] = now_ns


def accept_requests(p: DriveByWire, w: Record, now_ns: int, enable: int, clear: int, at_standstill: bool) -> None:
    """Take the requests of a valid CTRL_SysCmd."""
    w[LAST_VALID_NS] = now_ns
    rising = enable == 1 and w[ENABLE] == 0
    w[ENABLE] = enable
    if w[STATE] == ACTIVE and enable == 0:
        w[STATE] = READY
        w[REASON] = DISABLED_BY_CONTROLLER
    elif w[STATE] == FAULT and clear != 0 and enable == 0 and at_standstill and not _cause_lasts(w):
        w[OVERRIDE_LATCHED] = 0
        w[STATE] = MANUAL
        w[REASON] = NO_COMMAND
        _judge_ready(p, w, now_ns, at_standstill)
    elif w[STATE] == READY and rising:
        if at_standstill:
            w[STATE] = ACTIVE
            w[REASON] = NO_REASON
            w[ACTIVE_SINCE_NS] = now_ns
            w[FIRST_ACTIVE_NS] = min(w[FIRST_ACTIVE_NS], now_ns)
            _schedule(p, w)
        else:
            w[REASON] = NOT_AT_STANDSTILL


def accept_operator(p: DriveByWire, w: Record, estop: int) -> None:
    """Take a valid OPER_Cmd."""
    w[OPERATOR_ESTOP] = estop
    if estop != 0:
        fault(p, w, EMERGENCY_STOP)


def _cause_lasts(w: Record) -> bool:
    return w[OPERATOR_ESTOP] != 0 or w[BUTTON_PRESSED] != 0 or w[STEERING_OVERRIDE] != 0 or w[BRAKE_OVERRIDE] != 0


def follow_gear(p: DriveByWire, w: Record, now_ns: int, gear: int, park_brake: int, at_standstill: bool) -> None:
    """Obey gear and park-brake command; the gear only at standstill, and it takes its time."""
    if park_brake == 0:
        w[PARK_BRAKE_APPLIED] = 0
    elif at_standstill:
        w[PARK_BRAKE_APPLIED] = 1
    if w[GEAR_DONE_NS] != NEVER or not at_standstill or gear < PARK or gear > DRIVE:
        return
    if gear != w[GEAR]:
        w[GEAR_WANTED] = gear
        w[GEAR] = NO_GEAR
        w[GEAR_DONE_NS] = now_ns + p.gear_change_ns
        _schedule(p, w)


def driver(p: DriveByWire, w: Record, control: int, active: int) -> None:
    """Let the driver take the hand wheel (STEERING_OVERRIDE) or a pedal (BRAKE_OVERRIDE), or let go of it."""
    w[control] = active
    if active != 0:
        w[OVERRIDE_LATCHED] = 1
        fault(p, w, DRIVER_OVERRIDE)


def press_emergency_stop(p: DriveByWire, w: Record, pressed: int) -> None:
    """Press or release the emergency-stop button in the car."""
    w[BUTTON_PRESSED] = pressed
    if pressed != 0:
        fault(p, w, EMERGENCY_STOP)
