"""Load and check the tables: text from the design tools in, numbers for the core out. Runs once, before the loop.

A folder of tables holds `manifest.toml` (what made them, with hashes), `path.csv`, `speed.csv`, one `gains_LAW.csv` a
law, and `car.toml`. Whatever does not fit together is refused with one line that says what to run.
"""

import csv
import hashlib
import math
import tomllib
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

from firmware_py.core import estimator, motion
from firmware_py.core.tables import (
    GAIN_COLUMNS,
    LAW_CAR,
    LAW_PAPER,
    LAW_PLAIN,
    CarTable,
    GainTable,
    LegTable,
    PaperTable,
    ReferencePath,
)
from firmware_py.errors import UserError
from firmware_py.feedforward import slip_feedforward

FORMAT = 3
"""Of the folder's files: the next with each change of their columns."""

REMEDY = "run `parkctl design --update`"

PATH_COLUMNS = ("station_m", "x_m", "y_m", "yaw_rad", "curvature_1pm", "curvature_slope_1pm2")
SPEED_COLUMNS = ("direction", "station_m", "speed_mps", "accel_mps2")
GAINS_COLUMNS = (
    "direction",
    "speed_mps",
    "preview_m",
    "kp",
    "ki",
    "kd",
    "l_o",
    "l_g",
    "l_dr",
    "w_e",
    "w_p",
    "w_d",
)
PAPER_COLUMNS = (
    "direction",
    "speed_mps",
    "preview_m",
    "kp",
    "ki",
    "kd",
    "inverse_gain",
    "inverse_pole",
    "q_b1",
    "q_b2",
    "q_a1",
    "q_a2",
)
LAWS = {"car": LAW_CAR, "pid+ff": LAW_PLAIN, "paper": LAW_PAPER, "dob": LAW_PAPER, "pid": LAW_PAPER}
"""The laws by name. All but `car` take each pose as it comes, and their estimator learns nothing of the car (l_o to w_d
are 0); the paper's laws have the gains of `pid+ff` beside their own table: `paper` both parts, `dob`, `pid` one."""

NO_PAPER = PaperTable((0.0, 1.0), 1, (((0.0,) * 6,) * 2,) * 2, 0.0, 0.0, 0.0, 0.0, 0, 0)
NO_REFERENCE = ReferencePath(0.0, *[((0.0, 0.0),) * 2] * 3)
"""What stands in the tables of the other laws."""

SIDES = {"left": 1.0, "right": -1.0}

CAR_RANGES = {
    "wheelbase_m": (1.0, 10.0),
    "cg_to_rear_axle_m": (0.1, 9.0),
    "mass_kg": (100.0, 50_000.0),
    "yaw_inertia_kgm2": (10.0, 1e6),
    "cornering_stiffness_front_n_per_rad": (1e3, 1e7),
    "cornering_stiffness_rear_n_per_rad": (1e3, 1e7),
    "relaxation_length_m": (0.0, 2.0),
    "steering_lag_s": (0.0, 2.0),
    "pose_latency_samples": (0, estimator.ODOMETRY_LENGTH - 1),
    "command_latency_samples": (0, motion.QUEUE_LENGTH - 2),
    "drive_lag_s": (0.0, 5.0),
    "brake_lag_s": (0.0, 2.0),
    "gear_change_s": (0.0, 10.0),
    "max_road_wheel_angle_rad": (0.05, 1.2),
    "max_road_wheel_rate_radps": (0.01, 10.0),
    "max_speed_mps": (0.05, 3.0),
    "controlled_decel_mps2": (0.1, 5.0),
    "emergency_decel_mps2": (0.1, 10.0),
}
"""Every key of car.toml with its legal range."""


class TableSet(NamedTuple):
    """What a folder of tables holds, for one side and one law."""

    vehicle: str
    course: str
    vehicle_hash24: int
    legs: tuple[LegTable, LegTable]
    gains: GainTable
    car: CarTable
    law: int
    paper: PaperTable
    reference: ReferencePath


