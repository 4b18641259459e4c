"""Vehicle files: what a car is to the design, the controller and the plant."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import isfinite
from pathlib import Path
from typing import Annotated, NamedTuple, get_type_hints

from pydantic import BaseModel, Field

from sim.data_files.reading import STRICT, Finite, Name, Text, find_file, read_toml, shown, shown_key, validate
from sim.errors import UserError


class Parameter(NamedTuple):
    """What a vehicle parameter must be: its unit as the file spells it, and its range (both ends allowed)."""

    unit: str
    minimum: float
    maximum: float


class Criteria(BaseModel):
    """What the design must keep with every car of the box; the table `design` of a vehicle file.

    D-region of the closed loop's poles: none slower than `slowest_pole_1pm` per metre of travel, and all damped at
    least by `least_damping`. Margins of the loop cut at the steering command: the balanced disk margin, and the delay
    in samples of 10 ms beyond the car's own.
    """

    model_config = STRICT
    slowest_pole_1pm: Annotated[Finite, Field(ge=-1.0, lt=0.0)] = -0.08
    least_damping: Annotated[Finite, Field(gt=0.0, le=0.7)] = 0.1
    least_disk_margin: Annotated[Finite, Field(gt=0.0, le=1.5)] = 0.5
    least_delay_margin_samples: Annotated[Finite, Field(ge=0.0, le=100.0)] = 10.0


@dataclass(frozen=True)
class Vehicle:
    """A car: nominal parameters in SI units, `box[name] = (low, high)` around each, and the hash for the bus.

    Rear axle, centre of gravity and bumpers lie on the x axis of the body. `criteria` is what a design for the car must
    keep. `overlay` holds the nominal values that a scenario has put in place of the file's.
    """

    name: str
    description: str
    wheelbase_m: Annotated[float, Parameter("m", 0.5, 12.0)]
    front_overhang_m: Annotated[float, Parameter("m", 0.0, 3.0)]
    rear_overhang_m: Annotated[float, Parameter("m", 0.0, 4.0)]
    body_width_m: Annotated[float, Parameter("m", 0.4, 3.0)]
    mirror_width_m: Annotated[float, Parameter("m", 0.4, 3.5)]
    mirror_from_rear_axle_m: Annotated[float, Parameter("m", -3.0, 15.0)]
    mass_kg: Annotated[float, Parameter("kg", 50.0, 60000.0)]
    yaw_inertia_kgm2: Annotated[float, Parameter("kg m^2", 5.0, 1.0e6)]
    cg_to_rear_axle_m: Annotated[float, Parameter("m", 0.05, 12.0)]
    cornering_stiffness_front_n_per_rad: Annotated[float, Parameter("N/rad", 1.0e3, 5.0e6)]
    cornering_stiffness_rear_n_per_rad: Annotated[float, Parameter("N/rad", 1.0e3, 5.0e6)]
    tyre_friction: Annotated[float, Parameter("1", 0.05, 2.0)]
    relaxation_length_m: Annotated[float, Parameter("m", 0.02, 3.0)]
    steering_ratio: Annotated[float, Parameter("1", 1.0, 40.0)]
    max_road_wheel_angle_rad: Annotated[float, Parameter("rad", 0.05, 1.2)]
    max_road_wheel_rate_radps: Annotated[float, Parameter("rad/s", 0.02, 20.0)]
    steering_lag_s: Annotated[float, Parameter("s", 0.0, 2.0)]
    pose_latency_samples: Annotated[float, Parameter("samples", 0.0, 40.0)]
    command_latency_samples: Annotated[float, Parameter("samples", 0.0, 100.0)]
    drive_lag_s: Annotated[float, Parameter("s", 0.0, 5.0)]
    brake_lag_s: Annotated[float, Parameter("s", 0.0, 2.0)]
    gear_change_s: Annotated[float, Parameter("s", 0.0, 10.0)]
    max_speed_mps: Annotated[float, Parameter("m/s", 0.1, 3.0)]
    max_decel_mps2: Annotated[float, Parameter("m/s^2", 2.4, 10.0)]
    box: Mapping[str, tuple[float, float]]
    file_bytes: bytes = field(repr=False)
    criteria: Criteria = field(default_factory=Criteria)
    overlay: Mapping[str, float] = field(default_factory=dict)

    @property
    def hash24(self) -> int:
        """First 3 bytes (big-endian) of SHA-256 over the file's bytes, CRLF made LF, and the overlay's text.

        The overlay's text is empty, or a line "key=value" for each key in alphabetical order, the value as Python's
        shortest repr of the float, each line ended by LF.
        """
        text = "".join(f"{key}={self.overlay[key]!r}\n" for key in sorted(self.overlay))
        digest = hashlib.sha256(self.file_bytes.replace(b"\r\n", b"\n") + text.encode()).digest()
        return int.from_bytes(digest[:3], "big")

    def with_overlay(self, overlay: Mapping[str, float], where: str = "overlay: ") -> "Vehicle":
        """Return the same car with other nominal values; the box grows to hold them. `where` stands before errors.

        Overlays add up: a second one replaces the first only in the keys that both have.
        """
        if not overlay:
            return self
        values = {key: float(value) for key, value in overlay.items()}
        check_parameters(values, where)
        box = dict(self.box)
        for key, value in values.items():
            low, high = box[key]
            box[key] = (min(low, value), max(high, value))
        changed = replace(self, box=box, overlay={**self.overlay, **values}, **values)  # type: ignore[arg-type]
        _check_whole(changed, where)
        return changed


PARAMETERS: dict[str, Parameter] = {
    name: hint.__metadata__[0]
    for name, hint in get_type_hints(Vehicle, include_extras=True).items()
    if isinstance(getattr(hint, "__metadata__", (None,))[0], Parameter)
}
"""Every parameter of a vehicle file with its unit and range, from the annotations of `Vehicle`."""


def check_parameters(values: Mapping[str, float], where: str) -> None:
    """Raise UserError where a key is no vehicle parameter or a value is outside the parameter's range."""
    for key, value in values.items():
        if key not in PARAMETERS:
            raise UserError(f"{where}{shown_key(key)}: unknown key; a vehicle has {', '.join(PARAMETERS)}")
        _check_range(key, value, where)


