"""What the controller believed, out of a run's bus log: its cross-track error and how sure of it it was."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import cantools.database
import numpy as np

from sim.errors import UserError
from tools.figures import FORWARD, REVERSE, Floats

FRAME_BYTES = 8
LEGS = {"Forward": FORWARD, "Reverse": REVERSE}


class Estimates(NamedTuple):
    """Estimates of one leg over the path's station, arrays of shape (n,), ten a second, in m."""

    station_m: Floats
    cross_track_error_m: Floats
    cross_track_sigma_m: Floats


def load_estimates(log: Path, dbc: Path, length_m: float) -> dict[str, Estimates]:
    """Read a bus log (`candump -L`); `length_m` is the path's. A leg of which it says nothing is left out.

    What is no frame of ours is passed over. Raises UserError for a file that cannot be read.
    """
    database: Any = cantools.database.load_file(dbc)
    names = ("CTRL_SysCmd", "CTRL_Track", "CTRL_Estimate")
    sys_cmd, track, estimate = (database.get_message_by_name(name) for name in names)
    leg: str = ""
    place: dict[str, float] = {}
    rows: dict[str, list[tuple[float, float, float]]] = {}
    try:
        lines = log.read_text(encoding="ascii").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{log}: cannot be read: {getattr(error, 'strerror', None) or 'not a bus log'}") from None
    for line in lines:
        try:
            arbitration_id, _, data = line.rpartition(" ")[2].partition("#")
            frame_id, payload = int(arbitration_id, 16), bytes.fromhex(data)
        except ValueError:
            continue  # a remote frame, or the last line of a log that was cut off
        if len(payload) != FRAME_BYTES:
            continue  # a frame that no node of ours sent
        if frame_id == sys_cmd.frame_id:
            leg = LEGS.get(str(sys_cmd.decode(payload)["control_leg"]), "")
        elif frame_id == track.frame_id:
            place = track.decode(payload)
        elif frame_id == estimate.frame_id and leg and place:
            station_m = place["station_m"] if leg == FORWARD else length_m - place["station_m"]
            sure = estimate.decode(payload)["cross_track_sigma_m"]
            rows.setdefault(leg, []).append((station_m, place["cross_track_error_est_m"], sure))
    return {leg: Estimates(*np.array(of_leg).T) for leg, of_leg in rows.items()}
