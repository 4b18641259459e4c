"""The firmware's cycle with another steering law in it: everything else is the firmware's own.

`step` stands where `firmware_py.core.controller.step` does and calls it: health, supervisor, manoeuvre, estimator,
speed and gates run as ever. Only then the steering command is replaced by that of the law in question, cut by the same
limits and rounded by the same gate. With the law `car` nothing is replaced.
"""

import math
from collections.abc import MutableSequence, Sequence
from typing import NamedTuple

from firmware_py.core import controller, limits, manoeuvre, supervisor
from firmware_py.core import gate as last_gate
from firmware_py.core.controller import PERIOD_S
from firmware_py.core.motion import advance
from firmware_py.core.signals import MODE_ACTIVE, Inputs, Outputs, SteerCommand
from firmware_py.core.tables import Tables
from tools.compare import laws
from tools.compare.laws import LAW_SLOTS, Seen, Solve, on_path

# Slots of the memory of a run, after those of the law.
LEG = LAW_SLOTS
LAST_RAD = LEG + 1
LAST_CHANGE_RAD = LEG + 2
JITTER_RAD2 = LEG + 3  # two, by direction
JITTER_SAMPLES = LEG + 5
MEMORY_SLOTS = LEG + 7


class Steered(NamedTuple):
    """Tables of the firmware and the law that steers; `behind_estimator` is 1 where it gets the estimator's state."""

    core: Tables
    dbc_hash24: int
    vehicle_hash24: int
    law: int
    behind_estimator: int
    numbers: Sequence[float]
    table: Sequence[Sequence[float]]
    memory: MutableSequence[float]
    solve: Solve


class SteeredState(NamedTuple):
    """The firmware's state, and its supervisor's once more, where whoever drives looks for it."""

    core: controller.State
    supervisor: supervisor.SupervisorState


def begin() -> SteeredState:
    """Return the state before the first cycle."""
    core = controller.begin()
    return SteeredState(core, core.supervisor)


def step(tables: Steered, state: SteeredState, inputs: Inputs) -> tuple[SteeredState, Outputs]:
    """Return the next state and the commands of this cycle."""
    before = state.core
    after, outputs = controller.step(tables.core, before, inputs)
    direction = manoeuvre.direction_of(after.manoeuvre.leg)
    memory = tables.memory
    if after.supervisor.mode != MODE_ACTIVE or memory[LEG] != direction:
        memory[LEG] = direction
        for slot in range(LAW_SLOTS):
            memory[slot] = 0.0
    if after.supervisor.mode == MODE_ACTIVE:
        if tables.law != laws.CAR:
            after, outputs = _replaced(tables, before, after, outputs, inputs, direction)
        _note_jitter(memory, direction, after.speed_mps, after.sent_angles_rad[0])
    return SteeredState(after, after.supervisor), outputs


def _note_jitter(memory: MutableSequence[float], direction: int, speed_mps: float, angle_rad: float) -> None:
    """Sum up the squared second difference of the command while the car moves."""
    change_rad = angle_rad - memory[LAST_RAD]
    if speed_mps != 0.0:
        second_rad = change_rad - memory[LAST_CHANGE_RAD]
        memory[JITTER_RAD2 + direction] += second_rad * second_rad
        memory[JITTER_SAMPLES + direction] += 1.0
    memory[LAST_RAD] = angle_rad
    memory[LAST_CHANGE_RAD] = change_rad


def _replaced(
    tables: Steered,
    before: controller.State,
    after: controller.State,
    outputs: Outputs,
    inputs: Inputs,
    direction: int,
) -> tuple[controller.State, Outputs]:
    """Return state and outputs with the law's steering in place of the firmware's."""
    core = tables.core
    car = core.car
    leg = core.leg[direction]
    seen = see(tables, before, after, inputs, direction)
    wanted_rad = laws.steer(tables.law, tables.numbers, tables.table, leg, car, seen, tables.memory, tables.solve)
    if tables.behind_estimator != 0:
        estimated = after.estimator
        wanted_rad -= estimated.road_disturbance_rad + estimated.steering_offset_rad
        wanted_rad /= estimated.steering_gain
    last_rad = before.sent_angles_rad[0]
    wanted_rad, limited = limits.limit_angle(car, wanted_rad, last_rad, PERIOD_S)
    decided = after.supervisor
    angle_rad, angle_carry_rad, _speed_mps, _brake_mps2, _follow = last_gate.gate(
        car,
        core.road_wheel_angle_lsb_rad,
        decided.mode,
        decided.reaction,
        decided.released,
        leg.sigma,
        wanted_rad,
        0.0,
        0.0,
        last_rad,
        before.angle_carry_rad,
        PERIOD_S,
    )
    state = controller.State(
        after.last_us,
        after.health,
        after.supervisor,
        after.manoeuvre,
        after.estimator,
        after.speed,
        after.integral_m2,
        after.paper,
        limited,
        (angle_rad, *before.sent_angles_rad[:-1]),
        angle_carry_rad,
        after.speed_mps,
        after.standstill,
    )
    steering = SteerCommand(angle_rad, outputs.steer.steer_enable)
    return state, Outputs(outputs.sys, steering, outputs.long, outputs.track)


