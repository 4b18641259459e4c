"""The acceptance rules of rolling counters, the same cases on the controller's side and on the plant's side."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path

import pytest

from firmware_py import e2e
from firmware_py.codec import Mailbox, Sender, load_codec
from firmware_py.core.signals import MotionReport, SteerCommand
from sim.can_side import CanSide

DBC = Path(__file__).resolve().parent.parent / "dbc/parking.dbc"
CODEC = load_codec(DBC)
TICK_NS = 10_000_000
TIMEOUT_NS = 100_000_000

# Puts a frame with the given counter in at a time; returns whether it was accepted.
Put = Callable[[int, int], bool]


def controller_side() -> Put:
    """VEH_MotionRpt into the mailbox; accepted means that its value arrived."""
    mailbox = Mailbox(CODEC)
    marks = iter(range(1, 1_000_000))

    def put(now_ns: int, counter: int) -> bool:
        mark = next(marks) * 1e-4
        rejected = mailbox.rejected_counter
        mailbox.put(now_ns, 0x101, CODEC.pack["VEH_MotionRpt"](MotionReport(mark, 0.0, 1, 1), counter, None))
        inputs = mailbox.take(0, 0)
        arrived = inputs.motion.speed_meas_mps == pytest.approx(mark, abs=1e-9)
        assert arrived == (inputs.used.used_motion_counter == counter and counter < 15)
        assert arrived == (mailbox.rejected_counter == rejected)
        return arrived

    return put


def plant_side() -> Put:
    """CTRL_SteerCmd into the plant's side."""
    side = CanSide(DBC)

    def put(now_ns: int, counter: int) -> bool:
        before = side.received["CTRL_SteerCmd"].last_valid_ns
        decoded = side.decode(now_ns, 0x200, CODEC.pack["CTRL_SteerCmd"](SteerCommand(0.1, 1), counter, None))
        reception = side.received["CTRL_SteerCmd"]
        assert reception.bad_counter == (decoded is None)
        assert not reception.bad_crc
        assert reception.last_valid_ns == (before if decoded is None else now_ns)
        return decoded is not None

    return put


SIDES = {"controller": controller_side, "plant": plant_side}


@pytest.fixture(params=SIDES)
def put(request: pytest.FixtureRequest) -> Put:
    return SIDES[request.param]()


def in_turn(put: Put, counters: list[int], start_ns: int = 0) -> list[bool]:
    """Put one frame a tick."""
    return [put(start_ns + index * TICK_NS, counter) for index, counter in enumerate(counters)]


@pytest.mark.parametrize("first", [0, 1, 13, 14])
@pytest.mark.parametrize("side", SIDES)
def test_the_first_frame_is_accepted_whatever_its_counter(side: str, first: int) -> None:
    assert SIDES[side]()(0, first)


def test_steps_of_1_to_5_are_accepted_modulo_15(put: Put) -> None:
    now_ns = 0
    for base in range(15):
        for step in range(15):
            now_ns += 2 * TIMEOUT_NS
            assert put(now_ns, base)
            assert put(now_ns + TICK_NS, (base + step) % 15) == (1 <= step <= 5), (base, step)


def test_a_long_unbroken_run_is_accepted(put: Put) -> None:
    assert all(in_turn(put, [k % 15 for k in range(100)]))


def test_counter_15_is_never_accepted_and_leaves_nothing_behind(put: Put) -> None:
    assert not put(0, 15)
    assert put(TICK_NS, 3)
    assert not put(2 * TICK_NS, 15)
    assert put(3 * TICK_NS, 4)
    assert not put(TIMEOUT_NS * 5, 15)
    assert put(TIMEOUT_NS * 5 + TICK_NS, 11), "the silence before counter 15 still counts as silence"


def test_a_rejected_frame_never_moves_the_baseline(put: Put) -> None:
    assert in_turn(put, [3, 3, 3, 11, 4, 13, 4, 5]) == [True, False, False, False, True, False, False, True]


def test_repeats_are_rejected_for_ever(put: Put) -> None:
    """A hanging counter keeps talking: its silence rule must not let one frame in each timeout pass as a fresh one."""
    assert in_turn(put, [7] * 200) == [True] + [False] * 199


def test_a_pair_of_alternating_counters_is_not_a_sequence(put: Put) -> None:
    """Two senders on one id, far apart in their counters: the second never gets in beside the first."""
    counters = [k for pair in ((n % 15, (n + 7) % 15) for n in range(60)) for k in pair]
    accepted = in_turn(put, counters)
    assert accepted[0::2] == [True] * 60
    assert accepted[1::2] == [False] * 60


def test_a_jump_is_followed_from_the_third_frame_in_a_row(put: Put) -> None:
    assert in_turn(put, [2, 9, 10, 11, 12]) == [True, False, False, True, True]


def test_frames_of_a_jump_may_be_lost_too(put: Put) -> None:
    assert in_turn(put, [2, 9, 14, 4, 5]) == [True, False, False, True, True]


def test_a_run_that_breaks_starts_anew(put: Put) -> None:
    # 9 10 | 3 follows neither 10 nor is it a repeat; it continues the baseline 2.
    assert in_turn(put, [2, 9, 10, 3, 4]) == [True, False, False, True, True]
    # 0 8 | 0 8 ...: no two of them follow each other by 1 to 5.
    assert in_turn(put, [14, 6, 12, 6, 13, 14], 10**10) == [True, False, False, False, False, False]


