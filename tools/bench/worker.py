"""Process of its own that measures the tick and the codec: `python -m tools.bench.worker`.

Reads one JSON object a line from standard input, `{"do": NAME, "samples": N}`, answers with one line each, and ends
with its input. Tick: the plain cycle as the loop runs it, the same without rehearsal, the same source compiled, and an
empty call take turns, one sample each. Codec: the controller's own, cantools, and a raw UDP socket on the loopback take
turns in the same way.
"""

from __future__ import annotations

import gc
import json
import socket
import sys
import time
from collections.abc import Callable
from typing import Any

import cantools
import numpy as np

from firmware_py.codec import Codec, Sender
from firmware_py.core import controller
from firmware_py.loop import PERIOD_NS, SPIN_NS, Clock, Pace
from firmware_py.realtime import set_up
from tools.bench.compiled_tick import Entry, arrays_of, compile_entry
from tools.bench.recording import Recording, record
from tools.lockstep import DBC

MESSAGE = "CTRL_SteerCmd"

SETTLING_CYCLES = 100
"""Cycles before the first sample in which the loop's pace finds out how long a rehearsal takes."""

Samples = dict[str, list[int]]


def _empty() -> None:
    """Do nothing: what a call costs."""


class Ticks:
    """Plain and compiled cycle on the same recorded inputs, each with its own state."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._inputs = arrays_of(recording.inputs)
        self._states = arrays_of(recording.states)
        self._entry: Entry
        self._entry, self._columns = compile_entry(
            recording.tables, recording.states[0], recording.inputs[0], recording.outputs[0]
        )
        self._output = np.zeros(len(arrays_of(recording.outputs[:1])[0]))

    def differing_cycles(self) -> int:
        """Return in how many cycles the compiled state or outputs differ from the plain ones in any bit."""
        outputs = arrays_of(self._recording.outputs)
        state = self._states[0].copy()
        differing = 0
        for cycle, inputs in enumerate(self._inputs):
            self._entry(self._columns, state, inputs, self._output)
            same = np.array_equal(self._output, outputs[cycle]) and np.array_equal(state, self._states[cycle + 1])
            differing += not same
        return differing

    def cold(self, samples: int, *, fifo: bool) -> Samples:
        """Return durations in ns, each sample after a sleep of its own to a multiple of 10 ms.

        `looped`: the plain cycle as the loop runs it, which waits by the loop's own `Pace`, settled by then, and, where
        it has `fifo`, rehearses on the inputs of the cycle before; `rehearsal` is what it rehearsed before each sample.
        `plain` and `compiled` come straight from their sleep.
        """
        recording, entry, columns, output = self._recording, self._entry, self._columns, self._output
        step, tables, clock = controller.step, recording.tables, time.perf_counter_ns
        durations: Samples = {"looped": [], "plain": [], "compiled": [], "rehearsal": [0]}
        array = self._states[0].copy()
        cycle = recording.active[0]

        def rehearse() -> None:
            begun = clock()
            step(tables, recording.states[cycle], recording.inputs[cycle - 1])
            durations["rehearsal"][-1] += clock() - begun

        sleeping = Pace(Clock())
        looping = Pace(Clock(), SPIN_NS, rehearse) if fifo else sleeping
        for _ in range(SETTLING_CYCLES):
            looping.wait_until(_next_deadline_ns())
        durations["rehearsal"].clear()
        for cycle in _evenly(recording.active, samples):
            state, inputs, row = recording.states[cycle], recording.inputs[cycle], self._inputs[cycle]
            array[:] = self._states[cycle]
            durations["rehearsal"].append(0)
            looping.wait_until(_next_deadline_ns())
            begun = clock()
            step(tables, state, inputs)
            durations["looped"].append(clock() - begun)
            sleeping.wait_until(_next_deadline_ns())
            begun = clock()
            step(tables, state, inputs)
            durations["plain"].append(clock() - begun)
            sleeping.wait_until(_next_deadline_ns())
            begun = clock()
            entry(columns, array, row, output)
            durations["compiled"].append(clock() - begun)
        return durations

    def hot(self, samples: int) -> Samples:
        """Return durations in ns of samples without a pause between them."""
        recording, entry, columns, output = self._recording, self._entry, self._columns, self._output
        step, tables, clock = controller.step, recording.tables, time.perf_counter_ns
        durations: Samples = {"plain": [], "compiled": [], "empty": []}
        array = self._states[0].copy()
        for cycle in _evenly(recording.active, samples):
            state, inputs, row = recording.states[cycle], recording.inputs[cycle], self._inputs[cycle]
            array[:] = self._states[cycle]
            begun = clock()
            step(tables, state, inputs)
            durations["plain"].append(clock() - begun)
            begun = clock()
            entry(columns, array, row, output)
            durations["compiled"].append(clock() - begun)
            begun = clock()
            _empty()
            durations["empty"].append(clock() - begun)
        return durations


def _evenly(cycles: list[int], count: int) -> list[int]:
    """Return so many of the cycles from all over the manoeuvre, in their order."""
    return [cycles[index * len(cycles) // count] for index in range(count)]


def _next_deadline_ns() -> int:
    """Return the next multiple of the period."""
    return (time.monotonic_ns() // PERIOD_NS + 1) * PERIOD_NS


class Codecs:
    """One fast message there and back, in three ways."""

    def __init__(self, recording: Recording) -> None:
        self._ways: dict[str, Callable[[], object]] = {
            "own": _own_way(recording.codec, recording),
            "cantools": _cantools_way(recording),
            "socket": _socket_way(),
        }

    def measure(self, samples: int) -> Samples:
        """Return durations in ns, one sample of each way in turn."""
        clock = time.perf_counter_ns
        durations: Samples = {name: [] for name in self._ways}
        for _ in range(samples):
            for name, way in self._ways.items():
                begun = clock()
                way()
                durations[name].append(clock() - begun)
        return durations


def _own_way(codec: Codec, recording: Recording) -> Callable[[], object]:
    """Pack with counter and CRC, check the CRC, unpack."""
    sender, receive, values = Sender(codec), codec.receive[MESSAGE], recording.outputs[recording.active[-1]].steer

    def way() -> object:
        _, data = sender.pack(MESSAGE, values)
        return receive(data)

    return way


def _cantools_way(recording: Recording) -> Callable[[], object]:
    """Encode and decode, without CRC."""
    message = cantools.database.load_file(DBC).get_message_by_name(MESSAGE)  # type: ignore[union-attr]
    values = recording.outputs[recording.active[-1]].steer._asdict()
    values |= {f"{MESSAGE}_crc": 0, f"{MESSAGE}_counter": 0}

    def way() -> object:
        return message.decode(message.encode(values), decode_choices=False)

    return way


def _socket_way() -> Callable[[], object]:
    """Send one 16-byte frame to a socket of this process and receive it."""
    receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    receiver.bind(("127.0.0.1", 0))
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    address, frame = receiver.getsockname(), bytes(16)

    def way() -> object:
        sender.sendto(frame, address)
        return receiver.recv(32)

    return way


def main() -> None:
    """Serve until the input ends."""
    recording = record()
    ticks, codecs = Ticks(recording), Codecs(recording)
    answer: Any = {"cycles": len(recording.inputs), "differing_cycles": ticks.differing_cycles()}
    outcome = set_up("auto")
    print(json.dumps(answer | {"realtime": outcome.line}), flush=True)
    for line in sys.stdin:
        order = json.loads(line)
        if order["do"] == "codec":
            answer = codecs.measure(order["samples"])
        else:
            answer = (
                ticks.cold(order["samples"], fifo=outcome.fifo)
                if order["do"] == "tick_cold"
                else ticks.hot(order["samples"])
            )
        print(json.dumps(answer), flush=True)
        gc.collect()


if __name__ == "__main__":
    main()
