"""The whole study: every run and every figure that tables, pictures and page are made of, computed once."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from sim.body import Outline, clearance_array_m, outline_of
from sim.data_files import Course, Vehicle
from tools.design.path import Path
from tools.design.waypoints import Floats
from tools.paper import firmware_law, in_lockstep, path_study, rear_axle
from tools.paper.firmware_law import FirmwareRun
from tools.paper.fit import StoredFit, gains_for
from tools.paper.in_lockstep import Runs
from tools.paper.laws import BOTH, DOB, LAWS, Gains, Law, Observer
from tools.paper.path_study import AS_PRINTED, VARIANTS, Choice, PathResult
from tools.paper.plant import CORRECTED as CORRECTED_SIGN
from tools.paper.plant import FORWARD, PRINTED, REVERSE, PaperCar, Plant, car_of
from tools.paper.rates import Rates, study_rates
from tools.paper.rear_axle import RearAxleRun
from tools.paper.simulate import STEP_S, Figures, Run, Steps, figures_of, simulate
from tools.paper.speed import TABLE_3, Motion, Schedule, motion
from tools.paper.track import Track, track_of

CLEARANCE_STEP = 20  # of the simulation's steps

TABLE_5, TABLE_6, TABLE_6_CORRECTED = "table5", "table6", "table6_corrected"
CASES: dict[str, tuple[str, str]] = {
    TABLE_5: (FORWARD, PRINTED),
    TABLE_6: (REVERSE, PRINTED),
    TABLE_6_CORRECTED: (REVERSE, CORRECTED_SIGN),
}
"""Table: direction, sign of eq. 11's rear steering."""


class Result(NamedTuple):
    """One simulation: its histories, its figures, clearance to each cone (n / 20, cones) and the least of them."""

    run: Run
    figures: Figures
    clearance_m: Floats
    min_clearance_m: float


class Leaving(NamedTuple):
    """Where a diverging run leaves what it should keep to: travelled distances m, None where it does not.

    room: the true error exceeds what the box of cones leaves beside the body; cone: the body touches a cone that it
    would not touch on the path; angle: the steering passes 90 degrees, which no wheel turns to.
    """

    room_m: float | None
    cone_m: float | None
    angle_m: float | None


class Study(NamedTuple):
    """All results of one car. `results[table][law]`; paths by variant; the rear-axle law by direction."""

    vehicle: Vehicle
    course: Course
    car: PaperCar
    outline: Outline
    stored: StoredFit
    gains: Gains
    schedule: Schedule
    paths: dict[str, PathResult]
    choices: list[Choice]
    choices_corrected: list[Choice]
    tracks: dict[str, Track]
    motions: dict[str, Motion]
    results: dict[str, dict[str, Result]]
    leaving: dict[str, Leaving]
    room_m: float
    rear_path: Path
    rear_runs: dict[str, RearAxleRun]
    rates: Rates
    convergence: dict[float, Figures]
    firmware: list[FirmwareRun]
    lockstep: Runs
    observers: dict[Observer, Figures]


def compute(vehicle: Vehicle, course: Course, stored: StoredFit, tell: Callable[[str], None]) -> Study:
    """Run the whole study for a car; takes about a minute."""
    car = car_of(vehicle)
    outline = outline_of(vehicle)
    gains = gains_for(car, stored)
    tell("path: eq. 9 in four variants, sweep of m, p, q")
    paths = path_study.all_variants(stored.waypoints)
    path = paths[AS_PRINTED].path
    tracks = {direction: track_of(path, direction) for direction in (FORWARD, REVERSE)}
    motions = {d: motion(t.station_m, t.curvature_1pm, TABLE_3, STEP_S) for d, t in tracks.items()}
    results: dict[str, dict[str, Result]] = {}
    for table, (direction, sign) in CASES.items():
        tell(f"simulations of {table.replace('_', ', ')}: {', '.join(LAWS)}")
        results[table] = {
            name: drive(
                vehicle, course, Plant(car, direction, sign), Law(name, gains), tracks[direction], motions[direction]
            )
            for name in LAWS
        }
    room_m = box_half_width_m(course) - outline.half_width_m
    leaving = {name: leaving_of(result, room_m, course) for name, result in results[TABLE_6_CORRECTED].items()}
    tell("rear-axle law on the same plant")
    rear_path = rear_axle.rear_axle_path(vehicle, course)
    rear_runs = {}
    for direction, sign in ((FORWARD, PRINTED), (REVERSE, CORRECTED_SIGN)):
        track = track_of(rear_path, direction)
        rear_runs[direction] = rear_axle.drive(
            Plant(car, direction, sign), track, motion(track.station_m, track.curvature_1pm, TABLE_3, STEP_S)
        )
    tell("steering rates: starts, ends of the path, steps")
    return Study(
        vehicle, course, car, outline, stored, gains, TABLE_3, paths,
        path_study.sweep(stored.waypoints, VARIANTS[0]), path_study.sweep(stored.waypoints, VARIANTS[-1]),
        tracks, motions, results, leaving, room_m, rear_path, rear_runs, study_rates(car, gains, paths),
        convergence(car, gains, tracks[FORWARD]), firmware_law.study(car, gains, tracks),
        in_lockstep.study(vehicle, course, stored, tracks, tell), observer_choices(car, gains, tracks[FORWARD]),
    )  # fmt: skip


