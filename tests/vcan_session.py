"""What the tests of the real vcan0 do inside the guest: one boot, four runs, all results as files in FOLDER.

`python vcan_session.py FOLDER IDS [STEP ...]`: IDS are the frame ids, in hexadecimal, that a replay feeds to the
controller; without a step all of them.
Standard library only: every import costs its time again in the guest.
"""

from __future__ import annotations

import fcntl
import json
import os
import pty
import random
import shutil
import signal
import statistics
import struct
import subprocess
import sys
import termios
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

FOLDER = Path(sys.argv[1])
FED_IDS = set(sys.argv[2].split(","))
ROOT = Path(__file__).resolve().parent.parent
BUS = ["-i", "socketcan", "-c", "vcan0"]
ACTIVE, FAULT = 2, 3
FORWARD, REVERSE = 1, 3
FORGED_EACH = 5
ERROR_FRAMES = 4
FLOOD_S = 5.0
LEAD_IN_S = 0.4
LEAD_IN_FRAMES = 40
"""As many of a sensor's frames as there are cycles in the lead-in: each comes once more."""
LEAD_IN_CHOICES = 2000
POSE_FIELDS = {"600": ((12, 25), (37, 25)), "601": ((12, 24),)}
"""First bit and length of position x and y, and of the yaw."""
SLOWEST_MOVING = 100
"""Of the measured speed, in its steps of 0.1 mm/s."""
FED_EARLIER_S = 0.005
"""So much earlier in the controller's cycle frames are fed than they were recorded: canplayer is 2 to 3 ms late in the
guest, and they come in the middle then, with room on both sides."""
CYCLE_S = 0.01
SET_PIPE_SIZE = 1031
"""fcntl.F_SETPIPE_SZ, for an interpreter without it."""
FED_AFTER_START_S = 9.0
"""So long after the start button the recorded frames are fed."""
ATTEMPTS = 3
SCREEN = (260, 110)

figures: dict[str, Any] = {}


def fifo(priority: int) -> Callable[[], None]:
    def enter() -> None:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))

    return enter


def start(*command: object, priority: int | None = None, **files: Any) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [str(part) for part in command],
        stdin=subprocess.DEVNULL,
        preexec_fn=None if priority is None else fifo(priority),  # noqa: PLW1509
        **files,
    )


def candump(name: str, *what: str) -> subprocess.Popen[bytes]:
    """Record the bus, after everybody else: what waits is kept in a large buffer of the kernel."""
    command = ["candump", "-D", "-r", "8000000", "-L", *(what or ["vcan0"])]
    process = start(*command, priority=5, stdout=(FOLDER / name).open("wb"))
    time.sleep(0.3)
    return process


def end(process: subprocess.Popen[bytes], number: int = signal.SIGTERM, limit_s: float = 20.0) -> int:
    process.send_signal(number)
    try:
        return process.wait(limit_s)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()


def end_recorder(process: subprocess.Popen[bytes], limit_s: float = 20.0) -> None:
    """End candump once it sleeps: ended while it is waiting for the CPU, it would leave in its socket what is there."""
    limit = time.monotonic() + limit_s
    asleep = 0
    while asleep < 4 and time.monotonic() < limit and process.poll() is None:
        time.sleep(0.05)
        state = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()[0]
        asleep = asleep + 1 if state == "S" else 0
    end(process)


def run(*command: str) -> None:
    """Run a tool, after the processes of the drive and before all else: a busy machine must not outlast the drive."""
    subprocess.run(command, check=True, stdin=subprocess.DEVNULL, preexec_fn=fifo(6))


class Controller:
    """The controller's process alone, with its reports in a file."""

    def __init__(self, name: str) -> None:
        self.said = emptied(name) / "controller.jsonl"
        self.process = start(
            *(sys.executable, "-P", "-m", "firmware_py", *BUS, "--no-config", "--once", "--status"),
            *("--realtime", "required", "--out", FOLDER / name),
            stdout=self.said.open("wb"),
            stderr=(FOLDER / name / "controller.txt").open("wb"),
        )

    def reports(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in self.said.read_text().splitlines()]

    def wait_for(self, condition: Callable[[dict[str, Any]], bool], limit_s: float) -> bool:
        limit = time.monotonic() + limit_s
        while time.monotonic() < limit and self.process.poll() is None:
            reports = self.reports()
            if reports and condition(reports[-1]):
                return True
            time.sleep(0.05)
        return False


