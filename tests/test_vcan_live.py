"""The project on a real vcan0 of a real kernel, beside the programs that CAN people use: one boot, three runs.

`vcan_session.py` does it in the guest; the tests here judge the files that it left.
"""

from __future__ import annotations

import bisect
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import cantools.database
import pytest

from sim.can_side import CanSide
from tools.guest import image
from tools.operator_station import DBC

pytestmark = pytest.mark.live

ROOT = Path(__file__).resolve().parent.parent
PARKCTL = [sys.executable, "-m", "tools.cli"]
DATABASE = cantools.database.load_file(DBC)
FED_NODES = {"VEH", "LOC", "OPER"}
SAME_TIME_S = 0.015
"""A replayed command may come so much earlier or later than the recorded one: its cycle, or the next or last one."""
SAME_STEER_RAD, SAME_SPEED_MPS = 0.016, 0.016
"""99 % of the replayed commands are as near as that to a recorded one of the same time, and half within a half.

Nothing closes the loop of a replay, and in a bend the learnt gain of the steering takes up what the commands differ by.
Cycles that got two poses or none in one run only, as on a busy machine, and the lead-in's poses (`usual` in
`vcan_session.py`) leave an estimate behind that is 0.1 mm another: 0.005 and 0.007 rad of 0.45 were seen of it. What
sets off a cycle earlier or later is 10 mm from where it was at 1 m/s, for which the law asks 0.008 m/s.
"""
WORST = 2.0
"""None is further off than so many times that."""

Log = list[tuple[float, int, bytes, bool]]
"""Time in s, frame id, data, is error frame."""


def need_guest() -> None:
    reason = image.why_not()
    if reason is not None:
        assert os.environ.get("CI") != "true", reason
        pytest.skip(reason)


