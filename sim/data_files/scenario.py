"""Scenario files: how plant, sensors and start differ from what the tables were made for."""

import random
from collections.abc import Callable
from math import cos, sin
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, Field

from sim.data_files.course import Pose
from sim.data_files.reading import (
    STRICT,
    Finite,
    Name,
    Text,
    find_file,
    read_toml,
    shipped_names,
    shown,
    shown_key,
    validate,
)
from sim.data_files.vehicle import PARAMETERS, Vehicle, check_parameters
from sim.errors import UserError
from sim.faults import FaultEvent

Draw = tuple[float, float]
"""A value that each run draws evenly from (low, high); a plain number in the file is (number, number)."""


def _is_number(value: Any) -> bool:
    return isinstance(value, float) or (isinstance(value, int) and not isinstance(value, bool) and abs(value) < 1e300)


def _to_draw(value: Any) -> Any:
    if _is_number(value):
        return (float(value), float(value))
    if isinstance(value, list) and len(value) == 2 and all(_is_number(end) for end in value):
        return (float(value[0]), float(value[1]))
    if isinstance(value, tuple):
        return value
    raise ValueError(f"{shown(value)} must be a number or [low, high]")


def _within(minimum: float, maximum: float) -> Callable[[Draw], Draw]:
    def check(draw: Draw) -> Draw:
        low, high = draw
        if not (minimum <= low <= high <= maximum):
            shown = repr(low) if repr(low) == repr(high) else f"[{low!r}, {high!r}]"
            raise ValueError(f"{shown} must be from {minimum:g} to {maximum:g}, the lower end first")
        return draw

    return check


_AnyDraw = Annotated[Draw, BeforeValidator(_to_draw)]


class PlantDeviation(BaseModel):
    """What the car is made of, and how it differs from what the tables were made for.

    model: "nonlinear" single-track, or "eq11", the paper's linear one, whose reverse is "corrected" or has the
    "printed" sign of the steered wheels' yaw moment. steering_gain: road-wheel angle over command; steering_bias_rad:
    added at the road wheel, not seen by the steering sensor; steering_backlash_rad: whole width of the play between
    rack and road wheel; steering_command_resolution_rad: step of the actuator's converter, 0 = none;
    longitudinal_latency_samples: dead time of speed and brake commands in samples of 10 ms; unknown: vehicle parameters
    that the true car has instead of the file's nominal ones; corners: vehicle parameters that lie at either end of
    nominal * (1 -/+ spread), one bit of the seed each, lowest bit first.
    """

    model_config = STRICT
    model: Literal["nonlinear", "eq11"] = "nonlinear"
    reverse_sign: Literal["corrected", "printed"] = "corrected"
    steering_gain: Annotated[_AnyDraw, AfterValidator(_within(0.5, 1.5))] = (1.0, 1.0)
    steering_bias_rad: Annotated[_AnyDraw, AfterValidator(_within(-0.2, 0.2))] = (0.0, 0.0)
    steering_backlash_rad: Annotated[_AnyDraw, AfterValidator(_within(0.0, 0.2))] = (0.0, 0.0)
    steering_command_resolution_rad: Annotated[_AnyDraw, AfterValidator(_within(0.0, 0.05))] = (0.0, 0.0)
    longitudinal_latency_samples: Annotated[_AnyDraw, AfterValidator(_within(0.0, 100.0))] = (0.0, 0.0)
    unknown: dict[str, _AnyDraw] = {}
    corners: dict[str, Annotated[float, Field(ge=0.0, le=0.9, allow_inf_nan=False)]] = {}


LEAST_STATED_SIGMA_M = 0.001
"""One step of the signal position_sigma_m."""


class Sensors(BaseModel):
    """Errors of the sensors.

    position_noise_m (each axis) and yaw_noise_rad are standard deviations a sample, white, or correlated with time
    constant pose_noise_correlation_s; pose_drop_probability: share of pose samples that are not sent; *_resolution_*:
    steps, 0 = none; odometry_scale: 0.01 reads 1 % too much; gyro_bias_walk in rad/s per root second.
    """

    model_config = STRICT
    position_noise_m: Annotated[float, Field(ge=0.0, le=1.0, allow_inf_nan=False)] = 0.0
    yaw_noise_rad: Annotated[float, Field(ge=0.0, le=0.2, allow_inf_nan=False)] = 0.0
    pose_noise_correlation_s: Annotated[float, Field(ge=0.0, le=1000.0, allow_inf_nan=False)] = 0.0
    pose_drop_probability: Annotated[float, Field(ge=0.0, le=1.0, allow_inf_nan=False)] = 0.0
    position_resolution_m: Annotated[float, Field(ge=0.0, le=0.1, allow_inf_nan=False)] = 0.0
    yaw_resolution_rad: Annotated[float, Field(ge=0.0, le=0.02, allow_inf_nan=False)] = 0.0
    steering_resolution_rad: Annotated[float, Field(ge=0.0, le=0.02, allow_inf_nan=False)] = 0.0
    speed_resolution_mps: Annotated[float, Field(ge=0.0, le=0.1, allow_inf_nan=False)] = 0.0
    speed_noise_mps: Annotated[float, Field(ge=0.0, le=1.0, allow_inf_nan=False)] = 0.0
    odometry_scale: Annotated[_AnyDraw, AfterValidator(_within(-0.2, 0.2))] = (0.0, 0.0)
    gyro_noise_radps: Annotated[float, Field(ge=0.0, le=0.2, allow_inf_nan=False)] = 0.0
    gyro_bias_walk_radps_per_root_s: Annotated[float, Field(ge=0.0, le=0.1, allow_inf_nan=False)] = 0.0

    @property
    def stated_position_sigma_m(self) -> float:
        """What the localisation states of itself: at least the bus's step of it, as 0 would be "not known"."""
        return max(self.position_noise_m, LEAST_STATED_SIGMA_M)


