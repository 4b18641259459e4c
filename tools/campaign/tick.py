"""One tick of the plant with what the wire does to its numbers, for loops that run without a bus.

    sense   at the instant of the reports: advance, sample, round, and note the truth
    obey    at the instant at which the commands arrive: advance, round, accept

Whoever closes the loop calls the two in turn (tools/lockstep.py has the instants). Pure functions on what `sim.plant`
describes, so that the same source runs plain and compiled.
"""

from collections.abc import Sequence
from typing import NamedTuple

from firmware_py.core.signals import QUALITY_FIXED, Attitude, LongReport, MotionReport, Position, SteerReport, SysReport
from sim import drive_by_wire as dbw
from sim import plant
from sim.body import clearance_m
from sim.examiner import Yardstick
from sim.plant import Car, Memory, Motion, TruthRow
from sim.sensors import SensorParameters, SensorState
from sim.vehicle import rear_axle_pose
from tools.campaign import wire


class World(NamedTuple):
    """All that stays the same over a run; the last two are what the localiser says of itself."""

    car: Car
    sensors: SensorParameters
    scales: wire.Scales
    yardstick: Yardstick
    start_ns: int
    pose_latency_ms: float
    position_sigma_m: float


class Reports(NamedTuple):
    """The fast reports of one instant as the controller decodes them; `pose_is_new` is 0 where none was sent."""

    sys: SysReport
    steer: SteerReport
    motion: MotionReport
    long: LongReport
    position: Position
    attitude: Attitude
    pose_is_new: int


class Command(NamedTuple):
    """What the three command messages of a cycle say; units as in the DBC."""

    road_wheel_angle_rad: float
    speed_mps: float
    brake_decel_mps2: float
    gear: int
    park_brake: int
    steer_enable: int
    long_enable: int
    enable_request: int
    clear_request: int
    control_leg: int


def sense(
    world: World,
    motion: Motion,
    sensors: SensorState,
    m: Memory,
    now_ns: int,
    since_ns: int,
    normals: Sequence[float],
) -> tuple[Motion, SensorState, Reports, TruthRow]:
    """Return motion, sensors, reports and truth at `now_ns`, `since_ns` after the last call."""
    car = world.car
    scales = world.scales
    motion = plant.advance(car, motion, m, now_ns, dbw.NEVER)
    sensors, measured = plant.sample(car, world.sensors, sensors, motion, m, since_ns * 1.0e-9, normals)
    pose = rear_axle_pose(car.body, motion.body)
    by = world.yardstick
    clearance, _ = clearance_m(by.outline, pose[0], pose[1], pose[2], by.cones)
    truth = plant.truth_row(car, motion, m, (now_ns - world.start_ns) * 1.0e-9, pose, clearance)
    system = m.system
    timeouts = car.system
    standing = 0
    if motion.body.speed_mps == 0.0:
        standing = 1
    pose_is_new = 0
    if measured.pose_is_sent:
        pose_is_new = 1
    reports = Reports(
        SysReport(
            system[dbw.STATE],
            system[dbw.REASON],
            system[dbw.OVERRIDE_LATCHED],
            int(dbw.is_timed_out(timeouts, system, dbw.SYS, now_ns)),
            0,
            0,
            0,
        ),
        SteerReport(
            wire.report(measured.road_wheel_angle_rad, scales.road_wheel_angle_meas_rad),
            wire.report(m.value[plant.ECHO_ANGLE_RAD], scales.road_wheel_angle_echo_rad),
            1,
            m.number[plant.LIMITED_VALUE],
            m.number[plant.LIMITED_RATE],
            int(dbw.is_timed_out(timeouts, system, dbw.STEER, now_ns)),
            0,
            0,
            system[dbw.STEERING_OVERRIDE],
            0,
            0.0,
        ),
        MotionReport(
            wire.report(measured.speed_mps, scales.speed_meas_mps),
            wire.report(measured.yaw_rate_radps, scales.yaw_rate_meas_radps),
            1,
            1,
        ),
        LongReport(
            system[dbw.GEAR],
            system[dbw.PARK_BRAKE_APPLIED],
            standing,
            wire.report(m.value[plant.ECHO_SPEED_MPS], scales.speed_echo_mps),
            wire.report(m.value[plant.ECHO_DECEL_MPS2], scales.brake_decel_echo_mps2),
            int(dbw.is_timed_out(timeouts, system, dbw.LONG, now_ns)),
            0,
            0,
            system[dbw.BRAKE_OVERRIDE],
            0,
        ),
        Position(
            wire.report(measured.x_m, scales.position_x_m),
            wire.report(measured.y_m, scales.position_y_m),
            QUALITY_FIXED,
        ),
        Attitude(
            wire.report(measured.yaw_rad, scales.yaw_rad),
            QUALITY_FIXED,
            world.pose_latency_ms,
            world.position_sigma_m,
        ),
        pose_is_new,
    )
    return motion, sensors, reports, truth


def obey(world: World, motion: Motion, m: Memory, now_ns: int, command: Command) -> Motion:
    """Return the motion at `now_ns`, at which the commands arrived in the order steering, speed, system."""
    car = world.car
    scales = world.scales
    motion = plant.advance(car, motion, m, now_ns, dbw.NEVER)
    angle = wire.command(command.road_wheel_angle_rad, scales.road_wheel_angle_cmd_rad)
    plant.accept_steer(car, motion, m, angle, command.steer_enable)
    speed = wire.command(command.speed_mps, scales.speed_cmd_mps)
    decel = wire.command(command.brake_decel_mps2, scales.brake_decel_cmd_mps2)
    plant.accept_long(car, motion, m, speed, decel, command.gear, command.park_brake, command.long_enable)
    plant.accept_sys(car, motion, m, command.enable_request, command.clear_request, command.control_leg)
    return motion