def load_tables(folder: Path, side: str, law: str, period_s: float, dbc_folder: Path | None = None) -> TableSet:
    """Return the tables of a folder, the path mirrored for the right side.

    With `dbc_folder`, the files that made the tables are compared with the ones there, where they exist. Errors:
    UserError for a missing, malformed, changed or stale file.
    """
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder of tables; {REMEDY}")
    manifest = _read_toml(folder / "manifest.toml")
    _check_manifest(folder, manifest, dbc_folder)
    car, physics = _load_car(folder / "car.toml", period_s)
    path = _read_csv(folder / "path.csv", PATH_COLUMNS)
    speed = _read_csv(folder / "speed.csv", SPEED_COLUMNS)
    legs = _legs(folder, path, speed, physics, SIDES[side])
    kind, paper, reference = LAWS[law], NO_PAPER, NO_REFERENCE
    gains = _load_gains(folder / gains_file("pid+ff" if kind == LAW_PAPER else law))
    if kind == LAW_PAPER:
        paper = _load_paper(folder / gains_file(law))
        reference = _reference(legs, path, SIDES[side], physics["cg_to_rear_axle_m"])
    return TableSet(
        vehicle=str(manifest["vehicle"]),
        course=str(manifest["course"]),
        vehicle_hash24=int(manifest["vehicle_hash24"]),
        legs=legs,
        gains=gains,
        car=car,
        law=kind,
        paper=paper,
        reference=reference,
    )


def gains_file(law: str) -> str:
    """Return the name of a law's own table."""
    return f"gains_{law.replace('+', '_')}.csv"


def _read_bytes(file: Path) -> bytes:
    try:
        return file.read_bytes()
    except OSError as error:
        raise UserError(f"{file}: cannot be read ({error.strerror}); {REMEDY}") from error


