"""The paper's controllers closed around eq. 11: DOB (eq. 16, 18), PID (eq. 19), both, and PID with feedforward.

Everything is linear at a given speed, so a law and its plant are one matrix that varies with the speed. The inverse of
the nominal plant in Q/Gn is built in the model's own states (yaw rate and heading of the inverse), which stays the
inverse when the speed varies slowly; Q's own two states give the filtered e_y and its two derivatives.
"""

from typing import NamedTuple

import numpy as np

from tools.design.waypoints import Floats
from tools.paper.plant import Plant, matrices, steady_angle_per_curvature

DOB, PID, BOTH, FEEDFORWARD = "DOB", "PID", "PID+DOB", "PID+FF"
LAWS = (DOB, PID, BOTH, FEEDFORWARD)

# States: plant (beta, r, heading error, e_y), Q of e_y, Q of the command, inverse (r, heading), integral of e_y.
BETA, YAW_RATE, HEADING, ERROR, FILTERED, FILTERED_RATE, Q_U, Q_U_RATE, INV_YAW, INV_HEADING, INTEGRAL = range(11)
STATES = 11


class Gains(NamedTuple):
    """Eq. 19: kp in rad/m, ki in rad/(m s), kd in rad s/m."""

    kp: float
    ki: float
    kd: float


class Observer(NamedTuple):
    """Eq. 18 and the nominal plant: bandwidth rad/s, damping, and Gn = factor * G (Table 4 and text)."""

    bandwidth_radps: float = 100.0
    damping: float = 0.707
    nominal_factor: float = 1.01


TABLE_4_OBSERVER = Observer()


class Law(NamedTuple):
    """Which controller, with which numbers."""

    name: str
    gains: Gains
    observer: Observer = TABLE_4_OBSERVER

    @property
    def has_observer(self) -> bool:
        """Whether the disturbance observer is in the loop."""
        return self.name in (DOB, BOTH)


class ClosedLoop(NamedTuple):
    """x' = a x + e rho, command u = c x + d rho, and its parts: PID (or feedforward + PID) and what the DOB adds.

    Shapes: a (11, 11), e (11,), c (11,), d scalar, c_pid (11,), d_pid scalar.
    """

    a: Floats
    e: Floats
    c: Floats
    d: float
    c_pid: Floats
    d_pid: float


def close_loop(plant: Plant, law: Law, speed_mps: float) -> ClosedLoop:
    """Close a law around the plant at one speed."""
    a4, b4, e4, _ = matrices(plant, speed_mps)
    v, ls = speed_mps, plant.preview_time_s * speed_mps
    c_pid, d_pid = np.zeros(STATES), 0.0
    if law.name != DOB:
        kp, ki, kd = law.gains
        c_pid[:4] = -kd * a4[3]
        c_pid[ERROR] -= kp
        c_pid[INTEGRAL] = -ki
        d_pid = -kd * e4[3]
    if law.name == FEEDFORWARD:
        d_pid += steady_angle_per_curvature(plant, v)

    w, damping, factor = law.observer.bandwidth_radps, law.observer.damping, law.observer.nominal_factor
    # Second derivative of the filtered e_y, and from it the angle that the nominal plant would have needed for it.
    curve = np.zeros(STATES)
    curve[ERROR], curve[FILTERED], curve[FILTERED_RATE] = w * w, -w * w, -2.0 * damping * w
    inverse_beta = np.zeros(STATES)
    inverse_beta[FILTERED_RATE] = 1.0 / (factor * v)
    inverse_beta[INV_YAW], inverse_beta[INV_HEADING] = -ls / v, -1.0
    gain = v * b4[0] + ls * b4[1]
    angle = (curve / factor - (v * a4[0, 0] + ls * a4[1, 0]) * inverse_beta) / gain
    angle[INV_YAW] -= (v * a4[0, 1] + ls * a4[1, 1] + v) / gain

    c = c_pid.copy()
    if law.has_observer:
        c = c - angle
        c[Q_U] += 1.0
    a, e = np.zeros((STATES, STATES)), np.zeros(STATES)
    a[:4, :4] = a4
    a[:4] += np.outer(b4, c)
    e[:4] = e4 + b4 * d_pid
    a[INTEGRAL, ERROR] = 1.0
    if law.has_observer:
        a[FILTERED, FILTERED_RATE] = 1.0
        a[FILTERED_RATE] = curve
        a[Q_U, Q_U_RATE] = 1.0
        a[Q_U_RATE] = w * w * c
        a[Q_U_RATE, Q_U] -= w * w
        a[Q_U_RATE, Q_U_RATE] -= 2.0 * damping * w
        e[Q_U_RATE] = w * w * d_pid
        a[INV_YAW] = a4[1, 0] * inverse_beta + b4[1] * angle
        a[INV_YAW, INV_YAW] += a4[1, 1]
        a[INV_HEADING, INV_YAW] = 1.0
    return ClosedLoop(a, e, c, d_pid, c_pid, d_pid)
