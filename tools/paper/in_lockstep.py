"""What is left of Tables 5 and 6 in the real controller: its core, codecs and frames against the emulator's eq. 11.

Whole manoeuvres in lock-step (`tools.lockstep`), both legs, on the paper's path as printed. A report is as old as the
bus makes it when its command acts; one sample more is a latency of the car that the tables do not know.
"""

import math
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from firmware_py.core.signals import MODE_FAULT
from firmware_py.reasons import TEXT
from sim.data_files import Course, Scenario, Vehicle, load_scenario
from tools.design import tables as design_tables
from tools.design.waypoints import Floats
from tools.figures import Leg, Truth, load_path, load_preview, split_legs, truth_of_rows
from tools.lockstep import COMPUTE_NS, LONGEST_S, PERIOD_NS, LockstepRun, run_lockstep
from tools.paper.firmware_law import NAMES
from tools.paper.firmware_tables import SCENARIO, study_report
from tools.paper.fit import StoredFit, load_fit
from tools.paper.plant import CORRECTED, FORWARD, PREVIEW_TIME_S, PRINTED
from tools.paper.track import Track, project

CAR = "car"


class Delay(NamedTuple):
    """How old a report is when its command acts: before the cycle (ms), and whole samples in the car."""

    phase_ms: float
    samples: int

    @property
    def total_ms(self) -> float:
        """All of it."""
        return self.phase_ms + 1e-6 * COMPUTE_NS + 1e-6 * PERIOD_NS * self.samples


BUS, LATE = Delay(3.0, 0), Delay(3.0, 1)
"""As on the bus; one sample more, unknown to the law."""

CASES = (
    *((law, PRINTED, delay) for law in NAMES for delay in (BUS, LATE)),
    *((law, CORRECTED, BUS) for law in NAMES),
    *((CAR, CORRECTED, delay) for delay in (BUS, LATE)),
)
"""Law, sign of eq. 11 in reverse, delay: each is a run."""

START_M = 0.5
"""What belongs to the start: eq. 11's speeds begin at 0.1 m/s, a car's at 0, and a path with free ends begins bent."""


STEERING_LAG_S = 0.02
FORWARD_S = 30.0
"""Virtual time within which the forward leg is over."""


def real_parts(vehicle: Vehicle) -> dict[str, dict[str, object]]:
    """What a car has that eq. 11 has not, one at a time: name, and the changes in the scenario's plant."""
    rate, length = vehicle.max_road_wheel_rate_radps, vehicle.relaxation_length_m
    unknown = {
        f"a steering lag of {1e3 * STEERING_LAG_S:g} ms": {"steering_lag_s": STEERING_LAG_S},
        f"its own rack of {rate:g} rad/s": {"max_road_wheel_rate_radps": rate},
    }
    parts: dict[str, dict[str, object]] = {
        name: {"unknown": {key: (value, value) for key, value in of.items()}} for name, of in unknown.items()
    }
    parts[f"its own tyres, relaxing over {length:g} m"] = {
        "model": "nonlinear",
        "unknown": {"relaxation_length_m": (length, length)},
    }
    return parts


class LegRow(NamedTuple):
    """One leg of one run; e_y and cross_track are the centre of gravity's, true figures of the plant.

    `*_after_start_*` leave out the first START_M, `max_rear_cross_track_m`: that of the rear axle against its own
    path. `is_complete`: the leg came to its stop; `travelled_m`: how far it came; `reason`: why the controller
    stopped the car, by its number, 0 where it did not. `part`: the real part that the car has, "" for none.
    """

    law: str
    reverse_sign: str
    delay_ms: float
    direction: str
    max_e_y_m: float
    max_e_y_after_start_m: float
    rms_e_y_m: float
    max_steer_rad: float
    max_steer_rate_cmd_after_start_radps: float
    max_cross_track_m: float
    max_rear_cross_track_m: float
    min_clearance_m: float
    travelled_m: float
    is_complete: bool
    reason: int
    part: str


class LegRun(NamedTuple):
    """A leg's figures and histories (n,): station m, e_y m and true error m of the centre of gravity, angle rad."""

    row: LegRow
    station_m: Floats
    e_y_m: Floats
    cross_track_error_m: Floats
    steer_rad: Floats


class Manoeuvre(NamedTuple):
    """What all runs have in common: car with the scenario's overlay, course, the tracks of the centre of gravity."""

    vehicle: Vehicle
    course: Course
    scenario: Scenario
    folder: Path
    tracks: dict[str, Track]


class Runs(NamedTuple):
    """All legs of all cases, and the forward legs with one real part of the car each."""

    legs: list[LegRun]
    with_part: list[LegRun]


def study(
    vehicle: Vehicle, course: Course, stored: StoredFit, tracks: dict[str, Track], tell: Callable[[str], None]
) -> Runs:
    """Drive every case; `vehicle` is as its file has it. Tables that are not shipped are made now (15 s)."""
    scenario = load_scenario(SCENARIO)
    car = vehicle.with_overlay(scenario.vehicle_overlay)
    with tempfile.TemporaryDirectory(prefix="parkctl-paper-") as temporary:
        shipped = design_tables.tables_folder(car, course) if stored == load_fit() else None
        folder = shipped or Path(temporary) / "tables"
        if shipped is None:
            tell("the controller's tables for this car")
            design_tables.write_tables(study_report(car, course, stored), folder)
        setting = Manoeuvre(car, course, scenario, folder, tracks)
        runs: list[LegRun] = []
        for law, sign, delay in CASES:
            tell(f"the controller in lock-step: law {law}, {sign} sign, {delay.total_ms:g} ms")
            runs += drive(setting, law, sign, delay)
        with_part: list[LegRun] = []
        for part, changes in real_parts(vehicle).items():
            tell(f"the controller in lock-step: eq. 11 with {part}")
            for law in NAMES:
                with_part += drive(setting, law, CORRECTED, BUS, part=part, changes=changes)
    return Runs(runs, with_part)


