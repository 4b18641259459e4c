"""DBC -> Python functions that pack and unpack frames; the way of every value between bus and control law.

`load_codec` reads the DBC with cantools, checks that it says what `core/signals.py` says, and writes three functions a
message as source text (kept in `Codec.source`), which it then executes. In the cycle only those functions run: shifts,
masks, one multiplication a signal, the CRC written out. They round half up, saturate, and never raise for any float.
"""

import hashlib
import itertools
import re
import struct
from collections.abc import Callable
from math import floor
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, NamedTuple, cast

from firmware_py import e2e
from firmware_py.core import conditions, signals
from firmware_py.core.signals import NO_COUNTER, Inputs, UsedCounters
from firmware_py.errors import UserError
from firmware_py.reasons import TEXT

if TYPE_CHECKING:
    from cantools.database.can import Message, Signal

NODE = "CTRL"
FRAME_BYTES = 8


STRUCTS: dict[str, type[Any]] = {
    "CTRL_SysCmd": signals.SysCommand,
    "CTRL_SteerCmd": signals.SteerCommand,
    "CTRL_LongCmd": signals.LongCommand,
    "CTRL_Cycle": signals.CycleStamp,
    "CTRL_CycleInputs": signals.UsedCounters,
    "CTRL_Track": signals.Track,
    "CTRL_Version": signals.ControllerVersion,
    "CTRL_HealthTiming": signals.HealthTiming,
    "CTRL_HealthCounts": signals.HealthCounts,
    "CTRL_Estimate": signals.Estimate,
    "VEH_SysRpt": signals.SysReport,
    "VEH_SteerRpt": signals.SteerReport,
    "VEH_MotionRpt": signals.MotionReport,
    "VEH_LongRpt": signals.LongReport,
    "LOC_Position": signals.Position,
    "LOC_Attitude": signals.Attitude,
    "OPER_Cmd": signals.OperatorCommand,
    "VEH_Version": signals.VehicleVersion,
}
"""The struct of each message; its fields are the payload signals, in the DBC's order."""

PAIR = ("LOC_Position", "LOC_Attitude")
"""Two messages of one sample: their values belong together where their counters are equal."""

VALID_BITS = {
    "VEH_MotionRpt": (("speed_valid", "speed_meas_mps"), ("yaw_rate_valid", "yaw_rate_meas_radps")),
    "VEH_SteerRpt": (("steer_angle_valid", "road_wheel_angle_meas_rad"),),
}
"""Signals that say whether another signal of the message may be used; one that may not keeps its last value."""

INPUT_MESSAGES = (
    "VEH_SysRpt",
    "VEH_SteerRpt",
    "VEH_MotionRpt",
    "VEH_LongRpt",
    "LOC_Position",
    "LOC_Attitude",
    "OPER_Cmd",
    "VEH_Version",
)
"""What the controller receives, in the order of `UsedCounters` and of the structs in `Inputs`."""


def _constants(module: ModuleType, prefix: str) -> dict[str, int]:
    """Return the constants of a module whose names begin with the prefix, without it."""
    return {name.removeprefix(prefix): value for name, value in vars(module).items() if name.startswith(prefix)}


_MODES = _constants(signals, "MODE_")
_GEARS = _constants(signals, "GEAR_")
_QUALITIES = _constants(signals, "QUALITY_")

VALUE_TABLES: dict[str, dict[str, int]] = {
    "control_mode": _MODES,
    "vehicle_state": _MODES,
    "control_leg": _constants(signals, "LEG_"),
    "control_reason": {name: value for name, value in vars(conditions).items() if name.isupper() and value in TEXT},
    "gear_cmd": _GEARS,
    "gear_rpt": _GEARS,
    "position_quality": _QUALITIES,
    "yaw_quality": _QUALITIES,
}
"""Signals with a value table, and the firmware's own constants that must agree with it."""

Pack = Callable[[Any, int, Any], bytes]
Unpack = Callable[[bytes], Any]

_WORD = struct.Struct("<Q")
"""A payload as one number: byte 0, the CRC's, is its lowest."""


