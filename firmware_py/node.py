"""The controller as a node of the bus: frames in, one cycle of the core, frames out. Reads no clock."""

from typing import Any, NamedTuple

from firmware_py.codec import Codec, Mailbox, Sender
from firmware_py.core import conditions as c
from firmware_py.core import controller, kalman
from firmware_py.core.health import PROTOCOL
from firmware_py.core.manoeuvre import direction_of
from firmware_py.core.path import pose_at
from firmware_py.core.signals import (
    MODE_ACTIVE,
    MODE_FAULT,
    ControllerVersion,
    CycleStamp,
    Estimate,
    Inputs,
    LongCommand,
    Outputs,
    SteerCommand,
    SysCommand,
    Track,
)
from firmware_py.core.supervisor import STOP_EMERGENCY, STOP_RELEASE, SupervisorState
from firmware_py.core.tables import Tables, Timeouts
from firmware_py.health_frames import HealthFrames
from firmware_py.record import FlightRecord
from firmware_py.table_file import TableSet

Frame = tuple[int, bytes]

FAILED_CYCLES = 300
"""So many failed cycles in a row the vehicle is kept enabled to brake with its wheels held; then it is released."""

CYCLE_INDEX_VALUES = 1 << 20
WAKE_TIME_VALUES = 1 << 32


class Seen(NamedTuple):
    """What the outside wants to know of the newest cycle."""

    mode: int
    leg: int
    reason: int
    standstill: bool
    station_m: float
    cross_track_error_est_m: float


def build_tables(table_set: TableSet, codec: Codec) -> Tables:
    """Return what the core runs on: the tables, and what it needs of the DBC."""

    def timeout_us(name: str) -> int:
        return codec.messages[name].timeout_ms * 1000

    return Tables(
        leg=table_set.legs,
        gains=table_set.gains,
        car=table_set.car,
        timeouts=Timeouts(
            sys_us=timeout_us("VEH_SysRpt"),
            steer_us=timeout_us("VEH_SteerRpt"),
            motion_us=timeout_us("VEH_MotionRpt"),
            long_us=timeout_us("VEH_LongRpt"),
            pose_us=min(timeout_us("LOC_Position"), timeout_us("LOC_Attitude")),
            oper_us=timeout_us("OPER_Cmd"),
            version_us=timeout_us("VEH_Version"),
        ),
        dbc_hash24=codec.dbc_hash24,
        vehicle_hash24=table_set.vehicle_hash24,
        road_wheel_angle_lsb_rad=codec.scale("road_wheel_angle_cmd_rad"),
        law=table_set.law,
        paper=table_set.paper,
        reference=table_set.reference,
    )