def drive(
    setting: Manoeuvre, law: str, sign: str, delay: Delay, *, part: str = "", changes: dict[str, object] | None = None
) -> list[LegRun]:
    """Drive one manoeuvre from the path's first point; one entry a leg. With a real part: `changes`, forward alone."""
    path = load_path(setting.folder, "left")
    scenario = _scenario(setting, sign, delay, changes or {})
    longest_s = FORWARD_S if part else LONGEST_S
    run = run_lockstep(
        setting.vehicle, setting.course, scenario, "left", 0, law, setting.folder,
        phase_ms=delay.phase_ms, longest_s=longest_s,
    )  # fmt: skip
    truth = truth_of_rows(run.truth)
    legs = split_legs(truth, path, load_preview(setting.folder, law))
    kept = legs[:1] if part else legs
    return [_leg_run(setting, law, sign, delay, part, run, truth, leg, leg is legs[-1]) for leg in kept]


def _scenario(setting: Manoeuvre, sign: str, delay: Delay, changes: dict[str, object]) -> Scenario:
    scenario = setting.scenario
    plant = scenario.plant.model_copy(update={"reverse_sign": sign, **changes})
    if delay.samples:
        late = float(delay.samples)
        plant = plant.model_copy(update={"unknown": {**plant.unknown, "command_latency_samples": (late, late)}})
    path, pose = load_path(setting.folder, "left"), setting.course.start_pose(setting.vehicle)
    ahead, aside = float(path.x_m[0]) - pose.x_m, float(path.y_m[0]) - pose.y_m
    heading = float(path.yaw_rad[0]) - pose.yaw_rad
    start = {"ahead_m": (ahead, ahead), "aside_m": (aside, aside), "heading_rad": (heading, heading)}
    return scenario.model_copy(update={"plant": plant, "start": scenario.start.model_copy(update=start)})


def _leg_run(
    setting: Manoeuvre, law: str, sign: str, delay: Delay, part: str, run: LockstepRun, truth: Truth, leg: Leg,
    is_last: bool,
) -> LegRun:  # fmt: skip
    rows = leg.rows
    e_y, cross, station = centre_errors(
        setting.tracks[leg.direction], truth, rows, leg.direction, setting.vehicle.cg_to_rear_axle_m
    )
    # The last leg of a run that ends early is the one in which the controller stopped the car.
    stopped = is_last and run.controller["mode"] == MODE_FAULT
    later = station > START_M
    rate = np.abs(np.diff(truth.road_wheel_angle_cmd_rad[rows], prepend=truth.road_wheel_angle_cmd_rad[rows.start]))
    row = LegRow(
        law,
        sign,
        delay.total_ms,
        leg.direction,
        float(np.abs(e_y).max()),
        float(np.abs(e_y[later]).max(initial=0.0)),
        float(np.sqrt(np.mean(e_y * e_y))),
        float(np.abs(truth.road_wheel_angle_rad[rows]).max()),
        float(rate[later].max(initial=0.0) / (1e-9 * PERIOD_NS)),
        float(np.abs(cross).max()),
        float(np.abs(leg.on_path.cross_track_error_m).max()),
        float(truth.min_clearance_m[rows].min()),
        float(station[-1]),
        not stopped,
        int(run.controller["reason"]) if stopped else 0,
        part,
    )
    return LegRun(row, station, e_y, cross, truth.road_wheel_angle_rad[rows])


def centre_errors(
    track: Track, truth: Truth, rows: slice, direction: str, ahead_m: float
) -> tuple[Floats, Floats, Floats]:
    """e_y, true error (both left of travel, m) and station (m) of the centre of gravity, `ahead_m` before the axle."""
    yaw = truth.yaw_rad[rows]
    x, y = truth.x_m[rows] + ahead_m * np.cos(yaw), truth.y_m[rows] + ahead_m * np.sin(yaw)
    nearest = [int(np.argmin((track.x_m - a) ** 2 + (track.y_m - b) ** 2)) for a, b in zip(x, y, strict=True)]
    on_path = project(track, x, y, track.station_m[nearest])
    travel_yaw = yaw + (0.0 if direction == FORWARD else math.pi)
    heading = travel_yaw - on_path.yaw_rad
    preview = PREVIEW_TIME_S * np.abs(truth.speed_mps[rows])
    return on_path.cross_track_error_m + preview * np.sin(heading), on_path.cross_track_error_m, on_path.station_m


def find(runs: list[LegRun], law: str, sign: str, delay: Delay, direction: str) -> LegRun | None:
    """The leg of a case, None where its run did not come to it."""
    for run in runs:
        row = run.row
        if (row.law, row.reverse_sign, row.delay_ms, row.direction) == (law, sign, delay.total_ms, direction):
            return run
    return None


def reason_text(row: LegRow) -> str:
    """Why the controller stopped the car, in words; empty where it did not."""
    return "" if row.is_complete else TEXT[row.reason]