def on_its_way(report: dict[str, Any]) -> bool:
    """Whether the car drives on a leg, some way from both ends of it."""
    driving = report.get("mode") == ACTIVE and report.get("leg") in (FORWARD, REVERSE) and not report["standstill"]
    return driving and abs(report["station_m"]) > 1.0


def manoeuvre() -> None:
    """The whole test by `parkctl demo`, with candump beside it."""
    recorder = candump("candump.log")
    began_s = time.monotonic()
    demo = subprocess.run(
        ["parkctl", "demo", *BUS, "--out", str(FOLDER / "run"), "--no-plots"],
        capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL,
    )  # fmt: skip
    figures["demo"] = {"status": demo.returncode, "error": demo.stderr, "duration_s": time.monotonic() - began_s}
    (FOLDER / "demo.txt").write_text(demo.stdout)
    time.sleep(0.2)
    end_recorder(recorder)


def until_driven(step: Callable[[], bool]) -> None:
    """Take a step, and again where the car was stopped before: one CPU may be too busy to keep all timeouts."""
    attempt = 1
    while not step() and attempt < ATTEMPTS:
        attempt += 1
    figures[f"{step.__name__}_attempts"] = attempt


def emptied(name: str) -> Path:
    shutil.rmtree(FOLDER / name, ignore_errors=True)
    (FOLDER / name).mkdir()
    return FOLDER / name


def disturbed() -> bool:
    """Forged frames, error frames, load; at last the interface goes down and up while the car drives.

    Returns whether it did drive then.
    """
    recorder = candump("disturbed.log", "vcan0,0:0,#FFFFFFFF")
    folder = emptied("disturbed")
    car = start(
        *(sys.executable, "-P", "-m", "sim", *BUS, "--out", folder),
        stderr=(folder / "emulator.txt").open("wb"),
    )
    controller = Controller("disturbed_controller")
    operator = start(
        "parkctl", "operate", *BUS, "--auto", priority=10, stdout=(folder / "operate.txt").open("wb"),
        stderr=subprocess.STDOUT,
    )  # fmt: skip
    driving = controller.wait_for(lambda report: report.get("mode") == ACTIVE, 60.0)
    time.sleep(2.0)
    for _ in range(FORGED_EACH):
        run("cansend", "vcan0", "101#DEADBEEFDEADBEEF")  # VEH_MotionRpt
        run("cansend", "vcan0", "600#0000000000000000")  # LOC_Position
    for _ in range(ERROR_FRAMES):
        run("cansend", "vcan0", "20000004#0004000000000000")  # the controller of the bus: receive buffer overflow
    began_s = time.monotonic()
    run("cangen", "vcan0", "-I", "7A5", "-L", "8", "-D", "i", "-g", "5", "-n", "400")
    figures["load_s"] = time.monotonic() - began_s
    time.sleep(0.3)
    before = controller.reports()[-1]
    # A machine that was busy meanwhile may have brought the car to the end of a leg, where it stands anyway.
    moving = controller.wait_for(on_its_way, 30.0)
    run("ip", "link", "set", "vcan0", "down")
    figures["down_unix_s"] = time.time()
    noticed = controller.wait_for(lambda report: report.get("mode") == FAULT, 8.0)
    run("ip", "link", "set", "vcan0", "up")
    status = wait_or_kill(controller.process, 30.0)
    figures["disturbed"] = {
        "driving": driving,
        "before": before,
        "moving": moving,
        "noticed": noticed,
        "controller_status": status,
        "final": controller.reports()[-1].get("final"),
        "operator_status": wait_or_kill(operator),
        "emulator_status": end(car, signal.SIGINT),
    }
    end_recorder(recorder)
    return moving


def packets() -> int:
    return int(Path("/sys/class/net/vcan0/statistics/tx_packets").read_text())


