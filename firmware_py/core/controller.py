"""One control cycle, from reports to commands: the straight line of the whole controller.

    health -> supervisor -> manoeuvre -> schedule -> estimator -> predictor -> feedforward + PID (or the paper's law)
    -> limits -> speed -> gate

Pure: `step(tables, state, inputs) -> (state, outputs)`. Nothing here reads a clock, a bus or a file.
"""

import math
from typing import NamedTuple

from firmware_py.core import conditions as c
from firmware_py.core import estimator, health, kalman, limits, manoeuvre, paper_law, pid, predictor, speed, supervisor
from firmware_py.core import gate as last_gate
from firmware_py.core.bounds import bounded
from firmware_py.core.motion import QUEUE_LENGTH
from firmware_py.core.path import feedforward_at
from firmware_py.core.schedule import gains_at
from firmware_py.core.signals import (
    GEAR_NONE,
    GEAR_PARK,
    LEG_COMPLETE,
    LEG_IDLE,
    MODE_ACTIVE,
    MODE_FAULT,
    MODE_MANUAL,
    MODE_READY,
    NO_COUNTER,
    Inputs,
    LongCommand,
    MotionReport,
    Outputs,
    SteerCommand,
    SteerReport,
    SysCommand,
    Track,
    UsedCounters,
)
from firmware_py.core.tables import LAW_CAR, LAW_PAPER, CarTable, Tables

PERIOD_US = 10_000
PERIOD_S = 0.01

REPORT_AGE_S = 0.003
"""How long before the cycle the reports of a cycle are sampled, as agreed for the bus; the law works at any phase."""

MEAN_AGE_S = REPORT_AGE_S + 0.5 * PERIOD_S
"""From the reports to the middle of the cycle in which the command stands."""

LONGEST_CYCLE_S = 0.1
"""After a longer pause the odometry is not integrated further: the vehicle's watchdog has stopped the car by then."""


class State(NamedTuple):
    """All that one cycle hands to the next. `sent_angles_rad[0]` is the newest steering command."""

    last_us: int
    health: health.HealthState
    supervisor: supervisor.SupervisorState
    manoeuvre: manoeuvre.ManoeuvreState
    estimator: estimator.EstimatorState
    speed: speed.SpeedState
    integral_m2: float
    paper: paper_law.PaperState
    limited: int
    sent_angles_rad: tuple[float, ...]
    angle_carry_rad: float
    speed_mps: float
    standstill: int


def begin() -> State:
    """Return the state before the first cycle."""
    return State(
        last_us=-1,
        health=health.begin(),
        supervisor=supervisor.begin(),
        manoeuvre=manoeuvre.begin(),
        estimator=estimator.begin(),
        speed=speed.begin(0.0),
        integral_m2=0.0,
        paper=paper_law.begin(),
        limited=0,
        sent_angles_rad=(0.0,) * QUEUE_LENGTH,
        angle_carry_rad=0.0,
        speed_mps=0.0,
        standstill=0,
    )


