"""The cars that a design must survive: the nominal one and the corners of a vehicle's box."""

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sim.data_files import Vehicle
from tools.design import model
from tools.design.model import Complexes

GAIN_SPREAD = 0.1
"""Steering gain of the cars in the box."""


def corners(vehicle: Vehicle, softest_tyres: bool = False) -> list[model.Corner]:
    """The cars to survive: the nominal one, then the corners of the box.

    In steering lag, latencies, steering gain, wheelbase, mass (with the yaw inertia) and cornering stiffness (both
    axles together). With `softest_tyres` only those with the greatest mass on the softest tyres, which answer last.
    """
    nominal = model.Corner(
        "nominal car",
        vehicle.steering_lag_s,
        round(vehicle.pose_latency_samples),
        vehicle.command_latency_samples,
        1.0,
        vehicle.wheelbase_m,
        vehicle.cg_to_rear_axle_m,
        vehicle.mass_kg,
        vehicle.yaw_inertia_kgm2,
        vehicle.cornering_stiffness_front_n_per_rad,
        vehicle.cornering_stiffness_rear_n_per_rad,
    )
    cars = [nominal]
    box = vehicle.box

    def shares(key: str, softest: int) -> tuple[float, ...]:
        both = tuple(end / getattr(vehicle, key) for end in _ends(box[key]))
        return both[softest : softest + 1] or both if softest_tyres else both

    for lag, pose, command, gain, wheelbase, mass, stiffness in itertools.product(
        _ends(box["steering_lag_s"]),
        _ends(box["pose_latency_samples"]),
        _ends(box["command_latency_samples"]),
        (1.0 - GAIN_SPREAD, 1.0 + GAIN_SPREAD),
        _ends(box["wheelbase_m"]),
        shares("mass_kg", 1),
        shares("cornering_stiffness_front_n_per_rad", 0),
    ):
        name = (
            f"lag {lag:g} s, latency {pose:g} + {command:g} samples, steering gain {gain:g}, wheelbase {wheelbase:g} m,"
            f" mass {mass:.2g} and stiffness {stiffness:.2g} of nominal"
        )
        cars.append(
            nominal._replace(
                name=name,
                steering_lag_s=lag,
                pose_latency_samples=math.ceil(pose - 1e-9),
                command_latency_samples=command,
                steering_gain=gain,
                wheelbase_m=wheelbase,
                cg_to_rear_axle_m=nominal.cg_to_rear_axle_m * wheelbase / vehicle.wheelbase_m,
                mass_kg=nominal.mass_kg * mass,
                yaw_inertia_kgm2=nominal.yaw_inertia_kgm2 * mass,
                stiffness_front_n_per_rad=nominal.stiffness_front_n_per_rad * stiffness,
                stiffness_rear_n_per_rad=nominal.stiffness_rear_n_per_rad * stiffness,
            )
        )
    return cars


def _ends(interval: tuple[float, float]) -> tuple[float, ...]:
    return interval[:1] if interval[0] == interval[1] else interval


class CarsAtSpeed(NamedTuple):
    """The cars of a vehicle's box at one speed: their answers at the points z, and their matrices."""

    cars: Sequence[model.Corner]
    z: Complexes
    answers: Complexes
    plants: Sequence[model.StateSpace]


def cars_at_speed(cars: Sequence[model.Corner], speed_mps: float, direction: float, z: Complexes) -> CarsAtSpeed:
    """Return the cars at a speed and direction; what all laws and modes have in common."""
    return CarsAtSpeed(
        cars,
        z,
        np.stack([model.car_response(car, speed_mps, direction, z) for car in cars]),
        [model.car(car, speed_mps, direction) for car in cars],
    )
