"""Rehearsal: it comes before the deadline or not at all, and nothing that the controller does differs for it."""

from __future__ import annotations

import pytest

from firmware_py.loop import PERIOD_NS, REHEARSALS, Clock, Pace
from firmware_py.node import ControllerNode
from tools.bench.recording import Recording, now_ns_of, record

SPIN_NS = 200_000
READING_NS = 100
"""What reading the clock takes here: without it a spin would never end."""


class VirtualClock(Clock):
    """A clock that moves by what happens; sleeps may be longer than asked for."""

    def __init__(self, late_ns: int = 0) -> None:
        super().__init__()
        self.ns = 0
        self.late_ns = late_ns
        self.now_ns = self._read

    def _read(self) -> int:
        self.ns += READING_NS
        return self.ns

    def sleep(self, duration_s: float) -> None:
        self.ns += round(duration_s * 1e9) + self.late_ns


class Rehearsal:
    """Work that takes as long as it is told to."""

    def __init__(self, clock: VirtualClock, duration_ns: int) -> None:
        self.clock = clock
        self.duration_ns = duration_ns
        self.begun_ns: list[int] = []

    def __call__(self) -> None:
        self.begun_ns.append(self.clock.ns)
        self.clock.ns += self.duration_ns


def wait(pace: Pace, cycles: int) -> list[int]:
    """Wait for so many deadlines; return how late each wake-up was, ns."""
    return [pace.wait_until(number * PERIOD_NS) - number * PERIOD_NS for number in range(1, cycles + 1)]


def test_it_is_rehearsed_between_sleep_and_deadline() -> None:
    clock = VirtualClock()
    rehearsal = Rehearsal(clock, 150_000)
    pace = Pace(clock, SPIN_NS, rehearsal)
    late = wait(pace, 100)
    assert all(0 <= ns <= READING_NS for ns in late)
    assert len(rehearsal.begun_ns) == pace.rehearsals == 100 * REHEARSALS
    assert all(ns % PERIOD_NS > PERIOD_NS - 1_000_000 for ns in rehearsal.begun_ns)
    assert pace.rehearsal.quantile_us(0.5) == pytest.approx(150.0, rel=0.15)


@pytest.mark.parametrize("late_us", [100, 400, 700, 790])
def test_whoever_wakes_late_rehearses_less_and_is_no_later_for_it(late_us: int) -> None:
    clock = VirtualClock()
    rehearsal = Rehearsal(clock, 150_000)
    pace = Pace(clock, SPIN_NS, rehearsal)
    wait(pace, 1000)
    begun = pace.rehearsals
    clock.late_ns = late_us * 1000
    late = [pace.wait_until(number * PERIOD_NS) - number * PERIOD_NS for number in range(1001, 1049)]
    assert all(0 <= ns <= READING_NS for ns in late)
    fitting = min(max((800 - late_us - 50) // 150, 0), REHEARSALS)
    assert pace.rehearsals - begun == 48 * fitting


def test_a_long_rehearsal_is_not_tried_again_until_it_would_fit() -> None:
    """One that takes longer than there is time makes one cycle late, not the next ones."""
    clock = VirtualClock()
    rehearsal = Rehearsal(clock, 5_000_000)
    pace = Pace(clock, SPIN_NS, rehearsal)
    late = wait(pace, 2)
    assert late[0] > 4_000_000
    rehearsal.duration_ns = 150_000
    late = [pace.wait_until(number * PERIOD_NS) - number * PERIOD_NS for number in range(3, 2000)]
    assert all(0 <= ns <= READING_NS for ns in late)
    assert len(rehearsal.begun_ns) > 100, "forgotten after a while"
    assert rehearsal.begun_ns[1] > 500 * PERIOD_NS


def test_without_it_there_is_none() -> None:
    clock = VirtualClock()
    pace = Pace(clock)
    assert all(0 <= ns <= READING_NS for ns in wait(pace, 10))
    assert (pace.rehearsals, pace.rehearsal.total) == (0, 0)


@pytest.fixture(scope="module")
def recording() -> Recording:
    return record(6.0)


def frames_of(recording: Recording, *, rehearsing: bool) -> tuple[list[object], ControllerNode]:
    node = ControllerNode(recording.codec, recording.tables)
    sent: list[object] = []
    for cycle, frames in enumerate(recording.frames):
        if rehearsing:
            for _ in range(cycle % 3):
                node.rehearse()
        sent += node.cycle(now_ns_of(cycle), list(frames), 0)
    return sent, node


def test_nothing_differs_for_rehearsals(recording: Recording) -> None:
    plain, node = frames_of(recording, rehearsing=False)
    rehearsed, other = frames_of(recording, rehearsing=True)
    assert rehearsed == plain
    assert other.failed_rehearsals == 0
    assert (other.mailbox.received, other.frames_sent, other.cycles) == (node.mailbox.received, len(plain), node.cycles)
    assert node.seen() == other.seen()


def test_a_rehearsal_that_fails_raises_nothing(recording: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    _, node = frames_of(recording, rehearsing=False)
    before = node.seen()

    def fail(*_: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr("firmware_py.core.controller.step", fail)
    node.rehearse()
    assert node.failed_rehearsals == 1
    assert node.seen() == before
    assert not node.internal_errors
