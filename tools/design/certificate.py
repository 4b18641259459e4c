"""The certificate of a set of gains: stability margins of the whole steering loop over every car that may come true.

Every direction, speed of the gain table and middle between two speeds, each with the nominal car and all corners of the
vehicle's box (`tools.design.gains.corners`). Margins are those of the loop cut at the steering command.
"""

import math
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from sim.data_files import Vehicle
from tools.design import gains as criteria
from tools.design import model
from tools.design.model import Complexes, Floats, Row

RESOLUTION = 600
"""Frequencies a loop is computed at; margins lie within 2 % of those on ten times as many."""


class Certificate(NamedTuple):
    """The smallest margins of all loops of the law `car`, and where the disk margin is smallest.

    Delay in samples of 10 ms beyond the car's own; gain as the factor, up or down, that ends stability; the disk margin
    is the balanced one (any mixture of gain and phase). A loop that is not stable has margins of 0 (gain: 1). D-stable:
    every pole of every loop is in the D-region of `tools.design.gains`.

    `others` holds the same figures for what is not the usual: the law without the yaw rate, and the other laws.
    `by_speed` has the smallest disk margin and delay margin of each (direction, speed in m/s).
    """

    min_delay_margin_samples: float
    min_disk_margin: float
    min_gain_margin: float
    min_phase_margin_rad: float
    all_d_stable: bool
    worst: str
    others: dict[str, dict[str, Any]]
    by_speed: list[tuple[float, float, float, float]]


class Margins(NamedTuple):
    """Margins of one stable loop, as in `Certificate`."""

    delay_samples: float
    disk: float
    gain: float
    phase_rad: float


UNSTABLE = Margins(0.0, 0.0, 1.0, 0.0)


def certify(vehicle: Vehicle, gains: dict[str, list[tuple[float, ...]]]) -> Certificate:
    """Certify gain tables (`tools.design.gains.design_gains`) for a vehicle."""
    usual: Certificate | None = None
    others: dict[str, dict[str, Any]] = {}
    for law, rows in gains.items():
        for mode in criteria.MODES[law]:
            found = _certify(vehicle, rows, mode)
            if usual is None:
                usual = found
                continue
            figures = found._asdict()
            del figures["others"], figures["by_speed"]
            others[_name_of(law, mode)] = figures
    assert usual is not None
    return usual._replace(others=others, all_d_stable=usual.all_d_stable and all(o["all_d_stable"] for o in others.values()))


def _name_of(law: str, mode: model.Mode) -> str:
    return law if mode == criteria.MODES[law][0] else f"{law}, without the yaw rate"


def _certify(vehicle: Vehicle, rows: list[tuple[float, ...]], mode: model.Mode) -> Certificate:
    nominal = model.nominal_of(vehicle)
    cars = criteria.corners(vehicle)
    top_mps = criteria.checked_speeds(vehicle)[-1]
    found: list[tuple[Margins, str]] = []
    by_speed = []
    all_d_stable = True
    for row in _rows(rows, top_mps):
        where = f"direction {row.direction:+.0f}, {row.speed_mps:g} m/s"
        omega = criteria.frequencies(row.speed_mps, RESOLUTION)
        law = model.controller(row, nominal, mode)
        loops = model.loop_response(law, row, cars, criteria.on_circle(omega))
        here = []
        for car, loop in zip(cars, loops, strict=True):
            matrix = model.closed_loop(law, model.car(car, row.speed_mps, row.direction))
            stable = model.is_stable(matrix)
            all_d_stable = all_d_stable and stable and criteria.d_stable(matrix, row.speed_mps)
            here.append((margins_of(loop, omega) if stable else UNSTABLE, f"{where}, {car.name}"))
        found += here
        by_speed.append(
            (row.direction, row.speed_mps, min(m.disk for m, _ in here), min(m.delay_samples for m, _ in here))
        )
    return Certificate(
        min_delay_margin_samples=min(margins.delay_samples for margins, _ in found),
        min_disk_margin=min(margins.disk for margins, _ in found),
        min_gain_margin=min(margins.gain for margins, _ in found),
        min_phase_margin_rad=min(margins.phase_rad for margins, _ in found),
        all_d_stable=all_d_stable,
        worst=min(found, key=lambda item: item[0].disk)[1],
        others={},
        by_speed=by_speed,
    )


def _rows(rows: list[tuple[float, ...]], top_mps: float) -> list[Row]:
    """Rows of a table with travel in them, up to the car's top speed, and the middles as the firmware blends them."""
    result = []
    for before, after in pairwise(rows):
        low, high = Row(*before), Row(*after)
        if high.direction == low.direction and high.speed_mps <= top_mps:
            middle = Row(*(0.5 * (a + b) for a, b in zip(low, high, strict=True)))
            result += [middle, high]
    return result


def margins_of(loop: Complexes, omega: Floats) -> Margins:
    """Margins of a loop from its response at increasing frequencies in rad/s, shape (n,); the closed loop is stable.

    Between the frequencies the logarithm of the gain and the phase are taken as linear in the logarithm of frequency.
    """
    log_gain = np.log(np.abs(loop))
    phase = np.unwrap(np.angle(loop))
    # Gain is 1: the phase left to -180 degrees either way, and the delay that uses up the lag to it.
    at, share = _crossings(log_gain)
    angle = phase[at] + share * np.diff(phase)[at]
    rate = omega[at] * (omega[at + 1] / omega[at]) ** share
    lag_left = np.mod(angle + math.pi, 2.0 * math.pi)
    phase_margin = np.minimum(lag_left, 2.0 * math.pi - lag_left)
    delay = lag_left / rate / model.PERIOD_S
    # Phase is -180 degrees, whatever the number of turns: the gain left up or down to 1.
    gain_left = [np.array([], dtype=np.float64)]
    first, last = math.floor(float(phase.min()) / (2.0 * math.pi)) - 1, math.ceil(float(phase.max()) / (2.0 * math.pi))
    for turn in range(first, last + 1):
        at, share = _crossings(phase - (2.0 * turn + 1.0) * math.pi)
        gain_left.append(np.abs(log_gain[at] + share * np.diff(log_gain)[at]))
    return Margins(
        delay_samples=float(delay.min(initial=math.inf)),
        disk=float(criteria.disk_margin(loop)),
        gain=math.exp(float(np.concatenate(gain_left).min(initial=math.inf))),
        phase_rad=float(phase_margin.min(initial=math.inf)),
    )


def _crossings(values: Floats) -> tuple[np.ndarray[tuple[int], np.dtype[np.intp]], Floats]:
    """Indices before each change of sign, and where in the interval it is (0 to 1)."""
    at = np.flatnonzero(np.signbit(values[:-1]) != np.signbit(values[1:]))
    return at, np.asarray(values[at] / (values[at] - values[at + 1]))
