"""The embedded bus between processes: sudden death, restart, and the programs that people already use."""

from __future__ import annotations

import contextlib
import os
import pty
import re
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import pytest
from wire_support import Open, base_fixture, drain, frame, open_node_fixture  # noqa: F401 -- fixtures

from firmware_py.codec import Sender, load_codec
from firmware_py.core.signals import MotionReport, SteerCommand

pytestmark = pytest.mark.live

ROOT = Path(__file__).resolve().parent.parent
DBC = ROOT / "dbc/parking.dbc"
PROGRAMS = Path(sys.executable).parent
DEADLINE_S = 20.0

ECHO = """
import sys, can
bus = can.Bus(interface="loopbus", channel=sys.argv[1], ignore_config=True)
print("open", flush=True)
while True:
    message = bus.recv(1.0)
    if message is not None and message.arbitration_id < 0x400:
        message.arbitration_id += 0x400
        bus.send(message)
"""

Start = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture
def start() -> Iterator[Start]:
    children: list[subprocess.Popen[str]] = []

    def start(*command: str | Path, **options: object) -> subprocess.Popen[str]:
        children.append(
            subprocess.Popen(
                [str(part) for part in command],
                stdout=options.pop("stdout", subprocess.PIPE),  # type: ignore[call-overload]
                stderr=subprocess.STDOUT,
                text=True,
                cwd=ROOT,
                **options,
            )
        )
        return children[-1]

    yield start
    for child in children:
        if child.poll() is None:
            child.kill()
        child.wait()
        if child.stdout:
            child.stdout.close()


def start_echo(start: Start, base: int) -> subprocess.Popen[str]:
    child = start(sys.executable, "-c", ECHO, str(base))
    assert child.stdout is not None
    assert child.stdout.readline() == "open\n"
    return child


def wait_for(condition: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline, what
        time.sleep(0.01)


def test_two_processes_exchange_frames(open_node: Open, base: int, start: Start) -> None:
    node = open_node()
    start_echo(start, base)
    for number in range(300):
        node.send(frame(number % 0x300))
        answer = node.recv(2.0)
        assert answer is not None
        assert answer.arbitration_id == number % 0x300 + 0x400


def test_a_peer_that_is_killed_is_silence_and_its_successor_works_at_once(
    open_node: Open, base: int, start: Start
) -> None:
    node = open_node()
    for turn in range(3):
        child = start_echo(start, base)
        node.send(frame(turn))  # the very first frame to the new peer
        answer = node.recv(2.0)
        assert answer is not None, f"life {turn}"
        assert answer.arbitration_id == turn + 0x400
        child.send_signal(signal.SIGKILL)
        child.wait()
        for _ in range(100):
            node.send(frame(0x300))
        assert node.recv(0.05) is None


def test_a_peer_that_is_stopped_gets_its_frames_when_it_goes_on(open_node: Open, base: int, start: Start) -> None:
    """SIGSTOP: what came meanwhile waits in the kernel, in order."""
    node = open_node()
    child = start_echo(start, base)
    child.send_signal(signal.SIGSTOP)
    for number in range(100):
        node.send(frame(number))
    assert node.recv(0.05) is None
    child.send_signal(signal.SIGCONT)
    answers = [node.recv(2.0) for _ in range(100)]
    assert [m.arbitration_id for m in answers if m] == [number + 0x400 for number in range(100)]


def steady_traffic(node: can.BusABC, until: Callable[[], bool], what: str) -> int:
    """Send steering and motion frames at about 200 Hz until the condition holds; return the number of rounds."""
    codec = load_codec(DBC)
    sender = Sender(codec)
    deadline = time.monotonic() + DEADLINE_S
    rounds = 0
    while not until():
        assert time.monotonic() < deadline, what
        for name, values in (
            ("CTRL_SteerCmd", SteerCommand(0.1, 1)),
            ("VEH_MotionRpt", MotionReport(-0.5, 0.25, 1, 1)),
        ):
            number, data = sender.pack(name, values)
            node.send(can.Message(arbitration_id=number, data=data, is_extended_id=False))
        rounds += 1
        time.sleep(0.005)
    return rounds


def test_can_logger_records_what_cantools_decodes_and_can_player_plays_again(
    open_node: Open, base: int, start: Start, tmp_path: Path
) -> None:
    log = tmp_path / "bus.log"
    node = open_node()
    logger = start(PROGRAMS / "can_logger", "-i", "loopbus", "-c", str(base), "-f", log)

    def recorded() -> int:
        return log.read_text().count("\n") if log.exists() else 0

    def flushed() -> bool:
        return recorded() > 100

    steady_traffic(node, flushed, "can_logger records nothing")
    logger.send_signal(signal.SIGINT)
    logger.wait(DEADLINE_S)
    lines = log.read_text().splitlines()
    times = [float(line[1:].partition(")")[0]) for line in lines]
    assert times == sorted(times)
    assert abs(times[-1] - time.time()) < 60

    decoded = subprocess.run(
        [PROGRAMS / "cantools", "decode", "--single-line", DBC],
        input=log.read_text(),
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    steer = re.findall(r"CTRL_SteerCmd\(.*road_wheel_angle_cmd_rad: ([-.\d]+) rad, steer_enable: 1\)", decoded)
    motion = re.findall(
        r"VEH_MotionRpt\(.*speed_meas_mps: ([-.\d]+) m/s, yaw_rate_meas_radps: ([-.\d]+) rad/s", decoded
    )
    assert len(steer) + len(motion) == len(lines)
    assert {float(value) for value in steer} == {0.1}
    assert {(float(v), float(w)) for v, w in motion} == {(-0.5, 0.25)}

    listener = open_node()
    player = subprocess.run(
        [PROGRAMS / "can_player", "-i", "loopbus", "-c", str(base), "--ignore-timestamps", log],
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
        check=True,
    )
    played = [(m.arbitration_id, bytes(m.data).hex().upper()) for m in drain(listener)]
    assert played == [(int(n, 16), d) for n, d in re.findall(r" ([0-9A-F]+)#([0-9A-F]*)", log.read_text())], (
        player.stderr
    )


@pytest.mark.parametrize(
    ("command", "shown"),
    [
        ([PROGRAMS / "cantools", "monitor", DBC], b"VEH_MotionRpt"),
        ([PROGRAMS / "can_viewer"], b"0x101"),
    ],
    ids=["cantools monitor", "can_viewer"],
)
def test_programs_with_a_screen_show_the_traffic(
    open_node: Open, base: int, command: list[str | Path], shown: bytes
) -> None:
    """Run on a terminal of its own, until the message is on the screen; then the key q ends it."""
    node = open_node()
    child, terminal = pty.fork()
    if child == 0:
        os.environ |= {"TERM": "xterm", "LINES": "40", "COLUMNS": "120"}
        arguments = [str(part) for part in [*command, "-i", "loopbus", "-c", base]]
        os.execv(arguments[0], arguments)
    screen = bytearray()

    def on_screen() -> bool:
        if select.select([terminal], [], [], 0)[0]:
            screen.extend(os.read(terminal, 65536))
        return shown in screen

    try:
        steady_traffic(node, on_screen, f"not on the screen: {bytes(screen)!r}")
        os.write(terminal, b"q")

        def ended() -> bool:
            if select.select([terminal], [], [], 0)[0]:
                with contextlib.suppress(OSError):
                    os.read(terminal, 65536)
            return os.waitpid(child, os.WNOHANG)[0] == child

        wait_for(ended, "the key q does not end it")
        child = 0
    finally:
        if child:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
        os.close(terminal)
