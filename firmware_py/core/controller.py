"""One control cycle, from reports to commands: the straight line of the whole controller.

    health -> supervisor -> manoeuvre -> schedule -> estimator -> predictor -> feedforward + PID (or the paper's law)
    -> limits -> speed -> gate

Pure: `step(tables, state, inputs) -> (state, outputs)`. Nothing here reads a clock, a bus or a file.
"""

import math
from typing import NamedTuple

from firmware_py.core import conditions as c
from firmware_py.core import estimator, health, limits, manoeuvre, paper_law, pid, predictor, speed, supervisor
from firmware_py.core import gate as last_gate
from firmware_py.core.bounds import bounded
from firmware_py.core.motion import QUEUE_LENGTH
from firmware_py.core.path import feedforward_at, plan_at
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
    Outputs,
    SteerCommand,
    SysCommand,
    Track,
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
    car = tables.car
    dt_s = _elapsed_s(state.last_us, inputs.now_us)

    # Facts, then the decision.
    health_state, conditions = health.assess(tables, state.health, inputs, _believed(tables, state), PERIOD_US)
    if state.manoeuvre.gear_failed != 0:
        conditions |= 1 << c.DIRECTION_CHANGE_TIMEOUT
    if manoeuvre.is_done(state.manoeuvre, inputs.long.gear_rpt, inputs.long.park_brake_applied):
        conditions |= 1 << c.MANOEUVRE_DONE
    decided = supervisor.decide(state.supervisor, conditions, PERIOD_US)
    standstill = c.has(conditions, c.STANDSTILL)
    active = decided.mode == MODE_ACTIVE
    stopping_on_path = decided.mode == MODE_FAULT

    # The leg, and what changes with it.
    leg_state = _manoeuvre(state, car, inputs, decided.mode, standstill)
    direction = manoeuvre.direction_of(leg_state.leg)
    leg = tables.leg[direction]
    estimated = state.estimator
    reference = state.speed
    integral_m2 = state.integral_m2
    if direction != manoeuvre.direction_of(state.manoeuvre.leg):
        estimated = estimator.turn_round(leg, estimated)
        reference = speed.begin(estimated.station_m)
    if not active and not stopping_on_path:
        reference = speed.begin(estimated.station_m)
        integral_m2 = 0.0

    # Where the car is, and where it will be when this cycle's command acts.
    travel_mps = leg.sigma * inputs.motion.speed_meas_mps
    if c.has(conditions, c.MOTION_REPORT_TIMEOUT):
        # The car is being stopped, unseen: it is taken to slow down as the brake commands.
        travel_mps = leg.sigma * state.speed_mps
        travel_mps = max(travel_mps - car.controlled_decel_mps2 * dt_s, 0.0)
    if standstill:
        travel_mps = 0.0
    is_fresh = 0
    if inputs.used.used_motion_counter != NO_COUNTER and inputs.motion.yaw_rate_valid != 0:
        is_fresh = 1
    gains = gains_at(tables.gains, direction, max(travel_mps, 0.0), is_fresh)
    estimated = estimator.estimate(
        leg,
        car,
        gains,
        estimated,
        _motion(car, leg.sigma, state, inputs, travel_mps, is_fresh, standstill, active or stopping_on_path, dt_s),
        health_state.pose_is_new,
        inputs.position.position_x_m,
        inputs.position.position_y_m,
        inputs.attitude.yaw_rad,
        car.pose_latency_samples if tables.law == LAW_CAR else 0,
    )
    station_m, cross_m, heading_rad, angle_rad = predictor.predict(
        leg, car, estimated, state.sent_angles_rad, travel_mps, PERIOD_S
    )
    if tables.law != LAW_CAR:
        cross_m = estimated.cross_track_error_m
        heading_rad = estimated.heading_error_rad

    # Steering: feedforward + PID - disturbance, within the limits.
    feedforward_1pm, slope_1pm2 = feedforward_at(leg, station_m + travel_mps * MEAN_AGE_S)
    feedback_1pm = pid.feedback_1pm(cross_m, heading_rad, integral_m2, gains, leg.sigma)
    feedback_1pm = bounded(feedback_1pm, -pid.CORRECTION_MAX_1PM, pid.CORRECTION_MAX_1PM)
    wanted_rad = _steering(
        car,
        feedforward_1pm,
        slope_1pm2,
        feedback_1pm,
        travel_mps,
        estimated.road_disturbance_rad,
        angle_rad,
        tables.law,
    )
    wanted_rad = (wanted_rad - estimated.steering_offset_rad) / estimated.steering_gain
    paper = state.paper
    if tables.law == LAW_PAPER:
        believed = health_state.pose_is_new != 0 and estimated.disbelieved == 0
        paper, wanted_rad = _paper_steering(tables, state, inputs, estimated, believed, direction, travel_mps)
    if not active and not stopping_on_path:
        wanted_rad = inputs.steer.road_wheel_angle_meas_rad
    limited = limits.limit_angle(car, wanted_rad, state.sent_angles_rad[0], PERIOD_S)
    preview_m = pid.preview_error_m(cross_m, heading_rad, gains.preview_m, leg.sigma)
    held = 1 if limited.limited != 0 or abs(cross_m) > pid.CROSS_TRACK_MAX_M else 0
    integral_m2 = pid.integrate_m2(integral_m2, preview_m, travel_mps * dt_s, gains, held)

    # Speed, then the last word.
    station_now_m = estimated.station_m + travel_mps * REPORT_AGE_S
    speed_command = speed.hold()
    if active and leg_state.driving != 0:
        reference, speed_command = speed.follow(leg, car, reference, station_now_m, travel_mps, dt_s)
    passed = last_gate.gate(
        car,
        tables.road_wheel_angle_lsb_rad,
        decided.mode,
        decided.reaction,
        decided.released,
        leg.sigma,
        last_gate.Wanted(
            limited.angle_rad,
            speed_command.travel_speed_mps,
            speed_command.brake_decel_mps2,
        ),
        state.sent_angles_rad[0],
        state.angle_carry_rad,
        PERIOD_S,
    )
    next_state = State(
        inputs.now_us,
        health_state,
        decided,
        leg_state,
        estimated,
        reference,
        integral_m2,
        paper,
        limited.limited,
        (passed.angle_rad, *state.sent_angles_rad[:-1]),
        passed.angle_carry_rad,
        leg.sigma * travel_mps,
        1 if standstill else 0,
    )
    return next_state, _outputs(decided, leg_state, passed, estimated, car.wheelbase_m, standstill)