def _check_range(key: str, value: float, where: str) -> None:
    parameter = PARAMETERS[key.split(".", maxsplit=1)[0]]
    if not (isfinite(value) and parameter.minimum <= value <= parameter.maximum):
        raise UserError(
            f"{where}{key} = {value!r}: must be from {parameter.minimum:g} to {parameter.maximum:g} {parameter.unit}"
        )


def _check_whole(vehicle: Vehicle, where: str) -> None:
    """Check what takes more than one parameter."""
    if vehicle.cg_to_rear_axle_m >= vehicle.wheelbase_m:
        raise UserError(
            f"{where}cg_to_rear_axle_m = {vehicle.cg_to_rear_axle_m!r}: must be less than "
            f"wheelbase_m = {vehicle.wheelbase_m!r}"
        )
    if vehicle.mirror_width_m < vehicle.body_width_m:
        raise UserError(
            f"{where}mirror_width_m = {vehicle.mirror_width_m!r}: is the width over the mirrors, so at least "
            f"body_width_m = {vehicle.body_width_m!r}"
        )


class _Entry(BaseModel):
    model_config = STRICT
    nominal: Finite
    low: Finite
    high: Finite
    unit: str
    source: Text


class _VehicleFile(BaseModel):
    model_config = STRICT
    name: Name
    description: Text
    parameters: dict[str, _Entry]
    design: Criteria = Criteria()


def load_vehicle(name_or_path: str | Path, overlay: Mapping[str, float] | None = None) -> Vehicle:
    """Read and check a vehicle file, then put an overlay of nominal values on it."""
    path = find_file("vehicle", name_or_path)
    raw, content = read_toml(path)
    file = validate(path, _VehicleFile, content)
    where = f"{path}: parameters."
    for key in file.parameters:
        if key not in PARAMETERS:
            raise UserError(f"{where}{shown_key(key)}: unknown key; a vehicle has {', '.join(PARAMETERS)}")
    for key, parameter in PARAMETERS.items():
        if key not in file.parameters:
            raise UserError(
                f"{where}{key}: missing; write {key} = {{ nominal = , low = , high = , "
                f'unit = "{parameter.unit}", source = "" }}'
            )
        entry = file.parameters[key]
        if entry.unit != parameter.unit:
            raise UserError(f"{where}{key}.unit = {shown(entry.unit)}: must be {parameter.unit!r}")
        for part in ("nominal", "low", "high"):
            _check_range(f"{key}.{part}", getattr(entry, part), where)
        if not entry.low <= entry.nominal <= entry.high:
            raise UserError(
                f"{where}{key}: low <= nominal <= high does not hold for "
                f"{entry.low!r}, {entry.nominal!r}, {entry.high!r}"
            )
    nominal = {key: file.parameters[key].nominal for key in PARAMETERS}
    vehicle = Vehicle(
        name=file.name,
        description=file.description,
        box={key: (file.parameters[key].low, file.parameters[key].high) for key in PARAMETERS},
        file_bytes=raw,
        criteria=file.design,
        **nominal,  # type: ignore[arg-type]
    )
    _check_whole(vehicle, where)
    return vehicle.with_overlay(overlay) if overlay else vehicle
