"""Bounds. The interpreter's own `max(min(value, high), low)` takes it as long as five of these."""

from typing import TypeVar

Number = TypeVar("Number", int, float)


def bounded(value: Number, low: Number, high: Number) -> Number:
    """Return the value between its bounds; no number stays none, and where the bounds cross the lower one counts."""
    if value > high:
        value = high
    if value < low:
        value = low
    return value
