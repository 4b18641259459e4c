"""pytest-benchmark's record of the cycle's parts: shown and kept where asked for, never a gate."""

import pytest

from firmware_py.codec import Mailbox, Sender
from firmware_py.core import controller
from firmware_py.node import ControllerNode
from tools.bench.recording import now_ns_of, record

ROUNDS = 100


@pytest.fixture(scope="module")
def recording():
    return record(8.0)


def test_core_step(benchmark, recording):
    cycle = recording.active[-1]
    arguments = (recording.tables, recording.states[cycle], recording.inputs[cycle])
    _, outputs = benchmark.pedantic(controller.step, args=arguments, rounds=ROUNDS, warmup_rounds=5)
    assert outputs == recording.outputs[cycle]


def test_codec_pack(benchmark, recording):
    sender, steer = Sender(recording.codec), recording.outputs[recording.active[-1]].steer
    frame_id, _ = benchmark.pedantic(sender.pack, args=("CTRL_SteerCmd", steer), rounds=ROUNDS, warmup_rounds=5)
    assert frame_id == recording.codec.messages["CTRL_SteerCmd"].frame_id


def test_codec_unpack(benchmark, recording):
    mailbox, frames = Mailbox(recording.codec), recording.frames[recording.active[-1]]

    def fresh():
        return (Mailbox(recording.codec),), {}

    def unpack(mailbox):
        for frame in frames:
            mailbox.put(0, *frame)
        return mailbox

    mailbox = benchmark.pedantic(unpack, setup=fresh, rounds=ROUNDS, warmup_rounds=5)
    assert mailbox.received == len(frames)


def test_node_cycle(benchmark, recording):
    node = ControllerNode(recording.codec, recording.tables)
    cycles = iter(range(len(recording.frames)))

    def following():
        cycle = next(cycles)
        return (now_ns_of(cycle), recording.frames[cycle], 0), {}

    frames = benchmark.pedantic(node.cycle, setup=following, rounds=3 * ROUNDS)
    assert len(frames) >= 6
    assert not node.internal_errors
