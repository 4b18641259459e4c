"""Process of its own that plays the vehicle: `python -m tools.bench.turnaround INTERFACE CHANNEL SAMPLES`.

Sends a recorded cycle's reports every 10 ms and waits for the steering frame, by turns on two buses: the controller
answers on one, a bare echo on the other. On SocketCAN, where there is one vcan0, they take the bus in turns of runs.
Prints the times from the first report sent to the steering frame received, in ns, as one JSON line.
"""

from __future__ import annotations

import json
import select
import subprocess
import sys
import time
from typing import TYPE_CHECKING, Any

import can

from firmware_py.realtime import set_up
from sim.errors import UserError
from tools.bench.recording import Recording, record
from tools.buses import open_bus

if TYPE_CHECKING:
    from firmware_py.node import Frame

PRIORITY = 70
ANSWER_S = 0.2
RUN_SAMPLES = 100


class _Other:
    """The process on the other end, and the bus to it."""

    def __init__(self, kind: str, interface: str, channel: str) -> None:
        self.bus: Any = open_bus(interface, channel, None, ignore_settings=True)
        command = [sys.executable, "-P", "-m", "tools.bench.responder", kind, interface, channel]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert self._process.stdout is not None
        if not self._process.stdout.readline():
            raise UserError(f"the {kind} did not start")

    def turn_ns(self, frames: list[Frame], steer_id: int) -> int | None:
        """Return the time from the first frame sent to the steering frame received; None without an answer."""
        while self.bus.recv(0) is not None:
            pass
        messages = [can.Message(arbitration_id=i, data=data, is_extended_id=False) for i, data in frames]
        begun = time.perf_counter_ns()
        for message in messages:
            self.bus.send(message)
        while select.select([self.bus.fileno()], [], [], ANSWER_S)[0]:
            answer = self.bus.recv(0)
            if answer is not None and answer.arbitration_id == steer_id:
                return time.perf_counter_ns() - begun
        return None

    def close(self) -> None:
        self._process.terminate()
        self._process.wait()
        assert self._process.stdout is not None
        self._process.stdout.close()
        self.bus.shutdown()


def measure(interface: str, channels: list[str], samples: int, recording: Recording) -> dict[str, list[int]]:
    """Return the turnarounds in ns by kind; with one channel the kinds share it one after the other."""
    kinds = ("controller", "echo")
    turns: dict[str, list[int]] = {kind: [] for kind in kinds}
    groups = [kinds] if len(channels) == len(kinds) else [(kind,) for kind in kinds]
    steer_id = recording.codec.messages["CTRL_SteerCmd"].frame_id
    cycles = recording.frames
    for group in groups:
        others: dict[str, _Other] = {}
        try:
            for kind in group:
                others[kind] = _Other(kind, interface, channels[len(others)])
            set_up("auto", priority=PRIORITY)
            for index in range(recording.active[0] + samples):
                if index >= recording.active[0]:
                    time.sleep(0.01 - time.monotonic() % 0.01)
                for kind, other in others.items():
                    turn = other.turn_ns(cycles[index % len(cycles)], steer_id)
                    if turn is not None and index >= recording.active[0]:
                        turns[kind].append(turn)
        finally:
            for other in others.values():
                other.close()
    return turns


def main() -> None:
    """Measure and print."""
    interface, channels, samples = sys.argv[1], sys.argv[2].split(","), int(sys.argv[3])
    recording = record(8.0)
    print(json.dumps(measure(interface, channels, samples, recording)), flush=True)


if __name__ == "__main__":
    main()
