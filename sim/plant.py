"""The plant of one run: what acts when, the body's motion, and what the sensors see of it.

The emulator, the campaign and the comparison all drive by these functions. They are written on floats, NamedTuples
and records (mutable rows of numbers: lists in the live emulator, arrays when compiled), with `math` only, so that the
same source runs in CPython and through numba with the same bits.

Timing. An accepted command acts `steer_latency_ns` or `long_latency_ns` after it arrived, to the nanosecond; the
motion is integrated in steps of at most 1 ms that end at every instant at which something acts.
"""

import random
from collections.abc import MutableSequence, Sequence
from typing import NamedTuple

from sim import drive_by_wire as dbw
from sim.actuators import SteeringParameters, SteeringState, steering_target, step_speed, step_steering
from sim.data_files import Course, Scenario, Side, Vehicle, check_fit, true_vehicle
from sim.sensors import Measured, SensorParameters, SensorState, measure, parameters_of
from sim.vehicle import (
    EQ11,
    NONLINEAR,
    PlantParameters,
    PlantState,
    plant_parameters,
    rear_axle_of,
    state_at_rest,
    step,
)

PERIOD_NS = 10_000_000
"""Cycle of the fast reports, and the length of a sample in the vehicle file."""

VERSION_EVERY = 10
"""The vehicle tells its version with every so many-th report."""

MAX_STEP_NS = 1_000_000

HISTORY = 2048
"""Steps that are remembered: the longest pose latency is 40 samples, so 400 steps and some that were cut short."""

PENDING = 512
"""Commands that may be on their way: the longest dead time is 100 samples."""

_ROUNDING_RAD = 1.0e-9
_MISSED_TARGET_RAD = 1.0e-4  # farther than this from its target when the next one comes: the rate limit has cut it

# Slots of the record of values: targets and commands, commands on their way, the recent past.
(
    STEER_TARGET_RAD,
    SPEED_TARGET_MPS,
    DECEL_TARGET_MPS2,
    SPEED_CMD_MPS,  # of the command that acts
    DECEL_CMD_MPS2,
    ECHO_ANGLE_RAD,  # of the command that arrived last
    ECHO_SPEED_MPS,
    ECHO_DECEL_MPS2,
) = range(8)
STEER_RAD = 8
LONG_SPEED_MPS = STEER_RAD + PENDING
LONG_DECEL_MPS2 = LONG_SPEED_MPS + PENDING
PAST_X_M = LONG_DECEL_MPS2 + PENDING
PAST_Y_M = PAST_X_M + HISTORY
PAST_YAW_RAD = PAST_Y_M + HISTORY
VALUE_SLOTS = PAST_YAW_RAD + HISTORY

# Slots of the record of numbers: flags, places, and what belongs to the rows above.
(
    LONG_ENABLE,  # of the command that acts
    GEAR_CMD,
    PARK_BRAKE_CMD,
    LIMITED_VALUE,
    LIMITED_RATE,
    IS_FROZEN,  # a fault holds the rack
    STEER_FIRST,  # place of the oldest command on its way, and how many there are
    STEER_COUNT,
    LONG_FIRST,
    LONG_COUNT,
    PAST_FIRST,
    PAST_COUNT,
) = range(12)
STEER_DUE_NS = 12
LONG_DUE_NS = STEER_DUE_NS + PENDING
LONG_GEAR = LONG_DUE_NS + PENDING
LONG_PARK_BRAKE = LONG_GEAR + PENDING
LONG_ENABLED = LONG_PARK_BRAKE + PENDING
PAST_NS = LONG_ENABLED + PENDING
NUMBER_SLOTS = PAST_NS + HISTORY

Floats = MutableSequence[float]
Ints = MutableSequence[int]


class Car(NamedTuple):
    """Constants of one run: the true car, with its latencies in ns."""

    body: PlantParameters
    steering: SteeringParameters
    system: dbw.DriveByWire
    steer_latency_ns: int
    long_latency_ns: int
    pose_latency_ns: int
    drive_lag_s: float
    brake_lag_s: float
    max_decel_mps2: float


