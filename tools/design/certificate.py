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
    every pole of every loop is in the D-region, those of `others` included. `holds`: D-stable with at least the margins
    that the vehicle's file asks for (`Criteria`), with all localisations, or there are no tables for the vehicle.

    `others` holds the same figures for what is not the usual: the law with poses of less or of slower noise, with those
    of less noise in a bend, without the yaw rate, and the other laws. With slow noise the region asks for damped poles
    only, not for fast ones: such poses teach a gyro's bias slowly, however they are used.
    `by_speed` has the smallest disk margin and delay margin of each (direction, speed in m/s).
    """

    min_delay_margin_samples: float
    min_disk_margin: float
    min_gain_margin: float
    min_phase_margin_rad: float
    all_d_stable: bool
    holds: bool
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
    cars = criteria.corners(vehicle)
    top_mps = criteria.checked_speeds(vehicle)[-1]
    found: dict[str, list[_Found]] = {}
    tables = {law: _rows(rows, top_mps) for law, rows in gains.items()}
    for index, first in enumerate(tables["car"]):
        omega = criteria.frequencies(first.speed_mps, RESOLUTION)
        at = criteria.cars_at_speed(cars, first.speed_mps, first.direction, criteria.on_circle(omega))
        for law, rows in tables.items():
            for name, mode in criteria.MODES[law].items():
                found.setdefault(name, []).append(_found(rows[index], vehicle, mode, at, omega))
    usual = found.pop("car")
    figures = _figures(usual)
    all_d_stable = all(here.d_stable for some in (usual, *found.values()) for here in some)
    others = {name: _figures(some) for name, some in found.items()}
    must = [figures, *(others[name] for name, mode in criteria.MODES["car"].items() if mode.localisation != "white")]
    return Certificate(
        **{**figures, "all_d_stable": all_d_stable},
        holds=all_d_stable
        and min(of["min_disk_margin"] for of in must) >= vehicle.criteria.least_disk_margin
        and min(of["min_delay_margin_samples"] for of in must) >= vehicle.criteria.least_delay_margin_samples,
        others=others,
        by_speed=[(here.direction, here.speed_mps, here.least.disk, here.least.delay_samples) for here in usual],
    )


class _Found(NamedTuple):
    """The least margins of all cars under one row, each by itself, and where the disk margin is smallest."""

    direction: float
    speed_mps: float
    least: Margins
    d_stable: bool
    worst: str


def _found(row: Row, vehicle: Vehicle, mode: model.Mode, at: criteria.CarsAtSpeed, omega: Floats) -> _Found:
    law = model.controller(row, model.nominal_of(vehicle), mode)
    all_margins = []
    d_stable = True
    region = vehicle.criteria
    if mode.localisation == "slow":
        region = region.model_copy(update={"slowest_pole_1pm": 0.0})
    for plant, loop in zip(at.plants, model.loops(law, at.answers, at.z), strict=True):
        matrix = model.closed_loop(law, plant)
        stable = model.is_stable(matrix)
        d_stable = d_stable and stable and criteria.d_stable(matrix, row.speed_mps, region)
        all_margins.append(margins_of(loop, omega) if stable else UNSTABLE)
    worst = min(range(len(all_margins)), key=lambda car: all_margins[car].disk)
    return _Found(
        direction=row.direction,
        speed_mps=row.speed_mps,
        least=Margins(*(min(values) for values in zip(*all_margins, strict=True))),
        d_stable=d_stable,
        worst=f"direction {row.direction:+.0f}, {row.speed_mps:g} m/s, {at.cars[worst].name}",
    )


def _figures(found: list[_Found]) -> dict[str, Any]:
    return {
        "min_delay_margin_samples": min(here.least.delay_samples for here in found),
        "min_disk_margin": min(here.least.disk for here in found),
        "min_gain_margin": min(here.least.gain for here in found),
        "min_phase_margin_rad": min(here.least.phase_rad for here in found),
        "all_d_stable": all(here.d_stable for here in found),
        "worst": min(found, key=lambda here: here.least.disk).worst,
    }


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
