"""Vehicle, course and scenario files: load, check, and say in one line what is wrong.

All three are TOML. Every key is checked: unknown, missing, of the wrong type or unit, or out of range ends in a
`UserError` that names file and key. CONVENTIONS.md in dbc/ explains frames, signs and hashes.
"""

import hashlib
import random
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from math import cos, isfinite, sin
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar, get_args, get_type_hints

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from sim.body import clearance_m, outline_of
from sim.errors import UserError
from sim.faults import FaultEvent

ROOT = Path(__file__).resolve().parent.parent
FOLDERS = {
    "vehicle": ROOT / "dbc" / "vehicles",
    "course": ROOT / "dbc" / "courses",
    "scenario": ROOT / "sim" / "scenarios",
}

Side = Literal["left", "right"]
SIDES: tuple[Side, Side] = ("left", "right")


class Pose(NamedTuple):
    """Pose of the rear-axle centre in the course frame: x, y in m, yaw in rad."""

    x_m: float
    y_m: float
    yaw_rad: float


# --------------------------------------------------------------------------------------------------------------------
# Finding and reading files
# --------------------------------------------------------------------------------------------------------------------


def shipped_names(kind: str) -> list[str]:
    """Names of the files of a kind ("vehicle", "course", "scenario") that come with the project."""
    return sorted(path.stem for path in FOLDERS[kind].glob("*.toml"))


def find_file(kind: str, name_or_path: str | Path) -> Path:
    """Path of a shipped file given by its name, or of a user's file given by its path.

    A text without "/" that does not end in ".toml" is a name. Raises UserError where there is no such file.
    """
    text = str(name_or_path)
    known = ", ".join(shipped_names(kind))
    if isinstance(name_or_path, str) and "/" not in text and not text.endswith(".toml"):
        path = FOLDERS[kind] / f"{text}.toml"
        if not path.is_file():
            raise UserError(f"no {kind} is called {text!r}; there are {known}, or give the path of a .toml file")
        return path
    path = Path(text)
    if not path.is_file():
        raise UserError(f"{text}: no such {kind} file; give the path of a .toml file or one of the names {known}")
    return path


def _read(path: Path) -> tuple[bytes, dict[str, Any]]:
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror}") from None
    try:
        return raw, tomllib.loads(raw.decode("utf-8"))
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: not a text file in UTF-8 (byte {error.start})") from None
    except tomllib.TOMLDecodeError as error:
        raise UserError(f"{path}: not valid TOML: {' '.join(str(error).split())}") from None
    except RecursionError:
        raise UserError(f"{path}: not valid TOML: nested too deeply") from None


_Model = TypeVar("_Model", bound=BaseModel)


def _validate(path: Path, model: type[_Model], content: Mapping[str, Any]) -> _Model:
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise UserError(f"{path}: {_first_mistake(error, model)}") from None


def _first_mistake(error: ValidationError, model: type[BaseModel]) -> str:
    """One line for the first mistake that pydantic found, naming the key as it stands in the file."""
    mistakes = error.errors()
    # An unknown key is most often the misspelt twin of a missing one: it says more.
    mistake = next((m for m in mistakes if m["type"] == "extra_forbidden"), mistakes[0])
    key, siblings = _as_in_the_file(model, mistake["loc"])
    if mistake["type"] == "extra_forbidden":
        text = f"{key}: unknown key" + (f"; known here: {', '.join(siblings)}" if siblings else "")
    elif mistake["type"] == "missing":
        text = f"{key}: missing"
    elif mistake["type"] == "union_tag_not_found":
        text = f"{key}.rule: missing"
    elif mistake["type"] == "union_tag_invalid":
        text = f"{key}.rule = {_shown(mistake['ctx']['tag'])}: must be {mistake['ctx']['expected_tags']}"
    elif mistake["type"] == "value_error":
        what = str(mistake["ctx"]["error"])
        text = f"{key}: {what}" if key else what
    else:
        what = mistake["msg"]
        text = f"{key} = {_shown(mistake['input'])}: {what[0].lower()}{what[1:]}"
    more = len(mistakes) - 1
    return text + (f" (and {more} more)" if more else "")


def _shown(value: object, most: int = 60) -> str:
    text = repr(value)
    return text if len(text) <= most else text[:most] + "..."


def _key(text: str) -> str:
    """Return a key as it can stand in one line."""
    return text if text.isprintable() and len(text) <= 60 else _shown(text)


