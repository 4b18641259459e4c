"""The paper's simulations: a law on eq. 11 along the path, time-varying in the speed.

The speed is held over each step and the curvature linear in it; the step itself is exact (matrix exponential), so that
the stiffness of the tyres at walking speed costs nothing. A step of 1 ms leaves an error of second order in the
changes of speed alone.
"""

from typing import NamedTuple

import numpy as np

from sim.errors import UserError
from tools.design.waypoints import Floats
from tools.paper import laws
from tools.paper.laws import ClosedLoop, Law, close_loop
from tools.paper.plant import Plant
from tools.paper.speed import Motion
from tools.paper.track import Track, curvature_at, project

STEP_S = 1e-3


class Start(NamedTuple):
    """Errors at the start: heading rad and e_y m, zero where the car starts on the path."""

    heading_rad: float = 0.0
    preview_error_m: float = 0.0


class Run(NamedTuple):
    """Histories of one simulation, arrays (n,): eq. 11's states, the steering angle, and where the car really is.

    `steer_pid_rad` is the part of the PID (with its feedforward), the rest is the observer's. `x_m, y_m, yaw_rad` is
    the pose of the centre of gravity in the direction of travel, integrated from yaw rate and side slip;
    `cross_track_error_m` its distance from the path, `station_m` the station of the nearest point there.
    """

    time_s: Floats
    travelled_m: Floats
    speed_mps: Floats
    state: Floats
    steer_rad: Floats
    steer_pid_rad: Floats
    steer_rate_radps: Floats
    x_m: Floats
    y_m: Floats
    yaw_rad: Floats
    station_m: Floats
    cross_track_error_m: Floats
    curvature_1pm: Floats

    @property
    def preview_error_m(self) -> Floats:
        """e_y of eq. 11."""
        return np.asarray(self.state[:, laws.ERROR])


