"""A recorded manoeuvre: the frames and inputs of every cycle of one lock-step run, to be run again and again."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from firmware_py.codec import INPUT_MESSAGES, Codec, load_codec
from firmware_py.core import controller
from firmware_py.core.controller import State
from firmware_py.core.signals import MODE_ACTIVE, Inputs, Outputs
from firmware_py.core.tables import Tables
from firmware_py.node import ControllerNode, Frame, build_tables
from firmware_py.table_file import load_tables
from sim.data_files import load_course, load_scenario, load_vehicle
from tools.lockstep import DBC, PERIOD_NS, PHASE_MS, LockstepRun, run_lockstep

TABLES = Path(__file__).resolve().parents[2] / "firmware_py" / "tables" / "paper-ohio"
SEED = 3


class Recording(NamedTuple):
    """Cycle by cycle: the frames that wait, the core's inputs, the state before, and the outputs.

    `active` are the numbers of the cycles in which the car is driven.
    """

    codec: Codec
    tables: Tables
    frames: list[list[Frame]]
    inputs: list[Inputs]
    states: list[State]
    outputs: list[Outputs]
    active: list[int]


class _Recorder(ControllerNode):
    def __init__(self, codec: Codec, tables: Tables) -> None:
        super().__init__(codec, tables)
        self.inputs: list[Inputs] = []

    def _step(self, inputs: Inputs) -> Outputs:
        self.inputs.append(inputs)
        return super()._step(inputs)


def now_ns_of(cycle: int) -> int:
    """Return the wake-up time of a recorded cycle."""
    return (cycle + 1) * PERIOD_NS


def record_run(longest_s: float, *, with_frames: bool = False) -> LockstepRun:
    """Drive the standard manoeuvre in lock-step, at most `longest_s` of it."""
    vehicle, course, scenario = load_vehicle("paper"), load_course("ohio"), load_scenario("car")
    return run_lockstep(vehicle, course, scenario, "left", SEED, "car", TABLES, record=with_frames, longest_s=longest_s)


def record(longest_s: float = 60.0) -> Recording:
    """Return the cycles of the standard manoeuvre, of at most its first `longest_s`."""
    run = record_run(longest_s, with_frames=True)
    codec = load_codec(DBC)
    tables = build_tables(load_tables(TABLES, "left", "car", controller.PERIOD_S), codec)
    wanted = {codec.messages[name].frame_id for name in INPUT_MESSAGES}
    frames: list[list[Frame]] = [[] for _ in range(run.controller["cycles"])]
    for time_s, arbitration_id, data in run.frames:
        if arbitration_id in wanted:
            frames[round((time_s * 1e3 + PHASE_MS) / 10.0) - 1].append((arbitration_id, data))
    node = _Recorder(codec, tables)
    for cycle, waiting in enumerate(frames):
        node.cycle(now_ns_of(cycle), waiting, 0)
    states, outputs = [controller.begin()], []
    for inputs in node.inputs:
        state, output = controller.step(tables, states[-1], inputs)
        states.append(state)
        outputs.append(output)
    active = [cycle for cycle, state in enumerate(states[:-1]) if state.supervisor.mode == MODE_ACTIVE]
    return Recording(codec, tables, frames, node.inputs, states, outputs, active)
