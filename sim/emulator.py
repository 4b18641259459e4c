"""The emulator: the car on the other end of the bus, in the time that is handed to it.

Reads no clock and opens no bus: `receive` takes a frame at an instant, `reports` gives the frames of an instant, and
both integrate the plant up to it. The live process (`sim.__main__`) and the lock-step harness both stand on it. What
the car does is `sim.plant`; here it is put on the wire, with faults and examiner.

Timing. An accepted command acts `command_latency_samples` (steering) or the scenario's `longitudinal_latency_samples`
(speed, brake, gear) times 10 ms after it arrived, to the nanosecond. The pose in a LOC frame is the true one of
`pose_latency_samples` times 10 ms before the frame's instant; all VEH reports are of the frame's own instant.
"""

from pathlib import Path
from typing import Any

from sim import drive_by_wire as dbw
from sim import plant
from sim.can_side import CanSide, Values
from sim.data_files import Course, Scenario, Side, Vehicle
from sim.drive_by_wire import NEVER, PROTOCOL_VERSION, TIMED, WATCHED, Reason, State
from sim.errors import UserError
from sim.examiner import Examiner
from sim.faults import FaultInjector, Frame
from sim.plant import PERIOD_NS, VERSION_EVERY, TruthRow
from sim.sensors import Measured, NoiseRows, first_state
from sim.vehicle import rear_axle_pose

QUALITY_FIXED = 3
OVERRIDE_TORQUE_NM = 5.0
REJECTED_COUNT_MAX = 1023
MAX_TRUTH_ROWS = 360_000
"""An hour of truth; what is older goes."""

_OVERRIDES = {"steering": dbw.STEERING_OVERRIDE, "brake": dbw.BRAKE_OVERRIDE}


