"""The paper's linear path-tracking model, eq. 11, forward and in reverse, as printed and with the sign put right.

State (beta, r, heading error, e_y), all in the direction of travel: side slip rad, yaw rate rad/s, rad, m. Inputs:
road-wheel angle rad of the steered axle, path curvature 1/m. e_y lies at the preview point, l_s = K V ahead of the
centre of gravity. In reverse the car is one that drives forward with its rear wheels steered and its axles
interchanged; the paper prints the yaw moment of rear wheels steered left as +Cr lr, which turns a car to the left
although the force acts behind its centre of gravity. `PRINTED` keeps that, `CORRECTED` has -Cr lr.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from sim.data_files import Vehicle
from sim.errors import UserError
from tools.design.waypoints import Floats

PREVIEW_TIME_S = 0.5
"""K of Table 3: l_s = K V."""

FORWARD, REVERSE = "forward", "reverse"
PRINTED, CORRECTED = "printed", "corrected"


class PaperCar(NamedTuple):
    """What eq. 11 needs of a car (Table 4): axle stiffnesses N/rad, distances to the axles m, mass kg, kg m^2."""

    name: str
    front_stiffness: float
    front_m: float
    rear_stiffness: float
    rear_m: float
    mass_kg: float
    inertia_kgm2: float

    @property
    def wheelbase_m(self) -> float:
        """Distance of the axles."""
        return self.front_m + self.rear_m

    @property
    def is_papers(self) -> bool:
        """Whether these are the numbers of Table 4, so that the printed results may stand beside ours."""
        return self[1:] == TABLE_4[1:]


TABLE_4 = PaperCar("paper", 3e5, 2.0, 3e5, 2.0, 3000.0, 5113.0)


def car_of(vehicle: Vehicle) -> PaperCar:
    """Take from a vehicle file what eq. 11 needs of it."""
    return PaperCar(
        vehicle.name,
        vehicle.cornering_stiffness_front_n_per_rad,
        vehicle.wheelbase_m - vehicle.cg_to_rear_axle_m,
        vehicle.cornering_stiffness_rear_n_per_rad,
        vehicle.cg_to_rear_axle_m,
        vehicle.mass_kg,
        vehicle.yaw_inertia_kgm2,
    )


class Plant(NamedTuple):
    """Eq. 11 of one car in one direction; see `matrices` for what it means at a speed."""

    car: PaperCar
    direction: str = FORWARD
    sign: str = PRINTED
    preview_time_s: float = PREVIEW_TIME_S

    @property
    def name(self) -> str:
        """Direction, and in reverse which sign."""
        return self.direction if self.direction == FORWARD else f"{self.direction}, {self.sign} sign"


class Matrices(NamedTuple):
    """Eq. 11 at one speed: x' = a x + b delta + e rho, e_y = c x; shapes (4, 4), (4,), (4,), (4,)."""

    a: Floats
    b: Floats
    e: Floats
    c: Floats


def matrices(plant: Plant, speed_mps: float) -> Matrices:
    """Eq. 11 at a speed above zero. Raises UserError at standstill, where the model does not exist."""
    if not (math.isfinite(speed_mps) and speed_mps > 0.0):
        raise UserError(f"eq. 11 at {speed_mps:g} m/s: it divides by the speed, which must be above zero")
    car, v = plant.car, speed_mps
    mass, inertia = car.mass_kg, car.inertia_kgm2
    if plant.direction == FORWARD:
        cf, lf, cr, lr = car.front_stiffness, car.front_m, car.rear_stiffness, car.rear_m
        steer = (cf / (mass * v), cf * lf / inertia)
    else:
        cf, lf, cr, lr = car.rear_stiffness, car.rear_m, car.front_stiffness, car.front_m
        moment = 1.0 if plant.sign == PRINTED else -1.0
        steer = (cr / (mass * v), moment * cr * lr / inertia)
    ls = plant.preview_time_s * v
    a = np.zeros((4, 4))
    a[0, 0] = -(cf + cr) / (mass * v)
    a[0, 1] = -1.0 + (cr * lr - cf * lf) / (mass * v * v)
    a[1, 0] = (cr * lr - cf * lf) / inertia
    a[1, 1] = -(cf * lf * lf + cr * lr * lr) / (inertia * v)
    a[2, 1] = 1.0
    a[3, :3] = v, ls, v
    return Matrices(a, np.array([*steer, 0.0, 0.0]), np.array([0.0, 0.0, -v, -ls * v]), np.array([0.0, 0.0, 0.0, 1.0]))


class ZeroPole(NamedTuple):
    """G(s) from road-wheel angle to e_y as gain, zeros and poles; gain is the high-frequency one, G -> gain / s^2."""

    zeros: tuple[complex, ...]
    poles: tuple[complex, ...]
    gain: float


def numerator(plant: Plant, speed_mps: float) -> Floats:
    """Numerator of G(s), (3,), in falling powers; the denominator is s^2 times the lateral model's."""
    a, b, _, _ = matrices(plant, speed_mps)
    v, ls = speed_mps, plant.preview_time_s * speed_mps
    # Cramer's rule on (s - A) (beta, r) = b delta, exact where a general root finder would lose the slow zero.
    beta = np.array([b[0], a[0, 1] * b[1] - a[1, 1] * b[0]])
    yaw = np.array([b[1], a[1, 0] * b[0] - a[0, 0] * b[1]])
    # s^2 e = s (V beta + l_s r) + V r
    return np.array([v * beta[0] + ls * yaw[0], v * beta[1] + ls * yaw[1] + v * yaw[0], v * yaw[1]])


def lateral_denominator(plant: Plant, speed_mps: float) -> Floats:
    """Characteristic polynomial (3,) of side slip and yaw rate, falling powers."""
    a = matrices(plant, speed_mps).a
    return np.array([1.0, -(a[0, 0] + a[1, 1]), a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]])


def zeros_and_poles(plant: Plant, speed_mps: float) -> ZeroPole:
    """Zeros and poles of G at a speed, rad/s; slow ones first."""
    num = numerator(plant, speed_mps)
    zeros = sorted(np.roots(num), key=abs)
    poles = [0.0, 0.0, *sorted(np.roots(lateral_denominator(plant, speed_mps)), key=abs)]
    return ZeroPole(tuple(complex(z) for z in zeros), tuple(complex(p) for p in poles), float(num[0]))


def transfer_function(plant: Plant, speed_mps: float) -> Any:
    """G(s) from road-wheel angle to e_y as a python-control TransferFunction."""
    import control  # noqa: PLC0415

    den = np.concatenate([lateral_denominator(plant, speed_mps), [0.0, 0.0]])
    return control.TransferFunction(numerator(plant, speed_mps), den)


def steady_angle_per_curvature(plant: Plant, speed_mps: float) -> float:
    """Road-wheel angle (rad) over curvature (1/m) in a steady turn, for PID + FF; +-wheelbase if neutral."""
    a, b, _, _ = matrices(plant, speed_mps)
    # 0 = A (beta, r) + b delta with r = V rho: unknowns beta and delta for rho = 1/m.
    left = np.array([[a[0, 0], b[0]], [a[1, 0], b[1]]])
    right = -a[:2, 1] * speed_mps
    if abs(np.linalg.det(left)) < 1e-12 * np.abs(left).max() ** 2:
        raise UserError(
            f"vehicle {plant.car.name}: its steering does not turn it at {speed_mps:g} m/s; check its stiffnesses"
        )
    return float(np.linalg.solve(left, right)[1])
