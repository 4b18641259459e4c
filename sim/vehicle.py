"""The car's body on its tyres: nonlinear single-track model in the body frame; beside it, eq. 11 of the paper.

Axes and signs as ISO 8855: x ahead, y left, yaw and road-wheel angle positive to the left. Reverse is a negative
longitudinal velocity, not another model. The longitudinal velocity is given by drive and brake (`sim.actuators`);
this module integrates lateral velocity, yaw rate, tyre slips and the pose.

The slip of each axle relaxes over the distance travelled, `relaxation * dslip/dt = v_lateral - |v_rolling| * slip`:
regular at any speed, zero included. The step is implicit in lateral velocity, yaw rate and slips (one 2 x 2 system),
so it is stable at 1 ms however slowly the car creeps. At standstill nothing moves at all.

Written on floats and NamedTuples with `math` only, so that the same source can be compiled.
"""

from math import cos, sin, sqrt
from typing import NamedTuple

from sim.tyre import CARCASS_DAMPING_RATIO, brush_factor

GRAVITY_MPS2 = 9.81


# Models of the body's lateral motion.
NONLINEAR, EQ11 = range(2)

LEAST_SPEED_MPS = 0.1
"""Eq. 11 divides by the speed; below this it is taken at this speed (Table 3's least)."""


class PlantParameters(NamedTuple):
    """Constants of the single-track model (SI units); damping in N s/m of lateral tyre deflection, per axle.

    `model` is NONLINEAR or EQ11; `reverse_moment` is the sign of the front wheels' yaw moment in reverse with EQ11,
    +1 as it is, -1 as the paper prints it.
    """

    mass_kg: float
    yaw_inertia_kgm2: float
    cg_to_front_axle_m: float
    cg_to_rear_axle_m: float
    stiffness_front_n_per_rad: float
    stiffness_rear_n_per_rad: float
    friction_front_n: float
    friction_rear_n: float
    relaxation_length_m: float
    damping_front: float
    damping_rear: float
    model: int
    reverse_moment: float


class PlantState(NamedTuple):
    """Pose of the centre of gravity (m, rad), velocities in the body frame (m/s, rad/s), tyre slips (rad).

    `lateral_accel_mps2` is the acceleration of the centre of gravity to the left, of the last step.
    """

    x_m: float
    y_m: float
    yaw_rad: float
    speed_mps: float
    lateral_velocity_mps: float
    yaw_rate_radps: float
    slip_front_rad: float
    slip_rear_rad: float
    lateral_accel_mps2: float


def plant_parameters(
    mass_kg: float,
    yaw_inertia_kgm2: float,
    wheelbase_m: float,
    cg_to_rear_axle_m: float,
    cornering_stiffness_front_n_per_rad: float,
    cornering_stiffness_rear_n_per_rad: float,
    tyre_friction: float,
    relaxation_length_m: float,
    model: int = NONLINEAR,
    reverse_moment: float = 1.0,
) -> PlantParameters:
    """Constants of the model from those of a vehicle file; stiffnesses are per axle."""
    front, rear = wheelbase_m - cg_to_rear_axle_m, cg_to_rear_axle_m
    mass_front, mass_rear = mass_kg * rear / wheelbase_m, mass_kg * front / wheelbase_m

    def damping(stiffness: float, mass: float) -> float:
        return 2.0 * CARCASS_DAMPING_RATIO * sqrt(stiffness / relaxation_length_m * mass)

    return PlantParameters(
        mass_kg=mass_kg,
        yaw_inertia_kgm2=yaw_inertia_kgm2,
        cg_to_front_axle_m=front,
        cg_to_rear_axle_m=rear,
        stiffness_front_n_per_rad=cornering_stiffness_front_n_per_rad,
        stiffness_rear_n_per_rad=cornering_stiffness_rear_n_per_rad,
        friction_front_n=tyre_friction * mass_front * GRAVITY_MPS2,
        friction_rear_n=tyre_friction * mass_rear * GRAVITY_MPS2,
        relaxation_length_m=relaxation_length_m,
        damping_front=damping(cornering_stiffness_front_n_per_rad, mass_front),
        damping_rear=damping(cornering_stiffness_rear_n_per_rad, mass_rear),
        model=model,
        reverse_moment=reverse_moment,
    )


