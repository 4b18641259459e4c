"""Lint of dbc/parking.dbc: whatever a plant, a log tool or the codec relies on is there and consistent."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

import cantools
import pytest
from cantools.database.can import Database, Message, Signal

DBC = Path(__file__).resolve().parent.parent / "dbc/parking.dbc"
TEXT = DBC.read_text(encoding="ascii")  # other characters read differently in different tools
DATABASE: Database = cantools.database.load_string(TEXT, database_format="dbc", strict=True)
MESSAGES: list[Message] = DATABASE.messages
SIGNALS: list[tuple[Message, Signal]] = [(m, s) for m in MESSAGES for s in m.signals]
NODES = {"CTRL", "VEH", "LOC", "OPER"}
EXHAUSTIVE_BITS = 16

each_message = pytest.mark.parametrize("message", MESSAGES, ids=lambda m: m.name)
each_signal = pytest.mark.parametrize(("message", "signal"), SIGNALS, ids=[s.name for _, s in SIGNALS])


def attribute(holder: Message | Signal, name: str) -> int:
    assert holder.dbc is not None
    assert name in holder.dbc.attributes, f"{holder.name} lacks {name}; a default in the DBC is not enough"
    return int(holder.dbc.attributes[name].value)


def codable(signal: Signal) -> tuple[int, int]:
    half = 1 << (signal.length - 1)
    return (-half, half - 1) if signal.is_signed else (0, 2 * half - 1)


def test_the_bus_and_its_nodes_are_described() -> None:
    assert {node.name for node in DATABASE.nodes} == NODES
    assert all(node.comment for node in DATABASE.nodes)
    attributes = {name: found.value for name, found in DATABASE.dbc.attributes.items()}
    assert attributes == {"BusType": "CAN", "DBName": "parking", "Baudrate": 500000, "ProtocolVersion": 1}


def test_names_are_short_and_unique_over_the_whole_file() -> None:
    names = [m.name for m in MESSAGES] + [s.name for _, s in SIGNALS]
    assert [name for name, count in Counter(names).items() if count > 1] == []
    assert [name for name in names if len(name) > 32] == []
    assert len({m.frame_id for m in MESSAGES}) == len(MESSAGES)


@each_message
def test_message_has_all_that_a_receiver_needs(message: Message) -> None:
    assert message.comment
    assert message.length == 8
    assert not message.is_extended_frame
    assert not message.is_multiplexed()
    assert len(message.senders) == 1
    assert message.senders[0] == message.name.partition("_")[0]
    assert message.senders[0] in NODES
    assert message.receivers, "nobody listens"
    assert message.receivers <= NODES - set(message.senders)
    cycle_ms, timeout_ms = attribute(message, "GenMsgCycleTime"), attribute(message, "GenMsgTimeout")
    assert cycle_ms in (10, 20, 100, 1000)
    assert message.cycle_time == cycle_ms
    # A counter that jumped is followed after three frames: that must be sooner than the timeout.
    assert 5 * cycle_ms <= timeout_ms <= 10 * cycle_ms
    assert message.send_type == "cyclic"


@each_message
def test_message_has_crc_and_counter_where_they_belong(message: Message) -> None:
    layout = {s.name: (s.start, s.length, s.is_signed, s.scale, s.offset) for s in message.signals}
    assert layout[f"{message.name}_crc"] == (0, 8, False, 1, 0)
    assert layout[f"{message.name}_counter"] == (8, 4, False, 1, 0)
    assert attribute(message, "E2EDataId") == message.frame_id
    assert min(s.start for s in message.signals if not s.name.startswith(message.name)) >= 12


@each_message
def test_signals_share_no_bit(message: Message) -> None:
    """cantools' strict load says so too; this does not rely on it."""
    bits = [bit for s in message.signals for bit in range(s.start, s.start + s.length)]
    assert len(bits) == len(set(bits))
    assert max(bits) < 8 * message.length


def test_ids_are_ordered_by_priority() -> None:
    """Lower ids win the bus: system, then reports, commands, slow messages, localisation."""
    ranges = {"0x0": {"CTRL", "VEH", "OPER"}, "0x1": {"VEH"}, "0x2": {"CTRL"}, "0x3": {"CTRL", "VEH"}, "0x6": {"LOC"}}
    for message in MESSAGES:
        assert message.senders[0] in ranges[f"0x{message.frame_id >> 8:x}"], message.name
    estop_and_state = {m.name for m in MESSAGES if m.frame_id < 0x100}
    assert estop_and_state == {"CTRL_SysCmd", "VEH_SysRpt", "OPER_Cmd"}


@each_signal
def test_signal_comment_says_unit_and_sign(message: Message, signal: Signal) -> None:
    comment = signal.comment or ""
    body, _, tail = comment.rstrip("]").rpartition(" [")
    assert body, f"no comment, or no [unit; sign] at its end: {comment!r}"
    unit = signal.unit or "no unit"
    if signal.choices:
        assert tail == "value table"
    elif signal.length == 1:
        assert tail == "flag"
        assert body.startswith("1 = ")
    elif signal.is_signed:
        assert re.fullmatch(rf"{re.escape(unit)}; positive = .+", tail)
    else:
        assert tail == f"{unit}; never negative"


