"""The vehicle's drive-by-wire system: its states, its watchdog, the gear, and which commands it follows.

Decides, but moves nothing: the emulator asks it what the actuators are to do. All times are nanoseconds of the
emulator's clock. States, reasons and the handshake are those of dbc/parking.dbc and dbc/CONVENTIONS.md.
"""

from collections.abc import Mapping
from enum import IntEnum
from typing import Any

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


WATCHED = ("CTRL_SysCmd", "CTRL_SteerCmd", "CTRL_LongCmd")
"""Commands without which an Active vehicle stops."""

NEVER = 1 << 62


class DriveByWire:
    """State machine of the vehicle. Feed it frames with `accept`, time with `at`; read `state`, `reason`, `gear`."""

    def __init__(
        self,
        start_ns: int,
        dbc_hash24: int,
        vehicle_hash24: int,
        timeouts_ns: Mapping[str, int],
        gear_change_s: float,
    ) -> None:
        self.state = State.MANUAL
        self.reason = Reason.NO_COMMAND
        self.gear = Gear.PARK
        self.park_brake_applied = True
        self.driver_override_latched = False
        self.steering_override = False
        self.brake_override = False
        self.emergency_stop_pressed = False
        self.first_active_ns: int | None = None
        self.control_leg = 0
        self.next_event_ns = NEVER
        """Next instant at which `at` must be called: the end of a gear change, or the earliest at which the watchdog
        may bite; commands that come meanwhile only postpone it, so `at` then looks again."""
        self._hashes = (PROTOCOL_VERSION, dbc_hash24, vehicle_hash24)
        self._timeouts_ns = dict(timeouts_ns)
        self._last_valid_ns: dict[str, int] = {}
        self._start_ns = start_ns
        self._active_since_ns = start_ns
        self._gear_change_ns = round(gear_change_s * NS)
        self._gear_wanted = Gear.PARK
        self._gear_done_ns = NEVER
        self._enable: int | None = None
        self._operator_estop = 0
        self._controller_version: tuple[int, int, int] | None = None

    # -- what the emulator asks ---------------------------------------------------------------------------------------

    @property
    def follows_steering(self) -> bool:
        """Steering keeps to valid commands while Active, and after a fault until the driver has the wheel."""
        return self.state is State.ACTIVE or (self.state is State.FAULT and not self.driver_override_latched)

    @property
    def follows_speed(self) -> bool:
        """Speed, brake, gear and park brake are the controller's only while Active."""
        return self.state is State.ACTIVE

    def may_drive(self, speed_mps: float) -> bool:
        """Return whether gear and park brake let the car move with a speed command of this sign."""
        if self.park_brake_applied:
            return False
        return (speed_mps > 0.0 and self.gear is Gear.DRIVE) or (speed_mps < 0.0 and self.gear is Gear.REVERSE)

    def is_timed_out(self, name: str, now_ns: int) -> bool:
        """Return whether no valid frame of the message has come for its timeout."""
        return now_ns - self._last_valid_ns.get(name, -NEVER) >= self._timeouts_ns[name]

    def _deadline_ns(self, name: str) -> int:
        # A command that was silent before counts from the moment at which the vehicle became Active.
        return max(self._last_valid_ns.get(name, 0), self._active_since_ns) + self._timeouts_ns[name]

    def _schedule(self) -> None:
        event_ns = self._gear_done_ns
        if self.state is State.ACTIVE:
            for name in WATCHED:
                event_ns = min(event_ns, self._deadline_ns(name))
        self.next_event_ns = event_ns

    # -- what happens -------------------------------------------------------------------------------------------------

    def at(self, now_ns: int, at_standstill: bool, receptions: Mapping[str, Any]) -> None:
        """Let time pass to `now_ns`: watchdog, gear change, and the way from Manual to Ready.

        `receptions` (of the wire) tells whether a command that stays away was rejected.
        """
        if now_ns >= self._gear_done_ns:
            self.gear = self._gear_wanted
            self._gear_done_ns = NEVER
        if now_ns >= self.next_event_ns:
            if self.state is State.ACTIVE:
                self._watch(now_ns, receptions)
            self._schedule()
        if self.state is State.MANUAL or self.state is State.READY:
            self._judge_ready(now_ns, at_standstill)

    def _watch(self, now_ns: int, receptions: Mapping[str, Any]) -> None:
        for name in WATCHED:
            if now_ns >= self._deadline_ns(name):
                last = receptions[name]
                if last.bad_crc:
                    self._fault(Reason.BAD_CRC)
                elif last.bad_counter:
                    self._fault(Reason.BAD_COUNTER)
                else:
                    self._fault(Reason.COMMAND_TIMEOUT)
                return

    def _judge_ready(self, now_ns: int, at_standstill: bool) -> None:
        version = self._controller_version
        if self.is_timed_out("CTRL_SysCmd", now_ns) or version is None or self.is_timed_out("CTRL_Version", now_ns):
            reason = Reason.NO_COMMAND
        elif version[:2] != self._hashes[:2]:
            reason = Reason.DBC_HASH_MISMATCH
        elif version[2] != self._hashes[2]:
            reason = Reason.VEHICLE_HASH_MISMATCH
        elif self.state is State.MANUAL and not at_standstill:
            reason = Reason.NOT_AT_STANDSTILL
        elif self.state is State.MANUAL and self._enable == 1:
            reason = Reason.ENABLE_HELD_AT_START
        else:
            if self.state is State.MANUAL:
                self.state, self.reason = State.READY, Reason.NONE
            return
        self.state, self.reason = State.MANUAL, reason

    def _fault(self, reason: Reason) -> None:
        if self.state is not State.FAULT:
            self.state, self.reason = State.FAULT, reason
            self._schedule()

    def accept(self, now_ns: int, name: str, values: Mapping[str, float], at_standstill: bool) -> None:
        """Take a valid frame of controller or operator; `at` must have been called for `now_ns` before."""
        self._last_valid_ns[name] = now_ns
        if name == "CTRL_SysCmd":
            self.control_leg = int(values["control_leg"])
            self._requests(now_ns, int(values["enable_request"]), int(values["clear_request"]), at_standstill)
        elif name == "CTRL_Version":
            self._controller_version = (
                int(values["ctrl_protocol"]),
                int(values["ctrl_dbc_hash"]),
                int(values["ctrl_vehicle_hash"]),
            )
        elif name == "OPER_Cmd":
            self._operator_estop = int(values["oper_estop"])
            if self._operator_estop:
                self._fault(Reason.EMERGENCY_STOP)

    def _requests(self, now_ns: int, enable: int, clear: int, at_standstill: bool) -> None:
        rising = enable == 1 and self._enable == 0
        self._enable = enable
        if self.state is State.ACTIVE and not enable:
            self.state, self.reason = State.READY, Reason.DISABLED_BY_CONTROLLER
        elif self.state is State.FAULT and clear and not enable and at_standstill and not self._cause_lasts():
            self.driver_override_latched = False
            self.state, self.reason = State.MANUAL, Reason.NO_COMMAND
            self._judge_ready(now_ns, at_standstill)
        elif self.state is State.READY and rising:
            if at_standstill:
                self.state, self.reason = State.ACTIVE, Reason.NONE
                self._active_since_ns = now_ns
                if self.first_active_ns is None:
                    self.first_active_ns = now_ns
                self._schedule()
            else:
                self.reason = Reason.NOT_AT_STANDSTILL

    def _cause_lasts(self) -> bool:
        pressed = self._operator_estop or self.emergency_stop_pressed
        return bool(pressed or self.steering_override or self.brake_override)

    def follow_gear(self, now_ns: int, gear_cmd: int, park_brake_cmd: int, at_standstill: bool) -> None:
        """Obey gear and park-brake command; the gear only at standstill, and it takes its time."""
        if not park_brake_cmd:
            self.park_brake_applied = False
        elif at_standstill:
            self.park_brake_applied = True
        if self._gear_done_ns != NEVER or not at_standstill or not Gear.PARK <= gear_cmd <= Gear.DRIVE:
            return
        if gear_cmd != self.gear:
            self._gear_wanted = Gear(gear_cmd)
            self.gear = Gear.NONE
            self._gear_done_ns = now_ns + self._gear_change_ns
            self._schedule()

    def driver(self, control: str, active: bool) -> None:
        """Let the driver take the hand wheel ("steering") or a pedal ("brake"), or let go of it."""
        if control == "steering":
            self.steering_override = active
        else:
            self.brake_override = active
        if active:
            self.driver_override_latched = True
            self._fault(Reason.DRIVER_OVERRIDE)

    def press_emergency_stop(self, pressed: bool) -> None:
        """Press or release the emergency-stop button in the car."""
        self.emergency_stop_pressed = pressed
        if pressed:
            self._fault(Reason.EMERGENCY_STOP)
