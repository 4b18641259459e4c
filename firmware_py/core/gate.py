"""The last gate. Critical for safety: nothing is sent that has not passed here.

It bounds every command by the car's limits, independently of the law, and decides by mode whether the vehicle is to
follow at all. A value that is no number never passes and never stays.
"""

import math

from firmware_py.core.bounds import bounded
from firmware_py.core.signals import MODE_ACTIVE, MODE_FAULT
from firmware_py.core.speed import HOLD_DECEL_MPS2
from firmware_py.core.supervisor import STOP_EMERGENCY
from firmware_py.core.tables import CarTable


def is_number(value: float) -> bool:
    """Return whether a value is finite."""
    return value - value == 0.0


def gate(
    car: CarTable,
    lsb_rad: float,
    mode: int,
    reaction: int,
    released: int,
    sigma: float,
    angle_rad: float,
    speed_mps: float,
    brake_mps2: float,
    previous_rad: float,
    carry_rad: float,
    period_s: float,
) -> tuple[float, float, float, float, int]:
    """Return what may leave the controller: angle, its carry, signed speed, brake, and whether to follow it (1 or 0).

    Wanted are a road-wheel angle (left positive), a travel speed (never negative) and a brake. The carry is the angle's
    rounding remainder, which the next command makes good.

    Active: the wanted commands, bounded. Fault: steering goes on to follow the path while the brake stops the car,
    until it has stood or the driver has taken over (`released`). Otherwise nothing is to be followed: brake held, no
    speed.
    """
    if not is_number(angle_rad):
        angle_rad = previous_rad
    if not is_number(speed_mps) or not is_number(brake_mps2):
        speed_mps = 0.0
        brake_mps2 = car.controlled_decel_mps2

    follow = 0
    if mode == MODE_ACTIVE:
        follow = 1
    elif mode == MODE_FAULT:
        speed_mps = 0.0
        brake_mps2 = car.controlled_decel_mps2
        if reaction == STOP_EMERGENCY:
            brake_mps2 = car.emergency_decel_mps2
        if released != 0:
            angle_rad = previous_rad
        else:
            follow = 1
    else:
        speed_mps = 0.0
        brake_mps2 = HOLD_DECEL_MPS2

    speed_mps = bounded(speed_mps, 0.0, car.max_speed_mps)
    brake_mps2 = bounded(brake_mps2, 0.0, car.emergency_decel_mps2)
    if brake_mps2 > 0.0:
        speed_mps = 0.0

    # The car's rate less one step of the bus's resolution, so that rounding stays inside it too.
    step_rad = car.max_road_wheel_rate_radps * period_s - lsb_rad
    if step_rad < 0.0:
        step_rad = 0.0
    angle_rad = angle_rad + carry_rad
    angle_rad = bounded(angle_rad, previous_rad - step_rad, previous_rad + step_rad)
    most_rad = car.max_road_wheel_angle_rad - lsb_rad
    angle_rad = bounded(angle_rad, -most_rad, most_rad)
    sent_rad = math.floor(angle_rad / lsb_rad + 0.5) * lsb_rad
    remainder_rad = bounded(angle_rad - sent_rad, -lsb_rad, lsb_rad)
    return sent_rad, remainder_rad, sigma * speed_mps, brake_mps2, follow
