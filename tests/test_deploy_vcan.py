"""Preflight, bring-up, a flood and listening only on a real vcan0, in the guest where this machine has none."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tools.guest.image import why_not

ROOT = Path(__file__).resolve().parent.parent

pytestmark = [
    pytest.mark.live,
    pytest.mark.skipif(why_not() is not None, reason=f"no guest: {why_not()}"),
]

FLOOD = """
import socket, struct, time
bus = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
bus.bind(("vcan0",))
frame = struct.pack("=IB3x8s", 0x7F0, 8, bytes(8))
end_s = time.monotonic() + 60.0
while time.monotonic() < end_s:
    for _ in range(20):
        bus.send(frame)
    time.sleep(0.005)
"""

SESSION = f"""
step() {{ echo "== $1"; }}
controller() {{ "$PYTHON" -P -m firmware_py -i socketcan --no-config "$@" 2>&1; echo "status $?"; }}
for_seconds() {{
  "$PYTHON" -P -m firmware_py -i socketcan --no-config -c vcan0 --status "${{@:2}}" > /tmp/status.txt 2>&1 &
  local child=$!
  sleep "$1"; kill $child; wait $child; echo "status $?"; tail -n 1 /tmp/status.txt
}}
step missing; controller -c none0
step down; ip link set vcan0 down; controller -c vcan0
step down-preflight; controller -c vcan0 --preflight
step up; sh tools/deploy/can_up.sh vcan0; echo "status $?"
"$PYTHON" -m sim -i socketcan -c vcan0 > /dev/null 2>&1 & car=$!
"$PYTHON" -c '{FLOOD}' & flood=$!
candump -L vcan0,010:7FF,200:7FE > /tmp/own.log & dump=$!
step listen-only; for_seconds 8 --listen-only
echo "own frames $(wc -l < /tmp/own.log)"
step flood; for_seconds 8
kill $car $flood $dump; wait 2> /dev/null
echo "own frames $(wc -l < /tmp/own.log)"
"""


@pytest.fixture(scope="module")
def session() -> dict[str, str]:
    """What each step of the session said."""
    command = [
        sys.executable,
        "-m",
        "tools.cli",
        "guest",
        "--",
        "env",
        f"PYTHON={sys.executable}",
        "bash",
        "-c",
        SESSION,
    ]
    answer = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=240, check=False)
    steps = re.split(r"^== (\S+)\r?\n", answer.stdout, flags=re.MULTILINE)
    found = dict(zip(steps[1::2], steps[2::2], strict=True))
    assert list(found) == ["missing", "down", "down-preflight", "up", "listen-only", "flood"], answer
    return found


def final(text: str) -> dict[str, object]:
    content = json.loads(next(line for line in text.splitlines() if line.startswith('{"final"')))["final"]
    assert isinstance(content, dict)
    return content


def test_an_interface_that_is_missing_or_down_is_one_line(session: dict[str, str]) -> None:
    assert session["missing"].splitlines() == [
        "parkctl: error: CAN interface socketcan none0: cannot be opened "
        "(there is no such interface; `ip link` lists those that there are)",
        "status 2",
    ]
    assert session["down"].splitlines() == [
        "parkctl: error: not to be armed: interface: vcan0 is down: ip link set vcan0 up",
        "status 2",
    ]
    lines = session["down-preflight"].splitlines()
    assert lines[-2:] == ["preflight: 2 of 4 passed; do not arm: interface, the rest", "status 1"]


def test_bring_up_brings_it_up(session: dict[str, str]) -> None:
    assert session["up"].splitlines()[-1] == "status 0"
    assert re.search(r"vcan0: <[A-Z_,]*\bUP\b.*qlen 128", session["up"])


def test_listening_only_hears_the_car_and_the_bus_never_gets_a_frame(session: dict[str, str]) -> None:
    figures = final(session["listen-only"])
    assert (figures["listen_only"], figures["frames_sent"]) == (True, 0)
    assert int(str(figures["frames_received"])) > 500
    assert str(figures["reason_text"]).startswith("waiting for the operator station")
    assert "own frames 0" in session["listen-only"].splitlines()


def test_a_flood_of_foreign_ids_does_not_reach_the_controller(session: dict[str, str]) -> None:
    """The kernel's filters drop it; the reports come through it."""
    figures = final(session["flood"])
    assert (figures["frames_foreign"], figures["drains_cut"], figures["frames_rejected"]) == (0, 0, 0)
    assert int(str(figures["frames_received"])) > 500
    assert int(str(figures["frames_sent"])) > 500
    assert str(figures["reason_text"]).startswith("waiting for the operator station")
    assert int(session["flood"].rpartition("own frames ")[2]) > 200, "what listening only is compared with"
