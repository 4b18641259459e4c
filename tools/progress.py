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


class CountProgress:
    """A bar with count, rate and time to go, for work that consists of many equal parts.

    On a terminal one line that lives; elsewhere a line now and then, where something has been done since the last one.
    """

    WIDTH = 24

    def __init__(self, what: str, unit: str, total: int, done: int = 0, stream: TextIO | None = None) -> None:
        self._stream = sys.stderr if stream is None else stream
        self._terminal = self._stream.isatty()
        self._what, self._unit, self._total = what, unit, total
        self._first = self._shown = done
        self._begun_s: float | None = None
        self._next_s = 0.0
        self._open = False

    def show(self, now_s: float, done: int, note: str = "") -> None:
        """Show how much is done, if it is time for that; `note` stands at the end of the line."""
        if self._begun_s is None:
            self._begun_s = now_s
        if now_s < self._next_s and done < self._total:
            return
        self._next_s = now_s + (TERMINAL_PERIOD_S if self._terminal else FILE_PERIOD_S)
        text = self.line_of(now_s - self._begun_s, done, note)
        with contextlib.suppress(OSError, ValueError):
            if self._terminal:
                width = shutil.get_terminal_size().columns - 1
                self._stream.write(f"\r\x1b[K{text[:width]}")
                self._open = True
            elif done != self._shown:
                self._stream.write(f"{text}\n")
            self._stream.flush()
        self._shown = done

    def line_of(self, passed_s: float, done: int, note: str = "") -> str:
        """Return the line for a state of the work, so long after it began."""
        share = done / self._total if self._total else 1.0
        bar = "#" * round(self.WIDTH * share)
        text = f"{self._what} [{bar:<{self.WIDTH}}] {done} of {self._total} {self._unit}"
        fresh = done - self._first
        if fresh > 0 and passed_s > 0.0:
            rate = fresh / passed_s
            left_s = round((self._total - done) / rate)
            text += f"  {rate:.1f} {self._unit}/s"
            text += f"  {left_s // 60}:{left_s % 60:02d} to go" if done < self._total else ""
        return f"{text}  {note}" if note else text

    def close(self) -> None:
        """End the line."""
        if self._open:
            with contextlib.suppress(OSError, ValueError):
                self._stream.write("\n")
                self._stream.flush()
            self._open = False
