"""What the core's tests share: the shipped tables, and inputs of a car that stands at the start and is fine."""

from functools import cache
from pathlib import Path

from firmware_py.codec import Codec, load_codec
from firmware_py.core import signals as s
from firmware_py.core.controller import PERIOD_S
from firmware_py.core.tables import Tables
from firmware_py.node import build_tables
from firmware_py.table_file import load_tables

ROOT = Path(__file__).resolve().parent.parent
DBC = ROOT / "dbc" / "parking.dbc"
TABLES = ROOT / "firmware_py" / "tables" / "paper-ohio"


@cache
def shipped_codec() -> Codec:
    return load_codec(DBC)


@cache
def shipped_tables(side: str = "left", law: str = "car") -> Tables:
    return build_tables(load_tables(TABLES, side, law, PERIOD_S), shipped_codec())


def standing_inputs(tables: Tables, cycle: int, vehicle_state: int = s.MODE_READY) -> s.Inputs:
    """Inputs of cycle number `cycle` for a car at rest on the start pose, every report fresh and valid."""
    counter = cycle % 15
    start = tables.leg[0]
    return s.Inputs(
        now_us=cycle * 10_000,
        used=s.UsedCounters(counter, counter, counter, counter, counter, counter, counter, counter, 0),
        sys=s.SysReport(vehicle_state, 0, 0, 0, 0, 0, 0),
        steer=s.SteerReport(0.0, 0.0, 1, 0, 0, 0, 0, 0, 0, 0, 0.0),
        motion=s.MotionReport(0.0, 0.0, 1, 1),
        long=s.LongReport(s.GEAR_PARK, 1, 1, 0.0, 0.0, 0, 0, 0, 0, 0),
        position=s.Position(start.x_m[0], start.y_m[0], s.QUALITY_FIXED),
        attitude=s.Attitude(start.yaw_rad[0], s.QUALITY_FIXED, 10.0, 0.0),
        oper=s.OperatorCommand(0, 0, 0, 0),
        version=s.VehicleVersion(1, tables.dbc_hash24, tables.vehicle_hash24),
        second_controller=0,
    )
