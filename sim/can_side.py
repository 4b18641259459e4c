"""The plant's side of the wire: encodes and decodes with cantools, with a CRC and counter check of its own.

Nothing here is shared with the controller's codec, so that each side checks the other; what both follow is the DBC and
dbc/CONVENTIONS.md. Bits are packed by cantools' compiled formats; limits and scales are applied here, because
cantools' own `encode` and `decode` check on every call what never changes, and take ten times as long.
"""

import functools
import hashlib
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Protocol, cast

import cantools
from cantools.database.can import Database, Message, Signal
from cantools.database.utils import create_encode_decode_formats

from sim.errors import UserError

Values = dict[str, int | float]

PLANT_NODES = ("VEH", "LOC")
LOG_ONLY = ("CTRL_Cycle", "CTRL_CycleInputs", "CTRL_Track", "CTRL_HealthTiming", "CTRL_HealthCounts", "CTRL_Estimate")
"""Messages that say nothing to a vehicle: checked, counted, not decoded."""

NS_PER_MS = 1_000_000
_COUNTERS = 15
_FARTHEST_STEP = 5
_RUN_TO_RESYNC = 3


def _make_crc_table() -> bytes:
    """CRC-8 SAE J1850: polynomial x^8 + x^4 + x^3 + x^2 + 1."""
    table = bytearray(256)
    for index in range(256):
        remainder = index
        for _ in range(8):
            remainder = ((remainder << 1) ^ 0x11D) if remainder >= 0x80 else remainder << 1
        table[index] = remainder
    return bytes(table)


_CRC_TABLE = _make_crc_table()


class Reception:
    """One received message: its flags as the reports carry them, and the state of its counter check.

    `bad_crc` and `bad_counter` speak of the last frame; `last_valid_ns` is None before the first valid one;
    `lost_count` are the frames that the accepted counters have skipped.
    """

    def __init__(self, message: Message, timeout_ns: int, decoded: bool) -> None:
        self.message = message
        self.name = message.name
        self.length = message.length
        self.timeout_ns = timeout_ns
        self.decoded = decoded
        self._unpack = _packing(message).unpack
        self._scaled = [(s.name, s.scale, s.offset) for s in message.signals if (s.scale, s.offset) != (1, 0)]
        self.bad_crc = False
        self.bad_counter = False
        self.last_valid_ns: int | None = None
        self.rejected_count = 0
        self.lost_count = 0
        self._accepted: int | None = None
        self._stray: list[int] = []  # counters in a row that follow each other but not the accepted one
        self._heard_ns = 0

    def is_timed_out(self, now_ns: int) -> bool:
        """Return whether no valid frame has come for the message's timeout."""
        return self.last_valid_ns is None or now_ns - self.last_valid_ns > self.timeout_ns

    def values(self, data: bytes) -> Values:
        """Return the physical values of all signals of a payload of the right length."""
        values: Values = self._unpack(data[::-1])
        for name, scale, offset in self._scaled:
            values[name] = values[name] * scale + offset
        return values

    def accepts(self, now_ns: int, counter: int) -> bool:
        """Judge the counter of a frame whose CRC is right (CONVENTIONS.md, section "Counters")."""
        if counter >= _COUNTERS:
            return False
        silent = now_ns - self._heard_ns > self.timeout_ns
        self._heard_ns = now_ns
        if self._accepted is not None and not silent and not _follows(counter, self._accepted):
            self._stray = [*self._stray, counter] if self._stray and _follows(counter, self._stray[-1]) else [counter]
            if len(self._stray) < _RUN_TO_RESYNC:
                return False
        elif self._accepted is not None and not silent:
            self.lost_count += (counter - self._accepted - 1) % _COUNTERS
        self._accepted = counter
        self._stray = []
        return True


def _follows(counter: int, previous: int) -> bool:
    return 1 <= (counter - previous) % _COUNTERS <= _FARTHEST_STEP


class CanSide:
    """The wire of one or more nodes of the DBC: `encode` their messages, `decode` those of all others.

    Args:
        dbc_path: the DBC file.
        nodes: whose messages are sent here; what comes from elsewhere under their ids is foreign.
        check_only: messages that are checked but not decoded.

    """

    def __init__(
        self, dbc_path: Path, nodes: Collection[str] = PLANT_NODES, check_only: Collection[str] = LOG_ONLY
    ) -> None:
        content, database = _read(dbc_path)
        self.dbc_hash24 = int.from_bytes(hashlib.sha256(content).digest()[:3], "big")
        self._timeouts_ns = {message.name: _timeout_ns(dbc_path, message) for message in database.messages}
        self._sent = {m.name: _Transmission(m) for m in database.messages if set(m.senders) & set(nodes)}
        self.received = {
            m.name: Reception(m, self._timeouts_ns[m.name], m.name not in check_only)
            for m in database.messages
            if m.name not in self._sent
        }
        self._received_by_id = {reception.message.frame_id: reception for reception in self.received.values()}
        self.foreign_count = 0

    @property
    def rejected_count(self) -> int:
        """Frames of other nodes that were rejected, for whatever reason."""
        return sum(reception.rejected_count for reception in self.received.values())

    @property
    def lost_count(self) -> int:
        """Frames of other nodes that are missing between accepted ones."""
        return sum(reception.lost_count for reception in self.received.values())

    def timeout_ns(self, name: str) -> int:
        """Return the message's timeout as the DBC gives it."""
        return self._timeouts_ns[name]

    def encode(self, name: str, values: Mapping[str, float]) -> tuple[int, bytes]:
        """Return (arbitration id, payload) of the next frame of the message; values out of range are cut at the ends.

        `values` has every signal of the message but its CRC and counter; a NaN becomes the signal's start value.
        """
        return self._sent[name].next_frame(values)

    def decode(self, now_ns: int, arbitration_id: int, data: bytes) -> tuple[str, Values] | None:
        """Return (message name, values) of a valid frame, None for a rejected or foreign one.

        The values of messages that are only checked are empty.
        """
        reception = self._received_by_id.get(arbitration_id)
        if reception is None:
            self.foreign_count += 1
            return None
        reception.bad_crc = len(data) != reception.length or data[0] != _crc(arbitration_id, data)
        reception.bad_counter = not reception.bad_crc and not reception.accepts(now_ns, data[1] & 0x0F)
        if reception.bad_crc or reception.bad_counter:
            reception.rejected_count += 1
            return None
        reception.last_valid_ns = now_ns
        return reception.name, reception.values(data) if reception.decoded else {}