def test_an_accepted_frame_ends_a_run(put: Put) -> None:
    assert in_turn(put, [2, 9, 10, 3, 11, 12]) == [True, False, False, True, False, False]


def test_a_restarted_sender_is_heard_after_two_frames_at_the_latest(put: Put) -> None:
    for stop in range(15):
        start_ns = (stop + 1) * 10**11
        assert all(in_turn(put, [(stop + k) % 15 for k in range(16)], start_ns))
        after = in_turn(put, [0, 1, 2, 3, 4], start_ns + 16 * TICK_NS)
        assert after[2:] == [True] * 3, stop


@pytest.mark.parametrize("again", range(15))
def test_after_silence_of_the_timeout_any_frame_is_a_first_one(put: Put, again: int) -> None:
    assert in_turn(put, [4, 5, 6]) == [True] * 3
    assert put(2 * TICK_NS + TIMEOUT_NS + 1, again)


@pytest.mark.parametrize("again", [6, 12, 0])
def test_silence_of_exactly_the_timeout_is_not_yet_silence(put: Put, again: int) -> None:
    assert in_turn(put, [4, 5, 6]) == [True] * 3
    assert not put(2 * TICK_NS + TIMEOUT_NS, again)


def test_frames_with_a_wrong_crc_break_neither_sequence_nor_silence() -> None:
    mailbox, side = Mailbox(CODEC), CanSide(DBC)
    for put_bytes, name in (
        (lambda now, data: mailbox.put(now, 0x101, data), "VEH_MotionRpt"),
        (lambda now, data: side.decode(now, 0x200, data), "CTRL_SteerCmd"),
    ):
        good = [CODEC.pack[name](CODEC.unpack[name](bytes(8)), counter, None) for counter in range(15)]
        put_bytes(0, good[0])
        for tick in range(1, 20):
            put_bytes(tick * TICK_NS, bytes([good[0][0] ^ 0xA5]) + good[0][1:])
        put_bytes(20 * TICK_NS, good[9])  # no right frame for longer than the timeout: a first one
    assert (mailbox.received, mailbox.rejected_crc) == (2, 19)
    assert side.received["CTRL_SteerCmd"].last_valid_ns == 20 * TICK_NS
    assert side.rejected_count == 19


def test_both_sides_judge_random_sequences_alike() -> None:
    """Two implementations of one text; 20 000 frames with losses, repeats, restarts and pauses."""
    rng = random.Random(5)
    first, second = controller_side(), plant_side()
    receiver = e2e.Receiver(TIMEOUT_NS)
    now_ns, counter, accepted = 0, 0, 0
    for _ in range(20_000):
        kind = rng.random()
        counter = rng.randrange(16) if kind < 0.3 else (counter + rng.choice([0, 1, 1, 1, 1, 2, 5, 6])) % 15
        now_ns += rng.choice([TICK_NS, TICK_NS, TICK_NS, 6 * TICK_NS, TIMEOUT_NS, TIMEOUT_NS + 1])
        verdicts = {first(now_ns, counter), second(now_ns, counter), receiver.check(now_ns, counter) == e2e.OK}
        assert len(verdicts) == 1
        accepted += verdicts.pop()
    assert 5_000 < accepted < 18_000, "the sequence should exercise both verdicts"


def test_the_receiver_tells_repeats_from_jumps_and_counts_losses() -> None:
    receiver = e2e.Receiver(TIMEOUT_NS)
    verdicts = [receiver.check(TICK_NS * k, c) for k, c in enumerate([0, 1, 1, 4, 12, 9, 15, 10])]
    assert verdicts == [
        e2e.OK,
        e2e.OK,
        e2e.REPEATED,
        e2e.OK,
        e2e.WRONG_SEQUENCE,
        e2e.OK,
        e2e.WRONG_SEQUENCE,
        e2e.OK,
    ]
    assert receiver.lost == 2 + 4
    assert receiver.status == e2e.OK


def test_the_plants_flags_speak_of_the_last_frame_and_its_age_of_the_last_valid_one() -> None:
    side, sender = CanSide(DBC), Sender(CODEC)
    reception = side.received["CTRL_SteerCmd"]
    assert reception.is_timed_out(0), "never heard"
    frames = [sender.pack("CTRL_SteerCmd", SteerCommand(0.1, 1)) for _ in range(3)]
    assert side.decode(5, *frames[0]) is not None
    assert not reception.is_timed_out(5 + TIMEOUT_NS)
    assert reception.is_timed_out(6 + TIMEOUT_NS)
    assert side.decode(10, frames[1][0], b"\x00" + frames[1][1][1:]) is None
    assert (reception.bad_crc, reception.bad_counter) == (True, False)
    assert side.decode(11, *frames[0]) is None
    assert (reception.bad_crc, reception.bad_counter) == (False, True)
    assert side.decode(12, frames[1][0], frames[1][1][:7]) is None
    assert (reception.bad_crc, reception.bad_counter) == (True, False), "a wrong length counts as a wrong CRC"
    assert reception.last_valid_ns == 5
    assert side.decode(13, *frames[1]) is not None
    assert (reception.bad_crc, reception.bad_counter, reception.last_valid_ns) == (False, False, 13)
    assert reception.rejected_count == side.rejected_count == 3


def test_frames_under_the_plants_own_ids_are_foreign_to_it() -> None:
    side = CanSide(DBC)
    assert side.decode(0, 0x101, bytes(8)) is None
    assert side.decode(0, 0x7FF, b"") is None
    assert side.foreign_count == 2
    assert side.rejected_count == 0
