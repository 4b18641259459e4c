"""How many opcodes of CPython one cycle takes: exact on every machine, so a test can hold it to within 1 %.

Counted over every so-manieth cycle of a recorded manoeuvre, with `sys.settrace` and `f_trace_opcodes`. The counts
belong to one minor version of CPython; `opcodes.txt` holds them for the versions that they were counted with.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

from firmware_py.codec import Mailbox, Sender
from firmware_py.core import controller
from firmware_py.node import ControllerNode
from sim.errors import UserError
from tools.bench.recording import now_ns_of, record
from tools.run_folder import write_whole

STORED = Path(__file__).resolve().parent / "opcodes.txt"
EVERY = 11
"""Not a divisor of any message's cycle time, so that each kind of cycle is met."""

Counts = dict[str, float]


def python_version() -> str:
    """Return the version that counts belong to."""
    return f"{sys.version_info.major}.{sys.version_info.minor}"


def opcodes_of(call: Callable[[], object]) -> int:
    """Return how many opcodes run in the Python functions that `call` calls, itself included."""
    count = 0

    def trace(frame: FrameType, event: str, _argument: object) -> Any:
        nonlocal count
        frame.f_trace_opcodes = True
        frame.f_trace_lines = False
        if event == "opcode":
            count += 1
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        call()
    finally:
        sys.settrace(before)
    return count


def count_opcodes() -> Counts:
    """Return opcodes a cycle of the core's step, of the codec both ways, and of the node's whole cycle."""
    recording = record()
    node = ControllerNode(recording.codec, recording.tables)
    mailbox, sender = Mailbox(recording.codec), Sender(recording.codec)
    totals = {"core_step": 0, "codec_unpack": 0, "codec_pack": 0, "node_cycle": 0}
    counted = 0
    for cycle, (frames, inputs) in enumerate(zip(recording.frames, recording.inputs, strict=True)):
        now_ns, outputs = now_ns_of(cycle), recording.outputs[cycle]

        def step(state: Any = recording.states[cycle], inputs: Any = inputs) -> None:
            controller.step(recording.tables, state, inputs)

        def unpack(frames: Any = frames, now_ns: int = now_ns) -> None:
            for frame in frames:
                mailbox.put(now_ns, *frame)
            mailbox.take(now_ns // 1000, 0)

        def pack(outputs: Any = outputs, inputs: Any = inputs) -> None:
            sender.pack("CTRL_SteerCmd", outputs.steer)
            sender.pack("CTRL_LongCmd", outputs.long)
            sender.pack("CTRL_SysCmd", outputs.sys)
            sender.pack("CTRL_CycleInputs", inputs.used)
            sender.pack("CTRL_Track", outputs.track)

        def whole(frames: Any = frames, now_ns: int = now_ns) -> None:
            node.cycle(now_ns, frames, 0)

        parts: dict[str, Callable[[], None]] = {
            "core_step": step,
            "codec_unpack": unpack,
            "codec_pack": pack,
            "node_cycle": whole,
        }
        is_counted = cycle % EVERY == 0
        counted += is_counted
        for name, part in parts.items():
            if is_counted:
                totals[name] += opcodes_of(part)
            elif name != "core_step":
                part()
    return {name: total / counted for name, total in totals.items()}


def text_of(counts: Counts) -> str:
    """Return counts in one line."""
    return ", ".join(f"{name} {count:.1f}" for name, count in counts.items())


def stored_counts() -> dict[str, Counts]:
    """Return what is stored, by version of Python. Raises UserError for a line that is no count."""
    stored: dict[str, Counts] = {}
    for number, line in enumerate(STORED.read_text(encoding="utf-8").splitlines(), 1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        try:
            version, name, count = words
            stored.setdefault(version, {})[name] = float(count)
        except ValueError:
            raise UserError(f"{STORED}:{number}: must be VERSION NAME COUNT") from None
    return stored


def store(counts: Counts) -> None:
    """Store the counts of this version of Python beside those of the others."""
    stored = stored_counts() if STORED.is_file() else {}
    stored[python_version()] = counts
    lines = [
        "# Opcodes of CPython that one cycle takes, mean over a recorded manoeuvre: version, what, count.",
        "# Made by `parkctl bench --update-opcodes`; a test holds the code to them within 1 %.",
        *(f"{version} {name} {count:.1f}" for version in sorted(stored) for name, count in stored[version].items()),
    ]
    write_whole(STORED, "\n".join(lines) + "\n")
