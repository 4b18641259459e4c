"""The sampled steering loop as matrices: the car, the controller as the firmware runs it, and the loop they close.

Everything is linear about a straight path at a constant speed. Angles stand for the curvatures that they make
(tan(angle) / wheelbase), so that the loop hardly depends on the wheelbase. Where the loop is cut for the margins is the
steering command on its way to the car: what the controller remembers as sent stays inside the controller.

One cycle of the controller, with y = (cross-track error, heading error) of the newest pose:

    x  <- F x + G u[k-1-n];  x <- x + L (y - H x)      observer, n = nominal latency of pose and command
    xp  = F^n x + sum F^i G u[k-1-i]                   predictor, to the instant at which this command acts
    u   = -(kp (e + sigma p h) + sigma kd h + ki I + d);  I <- I + (e + sigma p h) ds

with x = (e, h, d, c): cross-track error, heading error, curvature disturbance, and the curvature of the wheels behind
their lag. F and G are `firmware_py.core.motion.advance`, linearised; the tests hold both against each other.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from sim.data_files import Vehicle

Floats = npt.NDArray[np.float64]
Complexes = npt.NDArray[np.complex128]

PERIOD_S = 0.01
"""Cycle of the controller."""

LOOP_AGE_S = 0.0035
"""Latency of every loop besides the car's own: reports are 3 ms old when a cycle begins and its commands leave 0.5 ms
after it. The law has no model of it, so it counts as part of what the design must survive."""

STATES = 4  # of the observer: e, heading error, disturbance, curvature of the wheels


class Row(NamedTuple):
    """One row of a gain table, in the order and units of its columns (`tools.design.gains.COLUMNS`)."""

    direction: float
    speed_mps: float
    preview_m: float
    kp: float
    ki: float
    kd: float
    l_ee: float
    l_ep: float
    l_pe: float
    l_pp: float
    l_de: float
    l_dp: float


class Nominal(NamedTuple):
    """What the controller believes of the car: lag in s, latency of pose and command in whole samples."""

    steering_lag_s: float
    latency_samples: int


class Corner(NamedTuple):
    """A car that may come true. gain: curvature that it makes over the curvature that was commanded."""

    name: str
    steering_lag_s: float
    latency_samples: float
    gain: float


class StateSpace(NamedTuple):
    """Discrete-time system with the controller's period: x' = a x + b u, y = c x + d u."""

    a: Floats
    b: Floats
    c: Floats
    d: Floats


def nominal_of(vehicle: Vehicle) -> Nominal:
    """What the controller is told of a vehicle; its latencies are rounded to whole cycles."""
    return Nominal(vehicle.steering_lag_s, round(vehicle.pose_latency_samples) + round(vehicle.command_latency_samples))


# --------------------------------------------------------------------------------------------------------------------
# The car
# --------------------------------------------------------------------------------------------------------------------


def _held(speed_mps: float, sigma: float, lag_s: float, time_s: float) -> tuple[Floats, Floats]:
    """Exact motion over `time_s` with the command held: matrix (3, 3) on (e, heading error, c) and vector (3,)."""
    ds = speed_mps * time_s
    if lag_s > 0.0:
        decay = math.exp(-time_s / lag_s)
        # Distances that the wheels' own curvature works over, once and twice integrated.
        once = speed_mps * lag_s * (1.0 - decay)
        twice = speed_mps * lag_s * (ds - once)
    else:
        decay = once = twice = 0.0
    a = np.array([[1.0, sigma * ds, twice], [0.0, 1.0, sigma * once], [0.0, 0.0, decay]])
    b = np.array([0.5 * ds * ds - twice, sigma * (ds - once), 1.0 - decay])
    return a, b


def car(corner: Corner, speed_mps: float, sigma: float) -> StateSpace:
    """From the commanded curvature to (e, heading error) of the newest pose; exact, latency need not be whole.

    State: (e, heading error, c) at the pose's instant, then the commands on their way, newest first.
    """
    latency = corner.latency_samples
    whole = math.floor(latency + 1e-9)
    part = max(latency - whole, 0.0)
    late, late_b = _held(speed_mps, sigma, corner.steering_lag_s, (1.0 - part) * PERIOD_S)
    early, early_b = _held(speed_mps, sigma, corner.steering_lag_s, part * PERIOD_S)
    waiting = whole + 1 if part > 1e-9 else whole
    size = 3 + waiting
    a = np.zeros((size, size))
    b = np.zeros((size, 1))
    a[:3, :3] = late @ early
    for index, effect in ((whole, late_b), (whole + 1, late @ early_b)):
        if index == 0:
            b[:3, 0] += corner.gain * effect
        elif index <= waiting:
            a[:3, 2 + index] += corner.gain * effect
    if waiting:
        b[3, 0] = 1.0
        a[4:, 3:-1] = np.eye(waiting - 1)
    return StateSpace(a, b, np.eye(2, size), np.zeros((2, 1)))


def car_response(corner: Corner, speed_mps: float, sigma: float, z: Complexes) -> Complexes:
    """Frequency response of `car` at the points z, shape (len(z), 2)."""
    latency = corner.latency_samples
    whole = math.floor(latency + 1e-9)
    part = max(latency - whole, 0.0)
    late, late_b = _held(speed_mps, sigma, corner.steering_lag_s, (1.0 - part) * PERIOD_S)
    early, early_b = _held(speed_mps, sigma, corner.steering_lag_s, part * PERIOD_S)
    drive = late_b + np.outer(1.0 / z, late @ early_b) * (part > 1e-9)
    matrix = z[:, None, None] * np.eye(3) - late @ early
    state = np.linalg.solve(matrix, drive[:, :, None])[:, :, 0]
    return np.asarray(corner.gain * (z**-whole)[:, None] * state[:, :2])


# --------------------------------------------------------------------------------------------------------------------
# The controller
# --------------------------------------------------------------------------------------------------------------------


def motion(speed_mps: float, sigma: float, lag_s: float) -> tuple[Floats, Floats]:
    """Observer's and predictor's model of one cycle: F (4, 4) and G (4,) on (e, heading error, d, c)."""
    ds = speed_mps * PERIOD_S
    alpha, own_share = 1.0, 0.0
    if lag_s > 0.0:
        alpha = 1.0 - math.exp(-PERIOD_S / lag_s)
        own_share = lag_s / PERIOD_S * alpha
    turn = sigma * ds
    half = 0.5 * ds * ds
    f = np.array(
        [
            [1.0, turn, half, half * own_share],
            [0.0, 1.0, turn, turn * own_share],
            [0.0, 0.0, 1.0, 0.0],
            [0.0, 0.0, 0.0, 1.0 - alpha],
        ]
    )
    g = np.array([half * (1.0 - own_share), turn * (1.0 - own_share), 0.0, alpha])
    return f, g


class _Parts(NamedTuple):
    """The pieces of one controller that both of its forms are built from."""

    f: Floats
    g: Floats
    correction: Floats  # (4, 2)
    kept: Floats  # I - L H
    ahead: Floats  # F^n
    ahead_g: Floats  # (n, 4): F^i G of the i-th newest command
    preview: Floats  # row that gives the preview error
    feedback: Floats  # row that gives the curvature to take away, without the integral
    ds_m: float


def _parts(row: Row, nominal: Nominal, predicts: bool) -> _Parts:
    f, g = motion(row.speed_mps, row.direction, nominal.steering_lag_s)
    correction = np.array([[row.l_ee, row.l_ep], [row.l_pe, row.l_pp], [row.l_de, row.l_dp], [0.0, 0.0]])
    steps = nominal.latency_samples if predicts else 0
    ahead = np.eye(STATES)
    ahead_g = np.zeros((steps, STATES))
    for index in range(steps):
        ahead_g[index] = ahead @ g
        ahead = f @ ahead
    preview = np.array([1.0, row.direction * row.preview_m, 0.0, 0.0])
    feedback = row.kp * preview + np.array([0.0, row.direction * row.kd, 1.0, 0.0])
    kept = np.eye(STATES) - correction @ np.eye(2, STATES)
    return _Parts(f, g, correction, kept, ahead, ahead_g, preview, feedback, row.speed_mps * PERIOD_S)


def controller(row: Row, nominal: Nominal, predicts: bool = True) -> StateSpace:
    """From (e, heading error) of the newest pose to the commanded curvature, as the firmware runs it.

    State: the observer's (e, heading error, d, c), the commands sent, newest first, and the integral where ki > 0. A
    disturbance that nothing corrects is no state of the loop and is left out.
    """
    p = _parts(row, nominal, predicts)
    sent = nominal.latency_samples + 1
    integral = STATES + sent
    size = integral + 1
    # Observer's state and predicted state as rows over (controller's state), and over y.
    seen = np.zeros((STATES, size))
    seen[:, :STATES] = p.kept @ p.f
    seen[:, STATES + sent - 1] = p.kept @ p.g
    ahead = p.ahead @ seen
    for index, effect in enumerate(p.ahead_g):
        ahead[:, STATES + index] += effect
    ahead_y = p.ahead @ p.correction
    command = -p.feedback @ ahead
    command[integral] = -row.ki
    command_y = -p.feedback @ ahead_y
    a = np.zeros((size, size))
    b = np.zeros((size, 2))
    a[:STATES] = seen
    b[:STATES] = p.correction
    a[STATES] = command
    b[STATES] = command_y
    a[STATES + 1 : integral, STATES : integral - 1] = np.eye(sent - 1)
    a[integral] = p.ds_m * (p.preview @ ahead)
    a[integral, integral] += 1.0
    b[integral] = p.ds_m * (p.preview @ ahead_y)
    keep = [index for index in range(size) if not _idle(index, integral, row)]
    return StateSpace(a[np.ix_(keep, keep)], b[keep], command[None, keep], command_y[None, :])


def _idle(index: int, integral: int, row: Row) -> bool:
    """Whether a state of the controller takes no part: its integrator would count as a pole that never decays."""
    if index == integral:
        return row.ki == 0.0
    return index == 2 and row.l_de == 0.0 and row.l_dp == 0.0


def controller_response(row: Row, nominal: Nominal, z: Complexes, predicts: bool = True) -> Complexes:
    """Frequency response of `controller` at the points z, shape (len(z), 2)."""
    p = _parts(row, nominal, predicts)
    delayed = z ** -(nominal.latency_samples + 1)
    matrix = np.eye(STATES) - (p.kept @ p.f) / z[:, None, None]
    drive = np.empty((len(z), STATES, 3), dtype=np.complex128)
    drive[:, :, :2] = p.correction
    drive[:, :, 2] = delayed[:, None] * (p.kept @ p.g)
    if row.l_de == 0.0 and row.l_dp == 0.0:
        # The idle disturbance's row is 0 = 0 at z = 1 only; keep it solvable there.
        matrix[:, 2, 2] = 1.0
    seen = np.linalg.solve(matrix, drive)
    ahead = p.ahead @ seen
    if len(p.ahead_g):
        powers = z[:, None] ** -np.arange(1, len(p.ahead_g) + 1)
        ahead[:, :, 2] += powers @ p.ahead_g
    gain = p.feedback + np.outer(row.ki * p.ds_m / (z - 1.0), p.preview)
    effect = np.einsum("zi,zij->zj", gain, ahead)
    return np.asarray(-effect[:, :2] / (1.0 + effect[:, 2:]))


# --------------------------------------------------------------------------------------------------------------------
# The loop
# --------------------------------------------------------------------------------------------------------------------


def open_loop(row: Row, nominal: Nominal, corner: Corner, predicts: bool = True) -> StateSpace:
    """The loop cut at the steering command, from the command that the car gets to minus the one that comes back.

    Negative feedback: the loop is closed by u = -y, its characteristic is 1 + L.
    """
    plant = car(corner, row.speed_mps, row.direction)
    law = controller(row, nominal, predicts)
    n, m = len(plant.a), len(law.a)
    a = np.zeros((n + m, n + m))
    a[:n, :n] = plant.a
    a[n:, :n] = law.b @ plant.c
    a[n:, n:] = law.a
    b = np.vstack([plant.b, np.zeros((m, 1))])
    c = -np.hstack([law.d @ plant.c, law.c])
    return StateSpace(a, b, c, np.zeros((1, 1)))


def closed_loop(row: Row, nominal: Nominal, corner: Corner, predicts: bool = True) -> Floats:
    """State matrix of the closed loop."""
    loop = open_loop(row, nominal, corner, predicts)
    return np.asarray(loop.a - loop.b @ loop.c)


def loop_response(
    row: Row, nominal: Nominal, corners: Sequence[Corner], z: Complexes, predicts: bool = True
) -> Complexes:
    """L of `open_loop` at the points z for several cars under one controller, shape (len(corners), len(z))."""
    law = controller_response(row, nominal, z, predicts)
    return np.stack(
        [-np.sum(law * car_response(corner, row.speed_mps, row.direction, z), axis=1) for corner in corners]
    )


def is_stable(matrix: Floats) -> bool:
    """Whether the states of a cycle's matrix decay."""
    return bool(np.abs(np.linalg.eigvals(matrix)).max() < 1.0)


def poles_1pm(matrix: Floats, speed_mps: float) -> Complexes:
    """Eigenvalues of a cycle's matrix as poles per metre of travel, ln(z) / ds; dead-beat ones are left out."""
    z = np.linalg.eigvals(matrix).astype(np.complex128)
    # A chain of n samples has n eigenvalues at 0, which rounding spreads to eps^(1/n).
    z = z[np.abs(z) > 1e-12]
    return np.asarray(np.log(z) / (speed_mps * PERIOD_S))