class MessageInfo(NamedTuple):
    """What the DBC says of one message."""

    name: str
    frame_id: int
    cycle_time_ms: int
    timeout_ms: int
    sender: str
    struct: type[Any]


class Codec(NamedTuple):
    """A checked DBC with its generated functions.

    `pack[name](values, counter, faults) -> bytes` makes a whole frame with CRC; a NaN becomes the signal's start value
    and adds one to `faults.nan_count`. `unpack[name](data) -> struct` reads the payload and checks nothing;
    `receive[name](data)` gives None where the CRC is wrong. Both want 8 bytes.
    """

    dbc_hash24: int
    messages: dict[str, MessageInfo]
    scales: dict[str, float]
    pack: dict[str, Pack]
    unpack: dict[str, Unpack]
    receive: dict[str, Unpack]
    source: str

    def scale(self, signal_name: str) -> float:
        """Return the physical value of one bit of the signal, in the signal's unit."""
        return self.scales[signal_name]


# ---------------------------------------------------------------------------------------------- reading and checking


def load_codec(dbc_path: Path) -> Codec:
    """Read, check and compile the DBC.

    Raises UserError if the file is missing, is no DBC, or differs from `core/signals.py`.
    """
    try:
        content = Path(dbc_path).read_bytes().replace(b"\r\n", b"\n")
    except OSError as error:
        raise UserError(f"DBC file {dbc_path}: cannot be read ({error.strerror}); give the path of a DBC") from None
    by_name = {message.name: message for message in _parse(dbc_path, content)}
    try:
        _same_names("messages", list(STRUCTS), list(by_name))
        messages = {name: _check_message(by_name[name], struct) for name, struct in STRUCTS.items()}
        for signal_name, wanted in VALUE_TABLES.items():
            _check_value_table(by_name, signal_name, wanted)
    except _DifferenceError as difference:
        raise UserError(f"DBC file {dbc_path}: {difference}") from None
    source = "\n\n".join(_source_of(by_name[name]) for name in STRUCTS)
    namespace: dict[str, Any] = {
        "floor": floor,
        "to_bytes": _WORD.pack,
        "from_bytes": _WORD.unpack,
        "new": tuple.__new__,  # what a NamedTuple's own constructor calls, without its Python frame
        **{f"crc_then_{zeros}_zeros": e2e.table_before_zeros(zeros) for zeros in range(FRAME_BYTES - 1)},
        **{s.__name__: s for s in STRUCTS.values()},
    }
    exec(compile(source, f"<generated from {Path(dbc_path).name}>", "exec"), namespace)
    return Codec(
        dbc_hash24=int.from_bytes(hashlib.sha256(content).digest()[:3], "big"),
        messages=messages,
        scales={s.name: float(s.scale) for name in STRUCTS for s in _payload(by_name[name])},
        pack={name: namespace[f"pack_{name}"] for name in STRUCTS},
        unpack={name: namespace[f"unpack_{name}"] for name in STRUCTS},
        receive={name: namespace[f"receive_{name}"] for name in STRUCTS},
        source=source,
    )


def _parse(dbc_path: Path, content: bytes) -> "list[Message]":
    import cantools  # noqa: PLC0415 -- heavy, and what only runs the cycle does not need it

    try:
        database = cantools.database.load_string(content.decode("utf-8"), database_format="dbc", strict=True)
    except Exception as error:  # cantools and its parser raise many kinds
        raise UserError(f"DBC file {dbc_path}: not a valid DBC ({_first_line(error)})") from None
    return cast("list[Message]", getattr(database, "messages", []))


class _DifferenceError(Exception):
    """How the DBC differs from what the controller was built for."""


def _first_line(error: Exception) -> str:
    return re.sub(r"\s+", " ", str(error)).strip()[:160] or type(error).__name__


def _same_names(what: str, wanted: list[str], found: list[str]) -> None:
    missing = [name for name in wanted if name not in found]
    extra = [name for name in found if name not in wanted]
    if missing or extra:
        parts = [f"lacks {', '.join(missing)}"] * bool(missing) + [f"has unknown {', '.join(extra)}"] * bool(extra)
        raise _DifferenceError(f"{what}: {' and '.join(parts)}; the controller needs {len(wanted)} {what}")


