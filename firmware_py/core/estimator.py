"""The estimator: where the car is, and what disturbs it, from pose, odometry, yaw rate and measured steering.

It is the disturbance observer of the law. Its states live at the instant of the newest vehicle reports:

- the pose of the rear axle, carried from cycle to cycle by odometry and yaw rate and corrected by each pose report;
- the gyro's bias, learnt at standstill and corrected by the poses;
- the road disturbance: angle by which the car turns as if its wheels stood otherwise than measured (alignment, play,
  tyres), which the yaw rate shows at once;
- the steering's gain and offset: how the measured wheels differ from the nominal actuator's. The offset is learnt
  slowly, the gain within a bend. A steering that is slower than known looks weak while it turns in and strong while it
  turns back; where the wheels stand in a bend the gain is the steering's own again, on the straight it stays as it was;
- the odometry's scale, learnt from what the poses find along the path;
- the rear tyres' slip, as a multiple of the nominal car's, learnt from what the poses find across it.

A pose report is old when it comes; it is carried to now by the way that odometry has gone since. Without a fresh yaw
rate the heading is carried by the steering and the road disturbance, which the poses then correct; without a fresh
angle the nominal actuator's stands in for the measured one. How much a pose corrects place, heading, slip and bias (or
road disturbance) is the Kalman filter's (`firmware_py.core.kalman`); the rest comes from the gain table.
"""

import math
from typing import NamedTuple

from firmware_py.core import kalman
from firmware_py.core.bounds import bounded
from firmware_py.core.path import pose_at, wrap_angle
from firmware_py.core.schedule import Gains
from firmware_py.core.tables import CarTable, LegTable

ODOMETRY_LENGTH = 32
"""Cycles of odometry that are remembered; the latency of the pose must be less."""

STATION_GAIN = 0.03
"""Share of the along-track innovation that corrects the pose each cycle: odometry is smooth but drifts by its scale,
the pose does not drift but is noisy."""

SCALE_GAIN_1PM2 = 0.5
"""Change of the odometry's scale per metre of along-track innovation and metre of travel: slow against STATION_GAIN at
full speed, so that both together do not swing."""

GATE_CROSS_M = 0.15
GATE_HEADING_RAD = 0.08
"""A pose farther than this from the expected one is not believed; several in a row are a fault (health)."""

STANDING_GATE_M = 0.05
STANDING_GATE_SIGMAS = 5.0
"""While the vehicle does not follow, a pose this far aside, or so many of its own standard deviations, begins a new
average: the car or its localisation has been moved, and the start is judged by where it is now."""

AVERAGING_MAX = 400
"""Poses of a standing car that its place along the path is the average of, at most; then a first-order filter of that
length. So are place across and heading, of the first `kalman.AVERAGED_POSES`, or with a law without filter."""

BIAS_AVERAGING_MAX = 1000
"""Yaw rates averaged at standstill for the gyro's bias, at most."""

MOVING_PRIOR = 300
"""What the estimate of a moving car is worth when it comes to a stop, counted in poses (along the path) and in yaw
rates (for the gyro's bias)."""

STEERING_GAIN_ANGLE_RAD = 0.1
"""The angle from which on the steering's gain is learnt at more than half of the table's rate."""

STEERING_GAIN_SPREAD = 0.1
STEERING_OFFSET_MAX_RAD = 0.03
ROAD_DISTURBANCE_MAX_RAD = 0.08
ODOMETRY_SCALE_MAX = 0.05
GYRO_BIAS_MAX_RADPS = 0.02
"""What may be learnt: several times what a car that is fit to drive shows."""

SLIP_SCALE_LEAST = 0.4
SLIP_SCALE_MOST = 2.0
"""What mass and tyres 30 % off make of the nominal car's slip, and no more: a localisation whose yaw is mounted askew
looks like slip too, until the car has gone both ways."""