def _as_in_the_file(model: type[BaseModel], location: tuple[int | str, ...]) -> tuple[str, list[str]]:
    """Dotted key of a mistake, without pydantic's union tags and with lists counted from 1, and the keys beside it."""
    key = ""
    here: list[type[BaseModel]] = [model]
    siblings: list[str] = []
    for part in location:
        if isinstance(part, int):
            key += f"[{part + 1}]"
            continue
        siblings = list(here[0].model_fields) if len(here) == 1 else []
        tagged = [m for m in here if "rule" in m.model_fields and part in get_args(m.model_fields["rule"].annotation)]
        if tagged and len(here) > 1:
            here = tagged
            continue
        key += f".{_key(part)}" if key else _key(part)
        field_info = here[0].model_fields.get(part) if len(here) == 1 else None
        here = [] if field_info is None else _models_in(field_info.annotation)
    return key, siblings


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for argument in getattr(annotation, "__args__", ()) for model in _models_in(argument)]


_STRICT = ConfigDict(extra="forbid", frozen=True, strict=True)
_Finite = Annotated[float, Field(allow_inf_nan=False)]
_Name = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,39}$")]
_Text = Annotated[str, Field(min_length=1)]


# --------------------------------------------------------------------------------------------------------------------
# Vehicles
# --------------------------------------------------------------------------------------------------------------------


class Parameter(NamedTuple):
    """What a vehicle parameter must be: its unit as the file spells it, and its range (both ends allowed)."""

    unit: str
    minimum: float
    maximum: float


