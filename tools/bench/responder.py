"""Process of its own on the other end of the turnaround: `python -m tools.bench.responder KIND INTERFACE CHANNEL`.

KIND `controller`: the controller's node on the controller's bus, but woken by the last frame of a cycle's reports in
place of its clock. KIND `echo`: the same bus and the same waiting, answering with one steering frame and no work.
"""

from __future__ import annotations

import select
import sys
import time

from firmware_py.bus import Bus
from firmware_py.codec import load_codec
from firmware_py.core.controller import PERIOD_S
from firmware_py.node import ControllerNode, build_tables
from firmware_py.realtime import set_up
from firmware_py.table_file import load_tables
from tools.bench.recording import TABLES
from tools.buses import open_bus
from tools.lockstep import DBC

LAST_REPORT = "LOC_Attitude"


def main() -> None:
    """Answer until nothing has come for three seconds."""
    kind, interface, channel = sys.argv[1:]
    codec = load_codec(DBC)
    tables = build_tables(load_tables(TABLES, "left", "car", PERIOD_S), codec)
    node = ControllerNode(codec, tables)
    last_id = codec.messages[LAST_REPORT].frame_id
    wire = open_bus(interface, channel, None, ignore_settings=True)
    bus = Bus(wire, interface, channel)
    echo = [(codec.messages["CTRL_SteerCmd"].frame_id, bytes(8))]
    outcome = set_up("auto")
    print(outcome.line, flush=True)
    waiting: list[tuple[int, bytes]] = []
    while select.select([wire.fileno()], [], [], 3.0)[0]:
        waiting += bus.drain()
        if not any(arbitration_id == last_id for arbitration_id, _ in waiting):
            continue
        bus.send(node.cycle(time.monotonic_ns(), waiting, 0) if kind == "controller" else echo)
        waiting = []
    bus.close()


if __name__ == "__main__":
    main()