class EstimatorState(NamedTuple):
    """Pose (course frame), its errors relative to the path, disturbances and the memory of the last cycles.

    `road_wheel_angle_rad` is the measured angle or what stands in for it, `modelled_angle_rad` the nominal actuator's
    answer to the commands, `yaw_rate_radps` the last one used. `averaged` counts the poses since the car stands at one
    place, `bias_averaged` the yaw rates, `disbelieved` the poses refused in a row. `odometry_*` is the way gone, newest
    first. `slow_*` is the part of the poses' noise that stays for seconds, as the newest pose had it. `cycles`,
    `poses`, `yaw_rates`, `body_m` and `slipped_m` are those since the filter's gains were made: how many, how many
    believed, how many fresh, the way along the body, and how far the nominal car's slip took it to the left.
    """

    x_m: float
    y_m: float
    yaw_rad: float
    station_m: float
    cross_track_error_m: float
    heading_error_rad: float
    road_disturbance_rad: float
    steering_gain: float
    steering_offset_rad: float
    gyro_bias_radps: float
    odometry_scale: float
    slip_scale: float
    road_wheel_angle_rad: float
    modelled_angle_rad: float
    yaw_rate_radps: float
    averaged: int
    bias_averaged: int
    disbelieved: int
    odometry_x_m: tuple[float, ...]
    odometry_y_m: tuple[float, ...]
    odometry_yaw_rad: tuple[float, ...]
    slow_cross_m: float
    slow_heading_rad: float
    cycles: int
    poses: int
    yaw_rates: int
    body_m: float
    slipped_m: float
    noise: kalman.SeenNoise
    filter: kalman.Filter


class Motion(NamedTuple):
    """What one cycle tells of the car's motion.

    `odometry_m` is the way along the leg's travel as the odometry has it, `acted_angle_rad` the command that acts on
    the nominal actuator now. `*_is_fresh` is 0 where a value is not of this cycle or not valid; `standstill` is 1 for a
    car that stands; `follows` is 1 while the vehicle follows the commands.
    """

    odometry_m: float
    dt_s: float
    acted_angle_rad: float
    angle_meas_rad: float
    angle_is_fresh: int
    yaw_rate_radps: float
    yaw_rate_is_fresh: int
    standstill: int
    follows: int


def begin() -> EstimatorState:
    """Return an estimator that knows nothing: the first pose is taken as it comes."""
    way = (0.0,) * ODOMETRY_LENGTH
    return EstimatorState(
        x_m=0.0,
        y_m=0.0,
        yaw_rad=0.0,
        station_m=0.0,
        cross_track_error_m=0.0,
        heading_error_rad=0.0,
        road_disturbance_rad=0.0,
        steering_gain=1.0,
        steering_offset_rad=0.0,
        gyro_bias_radps=0.0,
        odometry_scale=1.0,
        slip_scale=1.0,
        road_wheel_angle_rad=0.0,
        modelled_angle_rad=0.0,
        yaw_rate_radps=0.0,
        averaged=0,
        bias_averaged=0,
        disbelieved=0,
        odometry_x_m=way,
        odometry_y_m=way,
        odometry_yaw_rad=way,
        slow_cross_m=0.0,
        slow_heading_rad=0.0,
        cycles=kalman.GAINS_EVERY // 2,
        poses=0,
        yaw_rates=0,
        body_m=0.0,
        slipped_m=0.0,
        noise=kalman.begin_noise(),
        filter=kalman.begin(),
    )