class Motion(NamedTuple):
    """Where the car is at `t_ns`, with its actuators; accelerations and rates are those of the last step."""

    t_ns: int
    body: PlantState
    steer: SteeringState
    decel_mps2: float
    accel_x_mps2: float
    wheel_rate_radps: float


class Memory(NamedTuple):
    """Records of the drive-by-wire system, and of targets, commands on their way and the recent past of the body.

    Commands on their way and the past are rings of PENDING and HISTORY places within the records; what is too many
    pushes out the oldest. The past is the pose of the centre of gravity (m, m, rad) at the end of each step.
    """

    system: Ints
    number: Ints
    value: Floats


class TruthRow(NamedTuple):
    """The plant at the instant of a report: pose of the rear-axle centre, accelerations along and across the body.

    `road_wheel_angle_rad` is the true one, `road_wheel_angle_cmd_rad` the last accepted command; `gear` and `state`
    by the DBC's values, `brake` the deceleration by the brake in m/s^2; `min_clearance_m` of this instant, to the
    nearest cone's axis.
    """

    t_s: float
    x_m: float
    y_m: float
    yaw_rad: float
    speed_mps: float
    accel_x_mps2: float
    accel_y_mps2: float
    road_wheel_angle_rad: float
    road_wheel_rate_radps: float
    road_wheel_angle_cmd_rad: float
    gear: int
    brake: float
    state: int
    min_clearance_m: float


class Setup(NamedTuple):
    """What a run starts from: the true car, its sensors, and the pose of its rear-axle centre (m, m, rad)."""

    car: Car
    sensors: SensorParameters
    start: tuple[float, float, float]


def set_up(
    vehicle: Vehicle, course: Course, scenario: Scenario, side: Side, seed: int, timeout_ns: tuple[int, int, int, int]
) -> Setup:
    """Draw the true car, its sensors and its start; `timeout_ns` are those of the messages in `drive_by_wire.TIMED`.

    Raises UserError where the car does not fit the course.
    """
    nominal = vehicle.with_overlay(scenario.vehicle_overlay, f"scenario {scenario.name}: vehicle_overlay.")
    check_fit(nominal, course)
    rng = random.Random(f"plant {seed}")
    true = true_vehicle(nominal, scenario, seed, rng)
    plant = scenario.plant
    steering = SteeringParameters(
        max_angle_rad=true.max_road_wheel_angle_rad,
        max_rate_radps=true.max_road_wheel_rate_radps,
        lag_s=true.steering_lag_s,
        gain=rng.uniform(*plant.steering_gain),
        bias_rad=rng.uniform(*plant.steering_bias_rad),
        half_backlash_rad=0.5 * rng.uniform(*plant.steering_backlash_rad),
        resolution_rad=rng.uniform(*plant.steering_command_resolution_rad),
    )
    car = Car(
        body=plant_parameters(
            true.mass_kg,
            true.yaw_inertia_kgm2,
            true.wheelbase_m,
            true.cg_to_rear_axle_m,
            true.cornering_stiffness_front_n_per_rad,
            true.cornering_stiffness_rear_n_per_rad,
            true.tyre_friction,
            true.relaxation_length_m,
            EQ11 if plant.model == "eq11" else NONLINEAR,
            -1.0 if plant.reverse_sign == "printed" else 1.0,
        ),
        steering=steering,
        system=dbw.DriveByWire(timeout_ns, round(true.gear_change_s * dbw.NS)),
        steer_latency_ns=round(true.command_latency_samples * PERIOD_NS),
        long_latency_ns=round(rng.uniform(*plant.longitudinal_latency_samples) * PERIOD_NS),
        pose_latency_ns=round(true.pose_latency_samples * PERIOD_NS),
        drive_lag_s=true.drive_lag_s,
        brake_lag_s=true.brake_lag_s,
        max_decel_mps2=true.max_decel_mps2,
    )
    start = scenario.start.apply(course.start_pose(nominal, side), rng)
    return Setup(car, parameters_of(scenario.sensors, seed), (start.x_m, start.y_m, start.yaw_rad))