def flooded() -> bool:
    """Foreign frames as fast as they can be sent, while the car drives; then the operator stops it.

    Returns whether it drove before the flood.
    """
    folder = emptied("flood")
    car = start(
        *(sys.executable, "-P", "-m", "sim", *BUS, "--status", "--out", folder),
        stdout=(folder / "emulator.jsonl").open("wb"), stderr=(folder / "emulator.txt").open("wb"),
    )  # fmt: skip
    controller = Controller("flood_controller")
    operator = start(
        "parkctl", "operate", *BUS, "--auto", priority=10, stdout=(folder / "operate.txt").open("wb"),
        stderr=subprocess.STDOUT,
    )  # fmt: skip
    driving = controller.wait_for(lambda report: report.get("mode") == ACTIVE, 60.0)
    time.sleep(2.0)
    before, sent = controller.reports()[-1], packets()
    began_s = time.monotonic()
    generator = start("cangen", "vcan0", "-i", "-g", "0", "-I", "7A5", "-L", "8")
    time.sleep(FLOOD_S)
    rate = (packets() - sent) / (time.monotonic() - began_s)
    figures["flood"] = {"driving": driving, "frames_per_s": rate, "before": before}
    end(generator)
    time.sleep(0.5)
    after = controller.reports()[-1]
    figures["flood"] |= {
        "after": after,
        "operator_status": end(operator, signal.SIGINT),
        "controller_status": wait_or_kill(controller.process),
        "emulator_status": end(car, signal.SIGINT),
        "final": controller.reports()[-1].get("final"),
    }
    return before.get("mode") == ACTIVE


def disturbances() -> None:
    until_driven(disturbed)


def flood() -> None:
    until_driven(flooded)


def wait_or_kill(process: subprocess.Popen[bytes], limit_s: float = 20.0) -> int | None:
    """Return the exit status of a process that should end by itself; None where it hangs."""
    try:
        return process.wait(limit_s)
    except subprocess.TimeoutExpired:
        process.kill()
        return None


def crc8(data_id: int, data: bytes) -> int:
    crc = 0
    for byte in (data_id & 0xFF, data_id >> 8, *data[1:]):
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x1D if crc & 0x80 else crc << 1) & 0xFF
    return crc


def signed(payload: bytes, first_bit: int, bits: int) -> int:
    """A signal of a frame, little-endian."""
    raw = int.from_bytes(payload, "little") >> first_bit & (1 << bits) - 1
    return raw - (1 << bits) if raw >> (bits - 1) else raw


def usual(frames: dict[str, list[bytes]]) -> list[int]:
    """Which frames of the standing car's localisation come once more in the lead-in.

    Of many choices the one whose mean is most like that of all: otherwise the estimator's average, and with it the
    start of the replay, would be 0.3 mm another.
    """
    count = min(len(of) for of in frames.values())
    rows = [[signed(of[i], *field) for name, of in frames.items() for field in POSE_FIELDS[name]] for i in range(count)]
    means = [statistics.fmean(column) for column in zip(*rows, strict=True)]
    spreads = [statistics.pstdev(column) or 1.0 for column in zip(*rows, strict=True)]
    rng = random.Random(1)

    def unlikeness(chosen: list[int]) -> float:
        columns = zip(*(rows[i] for i in chosen), strict=True)
        found = zip(columns, means, spreads, strict=True)
        return sum(((statistics.fmean(column) - mean) / spread) ** 2 for column, mean, spread in found)

    choices = (rng.sample(range(count), min(LEAD_IN_FRAMES, count)) for _ in range(LEAD_IN_CHOICES))
    return min(choices, key=unlikeness)


def lead_in(lines: list[str]) -> list[str]:
    """Frames of the standing car, for a time before the first ones, with the counters that come before theirs.

    The recorded operator pressed start the moment the recorded controller was Ready; this one is Ready some cycles
    later or earlier, and is given the time for it.
    """
    first: dict[str, list[tuple[float, bytes]]] = {}
    stands = True
    for line in lines:
        time_s, _, frame = line.split()
        name, _, data = frame.partition("#")
        stands = stands and not (name == "101" and abs(signed(bytes.fromhex(data), 12, 24)) > SLOWEST_MOVING)
        if name in FED_IDS and (len(first.setdefault(name, [])) < LEAD_IN_FRAMES or (stands and name in POSE_FIELDS)):
            first[name].append((float(time_s[1:-1]), bytes.fromhex(data)))
    poses = usual({name: [data for _, data in first[name]] for name in POSE_FIELDS})
    end_s = max(kept[0][0] for kept in first.values())
    made = []
    for name, kept in first.items():
        start_s, data = kept[0]
        period_s = round((kept[9][0] - start_s) / 9, 2)
        count = round((start_s - (end_s - LEAD_IN_S)) / period_s)
        order = poses if name in POSE_FIELDS else range(len(kept))
        for before in range(1, count + 1):
            # Of the sensors a different one each time, as of one alone the estimator would learn the noise.
            payload = bytearray(data if name == "020" else kept[order[before % len(order)]][1])
            payload[1] = payload[1] & 0xF0 | ((data[1] & 0x0F) - before) % 15
            payload[0] = crc8(int(name, 16), payload)
            made.append((start_s - before * period_s, name, payload))
    return [f"({time_s:.6f}) vcan0 {name}#{payload.hex().upper()}" for time_s, name, payload in sorted(made)]


