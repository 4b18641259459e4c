"""The supervisor: modes, an ordered table of transitions with reasons, and what a fault asks for.

The table is read from the top; the first row of the present mode whose conditions hold decides. Order is priority.
"""

from typing import NamedTuple

from firmware_py.core import conditions as c
from firmware_py.core.signals import MODE_ACTIVE, MODE_FAULT, MODE_MANUAL, MODE_READY

STOP_NONE = 0
STOP_CONTROLLED = 1
STOP_EMERGENCY = 2
STOP_RELEASE = 3
"""Reactions: controlled or emergency braking while steering on, or the car given to the driver at once."""

ENABLE_TIMEOUT_US = 1_000_000
"""How long the vehicle may take to become Active after the request."""

CONTROLLED_STOP_US = 3_000_000
"""A controlled stop that lasts longer does not decelerate as it should: from there on the emergency brake."""

LONGEST_STOP_US = 10_000_000
"""After so long in Fault the vehicle is released even if no standstill was seen: its own brake then holds it."""

CLEAR_PULSE_US = 200_000
"""How long the clear request is held: twice the vehicle's command timeout."""

ANY = -1

# What keeps Manual from Ready, in the order in which it is reported. A row: the condition is also the reason.
_BLOCKING = (
    c.SECOND_CONTROLLER,
    c.WAITING_FOR_REPORTS,
    c.WAITING_FOR_OPERATOR,
    c.DBC_HASH_MISMATCH,
    c.VEHICLE_HASH_MISMATCH,
    c.EMERGENCY_STOP,
    c.OPERATOR_STOP,
    c.DRIVER_OVERRIDE,
    c.VEHICLE_FAULT,
    c.NOT_AT_STANDSTILL,
    c.POSE_NOT_AT_START,
    c.POSE_SETTLING,
)

# What ends Active, hardest reaction first. A row: condition, reaction.
_STOPPING = (
    (c.DRIVER_OVERRIDE, STOP_RELEASE),
    (c.EMERGENCY_STOP, STOP_EMERGENCY),
    (c.SECOND_CONTROLLER, STOP_EMERGENCY),
    (c.VEHICLE_FAULT, STOP_EMERGENCY),
    (c.STEERING_NOT_FOLLOWING, STOP_EMERGENCY),
    (c.WRONG_DIRECTION, STOP_EMERGENCY),
    (c.SPEED_NOT_FOLLOWING, STOP_EMERGENCY),
    (c.DBC_HASH_MISMATCH, STOP_CONTROLLED),
    (c.VEHICLE_HASH_MISMATCH, STOP_CONTROLLED),
    (c.CYCLE_OVERRUN, STOP_CONTROLLED),
    (c.SYS_REPORT_TIMEOUT, STOP_CONTROLLED),
    (c.OVER_SPEED, STOP_CONTROLLED),
    (c.STEER_REPORT_TIMEOUT, STOP_CONTROLLED),
    (c.MOTION_REPORT_TIMEOUT, STOP_CONTROLLED),
    (c.LONG_REPORT_TIMEOUT, STOP_CONTROLLED),
    (c.POSE_INVALID, STOP_CONTROLLED),
    (c.POSE_TIMEOUT, STOP_CONTROLLED),
    (c.POSE_JUMP, STOP_CONTROLLED),
    (c.OFF_PATH, STOP_CONTROLLED),
    (c.COMMAND_REJECTED, STOP_CONTROLLED),
    (c.OPERATOR_TIMEOUT, STOP_CONTROLLED),
    (c.OPERATOR_STOP, STOP_CONTROLLED),
    (c.DIRECTION_CHANGE_TIMEOUT, STOP_CONTROLLED),
)


def _mask(*reasons: int) -> int:
    mask = 0
    for reason in reasons:
        mask |= 1 << reason
    return mask


# (mode, conditions that must all be present, conditions that must all be absent, next mode, reason, reaction)
TRANSITIONS: tuple[tuple[int, int, int, int, int, int], ...] = (
    *((MODE_MANUAL, _mask(b), 0, MODE_MANUAL, b, STOP_NONE) for b in _BLOCKING),
    (MODE_MANUAL, _mask(c.VEHICLE_NOT_READY), 0, MODE_MANUAL, c.VEHICLE_NOT_READY, STOP_NONE),
    (MODE_MANUAL, 0, 0, MODE_READY, c.NONE, STOP_NONE),
    *((MODE_READY, _mask(b), 0, MODE_MANUAL, b, STOP_NONE) for b in _BLOCKING),
    (MODE_READY, _mask(c.ENABLE_REFUSED), 0, MODE_MANUAL, c.ENABLE_REFUSED, STOP_NONE),
    (MODE_READY, _mask(c.VEHICLE_ACTIVE, c.START_PRESSED), 0, MODE_ACTIVE, c.NONE, STOP_NONE),
    (MODE_READY, _mask(c.VEHICLE_NOT_READY), _mask(c.START_PRESSED), MODE_MANUAL, c.VEHICLE_NOT_READY, STOP_NONE),
    *((MODE_ACTIVE, _mask(reason), 0, MODE_FAULT, reason, reaction) for reason, reaction in _STOPPING),
    (MODE_ACTIVE, _mask(c.MANOEUVRE_DONE), 0, MODE_MANUAL, c.COMPLETE, STOP_NONE),
    (MODE_FAULT, _mask(c.CLEAR_PRESSED, c.STANDSTILL), 0, MODE_MANUAL, c.NONE, STOP_NONE),
)

