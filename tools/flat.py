"""Nests of NamedTuples as rows of float64, and generated source that goes between the two.

A compiled function that takes and returns such nests costs 50 to 200 us a call from Python, all of it packing; on
arrays it costs 1 or 2. Float64 holds every integer below 2^53 exactly.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np


def flat(nest: Any) -> list[float]:
    """Return all numbers of a nest of tuples, in order; arrays in it are left out."""
    if isinstance(nest, tuple):
        return [number for part in nest for number in flat(part)]
    return [] if isinstance(nest, np.ndarray) else [nest]


class Namespace:
    """What generated source may name: classes, and arrays that are no part of a row."""

    def __init__(self) -> None:
        self.names: dict[str, Any] = {}

    def built(self, example: Any, row: str, arrays: tuple[str, ...] = ()) -> str:
        """Return an expression that builds a nest like the example from the row; arrays in it by their names."""
        return self._built(example, row, iter(arrays), [0])

    def _built(self, example: Any, row: str, arrays: Any, place: list[int]) -> str:
        if isinstance(example, np.ndarray):
            return str(next(arrays))
        if isinstance(example, tuple):
            parts = ", ".join(self._built(part, row, arrays, place) for part in example)
            if type(example) is tuple:
                return f"({parts},)"
            self.names[type(example).__name__] = type(example)
            return f"{type(example).__name__}({parts})"
        place[0] += 1
        element = f"{row}[{place[0] - 1}]"
        return element if isinstance(example, float) else f"int({element})"


def written(example: Any, expression: str, row: str, first: int = 0) -> list[str]:
    """Return the lines that write all numbers of a nest like the example into the row, from a place on."""
    lines: list[str] = []
    _written(example, expression, row, [first], lines)
    return lines


def _written(example: Any, expression: str, row: str, place: list[int], lines: list[str]) -> None:
    if isinstance(example, tuple):
        fields = getattr(example, "_fields", None)
        for index, part in enumerate(example):
            inner = f"{expression}.{fields[index]}" if fields else f"{expression}[{index}]"
            _written(part, inner, row, place, lines)
    elif not isinstance(example, np.ndarray):
        lines.append(f"    {row}[{place[0]}] = {expression}")
        place[0] += 1


def rebuilder(example: Any) -> Callable[[list[float]], Any]:
    """Return a plain function that makes a nest like the example of a list of its numbers."""
    space = Namespace()
    source = f"def rebuild(row):\n    return {space.built(example, 'row')}\n"
    exec(compile(source, "<nest of a row>", "exec"), space.names)
    rebuild: Callable[[list[float]], Any] = space.names["rebuild"]
    return rebuild