@dataclass(frozen=True)
class Vehicle:
    """A car: nominal parameters in SI units, `box[name] = (low, high)` around each, and the hash for the bus.

    Rear axle, centre of gravity and bumpers lie on the x axis of the body. `overlay` holds the nominal values that
    a scenario has put in place of the file's.
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
            raise UserError(f"{where}{_key(key)}: unknown key; a vehicle has {', '.join(PARAMETERS)}")
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
    model_config = _STRICT
    nominal: _Finite
    low: _Finite
    high: _Finite
    unit: str
    source: _Text


class _VehicleFile(BaseModel):
    model_config = _STRICT
    name: _Name
    description: _Text
    parameters: dict[str, _Entry]


def load_vehicle(name_or_path: str | Path, overlay: Mapping[str, float] | None = None) -> Vehicle:
    """Read and check a vehicle file, then put an overlay of nominal values on it."""
    path = find_file("vehicle", name_or_path)
    raw, content = _read(path)
    file = _validate(path, _VehicleFile, content)
    where = f"{path}: parameters."
    for key in file.parameters:
        if key not in PARAMETERS:
            raise UserError(f"{where}{_key(key)}: unknown key; a vehicle has {', '.join(PARAMETERS)}")
    for key, parameter in PARAMETERS.items():
        if key not in file.parameters:
            raise UserError(
                f"{where}{key}: missing; write {key} = {{ nominal = , low = , high = , "
                f'unit = "{parameter.unit}", source = "" }}'
            )
        entry = file.parameters[key]
        if entry.unit != parameter.unit:
            raise UserError(f"{where}{key}.unit = {_shown(entry.unit)}: must be {parameter.unit!r}")
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
        **nominal,  # type: ignore[arg-type]
    )
    _check_whole(vehicle, where)
    return vehicle.with_overlay(overlay) if overlay else vehicle


# --------------------------------------------------------------------------------------------------------------------
# Courses
# --------------------------------------------------------------------------------------------------------------------

_Distance = Annotated[float, Field(ge=-150.0, le=150.0, allow_inf_nan=False)]  # what LOC_Position can carry
_Tolerance = Annotated[float, Field(gt=0.0, le=10.0, allow_inf_nan=False)]


class Cone(BaseModel):
    """A cone of the course: name and axis (m, course frame)."""

    model_config = _STRICT
    name: _Name
    x_m: _Distance
    y_m: _Distance


class StartAtBumper(BaseModel):
    """The car stands on the x axis with its front bumper at `x_m`."""

    model_config = _STRICT
    rule: Literal["front_bumper_x"]
    x_m: _Distance


class StartAtPoint(BaseModel):
    """The car stands parallel to the x axis with the named point at (x_m, y_m)."""

    model_config = _STRICT
    rule: Literal["reference_point"]
    point: Literal["rear_axle", "centre_of_gravity"]
    x_m: _Distance
    y_m: _Distance


class StopAtBumper(BaseModel):
    """The car stands with its rear bumper at `x_m`, shifted to the side from its start."""

    model_config = _STRICT
    rule: Literal["rear_bumper_x"]
    x_m: _Distance
    lateral_shift_m: Annotated[float, Field(gt=0.0, le=20.0, allow_inf_nan=False)]


class StopByDisplacement(BaseModel):
    """The car stands ahead of and beside its start by these distances."""

    model_config = _STRICT
    rule: Literal["displacement"]
    ahead_m: Annotated[float, Field(gt=0.0, le=150.0, allow_inf_nan=False)]
    aside_m: Annotated[float, Field(gt=0.0, le=20.0, allow_inf_nan=False)]


class Tolerances(BaseModel):
    """What the examiner still calls right: distance along the course (m), angle to it (rad)."""

    model_config = _STRICT
    stop_distance_m: _Tolerance
    parallel_rad: Annotated[float, Field(gt=0.0, le=0.8, allow_inf_nan=False)]
    completed_within_m: _Tolerance
    source: _Text


MistakeRule = Literal[
    "stop_to_check_progress",
    "cone_bumped",
    "stop_distance_misjudged",
    "not_parallel",
    "cone_knocked_down",
    "wrong_side",
    "not_completed",
]


class ScoredMistake(BaseModel):
    """A line of the score sheet: points lost each time, or failure at once."""

    model_config = _STRICT
    rule: MistakeRule
    points: Annotated[int, Field(ge=0, le=1000)] = 0
    fails: bool = False
    source: _Text


class ScoreSheet(BaseModel):
    """Points at the start, points needed to pass, and what costs how much."""

    model_config = _STRICT
    full: Annotated[int, Field(gt=0, le=1000)]
    pass_: Annotated[int, Field(ge=0, le=1000, alias="pass")]
    source: _Text
    mistakes: list[ScoredMistake]


def _one_line_a_rule(sheet: ScoreSheet) -> ScoreSheet:
    rules = [mistake.rule for mistake in sheet.mistakes]
    for rule in rules:
        if rules.count(rule) > 1:
            raise ValueError(f"the mistake {rule} stands twice")
    if sheet.pass_ > sheet.full:
        raise ValueError(f"pass = {sheet.pass_} is more than full = {sheet.full}")
    return sheet


def _distinct_names(cones: list[Cone]) -> list[Cone]:
    names = [cone.name for cone in cones]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"the name {name!r} stands twice")
    return cones


class Course(BaseModel):
    """A course: cones, start and stop, tolerances and score sheet, as the file gives them for the left side.

    The right side is the mirror image in y of everything, cones included.
    """

    model_config = _STRICT
    name: _Name
    description: _Text
    source: _Text
    frame: _Text
    cone_radius_m: Annotated[float, Field(gt=0.0, le=1.0, allow_inf_nan=False)]
    cones: Annotated[list[Cone], Field(min_length=1, max_length=100), AfterValidator(_distinct_names)]
    start: Annotated[StartAtBumper | StartAtPoint, Field(discriminator="rule")]
    stop: Annotated[StopAtBumper | StopByDisplacement, Field(discriminator="rule")]
    tolerances: Tolerances
    score: Annotated[ScoreSheet, AfterValidator(_one_line_a_rule)]

    def cones_xy(self, side: Side = "left") -> tuple[tuple[float, float], ...]:
        """Axes of the cones, (x, y) in m, in the file's order."""
        sign = 1.0 if side == "left" else -1.0
        return tuple((cone.x_m, sign * cone.y_m) for cone in self.cones)

    def cone_names(self, side: Side = "left") -> tuple[str, ...]:
        """Names of the cones in the file's order; in the mirror image left is right, in the names too."""
        if side == "left":
            return tuple(cone.name for cone in self.cones)
        words = {"left": "right", "right": "left"}
        return tuple("-".join(words.get(word, word) for word in cone.name.split("-")) for cone in self.cones)

    def start_pose(self, vehicle: Vehicle, side: Side = "left") -> Pose:
        """Pose of the rear-axle centre at the start, which is also that of the return."""
        if isinstance(self.start, StartAtBumper):
            return Pose(self.start.x_m - vehicle.wheelbase_m - vehicle.front_overhang_m, 0.0, 0.0)
        behind = vehicle.cg_to_rear_axle_m if self.start.point == "centre_of_gravity" else 0.0
        sign = 1.0 if side == "left" else -1.0
        return Pose(self.start.x_m - behind, sign * self.start.y_m, 0.0)

    def stop_pose(self, vehicle: Vehicle, side: Side = "left") -> Pose:
        """Pose of the rear-axle centre at the forward stop."""
        start = self.start_pose(vehicle, side)
        sign = 1.0 if side == "left" else -1.0
        if isinstance(self.stop, StopAtBumper):
            return Pose(self.stop.x_m + vehicle.rear_overhang_m, start.y_m + sign * self.stop.lateral_shift_m, 0.0)
        return Pose(start.x_m + self.stop.ahead_m, start.y_m + sign * self.stop.aside_m, 0.0)


def load_course(name_or_path: str | Path) -> Course:
    """Read and check a course file."""
    path = find_file("course", name_or_path)
    return _validate(path, Course, _read(path)[1])


