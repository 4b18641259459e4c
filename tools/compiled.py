"""The firmware's core and the plant through numba: the same functions, compiled, with the same bits in the result.

Each module is cloned with its functions compiled; the structs stay the very same classes, so states and outputs
of the plain and the compiled core can be compared and exchanged. Tables become float64 arrays of the same shape.
"""

import hashlib
import importlib
import os
import shutil
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

import numpy as np

from firmware_py.core.tables import GainTable, LegTable, ReferencePath, Tables

CORE = "firmware_py.core"
CORE_MODULES = (
    "signals",
    "conditions",
    "bounds",
    "tables",
    "path",
    "schedule",
    "motion",
    "kalman",
    "estimator",
    "predictor",
    "pid",
    "limits",
    "paper_law",
    "speed",
    "health",
    "supervisor",
    "manoeuvre",
    "gate",
    "controller",
)

PLANT_MODULES = (
    "sim.tyre",
    "sim.vehicle",
    "sim.actuators",
    "sim.body",
    "sim.sensors",
    "sim.drive_by_wire",
    "sim.plant",
    "sim.examiner",
)


OPTIONS: dict[str, Any] = {"_nrt": False}
"""No counting of references: nothing here allocates, and counting those of the tables' arrays takes half of a run."""


def compile_modules(*names: str) -> dict[str, ModuleType]:
    """Return clones of modules (dotted names) of pure functions with every function compiled (lazily) by numba.

    A function or module that one of them imports from another is the compiled one in the clone too; what else they
    hold stays what it is. No fastmath: the bits stay.
    """
    import numba  # noqa: PLC0415 -- half a second and 150 MiB; only where it is used

    originals = {name: importlib.import_module(name) for name in names}
    clones = {name: ModuleType(name) for name in names}
    compiled: dict[Any, Any] = {}
    for name, module in originals.items():
        for function in vars(module).values():
            if isinstance(function, FunctionType) and function.__module__ == name:
                clone = FunctionType(
                    function.__code__, vars(clones[name]), function.__name__, function.__defaults__, None
                )
                compiled[function] = numba.njit(**OPTIONS)(clone)
    for name, module in originals.items():
        for attribute, value in vars(module).items():
            if isinstance(value, FunctionType):
                vars(clones[name])[attribute] = compiled.get(value, value)
            elif isinstance(value, ModuleType):
                vars(clones[name])[attribute] = clones.get(value.__name__, value)
            elif attribute != "__name__":
                vars(clones[name])[attribute] = value
    return clones


def core_modules() -> tuple[str, ...]:
    """Return the dotted names of all modules of the core."""
    return tuple(f"{CORE}.{name}" for name in CORE_MODULES)


def compiled_step() -> Callable[..., Any]:
    """Return the core's `step`, compiled; its tables are those of `array_tables`."""
    step: Callable[..., Any] = compile_modules(*core_modules())[f"{CORE}.controller"].step
    return step


def array_tables(tables: Tables) -> Tables:
    """Return the tables with float64 arrays in place of tuples, same shapes, same bits."""
    return tables._replace(
        leg=(_array_leg(tables.leg[0]), _array_leg(tables.leg[1])),
        gains=GainTable(
            speed_grid_mps=np.array(tables.gains.speed_grid_mps),  # type: ignore[arg-type]
            last_row=tables.gains.last_row,
            gain=np.array(tables.gains.gain),  # type: ignore[arg-type]
        ),
        paper=tables.paper._replace(
            speed_grid_mps=np.array(tables.paper.speed_grid_mps),  # type: ignore[arg-type]
            row=np.array(tables.paper.row),  # type: ignore[arg-type]
        ),
        reference=ReferencePath(tables.reference.ahead_m, *_array_columns(tables.reference[1:])),
    )


def _array_columns(columns: tuple[Any, ...]) -> list[Any]:
    return [np.array(rows) for rows in columns]


def _array_leg(leg: LegTable) -> LegTable:
    columns = {name: value for name, value in leg._asdict().items() if isinstance(value, tuple)}
    arrays: dict[str, Any] = {name: np.array(column) for name, column in columns.items()}
    return leg._replace(**arrays)


KEPT_CACHES = 32
"""Folders of compiled code that are kept, one a state of the sources; about a megabyte each."""

KEPT_S = 7 * 86_400.0
"""Whatever was used within this time is kept however many there are: somebody may be using it now."""


def cache_folder(names: tuple[str, ...], *more: str) -> Path | None:
    """Return the folder for what numba makes of these modules (and further texts), or None where none can be had.

    Its name is a hash of all sources: numba itself would look at the file of the outermost function alone, and give
    back yesterday's code where a module below it has changed.
    """
    import numba  # noqa: PLC0415

    digest = hashlib.sha256(f"{sys.version} numba {numba.__version__} numpy {np.__version__}".encode())
    for name in (*names, __name__):
        file = importlib.import_module(name).__file__
        digest.update(str(file).encode())  # numba keeps apart what lies in different places
        digest.update(Path(str(file)).read_bytes())
    for text in more:
        digest.update(text.encode())
    root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "parkctl" / "compiled"
    folder = root / digest.hexdigest()[:24]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK):
            return None
        os.utime(folder)
        newest_first = sorted(root.iterdir(), key=lambda other: other.stat().st_mtime, reverse=True)
        for old in newest_first[KEPT_CACHES:]:
            if old.stat().st_mtime < time.time() - KEPT_S:
                shutil.rmtree(old, ignore_errors=True)
    except OSError:
        return None
    return folder


def cached_njit(function: Any, folder: Path | None) -> Any:
    """Return the function compiled by numba, kept on disk in the folder where there is one."""
    import numba  # noqa: PLC0415

    if folder is None:
        return numba.njit(**OPTIONS)(function)
    settings: Any = numba.config
    before = settings.CACHE_DIR
    try:
        settings.CACHE_DIR = str(folder)
        return numba.njit(cache=True, **OPTIONS)(function)
    finally:
        settings.CACHE_DIR = before


def source_to_functions(source: str, namespace: dict[str, Any], folder: Path | None, file_name: str) -> dict[str, Any]:
    """Execute generated source; as a file in the folder where there is one, since numba's cache goes by files."""
    name = f"<{file_name}>"
    namespace["__name__"] = __name__  # numba imports the module of what it finds in its cache
    if folder is not None:
        file = folder / file_name
        if not file.exists():
            temporary = folder / f".{file_name}.{os.getpid()}"
            temporary.write_text(source, encoding="utf-8")
            temporary.replace(file)
        name = str(file)
    exec(compile(source, name, "exec"), namespace)
    return namespace
