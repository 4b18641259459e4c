"""The real driver of a physical CAN interface: `make test-can-hw`, not part of `make test`.

An emulated machine with two Kvaser cards on one bus; both interfaces are brought up by tools/deploy/can_up.sh, and the
car takes the whole test in slow motion, for translated code cannot keep 10 ms. `can_hw_session.py` does it in the
machine; here its files are judged.
"""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from tools.guest import hardware

ROOT = Path(__file__).resolve().parent.parent
SLOW_MOTION = os.environ.get("SLOW_MOTION", "15")
BOOT_AND_IMPORTS_S = 90
TEST_S = 36


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    reason = hardware.why_not()
    if reason is not None:
        pytest.exit(reason, returncode=2)
    results = tmp_path_factory.mktemp("can_hw")
    minutes = (BOOT_AND_IMPORTS_S + TEST_S * int(SLOW_MOTION)) / 60
    print(f"\na second of the car lasts {SLOW_MOTION} (SLOW_MOTION=N changes that); takes about {minutes:.0f} min")
    began_s = time.monotonic()
    done = subprocess.run(
        [
            *(sys.executable, "-m", "tools.cli", "guest", "--hardware", "--verbose", "--results", str(results), "--"),
            *(sys.executable, "tests/can_hw_session.py", str(results), SLOW_MOTION),
        ],
        cwd=ROOT,
        check=False,
        timeout=60 * minutes * 2 + 300,
    )
    print(f"took {(time.monotonic() - began_s) / 60:.1f} min")
    assert done.returncode == 0
    return results


@pytest.fixture(scope="module")
def session(folder: Path) -> dict[str, Any]:
    figures: dict[str, Any] = json.loads((folder / "session.json").read_text())
    return figures


@pytest.mark.parametrize("channel", ["can0", "can1"])
def test_the_script_brings_the_interface_up(session: dict[str, Any], folder: Path, channel: str) -> None:
    assert session[f"{channel}_up_status"] == 0, (folder / f"{channel}_up.txt").read_text()
    link = session[channel]
    assert {"UP", "LOWER_UP"} <= set(link["flags"])
    assert link["txqlen"] == 128
    card = link["linkinfo"]["info_data"]
    assert (card["state"], card["restart_ms"], card["bittiming"]["bitrate"]) == ("ERROR-ACTIVE", 100, 500000)
    assert card["berr_counter"] == {"tx": 0, "rx": 0}


def test_the_car_is_armed_and_takes_the_whole_test(session: dict[str, Any]) -> None:
    assert session.get("why") is None
    active = [state for state in session["states"] if state.startswith("Active")]
    assert active == ["Active Forward", "Active DirectionChange", "Active Reverse", "Active Complete"]
    final = session["final"]
    assert final["completed"], final["reason_text"]
    assert final["scheduler"] == "SCHED_FIFO", "required on a physical interface"
    assert (session["controller_status"], session["operator_status"], session["car_status"]) == (0, 0, 0)
    assert session["car"]["cones_touched"] == 0


def test_the_car_passes_the_examiner(session: dict[str, Any], folder: Path) -> None:
    exam = json.loads((folder / "car/exam.json").read_text())
    assert exam["passed"], exam["mistakes"]
    with (folder / "car/truth.csv").open() as file:
        speeds = [float(row["speed_mps"]) for row in csv.DictReader(file)]
    assert max(speeds) > 0.9
    assert min(speeds) < -0.9


def test_no_frame_is_lost_and_the_driver_counts_them(session: dict[str, Any]) -> None:
    final, car = session["final"], session["car"]
    assert (final["frames_lost"], final["frames_rejected"], final["send_failed"]) == (0, 0, 0)
    assert (car["lost"], car["rejected"]) == (0, 0)
    sent, received = session["can0"]["stats64"]["tx"], session["can1"]["stats64"]["rx"]
    assert sent["packets"] == received["packets"] >= final["frames_sent"]
    assert (sent["errors"], sent["dropped"], received["errors"], received["over_errors"]) == (0, 0, 0, 0)
