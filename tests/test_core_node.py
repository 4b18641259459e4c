"""The node: a whole cycle from frames to frames; nothing that arrives on the bus makes it raise or stop sending."""

import gc
import random
import sys

import pytest
from core_support import shipped_codec, shipped_tables

from firmware_py.core import conditions as c
from firmware_py.core import controller
from firmware_py.core import signals as s
from firmware_py.histogram import Histogram
from firmware_py.node import ControllerNode

EVERY_CYCLE = {"CTRL_SteerCmd", "CTRL_LongCmd", "CTRL_SysCmd", "CTRL_Cycle", "CTRL_CycleInputs", "CTRL_Track"}
PERIOD_NS = 10_000_000


@pytest.fixture
def node():
    return ControllerNode(shipped_codec(), shipped_tables())


def names(frames):
    by_id = {info.frame_id: name for name, info in shipped_codec().messages.items()}
    return [by_id[arbitration_id] for arbitration_id, _ in frames]


def decoded(frames, name):
    codec = shipped_codec()
    data = next(data for arbitration_id, data in frames if arbitration_id == codec.messages[name].frame_id)
    return codec.unpack[name](data)


def test_every_cycle_sends_its_frames_once_and_slow_ones_at_their_cycle_time(node):
    counts = {}
    cycles = 500
    for cycle in range(cycles):
        for name in names(node.cycle(cycle * PERIOD_NS, [], 0)):
            counts[name] = counts.get(name, 0) + 1
    expected = {
        name: cycles * 10 // info.cycle_time_ms
        for name, info in shipped_codec().messages.items()
        if info.sender == "CTRL"
    }
    assert counts == expected
    assert set(counts) >= EVERY_CYCLE


def test_random_frames_are_counted_and_never_raise(node):
    rng = random.Random(7)
    ids = [info.frame_id for info in shipped_codec().messages.values()]
    for cycle in range(300):
        frames = [
            (rng.choice([*ids, rng.randrange(2048)]), rng.randbytes(rng.choice((0, 1, 7, 8, 8, 8)))) for _ in range(20)
        ]
        sent = node.cycle(cycle * PERIOD_NS, frames, rng.choice((0, 0, 1, 300)))
        assert set(names(sent)) >= EVERY_CYCLE
        assert decoded(sent, "CTRL_SysCmd").control_mode == s.MODE_MANUAL
        assert decoded(sent, "CTRL_SteerCmd").steer_enable == 0
    mailbox = node.mailbox
    assert mailbox.rejected_crc > 500
    assert mailbox.rejected_length > 500
    assert not node.internal_errors


def test_an_exception_in_the_core_becomes_a_fault_with_emergency_brake(node, monkeypatch):
    node.cycle(0, [], 0)

    def broken(*_):
        raise ZeroDivisionError("by zero")

    with monkeypatch.context() as patch:
        patch.setattr(controller, "step", broken)
        sent = node.cycle(PERIOD_NS, [], 0)
    sys = decoded(sent, "CTRL_SysCmd")
    assert (sys.control_mode, sys.control_reason) == (s.MODE_FAULT, c.INTERNAL_ERROR)
    assert decoded(sent, "CTRL_LongCmd").brake_decel_cmd_mps2 == pytest.approx(2.4)
    after = decoded(node.cycle(2 * PERIOD_NS, [], 0), "CTRL_SysCmd")
    assert (after.control_mode, after.control_reason) == (s.MODE_FAULT, c.INTERNAL_ERROR), "latched"
    assert node.internal_errors == ["ZeroDivisionError: by zero"]


def test_the_cycle_frame_tells_index_time_and_skipped_periods(node):
    for cycle in range(3):
        sent = node.cycle(cycle * PERIOD_NS, [], 0)
    sent = node.cycle(8 * PERIOD_NS + 1234, [], 5)
    assert decoded(sent, "CTRL_Cycle") == (9, 80_001)
    assert decoded(sent, "CTRL_CycleInputs").overruns_before_cycle == 5
    assert decoded(sent, "CTRL_CycleInputs").used_sys_counter == s.NO_COUNTER


def test_the_flight_record_keeps_the_newest_five_seconds(node, tmp_path):
    for cycle in range(700):
        node.cycle(cycle * PERIOD_NS, [], 0)
    file = tmp_path / "record.csv"
    node.record.write_csv(file)
    rows = file.read_text().splitlines()
    assert rows[0].startswith("now_us,used_sys_counter,")
    assert [row.split(",")[0] for row in (rows[1], rows[-1])] == ["2000000", "6990000"]
    assert {len(row.split(",")) for row in rows} == {len(rows[0].split(","))}


def test_the_cycle_retains_no_memory(node):
    for cycle in range(1200):
        node.cycle(cycle * PERIOD_NS, [], 0)
    gc.collect()
    before = sys.getallocatedblocks()
    for cycle in range(1200, 3200):
        node.cycle(cycle * PERIOD_NS, [], 0)
    gc.collect()
    assert sys.getallocatedblocks() - before < 50


def test_histogram_quantiles_are_within_one_bucket():
    rng = random.Random(1)
    durations_us = sorted(rng.lognormvariate(4.0, 1.5) for _ in range(20_000))
    histogram = Histogram()
    for duration_us in durations_us:
        histogram.add(int(duration_us * 1000))
    for share in (0.5, 0.99, 0.999):
        exact_us = durations_us[int(share * len(durations_us))]
        assert exact_us * 0.98 - 1 <= histogram.quantile_us(share) <= exact_us * 1.15 + 1
    assert histogram.quantile_us(1.0) <= histogram.max_us
    assert Histogram().quantile_us(0.5) == 0.0
