"""The tables as text: made from vehicle and course files, with hashes of all that made them.

A folder holds `path.csv` (left side), `speed.csv`, one `gains_LAW.csv` a law, `car.toml` and `manifest.toml`. It
appears whole or not at all. The same files give the same tables on the same machine; numbers carry 12 significant
digits.
"""

import hashlib
import os
import shutil
import tempfile
import tomllib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from firmware_py.table_file import FORMAT
from sim.data_files import Course, Vehicle, load_course, load_vehicle
from sim.errors import UserError
from tools.design.gains import COLUMNS as GAINS_COLUMNS
from tools.design.gains import checked_speeds, design_gains
from tools.design.model import PERIOD_S, Row
from tools.design.optimise import PathDesign, max_road_wheel_slope, optimise_path
from tools.design.speed_profile import GRAVITY_MPS2, SpeedLimits, SpeedProfile, plan_speed, road_wheel_slope

ROOT = Path(__file__).resolve().parent.parent.parent
DBC_FOLDER = ROOT / "dbc"
SHIPPED_FOLDER = ROOT / "firmware_py" / "tables"
SHIPPED = (("paper", "ohio"), ("fusion", "ohio"), ("compact", "ohio"), ("pickup", "ohio"), ("paper", "paper"))
"""Vehicles and courses whose tables come with the project."""
STUDY_NAME = "paper-study"
"""Folder of the paper's own manoeuvre (tools.paper.firmware_tables), for the car of scenario `paper`."""

SOURCES = (
    "waypoints",
    "path_fit",
    "path",
    "families",
    "search",
    "optimise",
    "speed_profile",
    "filter",
    "model",
    "box",
    "margins",
    "gains",
    "tables",
)
"""Modules of the design whose text decides the tables."""

# Ride: what the course's passengers and the firmware's stop allow. Sources: the paper's Table 3 for speed and
# accelerations; jerk and the share of the steering rate are this design's, for comfort and for feedback.
MAX_SPEED_MPS = 1.0
MAX_ACCEL_G = 0.05
PLANNED_SPEED_SHARE = 0.98
PLANNED_SHARE = 0.80
"""Shares of the speed and of the accelerations that are planned; the rest is for following: with nothing left, a car
that is behind its profile would start to brake late."""
MAX_JERK_MPS3 = 0.5
MAX_STEER_RATE_RADPS = 0.45
STEER_RATE_SHARE = 0.75

CONTROLLED_DECEL_MPS2 = 1.0
EMERGENCY_DECEL_MPS2 = 2.4

PATH_COLUMNS = ("station_m", "x_m", "y_m", "yaw_rad", "curvature_1pm", "curvature_slope_1pm2")
SPEED_COLUMNS = ("direction", "station_m", "speed_mps", "accel_mps2")


class DesignReport(NamedTuple):
    """What a design came to: path, speed profiles (forward, reverse), gains by law."""

    vehicle: Vehicle
    course: Course
    design: PathDesign
    profiles: tuple[SpeedProfile, SpeedProfile]
    gains: dict[str, list[tuple[float, ...]]]


def folder_name(vehicle: Vehicle, course: Course) -> str:
    """Return the name of the tables' folder."""
    return f"{vehicle.name}-{course.name}"


def tables_folder(vehicle: Vehicle, course: Course) -> Path | None:
    """Return the shipped tables of a vehicle and a course where they are fresh, else None.

    Fresh: made from exactly this vehicle (overlay included), this course file and this design.
    """
    for name in (folder_name(vehicle, course), STUDY_NAME):
        if not stale_inputs(SHIPPED_FOLDER / name, vehicle, course):
            return SHIPPED_FOLDER / name
    return None