def begin_memory(start_ns: int) -> Memory:
    """Return the records of a parked car, as lists; `begin` puts the body's past into them."""
    return Memory(dbw.begin(start_ns), [0] * NUMBER_SLOTS, [0.0] * VALUE_SLOTS)


def begin(car: Car, m: Memory, start: tuple[float, float, float], start_ns: int) -> Motion:
    """Return the motion of a car that stands at the start, braked, with its wheels straight."""
    x, y, yaw = start
    body = state_at_rest(car.body, x, y, yaw)
    m.value[DECEL_TARGET_MPS2] = dbw.BRAKE_DECEL_MPS2
    _remember(m, start_ns, body)
    return Motion(start_ns, body, SteeringState(0.0, 0.0, 0.0), dbw.BRAKE_DECEL_MPS2, 0.0, 0.0)


# -- time -------------------------------------------------------------------------------------------------------------


def advance(car: Car, motion: Motion, m: Memory, now_ns: int, stop_ns: int) -> Motion:
    """Return the motion at `now_ns`, stopping at every instant at which something acts; earlier is no effect.

    What acts from outside at `stop_ns` comes before all else: having reached it, this returns without acting there.
    """
    while True:
        event_ns = _next_event_ns(m)
        if event_ns > stop_ns:
            event_ns = stop_ns
        until_ns = event_ns
        if until_ns > now_ns:
            until_ns = now_ns
        if until_ns > motion.t_ns:
            motion = integrate(car, motion, m, until_ns)
        if event_ns > now_ns or event_ns == stop_ns:
            return motion
        act(car, motion, m)


def _next_event_ns(m: Memory) -> int:
    number = m.number
    event_ns = m.system[dbw.NEXT_EVENT_NS]
    if number[STEER_COUNT] != 0:
        due_ns = number[STEER_DUE_NS + number[STEER_FIRST]]
        if due_ns < event_ns:
            event_ns = due_ns
    if number[LONG_COUNT] != 0:
        due_ns = number[LONG_DUE_NS + number[LONG_FIRST]]
        if due_ns < event_ns:
            event_ns = due_ns
    return event_ns


def act(car: Car, motion: Motion, m: Memory) -> None:
    """Let all that is due at the present instant act."""
    now_ns = motion.t_ns
    number = m.number
    dbw.at(car.system, m.system, now_ns, motion.body.speed_mps == 0.0)
    while number[STEER_COUNT] != 0 and number[STEER_DUE_NS + number[STEER_FIRST]] <= now_ns:
        angle = m.value[STEER_RAD + number[STEER_FIRST]]
        number[STEER_FIRST] = (number[STEER_FIRST] + 1) % PENDING
        number[STEER_COUNT] -= 1
        if dbw.follows_steering(m.system):
            missed = abs(m.value[STEER_TARGET_RAD] - motion.steer.demand_rad) > _MISSED_TARGET_RAD
            number[LIMITED_RATE] = 1 if missed else 0
            number[LIMITED_VALUE] = 1 if abs(angle) > car.steering.max_angle_rad + _ROUNDING_RAD else 0
            m.value[STEER_TARGET_RAD] = steering_target(car.steering, angle)
    while number[LONG_COUNT] != 0 and number[LONG_DUE_NS + number[LONG_FIRST]] <= now_ns:
        place = number[LONG_FIRST]
        number[LONG_FIRST] = (place + 1) % PENDING
        number[LONG_COUNT] -= 1
        m.value[SPEED_CMD_MPS] = m.value[LONG_SPEED_MPS + place]
        m.value[DECEL_CMD_MPS2] = m.value[LONG_DECEL_MPS2 + place]
        number[GEAR_CMD] = number[LONG_GEAR + place]
        number[PARK_BRAKE_CMD] = number[LONG_PARK_BRAKE + place]
        number[LONG_ENABLE] = number[LONG_ENABLED + place]
    apply_targets(car, motion, m)