class Emulator:
    """Plant, sensors, drive-by-wire system and examiner of one run.

    Args:
        vehicle: the car as its file gives it; the scenario's overlay is put on it here (twice does no harm).
        course: where it drives; refused (UserError) if the car does not fit.
        scenario: what is wrong with car, sensors and start.
        side: "left" or "right".
        seed: decides every random draw; the same seed and calls give the same frames.
        dbc_path: the messages.
        start_ns: the instant at which the car stands at its start.

    """

    def __init__(
        self, vehicle: Vehicle, course: Course, scenario: Scenario, side: Side, seed: int, dbc_path: Path, start_ns: int
    ) -> None:
        nominal = vehicle.with_overlay(scenario.vehicle_overlay, f"scenario {scenario.name}: vehicle_overlay.")
        self._wire = CanSide(dbc_path)
        sys_ns, steer_ns, long_ns, version_ns = (self._wire.timeout_ns(name) for name in TIMED)
        setup = plant.set_up(vehicle, course, scenario, side, seed, (sys_ns, steer_ns, long_ns, version_ns))
        self._vehicle_hash24 = nominal.hash24
        self._start_ns = start_ns
        self._car = setup.car
        self._memory = plant.begin_memory(start_ns)
        self._motion = plant.begin(self._car, self._memory, setup.start, start_ns)
        self._dbw = self._memory.system
        self._sensors = setup.sensors
        self._noise = NoiseRows(seed)
        self._sensor_state = first_state(self._noise.row())
        self._sys_rpt: dict[str, Any] = {}
        self._steer_rpt: dict[str, Any] = {"steer_angle_valid": 1, "steer_fault": 0}
        self._motion_rpt: dict[str, Any] = {"speed_valid": 1, "yaw_rate_valid": 1}
        self._long_rpt: dict[str, Any] = {"long_fault": 0}
        self._position: dict[str, Any] = {"position_quality": QUALITY_FIXED}
        self._attitude: dict[str, Any] = {
            "yaw_quality": QUALITY_FIXED,
            "pose_latency_ms": 1.0e-6 * PERIOD_NS * nominal.pose_latency_samples,
            "position_sigma_m": scenario.sensors.stated_position_sigma_m,
        }
        self._received = tuple(self._wire.received[name] for name in WATCHED)
        self._faults = FaultInjector(scenario.faults, start_ns)
        self.examiner = Examiner(nominal, course, side)
        self.truth: list[TruthRow] = []
        self._report_index = 0
        self._last_report_ns = start_ns - PERIOD_NS
        self._has_moved = False
        self._check_fault_signals(scenario)

    # -- state for those who watch ------------------------------------------------------------------------------------

    @property
    def now_ns(self) -> int:
        """Instant up to which the plant has been integrated."""
        return self._motion.t_ns

    @property
    def state(self) -> State:
        """State of the drive-by-wire system."""
        return State(self._dbw[dbw.STATE])

    @property
    def reason(self) -> Reason:
        """Why the drive-by-wire system is in its state."""
        return Reason(self._dbw[dbw.REASON])

    @property
    def control_leg(self) -> int:
        """Leg that the controller last reported, by the DBC's values."""
        return self._dbw[dbw.CONTROL_LEG]

    @property
    def is_safe(self) -> bool:
        """Return whether the car stands and a brake holds it."""
        held = self._memory.value[plant.DECEL_TARGET_MPS2] > 0.0 or self._dbw[dbw.PARK_BRAKE_APPLIED] != 0
        return self._stands and held

    @property
    def _stands(self) -> bool:
        return self._motion.body.speed_mps == 0.0

    @property
    def is_parked(self) -> bool:
        """Return whether the car stands, held, and no longer follows the controller."""
        return self.is_safe and not dbw.follows_speed(self._dbw)

    @property
    def vehicle_hash24(self) -> int:
        """Hash of the vehicle's parameters as it goes over the bus."""
        return self._vehicle_hash24

    @property
    def rejected_count(self) -> int:
        """Frames of the controller and the operator that were rejected."""
        return self._wire.rejected_count

    @property
    def lost_count(self) -> int:
        """Frames of the controller and the operator that are missing between accepted ones."""
        return self._wire.lost_count

    # -- hooks for faults by hand -------------------------------------------------------------------------------------

    def driver(self, control: str, active: bool) -> None:
        """Let the driver take ("steering", "brake") or let go, at the present instant."""
        dbw.driver(self._car.system, self._dbw, _OVERRIDES[control], int(active))
        plant.apply_targets(self._car, self._motion, self._memory)

    def press_emergency_stop(self, pressed: bool) -> None:
        """Press or release the emergency-stop button in the car, at the present instant."""
        dbw.press_emergency_stop(self._car.system, self._dbw, int(pressed))
        plant.apply_targets(self._car, self._motion, self._memory)

    # -- time ---------------------------------------------------------------------------------------------------------

    def advance(self, now_ns: int) -> None:
        """Integrate the plant to `now_ns`, stopping at every instant at which something acts; earlier is no effect."""
        while True:
            edge_ns = self._faults.next_edge_ns
            self._motion = plant.advance(self._car, self._motion, self._memory, now_ns, edge_ns)
            if not self._has_moved and not self._stands:
                self._has_moved = True
                self._faults.begin("moving", self._motion.t_ns)
            if self._faults.next_edge_ns > self._motion.t_ns:
                return
            self._switch_faults()

    def _switch_faults(self) -> None:
        """Let the faults that begin or end at the present instant do so, then all else that is due."""
        for event, begins in self._faults.at(self._motion.t_ns):
            if event.kind == "driver_override" and event.control is not None:
                dbw.driver(self._car.system, self._dbw, _OVERRIDES[event.control], int(begins))
            elif event.kind == "emergency_stop":
                dbw.press_emergency_stop(self._car.system, self._dbw, int(begins))
        self._memory.number[plant.IS_FROZEN] = int(self._faults.steering_is_frozen)
        plant.act(self._car, self._motion, self._memory)

    # -- frames in ----------------------------------------------------------------------------------------------------

    def receive(self, now_ns: int, arbitration_id: int, data: bytes) -> None:
        """Take a frame that arrived at `now_ns`; rejected and foreign ones change nothing but the flags."""
        accepted = self._wire.decode(now_ns, arbitration_id, data)
        if accepted is None:
            self._note_rejections()
            return
        name, values = accepted
        if name not in _HEARD:
            return
        self.advance(now_ns)
        if not self._faults.is_quiet and self._faults.stops(name):
            return
        self._accept(name, values)

    def _note_rejections(self) -> None:
        """Tell the watchdog why the last frame of a command did not count."""
        for message, received in enumerate(self._received):
            reason = Reason.BAD_CRC if received.bad_crc else Reason.BAD_COUNTER if received.bad_counter else Reason.NONE
            self._dbw[dbw.REJECTED_FOR + message] = int(reason)

    def _accept(self, name: str, values: Values) -> None:
        """Take a valid frame at the present instant."""
        car, motion, memory = self._car, self._motion, self._memory
        if name in _PLACE:
            self._dbw[dbw.REJECTED_FOR + _PLACE[name]] = dbw.NO_REASON
        if name == "CTRL_SteerCmd":
            plant.accept_steer(car, motion, memory, values["road_wheel_angle_cmd_rad"], int(values["steer_enable"]))
        elif name == "CTRL_LongCmd":
            plant.accept_long(
                car,
                motion,
                memory,
                values["speed_cmd_mps"],
                values["brake_decel_cmd_mps2"],
                int(values["gear_cmd"]),
                int(values["park_brake_cmd"]),
                int(values["long_enable"]),
            )
        elif name == "CTRL_SysCmd":
            enable, clear = int(values["enable_request"]), int(values["clear_request"])
            plant.accept_sys(car, motion, memory, enable, clear, int(values["control_leg"]))
            if self._dbw[dbw.FIRST_ACTIVE_NS] == motion.t_ns:
                self._faults.begin("active", motion.t_ns)
                self.advance(motion.t_ns)
        elif name == "CTRL_Version":
            dbw.accept(self._dbw, dbw.VERSION, motion.t_ns)
            self._dbw[dbw.VERSION_REASON] = int(self._judge_version(values))
        else:
            state_before = self._dbw[dbw.STATE]
            dbw.accept_operator(car.system, self._dbw, int(values["oper_estop"]))
            if self._dbw[dbw.STATE] != state_before:
                plant.note_new_state(car, motion, memory)

    def _judge_version(self, values: Values) -> Reason:
        """Return what a controller's version gives reason to."""
        if (values["ctrl_protocol"], values["ctrl_dbc_hash"]) != (PROTOCOL_VERSION, self._wire.dbc_hash24):
            return Reason.DBC_HASH_MISMATCH
        return Reason.NONE if values["ctrl_vehicle_hash"] == self._vehicle_hash24 else Reason.VEHICLE_HASH_MISMATCH

    # -- frames out ---------------------------------------------------------------------------------------------------

    def reports(self, now_ns: int) -> list[Frame]:
        """Sample sensors and truth at `now_ns`, and return the frames that are due, as (arbitration id, data)."""
        self.advance(now_ns)
        car, motion = self._car, self._motion
        now_ns = motion.t_ns
        pose = rear_axle_pose(car.body, motion.body)
        since_s = (now_ns - self._last_report_ns) * 1.0e-9
        self._sensor_state, measured = plant.sample(
            car, self._sensors, self._sensor_state, motion, self._memory, since_s, self._noise.row()
        )
        self._last_report_ns = now_ns
        self._note_truth(now_ns, pose)
        messages = self._messages(now_ns, measured)
        if self._report_index % VERSION_EVERY == 0:
            messages.append(("VEH_Version", self._version()))
        self._report_index += 1
        encode = self._wire.encode
        if self._faults.is_quiet:
            return [encode(name, values) for name, values in messages]
        return self._faulty_frames(now_ns, messages)

    def _note_truth(self, now_ns: int, pose: tuple[float, float, float]) -> None:
        t_s = (now_ns - self._start_ns) * 1.0e-9
        clearance = self.examiner.observe(t_s, *pose, self._motion.body.speed_mps)
        if len(self.truth) >= MAX_TRUTH_ROWS:
            del self.truth[: MAX_TRUTH_ROWS // 10]
        self.truth.append(plant.truth_row(self._car, self._motion, self._memory, t_s, pose, clearance))

    def _messages(self, now_ns: int, measured: Measured) -> list[tuple[str, dict[str, Any]]]:
        """All fast reports; the dictionaries are used again in the next tick."""
        system, value, number = self._dbw, self._memory.value, self._memory.number
        timeouts = self._car.system
        rejected = self._wire.rejected_count
        by_sys, by_steer, by_long = self._received
        sys = self._sys_rpt
        sys["vehicle_state"] = system[dbw.STATE]
        sys["vehicle_reason"] = system[dbw.REASON]
        sys["driver_override"] = system[dbw.OVERRIDE_LATCHED]
        sys["sys_cmd_timeout"] = int(dbw.is_timed_out(timeouts, system, dbw.SYS, now_ns))
        sys["sys_cmd_bad_crc"] = int(by_sys.bad_crc)
        sys["sys_cmd_bad_counter"] = int(by_sys.bad_counter)
        sys["sys_cmd_rejected_count"] = rejected if rejected < REJECTED_COUNT_MAX else REJECTED_COUNT_MAX
        steer = self._steer_rpt
        steer["road_wheel_angle_meas_rad"] = measured.road_wheel_angle_rad
        steer["road_wheel_angle_echo_rad"] = value[plant.ECHO_ANGLE_RAD]
        steer["steer_limiting_value"] = number[plant.LIMITED_VALUE]
        steer["steer_limiting_rate"] = number[plant.LIMITED_RATE]
        steer["steer_cmd_timeout"] = int(dbw.is_timed_out(timeouts, system, dbw.STEER, now_ns))
        steer["steer_cmd_bad_crc"] = int(by_steer.bad_crc)
        steer["steer_cmd_bad_counter"] = int(by_steer.bad_counter)
        steer["steer_override"] = system[dbw.STEERING_OVERRIDE]
        steer["steering_wheel_torque_nm"] = OVERRIDE_TORQUE_NM if system[dbw.STEERING_OVERRIDE] else 0.0
        motion = self._motion_rpt
        motion["speed_meas_mps"] = measured.speed_mps
        motion["yaw_rate_meas_radps"] = measured.yaw_rate_radps
        long = self._long_rpt
        long["gear_rpt"] = system[dbw.GEAR]
        long["park_brake_applied"] = system[dbw.PARK_BRAKE_APPLIED]
        long["standstill"] = int(self._stands)
        long["speed_echo_mps"] = value[plant.ECHO_SPEED_MPS]
        long["brake_decel_echo_mps2"] = value[plant.ECHO_DECEL_MPS2]
        long["long_cmd_timeout"] = int(dbw.is_timed_out(timeouts, system, dbw.LONG, now_ns))
        long["long_cmd_bad_crc"] = int(by_long.bad_crc)
        long["long_cmd_bad_counter"] = int(by_long.bad_counter)
        long["brake_override"] = system[dbw.BRAKE_OVERRIDE]
        messages = [("VEH_SysRpt", sys), ("VEH_SteerRpt", steer), ("VEH_MotionRpt", motion), ("VEH_LongRpt", long)]
        if measured.pose_is_sent:
            position, attitude = self._position, self._attitude
            position["position_x_m"] = measured.x_m
            position["position_y_m"] = measured.y_m
            attitude["yaw_rad"] = measured.yaw_rad
            messages.append(("LOC_Position", position))
            messages.append(("LOC_Attitude", attitude))
        return messages

    def _version(self) -> dict[str, Any]:
        return {
            "veh_protocol": PROTOCOL_VERSION,
            "veh_dbc_hash": self._wire.dbc_hash24,
            "veh_vehicle_hash": self._vehicle_hash24,
        }

    def _faulty_frames(self, now_ns: int, messages: list[tuple[str, dict[str, Any]]]) -> list[Frame]:
        faults = self._faults
        frames = faults.late(now_ns)
        for name, values in messages:
            changed = dict(values)
            faults.alter(name, changed)
            # A stopped message is lost on the wire: its counter goes on, as a pair of LOC frames needs.
            encoded = self._wire.encode(name, changed)
            frame = None if faults.stops(name) else faults.spoil(now_ns, name, encoded)
            if frame is not None:
                frames.append(frame)
        return frames

    def _check_fault_signals(self, scenario: Scenario) -> None:
        still = Measured(0.0, 0.0, 0.0, True, 0.0, 0.0, 0.0)
        signals = dict(self._messages(self._start_ns, still))
        signals["VEH_Version"] = self._version()
        for event in scenario.faults:
            if event.signal is not None and event.message is not None and event.signal not in signals[event.message]:
                raise UserError(
                    f"scenario {scenario.name}: [[faults]] {event.kind}: message {event.message} has no signal "
                    f"{event.signal!r}; it has {', '.join(sorted(signals[event.message]))}"
                )


_HEARD = (*TIMED, "OPER_Cmd")
_PLACE = {name: place for place, name in enumerate(WATCHED)}

__all__ = ["NEVER", "PERIOD_NS", "Emulator", "TruthRow"]