def _read_toml(file: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(_read_bytes(file).decode())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UserError(f"{file}: not a TOML file ({error}); {REMEDY}") from error


def text_sha256(data: bytes) -> str:
    """Return the SHA-256 of a text file, the same whatever its line ends."""
    return hashlib.sha256(data.replace(b"\r\n", b"\n")).hexdigest()


def _check_manifest(folder: Path, manifest: dict[str, Any], dbc_folder: Path | None) -> None:
    file = folder / "manifest.toml"
    for key, kind in (("format", int), ("vehicle", str), ("course", str), ("vehicle_hash24", int), ("files", dict)):
        if not isinstance(manifest.get(key), kind):
            raise UserError(f"{file}: key {key} is missing or no {kind.__name__}; {REMEDY}")
    if manifest["format"] != FORMAT:
        raise UserError(f"{file}: format {manifest['format']}, this controller reads format {FORMAT}; {REMEDY}")
    for name, sha256 in manifest["files"].items():
        if text_sha256(_read_bytes(folder / name)) != sha256:
            raise UserError(f"{folder / name}: changed since the design tools wrote it; {REMEDY}")
    if dbc_folder is None:
        return
    for name, sha256 in manifest.get("inputs", {}).items():
        source = dbc_folder / name
        if source.is_file() and text_sha256(source.read_bytes()) != sha256:
            raise UserError(f"{folder}: tables are stale, {source} has changed since they were made; {REMEDY}")


def _read_csv(file: Path, columns: tuple[str, ...]) -> list[tuple[float, ...]]:
    """Return the rows of a table as floats; comment lines begin with #."""
    try:
        lines = _read_bytes(file).decode().splitlines()
    except UnicodeDecodeError as error:
        raise UserError(f"{file}: not a text file; {REMEDY}") from error
    reader = csv.reader(line for line in lines if line and not line.startswith("#"))
    header = next(reader, [])
    if tuple(header) != columns:
        raise UserError(f"{file}: columns are {','.join(header)}, must be {','.join(columns)}; {REMEDY}")
    rows = []
    for number, fields in enumerate(reader, 1):
        try:
            row = tuple(float(field) for field in fields)
        except ValueError:
            row = ()
        if len(row) != len(columns) or not all(math.isfinite(value) for value in row):
            raise UserError(f"{file}: row {number} does not hold {len(columns)} finite numbers; {REMEDY}")
        rows.append(row)
    if len(rows) < 2:
        raise UserError(f"{file}: needs at least two rows; {REMEDY}")
    return rows


def _load_car(file: Path, period_s: float) -> tuple[CarTable, dict[str, float]]:
    """Return the car's table and all values of car.toml by name."""
    values = _read_toml(file)
    unknown = sorted(set(values) - set(CAR_RANGES))
    if unknown:
        raise UserError(f"{file}: unknown key {unknown[0]}; {REMEDY}")
    for key, (low, high) in CAR_RANGES.items():
        value = values.get(key)
        if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
            raise UserError(f"{file}: {key} is {value}, must be a number from {low} to {high}; {REMEDY}")
    lag_s = float(values["steering_lag_s"])
    alpha, mean_weight, late_weight = motion.lag_weights(lag_s, period_s)
    car = CarTable(
        wheelbase_m=float(values["wheelbase_m"]),
        steering_lag_s=lag_s,
        lag_alpha=alpha,
        lag_mean_weight=mean_weight,
        late_weight=late_weight,
        pose_latency_samples=int(values["pose_latency_samples"]),
        command_latency_samples=int(values["command_latency_samples"]),
        drive_lag_s=float(values["drive_lag_s"]),
        brake_lag_s=float(values["brake_lag_s"]),
        gear_change_s=float(values["gear_change_s"]),
        max_road_wheel_angle_rad=float(values["max_road_wheel_angle_rad"]),
        max_road_wheel_rate_radps=float(values["max_road_wheel_rate_radps"]),
        max_speed_mps=float(values["max_speed_mps"]),
        controlled_decel_mps2=float(values["controlled_decel_mps2"]),
        emergency_decel_mps2=float(values["emergency_decel_mps2"]),
    )
    return car, {key: float(value) for key, value in values.items()}


def _legs(
    folder: Path,
    path: list[tuple[float, ...]],
    speed: list[tuple[float, ...]],
    physics: dict[str, float],
    mirror: float,
) -> tuple[LegTable, LegTable]:
    """Return both legs in travel order; the right side is the exact mirror of the left."""
    station, x, y, yaw, curvature, slope = (list(column) for column in zip(*path, strict=True))
    step_m = station[-1] / (len(station) - 1)
    for row, value in enumerate(station):
        if abs(value - row * step_m) > 1e-6:
            raise UserError(f"{folder / 'path.csv'}: row {row + 1}: stations must be evenly spaced from 0; {REMEDY}")
    legs = []
    for direction in (1.0, -1.0):
        rows = [row for row in speed if row[0] == direction]
        if len(rows) != len(station) or any(abs(row[1] - s) > 1e-6 for row, s in zip(rows, station, strict=True)):
            raise UserError(
                f"{folder / 'speed.csv'}: direction {direction:+.0f} must have the stations of path.csv; {REMEDY}"
            )
        order = 1 if direction > 0 else -1
        travel_curvature = [mirror * value for value in curvature[::order]]
        # Body curvature keeps its sign in reverse; its slope per metre of travel does not.
        travel_slope = [mirror * direction * value for value in slope[::order]]
        slip = slip_feedforward(
            direction,
            step_m,
            travel_curvature,
            travel_slope,
            [row[2] for row in rows],
            [row[3] for row in rows],
            physics,
        )
        legs.append(
            LegTable(
                sigma=direction,
                step_m=step_m,
                length_m=station[-1],
                last_row=len(station) - 1,
                x_m=tuple(x[::order]),
                y_m=tuple(mirror * value for value in y[::order]),
                yaw_rad=tuple(mirror * value for value in yaw[::order]),
                slip_heading_rad=slip.heading_rad,
                slip_curvature_1pm=slip.slip_curvature_1pm,
                feedforward_curvature_1pm=slip.curvature_1pm,
                feedforward_slope_1pm2=slip.slope_1pm2,
                speed_mps=tuple(row[2] for row in rows),
                accel_mps2=tuple(row[3] for row in rows),
            )
        )
    return legs[0], legs[1]


def _by_direction(file: Path, rows: list[tuple[float, ...]]) -> tuple[tuple[float, ...], list[list[tuple[float, ...]]]]:
    """Return the grid of speeds of a schedule, and its rows forward and in reverse."""
    by_direction = [[row for row in rows if row[0] == direction] for direction in (1.0, -1.0)]
    grid = tuple(row[1] for row in by_direction[0])
    if len(grid) < 2 or grid[0] < 0.0 or any(b <= a for a, b in pairwise(grid)):
        raise UserError(f"{file}: speed_mps must increase, none below 0, in direction +1; {REMEDY}")
    if tuple(row[1] for row in by_direction[1]) != grid or len(rows) != 2 * len(grid):
        raise UserError(f"{file}: directions +1 and -1 must have the same speeds and no other rows; {REMEDY}")
    return grid, by_direction


def _load_gains(file: Path) -> GainTable:
    grid, by_direction = _by_direction(file, _read_csv(file, GAINS_COLUMNS))
    if grid[0] != 0.0:
        raise UserError(f"{file}: speed_mps must begin at 0; {REMEDY}")
    gain = tuple(tuple(row[2 : 2 + GAIN_COLUMNS] for row in rows_of) for rows_of in by_direction)
    return GainTable(speed_grid_mps=grid, last_row=len(grid) - 1, gain=gain)


def _load_paper(file: Path) -> PaperTable:
    """Return the table of one of the paper's laws; a part whose columns are all zero is not in it."""
    rows = _read_csv(file, PAPER_COLUMNS)
    grid, by_direction = _by_direction(file, rows)
    for number, row in enumerate(rows, 1):
        for name, value in zip(PAPER_COLUMNS[2:7], row[2:7], strict=True):
            if value < 0.0:
                raise UserError(f"{file}: row {number}: {name} is {value:g}, must not be negative; {REMEDY}")
        if not -1.0 < row[7] < 1.0:
            raise UserError(f"{file}: row {number}: inverse_pole is {row[7]:g}, must be between -1 and 1; {REMEDY}")
        if row[8:] != rows[0][8:]:
            raise UserError(f"{file}: row {number}: q_b1 to q_a2 must be the same in every row; {REMEDY}")
    b1, b2, a1, a2 = rows[0][8:]
    has_observer = any(rows[0][8:])
    if has_observer and not (abs(a2) < 1.0 and abs(a1) < 1.0 + a2 and abs((b1 + b2) / (1.0 + a1 + a2) - 1.0) < 1e-6):
        raise UserError(f"{file}: q_b1 to q_a2 must be a stable filter of gain 1; {REMEDY}")
    return PaperTable(
        speed_grid_mps=grid,
        last_row=len(grid) - 1,
        row=tuple(tuple(row[2:8] for row in rows_of) for rows_of in by_direction),
        q_b1=b1,
        q_b2=b2,
        q_a1=a1,
        q_a2=a2,
        uses_pid=int(any(any(row[3:6]) for row in rows)),
        uses_observer=int(has_observer),
    )


def _reference(
    legs: tuple[LegTable, LegTable], path: list[tuple[float, ...]], mirror: float, ahead_m: float
) -> ReferencePath:
    """Return where the point `ahead_m` ahead of the rear axle goes on both legs."""
    curvature = [mirror * row[4] for row in path]
    x, y, yaw = [], [], []
    for leg, travelled in ((legs[0], curvature), (legs[1], curvature[::-1])):
        x.append(tuple(at + ahead_m * math.cos(heading) for at, heading in zip(leg.x_m, leg.yaw_rad, strict=True)))
        y.append(tuple(at + ahead_m * math.sin(heading) for at, heading in zip(leg.y_m, leg.yaw_rad, strict=True)))
        yaw.append(
            tuple(heading + math.atan(ahead_m * bend) for heading, bend in zip(leg.yaw_rad, travelled, strict=True))
        )
    return ReferencePath(ahead_m, tuple(x), tuple(y), tuple(yaw))
