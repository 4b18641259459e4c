"""One run with one law: what all runs of a scenario share, the loop compiled, and the figures of a run."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path as FilePath
from typing import Any, NamedTuple

import numpy as np

from firmware_py.core.tables import Tables
from sim import examiner
from sim.data_files import Course, Scenario, Side, Vehicle
from sim.examiner import Notes, begin_notes
from sim.sensors import NoiseRows
from tools.campaign import manoeuvre
from tools.campaign.manoeuvre import END_SLOTS, ERRORS_A_LEG, LEG_FIGURES, MAX_TRACE_COLUMNS, Path, Records
from tools.campaign.single import ROWS, Shared, share
from tools.campaign.world import TICK_MODULES, array_world, as_arrays, begin
from tools.compare import gains, laws, steered
from tools.compare.mpc import Mpc, callback, no_solver
from tools.compare.steered import MEMORY_SLOTS, Steered, jitter_rad
from tools.compiled import array_tables, cache_folder, cached_njit, compile_modules, core_modules

RAW, ESTIMATOR = "raw", "estimator"
INPUTS = (RAW, ESTIMATOR)

LIFTED = {
    "firmware_py.core.health": {"OFF_PATH_M": 1e3, "OFF_PATH_HEADING_RAD": 1e3, "STEERING_GAP_RAD": 1e3},
}
"""Limits at which the firmware would stop the car: out of the way here, so that a law that goes far off its path is
measured to the end of the manoeuvre instead of being stopped."""

MODULES = (
    *TICK_MODULES,
    *core_modules(),
    "tools.compare.laws",
    "tools.compare.steered",
    "tools.campaign.manoeuvre",
)


@dataclasses.dataclass(frozen=True)
class Controller:
    """A controller: its law, and the numbers that are tuned: name and box, and a guess by hand to start from.

    `inputs` are those that it is driven with.
    """

    law: int
    about: str
    box: dict[str, tuple[float, float]]
    guess: tuple[float, ...]
    inputs: tuple[str, ...] = INPUTS


CONTROLLERS = {
    "ff": Controller(laws.FF, "feedforward only", {"ahead_s": (0.005, 0.5)}, (0.1,)),
    "pure-pursuit": Controller(
        laws.PURE_PURSUIT, "pure pursuit (Coulter 1992)", {"least_m": (0.05, 4.0), "ahead_s": (0.05, 4.0)}, (0.3, 0.7)
    ),
    "stanley": Controller(
        laws.STANLEY,
        "Stanley (Hoffmann 2007), in reverse at the rear axle",
        {"k_1ps": (0.02, 5.0), "k_reverse_1ps": (0.005, 2.0), "soft_mps": (0.01, 1.0), "k_yaw_s": (0.005, 2.0)},
        (0.5, 0.1, 0.1, 0.1),
    ),
    "rear-wheel": Controller(
        laws.REAR_WHEEL,
        "rear-wheel feedback (Samson 1992, Paden 2016)",
        {"k_e_1pm2": (0.02, 20.0), "k_theta_1pm": (0.1, 10.0)},
        (1.0, 1.5),
    ),
    "lqr": Controller(
        laws.LQR,
        "LQR with feedforward, delay-blind (Snider 2009)",
        {"q_e": (1e-3, 300.0), "q_theta": (1e-3, 100.0)},
        (1.0, 1.0),
    ),
    "lqr-preview": Controller(
        laws.LQR_PREVIEW,
        "LQR that knows lag and latency, with preview",
        {"q_e": (1e-3, 300.0), "q_theta": (1e-3, 100.0)},
        (1.0, 1.0),
    ),
    "mpc": Controller(
        laws.MPC,
        "constrained MPC (OSQP), lag and latency known",
        {"q_e": (1e-3, 300.0), "q_theta": (1e-3, 100.0), "q_change": (1e-3, 100.0)},
        (1.0, 1.0, 0.1),
    ),
    "pid": Controller(
        laws.PID,
        "PID without feedforward",
        {"kp": (0.05, 20.0), "ki": (0.005, 10.0), "kd": (0.1, 10.0)},
        (2.0, 0.4, 2.5),
    ),
    "pid+ff": Controller(
        laws.PID_FF,
        "PID with feedforward",
        {"kp": (0.05, 20.0), "ki": (0.005, 10.0), "kd": (0.1, 10.0), "ahead_s": (0.005, 0.5)},
        (2.0, 0.4, 2.5, 0.1),
    ),
    "dob+pid": Controller(
        laws.DOB_PID,
        "Q/Gn DOB with lag and delay in it, PID, feedforward",
        {"kp": (0.05, 20.0), "kd": (0.1, 10.0), "length_m": (0.1, 10.0), "ahead_s": (0.005, 0.5)},
        (2.0, 2.5, 1.0, 0.1),
    ),
    "car": Controller(laws.CAR, "the shipped law, as shipped", {}, ()),
}
"""All controllers. `car` brings its own estimator and takes its numbers from the shipped tables: it is not tuned here,
and both its rows, `raw` and `estimator`, are the same runs."""


class Setting(NamedTuple):
    """A scenario with all that its runs share; `shared.vehicle` carries the scenario's overlay."""

    scenario: Scenario
    shared: Shared


class LegFigures(NamedTuple):
    """Figures of one leg of one run; errors are the rear axle's true ones."""

    max_cross_track_m: float
    sum_of_squares_m2: float
    samples: float
    final_cross_track_m: float
    final_heading_error_rad: float
    min_clearance_m: float
    jitter_rad: float


