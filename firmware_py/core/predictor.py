"""From the observer's state, which is as old as the pose, to the instant at which the next command acts."""

from firmware_py.core.motion import PathState, advance
from firmware_py.core.tables import CarTable, LegTable

QUEUE_LENGTH = 48
"""Commands that are remembered; latency of pose and command together may be one less."""


def predict(
    leg: LegTable,
    car: CarTable,
    state: PathState,
    sent_angles_rad: tuple[float, ...],
    travel_speed_mps: float,
    period_s: float,
) -> PathState:
    """Return the state when a command that is sent now begins to act.

    `sent_angles_rad[0]` is the newest command on its way, QUEUE_LENGTH of them. The commands that are still to act are
    the last (pose + command latency) of them; the speed is taken as constant over that time.
    """
    ahead = state
    remaining = car.pose_latency_samples + car.command_latency_samples
    while remaining > 0:
        remaining -= 1
        ahead = advance(leg, car, ahead, sent_angles_rad[remaining], travel_speed_mps, period_s)
    return ahead