class _Transmission:
    """One sent message with its rolling counter."""

    def __init__(self, message: Message) -> None:
        self._frame_id = message.frame_id
        self._pack = _packing(message).pack
        self._crc_name, self._counter_name = f"{message.name}_crc", f"{message.name}_counter"
        self._counter = 0
        payload = [s for s in message.signals if s.name not in (self._crc_name, self._counter_name)]
        # A number is compared with its own kind: a float with an integer takes three times as long.
        self._plain = [
            (s.name, round(s.minimum or 0), round(s.maximum or 0), _start_value(s)) for s in payload if _is_plain(s)
        ]
        self._scaled = [
            (s.name, float(s.minimum or 0), float(s.maximum or 0), _start_value(s), s.scale, s.offset)
            for s in payload
            if not _is_plain(s)
        ]

    def next_frame(self, values: Mapping[str, float]) -> tuple[int, bytes]:
        raw = {self._crc_name: 0, self._counter_name: self._counter}
        for name, least, most, start in self._plain:
            value = values[name]
            if not least <= value <= most:
                value = most if value > most else least if value < least else start
            raw[name] = round(value)
        for name, low, high, start, scale, offset in self._scaled:
            value = values[name]
            if not low <= value <= high:
                value = high if value > high else low if value < low else start
            raw[name] = round((value - offset) / scale)
        self._counter = (self._counter + 1) % _COUNTERS
        data = bytearray(self._pack(raw))
        data.reverse()
        data[0] = _crc(self._frame_id, data)
        return self._frame_id, bytes(data)


class _Packing(Protocol):
    """Raw values by signal name, and the bytes of a payload from the last to the first."""

    def pack(self, raw_values: Mapping[str, int]) -> bytes: ...
    def unpack(self, data: bytes) -> Values: ...


def _packing(message: Message) -> _Packing:
    for signal in message.signals:
        if signal.byte_order != "little_endian" or signal.is_float or signal.is_multiplexer or signal.multiplexer_ids:
            raise UserError(f"DBC: signal {signal.name} must be a plain integer in Intel byte order (@1)")
    return cast(_Packing, create_encode_decode_formats(message.signals, message.length).little_endian)


def _is_plain(signal: Signal) -> bool:
    """Whether the signal's value is what goes over the bus, a whole number between whole limits."""
    limits = (signal.minimum or 0, signal.maximum or 0)
    return (signal.scale, signal.offset) == (1, 0) and all(limit == round(limit) for limit in limits)


def _start_value(signal: Signal) -> float:
    return float(signal.raw_initial or 0) * signal.scale + signal.offset


def _crc(data_id: int, data: bytes | bytearray) -> int:
    """End-to-end CRC over the data id, low byte first, and all bytes but the first."""
    t = _CRC_TABLE
    crc = t[t[data_id % 256] ^ data_id // 256]
    if len(data) == 8:  # every message of the project
        _, b1, b2, b3, b4, b5, b6, b7 = data
        return t[t[t[t[t[t[t[crc ^ b1] ^ b2] ^ b3] ^ b4] ^ b5] ^ b6] ^ b7]
    for byte in data[1:]:
        crc = t[crc ^ byte]
    return crc


def _read(dbc_path: Path) -> tuple[bytes, Database]:
    try:
        content = Path(dbc_path).read_bytes().replace(b"\r\n", b"\n")
    except OSError as error:
        raise UserError(f"DBC file {dbc_path}: cannot be read ({error.strerror}); give the path of a DBC") from None
    try:
        database = _parse(content)
    except Exception as error:  # cantools and its parser raise many kinds
        raise UserError(f"DBC file {dbc_path}: not a valid DBC ({' '.join(str(error).split())[:160]})") from None
    return content, database


@functools.lru_cache(maxsize=8)
def _parse(content: bytes) -> Database:
    """Parsing takes longer than a second of simulated driving; nobody changes what it returns."""
    return cast(Database, cantools.database.load_string(content.decode("utf-8"), database_format="dbc", strict=True))


def signal_ranges(dbc_path: Path) -> dict[str, tuple[float, float, float]]:
    """Return (value of one bit, minimum, maximum) of every signal, in its unit."""
    _, database = _read(dbc_path)
    signals = [signal for message in database.messages for signal in message.signals]
    return {s.name: (float(s.scale), float(s.minimum or 0), float(s.maximum or 0)) for s in signals}


def message_timeouts_ns(dbc_path: Path, names: Collection[str]) -> list[int]:
    """Return the timeouts of messages as the DBC gives them."""
    _, database = _read(dbc_path)
    return [_timeout_ns(dbc_path, database.get_message_by_name(name)) for name in names]


def _timeout_ns(dbc_path: Path, message: Message) -> int:
    attribute = message.dbc.attributes.get("GenMsgTimeout") if message.dbc else None
    if attribute is None:
        raise UserError(f'DBC file {dbc_path}: message {message.name} lacks the attribute "GenMsgTimeout"')
    return int(attribute.value) * NS_PER_MS
