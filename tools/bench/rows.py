"""The rows of the bench's table: names, units, limits, and what each figure is measured against."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from typing import Any, NamedTuple


class Limit(NamedTuple):
    """What a row is judged by.

    `must` and `aim` bound the ratio to the floor where there is one, else the value; from above, or from below where
    `at_least`. `against` says in words what the floor is.
    """

    unit: str
    against: str = ""
    must: float | None = None
    aim: float | None = None
    at_least: bool = False


CYCLICTEST = "cyclictest -m -p 90 -i 10000"

LIMITS: dict[str, Limit] = {
    "wake_p50_fifo": Limit("us", CYCLICTEST, 2.5, 0.6),
    "wake_p99_fifo": Limit("us", CYCLICTEST, 3.0, 1.0),
    "wake_p50_fifo_loaded": Limit("us", CYCLICTEST + ", 2 hogs", 2.5, 0.6),
    "wake_p99_fifo_loaded": Limit("us", CYCLICTEST + ", 2 hogs", 3.0, 1.0),
    "wake_p99_normal_loaded": Limit("us", CYCLICTEST + ", 2 hogs"),
    "tick_cold_p50": Limit("us", "the same source compiled, on arrays, after 10 ms of sleep", 2.0, 1.4),
    "tick_cold_p99_of_period": Limit("%", "", 5.0, 2.0),
    "tick_unrehearsed_p50": Limit("us", "the same source compiled, on arrays, after 10 ms of sleep"),
    "tick_unrehearsed_p99": Limit("us"),
    "rehearsal_of_period": Limit("%"),
    "tick_hot": Limit("us", "the same source compiled, on arrays"),
    "tick_hot_in_calls": Limit("us", "an empty call"),
    "codec_frame": Limit("us", "raw UDP socket, send + receive", 0.6, 0.35),
    "codec_frame_by_cantools": Limit("us", "cantools, encode + decode"),
    "turnaround_loopbus": Limit("us", "a bare echo in its place"),
    "turnaround_vcan": Limit("us", "a bare echo in its place", 1.6, 1.2),
    "startup_s": Limit("s", "", 2.0, 1.0),
    "rss_mib": Limit("MiB", "", 60.0, 45.0),
    "lockstep_ratio": Limit("x", "", 20.0, 25.0, at_least=True),
    "campaign_rate": Limit("runs/s", "the same source plain, on one core too"),
}
"""Every row, in the order of the table."""


class Row(NamedTuple):
    """One figure: the median over rounds; `why` where it could not be measured here."""

    name: str
    value: float | None = None
    floor: float | None = None
    ratio: float | None = None
    why: str = ""

    @property
    def verdict(self) -> str:
        """Return "aim", "must" or "over" by the row's limits; nothing where there is none to judge."""
        limit = LIMITS[self.name]
        judged = self.value if self.ratio is None else self.ratio
        if judged is None or limit.must is None:
            return ""
        sign = -1.0 if limit.at_least else 1.0
        if limit.aim is not None and sign * judged <= sign * limit.aim:
            return "aim"
        return "must" if sign * judged <= sign * limit.must else "over"

    def as_dict(self) -> dict[str, Any]:
        """Return the row as JSON can hold it."""
        limit = LIMITS[self.name]
        row: dict[str, Any] = {
            "name": self.name,
            "value": self.value,
            "unit": limit.unit,
            "floor": self.floor,
            "ratio": self.ratio,
            "must": limit.must,
            "aim": limit.aim,
            "at_least": limit.at_least,
            "against": limit.against,
        }
        return row | {"why": self.why} if self.why else row


def row_of(name: str, values: Sequence[float], floors: Sequence[float] = ()) -> Row:
    """Return the row from one value a round, and one floor a round; the ratio is the median of the rounds' ratios."""
    value = statistics.median(values)
    if not floors:
        return Row(name, value)
    ratio = statistics.median(v / f for v, f in zip(values, floors, strict=True))
    return Row(name, value, statistics.median(floors), ratio)


def quantile(samples: Sequence[float], share: float) -> float:
    """Return the smallest sample that at least `share` of the samples do not exceed."""
    ordered = sorted(samples)
    return ordered[max(-(-int(len(ordered) * share * 1000) // 1000) - 1, 0)]