def step(tables: Tables, state: State, inputs: Inputs) -> tuple[State, Outputs]:
    """Return the next state and the commands of this cycle."""
    (
        last_us,
        health_state,
        decided,
        leg_state,
        estimated,
        reference,
        integral_m2,
        paper,
        _limited,
        sent_angles_rad,
        angle_carry_rad,
        last_speed_mps,
        _standstill,
    ) = state
    now_us, used, _sys, steer, motion, long, position, attitude, _oper, _version, _second_controller = inputs
    car = tables.car
    law = tables.law
    last_rad = sent_angles_rad[0]
    gear_rpt = long.gear_rpt
    park_brake_applied = long.park_brake_applied
    angle_meas_rad = steer.road_wheel_angle_meas_rad
    dt_s = _elapsed_s(last_us, now_us)

    # Facts, then the decision.
    last_direction = manoeuvre.direction_of(leg_state.leg)
    kept_cross_m, kept_heading_rad = estimated.cross_track_error_m, estimated.heading_error_rad
    if law == LAW_PAPER and leg_state.driving != 0:
        # What this law keeps to its path is the centre of gravity.
        kept_cross_m, kept_heading_rad = paper.cross_track_error_m, paper.heading_error_rad
    health_state, conditions = health.assess(
        tables,
        health_state,
        inputs,
        tables.leg[last_direction],
        decided.mode,
        leg_state.driving,
        reference.stopping,
        estimated,
        kept_cross_m,
        kept_heading_rad,
        PERIOD_US,
    )
    if leg_state.gear_failed != 0:
        conditions |= 1 << c.DIRECTION_CHANGE_TIMEOUT
    if manoeuvre.is_done(leg_state, gear_rpt, park_brake_applied):
        conditions |= 1 << c.MANOEUVRE_DONE
    decided = supervisor.decide(decided, conditions, PERIOD_US)
    mode = decided.mode
    standstill = c.has(conditions, c.STANDSTILL)
    active = mode == MODE_ACTIVE
    follows = active or mode == MODE_FAULT  # in Fault the car stops on its path

    # The leg, and what changes with it.
    if active:
        leg_state = manoeuvre.proceed(
            leg_state,
            car,
            gear_rpt,
            park_brake_applied,
            standstill,
            reference.stopping,
            angle_meas_rad - last_rad,
            law == LAW_CAR and estimated.filter.slow_m2 > kalman.SLOW_NOISE_M * kalman.SLOW_NOISE_M,
            PERIOD_US,
        )
    elif mode == MODE_FAULT:
        leg_state = manoeuvre.keep(leg_state)
    else:
        leg_state = manoeuvre.begin()
    direction = manoeuvre.direction_of(leg_state.leg)
    leg = tables.leg[direction]
    sigma = leg.sigma
    if direction != last_direction:
        estimated = estimator.turn_round(leg, estimated)
        reference = speed.begin(estimated.station_m)
    if not follows:
        reference = speed.begin(estimated.station_m)
        integral_m2 = 0.0

    # Where the car is, and where it will be when this cycle's command acts.
    travel_mps = sigma * motion.speed_meas_mps
    if c.has(conditions, c.MOTION_REPORT_TIMEOUT):
        # The car is being stopped, unseen: it is taken to slow down as the brake commands.
        travel_mps = sigma * last_speed_mps
        travel_mps = max(travel_mps - car.controlled_decel_mps2 * dt_s, 0.0)
    if standstill:
        travel_mps = 0.0
    moved = _moved(
        car,
        used,
        steer,
        motion,
        0.5 * (sigma * last_speed_mps + travel_mps) * dt_s,
        dt_s,
        sent_angles_rad,
        standstill,
        follows,
    )
    gains = gains_at(tables.gains, direction, travel_mps)
    estimated = estimator.estimate(
        leg,
        car,
        gains,
        estimated,
        moved,
        health_state.pose_is_new,
        position.position_x_m,
        position.position_y_m,
        attitude.yaw_rad,
        car.pose_latency_samples if law == LAW_CAR else 0,
        attitude.position_sigma_m,
        1 if law == LAW_CAR else 0,
    )
    station_m, cross_m, heading_rad, angle_rad = predictor.predict(
        leg, car, estimated, sent_angles_rad, travel_mps, PERIOD_S
    )
    if law != LAW_CAR:
        cross_m = estimated.cross_track_error_m
        heading_rad = estimated.heading_error_rad

    # Steering: feedforward + PID - disturbance, within the limits.
    feedforward_1pm, slope_1pm2 = feedforward_at(leg, station_m + travel_mps * MEAN_AGE_S)
    preview_m = pid.preview_error_m(cross_m, heading_rad, gains.preview_m, sigma)
    asked_1pm = pid.feedback_1pm(preview_m, heading_rad, integral_m2, gains, sigma)
    feedback_1pm = bounded(asked_1pm, -pid.CORRECTION_MAX_1PM, pid.CORRECTION_MAX_1PM)
    wanted_rad = _steering(
        car,
        feedforward_1pm,
        slope_1pm2,
        feedback_1pm,
        travel_mps,
        estimated.road_disturbance_rad,
        angle_rad,
        law,
    )
    wanted_rad = (wanted_rad - estimated.steering_offset_rad) / estimated.steering_gain
    if law == LAW_PAPER:
        believed = health_state.pose_is_new != 0 and estimated.disbelieved == 0
        paper, wanted_rad = _paper_steering(tables, state, inputs, estimated, believed, direction, travel_mps)
    if not follows:
        wanted_rad = angle_meas_rad
    wanted_rad, limited = limits.limit_angle(car, wanted_rad, last_rad, PERIOD_S)
    held = 1 if limited != 0 or feedback_1pm != asked_1pm or abs(cross_m) > pid.CROSS_TRACK_MAX_M else 0
    integral_m2 = pid.integrate_m2(integral_m2, preview_m, travel_mps * dt_s, gains, held)

    # Speed, then the last word.
    wanted_mps, brake_mps2 = 0.0, speed.HOLD_DECEL_MPS2
    if active and leg_state.driving != 0:
        station_now_m = estimated.station_m + travel_mps * REPORT_AGE_S
        reference, wanted_mps, brake_mps2 = speed.follow(leg, car, reference, station_now_m, travel_mps, dt_s)
    sent_rad, angle_carry_rad, speed_mps, brake_mps2, follow = last_gate.gate(
        car,
        tables.road_wheel_angle_lsb_rad,
        mode,
        decided.reaction,
        decided.released,
        sigma,
        wanted_rad,
        wanted_mps,
        brake_mps2,
        last_rad,
        angle_carry_rad,
        PERIOD_S,
    )
    next_state = State(
        now_us,
        health_state,
        decided,
        leg_state,
        estimated,
        reference,
        integral_m2,
        paper,
        limited,
        (sent_rad,) + sent_angles_rad[:-1],  # noqa: RUF005
        angle_carry_rad,
        sigma * travel_mps,
        1 if standstill else 0,
    )
    return next_state, _outputs(
        decided, leg_state.leg, sent_rad, speed_mps, brake_mps2, follow, estimated, car.wheelbase_m, standstill
    )


