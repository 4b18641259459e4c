"""Scripted faults: what a scenario file may list under [[faults]], and which of them act at an instant."""

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
                raise ValueError(f"a {self.kind} fault needs the key {key}")
            if is_given and not is_wanted:
                raise ValueError(f"a {self.kind} fault has no key {key}")
        if self.message is not None:
            known = REPORT_MESSAGES + COMMAND_MESSAGES if self.kind == "stop_message" else REPORT_MESSAGES
            if self.message not in known:
                raise ValueError(f"message {self.message!r} is not known; a {self.kind} fault takes {', '.join(known)}")
        return self
