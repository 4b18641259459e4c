"""One run of a campaign, plain or compiled: what all runs share is prepared once, then it is a call a run."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path as FilePath
from typing import Any, NamedTuple

import numpy as np

from firmware_py.codec import load_codec
from firmware_py.core import controller
from firmware_py.core.controller import PERIOD_S
from firmware_py.core.tables import Tables
from firmware_py.node import build_tables
from firmware_py.table_file import load_tables
from sim import drive_by_wire as dbw
from sim.data_files import SIDES, Course, Scenario, Side, Vehicle
from sim.errors import UserError
from sim.examiner import Notes, begin_notes
from sim.plant import VERSION_EVERY
from sim.sensors import NoiseRows
from tools import lockstep
from tools.campaign import manoeuvre, wire
from tools.campaign.manoeuvre import END_SLOTS, ERRORS_A_LEG, LEG_FIGURES, MAX_TRACE_COLUMNS, Path, Records, Timetable
from tools.campaign.world import DBC, TICK_MODULES, array_world, as_arrays, begin
from tools.compiled import array_tables, cache_folder, cached_njit, compile_modules, core_modules
from tools.figures import load_path
from tools.operator_station import START_HOLD_S

MODULES = (*TICK_MODULES, *core_modules(), "tools.campaign.manoeuvre")
ROWS = 6000
"""Cycles for which noise is drawn at first: a minute; a run that takes longer is run again with all of it."""

MOST_CONES = 62
"""Touched cones are bits of one integer."""


class Shared(NamedTuple):
    """What all runs of a campaign have in common, by side where it differs; it can be pickled."""

    vehicle: Vehicle
    course: Course
    tables: dict[Side, Tables]
    path: dict[Side, Path]
    times: Timetable
    scales: wire.Scales
    timeouts_ns: tuple[int, int, int, int]


class Outcome(NamedTuple):
    """What a run brought: records of `manoeuvre`, notes of the examiner, and the truth of each tick where asked for."""

    error: list[float]
    end: list[float]
    notes: Notes
    trace: Any


def failed_outcome(reason: float) -> Outcome:
    """Return the outcome of a run that came to nothing, for a reason by the DBC's control_reason; it has no cycles."""
    end = [0.0] * END_SLOTS
    end[manoeuvre.REASON] = reason
    return Outcome([0.0] * (LEG_FIGURES * ERRORS_A_LEG), end, begin_notes(), None)


def share(vehicle: Vehicle, course: Course, law: str, tables_dir: FilePath, dbc: FilePath = DBC) -> Shared:
    """Load what a campaign needs. The vehicle carries the scenario's overlay already."""
    if len(course.cones) > MOST_CONES:
        raise UserError(f"course {course.name}: {len(course.cones)} cones; a campaign takes at most {MOST_CONES}")
    codec = load_codec(dbc)
    tables: dict[Side, Tables] = {}
    path: dict[Side, Path] = {}
    for side in SIDES:
        table_set = load_tables(tables_dir, side, law, PERIOD_S)
        if table_set.vehicle_hash24 != vehicle.hash24:
            raise UserError(f"tables {tables_dir}: made for another car than {vehicle.name}")
        tables[side] = build_tables(table_set, codec)
        grid = load_path(tables_dir, side)
        columns = (grid.x_m, grid.y_m, grid.yaw_rad, grid.curvature_1pm)
        step_m = grid.length_m / (len(grid.station_m) - 1)
        path[side] = Path(step_m, *[tuple(column.tolist()) for column in columns])
    cycle_ms = {name: info.cycle_time_ms for name, info in codec.messages.items()}
    timeout_ns = {name: info.timeout_ms * 1_000_000 for name, info in codec.messages.items()}
    sys_ns, steer_ns, long_ns, version_ns = (timeout_ns[name] for name in dbw.TIMED)
    times = Timetable(
        phase_ns=round(lockstep.PHASE_MS * 1e6),
        compute_ns=lockstep.COMPUTE_NS,
        longest_ns=round(lockstep.LONGEST_S * 1e9),
        after_end_cycles=lockstep.AFTER_END_CYCLES,
        start_hold_ns=int(1e9 * START_HOLD_S),
        heartbeat_ns=cycle_ms["OPER_Cmd"] * 1_000_000,
        controller_version_every=cycle_ms["CTRL_Version"] * 1_000_000 // manoeuvre.PERIOD_NS,
        vehicle_version_every=VERSION_EVERY,
        protocol=dbw.PROTOCOL_VERSION,
    )
    timeouts = (sys_ns, steer_ns, long_ns, version_ns)
    return Shared(vehicle, course, tables, path, times, wire.load_scales(dbc), timeouts)