class ControllerNode:
    """Mailbox, core and sender in one: `cycle` is the whole way of a frame through the controller."""

    def __init__(self, codec: Codec, tables: Tables) -> None:
        self.mailbox = Mailbox(codec)
        self.record = FlightRecord()
        self.health = HealthFrames()
        self.stop_requested = False
        self.cycles = 0
        self.overruns = 0
        self.frames_sent = 0
        self.failed_rehearsals = 0
        self.internal_errors: list[str] = []
        self._failed_cycles = 0
        self._sender = Sender(codec)
        self._tables = tables
        self._state = controller.begin()
        self._frames: list[Frame] = []
        self._inputs: Inputs | None = None
        self._outputs: Outputs | None = None
        self._cycle_index = 0
        self._every = {
            name: codec.messages[name].cycle_time_ms * 1000 // controller.PERIOD_US
            for name in ("CTRL_Version", "CTRL_HealthTiming", "CTRL_HealthCounts", "CTRL_Estimate")
        }
        self._version = ControllerVersion(PROTOCOL, tables.dbc_hash24, tables.vehicle_hash24)

    def cycle(self, now_ns: int, frames: list[Frame], overruns: int, send_failed: int = 0) -> list[Frame]:
        """Run one control cycle and return the frames to send; never raises.

        `frames` are all that arrived since the last cycle, oldest first; `overruns` the periods skipped before it.
        """
        for arbitration_id, data in frames:
            self.mailbox.put(now_ns, arbitration_id, data)
        inputs = self.mailbox.take(now_ns // 1000, overruns)
        if self.stop_requested:
            inputs = inputs._replace(oper=inputs.oper._replace(oper_stop=1))
        outputs = self._step(inputs)
        self._frames, self._inputs, self._outputs = frames, inputs, outputs
        self.cycles += 1
        self.overruns += overruns
        self._cycle_index = (self._cycle_index + 1 + overruns) % CYCLE_INDEX_VALUES
        self.record.append(inputs, outputs)

        pack = self._sender.pack
        out = [pack(name, values) for name, values in self._messages(inputs, outputs)]
        if self.cycles % self._every["CTRL_Version"] == 1:
            out.append(pack("CTRL_Version", self._version))
        if self.cycles % self._every["CTRL_HealthTiming"] == 0:
            out.append(pack("CTRL_HealthTiming", self.health.timing()))
        if self.cycles % self._every["CTRL_HealthCounts"] == 0:
            out.append(pack("CTRL_HealthCounts", self.health.counts(self.mailbox, self.overruns, send_failed)))
        if self.cycles % self._every["CTRL_Estimate"] == 0 and not self._failed_cycles:
            out.append(pack("CTRL_Estimate", self._estimate(inputs)))
        self.frames_sent += len(out)
        return out

    def rehearse(self) -> None:
        """Run the work of a cycle on the newest frames and inputs and forget the result; changes nothing, never raises.

        The core is pure, and so are the codec's generated functions: code and tables are in the caches afterwards.
        """
        if self._inputs is None or self._outputs is None:
            return
        try:
            self.mailbox.rehearse(self._frames)
            controller.step(self._tables, self._state, self._inputs)
            self._sender.rehearse(self._messages(self._inputs, self._outputs))
        except Exception:
            self.failed_rehearsals += 1

    def _messages(self, inputs: Inputs, outputs: Outputs) -> list[tuple[str, tuple[Any, ...]]]:
        """Return what every cycle sends: names and values."""
        return [
            ("CTRL_SteerCmd", outputs.steer),
            ("CTRL_LongCmd", outputs.long),
            ("CTRL_SysCmd", outputs.sys),
            ("CTRL_Cycle", CycleStamp(self._cycle_index, inputs.now_us % WAKE_TIME_VALUES)),
            ("CTRL_CycleInputs", inputs.used),
            ("CTRL_Track", outputs.track),
        ]

    def seen(self) -> Seen:
        """Return mode, leg, reason and place as the newest cycle left them."""
        path = self._state.estimator
        sys = self._outputs.sys if self._outputs else SysCommand(0, 0, 0, 0, c.WAITING_FOR_REPORTS)
        return Seen(
            mode=sys.control_mode,
            leg=sys.control_leg,
            reason=sys.control_reason,
            standstill=self._state.standstill != 0,
            station_m=path.station_m,
            cross_track_error_est_m=path.cross_track_error_m,
        )

    @property
    def is_driving(self) -> bool:
        """Whether the controller is responsible for a car that may move."""
        mode = self._state.supervisor.mode
        return mode == MODE_ACTIVE or (mode == MODE_FAULT and self._state.supervisor.released == 0)

    def _step(self, inputs: Inputs) -> Outputs:
        """Run the core; whatever it may raise becomes a fault with an emergency stop, never an exception."""
        try:
            self._state, outputs = controller.step(self._tables, self._state, inputs)
        except Exception as error:
            return self._fail(error, inputs)
        self._failed_cycles = 0
        return outputs

    def _estimate(self, inputs: Inputs) -> Estimate:
        """Return how sure the estimator is, and what it has learnt of the car."""
        seen = self._state.estimator
        leg = self._tables.leg[direction_of(self._state.manoeuvre.leg)]
        slip_rad = pose_at(leg, seen.station_m)[3]
        cross_m, heading_rad = kalman.deviations(seen.filter.covariance, slip_rad, inputs.attitude.position_sigma_m)
        return Estimate(cross_m, heading_rad, seen.steering_gain, seen.steering_offset_rad, seen.odometry_scale)

    def _note(self, error: Exception) -> None:
        if len(self.internal_errors) < 10:
            self.internal_errors.append(f"{type(error).__name__}: {error}")

    def _fail(self, error: Exception, inputs: Inputs) -> Outputs:
        self._note(error)
        self._failed_cycles += 1
        was = self._state.supervisor
        followed = self._outputs is not None and self._outputs.steer.steer_enable != 0
        follow = 1 if followed and was.reaction != STOP_RELEASE and self._failed_cycles <= FAILED_CYCLES else 0
        angle_rad = self._state.sent_angles_rad[0]
        reaction = STOP_RELEASE if was.reaction == STOP_RELEASE else STOP_EMERGENCY
        self._state = self._state._replace(
            last_us=inputs.now_us,
            supervisor=SupervisorState(MODE_FAULT, c.INTERNAL_ERROR, reaction, 0, 0, 0, 1 - follow, was.fault_us),
        )
        leg = self._state.manoeuvre.leg
        return Outputs(
            sys=SysCommand(follow, 0, MODE_FAULT, leg, c.INTERNAL_ERROR),
            steer=SteerCommand(angle_rad, follow),
            long=LongCommand(0.0, self._tables.car.emergency_decel_mps2, 0, 0, follow),
            track=Track(0.0, 0.0, 0.0, 0.0),
        )