def children_of(pid: int) -> list[int]:
    return [int(number) for number in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def load_log(path: Path) -> Log:
    frames = []
    for line in path.read_text().splitlines():
        time_text, _, frame = line.split()
        name, _, data = frame.partition("#")
        number = int(name, 16)
        frames.append((float(time_text[1:-1]), number & 0x1FFFFFFF, bytes.fromhex(data), bool(number & 0x20000000)))
    return frames


class Session:
    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.figures: dict[str, Any] = json.loads((folder / "session.json").read_text())


@pytest.fixture(scope="session")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    need_guest()
    folder = tmp_path_factory.mktemp("vcan")
    ids = ",".join(f"{m.frame_id:03X}" for m in DATABASE.messages if set(m.senders) & FED_NODES)
    done = subprocess.run(
        [*PARKCTL, "guest", "--results", str(folder), "--", sys.executable, "tests/vcan_session.py", str(folder), ids],
        capture_output=True, text=True, cwd=ROOT, check=False, timeout=480,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return Session(folder)


# --------------------------------------------------------------------------------------------------------- manoeuvre


def test_the_whole_manoeuvre_passes_on_vcan0(session: Session) -> None:
    assert (session.figures["demo"]["status"], session.figures["demo"]["error"]) == (0, "")
    figures = json.loads((session.folder / "run/figures.json").read_text())
    assert figures["bus"] == {"interface": "socketcan", "channel": "vcan0"}
    assert (figures["passed"], figures["score"], figures["cones_touched"]) == (True, 100, 0)
    assert (figures["frames"]["lost"], figures["frames"]["rejected"]) == (0, 0)
    assert figures["loop"]["scheduler"] == "SCHED_FIFO"
    assert figures["loop"]["overruns"] <= 0.01 * figures["loop"]["cycles"]


def test_candump_and_our_log_hold_the_same_frames(session: Session) -> None:
    """Frame for frame; the order of what this process sent itself is that of its own clock."""
    ours, theirs = load_log(session.folder / "run/bus.log"), load_log(session.folder / "candump.log")
    assert len(ours) > 30000
    assert Counter(frame[1:] for frame in ours) == Counter(frame[1:] for frame in theirs)
    own_id = DATABASE.get_message_by_name("OPER_Cmd").frame_id
    received = [frame for frame in ours if frame[1] != own_id]
    dumped = [frame for frame in theirs if frame[1] != own_id]
    assert [frame[1:] for frame in received] == [frame[1:] for frame in dumped]
    assert max(abs(a[0] - b[0]) for a, b in zip(received, dumped, strict=True)) <= 2e-6


def test_cantools_decode_shows_every_signal_with_its_unit(session: Session) -> None:
    text = "".join((session.folder / "candump.log").read_text().splitlines(keepends=True)[-3000:])
    decoded = subprocess.run(
        [Path(sys.executable).parent / "cantools", "decode", "--single-line", DBC],
        input=text, capture_output=True, text=True, check=True, timeout=60,
    ).stdout  # fmt: skip
    for message in DATABASE.messages:
        for item in message.signals:
            unit = f" {re.escape(item.unit)}" if item.unit else ""
            assert re.search(rf"{message.name}\(.*\b{item.name}: [-\w.']+{unit}[,)]", decoded), item.name


# ------------------------------------------------------------------------------------------------------ disturbances


def test_forged_frames_are_rejected_and_counted(session: Session) -> None:
    disturbed = session.figures["disturbed"]
    assert disturbed["driving"] is True
    assert disturbed["before"]["mode"] == 2, "still driving after forged frames, error frames and load"
    frames = load_log(session.folder / "disturbed.log")
    forged = sum(data == bytes.fromhex("DEADBEEFDEADBEEF") for _, _, data, _ in frames)
    assert forged == 5
    # Each of the ten has a wrong CRC; two more are the first ones after the interface was down.
    counts = DATABASE.get_message_by_name("CTRL_HealthCounts")
    seen = [
        counts.decode(data)["rejected_crc_count"]
        for time_s, number, data, _ in frames
        if number == counts.frame_id and time_s < session.figures["down_unix_s"]
    ]
    assert seen[0] == 0
    assert seen[-1] == 10
    assert 10 <= disturbed["final"]["frames_rejected"] <= 14


def test_error_frames_are_seen_and_counted(session: Session) -> None:
    assert session.figures["disturbed"]["final"]["error_frames"] == 4
    errors = [frame for frame in load_log(session.folder / "disturbed.log") if frame[3]]
    assert [(number, data[1]) for _, number, data, _ in errors] == [(4, 4)] * 4


def test_a_load_of_foreign_frames_disturbs_nothing(session: Session) -> None:
    load = [frame for frame in load_log(session.folder / "disturbed.log") if frame[1] == 0x7A5]
    assert len(load) == 400
    assert session.figures["load_s"] < 8.0
    assert session.figures["disturbed"]["before"]["overruns"] < 20


def test_interface_down_and_up_is_survived_as_a_fault_and_reported(session: Session) -> None:
    disturbed, folder = session.figures["disturbed"], session.folder
    final = disturbed["final"]
    assert disturbed["moving"]
    assert disturbed["noticed"]
    assert disturbed["controller_status"] == 3, "ended in good order, stopped before the end"
    assert final["send_failed"] > 30
    assert re.search(
        r"^parkctl: stopped: .+ missing .*for its timeout",
        (folder / "disturbed_controller/controller.txt").read_text(),
        re.M,
    )
    assert (disturbed["operator_status"], disturbed["emulator_status"]) == (1, 0)
    assert re.search(r"stopped: .*Timeout", (folder / "disturbed/operate.txt").read_text())
    # Back on the bus, the controller says Fault; the plant's own watchdog has stopped the car. Nothing is on a bus that
    # is down, so all that comes after "down" is of "up" again; when the command for it returned says nothing.
    command = DATABASE.get_message_by_name("CTRL_SysCmd")
    after = [
        command.decode(data)
        for time_s, number, data, _ in load_log(folder / "disturbed.log")
        if number == command.frame_id and time_s > session.figures["down_unix_s"]
    ]
    assert len(after) > 10
    assert {str(values["control_mode"]) for values in after} == {"Fault"}
    truth = (folder / "disturbed/truth.csv").read_text().splitlines()
    column = truth[0].split(",").index("speed_mps")
    speeds = [float(line.split(",")[column]) for line in truth[1:]]
    assert max(speeds) > 0.3
    assert speeds[-1] == 0.0


# ------------------------------------------------------------------------------------------------------------- flood


def test_a_flood_of_foreign_ids_at_full_rate_is_driven_through(session: Session) -> None:
    """A generator without a pause: the kernel's filters keep it from car, controller and operator station."""
    flood, folder = session.figures["flood"], session.folder
    final = flood["final"]
    assert flood["driving"]
    assert flood["frames_per_s"] > 1800, "as many again as the bus carries beside it"
    assert (final["frames_foreign"], final["drains_cut"], final["receive_failed"]) == (0, 0, 0)
    statuses = flood["controller_status"], flood["operator_status"], flood["emulator_status"]
    if final["completed"]:  # a machine so busy that the session itself came late
        assert statuses == (0, 0, 0)
    else:  # stopped by the operator in the end, in good order on all sides
        assert flood["after"]["mode"] == 2, flood["after"]["reason_text"]
        assert flood["after"]["station_m"] > flood["before"]["station_m"] + 2.0 or flood["after"]["leg"] != 1
        assert final["reason_text"] == "stopped by the operator"
        assert statuses == (3, 0, 0)
    for said in (folder / "flood").glob("*.txt"):
        assert "Traceback" not in said.read_text(), said.name
    assert "Traceback" not in (folder / "flood_controller/controller.txt").read_text()


# ------------------------------------------------------------------------------------------------------------ replay


def commands(log: Log, message_name: str, signal_name: str) -> list[tuple[float, float]]:
    """(time in s since the operator's start, value) of a command while the controller drives."""
    side = CanSide(DBC, nodes=())
    start_s = next(
        time_s for time_s, number, data, _ in log
        if (decoded := side.decode(0, number, data)) and decoded[0] == "OPER_Cmd" and decoded[1]["oper_start"]
    )  # fmt: skip
    message = DATABASE.get_message_by_name(message_name)
    return [
        (time_s - start_s, float(message.decode(data, decode_choices=False)[signal_name]))
        for time_s, number, data, _ in log
        if number == message.frame_id
    ]


@pytest.mark.parametrize(
    ("message", "name", "tolerance", "moved"),
    [
        ("CTRL_SteerCmd", "road_wheel_angle_cmd_rad", SAME_STEER_RAD, 0.1),
        ("CTRL_LongCmd", "speed_cmd_mps", SAME_SPEED_MPS, 0.4),
    ],
)
def test_canplayer_makes_the_controller_give_its_commands_again(
    session: Session, message: str, name: str, tolerance: float, moved: float
) -> None:
    assert session.figures["replay"]["player_status"] == 0
    recorded = commands(load_log(session.folder / "run/bus.log"), message, name)
    replayed = [c for c in commands(load_log(session.folder / "replayed.log"), message, name) if 0.5 < c[0] < 8.5]
    assert len(replayed) > 780
    assert max(abs(value) for _, value in replayed) > moved, "the car was driving"
    times = [time_s for time_s, _ in recorded]
    off = []
    for time_s, value in replayed:
        near = recorded[bisect.bisect(times, time_s - SAME_TIME_S) : bisect.bisect(times, time_s + SAME_TIME_S)]
        off.append(min(abs(value - other) for _, other in near))
    off.sort()
    assert off[len(off) // 2] <= 0.5 * tolerance
    assert off[int(0.99 * len(off))] <= tolerance
    assert off[-1] <= WORST * tolerance


def screen_of(stream: str, rows: int, columns: int) -> list[str]:
    """What a terminal of the kind `linux` shows after all this: cursor moves, erasing, repeating."""
    screen = [[" "] * columns for _ in range(rows)]
    row = column = 0
    last = " "
    for part in re.finditer(r"\x1b\[([?\d;]*)([A-Za-z@])|\x1b.|([\s\S])", stream):
        text, action, character = part.groups()
        numbers = [int(n) for n in (text or "").strip("?").split(";") if n]
        first = numbers[0] if numbers else 1
        if character == "\r":
            column = 0
        elif character == "\n":
            row = min(row + 1, rows - 1)
        elif character == "\b":
            column = max(column - 1, 0)
        elif character is not None and character >= " ":
            screen[row][min(column, columns - 1)] = last = character
            column += 1
        elif action == "H":
            row, column = first - 1, (numbers[1] if len(numbers) > 1 else 1) - 1
        elif action in ("A", "B"):
            row += first if action == "B" else -first
        elif action in ("C", "D"):
            column += first if action == "C" else -first
        elif action == "G":
            column = first - 1
        elif action == "d":
            row = first - 1
        elif action == "X":
            screen[row][column : column + first] = [" "] * first
        elif action == "b":
            screen[row][column : column + first] = [last] * first
            column += first
        elif action == "P":
            screen[row][column : column + first] = []
            screen[row] += [" "] * first
        elif action == "L":
            screen[row:row] = [[" "] * columns for _ in range(first)]
            del screen[rows:]
        elif action == "K":
            screen[row][column:] = [" "] * (columns - column)
        elif action == "J":
            screen[row][column:] = [" "] * (columns - column)
            for line in screen[row + 1 :]:
                line[:] = [" "] * columns
        row, column = min(max(row, 0), rows - 1), max(column, 0)
    return ["".join(line).rstrip() for line in screen]


def test_cantools_monitor_shows_every_signal_with_its_unit(session: Session) -> None:
    stream = (session.folder / "screen.txt").read_text(errors="replace")
    assert session.figures["replay"]["monitor_status"] == 0, stream[-500:]
    shown = "\n".join(screen_of(stream.rpartition("\x1b[?1049l")[0] or stream, 260, 110))
    for message in DATABASE.messages:
        for item in message.signals:
            unit = f" {re.escape(item.unit)}" if item.unit else ""
            assert re.search(rf"\b{item.name}: +[-\w.']+{unit},?$", shown, re.M), f"{item.name}: {shown}"


# ----------------------------------------------------------------------------------------------------- the guest itself


def test_the_guest_passes_status_output_and_results_and_protects_the_rest(tmp_path: Path) -> None:
    need_guest()
    (tmp_path / "mine").write_text("mine\n")
    script = "cat mine; echo spoilt >mine; echo made >res/new; seq 1 30000; echo complaint >&2; exit 7"
    began = time.monotonic()
    done = subprocess.run(
        [*PARKCTL, "guest", "--results", "res", "--", "sh", "-c", script],
        capture_output=True, text=True, cwd=tmp_path, check=False, timeout=100,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert time.monotonic() - began < 30.0
    assert done.returncode == 7
    assert done.stdout == "mine\n" + "".join(f"{number}\n" for number in range(1, 30001))
    assert re.fullmatch(r".*sh: .*mine.*Read-only file system\ncomplaint\n", done.stderr), done.stderr
    assert (tmp_path / "mine").read_text() == "mine\n"
    assert (tmp_path / "res/new").read_text() == "made\n"


def test_an_interrupt_reaches_the_command_and_nothing_is_left(tmp_path: Path) -> None:
    need_guest()
    script = (
        "import time\n"
        "try:\n  print('up', flush=True)\n  time.sleep(60)\n"
        "except KeyboardInterrupt:\n  print('bye')\n  raise SystemExit(9)"
    )
    process = subprocess.Popen(
        [*PARKCTL, "guest", "--results", str(tmp_path), "--", sys.executable, "-c", script],
        stdout=subprocess.PIPE, text=True, cwd=ROOT,
    )  # fmt: skip
    assert process.stdout is not None
    assert process.stdout.readline() == "up\n"
    guests = children_of(process.pid)
    assert len(guests) == 1
    process.send_signal(signal.SIGINT)
    assert process.communicate(timeout=30)[0] == "bye\n"
    assert process.returncode == 9
    assert not Path(f"/proc/{guests[0]}").exists()
