"""The firmware's core through numba: the same functions, compiled, with the same bits in the result.

Each core module is cloned with its functions compiled; the structs stay the very same classes, so states and outputs
of the plain and the compiled core can be compared and exchanged. Tables become float64 arrays of the same shape.
"""

import importlib
from collections.abc import Callable
from types import FunctionType, ModuleType
from typing import Any

import numpy as np

from firmware_py.core.tables import GainTable, LegTable, Tables

CORE_MODULES = (
    "signals",
    "conditions",
    "tables",
    "path",
    "schedule",
    "motion",
    "predictor",
    "observer",
    "pid",
    "limits",
    "speed",
    "health",
    "supervisor",
    "manoeuvre",
    "gate",
    "controller",
)


def compile_modules(package: str, names: tuple[str, ...]) -> dict[str, ModuleType]:
    """Return clones of modules of pure functions with every function compiled (lazily) by numba.

    A function that one module imports from another is the compiled one in the clone too. No fastmath: the bits stay.
    """
    import numba  # noqa: PLC0415 -- half a second and 150 MiB; only where it is used

    originals = {name: importlib.import_module(f"{package}.{name}") for name in names}
    clones = {name: ModuleType(module.__name__) for name, module in originals.items()}
    compiled: dict[Any, Any] = {}
    for name, module in originals.items():
        for function in vars(module).values():
            if isinstance(function, FunctionType) and function.__module__ == module.__name__:
                clone = FunctionType(
                    function.__code__, vars(clones[name]), function.__name__, function.__defaults__, None
                )
                compiled[function] = numba.njit(clone)
    for name, module in originals.items():
        for attribute, value in vars(module).items():
            if isinstance(value, FunctionType):
                vars(clones[name])[attribute] = compiled.get(value, value)
            elif isinstance(value, ModuleType) and value.__name__.removeprefix(f"{package}.") in clones:
                vars(clones[name])[attribute] = clones[value.__name__.removeprefix(f"{package}.")]
            elif attribute != "__name__":
                vars(clones[name])[attribute] = value
    return clones


def compiled_step() -> Callable[..., Any]:
    """Return the core's `step`, compiled; its tables are those of `array_tables`."""
    step: Callable[..., Any] = compile_modules("firmware_py.core", CORE_MODULES)["controller"].step
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
    )


def _array_leg(leg: LegTable) -> LegTable:
    columns = {name: value for name, value in leg._asdict().items() if isinstance(value, tuple)}
    arrays: dict[str, Any] = {name: np.array(column) for name, column in columns.items()}
    return leg._replace(**arrays)
