"""The processes of a run: started in groups of their own, heard without waiting, ended for certain."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

from tools.buses import environment_without_can_settings

STATUS_USER_ERROR = 2
_PR_SET_PDEATHSIG = 1  # linux/prctl.h


def die_with_parent() -> None:
    """Have the kernel end this process when its parent is killed; runs in the child, between fork and exec."""
    if sys.platform == "linux":
        import ctypes  # noqa: PLC0415

        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


class Child:
    """A Python process `python -m MODULE ARGUMENTS` that prints one JSON object a line and complains on stderr.

    Its process group is its own, so that a Ctrl-C of the terminal reaches the parent only, who then decides.
    `latest` is the newest report, `final` the content of the last one's "final". `name` is for people.
    """

    def __init__(self, name: str, module: str, arguments: list[str]) -> None:
        self.name = name
        self.latest: dict[str, Any] = {}
        self.final: dict[str, Any] | None = None
        self._complaints = bytearray()
        self._partial = b""
        self.process = subprocess.Popen(
            # -P: a folder of the user's own called `sim` must not take the module's place.
            [sys.executable, "-P", "-m", module, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=environment_without_can_settings() | {"PYTHONUNBUFFERED": "1"},
            process_group=0,
            preexec_fn=die_with_parent,  # noqa: PLW1509  no thread runs here
        )
        for pipe in (self.process.stdout, self.process.stderr):
            assert pipe is not None
            os.set_blocking(pipe.fileno(), False)

    def listen(self) -> None:
        """Take in what the process has said since last time; never waits."""
        self._complaints += self._read(self.process.stderr)
        *lines, self._partial = (self._partial + self._read(self.process.stdout)).split(b"\n")
        for line in lines:
            try:
                report = json.loads(line)
            except ValueError:
                continue  # not a report
            if isinstance(report, dict) and isinstance(report.get("final"), dict):
                self.final = report["final"]
            elif isinstance(report, dict):
                self.latest = report

    @staticmethod
    def _read(pipe: Any) -> bytes:
        content = b""
        with contextlib.suppress(BlockingIOError):
            while part := os.read(pipe.fileno(), 1 << 16):
                content += part
        return content

    def ended(self) -> bool:
        """Whether the process is gone; its last words are then taken in."""
        if self.process.poll() is None:
            return False
        self.listen()
        return True

    @property
    def status(self) -> int | None:
        """Exit status, negative for a signal, None while it runs."""
        return self.process.returncode

    @property
    def complaints(self) -> str:
        """All that the process has written to stderr."""
        return self._complaints.decode(errors="replace")

    def last_complaint(self) -> str:
        """Return the last line of stderr, without the program's name before it."""
        lines = [line.strip() for line in self.complaints.splitlines() if line.strip()]
        return lines[-1].removeprefix("parkctl: ").removeprefix("error: ") if lines else ""

    def how_it_ended(self) -> str:
        """Return in plain words how the process ended."""
        if self.status is None:
            return f"the {self.name} is still running"
        if self.status < 0:
            with contextlib.suppress(ValueError):
                return f"the {self.name} was killed by {signal.Signals(-self.status).name}"
            return f"the {self.name} was killed by signal {-self.status}"
        said = self.last_complaint()
        return f"the {self.name} ended with status {self.status}" + (f": {said}" if said else "")

    def terminate(self) -> None:
        """Ask the process to end."""
        if self.process.poll() is None:
            self.process.terminate()

    def kill(self) -> None:
        """End the process and whatever it started."""
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()
        self.listen()

    def close(self, grace_s: float = 3.0) -> None:
        """Leave nothing behind: a process that still runs is asked to end, then killed; its pipes are closed.

        The controller stops the car when it is asked to end; it gets the time for that even where this process fails.
        """
        if self.process.poll() is None:
            self.process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(grace_s)
        if self.process.poll() is None:
            self.kill()
        for pipe in (self.process.stdout, self.process.stderr):
            if pipe is not None:
                pipe.close()

    def write_complaints(self, path: Path) -> None:
        """Keep what the process wrote to stderr, if anything."""
        if self.complaints:
            path.write_text(self.complaints, encoding="utf-8")
