"""The supervisor's table and decisions: complete, in order, latched, and every reason reachable."""

import random

import cantools
import pytest
from core_support import DBC, shipped_codec, shipped_tables, standing_inputs

from firmware_py.core import conditions as c
from firmware_py.core import controller, supervisor
from firmware_py.core import signals as s
from firmware_py.reasons import TEXT

MODES = (s.MODE_MANUAL, s.MODE_READY, s.MODE_ACTIVE, s.MODE_FAULT)
PERIOD_US = 10_000


def mask(*reasons):
    return sum(1 << reason for reason in reasons)


def state_in(mode, **changes):
    return supervisor.begin()._replace(mode=mode, reason=c.NONE, **changes)


def test_every_mode_has_rows_that_stand_together_and_lead_to_known_modes():
    modes = [row[0] for row in supervisor.TRANSITIONS]
    assert sorted(set(modes)) == list(MODES)
    assert modes == sorted(modes), "the rows of a mode must stand together"
    assert {row[3] for row in supervisor.TRANSITIONS} == set(MODES), "every mode is reachable"


def test_reasons_are_those_of_the_dbc_and_have_a_text():
    database = cantools.database.load_file(DBC)
    choices = database.get_message_by_name("CTRL_SysCmd").get_signal_by_name("control_reason").choices
    by_name = {str(text).upper(): number for number, text in choices.items()}
    ours = {
        name.replace("_", ""): value
        for name, value in vars(c).items()
        if isinstance(value, int) and value < c.START_PRESSED
    }
    assert ours == by_name
    assert set(TEXT) == set(by_name.values())


@pytest.mark.parametrize("row", [r for r in supervisor.TRANSITIONS if r[0] == s.MODE_ACTIVE and r[3] == s.MODE_FAULT])
def test_each_stopping_condition_alone_ends_active_with_its_reason_and_reaction(row):
    after = supervisor.decide(state_in(s.MODE_ACTIVE), row[1] | mask(c.VEHICLE_ACTIVE), PERIOD_US)
    assert (after.mode, after.reason, after.reaction) == (s.MODE_FAULT, row[4], row[5])


def test_harder_reactions_stand_before_softer_ones():
    reactions = [row[5] for row in supervisor.TRANSITIONS if row[0] == s.MODE_ACTIVE and row[3] == s.MODE_FAULT]
    hardness = [supervisor.STOP_RELEASE, supervisor.STOP_EMERGENCY, supervisor.STOP_CONTROLLED]
    assert reactions == sorted(reactions, key=hardness.index)


def test_active_stays_while_nothing_is_wrong():
    fine = mask(c.VEHICLE_ACTIVE, c.VEHICLE_NOT_READY, c.NOT_AT_STANDSTILL, c.POSE_NOT_AT_START)
    assert supervisor.decide(state_in(s.MODE_ACTIVE), fine, PERIOD_US).mode == s.MODE_ACTIVE


def test_the_hardest_reason_wins_when_several_are_present():
    present = mask(c.POSE_TIMEOUT, c.EMERGENCY_STOP, c.OPERATOR_STOP)
    after = supervisor.decide(state_in(s.MODE_ACTIVE), present, PERIOD_US)
    assert (after.reason, after.reaction) == (c.EMERGENCY_STOP, supervisor.STOP_EMERGENCY)


def test_random_conditions_never_leave_the_set_of_modes_and_fault_is_left_only_by_clear_at_standstill():
    rng = random.Random(4)
    state = supervisor.begin()
    seen = set()
    for _ in range(20_000):
        conditions = rng.getrandbits(46) & rng.getrandbits(46) & rng.getrandbits(46)
        after = supervisor.decide(state, conditions, PERIOD_US)
        assert after.mode in MODES
        if state.mode == s.MODE_FAULT and after.mode != s.MODE_FAULT:
            assert conditions & mask(c.CLEAR_PRESSED, c.STANDSTILL) == mask(c.CLEAR_PRESSED, c.STANDSTILL)
            assert after.mode == s.MODE_MANUAL
        if after.mode == s.MODE_ACTIVE and state.mode != s.MODE_ACTIVE:
            assert state.mode == s.MODE_READY
        seen.add((state.mode, after.mode))
        state = after
    assert {(s.MODE_ACTIVE, s.MODE_FAULT), (s.MODE_FAULT, s.MODE_MANUAL), (s.MODE_READY, s.MODE_MANUAL)} <= seen


def test_a_fault_gets_harder_but_never_softer_and_keeps_its_first_reason():
    fault = supervisor.decide(state_in(s.MODE_ACTIVE), mask(c.POSE_TIMEOUT), PERIOD_US)
    harder = supervisor.decide(fault, mask(c.EMERGENCY_STOP), PERIOD_US)
    later = supervisor.decide(harder, 0, PERIOD_US)
    assert (later.reason, later.reaction) == (c.POSE_TIMEOUT, supervisor.STOP_EMERGENCY)
    released = supervisor.decide(later, mask(c.DRIVER_OVERRIDE), PERIOD_US)
    assert (released.reason, released.reaction) == (c.POSE_TIMEOUT, supervisor.STOP_RELEASE)


