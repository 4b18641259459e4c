"""A plant as an outsider would write it, from the folder dbc/ alone: DBC text, CONVENTIONS.md, a vehicle and a course.

Kinematic single-track car, own encoder (bits placed by hand), own CRC and counter check, own state machine. It shares
no code with sim/ or firmware_py/. Section numbers are those of CONVENTIONS.md.
"""

from __future__ import annotations

import hashlib
import math
import tomllib
from collections import deque
from pathlib import Path

from test_wire_independent import LAYOUT, bitwise_crc, decode, encode

Frame = tuple[int, bytes]

MANUAL, READY, ACTIVE, FAULT = range(4)
GEAR_NONE, PARK, REVERSE, NEUTRAL, DRIVE = range(5)
REASONS = [
    "None",
    "NoCommand",
    "DbcHashMismatch",
    "VehicleHashMismatch",
    "NotAtStandstill",
    "EnableHeldAtStart",
    "DisabledByController",
    "CommandTimeout",
    "BadCrc",
    "BadCounter",
    "DriverOverride",
    "EmergencyStop",
    "ActuatorFault",
]
NAMES = {frame_id: name for name, (frame_id, _) in LAYOUT.items()}
SCALES = {field.name: field.scale for _, fields in LAYOUT.values() for field in fields}
TIMEOUT_NS = {"CTRL_Version": 1_000_000_000}
COMMANDS = ("CTRL_SysCmd", "CTRL_SteerCmd", "CTRL_LongCmd")
STEP_NS = 1_000_000
OWN_BRAKE_MPS2 = 2.4


def hash24(path: Path) -> int:
    """Section 5."""
    return int(hashlib.sha256(path.read_bytes().replace(b"\r\n", b"\n")).hexdigest()[:6], 16)


class Check:
    """Section 4, for one message."""

    def __init__(self, timeout_ns: int) -> None:
        self.timeout_ns = timeout_ns
        self.baseline: int | None = None
        self.strays: list[int] = []
        self.came_ns = self.valid_ns = -(10**18)
        self.bad_crc = self.bad_counter = False

    def judge(self, now_ns: int, frame_id: int, data: bytes) -> bool:
        self.bad_crc = len(data) != 8 or data[0] != bitwise_crc([frame_id & 0xFF, frame_id >> 8, *data[1:]])
        self.bad_counter = not self.bad_crc and not self.accept(now_ns, data[1] & 15)
        if self.bad_crc or self.bad_counter:
            return False
        self.valid_ns = now_ns
        return True

    def accept(self, now_ns: int, counter: int) -> bool:
        if counter == 15:
            return False
        silence_ns, self.came_ns = now_ns - self.came_ns, now_ns
        if self.baseline is not None and silence_ns <= self.timeout_ns and not 1 <= (counter - self.baseline) % 15 <= 5:
            if self.strays and not 1 <= (counter - self.strays[-1]) % 15 <= 5:
                self.strays = []
            self.strays.append(counter)
            if len(self.strays) < 3:
                return False
        self.baseline, self.strays = counter, []
        return True

    def is_lost(self, now_ns: int) -> bool:
        return now_ns - self.valid_ns > self.timeout_ns


