"""The sequence of the manoeuvre: forward leg, one direction change at standstill, reverse leg, park.

Each leg begins at standstill: the gear is engaged, the wheels are steered to where the leg begins, and where the poses
are noisy for seconds their noise is waited for; then the car goes. Nothing here moves the car while it waits.
"""

from typing import NamedTuple

from firmware_py.core.signals import (
    GEAR_DRIVE,
    GEAR_NONE,
    GEAR_PARK,
    GEAR_REVERSE,
    LEG_COMPLETE,
    LEG_DIRECTION_CHANGE,
    LEG_FORWARD,
    LEG_IDLE,
    LEG_REVERSE,
)
from firmware_py.core.tables import FORWARD, REVERSE, CarTable

STEERED_RAD = 0.01
STEER_WAIT_US = 500_000
"""Before a leg the wheels turn at standstill until they are this near to the command, but at most for so long: what
remains then is a disturbance that the observer learns."""

SETTLE_US = 10_000_000
"""How long the car stands before a leg where the poses' noise stays for seconds: twice as long as it stays
(`kalman.SLOW_S`), in which the standing poses tell more of it."""

GEAR_PATIENCE_US = 2_000_000
"""How much longer than the vehicle file says a gear change may take before it counts as failed."""


class ManoeuvreState(NamedTuple):
    """The leg, whether the car may move on it, and how long it has waited to."""

    leg: int
    driving: int
    waiting_us: int
    steering_us: int
    gear_failed: int


def begin() -> ManoeuvreState:
    """Return the state before the manoeuvre."""
    return ManoeuvreState(leg=LEG_IDLE, driving=0, waiting_us=0, steering_us=0, gear_failed=0)


def direction_of(leg: int) -> int:
    """Return the direction index of a leg; it changes with the beginning of the direction change."""
    if leg in (LEG_DIRECTION_CHANGE, LEG_REVERSE, LEG_COMPLETE):
        return REVERSE
    return FORWARD


def gear_of(leg: int) -> int:
    """Return the gear that a leg asks for."""
    if leg == LEG_FORWARD:
        return GEAR_DRIVE
    if leg in (LEG_DIRECTION_CHANGE, LEG_REVERSE):
        return GEAR_REVERSE
    if leg == LEG_COMPLETE:
        return GEAR_PARK
    return GEAR_NONE


def proceed(
    state: ManoeuvreState,
    car: CarTable,
    gear_rpt: int,
    park_brake_applied: int,
    standstill: bool,
    stopping: int,
    steering_gap_rad: float,
    pose_noise_is_slow: bool,
    period_us: int,
) -> ManoeuvreState:
    """Return the next state while the manoeuvre is Active."""
    if state.leg == LEG_IDLE:
        return ManoeuvreState(leg=LEG_FORWARD, driving=0, waiting_us=0, steering_us=0, gear_failed=0)
    if state.driving != 0:
        if stopping != 0 and standstill:
            next_leg = LEG_DIRECTION_CHANGE if state.leg == LEG_FORWARD else LEG_COMPLETE
            return ManoeuvreState(leg=next_leg, driving=0, waiting_us=0, steering_us=0, gear_failed=0)
        return state

    waiting_us = state.waiting_us + period_us
    geared = gear_rpt == gear_of(state.leg) and (park_brake_applied == 0 or state.leg == LEG_COMPLETE)
    gear_failed = 0
    if not geared and waiting_us > car.gear_change_s * 1e6 + GEAR_PATIENCE_US:
        gear_failed = 1
    steering_us = state.steering_us + period_us
    steered = abs(steering_gap_rad) < STEERED_RAD or steering_us > STEER_WAIT_US
    settled = not pose_noise_is_slow or waiting_us > SETTLE_US
    leg = state.leg
    driving = 0
    if geared and steered and settled and standstill and leg != LEG_COMPLETE:
        driving = 1
        if leg == LEG_DIRECTION_CHANGE:
            leg = LEG_REVERSE
    return ManoeuvreState(
        leg=leg, driving=driving, waiting_us=waiting_us, steering_us=steering_us, gear_failed=gear_failed
    )


def keep(state: ManoeuvreState) -> ManoeuvreState:
    """Return the next state in Fault: the leg stays, and nothing drives on it."""
    return ManoeuvreState(state.leg, 0, 0, 0, 0)


def is_done(state: ManoeuvreState, gear_rpt: int, park_brake_applied: int) -> bool:
    """Return whether the car is parked after the reverse leg."""
    return state.leg == LEG_COMPLETE and gear_rpt == GEAR_PARK and park_brake_applied != 0