def _payload(message: "Message") -> list["Signal"]:
    own = (f"{message.name}_crc", f"{message.name}_counter")
    return [signal for signal in message.signals if signal.name not in own]


def _check_message(message: "Message", struct: type[Any]) -> MessageInfo:
    name = message.name
    if message.length != FRAME_BYTES or message.is_extended_frame or message.is_multiplexed():
        raise _DifferenceError(f"message {name} must have an 11-bit id, {FRAME_BYTES} bytes and no multiplexing")
    layout = {signal.name: (signal.start, signal.length) for signal in message.signals}
    if layout.get(f"{name}_crc") != (0, 8) or layout.get(f"{name}_counter") != (8, 4):
        raise _DifferenceError(f"message {name} must have {name}_crc at bit 0|8 and {name}_counter at bit 8|4")
    found = [signal.name for signal in _payload(message)]
    _same_names(f"signals of {name}", list(struct._fields), found)
    if found != list(struct._fields):
        raise _DifferenceError(f"signals of {name} must stand in the order {', '.join(struct._fields)}")
    for signal in message.signals:
        if signal.byte_order != "little_endian" or signal.is_float:
            raise _DifferenceError(f"signal {signal.name} must be an integer in Intel byte order (@1)")
    attributes = {key: attribute.value for key, attribute in message.dbc.attributes.items()} if message.dbc else {}
    for key in ("GenMsgCycleTime", "GenMsgTimeout", "E2EDataId"):
        if not attributes.get(key):
            raise _DifferenceError(f'message {name} lacks the attribute "{key}"')
    if attributes["E2EDataId"] != message.frame_id:
        raise _DifferenceError(f'message {name}: the attribute "E2EDataId" must be the frame id, {message.frame_id}')
    if len(message.senders) != 1:
        raise _DifferenceError(f"message {name} must have one sender")
    return MessageInfo(
        name=name,
        frame_id=message.frame_id,
        cycle_time_ms=int(attributes["GenMsgCycleTime"]),
        timeout_ms=int(attributes["GenMsgTimeout"]),
        sender=message.senders[0],
        struct=struct,
    )


def _check_value_table(by_name: dict[str, "Message"], signal_name: str, wanted: dict[str, int]) -> None:
    signal = next(s for message in by_name.values() for s in message.signals if s.name == signal_name)
    found = {value: str(text) for value, text in (signal.choices or {}).items()}
    for constant, value in wanted.items():
        text = constant.title().replace("_", "")
        if found.get(value) != text:
            raise _DifferenceError(f'value table of {signal_name} must have {value} "{text}"')


# ------------------------------------------------------------------------------------------------------- generating


def _source_of(message: "Message") -> str:
    """Return the source text of the three functions of one message."""
    payload = _payload(message)
    names = [signal.name for signal in payload]
    values = f"new({STRUCTS[message.name].__name__}, ({', '.join(_unpack_expression(signal) for signal in payload)},))"
    last_byte = max(signal.start + signal.length - 1 for signal in payload) // 8
    pack = [
        f"def pack_{message.name}(values, counter, faults):",
        f"    {', '.join(names)}, = values",
        *(line for signal in payload for line in _pack_lines(signal)),
        "    word = counter << 8 | " + " | ".join(f"{signal.name} << {signal.start}" for signal in payload),
        f"    return to_bytes(word | {_crc_expression(message.frame_id, last_byte)})",
    ]
    unpack = [
        f"def unpack_{message.name}(data):",
        "    word, = from_bytes(data)",
        f"    return {values}",
    ]
    receive = [f"def receive_{message.name}(data):", "    word, = from_bytes(data)"]
    for last in sorted({last_byte, FRAME_BYTES - 1}):
        # What no signal uses is zero in a right frame; where it is not, the CRC is taken over all of it.
        condition = "else" if last > last_byte else f"if word < {1 << 8 * (last + 1):#x}"
        receive += [
            f"    {condition}:",
            f"        if {_crc_expression(message.frame_id, last)} != word & 0xff: return None",
        ]
    receive.append(f"    return {values}")
    return "\n".join([*pack, "", "", *unpack, "", "", *receive, ""])