def stale_inputs(folder: Path, vehicle: Vehicle, course: Course) -> list[str]:
    """Return what the tables of a folder do not agree with; empty where they are fresh."""
    try:
        manifest = tomllib.loads((folder / "manifest.toml").read_text(encoding="ascii"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError):
        return ["manifest.toml"]
    stale = [] if manifest.get("vehicle_hash24") == vehicle.hash24 else [f"vehicle {vehicle.name}"]
    if manifest.get("course_sha256") != course_sha256(course):
        stale.append(f"course {course.name}")
    if manifest.get("design_sha256") != design_sha256():
        stale.append("tools/design")
    for name, sha256 in manifest.get("files", {}).items():
        file = folder / name
        if not file.is_file() or _sha256(file.read_bytes()) != sha256:
            stale.append(name)
    return stale


def recorded_numbers(folder: Path) -> tuple[float, ...] | None:
    """Return the numbers of the search that the tables of a folder were made from; None where it does not tell."""
    try:
        numbers = tomllib.loads((folder / "manifest.toml").read_text(encoding="ascii"))["path_numbers"]
        return tuple(float(number) for number in numbers)
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError, KeyError, TypeError, ValueError):
        return None


def run_design(vehicle: Vehicle, course: Course, numbers: tuple[float, ...] | None = None) -> DesignReport:
    """Design path, speed and gains. Raises UserError where the car cannot do the course, and says why.

    numbers: those of an earlier search for the path, to make the same tables again; None searches.
    """
    design = optimise_path(vehicle, course, numbers=numbers)
    limits = speed_limits(vehicle)
    profiles = tuple(plan_speed(design.path, vehicle.wheelbase_m, limits, direction) for direction in (1, -1))
    return DesignReport(vehicle, course, design, (profiles[0], profiles[1]), design_gains(vehicle))


def design_tables(vehicle: Vehicle, course: Course, out_dir: Path) -> DesignReport:
    """Design and write the tables into `out_dir`, which is replaced as a whole."""
    report = run_design(vehicle, course)
    write_tables(report, out_dir)
    return report


def speed_limits(vehicle: Vehicle) -> SpeedLimits:
    """Return the limits that the ride is planned within for a car."""
    return SpeedLimits(
        speed_mps=PLANNED_SPEED_SHARE * min(MAX_SPEED_MPS, vehicle.max_speed_mps),
        accel_x_mps2=PLANNED_SHARE * MAX_ACCEL_G * GRAVITY_MPS2,
        accel_y_mps2=PLANNED_SHARE * MAX_ACCEL_G * GRAVITY_MPS2,
        jerk_mps3=MAX_JERK_MPS3,
        road_wheel_rate_radps=min(MAX_STEER_RATE_RADPS, STEER_RATE_SHARE * vehicle.max_road_wheel_rate_radps),
    )


def write_tables(report: DesignReport, out_dir: Path) -> None:
    """Write the tables of a design; the folder appears whole or stays as it was."""
    texts = table_texts(report)
    temporary: Path | None = None
    try:
        out_dir.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{out_dir.name}.", dir=out_dir.parent))
        for name, text in texts.items():
            (temporary / name).write_text(text, encoding="ascii", newline="\n")
        temporary.chmod(0o755)
        old = out_dir.with_name(f".{out_dir.name}.old")
        if out_dir.exists():
            shutil.rmtree(old, ignore_errors=True)
            os.replace(out_dir, old)
        os.replace(temporary, out_dir)
        shutil.rmtree(old, ignore_errors=True)
    except OSError as error:
        if temporary is not None:
            shutil.rmtree(temporary, ignore_errors=True)
        raise UserError(f"{out_dir}: tables cannot be written ({error.strerror})") from error


def table_texts(report: DesignReport) -> dict[str, str]:
    """Return the text of every file of the tables' folder."""
    path = report.design.path
    texts = {
        "path.csv": csv_text(
            "path of the rear-axle centre, forward, left side; the right side is its mirror in y",
            PATH_COLUMNS,
            zip(*path, strict=True),
        ),
        "speed.csv": csv_text(
            "speed along travel by station of the leg, direction +1 forward and -1 reverse",
            SPEED_COLUMNS,
            (
                (direction, *row)
                for direction, profile in zip((1, -1), report.profiles, strict=True)
                for row in zip(profile.station_m, profile.speed_mps, profile.accel_mps2, strict=True)
            ),
        ),
        "car.toml": _car_text(report.vehicle),
    }
    for law, rows in report.gains.items():
        texts[f"gains_{law}.csv"] = csv_text(
            "PID (curvature per metre of travel) and observer coefficients (per 10 ms cycle) by direction and speed",
            GAINS_COLUMNS,
            rows,
        )
    from tools.paper.firmware_tables import law_texts  # noqa: PLC0415 -- it is made of the design's own pieces

    texts |= law_texts(report.vehicle)
    texts["manifest.toml"] = _manifest_text(report, texts)
    return texts