class StartOffset(BaseModel):
    """Where the car stands at the beginning, relative to the course's start pose, in the body frame (m, rad)."""

    model_config = STRICT
    ahead_m: Annotated[_AnyDraw, AfterValidator(_within(-20.0, 20.0))] = (0.0, 0.0)
    aside_m: Annotated[_AnyDraw, AfterValidator(_within(-20.0, 20.0))] = (0.0, 0.0)
    heading_rad: Annotated[_AnyDraw, AfterValidator(_within(-3.1, 3.1))] = (0.0, 0.0)

    def apply(self, start: Pose, rng: random.Random) -> Pose:
        """Draw a start pose from the offsets."""
        ahead, aside, heading = rng.uniform(*self.ahead_m), rng.uniform(*self.aside_m), rng.uniform(*self.heading_rad)
        c, s = cos(start.yaw_rad), sin(start.yaw_rad)
        return Pose(start.x_m + c * ahead - s * aside, start.y_m + s * ahead + c * aside, start.yaw_rad + heading)


class Scenario(BaseModel):
    """How the world differs from the drawing board.

    `course` is the course that it is meant for, taken where none is named. `vehicle_overlay` holds nominal vehicle
    parameters of this scenario: tables are made from them too, and the vehicle hash on the bus covers them. All else is
    unknown to the controller.
    """

    model_config = STRICT
    name: Name
    description: Text
    course: Name | None = None
    vehicle_overlay: dict[str, Finite] = {}
    plant: PlantDeviation = PlantDeviation()
    sensors: Sensors = Sensors()
    start: StartOffset = StartOffset()
    faults: list[FaultEvent] = []


def load_scenario(name_or_path: str | Path) -> Scenario:
    """Read and check a scenario file."""
    path = find_file("scenario", name_or_path)
    scenario = validate(path, Scenario, read_toml(path)[1])
    if scenario.plant.reverse_sign != "corrected" and scenario.plant.model != "eq11":
        raise UserError(
            f'{path}: plant.reverse_sign = {scenario.plant.reverse_sign!r}: is for plant.model = "eq11" only'
        )
    if scenario.course is not None and scenario.course not in shipped_names("course"):
        known = ", ".join(shipped_names("course"))
        raise UserError(f"{path}: course = {scenario.course!r}: must be the name of a shipped course: {known}")
    check_parameters(scenario.vehicle_overlay, f"{path}: vehicle_overlay.")
    for low_or_high in (0, 1):
        check_parameters({k: v[low_or_high] for k, v in scenario.plant.unknown.items()}, f"{path}: plant.unknown.")
    for key, (low, high) in scenario.plant.unknown.items():
        if low > high:
            raise UserError(f"{path}: plant.unknown.{key} = [{low!r}, {high!r}]: the lower end comes first")
    for key in scenario.plant.corners:
        if key not in PARAMETERS:
            raise UserError(
                f"{path}: plant.corners.{shown_key(key)}: unknown key; a vehicle has {', '.join(PARAMETERS)}"
            )
    return scenario


def true_vehicle(vehicle: Vehicle, scenario: Scenario, seed: int, rng: random.Random) -> Vehicle:
    """Make the car as it really is in one run: nominal, with the scenario's corners and unknown parameters."""
    values: dict[str, float] = {}
    for bit, (key, spread) in enumerate(scenario.plant.corners.items()):
        sign = 1.0 if (seed >> bit) & 1 else -1.0
        values[key] = getattr(vehicle, key) * (1.0 + sign * spread)
    for key, draw in scenario.plant.unknown.items():
        values[key] = rng.uniform(*draw)
    return vehicle.with_overlay(values, f"scenario {scenario.name}: ")
