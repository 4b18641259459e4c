"""The core under numba gives the same bits as in plain CPython, cycle by cycle, over whole manoeuvres."""

import random

import pytest
from core_support import TABLES, shipped_codec, shipped_tables, standing_inputs

from firmware_py.core import controller
from firmware_py.core import signals as s
from firmware_py.core.controller import PERIOD_S
from firmware_py.node import build_tables
from firmware_py.table_file import load_tables
from sim.data_files import load_course, load_scenario, load_vehicle
from tools.compiled import array_tables, compiled_step
from tools.lockstep import run_lockstep


@pytest.fixture(scope="module")
def step():
    return compiled_step()


def recorded(monkeypatch, side, law, seed, scenario="car", course="ohio", folder=TABLES):
    """Inputs and outputs of every cycle of a lock-step run."""
    cycles = []
    plain = controller.step

    def recording(tables, state, inputs):
        state, outputs = plain(tables, state, inputs)
        cycles.append((inputs, state, outputs))
        return state, outputs

    with monkeypatch.context() as patch:
        patch.setattr(controller, "step", recording)
        world = load_scenario(scenario)
        vehicle = load_vehicle("paper", world.vehicle_overlay)
        run_lockstep(vehicle, load_course(course), world, side, seed, law, folder, longest_s=60.0)
    return cycles


@pytest.mark.parametrize(("side", "law", "seed"), [("left", "car", 3), ("right", "pid+ff", 4)])
def test_compiled_and_plain_agree_bit_for_bit_over_a_manoeuvre(monkeypatch, step, side, law, seed):
    cycles = recorded(monkeypatch, side, law, seed)
    assert len(cycles) > 2000
    assert {outputs.sys.control_leg for _, _, outputs in cycles} >= {s.LEG_FORWARD, s.LEG_REVERSE}
    tables = array_tables(shipped_tables(side, law))
    state = controller.begin()
    for number, (inputs, plain_state, plain_outputs) in enumerate(cycles):
        state, outputs = step(tables, state, inputs)
        assert state == plain_state, f"state after cycle {number}"
        assert outputs == plain_outputs, f"outputs of cycle {number}"


def test_so_they_do_by_the_papers_law_to_its_stop_in_reverse(monkeypatch, step):
    folder = TABLES.parent / "paper-study"
    cycles = recorded(monkeypatch, "right", "paper", 1, "paper", "paper", folder)
    assert {outputs.sys.control_leg for _, _, outputs in cycles} >= {s.LEG_FORWARD, s.LEG_REVERSE}
    assert max(abs(state.paper.cross_track_error_m) for _, state, _ in cycles) > 0.05
    tables = array_tables(build_tables(load_tables(folder, "right", "paper", PERIOD_S), shipped_codec()))
    state = controller.begin()
    for number, (inputs, plain_state, plain_outputs) in enumerate(cycles):
        state, outputs = step(tables, state, inputs)
        assert (state, outputs) == (plain_state, plain_outputs), f"cycle {number}"


def test_compiled_and_plain_agree_on_faults_and_nonsense(step):
    """Stale, implausible and extreme inputs too: 1 000 cycles that no manoeuvre brings."""
    rng = random.Random(9)
    plain_tables = shipped_tables()
    tables = array_tables(plain_tables)
    plain_state = state = controller.begin()
    for cycle in range(1000):
        inputs = standing_inputs(plain_tables, cycle, rng.choice((1, 2, 2, 2, 3)))
        if cycle > 60:
            inputs = inputs._replace(
                oper=s.OperatorCommand(rng.getrandbits(1), 0, int(rng.random() < 0.01), rng.getrandbits(1)),
                motion=inputs.motion._replace(speed_meas_mps=rng.choice((0.0, rng.uniform(-838.0, 838.0)))),
                position=inputs.position._replace(position_x_m=rng.uniform(-168.0, 168.0)),
                attitude=inputs.attitude._replace(yaw_rad=rng.uniform(-3.35, 3.35)),
                long=inputs.long._replace(gear_rpt=rng.randrange(8), standstill=rng.getrandbits(1)),
                used=inputs.used._replace(
                    used_attitude_counter=rng.randrange(16), overruns_before_cycle=rng.choice((0, 0, 0, 40))
                ),
            )
        plain_state, plain_outputs = controller.step(plain_tables, plain_state, inputs)
        state, outputs = step(tables, state, inputs)
        assert (state, outputs) == (plain_state, plain_outputs), f"cycle {cycle}"