def _elapsed_s(last_us: int, now_us: int) -> float:
    """Return the time since the last cycle; one period where there was none."""
    if last_us < 0:
        return PERIOD_S
    return bounded((now_us - last_us) * 1e-6, 0.0, LONGEST_CYCLE_S)


def _moved(
    car: CarTable,
    used: UsedCounters,
    steer: SteerReport,
    motion: MotionReport,
    odometry_m: float,
    dt_s: float,
    sent_angles_rad: tuple[float, ...],
    standstill: bool,
    follows: bool,
) -> estimator.Motion:
    """Return what this cycle's reports tell of the motion since the last one's."""
    n = car.command_latency_samples
    acted_angle_rad = sent_angles_rad[n] + car.late_weight * (sent_angles_rad[n + 1] - sent_angles_rad[n])
    angle_is_fresh = 0
    if used.used_steer_counter != NO_COUNTER and steer.steer_angle_valid != 0:
        angle_is_fresh = 1
    yaw_rate_is_fresh = 0
    if used.used_motion_counter != NO_COUNTER and motion.yaw_rate_valid != 0:
        yaw_rate_is_fresh = 1
    return estimator.Motion(
        odometry_m,
        dt_s,
        acted_angle_rad,
        steer.road_wheel_angle_meas_rad,
        angle_is_fresh,
        motion.yaw_rate_meas_radps,
        yaw_rate_is_fresh,
        1 if standstill else 0,
        1 if follows else 0,
    )


def _steering(
    car: CarTable,
    feedforward_1pm: float,
    slope_1pm2: float,
    correction_1pm: float,
    travel_mps: float,
    road_disturbance_rad: float,
    angle_rad: float,
    law: int,
) -> float:
    """Return the road-wheel angle to command: feedforward less correction (1/m), ahead of the actuator's lag.

    `angle_rad` is the wheels' angle when the command begins to act; the law `car` pushes them on by what they lack.
    """
    reference = car.wheelbase_m * feedforward_1pm
    wanted_rad = math.atan(reference - car.wheelbase_m * correction_1pm) - road_disturbance_rad
    rate_radps = travel_mps * car.wheelbase_m * slope_1pm2 / (1.0 + reference * reference)
    ahead_rad = wanted_rad + car.steering_lag_s * rate_radps
    if law == LAW_CAR:
        ahead_rad += pid.push_rad(wanted_rad - rate_radps * MEAN_AGE_S - angle_rad, car)
    return ahead_rad


def _paper_steering(
    tables: Tables,
    state: State,
    inputs: Inputs,
    estimated: estimator.EstimatorState,
    pose_is_believed: bool,
    direction: int,
    travel_mps: float,
) -> tuple[paper_law.PaperState, float]:
    """Return the paper's law's next state and angle: by the pose as it came, by the estimate where none is believed."""
    x_m = estimated.x_m
    y_m = estimated.y_m
    yaw_rad = estimated.yaw_rad
    if pose_is_believed:
        x_m = inputs.position.position_x_m
        y_m = inputs.position.position_y_m
        yaw_rad = inputs.attitude.yaw_rad
    return paper_law.steer(
        tables.paper,
        tables.reference,
        tables.leg[direction],
        tables.car,
        state.paper,
        direction,
        travel_mps,
        estimated.station_m,
        x_m,
        y_m,
        yaw_rad,
        inputs.steer.road_wheel_angle_meas_rad,
        state.sent_angles_rad[0],
    )


def _outputs(
    decided: supervisor.SupervisorState,
    leg: int,
    angle_rad: float,
    speed_mps: float,
    brake_mps2: float,
    follow: int,
    estimated: estimator.EstimatorState,
    wheelbase_m: float,
    standstill: bool,
) -> Outputs:
    """Return the frames' values. In Fault the vehicle stays enabled until it stands, to steer while braking."""
    mode = decided.mode
    enable = follow
    clear = 0
    gear = GEAR_NONE
    if mode == MODE_ACTIVE:
        gear = manoeuvre.gear_of(leg)
    elif mode == MODE_READY and decided.enabling != 0:
        enable = 1
    elif mode == MODE_MANUAL and decided.clearing_us > 0:
        clear = 1
    park_brake = 0
    if (follow == 0 and standstill) or gear == GEAR_PARK:
        park_brake = 1
    reason = decided.reason
    if leg == LEG_IDLE and reason == c.COMPLETE:
        leg = LEG_COMPLETE
    return Outputs(
        SysCommand(enable, clear, mode, leg, reason),
        SteerCommand(angle_rad, follow),
        LongCommand(speed_mps, brake_mps2, gear, park_brake, follow),
        Track(
            max(estimated.station_m, 0.0),
            estimated.cross_track_error_m,
            estimated.heading_error_rad,
            (estimated.road_disturbance_rad + estimated.steering_offset_rad) / wheelbase_m,
        ),
    )
