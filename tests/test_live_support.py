"""What judges the live tests: run again only where they failed and the machine was away."""

from __future__ import annotations

import time

import live_support
import pytest
from live_support import ATTEMPTS, AWAY_S, Witnesses, again_where_the_machine_was_away


def failing(monkeypatch: pytest.MonkeyPatch, times: int, away_s: float) -> list[int]:
    """Run a test that fails so many times beside witnesses that were away for so long; return its runs."""

    class Told(Witnesses):
        def __exit__(self, *what: object) -> None:
            super().__exit__(*what)  # type: ignore[arg-type]
            self.away_s = away_s

    monkeypatch.setattr(live_support, "Witnesses", Told)
    runs: list[int] = []

    @again_where_the_machine_was_away
    def test() -> None:
        runs.append(1)
        assert len(runs) > times, "as told"

    test()
    return runs


@pytest.mark.filterwarnings("ignore:the machine was away")
def test_a_failure_beside_a_machine_that_was_away_is_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    assert len(failing(monkeypatch, 2, AWAY_S)) == 3


@pytest.mark.filterwarnings("ignore:the machine was away")
@pytest.mark.parametrize(("times", "away_s"), [(1, AWAY_S / 2), (ATTEMPTS, 1.0)])
def test_a_failure_of_our_own_is_one_and_so_is_one_too_many(
    monkeypatch: pytest.MonkeyPatch, times: int, away_s: float
) -> None:
    with pytest.raises(AssertionError, match="as told"):
        failing(monkeypatch, times, away_s)


def test_what_passes_is_run_once_whatever_the_machine_did(monkeypatch: pytest.MonkeyPatch) -> None:
    assert len(failing(monkeypatch, 0, 1.0)) == 1


def test_witnesses_tell_how_long_they_were_away() -> None:
    witnesses = Witnesses()
    with witnesses:
        time.sleep(0.2)
    assert 0.004 < witnesses.away_s < 10.0
