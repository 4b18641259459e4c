"""The core's cycle compiled by numba with one entry on flat arrays: the floor that the plain cycle is measured against.

Numbers go in and out as float64, which holds every integer of the core exactly; the long columns of the tables are the
rows of one array, all else of the tables is constant. The step itself is the very source of `firmware_py.core`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from firmware_py.core.tables import Tables
from tools.compiled import array_tables, compiled_step

Entry = Callable[[Any, Any, Any, Any], None]


def flat(value: Any) -> list[float]:
    """Return all numbers of a nest of tuples, in order."""
    if isinstance(value, tuple):
        return [number for part in value for number in flat(part)]
    return [value]


class _Names:
    """Classes that generated source may call, by a name of their own."""

    def __init__(self) -> None:
        self.namespace: dict[str, Any] = {}

    def of(self, kind: type) -> str:
        self.namespace[kind.__name__] = kind
        return kind.__name__


def _built(example: Any, array: str, names: _Names, position: list[int]) -> str:
    """Return an expression that builds a nest like the example from consecutive elements of an array."""
    if isinstance(example, tuple):
        parts = ", ".join(_built(part, array, names, position) for part in example)
        return f"({parts},)" if type(example) is tuple else f"{names.of(type(example))}({parts})"
    element = f"{array}[{position[0]}]"
    position[0] += 1
    return element if isinstance(example, float) else f"int({element})"


def _taken_apart(example: Any, expression: str, array: str, position: list[int]) -> list[str]:
    """Return the lines that write all numbers of a nest like the example into consecutive elements."""
    if isinstance(example, tuple):
        fields = getattr(example, "_fields", None)
        lines = []
        for index, part in enumerate(example):
            inner = f"{expression}.{fields[index]}" if fields else f"{expression}[{index}]"
            lines += _taken_apart(part, inner, array, position)
        return lines
    position[0] += 1
    return [f"    {array}[{position[0] - 1}] = {expression}"]


def _tables_built(value: Any, names: _Names, columns: list[Any], longest: int) -> str:
    """Return an expression for the tables; columns as long as the path become rows of `columns`."""
    if isinstance(value, tuple):
        parts = ", ".join(_tables_built(part, names, columns, longest) for part in value)
        return f"({parts},)" if type(value) is tuple else f"{names.of(type(value))}({parts})"
    if isinstance(value, np.ndarray) and value.ndim == 1 and len(value) == longest:
        columns.append(value)
        return f"columns[{len(columns) - 1}]"
    constant = f"CONSTANT_{len(names.namespace)}"
    names.namespace[constant] = value
    return constant


def compile_entry(tables: Tables, state: Any, inputs: Any, outputs: Any) -> tuple[Entry, Any]:
    """Return `entry(columns, state, inputs, outputs)` on float64 arrays, and its `columns`.

    State goes in and out, inputs in, outputs out; the three structs given are examples of the shapes.
    """
    import numba  # noqa: PLC0415 -- half a second and 150 MiB; only where it is used

    names = _Names()
    columns: list[Any] = []
    arrays = array_tables(tables)
    lines = [
        "def entry(columns, state, inputs, outputs):",
        f"    tables = {_tables_built(arrays, names, columns, len(arrays.leg[0].x_m))}",
        f"    next_state, output = step(tables, {_built(state, 'state', names, [0])},",
        f"                              {_built(inputs, 'inputs', names, [0])})",
        *_taken_apart(state, "next_state", "state", [0]),
        *_taken_apart(outputs, "output", "outputs", [0]),
    ]
    namespace = {**names.namespace, "step": compiled_step()}
    exec(compile("\n".join(lines), "<entry on arrays>", "exec"), namespace)
    entry: Entry = numba.njit(namespace["entry"])
    return entry, np.array(columns)


def arrays_of(values: list[Any]) -> Any:
    """Return one row of numbers a struct."""
    return np.array([flat(value) for value in values], dtype=np.float64)
