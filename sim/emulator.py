"""The emulator: the car on the other end of the bus, in the time that is handed to it.

Reads no clock and opens no bus: `receive` takes a frame at an instant, `reports` gives the frames of an instant, and
both integrate the plant up to it. The live process (`sim.__main__`) and the lock-step harness both stand on it.

Timing. An accepted command acts `command_latency_samples` (steering) or the scenario's `longitudinal_latency_samples`
(speed, brake, gear) times 10 ms after it arrived, to the nanosecond. The pose in a LOC frame is the true one of
`pose_latency_samples` times 10 ms before the frame's instant; all VEH reports are of the frame's own instant.
"""

import random
from collections import deque
from pathlib import Path
from typing import Any, NamedTuple

from sim.actuators import SteeringParameters, SteeringState, steering_target, step_speed, step_steering
from sim.can_side import CanSide
from sim.data_files import Course, Scenario, Side, Vehicle, check_fit, true_vehicle
from sim.drive_by_wire import BRAKE_DECEL_MPS2, NEVER, PROTOCOL_VERSION, WATCHED, DriveByWire, Reason, State
from sim.errors import UserError
from sim.examiner import Examiner
from sim.faults import FaultInjector, Frame
from sim.sensors import Measured, SensorSet
from sim.vehicle import PlantState, plant_parameters, rear_axle_pose, state_at_rest, step

PERIOD_NS = 10_000_000
"""Cycle of the fast reports, and the length of a sample in the vehicle file."""

MAX_STEP_NS = 1_000_000
VERSION_EVERY = 10
QUALITY_FIXED = 3
OVERRIDE_TORQUE_NM = 5.0
REJECTED_COUNT_MAX = 1023
MAX_TRUTH_ROWS = 360_000
"""An hour of truth; what is older goes."""

_ROUNDING_RAD = 1.0e-9
_MISSED_TARGET_RAD = 1.0e-4  # farther than this from its target when the next one comes: the rate limit has cut it


