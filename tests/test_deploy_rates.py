"""A report that does not keep its cycle time is held back until it does, but never from a car that drives."""

from __future__ import annotations

import pytest

from firmware_py.__main__ import DEFAULT_DBC
from firmware_py.codec import INPUT_MESSAGES, load_codec
from firmware_py.rates import RateWatch

CODEC = load_codec(DEFAULT_DBC)
SYS = CODEC.messages["VEH_SysRpt"].frame_id
STEER = CODEC.messages["VEH_SteerRpt"].frame_id
FRAME = (STEER, bytes(8))


def nominal(cycle: int) -> list[tuple[int, bytes]]:
    messages = (CODEC.messages[name] for name in INPUT_MESSAGES)
    return [(info.frame_id, bytes(8)) for info in messages if cycle % (info.cycle_time_ms // 10) == 0]


@pytest.fixture
def watch() -> RateWatch:
    return RateWatch(CODEC.messages, 10)


@pytest.fixture
def timed(watch: RateWatch) -> RateWatch:
    """A watch to which every report has proved its rate."""
    for cycle in range(110):
        watch.sift(nominal(cycle), 1, holding=True)
    return watch


def test_reports_at_their_cycle_times_pass(timed: RateWatch) -> None:
    for cycle in range(1000):
        frames = nominal(cycle)
        assert timed.sift(frames, 1, holding=True) == frames
    assert timed.held == {}


@pytest.mark.parametrize("first", [0, 30, 60, 99, 130])
def test_a_car_is_timed_for_half_a_second_from_its_first_frame(watch: RateWatch, first: int) -> None:
    """Meanwhile its state is not passed on, all the rest is."""
    passed_from = None
    for cycle in range(400):
        frames = nominal(cycle) if cycle >= first else []
        passed = watch.sift(frames, 1, holding=True)
        assert [frame for frame in passed if frame[0] != SYS] == [f for f in frames if f[0] != SYS]
        if passed_from is None and SYS in dict(passed):
            passed_from = cycle
    assert watch.held == {}
    assert passed_from is not None
    assert first + 50 <= passed_from <= first + 80


@pytest.mark.parametrize(
    ("every", "times", "told"),
    [
        (2, 1, "VEH_SteerRpt comes every 20.0 ms, must be 10 ms"),
        (1, 2, "VEH_SteerRpt comes every 5.0 ms, must be 10 ms"),
    ],
)
def test_a_report_of_another_rate_is_held_back_and_alone(timed: RateWatch, every: int, times: int, told: str) -> None:
    for cycle in range(400):
        others = [frame for frame in nominal(cycle) if frame[0] != STEER]
        frames = others + [FRAME] * (times if cycle % every == 0 else 0)
        passed = timed.sift(frames, 1, holding=True)
        if cycle > 220:
            assert passed == others
    assert timed.held == {STEER: told}


@pytest.mark.parametrize("every", [2, 3])
def test_a_wrong_rate_is_seen_before_the_first_arming(watch: RateWatch, every: int) -> None:
    for cycle in range(300):
        frames = [frame for frame in nominal(cycle) if frame[0] != STEER or cycle % every == 0]
        passed = dict(watch.sift(frames, 1, holding=True))
        assert not (STEER in passed and SYS in passed), cycle


def test_it_passes_again_once_it_keeps_its_time(timed: RateWatch) -> None:
    for cycle in range(250):
        timed.sift([FRAME] if cycle % 2 == 0 else [], 1, holding=True)
    assert timed.held
    for _ in range(210):
        passed = timed.sift([FRAME], 1, holding=True)
    assert passed == [FRAME]


def test_while_driving_nothing_is_held(watch: RateWatch) -> None:
    for cycle in range(400):
        frames = [FRAME] if cycle % 3 == 0 else []
        assert watch.sift(frames, 1, holding=False) == frames
    assert STEER in watch.held


def test_periods_that_this_process_overslept_count(watch: RateWatch) -> None:
    """Ten periods late, all frames of them at once: the rate is right."""
    for cycle in range(40):
        frames = [FRAME] * 10
        assert watch.sift(frames, 10, holding=True) == frames, cycle
    assert watch.held == {}


def test_a_silent_report_is_left_to_its_timeout(watch: RateWatch) -> None:
    for _ in range(150):
        watch.sift([FRAME], 1, holding=True)
    for _ in range(500):
        watch.sift([], 1, holding=True)
    assert watch.held == {}


def test_who_comes_back_after_a_silence_is_timed_anew(timed: RateWatch) -> None:
    for cycle in range(300):
        timed.sift([frame for frame in nominal(cycle) if frame[0] != STEER], 1, holding=True)
    since = 0
    for cycle in range(300):
        passed = dict(timed.sift(nominal(cycle), 1, holding=True))
        since += SYS not in passed and cycle % 10 == 0
    assert since >= 5


def test_an_operator_station_that_is_not_there_holds_nothing(watch: RateWatch) -> None:
    """Else the reason shown would be the car's reports, not the operator's silence; it is timed once it comes."""
    oper = CODEC.messages["OPER_Cmd"].frame_id
    for cycle in range(300):
        passed = dict(watch.sift([frame for frame in nominal(cycle) if frame[0] != oper], 1, holding=True))
    assert SYS in passed
    came = [SYS in dict(watch.sift(nominal(cycle), 1, holding=True)) for cycle in range(100)]
    assert came[:50] == [False] * 50
    assert came[80:] == [True] * 20
