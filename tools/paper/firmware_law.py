"""The firmware's paper law (`firmware_py.core.paper_law`): its tables, and its runs on eq. 11 at 100 Hz."""

import math
from typing import NamedTuple

import numpy as np

from firmware_py.core import paper_law
from firmware_py.core.paper_law import PERIOD_S
from firmware_py.core.tables import CarTable, PaperTable
from tools.design.waypoints import Floats
from tools.paper.laws import BOTH, DOB, PID, Gains, Law
from tools.paper.plant import FORWARD, REVERSE, PaperCar, Plant, matrices
from tools.paper.sampled import ZOH, discretise, low_pass
from tools.paper.speed import TABLE_3, motion
from tools.paper.track import Track, curvature_at

SPEEDS_MPS = tuple(float(v) for v in np.round(np.geomspace(0.05, 1.0, 25), 6))
POSITION_STEP_M, ANGLE_STEP_RAD = 1e-5, 1e-4
"""Scales of position and road-wheel angle on the bus."""
BUS_DELAY_S = 0.0035
"""Age of a report when its command leaves, in every loop on the bus."""
IMPOSSIBLE_RAD = 0.5 * math.pi
UNBOUNDED = CarTable(1.0, 0.0, 1.0, 1.0, 0.0, 0, 0, 0.0, 0.0, 0.0, 1e9, 1e12, 1.0, 1.0, 1.0)
"""A car whose steering has no limits, as in the paper: of it the law reads these two alone."""
NAMES = {"dob": DOB, "pid": PID, "paper": BOTH}
"""The firmware's names of the paper's laws."""


def tables_of(car: PaperCar, law: Law) -> PaperTable:
    """Tables by (direction, speed) of one law; reverse is eq. 11 as printed, the only one that this law can drive."""
    observer = law.observer
    q = discretise(low_pass(observer), ZOH, observer.bandwidth_radps)
    a1, a2 = -float(np.trace(q.a)), float(np.linalg.det(q.a))
    b1 = float(q.c @ q.b)
    b2 = float(q.c @ q.a @ q.b) + a1 * b1
    t = PERIOD_S
    rows: list[tuple[tuple[float, ...], ...]] = []
    for direction in (FORWARD, REVERSE):
        arm = car.rear_m if direction == FORWARD else car.front_m
        columns = []
        for v in SPEEDS_MPS:
            ahead = TABLE_3.preview_time_s * v
            # Zero-order hold of (V/L)((arm + ls) s + V)/s^2: reach (z - pole)/(z - 1)^2, in angle per e_y.
            reach = (arm + ahead) * t + 0.5 * v * t * t
            pole = ((arm + ahead) * t - 0.5 * v * t * t) / reach
            inverse_gain = car.wheelbase_m / (observer.nominal_factor * v * reach)
            columns.append((ahead, *law.gains, inverse_gain, pole))
        rows.append(tuple(columns))
    has_pid, has_observer = int(law.name != DOB), int(law.has_observer)
    return PaperTable(SPEEDS_MPS, len(SPEEDS_MPS) - 1, tuple(rows), b1, b2, a1, a2, has_pid, has_observer)


class Bus(NamedTuple):
    """What lies between law and plant: delay in s, and whether error and angle are rounded to the bus's scales."""

    name: str
    delay_s: float
    rounds: bool


BUSES = (
    Bus("100 Hz, no delay", 0.0, False),
    Bus("100 Hz on the bus: 3.5 ms, rounded", BUS_DELAY_S, True),
    Bus("the same, one sample later", BUS_DELAY_S + PERIOD_S, True),
)


class FirmwareRun(NamedTuple):
    """One run: figures (infinite where the law asked for 90 degrees), histories (k,) up to there."""

    law: str
    direction: str
    bus: str
    max_e_y_m: float
    rms_e_y_m: float
    max_steer_rad: float
    travelled_m: float
    time_s: Floats
    e_y_m: Floats
    steer_rad: Floats


def run(plant: Plant, law: Law, track: Track, bus: Bus) -> FirmwareRun:
    """Drive the firmware's law along a track on eq. 11, exact between the instants at which a command acts."""
    plan = motion(track.station_m, track.curvature_1pm, TABLE_3, PERIOD_S)
    rho = curvature_at(track, plan.station_m)
    table = tables_of(plant.car, law)
    direction = 0 if plant.direction == FORWARD else 1
    whole = math.floor(bus.delay_s / PERIOD_S + 1e-9)
    part_s = bus.delay_s - whole * PERIOD_S
    early, late = _Half(plant, part_s), _Half(plant, PERIOD_S - part_s)
    state, x = paper_law.clear(), np.zeros(4)
    sent = [0.0] * (whole + 2)  # newest first
    e_y, steer = np.zeros(len(rho) - 1), np.zeros(len(rho) - 1)
    for k in range(len(rho) - 1):
        y = float(x[3])
        if bus.rounds:
            y = round(y / POSITION_STEP_M) * POSITION_STEP_M
        state, angle = paper_law.step(table, state, UNBOUNDED, direction, float(plan.speed_mps[k]), y, 0.0)
        if bus.rounds and abs(angle) < 1e6:
            angle = round(angle / ANGLE_STEP_RAD) * ANGLE_STEP_RAD
        e_y[k], steer[k] = float(x[3]), angle
        if not abs(angle) <= IMPOSSIBLE_RAD:
            none = float("inf")
            return FirmwareRun(
                law.name, plant.direction, bus.name, none, none, none, float(plan.station_m[k]),
                plan.time_s[: k + 1], e_y[: k + 1], steer[: k + 1],
            )  # fmt: skip
        sent = [angle, *sent[:-1]]
        v, curvature = float(plan.mid_speed_mps[k]), 0.5 * float(rho[k] + rho[k + 1])
        x = early.step(x, v, sent[whole + 1], curvature)
        x = late.step(x, v, sent[whole], curvature)
    return FirmwareRun(
        law.name, plant.direction, bus.name, float(np.max(np.abs(e_y))), float(np.sqrt(np.mean(e_y * e_y))),
        float(np.max(np.abs(steer))), float(plan.station_m[-1]), plan.time_s[:-1], e_y, steer,
    )  # fmt: skip


class _Half:
    """Exact steps of eq. 11 over a part of a cycle, command and curvature held, remembered by speed."""

    def __init__(self, plant: Plant, time_s: float) -> None:
        self._plant, self._time_s = plant, time_s
        self._known: dict[float, tuple[Floats, Floats, Floats]] = {}

    def step(self, x: Floats, speed_mps: float, angle_rad: float, curvature_1pm: float) -> Floats:
        if self._time_s <= 0.0:
            return x
        key = round(speed_mps, 9)
        if key not in self._known:
            from scipy.linalg import expm  # noqa: PLC0415

            a, b, e, _ = matrices(self._plant, key)
            whole = np.zeros((6, 6))
            whole[:4, :4], whole[:4, 4], whole[:4, 5] = a, b, e
            exact = expm(whole * self._time_s)
            self._known[key] = exact[:4, :4], exact[:4, 4], exact[:4, 5]
        phi, gamma, hold = self._known[key]
        return np.asarray(phi @ x + gamma * angle_rad + hold * curvature_1pm)


def study(car: PaperCar, gains: Gains, tracks: dict[str, Track]) -> list[FirmwareRun]:
    """Every law in both directions (printed sign) behind each bus."""
    return [
        run(Plant(car, direction), Law(law, gains), tracks[direction], bus)
        for direction in (FORWARD, REVERSE)
        for law in NAMES.values()
        for bus in BUSES
    ]
