"""Controller and plant in one process, in virtual time: no clock, no socket, repeatable bit for bit from a seed.

The one place where both meet. They exchange the same frames through the same codecs as on the bus, in the order in
which a live run would see them:

    t - phase            the emulator samples and sends its reports
    t                    the controller wakes, drains, runs its cycle
    t + COMPUTE_NS       its commands arrive at the plant and act from there on (the plant adds its own latency)

for every t on the 10 ms grid. The operator station presses start when the controller is Ready.
"""

from pathlib import Path
from typing import Any, NamedTuple

from firmware_py.codec import load_codec
from firmware_py.core import conditions as c
from firmware_py.core.controller import PERIOD_S
from firmware_py.core.signals import MODE_FAULT, MODE_MANUAL
from firmware_py.node import ControllerNode, build_tables
from firmware_py.reasons import TEXT
from firmware_py.table_file import load_tables
from sim.data_files import Course, Scenario, Side, Vehicle
from sim.emulator import Emulator, TruthRow
from sim.examiner import Verdict
from tools.operator_station import Station

PERIOD_NS = 10_000_000
PHASE_MS = 3.0
COMPUTE_NS = 500_000
"""From wake-up to the commands' arrival: what a live cycle takes."""

LONGEST_S = 180.0
AFTER_END_CYCLES = 60
DBC = Path(__file__).resolve().parent.parent / "dbc" / "parking.dbc"


class LockstepRun(NamedTuple):
    """What a run left behind.

    `truth` has one row per report instant; `frames` are (time in s, id, data) of the whole bus where recorded;
    `controller` holds the same figures as the final line of a live controller, as far as they exist in virtual time.
    """

    truth: list[TruthRow]
    exam: Verdict
    controller: dict[str, Any]
    frames: list[tuple[float, int, bytes]]


def run_lockstep(
    vehicle: Vehicle,
    course: Course,
    scenario: Scenario,
    side: Side,
    seed: int,
    law: str,
    tables_dir: Path,
    *,
    phase_ms: float = PHASE_MS,
    record: bool = False,
    dbc: Path = DBC,
    longest_s: float = LONGEST_S,
) -> LockstepRun:
    """Drive one manoeuvre, both legs, or until the car stands in a fault.

    `phase_ms`, 0 to 10 exclusive, is how long before the controller's grid the emulator samples.
    """
    codec = load_codec(dbc)
    table_set = load_tables(tables_dir, side, law, PERIOD_S)
    node = ControllerNode(codec, build_tables(table_set, codec))
    emulator = Emulator(vehicle, course, scenario, side, seed, dbc, 0)
    station = Station(dbc)
    sys_cmd_id = codec.messages["CTRL_SysCmd"].frame_id
    phase_ns = round(phase_ms * 1e6)
    frames: list[tuple[float, int, bytes]] = []
    waiting: list[tuple[int, bytes]] = []
    after_end = 0
    completed = False
    now_ns = PERIOD_NS
    while now_ns < longest_s * 1e9 and after_end < AFTER_END_CYCLES:
        reports = emulator.reports(now_ns - phase_ns)
        waiting += reports
        heartbeat = station.heartbeat(now_ns - 1)
        if heartbeat is not None:
            waiting.append(heartbeat)
        commands = node.cycle(now_ns, waiting, 0)
        if record:
            frames += [((now_ns - phase_ns) * 1e-9, *frame) for frame in waiting]
            frames += [((now_ns + COMPUTE_NS) * 1e-9, *frame) for frame in commands]
        waiting = []
        if heartbeat is not None:
            emulator.receive(now_ns, *heartbeat)
        for arbitration_id, data in commands:
            emulator.receive(now_ns + COMPUTE_NS, arbitration_id, data)
            if arbitration_id == sys_cmd_id:
                station.hear(now_ns, arbitration_id, data)
        seen = node.seen()
        if not after_end:
            station.press_start_when_ready(now_ns)
        completed = completed or (seen.mode == MODE_MANUAL and seen.reason == c.COMPLETE)
        over = completed or (seen.mode == MODE_FAULT and not node.is_driving)
        after_end = after_end + 1 if over else 0
        now_ns += PERIOD_NS
    return LockstepRun(
        truth=list(emulator.truth), exam=emulator.examiner.verdict(), controller=_final(node, completed), frames=frames
    )


def _final(node: ControllerNode, completed: bool) -> dict[str, Any]:
    """Return the controller's figures; what only real time can tell is zero."""
    mailbox = node.mailbox
    seen = node.seen()
    reason = c.COMPLETE if completed else seen.reason
    return {
        "mode": seen.mode,
        "leg": seen.leg,
        "reason": reason,
        "reason_text": TEXT[reason],
        "completed": completed,
        "cycles": node.cycles,
        "overruns": 0,
        "longest_stall_cycles": 0,
        "wake_p50_us": 0.0,
        "wake_p99_us": 0.0,
        "wake_p999_us": 0.0,
        "wake_max_us": 0.0,
        "step_p50_us": 0.0,
        "step_p99_us": 0.0,
        "scheduler": "virtual time",
        "frames_sent": node.frames_sent,
        "frames_received": mailbox.received,
        "frames_lost": mailbox.lost,
        "frames_rejected": mailbox.rejected_crc + mailbox.rejected_counter + mailbox.rejected_length,
        "send_failed": 0,
        "internal_errors": list(node.internal_errors),
    }