class Steps:
    """Exact steps of a closed loop by speed; what was computed for a speed serves every path that is driven at it."""

    def __init__(self, plant: Plant, law: Law, step_s: float) -> None:
        self.plant, self.law, self.step_s = plant, law, step_s
        self._known: dict[float, int] = {}
        n = laws.STATES
        self._phi, self._hold, self._ramp = np.zeros((0, n, n)), np.zeros((0, n)), np.zeros((0, n))
        self._outputs: dict[float, ClosedLoop] = {}

    def at(self, speed_mps: Floats) -> tuple[Floats, Floats, Floats]:
        """Transition matrices (k, 11, 11) and the curvature's vectors (k, 11), value and increment, at speeds (k,)."""
        # Speeds that differ by rounding only are one speed: the plateau, and the ramps of different paths.
        rounded = np.round(speed_mps, 9)
        missing = [v for v in np.unique(rounded) if float(v) not in self._known]
        if missing:
            self._add(missing)
        index = [self._known[float(v)] for v in rounded]
        return self._phi[index], self._hold[index], self._ramp[index]

    def outputs(self, speed_mps: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Rows (k, 11) and curvature's factors (k,) that give the command, and the same for the PID's part of it."""
        rounded = np.round(speed_mps, 9)
        for v in map(float, np.unique(rounded)):
            if v not in self._outputs:
                self._outputs[v] = close_loop(self.plant, self.law, v)
        loops = [self._outputs[float(v)] for v in rounded]
        rows = np.array([loop.c for loop in loops]), np.array([loop.d for loop in loops])
        return *rows, np.array([loop.c_pid for loop in loops]), np.array([loop.d_pid for loop in loops])

    def _add(self, speeds_mps: list[float]) -> None:
        from scipy.linalg import expm  # noqa: PLC0415

        n, dt = laws.STATES, self.step_s
        whole = np.zeros((len(speeds_mps), n + 2, n + 2))
        for row, v in enumerate(speeds_mps):
            loop = close_loop(self.plant, self.law, float(v))
            whole[row, :n, :n] = loop.a * dt
            whole[row, :n, n] = loop.e * dt
            self._known[float(v)] = len(self._phi) + row
        whole[:, n, n + 1] = 1.0
        step = expm(whole)
        self._phi = np.concatenate([self._phi, step[:, :n, :n]])
        self._hold = np.concatenate([self._hold, step[:, :n, n]])
        self._ramp = np.concatenate([self._ramp, step[:, :n, n + 1]])


def simulate(steps: Steps, track: Track, motion: Motion, start: Start | None = None) -> Run:
    """Drive a law along a track; raises UserError where the step of `motion` is not the one of `steps`."""
    if abs(motion.step_s - steps.step_s) > 1e-12:
        raise UserError(f"simulation: steps of {steps.step_s:g} s on a motion in steps of {motion.step_s:g} s")
    start = start or Start()
    rho = curvature_at(track, motion.station_m)
    phi, hold, ramp = steps.at(motion.mid_speed_mps)
    drive = hold * rho[:-1, None] + ramp * np.diff(rho)[:, None]
    state = np.zeros((len(rho), laws.STATES))
    state[0, laws.HEADING], state[0, laws.ERROR] = start.heading_rad, start.preview_error_m
    x = state[0]
    for k, (matrix, vector) in enumerate(zip(phi, drive, strict=True)):
        x = matrix @ x + vector
        state[k + 1] = x
    steer, steer_pid = _commands(steps, motion, state, rho)
    rate = np.concatenate([[0.0], np.diff(steer) / motion.step_s])
    return _with_pose(track, motion, state, steer, steer_pid, rate, rho)


def _commands(steps: Steps, motion: Motion, state: Floats, rho: Floats) -> tuple[Floats, Floats]:
    """Steering angle and the PID's part of it from the states; the output row varies with the speed."""
    c, d, c_pid, d_pid = steps.outputs(motion.speed_mps)
    return np.sum(c * state, axis=1) + d * rho, np.sum(c_pid * state, axis=1) + d_pid * rho


def _with_pose(
    track: Track, motion: Motion, state: Floats, steer: Floats, steer_pid: Floats, rate: Floats, rho: Floats
) -> Run:
    dt = motion.step_s
    yaw_rate, beta = state[:, laws.YAW_RATE], state[:, laws.BETA]
    yaw0 = track.yaw_rad[0] + state[0, laws.HEADING]
    yaw = yaw0 + np.concatenate([[0.0], np.cumsum(0.5 * dt * (yaw_rate[1:] + yaw_rate[:-1]))])
    aside0 = state[0, laws.ERROR]
    vx, vy = motion.speed_mps * np.cos(yaw + beta), motion.speed_mps * np.sin(yaw + beta)
    x0 = track.x_m[0] - aside0 * np.sin(track.yaw_rad[0])
    y0 = track.y_m[0] + aside0 * np.cos(track.yaw_rad[0])
    x = x0 + np.concatenate([[0.0], np.cumsum(0.5 * dt * (vx[1:] + vx[:-1]))])
    y = y0 + np.concatenate([[0.0], np.cumsum(0.5 * dt * (vy[1:] + vy[:-1]))])
    on_path = project(track, x, y, motion.station_m)
    return Run(
        motion.time_s, motion.station_m, motion.speed_mps, state, steer, steer_pid, rate, x, y, yaw,
        on_path.station_m, on_path.cross_track_error_m, rho,
    )  # fmt: skip


class Figures(NamedTuple):
    """What Tables 5 and 6 hold, and the true cross-track error of the centre of gravity beside it."""

    max_e_y_m: float
    rms_e_y_m: float
    max_steer_rad: float
    max_steer_rate_radps: float
    max_cross_track_m: float
    rms_cross_track_m: float
    final_heading_error_rad: float


def figures_of(run: Run) -> Figures:
    """Reduce a run to the figures of Tables 5 and 6."""
    e = run.preview_error_m
    return Figures(
        float(np.max(np.abs(e))),
        float(np.sqrt(np.mean(e * e))),
        float(np.max(np.abs(run.steer_rad))),
        float(np.max(np.abs(run.steer_rate_radps))),
        float(np.max(np.abs(run.cross_track_error_m))),
        float(np.sqrt(np.mean(run.cross_track_error_m**2))),
        float(run.state[-1, laws.HEADING]),
    )