def compiled_drive() -> Callable[..., None]:
    """Return `manoeuvre.drive` compiled: half a minute, or a second where it was compiled before."""
    module = compile_modules(*MODULES)["tools.campaign.manoeuvre"]
    drive: Callable[..., None] = cached_njit(module.drive.py_func, cache_folder(MODULES))
    return drive


def is_compiled() -> bool:
    """Return whether `compiled_drive` finds its work done on the disk."""
    folder = cache_folder(MODULES)
    return folder is not None and any(folder.rglob("*.nbi"))


class Runner:
    """Drives runs with what they share; `compiled` decides by which of the two ways, with the same bits."""

    def __init__(self, shared: Shared, *, compiled: bool = True) -> None:
        self._shared = shared
        self._compiled = compiled
        self._tables, self._path = shared.tables, shared.path
        self._drive: Callable[..., None] = manoeuvre.drive
        if compiled:
            self._tables = {side: array_tables(tables) for side, tables in shared.tables.items()}
            self._path = {side: _array_path(path) for side, path in shared.path.items()}
            self._drive = compiled_drive()

    def run(self, scenario: Scenario, side: Side, seed: int, *, trace_rows: int = 0) -> Outcome:
        """Drive one manoeuvre; the same arguments give the same bits."""
        longest = self._shared.times.longest_ns // manoeuvre.PERIOD_NS
        for rows in (min(ROWS, longest), longest + 1):
            outcome = self._run(scenario, side, seed, rows, trace_rows)
            if not outcome.end[manoeuvre.RAN_OUT]:
                break
        return outcome

    def _run(self, scenario: Scenario, side: Side, seed: int, rows: int, trace_rows: int) -> Outcome:
        shared = self._shared
        beginning = begin(shared.vehicle, shared.course, scenario, side, seed, shared.scales, shared.timeouts_ns)
        normals: Any = NoiseRows(seed).array(rows)
        world, memory, notes = beginning.world, beginning.memory, begin_notes()
        error: Any = [0.0] * (LEG_FIGURES * ERRORS_A_LEG)
        end: Any = [0.0] * END_SLOTS
        trace: Any = np.zeros((trace_rows, MAX_TRACE_COLUMNS))
        if self._compiled:
            world, memory = array_world(world), as_arrays(memory)
            notes = Notes(np.array(notes.number, dtype=np.int64), np.array(notes.value))  # type: ignore[arg-type]
            error, end = np.array(error), np.array(end)
        else:
            normals = normals.tolist()
        self._drive(
            self._tables[side],
            controller.begin(),
            shared.times,
            world,
            self._path[side],
            beginning.motion,
            memory,
            notes,
            normals,
            Records(error, end, trace),
        )
        if self._compiled:
            error, end = error.tolist(), end.tolist()
            notes = Notes(notes.number.tolist(), notes.value.tolist())  # type: ignore[attr-defined]
        return Outcome(error, end, notes, trace)


def _array_path(path: Path) -> Path:
    columns: list[Any] = [np.array(column) for column in path[1:]]
    return Path(path.step_m, *columns)
