"""A report that does not keep its cycle time is held back until it does, but never from a car that drives."""

from __future__ import annotations

import pytest

from firmware_py.__main__ import DEFAULT_DBC
from firmware_py.codec import INPUT_MESSAGES, load_codec
from firmware_py.rates import RateWatch

CODEC = load_codec(DEFAULT_DBC)
STEER = CODEC.messages["VEH_SteerRpt"].frame_id
FRAME = (STEER, bytes(8))


def nominal(cycle: int) -> list[tuple[int, bytes]]:
    messages = (CODEC.messages[name] for name in INPUT_MESSAGES)
    return [(info.frame_id, bytes(8)) for info in messages if cycle % (info.cycle_time_ms // 10) == 0]


@pytest.fixture
def watch() -> RateWatch:
    return RateWatch(CODEC.messages, 10)


def test_reports_at_their_cycle_times_pass(watch: RateWatch) -> None:
    for cycle in range(1000):
        frames = nominal(cycle)
        assert watch.sift(frames, 1, holding=True) == frames
    assert watch.held == {}


@pytest.mark.parametrize("first", [0, 30, 60, 99, 130])
def test_a_car_that_comes_late_is_not_held(watch: RateWatch, first: int) -> None:
    for cycle in range(400):
        frames = nominal(cycle) if cycle >= first else []
        assert watch.sift(frames, 1, holding=True) == frames
    assert watch.held == {}


@pytest.mark.parametrize(
    ("every", "times", "told"),
    [
        (2, 1, "VEH_SteerRpt comes every 20.0 ms, must be 10 ms"),
        (1, 2, "VEH_SteerRpt comes every 5.0 ms, must be 10 ms"),
    ],
)
def test_a_report_of_another_rate_is_held_back_and_alone(watch: RateWatch, every: int, times: int, told: str) -> None:
    for cycle in range(400):
        others = [frame for frame in nominal(cycle) if frame[0] != STEER]
        frames = others + [FRAME] * (times if cycle % every == 0 else 0)
        passed = watch.sift(frames, 1, holding=True)
        if cycle > 200:
            assert passed == others
    assert list(watch.held) == [STEER]
    assert watch.held[STEER][:30] == told[:30]
    assert watch.held[STEER].endswith("must be 10 ms")


def test_it_passes_again_once_it_keeps_its_time(watch: RateWatch) -> None:
    for cycle in range(250):
        watch.sift([FRAME] if cycle % 2 == 0 else [], 1, holding=True)
    assert watch.held
    for _ in range(210):
        passed = watch.sift([FRAME], 1, holding=True)
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
