"""Process of its own that waits as the controller's loop waits: `python -m tools.bench.pacer POLICY SECONDS`.

Prints the lateness of each wake-up in ns as one JSON line. Real-time set-up and waiting are the loop's own.
"""

from __future__ import annotations

import json
import sys
import time

from firmware_py.loop import PERIOD_NS, SPIN_NS, Clock, Loop
from firmware_py.realtime import set_up


class _Pace:
    """What the loop's waiting needs of the loop."""

    wait_until = Loop._wait_until

    def __init__(self, spin_ns: int) -> None:
        self._spin_ns = spin_ns
        self._clock = Clock()


def main() -> None:
    """Wait for every deadline of the given time."""
    policy, seconds = sys.argv[1], float(sys.argv[2])
    outcome = set_up(policy)
    pace = _Pace(SPIN_NS if outcome.fifo else 0)
    late: list[int] = []
    deadline_ns = (time.monotonic_ns() // PERIOD_NS + 2) * PERIOD_NS
    end_ns = deadline_ns + round(seconds * 1e9)
    while deadline_ns < end_ns:
        late_ns = pace.wait_until(deadline_ns) - deadline_ns  # type: ignore[misc]
        deadline_ns += (late_ns // PERIOD_NS + 1) * PERIOD_NS
        late.append(late_ns)
    print(json.dumps({"fifo": outcome.fifo, "line": outcome.line, "late_ns": late}))


if __name__ == "__main__":
    main()
