"""The reasons that the controller can give, as in the DBC's value table of control_reason.

A condition is a fact about the world or the controller: bit `1 << reason` of an integer. A mode is a decision, taken
from the conditions by the supervisor. Bits above the value table are facts that are no reasons.
"""

NONE = 0
WAITING_FOR_REPORTS = 1
WAITING_FOR_OPERATOR = 2
DBC_HASH_MISMATCH = 3
VEHICLE_HASH_MISMATCH = 4
POSE_NOT_AT_START = 5
NOT_AT_STANDSTILL = 6
VEHICLE_NOT_READY = 7
ENABLE_REFUSED = 8
OPERATOR_STOP = 9
EMERGENCY_STOP = 10
DRIVER_OVERRIDE = 11
VEHICLE_FAULT = 12
SYS_REPORT_TIMEOUT = 13
STEER_REPORT_TIMEOUT = 14
MOTION_REPORT_TIMEOUT = 15
LONG_REPORT_TIMEOUT = 16
POSE_TIMEOUT = 17
OPERATOR_TIMEOUT = 18
POSE_INVALID = 19
POSE_JUMP = 20
OFF_PATH = 21
OVER_SPEED = 22
STEERING_NOT_FOLLOWING = 23
SPEED_NOT_FOLLOWING = 24
WRONG_DIRECTION = 25
CYCLE_OVERRUN = 26
COMMAND_REJECTED = 27
DIRECTION_CHANGE_TIMEOUT = 28
SECOND_CONTROLLER = 29
INTERNAL_ERROR = 30
COMPLETE = 31
POSE_SETTLING = 32

START_PRESSED = 40
CLEAR_PRESSED = 41
VEHICLE_ACTIVE = 42
STANDSTILL = 43
MANOEUVRE_DONE = 44


def has(conditions: int, reason: int) -> bool:
    """Return whether a condition is present."""
    return (conditions & (1 << reason)) != 0
