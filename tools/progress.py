"""One line that lives while the car drives; where the output is no terminal, a line now and then."""

from __future__ import annotations

import contextlib
import shutil
import sys
from typing import NamedTuple, TextIO

TERMINAL_PERIOD_S = 0.1
FILE_PERIOD_S = 5.0


class Moment(NamedTuple):
    """What is shown of a running test; None where it is not known (yet)."""

    leg: str
    speed_mps: float | None = None
    station_m: float | None = None
    length_m: float | None = None
    cross_track_error_m: float | None = None
    clearance_m: float | None = None
    wake_late_p99_us: float | None = None


def line_of(moment: Moment) -> str:
    """Return the line; the cross-track error is the plant's own (true), positive to the left of the path."""
    parts = [f"{moment.leg:<16}"]
    if moment.speed_mps is not None:
        parts.append(f"{moment.speed_mps:+5.2f} m/s")
    if moment.station_m is not None and moment.length_m is not None:
        parts.append(f"station {moment.station_m:5.2f} of {moment.length_m:.2f} m")
    if moment.cross_track_error_m is not None:
        parts.append(f"cross-track {1e3 * moment.cross_track_error_m:+5.1f} mm")
    if moment.clearance_m is not None:
        parts.append(f"clearance {moment.clearance_m:.3f} m")
    if moment.wake_late_p99_us is not None:
        parts.append(f"loop late p99 {1e-3 * moment.wake_late_p99_us:.2f} ms")
    return "  ".join(parts)


class Progress:
    """Shows moments on a stream: overwrites its line on a terminal, adds a line now and then elsewhere."""

    def __init__(self, stream: TextIO | None = None) -> None:
        self._stream = sys.stdout if stream is None else stream
        self._terminal = self._stream.isatty()
        self._next_s = 0.0
        self._leg = ""
        self._open = False

    def due(self, now_s: float, leg: str) -> bool:
        """Whether something should be shown now (so that nothing is computed for nothing)."""
        return now_s >= self._next_s or leg != self._leg

    def show(self, now_s: float, moment: Moment) -> None:
        """Show the moment. A reader that has gone away is no reason to stop."""
        text = line_of(moment)
        self._leg = moment.leg
        self._next_s = now_s + (TERMINAL_PERIOD_S if self._terminal else FILE_PERIOD_S)
        if self._terminal:
            width = shutil.get_terminal_size().columns - 1
            self._write(f"\r\x1b[K{text[:width]}")
            self._open = True
        else:
            self._write(f"{text}\n")

    def close(self) -> None:
        """End the line."""
        if self._open:
            self._write("\n")
            self._open = False

    def _write(self, text: str) -> None:
        with contextlib.suppress(OSError, ValueError):
            self._stream.write(text)
            self._stream.flush()