def _elapsed_s(last_us: int, now_us: int) -> float:
    """Return the time since the last cycle; one period where there was none."""
    if last_us < 0:
        return PERIOD_S
    return bounded((now_us - last_us) * 1e-6, 0.0, LONGEST_CYCLE_S)


def _believed(tables: Tables, state: State) -> health.Believed:
    path = state.estimator
    leg = tables.leg[manoeuvre.direction_of(state.manoeuvre.leg)]
    planned_mps, _accel_mps2 = plan_at(leg, path.station_m)
    cross_m = path.cross_track_error_m
    heading_rad = path.heading_error_rad
    if tables.law == LAW_PAPER and state.manoeuvre.driving != 0:
        # What this law keeps to its path is the centre of gravity.
        cross_m = state.paper.cross_track_error_m
        heading_rad = state.paper.heading_error_rad
    return health.Believed(
        state.supervisor.mode,
        leg.sigma,
        state.manoeuvre.driving,
        state.speed.stopping,
        planned_mps,
        path.station_m - leg.length_m,
        cross_m,
        heading_rad,
        path.station_m,
        path.disbelieved,
        path.averaged,
        path.modelled_angle_rad,
    )


def _manoeuvre(state: State, car: CarTable, inputs: Inputs, mode: int, standstill: bool) -> manoeuvre.ManoeuvreState:
    """Return the manoeuvre's next state: it proceeds in Active, is kept in Fault, and is over in Manual and Ready."""
    if mode == MODE_ACTIVE:
        steering_gap_rad = inputs.steer.road_wheel_angle_meas_rad - state.sent_angles_rad[0]
        return manoeuvre.proceed(
            state.manoeuvre,
            car,
            inputs.long.gear_rpt,
            inputs.long.park_brake_applied,
            standstill,
            state.speed.stopping,
            steering_gap_rad,
            PERIOD_US,
        )
    if mode == MODE_FAULT:
        kept = state.manoeuvre
        return manoeuvre.ManoeuvreState(kept.leg, 0, 0, 0, 0)
    return manoeuvre.begin()


def _motion(
    car: CarTable,
    sigma: float,
    state: State,
    inputs: Inputs,
    travel_mps: float,
    yaw_rate_is_fresh: int,
    standstill: bool,
    follows: bool,
    dt_s: float,
) -> estimator.Motion:
    """Return what this cycle's reports tell of the motion since the last one's."""
    n = car.command_latency_samples
    angle_is_fresh = 0
    if inputs.used.used_steer_counter != NO_COUNTER and inputs.steer.steer_angle_valid != 0:
        angle_is_fresh = 1
    return estimator.Motion(
        0.5 * (sigma * state.speed_mps + travel_mps) * dt_s,
        dt_s,
        state.sent_angles_rad[n] + car.late_weight * (state.sent_angles_rad[n + 1] - state.sent_angles_rad[n]),
        inputs.steer.road_wheel_angle_meas_rad,
        angle_is_fresh,
        inputs.motion.yaw_rate_meas_radps,
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
    leg_state: manoeuvre.ManoeuvreState,
    passed: last_gate.Passed,
    estimated: estimator.EstimatorState,
    wheelbase_m: float,
    standstill: bool,
) -> Outputs:
    """Return the frames' values. In Fault the vehicle stays enabled until it stands, to steer while braking."""
    enable = 0
    if (decided.mode == MODE_READY and decided.enabling != 0) or passed.follow != 0:
        enable = 1
    clear = 0
    if decided.mode == MODE_MANUAL and decided.clearing_us > 0:
        clear = 1
    leg = leg_state.leg
    if leg == LEG_IDLE and decided.reason == c.COMPLETE:
        leg = LEG_COMPLETE
    gear = GEAR_NONE
    if decided.mode == MODE_ACTIVE:
        gear = manoeuvre.gear_of(leg_state.leg)
    park_brake = 0
    if (passed.follow == 0 and standstill) or gear == GEAR_PARK:
        park_brake = 1
    return Outputs(
        SysCommand(
            enable,
            clear,
            decided.mode,
            leg,
            decided.reason,
        ),
        SteerCommand(passed.angle_rad, passed.follow),
        LongCommand(
            passed.speed_mps,
            passed.brake_decel_mps2,
            gear,
            park_brake,
            passed.follow,
        ),
        Track(
            max(estimated.station_m, 0.0),
            estimated.cross_track_error_m,
            estimated.heading_error_rad,
            (estimated.road_disturbance_rad + estimated.steering_offset_rad) / wheelbase_m,
        ),
    )
