"""Rehearsal: it comes before the deadline or not at all, and nothing that the controller does differs for it."""

from __future__ import annotations

import pytest

from firmware_py.loop import PERIOD_NS, Clock, Pace
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
    """Work that takes as long as it is told to, and longer after a sleep where it is told so."""

    def __init__(self, clock: VirtualClock, duration_ns: int, first_ns: int = 0) -> None:
        self.clock = clock
        self.duration_ns = duration_ns
        self.first_ns = first_ns or duration_ns
        self.begun_ns: list[int] = []
        self.ended_ns = 0

    def __call__(self) -> None:
        slept = self.clock.ns - self.ended_ns > PERIOD_NS // 2
        self.begun_ns.append(self.clock.ns)
        self.clock.ns += self.first_ns if slept else self.duration_ns
        self.ended_ns = self.clock.ns


def wait(pace: Pace, cycles: int) -> list[int]:
    """Wait for so many deadlines; return how late each wake-up was, ns."""
    return [pace.wait_until(number * PERIOD_NS) - number * PERIOD_NS for number in range(1, cycles + 1)]


def test_it_is_rehearsed_between_sleep_and_deadline() -> None:
    clock = VirtualClock()
    rehearsal = Rehearsal(clock, 150_000)
    pace = Pace(clock, SPIN_NS, rehearsal)
    late = wait(pace, 100)
    assert all(0 <= ns <= READING_NS for ns in late)
    assert len(rehearsal.begun_ns) == pace.rehearsals >= 100 * 3
    assert all(ns % PERIOD_NS > PERIOD_NS - 1_000_000 for ns in rehearsal.begun_ns)
    assert pace.rehearsal.quantile_us(0.5) == pytest.approx(150.0, rel=0.15)


def test_the_last_ends_shortly_before_the_deadline_however_long_the_first_takes() -> None:
    """What neighbours take from the caches after the last one is missing in the cycle."""
    clock = VirtualClock()
    rehearsal = Rehearsal(clock, 100_000, first_ns=350_000)
    pace = Pace(clock, SPIN_NS, rehearsal)
    wait(pace, 1500)  # until the first guess of how long they take is forgotten
    for number in range(1501, 1600):
        assert 0 <= pace.wait_until(number * PERIOD_NS) - number * PERIOD_NS <= READING_NS
        assert 50_000 <= number * PERIOD_NS - rehearsal.ended_ns <= 50_000 + 150_000


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
    fitting = max((800 - late_us - 50 - 1) // 150, 0)
    assert pace.rehearsals - begun == 48 * fitting


@pytest.mark.parametrize("late_ns", [900_000, 25_000_000])
def test_waking_after_the_deadline_says_nothing_of_how_long_a_rehearsal_takes(late_ns: int) -> None:
    clock = VirtualClock()
    rehearsal = Rehearsal(clock, 150_000)
    pace = Pace(clock, SPIN_NS, rehearsal)
    wait(pace, 1000)
    clock.late_ns = late_ns
    pace.wait_until(1001 * PERIOD_NS)
    clock.late_ns = 0
    begun = pace.rehearsals
    pace.wait_until(1010 * PERIOD_NS)
    assert pace.rehearsals - begun >= 3


def test_a_long_rehearsal_is_not_tried_again_until_it_would_fit() -> None:
    """One that takes longer than there is time makes one cycle late, not the next ones."""
    clock = VirtualClock()
    rehearsal = Rehearsal(clock, 5_000_000)
    pace = Pace(clock, SPIN_NS, rehearsal)
    late = wait(pace, 2)
    assert late[0] > 4_000_000
    rehearsal.duration_ns = rehearsal.first_ns = 150_000
    late = [pace.wait_until(number * PERIOD_NS) - number * PERIOD_NS for number in range(3, 2000)]
    assert all(0 <= ns <= READING_NS for ns in late)
    assert len(rehearsal.begun_ns) > 100, "forgotten after a while"
    assert rehearsal.begun_ns[1] > 150 * PERIOD_NS


def test_a_machine_that_was_away_during_a_later_one_rehearses_once_at_once_and_soon_again_as_before() -> None:
    clock = VirtualClock()
    rehearsal = Rehearsal(clock, 150_000)
    pace = Pace(clock, SPIN_NS, rehearsal)
    wait(pace, 1500)
    counts = []
    for number in range(1501, 1800):
        begun = pace.rehearsals
        rehearsal.duration_ns = 3_000_000 if number == 1501 else 150_000
        late_ns = pace.wait_until(number * PERIOD_NS) - number * PERIOD_NS
        assert (late_ns > READING_NS) == (number == 1501)
        counts.append(pace.rehearsals - begun)
    assert counts[:2] == [2, 1]
    assert min(counts[200:]) >= 4


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