class RunFigures(NamedTuple):
    """Figures of a run, forward and reverse leg; where it did not come to its end, those until then."""

    legs: tuple[LegFigures, LegFigures]
    completed: bool


def side_of(seed: int) -> Side:
    """Return the side that a seed's run is driven on: it changes every eighth seed, as the corners are through."""
    return "right" if (seed >> 3) & 1 else "left"


def setting_of(vehicle: Vehicle, course: Course, scenario: Scenario, tables_dir: FilePath) -> Setting:
    """Load what the runs of a scenario share; the vehicle carries the scenario's overlay."""
    return Setting(scenario, share(vehicle, course, "car", tables_dir))


def compiled_drive() -> Callable[..., None]:
    """Return the campaign's loop compiled with `steered` in the place of the firmware's controller."""
    clones = compile_modules(*MODULES)
    for name, constants in LIFTED.items():
        vars(clones[name]).update(constants)
    loop = clones["tools.campaign.manoeuvre"]
    vars(loop)["controller"] = clones["tools.compare.steered"]
    drive: Callable[..., None] = cached_njit(loop.drive.py_func, cache_folder(MODULES, repr(LIFTED)))
    return drive


def is_compiled() -> bool:
    """Return whether `compiled_drive` finds its work done on the disk."""
    folder = cache_folder(MODULES, repr(LIFTED))
    return folder is not None and any(folder.rglob("*.nbi"))


def gain_table(law: int, numbers: tuple[float, ...], tables: Tables) -> Any:
    """Return a law's gains by speed, at least two rows."""
    if law == laws.LQR:
        return gains.lqr_rows(*numbers)
    if law == laws.LQR_PREVIEW:
        return gains.lqr_preview_rows(tables.car, *numbers)
    return np.zeros((2, 2))


class Driver:
    """Drives runs of one setting with any law; the same arguments give the same figures."""

    def __init__(self, setting: Setting) -> None:
        self.setting = setting
        self._drive = _drive()
        shared = setting.shared
        self._tables = {side: array_tables(tables) for side, tables in shared.tables.items()}
        self._path = {
            side: Path(path.step_m, *[np.array(column) for column in path[1:]])  # type: ignore[arg-type]
            for side, path in shared.path.items()
        }
        self._kept: dict[Any, Any] = {}

    def _law(self, law: int, numbers: tuple[float, ...], side: Side) -> tuple[Any, Any, Mpc | None]:
        key = (law, numbers, side)
        if key not in self._kept:
            tables = self.setting.shared.tables[side]
            solver = Mpc(tables.car, tables.leg, numbers) if law == laws.MPC else None
            self._kept.clear()
            self._kept[key] = (
                gain_table(law, numbers, tables),
                callback(solver.solve if solver else no_solver),
                solver,
            )
        return self._kept[key]  # type: ignore[no-any-return]

    def run(self, law: int, numbers: tuple[float, ...], inputs: str, seed: int) -> RunFigures:
        """Drive one manoeuvre, both legs."""
        scenario, shared = self.setting
        side = side_of(seed)
        table, solve, _ = self._law(law, numbers, side)
        longest = shared.times.longest_ns // manoeuvre.PERIOD_NS
        for rows in (min(ROWS, longest), longest + 1):
            beginning = begin(shared.vehicle, shared.course, scenario, side, seed, shared.scales, shared.timeouts_ns)
            notes = begin_notes()
            notes = Notes(np.array(notes.number, dtype=np.int64), np.array(notes.value))  # type: ignore[arg-type]
            error, end = np.zeros(LEG_FIGURES * ERRORS_A_LEG), np.zeros(END_SLOTS)
            memory = np.zeros(MEMORY_SLOTS)
            tables = self._tables[side]
            with_law = Steered(
                tables,
                tables.dbc_hash24,
                tables.vehicle_hash24,
                law,
                int(inputs == ESTIMATOR),
                np.array([*numbers, 0.0]),  # type: ignore[arg-type]
                table,
                memory,  # type: ignore[arg-type]
                solve,
            )
            self._drive(
                with_law,
                steered.begin(),
                shared.times,
                array_world(beginning.world),
                self._path[side],
                beginning.motion,
                as_arrays(beginning.memory),
                notes,
                NoiseRows(seed).array(rows),
                Records(error, end, np.zeros((0, MAX_TRACE_COLUMNS))),  # type: ignore[arg-type]
            )
            if solve.error is not None:
                raise solve.error
            if not end[manoeuvre.RAN_OUT]:
                break
        return RunFigures(
            (_leg(error, notes, memory, 0), _leg(error, notes, memory, 1)), bool(end[manoeuvre.COMPLETED])
        )


_DRIVES: list[Callable[..., None]] = []


def _drive() -> Callable[..., None]:
    """Compile once a process."""
    if not _DRIVES:
        _DRIVES.append(compiled_drive())
    return _DRIVES[0]


def _leg(error: Any, notes: Notes, memory: Any, leg: int) -> LegFigures:
    first = leg * ERRORS_A_LEG
    row = examiner.LEG_VALUES + leg * examiner.VALUES_A_LEG
    driven = leg < notes.number[examiner.LEGS]
    return LegFigures(
        float(error[first + manoeuvre.MAX_ERROR_M]),
        float(error[first + manoeuvre.SUM_OF_SQUARES_M2]),
        float(error[first + manoeuvre.SAMPLES]),
        float(error[first + manoeuvre.FINAL_ERROR_M]),
        float(error[first + manoeuvre.FINAL_HEADING_RAD]),
        float(notes.value[row + examiner.LEG_CLEARANCE_M]) if driven else float("inf"),
        jitter_rad(memory, leg),
    )