class OutsidePlant:
    """VEH and LOC of one run. `receive` takes a frame, `reports` gives those of an instant; both let time pass."""

    def __init__(self, folder: Path, vehicle: str, course: str, now_ns: int) -> None:
        self.car = {
            key: entry["nominal"]
            for key, entry in tomllib.loads((folder / f"vehicles/{vehicle}.toml").read_text())["parameters"].items()
        }
        start = tomllib.loads((folder / f"courses/{course}.toml").read_text())["start"]
        assert start["rule"] == "front_bumper_x"
        self.x_m = start["x_m"] - self.car["wheelbase_m"] - self.car["front_overhang_m"]  # section 12
        self.y_m = self.yaw_rad = self.speed_mps = self.wheel_rad = self.demand_rad = self.decel_mps2 = 0.0
        self.dbc_hash = hash24(folder / "parking.dbc")
        self.vehicle_hash = hash24(folder / f"vehicles/{vehicle}.toml")
        self.state, self.reason = MANUAL, "NoCommand"
        self.gear, self.gear_wanted, self.gear_ready_ns = PARK, PARK, 0
        self.park_brake, self.enable = 1, -1
        self.active_since_ns = 0
        self.version: tuple[int, ...] | None = None
        self.checks = {
            name: Check(TIMEOUT_NS.get(name, 100_000_000)) for name in LAYOUT if name.startswith(("CTRL", "OPER"))
        }
        self.rejected = 0
        self.estop = 0
        self.steer: dict[str, float] = {}
        self.long: dict[str, float] = {}
        self.acting_long: dict[str, float] = {}
        self.due: deque[tuple[int, str, dict[str, float]]] = deque()
        self.poses = deque([(self.x_m, self.y_m, self.yaw_rad)] * (1 + round(self.car["pose_latency_samples"])))
        self.counters = dict.fromkeys(LAYOUT, 0)
        self.ticks = 0
        self.now_ns = now_ns

    # -- frames in --------------------------------------------------------------------------------------------------

    def receive(self, now_ns: int, frame_id: int, data: bytes) -> None:
        self.pass_time(now_ns)
        name = NAMES.get(frame_id, "")
        if name not in self.checks:
            return
        if not self.checks[name].judge(now_ns, frame_id, data):
            self.rejected += 1
            return
        values = {key: raw * SCALES[key] for key, raw in decode(name, data).items()}
        if name == "CTRL_SysCmd":
            self.request(now_ns, int(values["enable_request"]), int(values["clear_request"]))
        elif name == "CTRL_Version":
            self.version = tuple(int(values[key]) for key in ("ctrl_protocol", "ctrl_dbc_hash", "ctrl_vehicle_hash"))
        elif name == "OPER_Cmd":
            self.estop = int(values["oper_estop"])
            if self.estop:
                self.fault("EmergencyStop")
        elif name == "CTRL_SteerCmd":
            self.steer = values
            self.due.append((now_ns + round(self.car["command_latency_samples"] * 10**7), name, values))
        elif name == "CTRL_LongCmd":
            self.long = values
            self.due.append((now_ns, name, values))

    def request(self, now_ns: int, enable: int, clear: int) -> None:
        rises, self.enable = enable == 1 and self.enable == 0, enable
        if self.state == ACTIVE and not enable:
            self.state, self.reason = READY, "DisabledByController"
        elif self.state == READY and rises:
            if self.speed_mps == 0.0:
                self.state, self.reason, self.active_since_ns = ACTIVE, "None", now_ns
                self.acting_long = {}
            else:
                self.reason = "NotAtStandstill"
        elif self.state == FAULT and clear and not enable and self.speed_mps == 0.0 and not self.estop:
            self.state, self.reason = MANUAL, "NoCommand"

    def fault(self, reason: str) -> None:
        if self.state != FAULT:
            self.state, self.reason = FAULT, reason

    # -- time -------------------------------------------------------------------------------------------------------

    def pass_time(self, now_ns: int) -> None:
        while self.now_ns < now_ns:
            until_ns = min(now_ns, self.now_ns + STEP_NS)
            self.move((until_ns - self.now_ns) * 1e-9)
            self.now_ns = until_ns
            for item in [item for item in self.due if item[0] <= self.now_ns]:
                self.due.remove(item)
                if item[1] == "CTRL_LongCmd":
                    self.acting_long = item[2]
                elif self.state in (ACTIVE, FAULT) and item[2]["steer_enable"]:
                    most = self.car["max_road_wheel_angle_rad"]
                    self.demand_rad = max(-most, min(most, item[2]["road_wheel_angle_cmd_rad"]))
            self.supervise()

    def supervise(self) -> None:
        if self.gear == GEAR_NONE and self.now_ns >= self.gear_ready_ns:
            self.gear = self.gear_wanted
        if self.state == ACTIVE:
            for name in COMMANDS:
                check = self.checks[name]
                if self.now_ns - max(check.valid_ns, self.active_since_ns) >= check.timeout_ns:
                    self.fault("BadCrc" if check.bad_crc else "BadCounter" if check.bad_counter else "CommandTimeout")
        elif self.state in (MANUAL, READY):
            reason = self.not_ready_because()
            if reason is None and self.state == MANUAL:
                self.state, self.reason = READY, "None"
            elif reason is not None and (
                self.state == MANUAL or reason not in ("NotAtStandstill", "EnableHeldAtStart")
            ):
                self.state, self.reason = MANUAL, reason

    def not_ready_because(self) -> str | None:
        if self.version is None or any(self.checks[n].is_lost(self.now_ns) for n in ("CTRL_SysCmd", "CTRL_Version")):
            return "NoCommand"
        if self.version[:2] != (1, self.dbc_hash):
            return "DbcHashMismatch"
        if self.version[2] != self.vehicle_hash:
            return "VehicleHashMismatch"
        if self.speed_mps != 0.0:
            return "NotAtStandstill"
        return "EnableHeldAtStart" if self.enable else None

    def move(self, h_s: float) -> None:
        speed_wanted, decel_wanted = 0.0, OWN_BRAKE_MPS2
        command = self.acting_long
        if self.state == ACTIVE and command.get("long_enable"):
            speed_wanted, decel_wanted = command["speed_cmd_mps"], command["brake_decel_cmd_mps2"]
            if self.speed_mps == 0.0:
                self.park_brake = int(command["park_brake_cmd"])
                gear = int(command["gear_cmd"])
                if gear in (PARK, REVERSE, NEUTRAL, DRIVE) and gear != self.gear != GEAR_NONE:
                    self.gear, self.gear_wanted = GEAR_NONE, gear
                    self.gear_ready_ns = self.now_ns + round(self.car["gear_change_s"] * 1e9)
            fits = self.gear == (DRIVE if speed_wanted > 0 else REVERSE) and not self.park_brake
            speed_wanted = speed_wanted if fits else 0.0
        self.decel_mps2 += (decel_wanted - self.decel_mps2) * min(1.0, h_s / self.car["brake_lag_s"])
        if decel_wanted > 0.0:
            change = min(abs(self.speed_mps), self.decel_mps2 * h_s)
            self.speed_mps -= math.copysign(change, self.speed_mps)
            self.speed_mps = 0.0 if abs(self.speed_mps) < 1e-3 else self.speed_mps
        else:
            self.speed_mps += (speed_wanted - self.speed_mps) * min(1.0, h_s / self.car["drive_lag_s"])
            self.speed_mps = 0.0 if speed_wanted == 0.0 and abs(self.speed_mps) < 1e-3 else self.speed_mps
        lag_s = self.car["steering_lag_s"]
        most = self.car["max_road_wheel_rate_radps"] * h_s
        change_rad = (self.demand_rad - self.wheel_rad) * min(1.0, h_s / lag_s if lag_s else 1.0)
        self.wheel_rad += max(-most, min(most, change_rad))
        yaw_rate = self.speed_mps * math.tan(self.wheel_rad) / self.car["wheelbase_m"]
        middle_rad = self.yaw_rad + 0.5 * yaw_rate * h_s
        self.x_m += self.speed_mps * math.cos(middle_rad) * h_s
        self.y_m += self.speed_mps * math.sin(middle_rad) * h_s
        self.yaw_rad += yaw_rate * h_s

    # -- frames out -------------------------------------------------------------------------------------------------

    def reports(self, now_ns: int) -> list[Frame]:
        """Section 8."""
        self.pass_time(now_ns)
        self.poses.append((self.x_m, self.y_m, self.yaw_rad))
        self.poses.popleft()
        x_m, y_m, yaw_rad = self.poses[0]
        flags: dict[str, float] = {}
        for name, prefix in zip(COMMANDS, ("sys_cmd", "steer_cmd", "long_cmd"), strict=True):
            check = self.checks[name]
            flags[f"{prefix}_timeout"] = int(check.is_lost(now_ns))
            flags[f"{prefix}_bad_crc"] = int(check.bad_crc)
            flags[f"{prefix}_bad_counter"] = int(check.bad_counter)
        everything: dict[str, float] = {
            **flags,
            "vehicle_state": self.state,
            "vehicle_reason": REASONS.index(self.reason),
            "sys_cmd_rejected_count": min(self.rejected, 1023),
            "road_wheel_angle_meas_rad": self.wheel_rad,
            "road_wheel_angle_echo_rad": self.steer.get("road_wheel_angle_cmd_rad", 0.0),
            "steer_angle_valid": 1,
            "speed_meas_mps": self.speed_mps,
            "speed_valid": 1,
            "gear_rpt": self.gear,
            "park_brake_applied": self.park_brake,
            "standstill": int(self.speed_mps == 0.0),
            "speed_echo_mps": self.long.get("speed_cmd_mps", 0.0),
            "brake_decel_echo_mps2": self.long.get("brake_decel_cmd_mps2", 0.0),
            "position_x_m": x_m,
            "position_y_m": y_m,
            "position_quality": 3,
            "yaw_rad": (yaw_rad + math.pi) % (2 * math.pi) - math.pi,
            "yaw_quality": 3,
            "veh_protocol": 1,
            "veh_dbc_hash": self.dbc_hash,
            "veh_vehicle_hash": self.vehicle_hash,
        }
        names = ["VEH_SysRpt", "VEH_SteerRpt", "VEH_MotionRpt", "VEH_LongRpt", "LOC_Position", "LOC_Attitude"]
        names += ["VEH_Version"] * (self.ticks % 10 == 0)
        self.ticks += 1
        return [self.frame(name, everything) for name in names]

    def frame(self, name: str, values: dict[str, float]) -> Frame:
        raws = {f.name: math.floor(values[f.name] / f.scale + 0.5) for f in LAYOUT[name][1] if f.name in values}
        counter = self.counters[name]
        self.counters[name] = (counter + 1) % 15
        return encode(name, raws, counter)