def see(tables: Steered, before: controller.State, after: controller.State, inputs: Inputs, direction: int) -> Seen:
    """Return what the law is told: the newest pose as it came, or the estimator's state; the prediction of it.

    The prediction takes the motion of the firmware's own predictor over the latencies: those of pose and command for
    the pose as it came, of the command alone for the estimator's state, which is that of now.
    """
    core = tables.core
    car = core.car
    leg = core.leg[direction]
    estimated = after.estimator
    sent_rad = before.sent_angles_rad
    travel_mps = leg.sigma * after.speed_mps
    late = car.command_latency_samples
    gain = 1.0
    offset_rad = 0.0
    road_rad = 0.0
    x_m = inputs.position.position_x_m
    y_m = inputs.position.position_y_m
    yaw_rad = inputs.attitude.yaw_rad
    yaw_rate_radps = inputs.motion.yaw_rate_meas_radps
    angle_rad = inputs.steer.road_wheel_angle_meas_rad
    if tables.behind_estimator != 0:
        gain = estimated.steering_gain
        offset_rad = estimated.steering_offset_rad
        road_rad = estimated.road_disturbance_rad
        x_m = estimated.x_m
        y_m = estimated.y_m
        yaw_rad = estimated.yaw_rad
        yaw_rate_radps -= estimated.gyro_bias_radps
        angle_rad = estimated.road_wheel_angle_rad
        station_m = estimated.station_m
        cross_m = estimated.cross_track_error_m
        heading_rad = estimated.heading_error_rad
        pose_late = 0
    else:
        station_m, cross_m, heading_rad = on_path(leg, estimated.station_m, x_m, y_m, yaw_rad)
        pose_late = car.pose_latency_samples
    ahead_station_m = station_m
    ahead_cross_m = cross_m
    ahead_heading_rad = heading_rad
    for _ in range(pose_late):
        # Over the pose's latency the wheels stood about as they are measured now.
        ahead_station_m, ahead_cross_m, ahead_heading_rad, _angle_rad = advance(
            leg,
            car,
            ahead_station_m,
            ahead_cross_m,
            ahead_heading_rad,
            angle_rad,
            angle_rad,
            road_rad,
            travel_mps,
            PERIOD_S,
        )
    for index in range(late):
        target_rad = gain * sent_rad[late - 1 - index] + offset_rad
        ahead_station_m, ahead_cross_m, ahead_heading_rad, angle_rad = advance(
            leg,
            car,
            ahead_station_m,
            ahead_cross_m,
            ahead_heading_rad,
            angle_rad,
            target_rad,
            road_rad,
            travel_mps,
            PERIOD_S,
        )
    acts = late + pose_late
    acted_rad = sent_rad[acts] + car.late_weight * (sent_rad[acts + 1] - sent_rad[acts])
    return Seen(
        x_m,
        y_m,
        yaw_rad,
        station_m,
        cross_m,
        heading_rad,
        ahead_station_m,
        ahead_cross_m,
        ahead_heading_rad,
        angle_rad + road_rad,
        travel_mps,
        0.5 * (leg.sigma * before.speed_mps + travel_mps) * PERIOD_S,
        yaw_rate_radps,
        gain * acted_rad + offset_rad + road_rad,
        gain * sent_rad[0] + offset_rad + road_rad,
        before.limited,
    )


def jitter_rad(memory: Sequence[float], direction: int) -> float:
    """Return the rms of the command's second difference over the moving cycles of a leg."""
    samples = memory[JITTER_SAMPLES + direction]
    return math.sqrt(memory[JITTER_RAD2 + direction] / samples) if samples > 0.0 else 0.0
