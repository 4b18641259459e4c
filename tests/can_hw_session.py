"""What the test of the CAN cards does inside the emulated machine; all results are files in FOLDER.

`python can_hw_session.py FOLDER SLOW_MOTION`: both interfaces are brought up by the project's own script; car and
operator are on can1, the controller is on can0, and each frame between them goes through two drivers and the bus.
Standard library only.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

FOLDER, SLOW_MOTION = Path(sys.argv[1]), sys.argv[2]
ROOT = Path(__file__).resolve().parent.parent
LEGS = ("Idle", "Forward", "DirectionChange", "Reverse", "Complete")
MODES = ("Manual", "Ready", "Active", "Fault")
START_LIMIT_S = 240.0
DRIVE_LIMIT_S = 40.0
"""Of the car's own time."""
SHOW_S = 15.0
OPERATOR_PRIORITY = 10

figures: dict[str, Any] = {}


def bring_up(channel: str) -> None:
    script = str(ROOT / "tools/deploy/can_up.sh")
    done = subprocess.run(["sh", script, channel], capture_output=True, text=True, check=False)
    (FOLDER / f"{channel}_up.txt").write_text(done.stdout + done.stderr)
    figures[f"{channel}_up_status"] = done.returncode


def link(channel: str) -> dict[str, Any]:
    said = subprocess.run(
        ["ip", "-details", "-statistics", "-json", "link", "show", "dev", channel],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    return json.loads(said.stdout)[0]


def before_ordinary_ones() -> None:
    os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(OPERATOR_PRIORITY))


def start(name: str, *command: str, first: bool = False) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-P", "-m", *command, "--slow-motion", SLOW_MOTION],
        stdin=subprocess.DEVNULL,
        stdout=(FOLDER / f"{name}.out").open("wb"),
        stderr=(FOLDER / f"{name}.err").open("wb"),
        cwd=ROOT,
        preexec_fn=before_ordinary_ones if first else None,  # noqa: PLW1509
    )


def newest(name: str) -> dict[str, Any]:
    lines = (FOLDER / f"{name}.out").read_bytes().splitlines(keepends=True)
    whole = [line for line in lines if line.endswith(b"\n")]
    return json.loads(whole[-1]) if whole else {}


def end(process: subprocess.Popen[bytes]) -> int:
    process.send_signal(signal.SIGINT)
    try:
        return process.wait(120.0)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()


def drive() -> None:
    began_s = time.monotonic()
    (FOLDER / "controller").mkdir()
    car = start("car", "sim", "-i", "socketcan", "-c", "can1", "--status", "--out", str(FOLDER / "car"))
    controller = start(
        "drive", "firmware_py", "-i", "socketcan", "-c", "can0", "--no-config", "--once", "--status",
        "--out", str(FOLDER / "controller"),
    )  # fmt: skip
    operator = start("operate", "tools.cli", "operate", "-i", "socketcan", "-c", "can1", "--auto", first=True)
    active_s: float | None = None
    shown_s = 0.0
    seen: list[str] = []
    while controller.poll() is None:
        time.sleep(0.2)
        report, now_s = newest("drive"), time.monotonic()
        state = f"{MODES[report.get('mode', 0)]} {LEGS[report.get('leg', 0)]}" if report else "starting"
        if active_s is None and state.startswith("Active"):
            active_s = now_s
        if state not in seen or now_s - shown_s > SHOW_S:
            shown_s = now_s
            seen += [state] if state not in seen else []
            moment = newest("car")
            print(
                f"{now_s - began_s:4.0f} s  {state:<22} {moment.get('speed_mps', 0.0):+.2f} m/s  "
                f"loop late p99 {1e-3 * report.get('wake_late_p99_us', 0.0) * int(SLOW_MOTION):.0f} ms",
                flush=True,
            )
        if active_s is None and now_s - began_s > START_LIMIT_S:
            figures["why"] = f"not started: {report.get('reason_text')}"
            break
        if active_s is not None and now_s - active_s > DRIVE_LIMIT_S * int(SLOW_MOTION):
            figures["why"] = "not ended"
            break
    if active_s is not None:
        figures["drive_s"] = time.monotonic() - active_s
    figures["states"] = seen
    figures["controller_status"] = end(controller) if controller.poll() is None else controller.returncode
    figures["operator_status"] = end(operator)
    figures["car_status"] = end(car)
    figures["final"] = newest("drive").get("final")
    figures["car"] = newest("car")


if __name__ == "__main__":
    for channel in ("can0", "can1"):
        bring_up(channel)
    drive()
    for channel in ("can0", "can1"):
        figures[channel] = link(channel)
    (FOLDER / "session.json").write_text(json.dumps(figures, indent=2))
    os.sync()
