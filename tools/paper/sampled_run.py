"""The paper's simulations again with the controller at 100 Hz: what delay and lag leave of Tables 5 and 6."""

from collections import deque
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from tools.design.waypoints import Floats
from tools.paper.laws import BOTH, DOB, PID, Gains, Law
from tools.paper.plant import Plant, matrices
from tools.paper.sampled import KINEMATIC, PERIOD_S, Path, observer_at, pid_at
from tools.paper.speed import TABLE_3, motion
from tools.paper.track import Track, curvature_at

PATHS = (Path(0), Path(1), Path(2), Path(0, 0.02), Path(0, 0.05), Path(1, 0.05), Path(2, 0.1))
BANDWIDTHS_RADPS = (100.0, 50.0, 20.0, 10.0)
IMPOSSIBLE_RAD = 0.5 * np.pi
"""No wheel turns further; a loop that asks for more has failed, and its run ends."""


class SampledRun(NamedTuple):
    """One run: figures, or infinite where the loop asked for an impossible angle; histories (k,) up to there."""

    law: str
    bandwidth_radps: float
    path: Path
    max_e_y_m: float
    rms_e_y_m: float
    max_steer_rad: float
    time_s: Floats
    e_y_m: Floats
    steer_rad: Floats


def run(plant: Plant, law: Law, track: Track, path: Path, method: str = KINEMATIC) -> SampledRun:
    """Drive one law along a track with a tick of 10 ms; the plant is exact between the ticks."""
    plan = motion(track.station_m, track.curvature_1pm, TABLE_3, PERIOD_S)
    rho = curvature_at(track, plan.station_m)
    speeds, index = np.unique(np.round(plan.mid_speed_mps, 9), return_inverse=True)
    steps = [_plant_step(plant, float(v), path) for v in speeds]
    pid = pid_at(law)
    observers = [_observer_at(plant, law.observer, float(v), method) for v in speeds] if law.has_observer else []
    size = 5 if path.lag_s > 0.0 else 4
    x, x_pid = np.zeros(size), np.zeros(len(pid.b))
    x_q = np.zeros(len(observers[0][0].b)) if observers else np.zeros(0)
    x_f = np.zeros(len(observers[0][1].b)) if observers else np.zeros(0)
    waiting = deque([0.0] * path.delay_samples)
    e_y, steer = np.zeros(len(index)), np.zeros(len(index))
    for k, row in enumerate(index):
        y = float(x[3])
        u = 0.0
        if law.name != DOB:
            u = -float(pid.c @ x_pid) - pid.d * y
            x_pid = pid.a @ x_pid + pid.b * y
        if observers:
            q, f = observers[row]
            u = (u - float(f.c @ x_f) - f.d * y + float(q.c @ x_q)) / (1.0 - q.d)
            x_f, x_q = f.a @ x_f + f.b * y, q.a @ x_q + q.b * u
        e_y[k], steer[k] = y, u
        if not abs(u) <= IMPOSSIBLE_RAD:
            return SampledRun(
                law.name, law.observer.bandwidth_radps, path, np.inf, np.inf, np.inf,
                plan.time_s[: k + 1], e_y[: k + 1], steer[: k + 1],
            )  # fmt: skip
        waiting.append(u)
        phi, gamma, hold, ramp = steps[row]
        x = phi @ x + gamma * waiting.popleft() + hold * rho[k] + ramp * (rho[k + 1] - rho[k])
    return SampledRun(
        law.name, law.observer.bandwidth_radps, path, float(np.max(np.abs(e_y))), float(np.sqrt(np.mean(e_y * e_y))),
        float(np.max(np.abs(steer))), plan.time_s[: len(e_y)], e_y, steer,
    )  # fmt: skip


@lru_cache(maxsize=4096)
def _plant_step(plant: Plant, speed_mps: float, path: Path) -> tuple[Floats, Floats, Floats, Floats]:
    """Exact step of 10 ms: transition, held command, and curvature (value and increment)."""
    from scipy.linalg import expm  # noqa: PLC0415

    a4, b4, e4, _ = matrices(plant, speed_mps)
    n = 5 if path.lag_s > 0.0 else 4
    whole = np.zeros((n + 3, n + 3))
    whole[:4, :4] = a4
    if path.lag_s > 0.0:
        whole[:4, 4], whole[4, 4], whole[4, n] = b4, -1.0 / path.lag_s, 1.0 / path.lag_s
    else:
        whole[:4, n] = b4
    whole[:4, n + 1] = e4
    whole[n + 1, n + 2] = 1.0 / PERIOD_S
    step = expm(whole * PERIOD_S)
    return step[:n, :n], step[:n, n], step[:n, n + 1], step[:n, n + 2]


_observer_at = lru_cache(maxsize=4096)(observer_at)


def study(plant: Plant, gains: Gains, track: Track) -> list[SampledRun]:
    """Every bandwidth with every delay and lag, and the PID alone."""
    runs = [run(plant, Law(PID, gains), track, path) for path in PATHS]
    for bandwidth in BANDWIDTHS_RADPS:
        law = Law(BOTH, gains)
        law = law._replace(observer=law.observer._replace(bandwidth_radps=bandwidth))
        runs += [run(plant, law, track, path) for path in PATHS]
    return runs
