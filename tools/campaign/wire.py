"""What the wire does to a number: scales and limits of the DBC, without the bytes.

Both directions round as their encoders do (the plant's to even on a tie, the controller's upward), hold the value
within the signal's range, and give back the decoded number bit for bit. Pure, so that it compiles.
"""

from collections.abc import Mapping
from math import floor
from pathlib import Path
from typing import NamedTuple


class Scale(NamedTuple):
    """One signal: the value of one bit, and its range (unit of the signal)."""

    lsb: float
    low: float
    high: float


class Scales(NamedTuple):
    """The signals of a manoeuvre that are not whole numbers; names as in the DBC."""

    road_wheel_angle_meas_rad: Scale
    road_wheel_angle_echo_rad: Scale
    speed_meas_mps: Scale
    yaw_rate_meas_radps: Scale
    speed_echo_mps: Scale
    brake_decel_echo_mps2: Scale
    position_x_m: Scale
    position_y_m: Scale
    yaw_rad: Scale
    pose_latency_ms: Scale
    position_sigma_m: Scale
    road_wheel_angle_cmd_rad: Scale
    speed_cmd_mps: Scale
    brake_decel_cmd_mps2: Scale


def load_scales(dbc: Path) -> Scales:
    """Read the scales from a DBC that the controller takes."""
    from firmware_py.codec import load_codec  # noqa: PLC0415
    from sim.can_side import signal_ranges  # noqa: PLC0415

    load_codec(dbc)  # says in one line what is wrong with it
    ranges: Mapping[str, tuple[float, float, float]] = signal_ranges(dbc)
    return Scales(*[Scale(*ranges[name]) for name in Scales._fields])


def report(value: float, scale: Scale) -> float:
    """Return what the controller reads of a value that the plant sends; a number, never a NaN."""
    return round(max(min(value, scale.high), scale.low) / scale.lsb) * scale.lsb


def command(value: float, scale: Scale) -> float:
    """Return what the plant reads of a value that the controller sends; a number, never a NaN."""
    return floor(max(min(value, scale.high), scale.low) / scale.lsb + 0.5) * scale.lsb