def apply_targets(car: Car, motion: Motion, m: Memory) -> None:
    """Set what drive and brake are to do, from the command that acts and the state of the vehicle."""
    value = m.value
    number = m.number
    if not dbw.follows_speed(m.system) or number[LONG_ENABLE] == 0:
        value[SPEED_TARGET_MPS] = 0.0
        value[DECEL_TARGET_MPS2] = dbw.BRAKE_DECEL_MPS2
        return
    standing = motion.body.speed_mps == 0.0
    dbw.follow_gear(car.system, m.system, motion.t_ns, number[GEAR_CMD], number[PARK_BRAKE_CMD], standing)
    speed = value[SPEED_CMD_MPS]
    if not dbw.may_drive(m.system, speed):
        speed = 0.0
    value[SPEED_TARGET_MPS] = speed
    value[DECEL_TARGET_MPS2] = min(value[DECEL_CMD_MPS2], car.max_decel_mps2)


def integrate(car: Car, motion: Motion, m: Memory, until_ns: int) -> Motion:
    """Return the motion at `until_ns`, later than now, with the targets as they are."""
    t_ns = motion.t_ns
    body = motion.body
    steer = motion.steer
    decel = motion.decel_mps2
    span_ns = until_ns - t_ns
    count = -(-span_ns // MAX_STEP_NS)
    h = span_ns * 1.0e-9 / count
    is_frozen = m.number[IS_FROZEN] != 0
    target = m.value[STEER_TARGET_RAD]
    speed_target = m.value[SPEED_TARGET_MPS]
    decel_target = m.value[DECEL_TARGET_MPS2]
    drive_lag = car.drive_lag_s
    brake_lag = car.brake_lag_s
    bias = car.steering.bias_rad
    speed = body.speed_mps
    before = speed
    wheel_before = steer.wheel_rad
    for index in range(1, count + 1):
        wheel_before = steer.wheel_rad
        if not is_frozen:
            steer = step_steering(car.steering, steer, target, h)
        before = speed
        speed, decel = step_speed(drive_lag, brake_lag, speed, decel, speed_target, decel_target, h)
        body = step(car.body, body, speed, steer.wheel_rad + bias, h)
        _remember(m, t_ns + span_ns * index // count, body)
    return Motion(until_ns, body, steer, decel, (speed - before) / h, (steer.wheel_rad - wheel_before) / h)


def _remember(m: Memory, t_ns: int, body: PlantState) -> None:
    number = m.number
    value = m.value
    count = number[PAST_COUNT]
    place = (number[PAST_FIRST] + count) % HISTORY
    if count == HISTORY:
        number[PAST_FIRST] = (place + 1) % HISTORY
    else:
        number[PAST_COUNT] = count + 1
    number[PAST_NS + place] = t_ns
    value[PAST_X_M + place] = body.x_m
    value[PAST_Y_M + place] = body.y_m
    value[PAST_YAW_RAD + place] = body.yaw_rad


def pose_at(car: Car, m: Memory, t_ns: int) -> tuple[float, float, float]:
    """Rear-axle pose at an earlier instant, between two steps by linear interpolation; forgets what is older."""
    number = m.number
    first = number[PAST_FIRST]
    count = number[PAST_COUNT]
    while count > 1 and number[PAST_NS + (first + 1) % HISTORY] <= t_ns:
        first = (first + 1) % HISTORY
        count -= 1
    number[PAST_FIRST] = first
    number[PAST_COUNT] = count
    x = m.value[PAST_X_M + first]
    y = m.value[PAST_Y_M + first]
    yaw = m.value[PAST_YAW_RAD + first]
    if number[PAST_NS + first] < t_ns and count > 1:
        later = (first + 1) % HISTORY
        share = (t_ns - number[PAST_NS + first]) / (number[PAST_NS + later] - number[PAST_NS + first])
        x += share * (m.value[PAST_X_M + later] - x)
        y += share * (m.value[PAST_Y_M + later] - y)
        yaw += share * (m.value[PAST_YAW_RAD + later] - yaw)
    return rear_axle_of(car.body, x, y, yaw)


# -- reports out ------------------------------------------------------------------------------------------------------


def sample(
    car: Car,
    p: SensorParameters,
    s: SensorState,
    motion: Motion,
    m: Memory,
    since_s: float,
    normals: Sequence[float],
) -> tuple[SensorState, Measured]:
    """Sample all sensors at the present instant, `since_s` after the last time, with a row of standard normals."""
    dbw.at(car.system, m.system, motion.t_ns, motion.body.speed_mps == 0.0)
    pose = pose_at(car, m, motion.t_ns - car.pose_latency_ns)
    return measure(
        p, s, normals, since_s, pose, motion.body.speed_mps, motion.body.yaw_rate_radps, motion.steer.rack_rad
    )


def truth_row(
    car: Car, motion: Motion, m: Memory, t_s: float, pose: tuple[float, float, float], clearance_m: float
) -> TruthRow:
    """Return the truth of the present instant; `pose` is that of the rear-axle centre."""
    return TruthRow(
        t_s,
        pose[0],
        pose[1],
        pose[2],
        motion.body.speed_mps,
        motion.accel_x_mps2,
        motion.body.lateral_accel_mps2,
        motion.steer.wheel_rad + car.steering.bias_rad,
        motion.wheel_rate_radps,
        m.value[ECHO_ANGLE_RAD],
        m.system[dbw.GEAR],
        motion.decel_mps2,
        m.system[dbw.STATE],
        clearance_m,
    )


# -- commands in ------------------------------------------------------------------------------------------------------


def accept_steer(car: Car, motion: Motion, m: Memory, angle_rad: float, enable: int) -> None:
    """Take a valid CTRL_SteerCmd that arrives at the present instant."""
    dbw.accept(m.system, dbw.STEER, motion.t_ns)
    m.value[ECHO_ANGLE_RAD] = angle_rad
    if enable != 0:
        number = m.number
        place = (number[STEER_FIRST] + number[STEER_COUNT]) % PENDING
        if number[STEER_COUNT] == PENDING:
            number[STEER_FIRST] = (number[STEER_FIRST] + 1) % PENDING
        else:
            number[STEER_COUNT] += 1
        number[STEER_DUE_NS + place] = motion.t_ns + car.steer_latency_ns
        m.value[STEER_RAD + place] = angle_rad
        if car.steer_latency_ns == 0:
            act(car, motion, m)


def accept_long(
    car: Car,
    motion: Motion,
    m: Memory,
    speed_mps: float,
    decel_mps2: float,
    gear: int,
    park_brake: int,
    enable: int,
) -> None:
    """Take a valid CTRL_LongCmd that arrives at the present instant."""
    dbw.accept(m.system, dbw.LONG, motion.t_ns)
    m.value[ECHO_SPEED_MPS] = speed_mps
    m.value[ECHO_DECEL_MPS2] = decel_mps2
    number = m.number
    place = (number[LONG_FIRST] + number[LONG_COUNT]) % PENDING
    if number[LONG_COUNT] == PENDING:
        number[LONG_FIRST] = (number[LONG_FIRST] + 1) % PENDING
    else:
        number[LONG_COUNT] += 1
    number[LONG_DUE_NS + place] = motion.t_ns + car.long_latency_ns
    m.value[LONG_SPEED_MPS + place] = speed_mps
    m.value[LONG_DECEL_MPS2 + place] = decel_mps2
    number[LONG_GEAR + place] = gear
    number[LONG_PARK_BRAKE + place] = park_brake
    number[LONG_ENABLED + place] = enable
    if car.long_latency_ns == 0:
        act(car, motion, m)


def accept_sys(car: Car, motion: Motion, m: Memory, enable: int, clear: int, leg: int) -> None:
    """Take a valid CTRL_SysCmd that arrives at the present instant."""
    m.system[dbw.CONTROL_LEG] = leg
    before = m.system[dbw.STATE]
    dbw.accept_requests(car.system, m.system, motion.t_ns, enable, clear, motion.body.speed_mps == 0.0)
    if m.system[dbw.STATE] != before:
        note_new_state(car, motion, m)


def note_new_state(car: Car, motion: Motion, m: Memory) -> None:
    """Let a new state of the drive-by-wire system act."""
    if m.system[dbw.STATE] == dbw.ACTIVE and dbw.is_timed_out(car.system, m.system, dbw.LONG, motion.t_ns):
        m.number[LONG_ENABLE] = 0  # a command from long ago must not move the car
    apply_targets(car, motion, m)
