"""The cycle run before it counts: a controller of its own is driven with reports of a car that stands at its start.

It brings code and tables into the caches, and it is a test of what is installed: tables, DBC and core must together get
as far as Active. Nothing of it reaches the bus, and no state of it is kept.
"""

from firmware_py.codec import Codec, Sender
from firmware_py.core.controller import PERIOD_US
from firmware_py.core.health import PROTOCOL
from firmware_py.core.signals import (
    GEAR_PARK,
    MODE_ACTIVE,
    MODE_READY,
    QUALITY_FIXED,
    Attitude,
    LongReport,
    MotionReport,
    OperatorCommand,
    Position,
    SteerReport,
    SysReport,
    VehicleVersion,
)
from firmware_py.core.tables import Tables
from firmware_py.errors import UserError
from firmware_py.node import ControllerNode
from firmware_py.reasons import TEXT

CYCLES = 200
START_CYCLE = 120
"""Long enough before it for the pose to settle, long enough after it for the control law to run."""


def warm_up(codec: Codec, tables: Tables) -> None:
    """Run CYCLES cycles in virtual time. Raises UserError where they do not get as far as Active."""
    node = ControllerNode(codec, tables)
    sender = Sender(codec)
    leg = tables.leg[0]
    was_active = False
    for cycle in range(CYCLES):
        state = MODE_ACTIVE if cycle > START_CYCLE else MODE_READY
        reports = (
            ("VEH_SysRpt", SysReport(state, 0, 0, 0, 0, 0, 0)),
            ("OPER_Cmd", OperatorCommand(int(cycle >= START_CYCLE), 0, 0, 0)),
            ("VEH_SteerRpt", SteerReport(0.0, 0.0, 1, 0, 0, 0, 0, 0, 0, 0, 0.0)),
            ("VEH_MotionRpt", MotionReport(0.0, 0.0, 1, 1)),
            ("VEH_LongRpt", LongReport(GEAR_PARK, 1, 1, 0.0, 0.0, 0, 0, 0, 0, 0)),
            ("VEH_Version", VehicleVersion(PROTOCOL, tables.dbc_hash24, tables.vehicle_hash24)),
            ("LOC_Position", Position(leg.x_m[0], leg.y_m[0], QUALITY_FIXED)),
            ("LOC_Attitude", Attitude(leg.yaw_rad[0], QUALITY_FIXED, 0.0, 0.0)),
        )
        frames = [sender.pack(name, values) for name, values in reports]
        node.cycle((cycle + 1) * PERIOD_US * 1000, frames, 0)
        was_active |= node.seen().mode == MODE_ACTIVE
    if not was_active or node.internal_errors:
        why = node.internal_errors[0] if node.internal_errors else TEXT[node.seen().reason]
        raise UserError(f"self-test: the controller does not work with these tables and this DBC ({why})")