class TruthRow(NamedTuple):
    """The plant at one call of `reports`: pose of the rear-axle centre, accelerations along and across the body.

    `road_wheel_angle_rad` is the true one, `road_wheel_angle_cmd_rad` the last accepted command; `gear` and `state`
    by the DBC's values, `brake` the deceleration by the brake in m/s^2; `min_clearance_m` of this instant, to the
    nearest cone's axis.
    """

    t_s: float
    x_m: float
    y_m: float
    yaw_rad: float
    speed_mps: float
    accel_x_mps2: float
    accel_y_mps2: float
    road_wheel_angle_rad: float
    road_wheel_rate_radps: float
    road_wheel_angle_cmd_rad: float
    gear: int
    brake: float
    state: int
    min_clearance_m: float


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
        check_fit(nominal, course)
        rng = random.Random(f"plant {seed}")
        true = true_vehicle(nominal, scenario, seed, rng)
        plant = scenario.plant
        self._wire = CanSide(dbc_path)
        self._vehicle_hash24 = nominal.hash24
        self._start_ns = start_ns
        self._t_ns = start_ns
        self._plant = plant_parameters(
            true.mass_kg,
            true.yaw_inertia_kgm2,
            true.wheelbase_m,
            true.cg_to_rear_axle_m,
            true.cornering_stiffness_front_n_per_rad,
            true.cornering_stiffness_rear_n_per_rad,
            true.tyre_friction,
            true.relaxation_length_m,
        )
        self._steering = SteeringParameters(
            max_angle_rad=true.max_road_wheel_angle_rad,
            max_rate_radps=true.max_road_wheel_rate_radps,
            lag_s=true.steering_lag_s,
            gain=rng.uniform(*plant.steering_gain),
            bias_rad=rng.uniform(*plant.steering_bias_rad),
            half_backlash_rad=0.5 * rng.uniform(*plant.steering_backlash_rad),
            resolution_rad=rng.uniform(*plant.steering_command_resolution_rad),
        )
        self._steer_latency_ns = round(true.command_latency_samples * PERIOD_NS)
        self._long_latency_ns = round(rng.uniform(*plant.longitudinal_latency_samples) * PERIOD_NS)
        self._pose_latency_ns = round(true.pose_latency_samples * PERIOD_NS)
        self._drive_lag_s = true.drive_lag_s
        self._brake_lag_s = true.brake_lag_s
        self._max_decel_mps2 = true.max_decel_mps2
        self._sys_rpt: dict[str, Any] = {}
        self._steer_rpt: dict[str, Any] = {"steer_angle_valid": 1, "steer_fault": 0}
        self._motion_rpt: dict[str, Any] = {"speed_valid": 1, "yaw_rate_valid": 1}
        self._long_rpt: dict[str, Any] = {"long_fault": 0}
        self._position: dict[str, Any] = {"position_quality": QUALITY_FIXED}
        self._attitude: dict[str, Any] = {
            "yaw_quality": QUALITY_FIXED,
            "pose_latency_ms": 1.0e-6 * PERIOD_NS * nominal.pose_latency_samples,
            "position_sigma_m": scenario.sensors.position_noise_m,
        }
        self._received_sys, self._received_steer, self._received_long = (self._wire.received[name] for name in WATCHED)
        self._dbw = DriveByWire(
            start_ns,
            self._wire.dbc_hash24,
            self._vehicle_hash24,
            {name: self._wire.timeout_ns(name) for name in (*WATCHED, "CTRL_Version")},
            true.gear_change_s,
        )
        self._sensors = SensorSet(scenario.sensors, seed)
        self._faults = FaultInjector(scenario.faults, start_ns)
        self.examiner = Examiner(nominal, course, side)
        self.truth: list[TruthRow] = []

        start = scenario.start.apply(course.start_pose(nominal, side), rng)
        self._state = state_at_rest(self._plant, *start)
        self._steer = SteeringState(0.0, 0.0, 0.0)
        self._steer_target_rad = 0.0
        self._speed_target_mps = 0.0
        self._decel_target_mps2 = BRAKE_DECEL_MPS2
        self._decel_mps2 = BRAKE_DECEL_MPS2
        self._accel_x_mps2 = 0.0
        self._wheel_rate_radps = 0.0
        self._history: deque[tuple[int, PlantState]] = deque([(start_ns, self._state)])
        self._pending_steer: deque[tuple[int, float]] = deque()
        self._pending_long: deque[tuple[int, dict[str, Any]]] = deque()
        self._long: dict[str, Any] = {}
        self._echo_angle_rad = 0.0
        self._echo_speed_mps = 0.0
        self._echo_decel_mps2 = 0.0
        self._limited_value = 0
        self._limited_rate = 0
        self._report_index = 0
        self._last_report_ns = start_ns - PERIOD_NS
        self._has_moved = False
        self._check_fault_signals(scenario)

    # -- state for those who watch ------------------------------------------------------------------------------------

    @property
    def now_ns(self) -> int:
        """Instant up to which the plant has been integrated."""
        return self._t_ns

    @property
    def state(self) -> State:
        """State of the drive-by-wire system."""
        return self._dbw.state

    @property
    def reason(self) -> Reason:
        """Why the drive-by-wire system is in its state."""
        return self._dbw.reason

    @property
    def control_leg(self) -> int:
        """Leg that the controller last reported, by the DBC's values."""
        return self._dbw.control_leg

    @property
    def is_safe(self) -> bool:
        """Return whether the car stands and a brake holds it."""
        held = self._decel_target_mps2 > 0.0 or self._dbw.park_brake_applied
        return self._state.speed_mps == 0.0 and held

    @property
    def is_parked(self) -> bool:
        """Return whether the car stands, held, and no longer follows the controller."""
        return self.is_safe and not self._dbw.follows_speed

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
        self._dbw.driver(control, active)
        self._apply_targets()

    def press_emergency_stop(self, pressed: bool) -> None:
        """Press or release the emergency-stop button in the car, at the present instant."""
        self._dbw.press_emergency_stop(pressed)
        self._apply_targets()

    # -- time ---------------------------------------------------------------------------------------------------------

    def advance(self, now_ns: int) -> None:
        """Integrate the plant to `now_ns`, stopping at every instant at which something acts; earlier is no effect."""
        while True:
            event_ns = self._next_event_ns()
            until_ns = event_ns if event_ns < now_ns else now_ns
            if until_ns > self._t_ns:
                self._integrate(until_ns)
            if event_ns > now_ns:
                return
            self._act()

    def _next_event_ns(self) -> int:
        event_ns = self._dbw.next_event_ns
        if self._pending_steer and self._pending_steer[0][0] < event_ns:
            event_ns = self._pending_steer[0][0]
        if self._pending_long and self._pending_long[0][0] < event_ns:
            event_ns = self._pending_long[0][0]
        return min(event_ns, self._faults.next_edge_ns)

    def _act(self) -> None:
        """Let all that is due at the present instant act."""
        now_ns = self._t_ns
        for event, begins in self._faults.at(now_ns) if self._faults.next_edge_ns <= now_ns else ():
            if event.kind == "driver_override" and event.control is not None:
                self._dbw.driver(event.control, begins)
            elif event.kind == "emergency_stop":
                self._dbw.press_emergency_stop(begins)
        self._dbw.at(now_ns, self._state.speed_mps == 0.0, self._wire.received)
        while self._pending_steer and self._pending_steer[0][0] <= now_ns:
            _, angle = self._pending_steer.popleft()
            if self._dbw.follows_steering:
                self._limited_rate = int(abs(self._steer_target_rad - self._steer.demand_rad) > _MISSED_TARGET_RAD)
                self._limited_value = int(abs(angle) > self._steering.max_angle_rad + _ROUNDING_RAD)
                self._steer_target_rad = steering_target(self._steering, angle)
        while self._pending_long and self._pending_long[0][0] <= now_ns:
            self._long = self._pending_long.popleft()[1]
        self._apply_targets()

    def _apply_targets(self) -> None:
        """Set what drive and brake are to do, from the command that acts and the state of the vehicle."""
        command = self._long
        if not self._dbw.follows_speed or not command or not command["long_enable"]:
            self._speed_target_mps = 0.0
            self._decel_target_mps2 = BRAKE_DECEL_MPS2
            return
        at_standstill = self._state.speed_mps == 0.0
        self._dbw.follow_gear(self._t_ns, int(command["gear_cmd"]), int(command["park_brake_cmd"]), at_standstill)
        speed = command["speed_cmd_mps"]
        self._speed_target_mps = speed if self._dbw.may_drive(speed) else 0.0
        self._decel_target_mps2 = min(command["brake_decel_cmd_mps2"], self._max_decel_mps2)

    def _integrate(self, until_ns: int) -> None:
        span_ns = until_ns - self._t_ns
        count = -(-span_ns // MAX_STEP_NS)
        h = span_ns * 1.0e-9 / count
        plant, steering = self._plant, self._steering
        state, steer, decel = self._state, self._steer, self._decel_mps2
        is_frozen = not self._faults.is_quiet and self._faults.steering_is_frozen
        target = self._steer_target_rad
        speed_target, decel_target = self._speed_target_mps, self._decel_target_mps2
        drive_lag, brake_lag, bias = self._drive_lag_s, self._brake_lag_s, steering.bias_rad
        remember = self._history.append
        speed = before = state.speed_mps
        wheel_before = steer.wheel_rad
        t_ns = self._t_ns
        for index in range(1, count + 1):
            wheel_before = steer.wheel_rad
            if not is_frozen:
                steer = step_steering(steering, steer, target, h)
            before = speed
            speed, decel = step_speed(drive_lag, brake_lag, speed, decel, speed_target, decel_target, h)
            state = step(plant, state, speed, steer.wheel_rad + bias, h)
            remember((t_ns + span_ns * index // count, state))
        self._accel_x_mps2 = (speed - before) / h
        self._wheel_rate_radps = (steer.wheel_rad - wheel_before) / h
        self._state, self._steer, self._decel_mps2 = state, steer, decel
        self._t_ns = until_ns
        if not self._has_moved and speed != 0.0:
            self._has_moved = True
            self._faults.begin("moving", until_ns)

    # -- frames in ----------------------------------------------------------------------------------------------------

    def receive(self, now_ns: int, arbitration_id: int, data: bytes) -> None:
        """Take a frame that arrived at `now_ns`; rejected and foreign ones change nothing but the flags."""
        accepted = self._wire.decode(now_ns, arbitration_id, data)
        if accepted is None:
            return
        name, values = accepted
        if name not in _HEARD:
            return
        self.advance(now_ns)
        if not self._faults.is_quiet and self._faults.stops(name):
            return
        state_before = self._dbw.state
        self._dbw.accept(self._t_ns, name, values, self._state.speed_mps == 0.0)
        if name == "CTRL_SteerCmd":
            self._echo_angle_rad = values["road_wheel_angle_cmd_rad"]
            if values["steer_enable"]:
                self._pending_steer.append((self._t_ns + self._steer_latency_ns, self._echo_angle_rad))
                if not self._steer_latency_ns:
                    self._act()
        elif name == "CTRL_LongCmd":
            self._echo_speed_mps = values["speed_cmd_mps"]
            self._echo_decel_mps2 = values["brake_decel_cmd_mps2"]
            self._pending_long.append((self._t_ns + self._long_latency_ns, values))
            if not self._long_latency_ns:
                self._act()
        elif self._dbw.state is not state_before:
            self._note_new_state()

    def _note_new_state(self) -> None:
        if self._dbw.state is State.ACTIVE and self._dbw.first_active_ns is not None:
            self._faults.begin("active", self._dbw.first_active_ns)
            if self._dbw.is_timed_out("CTRL_LongCmd", self._t_ns):
                self._long = {}  # a command from long ago must not move the car
        self._apply_targets()
        self.advance(self._t_ns)

    # -- frames out ---------------------------------------------------------------------------------------------------

    def reports(self, now_ns: int) -> list[Frame]:
        """Sample sensors and truth at `now_ns`, and return the frames that are due, as (arbitration id, data)."""
        self.advance(now_ns)
        now_ns = self._t_ns
        self._dbw.at(now_ns, self._state.speed_mps == 0.0, self._wire.received)
        pose = rear_axle_pose(self._plant, self._state)
        measured = self._sensors.sample(
            (now_ns - self._last_report_ns) * 1.0e-9,
            self._pose_at(now_ns - self._pose_latency_ns),
            self._state.speed_mps,
            self._state.yaw_rate_radps,
            self._steer.rack_rad,
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

    def _pose_at(self, t_ns: int) -> tuple[float, float, float]:
        """Rear-axle pose at an earlier instant, between two steps by linear interpolation; forgets what is older."""
        history = self._history
        while len(history) > 1 and history[1][0] <= t_ns:
            history.popleft()
        earlier_ns, earlier = history[0]
        if earlier_ns >= t_ns or len(history) == 1:
            return rear_axle_pose(self._plant, earlier)
        later_ns, later = history[1]
        share = (t_ns - earlier_ns) / (later_ns - earlier_ns)
        between = PlantState(*[a + share * (b - a) for a, b in zip(earlier, later, strict=True)])
        return rear_axle_pose(self._plant, between)

    def _note_truth(self, now_ns: int, pose: tuple[float, float, float]) -> None:
        t_s = (now_ns - self._start_ns) * 1.0e-9
        speed = self._state.speed_mps
        clearance = self.examiner.observe(t_s, *pose, speed)
        if len(self.truth) >= MAX_TRUTH_ROWS:
            del self.truth[: MAX_TRUTH_ROWS // 10]
        self.truth.append(
            TruthRow(
                t_s,
                *pose,
                speed,
                self._accel_x_mps2,
                self._state.lateral_accel_mps2,
                self._steer.wheel_rad + self._steering.bias_rad,
                self._wheel_rate_radps,
                self._echo_angle_rad,
                int(self._dbw.gear),
                self._decel_mps2,
                int(self._dbw.state),
                clearance,
            )
        )

    def _messages(self, now_ns: int, measured: Measured) -> list[tuple[str, dict[str, Any]]]:
        """All fast reports; the dictionaries are used again in the next tick."""
        dbw = self._dbw
        rejected = self._wire.rejected_count
        sys, received = self._sys_rpt, self._received_sys
        sys["vehicle_state"] = int(dbw.state)
        sys["vehicle_reason"] = int(dbw.reason)
        sys["driver_override"] = int(dbw.driver_override_latched)
        sys["sys_cmd_timeout"] = int(dbw.is_timed_out("CTRL_SysCmd", now_ns))
        sys["sys_cmd_bad_crc"] = int(received.bad_crc)
        sys["sys_cmd_bad_counter"] = int(received.bad_counter)
        sys["sys_cmd_rejected_count"] = rejected if rejected < REJECTED_COUNT_MAX else REJECTED_COUNT_MAX
        steer, received = self._steer_rpt, self._received_steer
        steer["road_wheel_angle_meas_rad"] = measured.road_wheel_angle_rad
        steer["road_wheel_angle_echo_rad"] = self._echo_angle_rad
        steer["steer_limiting_value"] = self._limited_value
        steer["steer_limiting_rate"] = self._limited_rate
        steer["steer_cmd_timeout"] = int(dbw.is_timed_out("CTRL_SteerCmd", now_ns))
        steer["steer_cmd_bad_crc"] = int(received.bad_crc)
        steer["steer_cmd_bad_counter"] = int(received.bad_counter)
        steer["steer_override"] = int(dbw.steering_override)
        steer["steering_wheel_torque_nm"] = OVERRIDE_TORQUE_NM if dbw.steering_override else 0.0
        motion = self._motion_rpt
        motion["speed_meas_mps"] = measured.speed_mps
        motion["yaw_rate_meas_radps"] = measured.yaw_rate_radps
        long, received = self._long_rpt, self._received_long
        long["gear_rpt"] = int(dbw.gear)
        long["park_brake_applied"] = int(dbw.park_brake_applied)
        long["standstill"] = int(self._state.speed_mps == 0.0)
        long["speed_echo_mps"] = self._echo_speed_mps
        long["brake_decel_echo_mps2"] = self._echo_decel_mps2
        long["long_cmd_timeout"] = int(dbw.is_timed_out("CTRL_LongCmd", now_ns))
        long["long_cmd_bad_crc"] = int(received.bad_crc)
        long["long_cmd_bad_counter"] = int(received.bad_counter)
        long["brake_override"] = int(dbw.brake_override)
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


_HEARD = ("CTRL_SysCmd", "CTRL_SteerCmd", "CTRL_LongCmd", "CTRL_Version", "OPER_Cmd")

__all__ = ["NEVER", "PERIOD_NS", "Emulator", "TruthRow"]