def _number(value: float) -> str:
    """Return 12 significant digits, shortest form; -0 is 0."""
    return format(float(value) + 0.0, ".12g")


def csv_text(what: str, columns: Sequence[str], rows: Iterable[Sequence[float]]) -> str:
    """Return a table as text, with what it is in its first line."""
    lines = [f"# {what}", "# GENERATED by `parkctl design`; do not edit", ",".join(columns)]
    lines += [",".join(_number(value) for value in row) for row in rows]
    return "\n".join(lines) + "\n"


def _car_text(vehicle: Vehicle) -> str:
    lines = ["# What the firmware knows of the car. GENERATED by `parkctl design`; do not edit"]
    names = (
        "wheelbase_m",
        "cg_to_rear_axle_m",
        "mass_kg",
        "yaw_inertia_kgm2",
        "cornering_stiffness_front_n_per_rad",
        "cornering_stiffness_rear_n_per_rad",
        "relaxation_length_m",
        "steering_lag_s",
        "drive_lag_s",
        "brake_lag_s",
        "gear_change_s",
        "max_road_wheel_angle_rad",
        "max_road_wheel_rate_radps",
    )
    lines += [f"{name} = {float(getattr(vehicle, name))!r}" for name in names]
    # The control cycle works in whole samples.
    lines += [
        f"{name} = {round(getattr(vehicle, name))}" for name in ("pose_latency_samples", "command_latency_samples")
    ]
    lines.append(f"max_speed_mps = {min(MAX_SPEED_MPS, vehicle.max_speed_mps)!r}")
    lines.append(f"controlled_decel_mps2 = {CONTROLLED_DECEL_MPS2!r}")
    lines.append(f"emergency_decel_mps2 = {min(EMERGENCY_DECEL_MPS2, vehicle.max_decel_mps2)!r}")
    return "\n".join(lines) + "\n"


def _manifest_text(report: DesignReport, texts: dict[str, str]) -> str:
    vehicle, course = report.vehicle, report.course
    lines = [
        "# What made these tables. GENERATED by `parkctl design`; do not edit",
        f"format = {FORMAT}",
        f'vehicle = "{vehicle.name}"',
        f'course = "{course.name}"',
        f"vehicle_hash24 = {vehicle.hash24}",
        f'course_sha256 = "{course_sha256(course)}"',
        f'design_sha256 = "{design_sha256()}"',
        f"path_numbers = {list(report.design.numbers)!r} # what the search found; --check starts from them",
        "",
        "[inputs] # files under dbc/ that the firmware compares where it finds them",
    ]
    for kind, name in (("vehicle", vehicle.name), ("course", course.name)):
        file = DBC_FOLDER / f"{kind}s" / f"{name}.toml"
        if file.is_file() and _is_shipped(kind, vehicle, course):
            lines.append(f'"{kind}s/{name}.toml" = "{_sha256(file.read_bytes())}"')
    lines += ["", "[files]", *(f'"{name}" = "{_sha256(text.encode())}"' for name, text in texts.items())]
    return "\n".join(lines) + "\n"


def _is_shipped(kind: str, vehicle: Vehicle, course: Course) -> bool:
    """Return whether a vehicle or course is the one that comes with the project, not a user's of the same name."""
    if kind == "vehicle":
        return load_vehicle(vehicle.name).file_bytes == vehicle.file_bytes
    return course_sha256(load_course(course.name)) == course_sha256(course)


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data.replace(b"\r\n", b"\n")).hexdigest()


def course_sha256(course: Course) -> str:
    """Return a hash of what a course file says, comments and layout left out."""
    return hashlib.sha256(course.model_dump_json().encode()).hexdigest()


