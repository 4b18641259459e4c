"""The Kalman filter behind the estimator: how well the car's place is known, and how much a pose therefore corrects.

Six errors are carried: of the cross-track error (e, m), of the heading (p, rad), of what carries the heading wrong
(x: the gyro's bias in rad/s with the yaw rate, else the road disturbance in 1/m), of how much the rear tyres slip (c, a
share of the nominal car's slip), and two of the pose itself: the part of its noise that stays for seconds, sideways
(s, m) and in yaw (t, rad). Names put two of these letters together: `ep` is the covariance of e and p, or the gain that
corrects e by a new heading.

What differs from one pose to the next averages out; how large it is, the poses of a car that stands show. The rest of
the standard deviation that the localisation states for itself is taken to stay for seconds: a first-order process of
`SLOW_S`, which the filter follows beside the car and does not take for the car's place.

Every tenth cycle covariance and gains are made anew for the ten cycles to come. All is relative to the path and linear;
the noise's part along the path is not carried, nor that it turns into a sideways one as the path bends.
"""

import math
from typing import NamedTuple

from firmware_py.core.path import wrap_angle

GAINS_EVERY = 10
"""Cycles for which gains hold."""

PERIOD_S = 0.01
"""Cycle of the controller, for which the gains are."""

SLOW_S = 5.0
"""How long the slow part of a pose's noise stays, s: as after a change of satellites or of their signals' paths."""

HALF_S = 0.5 * GAINS_EVERY * PERIOD_S
"""Half of that time."""

KEPT = math.exp(-PERIOD_S / SLOW_S)
KEPT_HALF = math.exp(-HALF_S / SLOW_S)
"""Share of the slow noise that is left after a cycle, and after half of `GAINS_EVERY`."""

STANDING_WALK_M = 0.25e-3
"""What a standing car's place is taken to change by, m per root second, its yaw by `YAW_PER_POSITION_RADPM` as much:
no more than some 400 poses with 1 cm of white noise are averaged so, and a car that is pushed aside is seen there."""


YAW_PER_POSITION_RADPM = math.radians(0.1) / 0.01
"""Standard deviation of the yaw over that of the position, of which alone the localisation tells: 0.1 degrees for
1 cm, as of two antennas 6 m apart or an inertial unit of that class."""

UNKNOWN_SIGMA_M = 0.01
"""Standard deviation of a position of which the localisation does not state any: it is taken for white noise."""

UNSTATED_M = 0.0003
"""What neither the localisation can state nor a standing car show, as both come in steps of 1 mm."""

SLOW_NOISE_M = 0.002
"""Slow noise of the position from which on it is worth to wait for it at standstill (`manoeuvre`)."""

SIDE_SLIP = 0.25e-3
"""With the yaw rate: what else moves the car aside, m per root metre of travel. Half as much would do in the scenarios;
but a yaw mounted askew or an axle out of line, which no state stands for, are to be followed too."""

SLIP_UNKNOWN = 0.5
"""Standard deviation of the rear tyres' slip before any pose of a moving car has told of it, as a share of the nominal
car's: a mass and a stiffness that are each 30 % off make it nearly twice, or half as much."""

SLIP_WALK = 0.03
"""Change of that share per root metre of travel, up to what is unknown at first: passengers get in, a tyre loses air,
and within a manoeuvre or two it is to be learnt anew."""

HEADING_WALK = 0.2e-3
"""With the yaw rate: what is left of heading that it does not show, rad per root metre."""

YAW_RATE_NOISE_RADPS = math.radians(0.02)
"""Noise of a yaw rate, a sample."""

YAW_RATE_WALK = math.radians(0.002)
"""Walk of the gyro's bias, rad/s per root second."""

BIAS_UNKNOWN_RADPS = 0.01
"""Standard deviation of the gyro's bias before it has been heard at standstill."""

ROAD_UNKNOWN_1PM = 4e-3
ROAD_SEEN_1PM = 0.5e-3
ROAD_LENGTH_M = 0.2
"""Standard deviation of the road disturbance before the yaw rate of a moving car has shown it, and after; and the way
over which it does."""

AVERAGED_POSES = 60
"""At first the poses of a standing car are averaged, so many; they show the noise, and then the filter takes over."""

COMPARED_LEAST = 40
COMPARED_MAX = 400
"""Pairs of poses that show the noise of a pose: so many at least, and at most; then a first-order filter of that
length."""

MOST_SIGMAS = 3.0
"""Where most of the poses' noise is slow, what is beyond so many standard deviations of an innovation is a jump of the
localisation, and slow noise as well. White noise goes beyond it by chance, which is to leave no trace."""