def play(file: Path) -> int:
    """Run canplayer such that the frames come at the phase of the controller's cycle at which they were recorded.

    At another one they might come as the cycle begins, some before and some after it. canplayer's time begins with the
    first line that it gets, and the controller's cycle with multiples of 10 ms of the monotonic clock.
    """
    text = file.read_bytes()
    recorded_s = float(text[1 : text.index(b")")]) - (time.time() - time.monotonic())
    reading, writing = os.pipe()
    fcntl.fcntl(writing, SET_PIPE_SIZE, len(text))
    player = subprocess.Popen(["canplayer"], stdin=reading, preexec_fn=fifo(75))  # noqa: PLW1509
    os.close(reading)
    time.sleep(1.0)  # it waits for its first line by now
    time.sleep((recorded_s - FED_EARLIER_S - time.monotonic()) % CYCLE_S)
    os.write(writing, text)
    os.close(writing)
    return player.wait()


def replay() -> None:
    """The recorded frames of car, localisation and operator, fed by canplayer; cantools monitor on a terminal."""
    fed = FOLDER / "fed.log"
    begin_s = None
    lines = (FOLDER / "run/bus.log").read_text().splitlines()
    lines = sorted([*lead_in(lines), *lines], key=lambda line: float(line[1 : line.index(")")]))
    with fed.open("w") as file:
        for line in lines:
            time_s, _, frame = line.split()
            frame_id, _, data = frame.partition("#")
            if frame_id not in FED_IDS:
                continue
            if begin_s is None and frame_id == "030" and int(data[2:4], 16) & 0x10:  # oper_start
                begin_s = float(time_s[1:-1])
            if begin_s is not None and float(time_s[1:-1]) > begin_s + FED_AFTER_START_S:
                break
            file.write(line + "\n")
    screen, terminal = pty.openpty()
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", *SCREEN, 0, 0))
    monitor = subprocess.Popen(
        [Path(sys.executable).parent / "cantools", "monitor", *BUS, ROOT / "dbc/parking.dbc"],
        stdin=terminal, stdout=terminal, stderr=terminal, start_new_session=True,
        env=os.environ | {"TERM": "linux", "LINES": str(SCREEN[0]), "COLUMNS": str(SCREEN[1])},
    )  # fmt: skip
    reader = start(sys.executable, "-c", COPY, FOLDER / "screen.txt", pass_fds=[screen], env={"FD": str(screen)})
    time.sleep(4.0)  # the monitor loads
    for attempt in range(1, ATTEMPTS + 1):
        recorder = candump("replayed.log")
        controller = Controller(f"replayed{attempt}")
        ready = controller.wait_for(lambda report: True, 30.0)
        status = play(fed)
        driven = any(report.get("mode") == ACTIVE for report in controller.reports())
        end(controller.process, signal.SIGKILL)  # it would wait for a car to stand that is not there
        end_recorder(recorder)
        figures["replay"] = {"ready": ready, "player_status": status, "attempts": attempt}
        if driven:
            break
    os.write(screen, b"q")
    try:
        figures["replay"]["monitor_status"] = monitor.wait(20.0)
    except subprocess.TimeoutExpired:
        monitor.kill()
    end(reader)


COPY = """
import os, sys
with open(sys.argv[1], "wb") as file:
    try:
        while True:
            file.write(os.read(int(os.environ["FD"]), 65536))
            file.flush()
    except OSError:
        pass  # the other end is closed
"""


if __name__ == "__main__":
    # The drive takes most of the one CPU, and the flood all that is left of it.
    os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(6))
    steps = {step.__name__: step for step in (manoeuvre, disturbances, flood, replay)}
    for step in [steps[name] for name in sys.argv[3:]] or steps.values():
        began_s = time.monotonic()
        step()
        figures[f"{step.__name__}_s"] = time.monotonic() - began_s
        (FOLDER / "session.json").write_text(json.dumps(figures, indent=2))
