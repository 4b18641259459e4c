"""The journal of a campaign: what is finished, safe against an end at any moment.

A file to which whole chunks of runs are appended: one line of JSON (what the campaign is), then records of magic,
chunk number, length and CRC-32, and the rows as float64. Whatever the process dies of, what was appended before is
there; a record that was cut short is recognised by its length or CRC, cut off, and driven again. A chunk counts once
even where it stands twice. When all runs are there, the rows become one Parquet file, in order of the runs, written
beside its place and renamed; then the journal goes.
"""

from __future__ import annotations

import fcntl
import json
import os
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from sim.errors import UserError
from tools.campaign.results import COLUMNS, Rows

MAGIC = b"RUN1"
HEAD = struct.Struct("<4sIII")
FORMAT = 1
LONGEST_LINE = 1 << 26


def journal_of(file: Path) -> Path:
    """Return the journal that belongs to a campaign's Parquet file."""
    return file.with_name(file.name + ".journal")


class Journal:
    """The open journal; `done` are the rows of each finished chunk."""

    def __init__(self, path: Path, about: dict[str, Any], done: dict[int, Rows], file: Any) -> None:
        self.path = path
        self.about = about
        self.done = done
        self._file = file

    @classmethod
    def begin(cls, path: Path, about: dict[str, Any]) -> Journal:
        """Make a journal. It appears with its first line whole or not at all."""
        temporary = path.with_name(f".{path.name}.{os.getpid()}")
        line = json.dumps({"format": FORMAT, "columns": list(COLUMNS), **about}) + "\n"
        try:
            with temporary.open("wb") as file:
                file.write(line.encode())
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(path)
        except OSError as error:
            temporary.unlink(missing_ok=True)
            raise UserError(f"{path}: cannot be written: {error.strerror}") from None
        return cls.resume(path)

    @classmethod
    def resume(cls, path: Path) -> Journal:
        """Open a journal, take what is whole in it, and cut off the rest."""
        try:
            file = path.open("r+b")
        except OSError as error:
            raise UserError(f"{path}: cannot be opened: {error.strerror}") from None
        try:
            _lock(file, path)
            about = _about(file, path)
            done = _read_chunks(file, len(about["columns"]))
        except BaseException:
            file.close()
            raise
        return cls(path, about, done, file)

    def append(self, chunk: int, rows: Rows) -> None:
        """Add a finished chunk; it is on the disk when this returns."""
        payload = np.ascontiguousarray(rows, dtype="<f8").tobytes()
        record = HEAD.pack(MAGIC, chunk, len(payload), _crc(chunk, payload)) + payload
        try:
            self._file.write(record)
            self._file.flush()
            os.fsync(self._file.fileno())
        except OSError as error:
            raise UserError(
                f"{self.path}: cannot be written: {error.strerror}; what was finished is kept, --resume goes on"
            ) from None
        self.done[chunk] = rows

    def rows(self) -> Rows:
        """Return the rows of all finished chunks in order of their runs."""
        return np.concatenate([self.done[chunk] for chunk in sorted(self.done)])

    def close(self) -> None:
        """Close the file and let others have it."""
        self._file.close()


def _lock(file: Any, path: Path) -> None:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        raise UserError(f"{path}: another campaign is writing there; wait for it or end it") from None


def _about(file: Any, path: Path) -> dict[str, Any]:
    try:
        about = json.loads(file.readline(LONGEST_LINE))
        known = about["format"] == FORMAT and about["columns"] == list(COLUMNS)
    except (ValueError, TypeError, KeyError):
        raise UserError(f"{path}: not the journal of a campaign") from None
    if not known:
        raise UserError(f"{path}: of another version of parkctl; begin the campaign anew")
    return dict(about)


def _crc(chunk: int, payload: bytes) -> int:
    return zlib.crc32(payload, zlib.crc32(struct.pack("<II", chunk, len(payload))))


def _read_chunks(file: Any, columns: int) -> dict[int, Rows]:
    """Read whole records up to the first that is not, and cut the file there."""
    done: dict[int, Rows] = {}
    good = file.tell()
    while True:
        head = file.read(HEAD.size)
        if len(head) < HEAD.size:
            break
        magic, chunk, length, crc = HEAD.unpack(head)
        if magic != MAGIC or length % (8 * columns):
            break
        payload = file.read(length)
        if len(payload) < length or _crc(chunk, payload) != crc:
            break
        done[chunk] = np.frombuffer(payload, dtype="<f8").reshape(-1, columns).astype(np.float64)
        good = file.tell()
    file.seek(good)
    file.truncate(good)
    return done
