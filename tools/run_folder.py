"""The folder of a run: made late, filled by whole files, taken back where the run never began."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from datetime import datetime
from pathlib import Path

from sim.errors import UserError

MARK = "run.json"
"""Written first; a folder with this file belongs to an earlier run and may be used again."""
CONTENT = (
    MARK, "figures.json", "bus.log", "truth.csv", "exam.json", "controller.txt", "emulator.txt",
    "flight_record.csv", "swept_body.png", "signals.png", "tables", "soak.json",
)  # fmt: skip


def write_whole(path: Path, text: str) -> None:
    """Write a file so that it is there whole or not at all. Raises UserError where the folder does not take it."""
    try:
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        try:
            with os.fdopen(handle, "w", encoding="utf-8") as file:
                file.write(text)
            Path(temporary).chmod(0o644)
            Path(temporary).replace(path)
        except BaseException:
            Path(temporary).unlink(missing_ok=True)
            raise
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror}") from None


def check_writable_file(path: Path) -> None:
    """Raise UserError, before the work begins, where a file could not be written at its end."""
    if path.is_dir():
        raise UserError(f"{path}: is a folder; name a file")
    if not path.parent.is_dir():
        raise UserError(f"{path}: there is no folder {path.parent}")
    if not os.access(path if path.exists() else path.parent, os.W_OK):
        raise UserError(f"{path}: no right to write there")


class RunFolder:
    """Folder `path` of one run."""

    def __init__(self, path: Path, *, latest_link: Path | None) -> None:
        self.path = path
        self._latest_link = latest_link
        self._made: Path | None = None

    @classmethod
    def plan(cls, out: str | None, name: str) -> RunFolder:
        """Choose the folder: `out` itself where given, else runs/<time>-<name> with the link runs/latest.

        Nothing is made yet. Raises UserError where `out` is a file or holds something that is not a run.
        """
        if out is None:
            base = Path("runs") / f"{datetime.now():%Y%m%d-%H%M%S}-{name}"
            path, count = base, 2
            while path.exists():
                path, count = base.with_name(f"{base.name}-{count}"), count + 1
            return cls(path, latest_link=Path("runs") / "latest")
        path = Path(out)
        if path.exists():
            if not path.is_dir():
                raise UserError(f"--out {out}: is a file; name a folder")
            if any(path.iterdir()) and not (path / MARK).is_file():
                raise UserError(f"--out {out}: holds files that are not of a run; name an empty or new folder")
        return cls(path, latest_link=None)

    def make(self) -> None:
        """Make the folder, or empty it of the earlier run that it held."""
        try:
            if self.path.is_dir():
                for name in CONTENT:
                    old = self.path / name
                    if old.is_dir():
                        shutil.rmtree(old)
                    else:
                        old.unlink(missing_ok=True)
                return
            first_new = self.path
            while not first_new.parent.exists():
                first_new = first_new.parent
            self.path.mkdir(parents=True)
            self._made = first_new
        except OSError as error:
            raise UserError(f"{self.path}: the run's folder cannot be made: {error.strerror}") from None

    def discard(self) -> None:
        """Take back what this run made: for a run that never began."""
        if self._made is not None:
            shutil.rmtree(self._made, ignore_errors=True)
        elif self.path.is_dir():
            for name in CONTENT:
                with contextlib.suppress(OSError):
                    (self.path / name).unlink()
            shutil.rmtree(self.path / "tables", ignore_errors=True)

    def publish(self) -> None:
        """Point the link `latest` at this folder; a real folder of that name is left alone."""
        link = self._latest_link
        if link is None or (link.exists() and not link.is_symlink()):
            return
        temporary = link.with_name(f".latest.{os.getpid()}")
        with contextlib.suppress(OSError):
            temporary.symlink_to(self.path.name)
            temporary.replace(link)
