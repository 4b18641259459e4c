"""What the paper prints: its tables and its start poses, in SI units. The only place where they stand."""

from typing import NamedTuple

from tools.paper.laws import BOTH, DOB, PID
from tools.paper.plant import FORWARD, REVERSE


class Printed(NamedTuple):
    """One column of Table 5 or 6."""

    max_e_y_m: float
    rms_e_y_m: float
    max_steer_rad: float
    max_steer_rate_radps: float


TABLES_5_6: dict[str, dict[str, Printed]] = {
    FORWARD: {
        DOB: Printed(0.0071, 0.0029, 0.4692, 0.6597),
        PID: Printed(0.0073, 0.0027, 0.4746, 2.4348),
        BOTH: Printed(1.3399e-4, 4.4357e-5, 0.4697, 2.4538),
    },
    REVERSE: {
        DOB: Printed(0.0078, 0.0032, 0.4876, 0.5561),
        PID: Printed(0.0078, 0.0027, 0.4951, 3.16),
        BOTH: Printed(1.4684e-4, 4.4335e-5, 0.4876, 3.1847),
    },
}
"""Tables 5 (forward) and 6 (reverse)."""

START_FORWARD = (0.0, 0.0, 0.0)
"""Eq. 20: x m, y m, heading rad, in a frame whose origin is the centre of gravity at the start."""
START_REVERSE = (15.2386, 1.3716, 3.141592653589793)
"""Eq. 21."""

TABLE_1 = {"m": 4, "p": 6, "q": 3}
