"""A bench for the emulator: plays controller and operator, on the wire, in virtual time."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from sim.can_side import CanSide
from sim.data_files import Course, Scenario, Side, Vehicle, load_course, load_vehicle
from sim.drive_by_wire import Gear, State
from sim.emulator import Emulator

DBC = Path(__file__).resolve().parent.parent / "dbc" / "parking.dbc"
MS = 1_000_000
TICK = 10 * MS
PHASE = 3 * MS
"""The controller's frames arrive so long after the emulator's reports."""

Frame = tuple[int, bytes]


def scenario(**parts: Any) -> Scenario:
    """A scenario without errors but for the parts given."""
    return Scenario.model_validate({"name": "bench", "description": "bench", **parts})


LAGLESS = {"steering_lag_s": 0.0, "pose_latency_samples": 0.0, "command_latency_samples": 0.0}


class Bench:
    """An emulator and the frames of a controller: set the fields, call `tick`, look at `seen` and `emulator`.

    `lost` names messages that the controller does not send; `mangle` may change any frame on its way in.
    """

    def __init__(
        self,
        world: Scenario | None = None,
        vehicle: Vehicle | None = None,
        course: Course | None = None,
        side: Side = "left",
        seed: int = 0,
        start_ns: int = 0,
        period_ns: int = TICK,
    ) -> None:
        world = scenario(vehicle_overlay=LAGLESS) if world is None else world
        self.emulator = Emulator(
            vehicle or load_vehicle("paper"), course or load_course("ohio"), world, side, seed, DBC, start_ns
        )
        self.wire = CanSide(DBC, nodes=("CTRL", "OPER"), check_only=())
        self.now_ns = start_ns
        self.period_ns = period_ns
        self.ticks = 0
        self.seen: dict[str, dict[str, Any]] = {}
        self.sys = {"enable_request": 0, "clear_request": 0, "control_mode": 0, "control_leg": 0, "control_reason": 0}
        self.steer = {"road_wheel_angle_cmd_rad": 0.0, "steer_enable": 0}
        self.long = {
            "speed_cmd_mps": 0.0,
            "brake_decel_cmd_mps2": 1.5,
            "gear_cmd": Gear.NONE,
            "park_brake_cmd": 0,
            "long_enable": 0,
        }
        self.version = {
            "ctrl_protocol": 1,
            "ctrl_dbc_hash": self.wire.dbc_hash24,
            "ctrl_vehicle_hash": self.emulator.vehicle_hash24,
        }
        self.oper = {"oper_start": 0, "oper_stop": 0, "oper_estop": 0, "oper_clear": 0}
        self.lost: set[str] = set()
        self.mangle: Callable[[str, Frame], list[Frame]] = lambda _name, frame: [frame]

    def tick(self, count: int = 1) -> Bench:
        """Run whole cycles: reports at `now_ns`, the controller's frames 3 ms later."""
        for _ in range(count):
            self.hear(self.emulator.reports(self.now_ns))
            due = {"CTRL_SysCmd": self.sys, "CTRL_SteerCmd": self.steer, "CTRL_LongCmd": self.long}
            if self.ticks % 10 == 0:
                due["CTRL_Version"] = self.version
            if self.ticks % 2 == 0:
                due["OPER_Cmd"] = self.oper
            for name, values in due.items():
                if name not in self.lost:
                    for frame in self.mangle(name, self.wire.encode(name, values)):
                        self.emulator.receive(self.now_ns + PHASE, *frame)
            self.ticks += 1
            self.now_ns += self.period_ns
        return self

    def hear(self, frames: list[Frame]) -> None:
        for frame in frames:
            heard = self.wire.decode(self.now_ns, *frame)
            assert heard is not None, "the emulator sent a frame that its peer rejects"
            self.seen[heard[0]] = heard[1]

    def send(self, at_ns: int, name: str, values: dict[str, Any]) -> None:
        self.emulator.receive(at_ns, *self.wire.encode(name, values))

    @property
    def state(self) -> tuple[int, int]:
        """Vehicle state and reason as reported."""
        report = self.seen["VEH_SysRpt"]
        return report["vehicle_state"], report["vehicle_reason"]

    def until_ready(self) -> Bench:
        self.tick(3)
        assert self.emulator.state is State.READY
        return self

    def until_active(self, gear: Gear = Gear.DRIVE) -> Bench:
        """Arm, release the park brake, engage the gear; the brake is held."""
        self.until_ready()
        self.sys["enable_request"] = self.steer["steer_enable"] = self.long["long_enable"] = 1
        self.long["gear_cmd"] = gear
        self.tick(70)
        assert self.emulator.state is State.ACTIVE
        assert self.seen["VEH_LongRpt"]["gear_rpt"] == gear
        return self

    def go(self, speed: float, seconds: float = 2.0) -> Bench:
        """Drive at a speed; the gear must fit."""
        self.long |= {"speed_cmd_mps": speed, "brake_decel_cmd_mps2": 0.0}
        return self.tick(round(seconds * 100))

    def brake(self, decel: float = 1.0, seconds: float = 2.0) -> Bench:
        self.long |= {"speed_cmd_mps": 0.0, "brake_decel_cmd_mps2": decel}
        return self.tick(round(seconds * 100))

    @property
    def truth(self) -> Any:
        return self.emulator.truth[-1]