@each_signal
def test_signal_name_ends_in_its_unit(message: Message, signal: Signal) -> None:
    suffix = {"m": "_m", "rad": "_rad", "m/s": "_mps", "rad/s": "_radps", "m/s^2": "_mps2", "1/m": "_1pm"}
    suffix |= {"us": "_us", "ms": "_ms", "Nm": "_nm"}
    if signal.unit:
        assert signal.name.endswith(suffix[signal.unit])
    else:
        assert not signal.name.endswith(tuple(suffix.values()))


@each_signal
def test_signal_range_is_the_codable_range(message: Message, signal: Signal) -> None:
    low, high = codable(signal)
    assert signal.minimum == pytest.approx(low * signal.scale, rel=1e-12, abs=0)
    assert signal.maximum == pytest.approx(high * signal.scale, rel=1e-12, abs=0)
    assert signal.offset == 0
    assert signal.byte_order == "little_endian"
    assert not signal.is_float
    assert signal.receivers


@each_signal
def test_signal_start_value_is_legal(message: Message, signal: Signal) -> None:
    start = attribute(signal, "GenSigStartValue")
    low, high = codable(signal)
    assert low <= start <= high
    assert start == signal.raw_initial
    assert start == (15 if signal.name.startswith("used_") else 0)
    if signal.choices:
        assert start in signal.choices


@each_signal
def test_value_tables_are_complete_and_codable(message: Message, signal: Signal) -> None:
    if not signal.choices:
        assert not signal.name.endswith(("_state", "_reason", "_mode", "_leg", "_quality")), (
            "an enumeration without names"
        )
        return
    assert list(signal.choices) == list(range(len(signal.choices))), "a table has no holes and starts at 0"
    assert max(signal.choices) <= codable(signal)[1]
    names = [str(name) for name in signal.choices.values()]
    assert len(names) == len(set(names))
    assert all(re.fullmatch(r"[A-Z][A-Za-z]*", name) for name in names), "names that are identifiers in every language"


def test_signals_that_mean_the_same_have_the_same_value_table() -> None:
    tables = {s.name: s.choices for _, s in SIGNALS}
    assert tables["control_mode"] == tables["vehicle_state"]
    assert tables["gear_cmd"] == tables["gear_rpt"]
    assert tables["position_quality"] == tables["yaw_quality"]


def test_echo_and_measurement_are_coded_like_their_command() -> None:
    coding = {s.name: (s.length, s.is_signed, s.scale, s.offset) for _, s in SIGNALS}
    assert coding["road_wheel_angle_echo_rad"] == coding["road_wheel_angle_cmd_rad"]
    assert coding["road_wheel_angle_meas_rad"] == coding["road_wheel_angle_cmd_rad"]
    assert coding["speed_echo_mps"] == coding["speed_cmd_mps"]
    assert coding["brake_decel_echo_mps2"] == coding["brake_decel_cmd_mps2"]


@each_signal
def test_raw_to_physical_to_raw_is_exact(message: Message, signal: Signal) -> None:
    """Every raw value of short signals; ends, neighbours of the ends and a sweep of the long ones."""
    low, high = codable(signal)
    if signal.length <= EXHAUSTIVE_BITS:
        raws: set[int] = set(range(low, high + 1))
    else:
        raws = {low, low + 1, -1 if signal.is_signed else 1, 0, high - 1, high}
        raws |= set(range(low, high, (high - low) // 5000))
    scale = signal.scale
    assert [raw for raw in raws if round(raw * scale / scale) != raw] == []
    back = signal.conversion.numeric_scaled_to_raw
    assert [raw for raw in raws if back(raw * scale) != raw] == []


def test_resolution_is_fine_enough_for_the_control_law() -> None:
    """The figures that the design stands on: 1e-5 m, 4e-7 rad, 1e-4 m/s, 1e-4 rad of road wheel or finer."""
    needed = {
        "position_x_m": (1e-5, 100.0),
        "position_y_m": (1e-5, 100.0),
        "yaw_rad": (4e-7, 3.1415927),
        "speed_meas_mps": (1e-4, 10.0),
        "road_wheel_angle_cmd_rad": (1e-4, 0.8),
        "yaw_rate_meas_radps": (1e-5, 2.0),
        "speed_cmd_mps": (1e-3, 2.0),
    }
    by_name = {s.name: s for _, s in SIGNALS}
    for name, (resolution, reach) in needed.items():
        signal = by_name[name]
        assert signal.scale <= resolution, name
        assert signal.maximum is not None
        assert signal.maximum >= reach, name
        assert signal.minimum is not None
        assert signal.minimum <= -reach, name


def test_bus_load_leaves_room_at_500_kbit() -> None:
    """A standard frame of 8 bytes takes at most 135 bits with all stuff bits and the gap."""
    load = sum(1000 / attribute(m, "GenMsgCycleTime") for m in MESSAGES) * 135 / 500_000
    assert load < 0.40
