"""Where steering rates of 2 to 3 rad/s come from: free ends of the path, the start pose, the derivative's step.

A path with free ends begins with a curvature, so that e_y of a car that starts exactly on it begins with a slope of
-l_s V rho. The derivative of the PID makes a step of kd l_s V rho of it, and the "rate" of a step is the step over the
sampling interval: it grows without bound as the interval shrinks, and is no property of the control system.
"""

from typing import NamedTuple

import numpy as np

from tools.design.waypoints import Floats
from tools.paper.laws import BOTH, DOB, FEEDFORWARD, PID, Gains, Law
from tools.paper.path_study import AS_PRINTED, CORRECTED, PathResult
from tools.paper.plant import FORWARD, REVERSE, PaperCar, Plant
from tools.paper.printed import START_FORWARD, START_REVERSE, TABLES_5_6
from tools.paper.simulate import STEP_S, Run, Start, Steps, simulate
from tools.paper.speed import TABLE_3, Motion, motion
from tools.paper.track import Track, project, track_of

ON_PATH, AT_POSE = "on the path", "eq. 20 / 21"
KICK_STEPS_S = tuple(float(step) for step in np.geomspace(2e-5, 4e-3, 10))
KICK_TIME_S = 0.05
SETTLED_M = 0.5


class RateRun(NamedTuple):
    """One run: path and start, by what the start is off, and the rates; the later rate is from 0.5 m on."""

    direction: str
    path: str
    start: str
    law: str
    start_curvature_1pm: float
    start_error_m: float
    start_heading_rad: float
    max_rate_radps: float
    max_rate_later_radps: float
    max_e_y_m: float


class Rates(NamedTuple):
    """The rate study.

    runs: in steps of 1 ms. kicks_radps: largest rate in the first 0.05 s at each of kick_steps_s, by direction and law.
    printed_step_s: the step at which the PID's kick is the printed rate, by direction (None where no step gives it).
    """

    runs: list[RateRun]
    kick_steps_s: Floats
    kicks_radps: dict[str, dict[str, Floats]]
    printed_step_s: dict[str, float | None]


def start_at(track: Track, pose: tuple[float, float, float], preview_m: float) -> Start:
    """Errors of a start pose (x, y, heading of travel) against the track: eq. 20 and 21 on a path with free ends."""
    on_path = project(track, np.array([pose[0]]), np.array([pose[1]]), np.array([0.0]))
    heading = (pose[2] - float(on_path.yaw_rad[0]) + np.pi) % (2.0 * np.pi) - np.pi
    return Start(heading, float(on_path.cross_track_error_m[0]) + preview_m * heading)


def peak_rate_radps(run: Run) -> float:
    """Largest steering rate; the wheels stand straight before the start, so the first command is a change too."""
    first = abs(float(run.steer_rad[0])) / float(run.time_s[1])
    return max(first, float(np.max(np.abs(run.steer_rate_radps))))


def study_rates(car: PaperCar, gains: Gains, paths: dict[str, PathResult]) -> Rates:
    """Run all of it on the printed-sign plant."""
    runs = []
    kicks: dict[str, dict[str, Floats]] = {}
    printed_step: dict[str, float | None] = {}
    poses = {FORWARD: START_FORWARD, REVERSE: START_REVERSE}
    for direction, pose in poses.items():
        for name, start_name in ((AS_PRINTED, ON_PATH), (AS_PRINTED, AT_POSE), (CORRECTED, ON_PATH)):
            track = track_of(paths[name].path, direction)
            start = Start()
            if start_name == AT_POSE:
                start = start_at(track, pose, TABLE_3.preview_time_s * TABLE_3.min_speed_mps)
            for law in (DOB, PID, BOTH, FEEDFORWARD):
                plan = motion(track.station_m, track.curvature_1pm, TABLE_3, STEP_S)
                run = simulate(Steps(Plant(car, direction), Law(law, gains), STEP_S), track, plan, start)
                later = float(np.max(np.abs(run.steer_rate_radps[run.travelled_m > SETTLED_M])))
                runs.append(
                    RateRun(
                        direction, name, start_name, law, float(track.curvature_1pm[0]), start.preview_error_m,
                        start.heading_rad, peak_rate_radps(run), later, float(np.max(np.abs(run.preview_error_m))),
                    )
                )  # fmt: skip
        track = track_of(paths[AS_PRINTED].path, direction)
        kicks[direction] = {
            law: np.array([kick_radps(car, direction, Law(law, gains), track, step) for step in KICK_STEPS_S])
            for law in (DOB, PID, BOTH)
        }
        wanted = TABLES_5_6[direction][PID].max_steer_rate_radps
        printed_step[direction] = _step_for(wanted, kicks[direction][PID]) if car.is_papers else None
    return Rates(runs, np.array(KICK_STEPS_S), kicks, printed_step)


def kick_radps(car: PaperCar, direction: str, law: Law, track: Track, step_s: float) -> float:
    """Peak rate of the first 0.05 s from a start on the path."""
    begin = slice(0, int(np.searchsorted(track.station_m, 0.5)))
    whole = motion(track.station_m[begin], np.zeros(begin.stop), TABLE_3, step_s)
    count = min(round(KICK_TIME_S / step_s), len(whole.mid_speed_mps) - 1)
    plan = Motion(
        whole.time_s[: count + 1],
        whole.station_m[: count + 1],
        whole.speed_mps[: count + 1],
        whole.mid_speed_mps[:count],
    )
    return peak_rate_radps(simulate(Steps(Plant(car, direction), law, step_s), track, plan))


def _step_for(rate_radps: float, kicks_radps: Floats) -> float | None:
    """Sampling step at which the kick has a given rate, between the steps that were run; both fall together."""
    falling = kicks_radps[::-1]
    if not falling[0] <= rate_radps <= falling[-1]:
        return None
    return float(np.exp(np.interp(np.log(rate_radps), np.log(falling), np.log(np.array(KICK_STEPS_S)[::-1]))))
