"""Scripted faults: what a scenario file may list under [[faults]], and which of them act at an instant."""

from collections.abc import Sequence
from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

REPORT_MESSAGES = (
    "VEH_SysRpt",
    "VEH_SteerRpt",
    "VEH_MotionRpt",
    "VEH_LongRpt",
    "VEH_Version",
    "LOC_Position",
    "LOC_Attitude",
)
COMMAND_MESSAGES = ("CTRL_SysCmd", "CTRL_SteerCmd", "CTRL_LongCmd", "CTRL_Version", "OPER_Cmd")

_NEEDS_MESSAGE = ("stop_message", "freeze_counter", "corrupt_crc", "delay_message", "stick_signal", "offset_signal")
_NEEDS_SIGNAL = ("stick_signal", "offset_signal")

FaultKind = Literal[
    "stop_message",
    "freeze_counter",
    "corrupt_crc",
    "delay_message",
    "stick_signal",
    "offset_signal",
    "driver_override",
    "emergency_stop",
    "steering_frozen",
]


class FaultEvent(BaseModel):
    """One fault: what, from when and for how long (s, on the emulator's clock).

    `after` says where the time starts to count: when the emulator starts, when the vehicle first becomes Active, or
    when the car first moves. Without `duration_s` the fault stays.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    kind: FaultKind
    after: Literal["start", "active", "moving"] = "start"
    at_s: Annotated[float, Field(ge=0.0, le=3600.0, allow_inf_nan=False)]
    duration_s: Annotated[float, Field(gt=0.0, le=3600.0, allow_inf_nan=False)] | None = None
    message: str | None = None
    signal: str | None = None
    delay_s: Annotated[float, Field(gt=0.0, le=1.0, allow_inf_nan=False)] | None = None
    offset: Annotated[float, Field(allow_inf_nan=False)] | None = None
    control: Literal["steering", "brake"] | None = None

    @model_validator(mode="after")
    def _keys_fit_the_kind(self) -> Self:
        wanted = {
            "message": self.kind in _NEEDS_MESSAGE,
            "signal": self.kind in _NEEDS_SIGNAL,
            "delay_s": self.kind == "delay_message",
            "offset": self.kind == "offset_signal",
            "control": self.kind == "driver_override",
        }
        for key, is_wanted in wanted.items():
            is_given = getattr(self, key) is not None
            if is_wanted and not is_given:
                raise ValueError(f"{self.kind} needs the key {key}")
            if is_given and not is_wanted:
                raise ValueError(f"{self.kind} has no key {key}")
        if self.message is not None:
            known = REPORT_MESSAGES + COMMAND_MESSAGES if self.kind == "stop_message" else REPORT_MESSAGES
            if self.message not in known:
                raise ValueError(f"message {self.message!r} is not known; {self.kind} takes {', '.join(known)}")
        return self


NS = 1_000_000_000
NEVER = 1 << 62

Frame = tuple[int, bytes]


def crc8(data_id: int, payload: bytes) -> int:
    """CRC-8 SAE J1850 (0x1D, start 0, no final XOR) over data id low, data id high, then the payload, bit by bit."""
    crc = 0
    for byte in (data_id & 0xFF, data_id >> 8, *payload):
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1) ^ 0x11D if crc & 0x80 else crc << 1
    return crc


class _Scheduled:
    """A fault with its instants, which for "active" and "moving" become known on the way."""

    def __init__(self, event: FaultEvent) -> None:
        self.event = event
        self.begin_ns = NEVER
        self.end_ns = NEVER
        self.is_active = False
        self.held: float | None = None
        self.held_counter: int | None = None

    def count_from(self, origin_ns: int) -> None:
        self.begin_ns = origin_ns + round(self.event.at_s * NS)
        if self.event.duration_s is not None:
            self.end_ns = self.begin_ns + round(self.event.duration_s * NS)


class FaultInjector:
    """Runs a scenario's faults: call `begin` when a phase starts and `at` at every edge, then ask what is wrong."""

    def __init__(self, events: Sequence[FaultEvent], start_ns: int) -> None:
        self._faults = [_Scheduled(event) for event in events]
        self._begun: set[str] = set()
        self._active: list[_Scheduled] = []
        self._late: list[tuple[int, Frame]] = []
        self.next_edge_ns = NEVER
        self.is_quiet = True
        """Whether no frame needs to be looked at."""
        self.begin("start", start_ns)

    def begin(self, phase: str, now_ns: int) -> None:
        """Start the clock of the faults that count from this phase; only the first call for a phase matters."""
        if phase in self._begun:
            return
        self._begun.add(phase)
        for fault in self._faults:
            if fault.event.after == phase:
                fault.count_from(now_ns)
        self._find_next_edge()

    def _find_next_edge(self) -> None:
        edges = [fault.end_ns if fault.is_active else fault.begin_ns for fault in self._faults]
        self.next_edge_ns = min(edges, default=NEVER)

    def at(self, now_ns: int) -> list[tuple[FaultEvent, bool]]:
        """Switch what is due; returns (event, begins) of all that changed."""
        changed = []
        for fault in self._faults:
            is_active = fault.begin_ns <= now_ns < fault.end_ns
            if is_active != fault.is_active:
                fault.is_active = is_active
                fault.held = fault.held_counter = None
                changed.append((fault.event, is_active))
            if now_ns >= fault.end_ns:
                fault.begin_ns = fault.end_ns = NEVER
        self._active = [fault for fault in self._faults if fault.is_active]
        self.is_quiet = not self._active and not self._late
        self._find_next_edge()
        return changed

    def stops(self, message: str) -> bool:
        """Return whether frames of the message are lost now."""
        return any(fault.event.kind == "stop_message" and fault.event.message == message for fault in self._active)

    @property
    def steering_is_frozen(self) -> bool:
        """Return whether the rack stands still now."""
        return any(fault.event.kind == "steering_frozen" for fault in self._active)

    def alter(self, message: str, values: dict[str, float]) -> None:
        """Change the values of a report before it is encoded."""
        for fault in self._active:
            event = fault.event
            if event.message != message or event.signal is None:
                continue
            if event.kind == "stick_signal":
                if fault.held is None:
                    fault.held = values[event.signal]
                values[event.signal] = fault.held
            elif event.kind == "offset_signal" and event.offset is not None:
                values[event.signal] += event.offset

    def spoil(self, now_ns: int, message: str, frame: Frame) -> Frame | None:
        """Change an encoded report, or keep it back (None) to come out of `late` in its time."""
        arbitration_id, data = frame
        for fault in self._active:
            event = fault.event
            if event.message != message:
                continue
            if event.kind == "freeze_counter":
                if fault.held_counter is None:
                    fault.held_counter = data[1] & 0x0F
                rest = bytes([(data[1] & 0xF0) | fault.held_counter]) + data[2:]
                data = bytes([crc8(arbitration_id, rest)]) + rest
            elif event.kind == "corrupt_crc":
                data = bytes([data[0] ^ 0xFF]) + data[1:]
            elif event.kind == "delay_message" and event.delay_s is not None:
                self._late.append((now_ns + round(event.delay_s * NS), (arbitration_id, data)))
                return None
        return arbitration_id, data

    def late(self, now_ns: int) -> list[Frame]:
        """Frames that were kept back and are due, oldest first."""
        due = [frame for due_ns, frame in self._late if due_ns <= now_ns]
        self._late = [(due_ns, frame) for due_ns, frame in self._late if due_ns > now_ns]
        self.is_quiet = not self._active and not self._late
        return due