# The rows of each mode stand together: where they begin and where the next mode's begin.
_FIRST_ROW = tuple(min(i for i, row in enumerate(TRANSITIONS) if row[0] == mode) for mode in range(4))
_END_ROW = tuple(max(i for i, row in enumerate(TRANSITIONS) if row[0] == mode) + 1 for mode in range(4))


def _any_required(mode: int) -> int:
    """Return the conditions of which one must be present for any row of the mode to hold; -1 where a row needs none."""
    mask = 0
    for row in TRANSITIONS:
        if row[0] == mode:
            if row[1] == 0:
                return -1
            mask |= row[1]
    return mask


_ANY_REQUIRED = tuple(_any_required(mode) for mode in range(4))


_EMERGENCIES = _mask(*(reason for reason, reaction in _STOPPING if reaction == STOP_EMERGENCY))


class SupervisorState(NamedTuple):
    """The mode, why, what a fault asks for, and how long the present request to the vehicle has lasted.

    `released` is latched in a fault: once the car has stood, or the driver has it, nothing is asked of the vehicle
    until the operator has cleared the fault. `fault_us` is how long the fault has lasted.
    """

    mode: int
    reason: int
    reaction: int
    enabling: int
    enabling_us: int
    clearing_us: int
    released: int
    fault_us: int


def begin() -> SupervisorState:
    """Return the state before the first cycle."""
    return SupervisorState(
        mode=MODE_MANUAL,
        reason=c.WAITING_FOR_REPORTS,
        reaction=STOP_NONE,
        enabling=0,
        enabling_us=0,
        clearing_us=0,
        released=0,
        fault_us=0,
    )


def find_transition(mode: int, conditions: int) -> int:
    """Return the row of TRANSITIONS that decides for a mode, or -1 where the mode stays."""
    if _ANY_REQUIRED[mode] != -1 and (conditions & _ANY_REQUIRED[mode]) == 0:
        return -1  # nothing has happened: no need to look at each row
    for row in range(_FIRST_ROW[mode], _END_ROW[mode]):
        if (conditions & TRANSITIONS[row][1]) == TRANSITIONS[row][1] and (conditions & TRANSITIONS[row][2]) == 0:
            return row
    return -1


def decide(state: SupervisorState, conditions: int, period_us: int) -> SupervisorState:
    """Return the supervisor's next state.

    From Ready, a pressed start asks the vehicle to enable; Active begins when the vehicle reports Active. A start that
    the vehicle does not answer within ENABLE_TIMEOUT_US is withdrawn.
    """
    if state.mode == MODE_ACTIVE and (conditions & _ANY_REQUIRED[MODE_ACTIVE]) == 0 and state.clearing_us == 0:
        # Driving, and nothing has happened: by far the most cycles. Active is entered without a reaction, not released
        # and with no time in Fault: nothing of them is left to count.
        return state
    mode, shown_reason, reaction, enabling, enabling_us, clearing_us, released, fault_us = state
    seen = conditions & ~(1 << c.START_PRESSED)
    if mode == MODE_READY:
        if c.has(conditions, c.START_PRESSED):
            enabling = 1
            enabling_us = 0
        elif enabling != 0:
            enabling_us += period_us
        if enabling != 0:
            # From here on START_PRESSED means "the operator's start stands".
            seen |= 1 << c.START_PRESSED
            if enabling_us > ENABLE_TIMEOUT_US:
                seen |= 1 << c.ENABLE_REFUSED
    clearing_us -= period_us
    if clearing_us < 0:
        clearing_us = 0
    if mode != MODE_ACTIVE and c.has(conditions, c.CLEAR_PRESSED) and c.has(conditions, c.STANDSTILL):
        clearing_us = CLEAR_PULSE_US

    row = find_transition(mode, seen)
    if row < 0:
        if mode == MODE_FAULT:
            reaction = _escalated(reaction, fault_us, conditions)
            fault_us = min(fault_us + period_us, LONGEST_STOP_US)
            if c.has(conditions, c.STANDSTILL) or reaction == STOP_RELEASE or fault_us >= LONGEST_STOP_US:
                released = 1
        else:
            fault_us = 0
            released = 0
        return SupervisorState(
            mode,
            shown_reason,
            reaction,
            enabling,
            enabling_us,
            clearing_us,
            released,
            fault_us,
        )
    _mode, _present, _absent, next_mode, reason, reaction = TRANSITIONS[row]
    if next_mode not in (MODE_READY, MODE_ACTIVE):
        enabling = 0
        enabling_us = 0
    if mode == MODE_MANUAL and next_mode == MODE_MANUAL:
        reason = _manual_reason(shown_reason, reason)
    return SupervisorState(
        next_mode,
        reason,
        reaction,
        enabling,
        enabling_us,
        clearing_us,
        1 if reaction == STOP_RELEASE else 0,
        0,
    )


def _escalated(reaction: int, fault_us: int, conditions: int) -> int:
    """Return the reaction of a standing fault: it may get harder, never softer; the first reason stays."""
    if c.has(conditions, c.DRIVER_OVERRIDE):
        return STOP_RELEASE
    if reaction == STOP_CONTROLLED and ((conditions & _EMERGENCIES) != 0 or fault_us >= CONTROLLED_STOP_US):
        return STOP_EMERGENCY
    return reaction


def _manual_reason(shown: int, blocking: int) -> int:
    """Return what Manual reports: a finished manoeuvre stays visible until something other than routine blocks."""
    routine = blocking in (c.VEHICLE_NOT_READY, c.NOT_AT_STANDSTILL, c.POSE_SETTLING)
    if routine and shown in (c.COMPLETE, c.ENABLE_REFUSED):
        return shown
    return blocking