def convergence(car: PaperCar, gains: Gains, track: Track) -> dict[float, Figures]:
    """PID + DOB forward at steps of 4 ms down to 0.5 ms: the figures must not depend on the step."""
    found = {}
    for step_s in (4e-3, 2e-3, 1e-3, 5e-4):
        plan = motion(track.station_m, track.curvature_1pm, TABLE_3, step_s)
        found[step_s] = figures_of(simulate(Steps(Plant(car), Law(BOTH, gains), step_s), track, plan))
    return found


def observer_choices(car: PaperCar, gains: Gains, track: Track) -> dict[Observer, Figures]:
    """DOB alone, forward, with other bandwidths and other nominal factors than the paper's."""
    plan = motion(track.station_m, track.curvature_1pm, TABLE_3, STEP_S)
    choices = [Observer(bandwidth_radps=w) for w in (10.0, 30.0, 100.0, 300.0)]
    choices += [Observer(nominal_factor=factor) for factor in (0.7, 1.0, 1.3)]
    return {
        choice: figures_of(simulate(Steps(Plant(car), Law(DOB, gains, choice), STEP_S), track, plan))
        for choice in choices
    }


def drive(vehicle: Vehicle, course: Course, plant: Plant, law: Law, track: Track, plan: Motion) -> Result:
    """Simulate one law and judge it: figures, and the body's clearance to the cones."""
    run = simulate(Steps(plant, law, plan.step_s), track, plan)
    clearance = clearances(vehicle, course, plant.direction, run.x_m, run.y_m, run.yaw_rad)
    return Result(run, figures_of(run), clearance, float(clearance.min()))


def clearances(vehicle: Vehicle, course: Course, direction: str, x_m: Floats, y_m: Floats, yaw_rad: Floats) -> Floats:
    """Clearance of the body to each cone, shape (n / 20, cones), from poses of the centre of gravity in travel."""
    every = slice(None, None, CLEARANCE_STEP)
    body_yaw = yaw_rad[every] - (0.0 if direction == FORWARD else np.pi)
    behind = vehicle.cg_to_rear_axle_m
    x, y = x_m[every] - behind * np.cos(body_yaw), y_m[every] - behind * np.sin(body_yaw)
    return np.asarray(clearance_array_m(outline_of(vehicle), x, y, body_yaw, course.cones_xy()))


def box_half_width_m(course: Course) -> float:
    """Distance of the box's cones from its middle line: the widest cones of the course."""
    return max(abs(y) for _, y in course.cones_xy())


def leaving_of(result: Result, room_m: float, course: Course) -> Leaving:
    """Find where a run leaves its room, its cones and the possible angles."""
    run = result.run
    touched = result.clearance_m < course.cone_radius_m
    # A cone that stands in the way of the path itself is not this law's fault.
    spared = np.array([name != "point" for name in course.cone_names()])
    travelled = run.travelled_m[::CLEARANCE_STEP]
    return Leaving(
        _first(run.travelled_m, np.abs(run.cross_track_error_m) > room_m),
        _first(travelled, (touched & spared).any(axis=1)),
        _first(run.travelled_m, np.abs(run.steer_rad) > 0.5 * np.pi),
    )


def _first(travelled_m: Floats, condition: npt.NDArray[np.bool_]) -> float | None:
    where = np.flatnonzero(condition)
    return float(travelled_m[where[0]]) if len(where) else None