def check_fit(vehicle: Vehicle, course: Course) -> None:
    """Raise UserError where the car cannot stand at start or stop without touching a cone, or the stop lies behind."""
    outline = outline_of(vehicle)
    cones = course.cones_xy()
    start, stop = course.start_pose(vehicle), course.stop_pose(vehicle)
    if stop.x_m <= start.x_m:
        raise UserError(
            f"vehicle {vehicle.name} does not fit course {course.name}: the stop would lie "
            f"{start.x_m - stop.x_m:.3f} m behind the start"
        )
    for what, pose in (("start", start), ("stop", stop)):
        clearance, index = clearance_m(outline, *pose, cones)
        if clearance < course.cone_radius_m:
            raise UserError(
                f"vehicle {vehicle.name} does not fit course {course.name}: at the {what} its outline is "
                f"{clearance:.3f} m from the axis of cone {course.cones[index].name}, "
                f"and must be {course.cone_radius_m:.3f} m or more"
            )


# --------------------------------------------------------------------------------------------------------------------
# Scenarios
# --------------------------------------------------------------------------------------------------------------------

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
    raise ValueError(f"{_shown(value)} must be a number or [low, high]")


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
    """How the car differs from what the tables were made for.

    steering_gain: road-wheel angle over command; steering_bias_rad: added at the road wheel, not seen by the steering
    sensor; steering_backlash_rad: whole width of the play between rack and road wheel; steering_command_resolution_rad:
    step of the actuator's converter, 0 = none; longitudinal_latency_samples: dead time of speed and brake commands in
    samples of 10 ms; unknown: vehicle parameters that the true car has instead of the file's nominal ones; corners:
    vehicle parameters that lie at either end of nominal * (1 -/+ spread), one bit of the seed each, lowest bit first.
    """

    model_config = _STRICT
    steering_gain: Annotated[_AnyDraw, AfterValidator(_within(0.5, 1.5))] = (1.0, 1.0)
    steering_bias_rad: Annotated[_AnyDraw, AfterValidator(_within(-0.2, 0.2))] = (0.0, 0.0)
    steering_backlash_rad: Annotated[_AnyDraw, AfterValidator(_within(0.0, 0.2))] = (0.0, 0.0)
    steering_command_resolution_rad: Annotated[_AnyDraw, AfterValidator(_within(0.0, 0.05))] = (0.0, 0.0)
    longitudinal_latency_samples: Annotated[_AnyDraw, AfterValidator(_within(0.0, 100.0))] = (0.0, 0.0)
    unknown: dict[str, _AnyDraw] = {}
    corners: dict[str, Annotated[float, Field(ge=0.0, le=0.9, allow_inf_nan=False)]] = {}


class Sensors(BaseModel):
    """Errors of the sensors.

    position_noise_m (each axis) and yaw_noise_rad are standard deviations a sample, white, or correlated with time
    constant pose_noise_correlation_s; pose_drop_probability: share of pose samples that are not sent; *_resolution_*:
    steps, 0 = none; odometry_scale: 0.01 reads 1 % too much; gyro_bias_walk in rad/s per root second.
    """

    model_config = _STRICT
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


class StartOffset(BaseModel):
    """Where the car stands at the beginning, relative to the course's start pose, in the body frame (m, rad)."""

    model_config = _STRICT
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

    `vehicle_overlay` holds nominal vehicle parameters of this scenario: tables are made from them too, and the
    vehicle hash on the bus covers them. All else is unknown to the controller.
    """

    model_config = _STRICT
    name: _Name
    description: _Text
    vehicle_overlay: dict[str, _Finite] = {}
    plant: PlantDeviation = PlantDeviation()
    sensors: Sensors = Sensors()
    start: StartOffset = StartOffset()
    faults: list[FaultEvent] = []


def load_scenario(name_or_path: str | Path) -> Scenario:
    """Read and check a scenario file."""
    path = find_file("scenario", name_or_path)
    scenario = _validate(path, Scenario, _read(path)[1])
    check_parameters(scenario.vehicle_overlay, f"{path}: vehicle_overlay.")
    for low_or_high in (0, 1):
        check_parameters({k: v[low_or_high] for k, v in scenario.plant.unknown.items()}, f"{path}: plant.unknown.")
    for key, (low, high) in scenario.plant.unknown.items():
        if low > high:
            raise UserError(f"{path}: plant.unknown.{key} = [{low!r}, {high!r}]: the lower end comes first")
    for key in scenario.plant.corners:
        if key not in PARAMETERS:
            raise UserError(f"{path}: plant.corners.{_key(key)}: unknown key; a vehicle has {', '.join(PARAMETERS)}")
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
