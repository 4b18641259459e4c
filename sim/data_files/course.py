"""Course files: cones, start, stop and score sheet; where a car stands at start and stop, and whether it fits."""

from pathlib import Path
from typing import Annotated, Literal, NamedTuple

from pydantic import AfterValidator, BaseModel, Field

from sim.body import clearance_m, outline_of
from sim.data_files.reading import STRICT, Name, Text, find_file, read_toml, validate
from sim.data_files.vehicle import Vehicle
from sim.errors import UserError

Side = Literal["left", "right"]
SIDES: tuple[Side, Side] = ("left", "right")


class Pose(NamedTuple):
    """Pose of the rear-axle centre in the course frame: x, y in m, yaw in rad."""

    x_m: float
    y_m: float
    yaw_rad: float


_Distance = Annotated[float, Field(ge=-150.0, le=150.0, allow_inf_nan=False)]  # what LOC_Position can carry
_Tolerance = Annotated[float, Field(gt=0.0, le=10.0, allow_inf_nan=False)]


class Cone(BaseModel):
    """A cone of the course: name and axis (m, course frame)."""

    model_config = STRICT
    name: Name
    x_m: _Distance
    y_m: _Distance


class StartAtBumper(BaseModel):
    """The car stands on the x axis with its front bumper at `x_m`."""

    model_config = STRICT
    rule: Literal["front_bumper_x"]
    x_m: _Distance


class StartAtPoint(BaseModel):
    """The car stands parallel to the x axis with the named point at (x_m, y_m)."""

    model_config = STRICT
    rule: Literal["reference_point"]
    point: Literal["rear_axle", "centre_of_gravity"]
    x_m: _Distance
    y_m: _Distance


class StopAtBumper(BaseModel):
    """The car stands with its rear bumper at `x_m`, shifted to the side from its start."""

    model_config = STRICT
    rule: Literal["rear_bumper_x"]
    x_m: _Distance
    lateral_shift_m: Annotated[float, Field(gt=0.0, le=20.0, allow_inf_nan=False)]


class StopByDisplacement(BaseModel):
    """The car stands ahead of and beside its start by these distances."""

    model_config = STRICT
    rule: Literal["displacement"]
    ahead_m: Annotated[float, Field(gt=0.0, le=150.0, allow_inf_nan=False)]
    aside_m: Annotated[float, Field(gt=0.0, le=20.0, allow_inf_nan=False)]


class Tolerances(BaseModel):
    """What the examiner still calls right: distance along the course (m), angle to it (rad)."""

    model_config = STRICT
    stop_distance_m: _Tolerance
    parallel_rad: Annotated[float, Field(gt=0.0, le=0.8, allow_inf_nan=False)]
    completed_within_m: _Tolerance
    source: Text


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

    model_config = STRICT
    rule: MistakeRule
    points: Annotated[int, Field(ge=0, le=1000)] = 0
    fails: bool = False
    source: Text


class ScoreSheet(BaseModel):
    """Points at the start, points needed to pass, and what costs how much."""

    model_config = STRICT
    full: Annotated[int, Field(gt=0, le=1000)]
    pass_: Annotated[int, Field(ge=0, le=1000, alias="pass")]
    source: Text
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

    model_config = STRICT
    name: Name
    description: Text
    source: Text
    frame: Text
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
    return validate(path, Course, read_toml(path)[1])


def check_fit(vehicle: Vehicle, course: Course) -> None:
    """Raise UserError where the car cannot stand at start or stop without touching a cone, or the stop lies behind."""
    start, stop = course.start_pose(vehicle), course.stop_pose(vehicle)
    if stop.x_m <= start.x_m:
        raise UserError(
            f"vehicle {vehicle.name} does not fit course {course.name}: the stop would lie "
            f"{start.x_m - stop.x_m:.3f} m behind the start"
        )
    clearance, index, where = _room_standing(vehicle, course)
    if clearance < course.cone_radius_m:
        raise UserError(
            f"vehicle {vehicle.name} does not fit course {course.name}: at the {where} its outline is "
            f"{clearance:.3f} m from the axis of cone {course.cones[index].name}, "
            f"and must be {course.cone_radius_m:.3f} m or more{_too_much(vehicle, course)}"
        )


def _room_standing(vehicle: Vehicle, course: Course) -> tuple[float, int, str]:
    """Return the least clearance at start and stop in m, the cone's index, and where it is."""
    outline, cones = outline_of(vehicle), course.cones_xy()
    poses = (("start", course.start_pose(vehicle)), ("stop", course.stop_pose(vehicle)))
    return min((*clearance_m(outline, *pose, cones), where) for where, pose in poses)


def _too_much(vehicle: Vehicle, course: Course) -> str:
    """Return which dimension keeps the car from standing between the cones, if one does: that of the least change."""
    best: tuple[float, str] | None = None
    for name in ("mirror_width_m", "body_width_m", "front_overhang_m", "rear_overhang_m"):
        value = float(getattr(vehicle, name))
        for percent in range(99, 0, -1):
            overlay = {name: 0.01 * percent * value}
            if name == "body_width_m" and vehicle.mirror_width_m <= vehicle.body_width_m:
                overlay["mirror_width_m"] = overlay[name]
            try:
                other = vehicle.with_overlay(overlay)
            except UserError:
                break
            if _room_standing(other, course)[0] >= course.cone_radius_m:
                if best is None or percent > best[0]:
                    best = (percent, f"; {name} = {value:.3f} prevents it ({overlay[name]:.3f} would do)")
                break
    return best[1] if best else ""
