"""The bus log of a run in candump's format (`candump -L`), in order of time."""

from __future__ import annotations

import contextlib
from pathlib import Path
from types import TracebackType
from typing import TextIO

SETTLE_S = 0.2
"""Frames are held back so long before they are written, since own and received ones come in slightly out of order."""
ERROR_FRAME_ID = 0x20000080

Frame = tuple[float, int, bytes, bool]
"""Unix time in s, arbitration id, data, is error frame."""


class NoLog:
    """In the place of a log where none is kept."""

    failed: str | None = None

    def add(self, frames: list[Frame]) -> None:
        """Forget them."""

    def write_due(self, now_s: float) -> None:
        """Write nothing."""


class BusLog(NoLog):
    """Writes frames to a file; `write_due` is cheap and may be called often.

    A full disk must not stop a car: what goes wrong in writing ends the log and is kept in `failed`.
    """

    def __init__(self, path: Path, channel: str) -> None:
        self._file: TextIO = path.open("w", encoding="ascii")
        self._channel = channel
        self._held: list[Frame] = []
        self._next_write_s = 0.0
        self._last_s = 0.0

    def add(self, frames: list[Frame]) -> None:
        """Take frames in."""
        self._held += frames

    def write_due(self, now_s: float) -> None:
        """Write, a few times a second, what cannot be overtaken any more; `now_s` is Unix time."""
        if now_s >= self._next_write_s:
            self._next_write_s = now_s + SETTLE_S
            self._write(now_s - SETTLE_S)

    def _write(self, until_s: float) -> None:
        self._held.sort(key=lambda frame: frame[0])
        count = next((i for i, frame in enumerate(self._held) if frame[0] > until_s), len(self._held))
        lines = []
        for time_s, arbitration_id, data, is_error in self._held[:count]:
            self._last_s = max(self._last_s, time_s)  # a clock that was set back must not make the log run backwards
            name = f"{ERROR_FRAME_ID:08X}" if is_error else f"{arbitration_id:03X}"
            lines.append(f"({self._last_s:.6f}) {self._channel} {name}#{data.hex().upper()}\n")
        del self._held[:count]
        try:
            if self.failed is None:
                self._file.write("".join(lines))
                self._file.flush()
        except OSError as error:
            self.failed = f"the bus log could not be written: {error.strerror}"

    def __enter__(self) -> BusLog:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._write(float("inf"))
        with contextlib.suppress(OSError):
            self._file.close()
