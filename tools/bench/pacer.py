"""Process of its own that waits as the controller's loop waits: `python -m tools.bench.pacer POLICY SECONDS`.

Prints the lateness of each wake-up in ns as one JSON line. Real-time set-up and waiting are the loop's own, with the
rehearsal of a controller that has run.
"""

from __future__ import annotations

import json
import sys
import time

from firmware_py.loop import PERIOD_NS, SPIN_NS, Clock, Pace
from firmware_py.node import ControllerNode
from firmware_py.realtime import set_up
from tools.bench.recording import now_ns_of, record

RECORDED_S = 4.0
"""The car drives by then."""


def main() -> None:
    """Wait for every deadline of the given time."""
    policy, seconds = sys.argv[1], float(sys.argv[2])
    recording = record(RECORDED_S)
    node = ControllerNode(recording.codec, recording.tables)
    for cycle, frames in enumerate(recording.frames):
        node.cycle(now_ns_of(cycle), frames, 0)
    outcome = set_up(policy)
    pace = Pace(Clock(), SPIN_NS, node.rehearse) if outcome.fifo else Pace(Clock())
    late: list[int] = []
    deadline_ns = (time.monotonic_ns() // PERIOD_NS + 2) * PERIOD_NS
    end_ns = deadline_ns + round(seconds * 1e9)
    while deadline_ns < end_ns:
        late_ns = pace.wait_until(deadline_ns) - deadline_ns
        deadline_ns += (late_ns // PERIOD_NS + 1) * PERIOD_NS
        late.append(late_ns)
    print(json.dumps({"fifo": outcome.fifo, "line": outcome.line, "late_ns": late}))


if __name__ == "__main__":
    main()