def test_start_needs_an_edge_in_ready_and_the_vehicle_answers_in_time_or_it_is_withdrawn():
    ready = state_in(s.MODE_READY)
    assert supervisor.decide(ready, mask(c.VEHICLE_ACTIVE), PERIOD_US).mode == s.MODE_READY
    pressed = supervisor.decide(ready, mask(c.START_PRESSED), PERIOD_US)
    assert (pressed.mode, pressed.enabling) == (s.MODE_READY, 1)
    answered = supervisor.decide(pressed, mask(c.VEHICLE_ACTIVE, c.VEHICLE_NOT_READY), PERIOD_US)
    assert answered.mode == s.MODE_ACTIVE
    waiting = pressed
    for _ in range(supervisor.ENABLE_TIMEOUT_US // PERIOD_US):
        waiting = supervisor.decide(waiting, 0, PERIOD_US)
    assert waiting.mode == s.MODE_READY, "exactly at the limit it still waits"
    waiting = supervisor.decide(waiting, 0, PERIOD_US)
    assert (waiting.mode, waiting.reason, waiting.enabling) == (s.MODE_MANUAL, c.ENABLE_REFUSED, 0)


def drive_to(tables, cycles, change, vehicle_state=s.MODE_READY, state=None):
    state = state or controller.begin()
    outputs = None
    for cycle in range(cycles):
        inputs = change(standing_inputs(tables, cycle, vehicle_state), cycle)
        state, outputs = controller.step(tables, state, inputs)
    return state, outputs


BLOCKED = {
    c.WAITING_FOR_OPERATOR: lambda i, n: i._replace(used=i.used._replace(used_oper_counter=s.NO_COUNTER)),
    c.WAITING_FOR_REPORTS: lambda i, n: i._replace(used=i.used._replace(used_steer_counter=s.NO_COUNTER)),
    c.DBC_HASH_MISMATCH: lambda i, n: i._replace(version=i.version._replace(veh_dbc_hash=1)),
    c.VEHICLE_HASH_MISMATCH: lambda i, n: i._replace(version=i.version._replace(veh_vehicle_hash=1)),
    c.POSE_NOT_AT_START: lambda i, n: i._replace(position=i.position._replace(position_x_m=-0.852)),
    c.NOT_AT_STANDSTILL: lambda i, n: i._replace(motion=i.motion._replace(speed_meas_mps=0.01)),
    c.VEHICLE_NOT_READY: lambda i, n: i._replace(sys=i.sys._replace(vehicle_state=s.MODE_MANUAL)),
    c.VEHICLE_FAULT: lambda i, n: i._replace(sys=i.sys._replace(vehicle_state=s.MODE_FAULT)),
    c.DRIVER_OVERRIDE: lambda i, n: i._replace(steer=i.steer._replace(steer_override=1)),
    c.EMERGENCY_STOP: lambda i, n: i._replace(oper=i.oper._replace(oper_estop=1)),
    c.OPERATOR_STOP: lambda i, n: i._replace(oper=i.oper._replace(oper_stop=1)),
    c.SECOND_CONTROLLER: lambda i, n: i._replace(second_controller=1),
}


def test_a_car_that_is_fine_becomes_ready():
    _, outputs = drive_to(shipped_tables(), 60, lambda i, n: i)
    assert outputs.sys.control_mode == s.MODE_READY
    assert outputs.sys.control_reason == c.NONE


@pytest.mark.parametrize("reason", sorted(BLOCKED))
def test_each_missing_precondition_alone_keeps_the_controller_manual_and_is_named(reason):
    _, outputs = drive_to(shipped_tables(), 150, BLOCKED[reason])
    assert (outputs.sys.control_mode, outputs.sys.control_reason) == (s.MODE_MANUAL, reason)
    assert (outputs.sys.enable_request, outputs.steer.steer_enable, outputs.long.long_enable) == (0, 0, 0)


@pytest.mark.parametrize(
    ("message", "counter"),
    [
        ("VEH_SysRpt", "used_sys_counter"),
        ("VEH_SteerRpt", "used_steer_counter"),
        ("VEH_MotionRpt", "used_motion_counter"),
        ("VEH_LongRpt", "used_long_counter"),
        ("LOC_Position", "used_position_counter"),
        ("LOC_Attitude", "used_attitude_counter"),
        ("OPER_Cmd", "used_oper_counter"),
        ("VEH_Version", "used_veh_version_counter"),
    ],
)
def test_each_timeout_of_the_dbc_acts_at_its_limit_and_not_one_cycle_before(message, counter):
    tables = shipped_tables()
    timeout_cycles = shipped_codec().messages[message].timeout_ms // 10
    state, outputs = drive_to(tables, 60, lambda i, n: i)
    for silent in range(1, timeout_cycles + 1):
        assert outputs.sys.control_mode == s.MODE_READY, f"{silent - 1} silent cycles"
        inputs = standing_inputs(tables, 60 + silent)
        inputs = inputs._replace(used=inputs.used._replace(**{counter: s.NO_COUNTER}))
        state, outputs = controller.step(tables, state, inputs)
    assert outputs.sys.control_mode == s.MODE_MANUAL