def _crc_expression(frame_id: int, last_byte: int) -> str:
    """Return the CRC over the frame's id and bytes 1 to 7 of `word`, where those after `last_byte` are zero.

    The table of the last step takes the zero bytes in one with it.
    """
    crc = f"{e2e.crc8_of_id(frame_id):#x}"
    for number in range(1, last_byte + 1):
        table = f"crc_then_{FRAME_BYTES - 1 - last_byte if number == last_byte else 0}_zeros"
        byte = f"word >> {8 * number}" + ("" if number == last_byte else " & 0xff")
        crc = f"{table}[{crc} ^ ({byte})]"
    return crc


def _raw_limits(signal: "Signal") -> tuple[int, int]:
    if signal.is_signed:
        return -(1 << signal.length - 1), (1 << signal.length - 1) - 1
    return 0, (1 << signal.length) - 1


def _pack_lines(signal: "Signal") -> list[str]:
    """Physical value -> raw bits, in place. The comparisons are so ordered that only a NaN reaches the `else`.

    What is scaled is a float and compared with floats: comparing a float with an integer takes CPython three times as
    long.
    """
    name = signal.name
    low, high = _raw_limits(signal)
    start = int(signal.raw_initial or 0)
    shifted = name if signal.offset == 0 else f"({name} - {signal.offset!r})"
    is_scaled = (signal.scale, signal.offset) != (1, 0)
    lines = [f"    {name} = {shifted} / {signal.scale!r}"] if is_scaled else []
    least, most = (float(low), float(high)) if is_scaled else (low, high)
    lines += [
        f"    if {name} < {most}: {name} = floor({name} + 0.5) if {name} > {least} else {low}",
        f"    elif {name} >= {most}: {name} = {high}",
        "    else:",
        f"        {name} = {start}",
        "        faults.nan_count += 1",
    ]
    if signal.is_signed:
        lines.append(f"    {name} &= {(1 << signal.length) - 1:#x}")
    return lines


def _unpack_expression(signal: "Signal") -> str:
    raw = f"(word >> {signal.start} & {(1 << signal.length) - 1:#x})"
    if signal.is_signed:
        sign = 1 << signal.length - 1
        raw = f"(({raw} ^ {sign:#x}) - {sign:#x})"
    if signal.scale != 1:
        raw = f"{raw} * {signal.scale!r}"
    return raw if signal.offset == 0 else f"{raw} + {signal.offset!r}"


# -------------------------------------------------------------------------------------------------- the two directions


class _Slot:
    """The newest valid values of one message."""

    __slots__ = ("frame_id", "partner", "receive", "receiver", "timeout_ns", "used", "valid_bits", "values", "waiting")

    def __init__(self, info: MessageInfo, codec: Codec) -> None:
        self.frame_id = info.frame_id
        self.timeout_ns = info.timeout_ms * 1_000_000
        self.receiver = e2e.Receiver(self.timeout_ns)
        self.receive = codec.receive[info.name]
        self.values: Any = codec.unpack[info.name](bytes(FRAME_BYTES))
        self.used = NO_COUNTER
        fields = info.struct._fields
        self.valid_bits = tuple((fields.index(b), fields.index(v)) for b, v in VALID_BITS.get(info.name, ()))
        self.partner: _Slot | None = None
        self.waiting: tuple[int, int, Any] | None = None  # arrival, counter and values: wait for the partner's frame

    def keep(self, now_ns: int, counter: int, values: Any) -> None:
        """Take over the values of a valid frame; a value that says itself that it is invalid is not taken.

        What has waited for its partner for a timeout is of another sample, whatever its counter says: counters recur.
        """
        for bit, value in self.valid_bits:
            if not values[bit]:
                values = values._replace(**{values._fields[value]: self.values[value]})
        if self.partner is None:
            self.values, self.used = values, counter
            return
        other = self.partner
        if other.waiting is not None and other.waiting[1] == counter and now_ns - other.waiting[0] < self.timeout_ns:
            self.used, self.values = counter, values
            _, other.used, other.values = other.waiting
            self.waiting = other.waiting = None
        else:
            self.waiting = (now_ns, counter, values)