COMPARED_DOUBT = 6.0
"""The noise that pairs show may be larger by this over the root of their number: only what is beyond is slow."""

UNKNOWN_M = 1.0
UNKNOWN_RAD = 0.1
"""Before the first pose."""


class Covariance(NamedTuple):
    """Covariance of the six errors, symmetric."""

    ee: float
    ep: float
    ex: float
    ec: float
    es: float
    et: float
    pp: float
    px: float
    pc: float
    ps: float
    pt: float
    xx: float
    xc: float
    xs: float
    xt: float
    cc: float
    cs: float
    ct: float
    ss: float
    st: float
    tt: float


class PoseGains(NamedTuple):
    """What each of the six takes of the innovation in cross-track error (e) and heading (p), a pose."""

    ee: float
    ep: float
    pe: float
    pp: float
    xe: float
    xp: float
    ce: float
    cp: float
    se: float
    sp: float
    te: float
    tp: float


class SeenNoise(NamedTuple):
    """Noise of a pose as `compared` pairs of consecutive ones of a standing car show it, and the last of them.

    `stood` is 1 if the last pose was one of a car that stood.
    """

    position_m2: float
    yaw_rad2: float
    compared: int
    x_m: float
    y_m: float
    yaw_rad: float
    stood: int


class Walks(NamedTuple):
    """Without the yaw rate: noise of cross-track error (m), heading (rad), road disturbance (1/m) per root metre."""

    cross: float
    heading: float
    road: float


class Filter(NamedTuple):
    """Covariance, the gains that follow from it, and the variance (m^2) of the position's slow noise.

    Of an innovation beyond `most_*` the rest is a jump of the localisation. `with_yaw_rate` is 1 where x is the gyro's
    bias; `road_1pm2` is then the variance of the road disturbance, 1/m^2, of which the yaw rate tells.
    """

    covariance: Covariance
    gains: PoseGains
    most_cross_m: float
    most_heading_rad: float
    slow_m2: float
    road_1pm2: float
    with_yaw_rate: int


class Interval(NamedTuple):
    """`GAINS_EVERY` cycles.

    `body_m` is the way along the body (negative in reverse), `slipped_m` how far the nominal car's slip took it to the
    left on it, `poses` how many were believed, `stated_m` the standard deviation that the localisation states for a
    position (0: it does not know), `averaged` how many poses a standing car's place is the average of, `bias_averaged`
    how many yaw rates the gyro's bias is; `standstill` is 1 for a car that stands.
    """

    body_m: float
    slipped_m: float
    poses: int
    stated_m: float
    averaged: int
    bias_averaged: int
    standstill: int
    with_yaw_rate: int