def design_sha256() -> str:
    """Return a hash of the design's own source: other code makes other tables."""
    digest = hashlib.sha256()
    for name in SOURCES:
        digest.update((Path(__file__).with_name(f"{name}.py").read_bytes()).replace(b"\r\n", b"\n"))
    return digest.hexdigest()


def shipped_pairs(vehicle: str | None = None, course: str | None = None) -> list[tuple[Vehicle, Course]]:
    """Return the shipped pairs, or those of the given names."""
    return [
        (load_vehicle(v), load_course(c))
        for v, c in SHIPPED
        if (vehicle is None or v == vehicle) and (course is None or c == course)
    ]


LEAST_DIFFERENCE = 1e-10
"""Difference, in the unit of any column, that is never more than rounding."""


def differences(made: dict[str, str], folder: Path, relative: float = 1e-9) -> list[str]:
    """Return, a line each, where the tables of a folder differ from texts made now by more than rounding."""
    found = []
    for name, text in made.items():
        if name == "manifest.toml":
            continue
        file = folder / name
        if not file.is_file():
            found.append(f"{name}: missing")
            continue
        ours, theirs = text.splitlines(), file.read_text(encoding="ascii").splitlines()
        if len(ours) != len(theirs):
            found.append(f"{name}: {len(theirs)} lines, made now: {len(ours)}")
        for number, (new, old) in enumerate(zip(ours, theirs, strict=False), 1):
            if new != old and not _nearly_equal(new, old, relative):
                found.append(f"{name}:{number}: {old}  made now: {new}")
                break
    extra = sorted({file.name for file in folder.glob("*")} - set(made)) if folder.is_dir() else []
    return found + [f"{name}: not one of the tables" for name in extra]


def _nearly_equal(new: str, old: str, relative: float) -> bool:
    try:
        pairs = [(float(a), float(b)) for a, b in zip(new.split(","), old.split(","), strict=True)]
    except ValueError:
        return False
    return all(abs(a - b) <= relative * max(abs(a), abs(b)) + LEAST_DIFFERENCE for a, b in pairs)


def gains_at_top_speed(report: DesignReport) -> dict[str, float]:
    """Return the PID of the law `car` forward at the car's top speed, and how fast it learns the steering's gain."""
    speed_mps = checked_speeds(report.vehicle)[-1]
    row = next(row for row in map(Row._make, report.gains["car"]) if row[:2] == (1.0, speed_mps))
    return {
        "speed_mps": speed_mps,
        "kp_1pm2": row.kp,
        "ki_1pm3": row.ki,
        "kd_1pm": row.kd,
        "steering_gain_rate_1pm": row.l_g / (speed_mps * PERIOD_S),
    }


def as_json(report: DesignReport, certificate: Any) -> dict[str, Any]:
    """Return the figures of a design for `--json`; `certificate` is that of tools.design.certificate, or None."""
    path = report.design.path
    figures: dict[str, Any] = {
        "vehicle": report.vehicle.name,
        "course": report.course.name,
        "path": {
            "max_curvature_1pm": float(abs(path.curvature_1pm).max()),
            "max_curvature_slope_1pm2": float(abs(path.curvature_slope_1pm2).max()),
            "max_road_wheel_angle_rad": report.design.max_road_wheel_angle_rad,
            "max_road_wheel_slope_radpm": max_road_wheel_slope(report.design, report.vehicle.wheelbase_m),
            "max_road_wheel_rate_radps": max(
                float(abs(profile.speed_mps * road_wheel_slope(path, report.vehicle.wheelbase_m)[::sign]).max())
                for profile, sign in zip(report.profiles, (1, -1), strict=True)
            ),
            "min_clearance_m": report.design.clearance_m,
            "min_body_clearance_m": report.design.body_clearance_m,
            "nearest_cone": report.design.nearest_cone,
            "length_m": path.length_m,
            "duration_s": [profile.duration_s for profile in report.profiles],
            "constraint_residual": report.design.fit.constraint_residual,
        },
    }
    figures["gains"] = gains_at_top_speed(report)
    if certificate is not None:
        figures["certificate"] = certificate._asdict()
    return figures