def estimate(
    leg: LegTable,
    car: CarTable,
    gains: Gains,
    state: EstimatorState,
    motion: Motion,
    pose_is_new: int,
    position_x_m: float,
    position_y_m: float,
    yaw_rad: float,
    pose_latency_samples: int,
    stated_sigma_m: float,
    filters: int,
) -> EstimatorState:
    """Return the state one cycle later: carried on by the car's motion, corrected if a pose arrived.

    While the vehicle follows, a pose beyond the gate is not believed; else, at standstill, it begins a new average.
    `stated_sigma_m` is the position's standard deviation, of which the localisation tells (0: it does not know). With
    `filters` 0 the poses of a moving car are taken as they come.
    """
    (
        x_m,
        y_m,
        own_yaw_rad,
        station_m,
        _cross_m,
        _heading_rad,
        road_rad,
        gain,
        offset_rad,
        bias_radps,
        scale,
        slip_scale,
        angle_rad,
        modelled_rad,
        last_yaw_rate_radps,
        averaged,
        bias_averaged,
        disbelieved,
        odometry_x_m,
        odometry_y_m,
        odometry_yaw_rad,
        slow_cross_m,
        slow_heading_rad,
        cycles,
        poses,
        yaw_rates,
        gone_m,
        slipped_m,
        noise,
        known,
    ) = state
    odometry_m, dt_s, acted_rad, meas_rad, angle_is_fresh, yaw_rate_radps, yaw_rate_is_fresh, standstill, follows = (
        motion
    )
    sigma = leg.sigma

    # The wheels: measured, or as the nominal actuator has them.
    last_angle_rad = angle_rad
    ds_m = scale * odometry_m
    if follows != 0:
        limit_rad = car.max_road_wheel_rate_radps * dt_s
        modelled_rad += bounded(car.lag_alpha * (acted_rad - modelled_rad), -limit_rad, limit_rad)
    elif angle_is_fresh != 0:
        modelled_rad = meas_rad
    angle_rad = gain * modelled_rad + offset_rad
    if angle_is_fresh != 0:
        gap_rad = meas_rad - angle_rad
        angle_rad = meas_rad
        if follows != 0:
            offset_rad += gains.offset * gap_rad
            offset_rad = bounded(offset_rad, -STEERING_OFFSET_MAX_RAD, STEERING_OFFSET_MAX_RAD)
            weight = modelled_rad * modelled_rad + STEERING_GAIN_ANGLE_RAD * STEERING_GAIN_ANGLE_RAD
            gain += gains.gain * modelled_rad * gap_rad / weight
            gain = bounded(gain, 1.0 - STEERING_GAIN_SPREAD, 1.0 + STEERING_GAIN_SPREAD)

    # The path at the station that odometry has come to.
    station_m += ds_m
    path_x_m, path_y_m, path_yaw_rad, nominal_slip_rad, slip_1pm = pose_at(leg, station_m)
    slip_rad = slip_scale * nominal_slip_rad
    cos_path = math.cos(path_yaw_rad)
    sin_path = math.sin(path_yaw_rad)

    # Heading and place, one cycle on.
    body_m = sigma * ds_m
    turn_rad = 0.0
    dx_m = 0.0
    dy_m = 0.0
    if standstill != 0:
        if yaw_rate_is_fresh != 0:
            bias_averaged = min(bias_averaged + 1, BIAS_AVERAGING_MAX)
            bias_radps += (yaw_rate_radps - bias_radps) / bias_averaged
            bias_radps = max(min(bias_radps, GYRO_BIAS_MAX_RADPS), -GYRO_BIAS_MAX_RADPS)
    else:
        mean_rad = 0.5 * (last_angle_rad + angle_rad) + road_rad
        turn_rad = body_m * (math.tan(mean_rad) / car.wheelbase_m - slip_1pm)
        if yaw_rate_is_fresh != 0:
            turned_rad = dt_s * (0.5 * (last_yaw_rate_radps + yaw_rate_radps) - bias_radps)
            road_rad += car.wheelbase_m * gains.dr * (turned_rad - turn_rad)
            turn_rad = turned_rad
        course_rad = own_yaw_rad + 0.5 * turn_rad - slip_rad
        dx_m = body_m * math.cos(course_rad)
        dy_m = body_m * math.sin(course_rad)
        x_m += dx_m
        y_m += dy_m
        own_yaw_rad += turn_rad
    # Sums of tuples: (newest, *others) makes a list in between and takes half as long again.
    odometry_x_m = (odometry_x_m[0] + dx_m,) + odometry_x_m[:-1]  # noqa: RUF005
    odometry_y_m = (odometry_y_m[0] + dy_m,) + odometry_y_m[:-1]  # noqa: RUF005
    odometry_yaw_rad = (odometry_yaw_rad[0] + turn_rad,) + odometry_yaw_rad[:-1]  # noqa: RUF005
    if yaw_rate_is_fresh != 0:
        last_yaw_rate_radps = yaw_rate_radps
    elif dt_s > 0.0:
        last_yaw_rate_radps = turn_rad / dt_s + bias_radps

    # The estimate relative to the path.
    dx_m = x_m - path_x_m
    dy_m = y_m - path_y_m
    station_m += sigma * (dx_m * cos_path + dy_m * sin_path)
    cross_m = dy_m * cos_path - dx_m * sin_path
    heading_rad = wrap_angle(own_yaw_rad - path_yaw_rad - slip_rad)

    slow_cross_m *= kalman.KEPT
    slow_heading_rad *= kalman.KEPT
    if pose_is_new != 0:
        # The pose, carried to now by the way gone since it was taken, against the estimate, in the path's frame.
        n = pose_latency_samples
        dx_m = position_x_m + odometry_x_m[0] - odometry_x_m[n] - x_m
        dy_m = position_y_m + odometry_y_m[0] - odometry_y_m[n] - y_m
        new_heading_rad = wrap_angle(yaw_rad + odometry_yaw_rad[0] - odometry_yaw_rad[n] - own_yaw_rad)
        new_along_m = dx_m * cos_path + dy_m * sin_path
        new_cross_m = dy_m * cos_path - dx_m * sin_path
        gate_m = GATE_CROSS_M
        if follows == 0:
            gate_m = bounded(STANDING_GATE_SIGMAS * stated_sigma_m, STANDING_GATE_M, GATE_CROSS_M)
        believed = (
            abs(new_cross_m) <= gate_m and abs(new_along_m) <= gate_m and abs(new_heading_rad) <= GATE_HEADING_RAD
        )
        along_m = 0.0
        left_m = 0.0
        turned_rad = 0.0
        taken = 0  # by the filter's gains
        if standstill != 0 and (believed or follows == 0):
            if not believed:
                averaged = 0
            if averaged < AVERAGING_MAX:
                averaged += 1
            along_m = new_along_m / averaged
            noise = kalman.compare(noise, position_x_m, position_y_m, yaw_rad, averaged == 1)
            if averaged <= kalman.AVERAGED_POSES or filters == 0:
                left_m = new_cross_m / averaged
                turned_rad = new_heading_rad / averaged
                slow_cross_m = 0.0
                slow_heading_rad = 0.0
            else:
                taken = 1
            poses += 1
            disbelieved = 0
        elif believed:
            along_m = STATION_GAIN * new_along_m
            scale += SCALE_GAIN_1PM2 * abs(ds_m) * sigma * new_along_m
            scale = bounded(scale, 1.0 - ODOMETRY_SCALE_MAX, 1.0 + ODOMETRY_SCALE_MAX)
            averaged += 1
            if averaged > MOVING_PRIOR:
                averaged = MOVING_PRIOR
            if filters != 0:
                taken = 1
            else:
                left_m = new_cross_m
                turned_rad = new_heading_rad
            poses += 1
            disbelieved = 0
        else:
            disbelieved += 1
        if taken != 0:
            ee, ep, pe, pp, xe, xp, ce, cp, se, sp, te, tp = known.gains
            cross_gap_m = bounded(new_cross_m - slow_cross_m, -known.most_cross_m, known.most_cross_m)
            heading_gap_rad = new_heading_rad - slow_heading_rad
            heading_gap_rad = bounded(heading_gap_rad, -known.most_heading_rad, known.most_heading_rad)
            left_m = ee * cross_gap_m + ep * heading_gap_rad
            turned_rad = pe * cross_gap_m + pp * heading_gap_rad
            # What is beyond the usual is a jump of the localisation, and not of the car.
            slow_cross_m = new_cross_m - cross_gap_m + se * cross_gap_m + sp * heading_gap_rad
            slow_heading_rad = new_heading_rad - heading_gap_rad + te * cross_gap_m + tp * heading_gap_rad
            if follows != 0:
                # Near the speed that the path is planned with; under a driver's hands the slip is another one.
                slip_scale += ce * cross_gap_m + cp * heading_gap_rad
                slip_scale = bounded(slip_scale, SLIP_SCALE_LEAST, SLIP_SCALE_MOST)
            if known.with_yaw_rate == yaw_rate_is_fresh:
                learnt = xe * cross_gap_m + xp * heading_gap_rad
                if yaw_rate_is_fresh != 0:
                    bias_radps += learnt
                else:
                    road_rad += car.wheelbase_m * learnt
        x_m += along_m * cos_path - left_m * sin_path
        y_m += along_m * sin_path + left_m * cos_path
        own_yaw_rad += turned_rad
        station_m += sigma * along_m
        cross_m += left_m
        heading_rad += turned_rad
    if standstill == 0:
        if noise.stood != 0:
            noise = kalman.moved(noise)
        if bias_averaged > MOVING_PRIOR:
            bias_averaged = MOVING_PRIOR
        road_rad = bounded(road_rad, -ROAD_DISTURBANCE_MAX_RAD, ROAD_DISTURBANCE_MAX_RAD)
        bias_radps = bounded(bias_radps, -GYRO_BIAS_MAX_RADPS, GYRO_BIAS_MAX_RADPS)

    cycles += 1
    yaw_rates += yaw_rate_is_fresh
    gone_m += body_m
    if follows != 0:
        slipped_m -= body_m * nominal_slip_rad
    if cycles >= kalman.GAINS_EVERY:
        with_yaw_rate = 1 if 2 * yaw_rates >= cycles else 0
        if filters != 0:
            walks = kalman.Walks(gains.cross_walk, gains.heading_walk, gains.road_walk)
            interval = kalman.Interval(
                gone_m, slipped_m, poses, stated_sigma_m, averaged, bias_averaged, standstill, with_yaw_rate
            )
            known = kalman.advance(known, walks, noise, interval)
        elif averaged > 0:
            known = kalman.as_they_come(noise, stated_sigma_m, averaged if standstill != 0 else 1)
        cycles = 0
        poses = 0
        yaw_rates = 0
        gone_m = 0.0
        slipped_m = 0.0

    return EstimatorState(
        x_m,
        y_m,
        own_yaw_rad,
        station_m,
        cross_m,
        heading_rad,
        road_rad,
        gain,
        offset_rad,
        bias_radps,
        scale,
        slip_scale,
        angle_rad,
        modelled_rad,
        last_yaw_rate_radps,
        averaged,
        bias_averaged,
        disbelieved,
        odometry_x_m,
        odometry_y_m,
        odometry_yaw_rad,
        slow_cross_m,
        slow_heading_rad,
        cycles,
        poses,
        yaw_rates,
        gone_m,
        slipped_m,
        noise,
        known,
    )


def turn_round(leg: LegTable, state: EstimatorState) -> EstimatorState:
    """Return the state on the path travelled the other way: the same body, the station counted from the other end."""
    return EstimatorState(
        state.x_m,
        state.y_m,
        state.yaw_rad,
        leg.length_m - state.station_m,
        state.cross_track_error_m,
        state.heading_error_rad,
        state.road_disturbance_rad,
        state.steering_gain,
        state.steering_offset_rad,
        state.gyro_bias_radps,
        state.odometry_scale,
        state.slip_scale,
        state.road_wheel_angle_rad,
        state.modelled_angle_rad,
        state.yaw_rate_radps,
        state.averaged,
        state.bias_averaged,
        state.disbelieved,
        state.odometry_x_m,
        state.odometry_y_m,
        state.odometry_yaw_rad,
        state.slow_cross_m,
        state.slow_heading_rad,
        state.cycles,
        state.poses,
        state.yaw_rates,
        state.body_m,
        state.slipped_m,
        state.noise,
        state.filter,
    )