def begin() -> Filter:
    """Return what is known before the first pose: nothing; a pose would be taken as it comes."""
    covariance = Covariance(
        UNKNOWN_M * UNKNOWN_M,
        0.0,
        0.0,
        0.0,
        0.0,
        0.0,
        UNKNOWN_RAD * UNKNOWN_RAD,
        0.0,
        0.0,
        0.0,
        0.0,
        0.0,
        0.0,
        0.0,
        0.0,
        SLIP_UNKNOWN * SLIP_UNKNOWN,
        0.0,
        0.0,
        0.0,
        0.0,
        0.0,
    )
    gains = PoseGains(1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    return Filter(covariance, gains, MOST_SIGMAS * UNKNOWN_M, MOST_SIGMAS * UNKNOWN_RAD, 0.0, ROAD_UNKNOWN_1PM**2, 1)


def begin_noise() -> SeenNoise:
    """Return that no pose has been seen."""
    return SeenNoise(0.0, 0.0, 0, 0.0, 0.0, 0.0, 0)


def compare(seen: SeenNoise, x_m: float, y_m: float, yaw_rad: float, is_first: bool) -> SeenNoise:
    """Return the noise after one more pose of a standing car; the first one of a stay is compared with none."""
    position_m2, yaw_rad2, compared, last_x_m, last_y_m, last_yaw_rad, stood = seen
    if stood != 0 and not is_first:
        if compared < COMPARED_MAX:
            compared += 1
        dx_m = x_m - last_x_m
        dy_m = y_m - last_y_m
        turned_rad = wrap_angle(yaw_rad - last_yaw_rad)
        # Half the square of a difference is the noise of one; of a position, two axes tell.
        position_m2 += (0.25 * (dx_m * dx_m + dy_m * dy_m) - position_m2) / compared
        yaw_rad2 += (0.5 * turned_rad * turned_rad - yaw_rad2) / compared
    return SeenNoise(position_m2, yaw_rad2, compared, x_m, y_m, yaw_rad, 1)


def moved(seen: SeenNoise) -> SeenNoise:
    """Return the same noise, of a car that does not stand (any more)."""
    return SeenNoise(seen.position_m2, seen.yaw_rad2, seen.compared, 0.0, 0.0, 0.0, 0)


def split(seen: SeenNoise, stated_m: float) -> tuple[float, float, float, float]:
    """Return variances of a pose: of position and yaw what averages out, of position and yaw what stays for seconds."""
    stated_m2 = stated_m * stated_m
    if stated_m <= 0.0:
        stated_m2 = UNKNOWN_SIGMA_M * UNKNOWN_SIGMA_M
    to_yaw = YAW_PER_POSITION_RADPM * YAW_PER_POSITION_RADPM
    least_m2 = UNSTATED_M * UNSTATED_M
    if stated_m <= 0.0 or seen.compared < COMPARED_LEAST:
        return stated_m2, to_yaw * stated_m2, least_m2, to_yaw * least_m2
    doubt = 1.0 + COMPARED_DOUBT / math.sqrt(seen.compared)
    return (
        seen.position_m2 + least_m2,
        seen.yaw_rad2 + to_yaw * least_m2,
        max(stated_m2 - doubt * seen.position_m2, least_m2),
        max(to_yaw * stated_m2 - doubt * seen.yaw_rad2, to_yaw * least_m2),
    )


def averaged(
    poses: int, position_m2: float, yaw_rad2: float, slow_m2: float, slow_rad2: float, slip2: float
) -> Covariance:
    """Return the covariance of an average of so many poses, short against `SLOW_S`: the slow noise is wholly in it.

    `slip2` is the variance of the tyres' slip, of which a standing car tells nothing.
    """
    return Covariance(
        slow_m2 + position_m2 / poses,
        0.0,
        0.0,
        0.0,
        -slow_m2,
        0.0,
        slow_rad2 + yaw_rad2 / poses,
        0.0,
        0.0,
        0.0,
        -slow_rad2,
        0.0,
        0.0,
        0.0,
        0.0,
        slip2,
        0.0,
        0.0,
        slow_m2,
        0.0,
        slow_rad2,
    )


def predict(
    before: Covariance,
    body_m: float,
    slipped_m: float,
    standstill: int,
    walks: Walks,
    with_yaw_rate: int,
    slow_m2: float,
    slow_rad2: float,
) -> Covariance:
    """Return the covariance half of `GAINS_EVERY` cycles later, after a way along the body (m).

    `slipped_m`: to the left, by the nominal car's slip.
    """
    ee, ep, ex, ec, es, et, pp, px, pc, ps, pt, xx, xc, xs, xt, cc, cs, ct, ss, st, tt = before
    way_m = abs(body_m)
    if standstill != 0:
        turn = 0.0
        cross_m2 = STANDING_WALK_M * STANDING_WALK_M * HALF_S
        heading_rad2 = YAW_PER_POSITION_RADPM * YAW_PER_POSITION_RADPM * cross_m2
        other = 0.0
        slip2 = 0.0
    elif with_yaw_rate != 0:
        turn = -HALF_S
        cross_m2 = SIDE_SLIP * SIDE_SLIP * way_m
        heading_rad2 = HEADING_WALK * HEADING_WALK * way_m
        heading_rad2 += YAW_RATE_NOISE_RADPS * YAW_RATE_NOISE_RADPS * PERIOD_S * HALF_S
        other = YAW_RATE_WALK * YAW_RATE_WALK * HALF_S
        slip2 = SLIP_WALK * SLIP_WALK * way_m
    else:
        turn = body_m
        cross_m2 = walks.cross * walks.cross * way_m
        heading_rad2 = walks.heading * walks.heading * way_m
        other = walks.road * walks.road * way_m
        slip2 = SLIP_WALK * SLIP_WALK * way_m
    # e += body_m p + aside x + slipped_m c, p += turn x.
    aside = 0.5 * body_m * turn
    kept = KEPT_HALF
    left = 1.0 - kept * kept
    # What e comes to, with each of the others as it was before.
    e_p = ep + body_m * pp + aside * px + slipped_m * pc
    e_x = ex + body_m * px + aside * xx + slipped_m * xc
    e_c = ec + body_m * pc + aside * xc + slipped_m * cc
    px_after = px + turn * xx
    return Covariance(
        ee + body_m * (ep + e_p) + aside * (ex + e_x) + slipped_m * (ec + e_c) + cross_m2,
        e_p + turn * e_x + 0.5 * body_m * heading_rad2,
        e_x,
        e_c,
        kept * (es + body_m * ps + aside * xs + slipped_m * cs),
        kept * (et + body_m * pt + aside * xt + slipped_m * ct),
        pp + turn * (px + px_after) + heading_rad2,
        px_after + 0.5 * turn * other,
        pc + turn * xc,
        kept * (ps + turn * xs),
        kept * (pt + turn * xt),
        xx + other,
        xc,
        kept * xs,
        kept * xt,
        min(cc + slip2, max(cc, SLIP_UNKNOWN * SLIP_UNKNOWN)),
        kept * cs,
        kept * ct,
        kept * kept * ss + left * slow_m2,
        kept * kept * st,
        kept * kept * tt + left * slow_rad2,
    )


def _shown(
    known: Covariance,
) -> tuple[float, float, float, float, float, float, float, float, float, float, float, float]:
    """Return the columns of P H', what a pose shows of each error: by its cross-track error e + s, its heading p + t.

    First the six of the one, then of the other.
    """
    return (
        known.ee + known.es,
        known.ep + known.ps,
        known.ex + known.xs,
        known.ec + known.cs,
        known.es + known.ss,
        known.et + known.st,
        known.ep + known.et,
        known.pp + known.pt,
        known.px + known.xt,
        known.pc + known.ct,
        known.ps + known.st,
        known.pt + known.tt,
    )


def gains_of(before: Covariance, position_m2: float, yaw_rad2: float) -> PoseGains:
    """Return the gains for a pose of which so much (variances) averages out: P H' (H P H' + R)^-1."""
    e_e, p_e, x_e, c_e, s_e, t_e, e_p, p_p, x_p, c_p, s_p, t_p = _shown(before)
    # The inverse of H P H' + R, in which e + s is the first.
    cross_m2 = e_e + s_e + position_m2
    heading_rad2 = p_p + t_p + yaw_rad2
    both = p_e + t_e
    scale = 1.0 / (cross_m2 * heading_rad2 - both * both)
    a = heading_rad2 * scale
    b = -both * scale
    c = cross_m2 * scale
    return PoseGains(
        a * e_e + b * e_p,
        b * e_e + c * e_p,
        a * p_e + b * p_p,
        b * p_e + c * p_p,
        a * x_e + b * x_p,
        b * x_e + c * x_p,
        a * c_e + b * c_p,
        b * c_e + c * c_p,
        a * s_e + b * s_p,
        b * s_e + c * s_p,
        a * t_e + b * t_p,
        b * t_e + c * t_p,
    )


def correct(before: Covariance, gains: PoseGains) -> Covariance:
    """Return the covariance after a pose, taken with the gains that are best for it: P - K H P."""
    ee, ep, ex, ec, es, et, pp, px, pc, ps, pt, xx, xc, xs, xt, cc, cs, ct, ss, st, tt = before
    g_ee, g_ep, g_pe, g_pp, g_xe, g_xp, g_ce, g_cp, g_se, g_sp, g_te, g_tp = gains
    e_e, p_e, x_e, c_e, s_e, t_e, e_p, p_p, x_p, c_p, s_p, t_p = _shown(before)
    return Covariance(
        ee - g_ee * e_e - g_ep * e_p,
        ep - g_ee * p_e - g_ep * p_p,
        ex - g_ee * x_e - g_ep * x_p,
        ec - g_ee * c_e - g_ep * c_p,
        es - g_ee * s_e - g_ep * s_p,
        et - g_ee * t_e - g_ep * t_p,
        pp - g_pe * p_e - g_pp * p_p,
        px - g_pe * x_e - g_pp * x_p,
        pc - g_pe * c_e - g_pp * c_p,
        ps - g_pe * s_e - g_pp * s_p,
        pt - g_pe * t_e - g_pp * t_p,
        xx - g_xe * x_e - g_xp * x_p,
        xc - g_xe * c_e - g_xp * c_p,
        xs - g_xe * s_e - g_xp * s_p,
        xt - g_xe * t_e - g_xp * t_p,
        cc - g_ce * c_e - g_cp * c_p,
        cs - g_ce * s_e - g_cp * s_p,
        ct - g_ce * t_e - g_cp * t_p,
        ss - g_se * s_e - g_sp * s_p,
        st - g_se * t_e - g_sp * t_p,
        tt - g_te * t_e - g_tp * t_p,
    )


def advance(state: Filter, walks: Walks, seen: SeenNoise, interval: Interval) -> Filter:
    """Return the filter after `GAINS_EVERY` cycles, with the gains for the next ones."""
    body_m, slipped_m, poses, stated_m, count, bias_count, standstill, with_yaw_rate = interval
    known = state.covariance
    position_m2, yaw_rad2, slow_m2, slow_rad2 = split(seen, stated_m)
    if standstill != 0 and 0 < count <= AVERAGED_POSES:
        known = averaged(count, position_m2, yaw_rad2, slow_m2, slow_rad2, known.cc)
    road_1pm2 = state.road_1pm2 if state.with_yaw_rate != 0 else known.xx
    if standstill != 0 or with_yaw_rate != state.with_yaw_rate:
        # At standstill the bias is the average that the estimator makes of it.
        other = road_1pm2
        if with_yaw_rate != 0:
            other = BIAS_UNKNOWN_RADPS * BIAS_UNKNOWN_RADPS
            if bias_count > 0:
                other = YAW_RATE_NOISE_RADPS * YAW_RATE_NOISE_RADPS / bias_count
        known = _with_x(known, other)
    if with_yaw_rate != 0:
        road_1pm2 = max(road_1pm2 / (1.0 + abs(body_m) / ROAD_LENGTH_M), ROAD_SEEN_1PM * ROAD_SEEN_1PM)
    if standstill == 0 or count > AVERAGED_POSES:
        half_m = body_m / 2
        slipped_half_m = slipped_m / 2
        known = predict(known, half_m, slipped_half_m, standstill, walks, with_yaw_rate, slow_m2, slow_rad2)
        if poses > 0:
            # As many poses as came meanwhile, at once: their mean, in the middle of the way.
            known = correct(known, gains_of(known, position_m2 / poses, yaw_rad2 / poses))
        known = predict(known, half_m, slipped_half_m, standstill, walks, with_yaw_rate, slow_m2, slow_rad2)
    cross_m2 = UNKNOWN_M * UNKNOWN_M
    heading_rad2 = UNKNOWN_RAD * UNKNOWN_RAD
    if slow_m2 > position_m2:
        cross_m2 = max(known.ee + 2.0 * known.es + known.ss, 0.0) + position_m2
        heading_rad2 = max(known.pp + 2.0 * known.pt + known.tt, 0.0) + yaw_rad2
    return Filter(
        known,
        gains_of(known, position_m2, yaw_rad2),
        MOST_SIGMAS * math.sqrt(cross_m2),
        MOST_SIGMAS * math.sqrt(heading_rad2),
        slow_m2,
        road_1pm2,
        with_yaw_rate,
    )


def as_they_come(seen: SeenNoise, stated_m: float, poses: int) -> Filter:
    """Return the filter of a law that does not filter: as good as one pose, or as the average of a standing car's."""
    position_m2, yaw_rad2, slow_m2, slow_rad2 = split(seen, stated_m)
    known = averaged(poses, position_m2, yaw_rad2, slow_m2, slow_rad2, SLIP_UNKNOWN * SLIP_UNKNOWN)
    _, gains, most_cross_m, most_heading_rad, _, road_1pm2, with_yaw_rate = begin()
    return Filter(known, gains, most_cross_m, most_heading_rad, slow_m2, road_1pm2, with_yaw_rate)


def _with_x(known: Covariance, variance: float) -> Covariance:
    """Return the covariance with x known so well, and of itself."""
    return Covariance(
        known.ee,
        known.ep,
        0.0,
        known.ec,
        known.es,
        known.et,
        known.pp,
        0.0,
        known.pc,
        known.ps,
        known.pt,
        variance,
        0.0,
        0.0,
        0.0,
        known.cc,
        known.cs,
        known.ct,
        known.ss,
        known.st,
        known.tt,
    )


def deviations(known: Covariance, nominal_slip_rad: float, stated_m: float) -> tuple[float, float]:
    """Return the standard deviations of cross-track (m) and heading error (rad) of the estimate.

    The heading error is that against the path and the slip there (`nominal_slip_rad`). Where the localisation states
    none of its own (`stated_m` 0), what it is assumed to have may be slow as well.
    """
    cross_m2 = max(known.ee, 0.0)  # rounding may leave a variance a little below zero
    heading_rad2 = max(known.pp - nominal_slip_rad * (2.0 * known.pc - nominal_slip_rad * known.cc), 0.0)
    if stated_m <= 0.0:
        cross_m2 += UNKNOWN_SIGMA_M * UNKNOWN_SIGMA_M
        heading_rad2 += (YAW_PER_POSITION_RADPM * UNKNOWN_SIGMA_M) ** 2
    return math.sqrt(cross_m2), math.sqrt(heading_rad2)