class Mailbox:
    """Receiving side of the controller: keeps the newest valid values of each message until the cycle takes them.

    A rejected frame changes no value and no baseline; it is counted by its reason. `second_controller` is 1 from a
    frame that only a controller may send until the next `take`. The two messages of a pose are handed out together or
    not at all, whichever cycles their frames fall into.
    """

    def __init__(self, codec: Codec) -> None:
        self._slots = tuple(_Slot(codec.messages[name], codec) for name in INPUT_MESSAGES)
        self._slot_by_id = {slot.frame_id: slot for slot in self._slots}
        slot_of = dict(zip(INPUT_MESSAGES, self._slots, strict=True))
        for one, other in (PAIR, PAIR[::-1]):
            slot_of[one].partner = slot_of[other]
        self._own_ids = frozenset(info.frame_id for info in codec.messages.values() if info.sender == NODE)
        self.received = 0
        self.foreign = 0
        self.rejected_crc = 0
        self.rejected_counter = 0
        self.rejected_length = 0
        self.second_controller = 0

    @property
    def lost(self) -> int:
        """Frames that the counters of accepted frames have skipped."""
        return sum(slot.receiver.lost for slot in self._slots)

    def put(self, now_ns: int, arbitration_id: int, data: bytes) -> None:
        """Judge one frame from the bus and keep its values if it is valid; never raises."""
        slot = self._slot_by_id.get(arbitration_id)
        if slot is None:
            if arbitration_id in self._own_ids:
                self.second_controller = 1
            else:
                self.foreign += 1
        elif len(data) != FRAME_BYTES:
            self.rejected_length += 1
        else:
            values = slot.receive(data)
            counter = data[1] & 0x0F
            if values is None:
                self.rejected_crc += 1
            elif slot.receiver.check(now_ns, counter) != e2e.OK:
                self.rejected_counter += 1
            else:
                slot.keep(now_ns, counter, values)
                self.received += 1

    def rehearse(self, frames: list[tuple[int, bytes]]) -> None:
        """Decode frames that have been put already, and forget them; changes nothing."""
        for arbitration_id, data in frames:
            slot = self._slot_by_id.get(arbitration_id)
            if slot is not None and len(data) == FRAME_BYTES:
                slot.receive(data)

    def take(self, now_us: int, overruns: int) -> Inputs:
        """Return the newest valid values and which of them are new since the last call.

        `now_us` is the wake-up time of the cycle in whole microseconds, not wrapped; `overruns` the periods skipped
        before it, held at the greatest number that the bus can carry.
        """
        used = UsedCounters._make([*[slot.used for slot in self._slots], min(overruns, 255)])
        inputs = Inputs._make([now_us, used, *[slot.values for slot in self._slots], self.second_controller])
        for slot in self._slots:
            slot.used = NO_COUNTER
        self.second_controller = 0
        return inputs


class Sender:
    """Sending side of the controller: one rolling counter a message; `nan_count` counts values that were no number."""

    def __init__(self, codec: Codec) -> None:
        self._outgoing = {
            name: (info.frame_id, codec.pack[name], itertools.cycle(range(e2e.COUNTER_VALUES)))
            for name, info in codec.messages.items()
        }
        self.nan_count = 0

    def pack(self, name: str, values: tuple[Any, ...]) -> tuple[int, bytes]:
        """Return (arbitration id, payload) of the next frame of the message `name`."""
        frame_id, pack, counters = self._outgoing[name]
        return frame_id, pack(values, next(counters), self)

    def rehearse(self, messages: list[tuple[str, tuple[Any, ...]]]) -> None:
        """Pack messages and forget the frames; no counter moves, and what is no number is not counted."""
        for name, values in messages:
            self._outgoing[name][1](values, 0, _Uncounted)


class _Uncounted:
    """Takes the count of values that were no number where nothing is sent."""

    nan_count = 0