def state_at_rest(p: PlantParameters, x_m: float, y_m: float, yaw_rad: float) -> PlantState:
    """State of a car that stands with its rear-axle centre at the given pose."""
    x = x_m + p.cg_to_rear_axle_m * cos(yaw_rad)
    y = y_m + p.cg_to_rear_axle_m * sin(yaw_rad)
    return PlantState(x, y, yaw_rad, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def rear_axle_pose(p: PlantParameters, state: PlantState) -> tuple[float, float, float]:
    """Pose (x, y in m, yaw in rad) of the rear-axle centre."""
    return rear_axle_of(p, state.x_m, state.y_m, state.yaw_rad)


def rear_axle_of(p: PlantParameters, x_m: float, y_m: float, yaw_rad: float) -> tuple[float, float, float]:
    """Pose of the rear-axle centre, from that of the centre of gravity (m, m, rad)."""
    return x_m - p.cg_to_rear_axle_m * cos(yaw_rad), y_m - p.cg_to_rear_axle_m * sin(yaw_rad), yaw_rad


def step(p: PlantParameters, s: PlantState, speed_next: float, road_wheel_angle: float, h: float) -> PlantState:
    """State after `h` seconds (at most about 1 ms), given speed (m/s) and true road-wheel angle (rad) at their end."""
    x, y, yaw, speed, lateral, yaw_rate, slip_front, slip_rear, accel = s
    if speed_next == 0.0 and speed == 0.0:
        if lateral == 0.0 and yaw_rate == 0.0 and accel == 0.0:
            return s
        return PlantState(x, y, yaw, 0.0, 0.0, 0.0, slip_front, slip_rear, 0.0)
    if p.model == EQ11:
        return step_eq11(p, s, speed_next, road_wheel_angle, h)
    mass, inertia, lf, lr, stiffness_f, stiffness_r, friction_f, friction_r, relaxation, damping_f, damping_r, _, _ = p
    c = cos(road_wheel_angle)
    w = sin(road_wheel_angle)

    # Axle force on slip and lateral velocity at the end of the step: force = -(const + gain * v_lateral).
    rolling = speed_next * c + (lateral + lf * yaw_rate) * w
    if rolling < 0.0:
        rolling = -rolling
    share = brush_factor(stiffness_f * slip_front, friction_f)
    inverse = 1.0 / (relaxation + h * rolling)
    keep_f = relaxation * slip_front * inverse
    take_f = h * inverse
    stiff = share * (stiffness_f - damping_f * rolling)
    const_f = stiff * keep_f
    gain_f = stiff * take_f + share * damping_f

    rolling = speed_next if speed_next >= 0.0 else -speed_next
    share = brush_factor(stiffness_r * slip_rear, friction_r)
    inverse = 1.0 / (relaxation + h * rolling)
    keep_r = relaxation * slip_rear * inverse
    take_r = h * inverse
    stiff = share * (stiffness_r - damping_r * rolling)
    const_r = stiff * keep_r
    gain_r = stiff * take_r + share * damping_r

    # Balance of lateral force and yaw moment, both velocities taken at the end of the step.
    scrub = speed_next * w  # part of the rolling velocity that the steered wheels see from the side
    gain_cc = gain_f * c * c
    force_f = c * (const_f - gain_f * scrub)
    a11 = mass / h + gain_cc + gain_r
    a21 = lf * gain_cc - lr * gain_r
    a12 = mass * speed_next + a21
    a22 = inertia / h + lf * lf * gain_cc + lr * lr * gain_r
    b1 = mass / h * lateral - force_f - const_r
    b2 = inertia / h * yaw_rate - lf * force_f + lr * const_r
    inverse = 1.0 / (a11 * a22 - a12 * a21)
    lateral_next = (b1 * a22 - a12 * b2) * inverse
    yaw_rate_next = (a11 * b2 - b1 * a21) * inverse

    front = c * (lateral_next + lf * yaw_rate_next) - scrub
    rear = lateral_next - lr * yaw_rate_next
    accel = -(c * (const_f + gain_f * front) + const_r + gain_r * rear) / mass

    yaw_next = yaw + 0.5 * h * (yaw_rate + yaw_rate_next)
    middle = 0.5 * (yaw + yaw_next)
    cm = cos(middle)
    sm = sin(middle)
    half = 0.5 * h
    ahead = half * (speed + speed_next)
    aside = half * (lateral + lateral_next)
    return PlantState(
        x + ahead * cm - aside * sm,
        y + ahead * sm + aside * cm,
        yaw_next,
        speed_next,
        lateral_next,
        yaw_rate_next,
        keep_f + take_f * front,
        keep_r + take_r * rear,
        accel,
    )


def step_eq11(p: PlantParameters, s: PlantState, speed_next: float, road_wheel_angle: float, h: float) -> PlantState:
    """State after `h` seconds by eq. 11 of the paper: linear tyres without relaxation, small angles, implicit.

    Eq. 11's (beta, r) in the body frame with signed speed, beta = lateral velocity / speed; the pose is integrated
    exactly. In reverse the paper prints the steered wheels' yaw moment with the other sign (`reverse_moment` -1).
    """
    size = abs(speed_next)
    size = max(size, LEAST_SPEED_MPS)
    lf = p.cg_to_front_axle_m
    lr = p.cg_to_rear_axle_m
    drag_f = p.stiffness_front_n_per_rad / size
    drag_r = p.stiffness_rear_n_per_rad / size
    steered = speed_next * drag_f * road_wheel_angle  # force of the steered wheels in the direction of no slip
    turning = lf * steered
    if speed_next < 0.0:
        turning *= p.reverse_moment
    moment = lr * drag_r - lf * drag_f
    a11 = p.mass_kg / h + drag_f + drag_r
    a12 = p.mass_kg * speed_next - moment
    a22 = p.yaw_inertia_kgm2 / h + lf * lf * drag_f + lr * lr * drag_r
    b1 = p.mass_kg / h * s.lateral_velocity_mps + steered
    b2 = p.yaw_inertia_kgm2 / h * s.yaw_rate_radps + turning
    inverse = 1.0 / (a11 * a22 + a12 * moment)
    lateral_next = (b1 * a22 - a12 * b2) * inverse
    yaw_rate_next = (a11 * b2 + b1 * moment) * inverse
    accel = (lateral_next - s.lateral_velocity_mps) / h + speed_next * yaw_rate_next

    yaw_next = s.yaw_rad + 0.5 * h * (s.yaw_rate_radps + yaw_rate_next)
    middle = 0.5 * (s.yaw_rad + yaw_next)
    cm = cos(middle)
    sm = sin(middle)
    ahead = 0.5 * h * (s.speed_mps + speed_next)
    aside = 0.5 * h * (s.lateral_velocity_mps + lateral_next)
    return PlantState(
        s.x_m + ahead * cm - aside * sm,
        s.y_m + ahead * sm + aside * cm,
        yaw_next,
        speed_next,
        lateral_next,
        yaw_rate_next,
        s.slip_front_rad,
        s.slip_rear_rad,
        accel,
    )
