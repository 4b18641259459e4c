"""The certificate of a set of gains: stability margins of the whole steering loop over every car that may come true.

Every direction, speed of the gain table and middle between two speeds, each with the nominal car and all corners of the
vehicle's box (`tools.design.box`). Margins are those of the loop cut at the steering command.
"""

from itertools import pairwise
from typing import Any, NamedTuple

from sim.data_files import Vehicle
from tools.design import gains as criteria
from tools.design import model
from tools.design.box import CarsAtSpeed, cars_at_speed, corners
from tools.design.margins import UNSTABLE, Margins, frequencies, margins_of, on_circle
from tools.design.model import Floats, Row

RESOLUTION = 600
"""Frequencies a loop is computed at; margins lie within 2 % of those on ten times as many."""


class Certificate(NamedTuple):
    """The smallest margins of all loops of the law `car`, and where the disk margin is smallest.

    Delay in samples of 10 ms beyond the car's own; gain as the factor, up or down, that ends stability; the disk margin
    is the balanced one (any mixture of gain and phase). A loop that is not stable has margins of 0 (gain: 1). D-stable:
    every pole of every loop is in the D-region, those of `others` included. `holds`: D-stable with at least the margins
    that the vehicle's file asks for (`Criteria`), with all localisations and in bends, or there are no tables for the
    vehicle. `lacks` says, a line each, which mode has too little of what, and where.

    `others` holds the same figures for what is not the usual: the law with poses of less or of slower noise, in a bend,
    without the yaw rate, and the other laws.
    `by_speed` has the smallest disk margin and delay margin of each (direction, speed in m/s).
    """

    min_delay_margin_samples: float
    min_disk_margin: float
    min_gain_margin: float
    min_phase_margin_rad: float
    all_d_stable: bool
    holds: bool
    lacks: list[str]
    worst: str
    others: dict[str, dict[str, Any]]
    by_speed: list[tuple[float, float, float, float]]


def certify(vehicle: Vehicle, gains: dict[str, list[tuple[float, ...]]]) -> Certificate:
    """Certify gain tables (`tools.design.gains.design_gains`) for a vehicle."""
    cars = corners(vehicle)
    top_mps = criteria.checked_speeds(vehicle)[-1]
    found: dict[str, list[_Found]] = {}
    tables = {law: _rows(rows, top_mps) for law, rows in gains.items()}
    for index, first in enumerate(tables["car"]):
        omega = frequencies(first.speed_mps, RESOLUTION)
        at = cars_at_speed(cars, first.speed_mps, first.direction, on_circle(omega))
        for law, rows in tables.items():
            for name, mode in criteria.MODES[law].items():
                found.setdefault(name, []).append(_found(rows[index], vehicle, mode, at, omega))
    lacks = [line for name, some in found.items() for line in _lacks(name, some, vehicle)]
    usual = found.pop("car")
    return Certificate(
        **{**_figures(usual), "all_d_stable": all(here.d_stable for some in (usual, *found.values()) for here in some)},
        holds=not lacks,
        lacks=lacks,
        others={name: _figures(some) for name, some in found.items()},
        by_speed=[(here.direction, here.speed_mps, here.least.disk, here.least.delay_samples) for here in usual],
    )


class _Found(NamedTuple):
    """The least margins of all cars under one row, each by itself, and where the disk margin is smallest."""

    direction: float
    speed_mps: float
    least: Margins
    d_stable: bool
    worst_car: str


def _found(row: Row, vehicle: Vehicle, mode: model.Mode, at: CarsAtSpeed, omega: Floats) -> _Found:
    law = model.controller(row, model.nominal_of(vehicle), mode)
    all_margins = []
    d_stable = True
    region = criteria.region_of(vehicle.criteria, mode)
    for plant, loop in zip(at.plants, model.loops(law, at.answers, at.z), strict=True):
        poles = model.poles_1pm(model.closed_loop(law, plant), row.speed_mps)
        stable = float(poles.real.max()) < 0.0
        d_stable = d_stable and stable and criteria.in_region(poles, row.speed_mps, region)
        all_margins.append(margins_of(loop, omega) if stable else UNSTABLE)
    worst = min(range(len(all_margins)), key=lambda car: all_margins[car].disk)
    return _Found(
        direction=row.direction,
        speed_mps=row.speed_mps,
        least=Margins(*(min(values) for values in zip(*all_margins, strict=True))),
        d_stable=d_stable,
        worst_car=at.cars[worst].name,
    )


def _lacks(name: str, found: list[_Found], vehicle: Vehicle) -> list[str]:
    """What a mode has too little of, a line each; the margins are asked of the law `car` with a yaw rate."""
    lines = []
    outside = next((here for here in found if not here.d_stable), None)
    if outside is not None:
        lines.append(f"{name}: poles outside the D-region ({_place(outside)})")
    mode = criteria.MODES["car"].get(name)
    if mode is not None and mode.with_yaw_rate:
        asked = vehicle.criteria
        disk = min(here.least.disk for here in found)
        if disk < asked.least_disk_margin:
            lines.append(f"{name}: disk margin {disk:.2f} must be {asked.least_disk_margin:g} ({_worst(found)})")
        latest = min(found, key=lambda here: here.least.delay_samples)
        delay = latest.least.delay_samples
        if delay < asked.least_delay_margin_samples:
            least = f"{asked.least_delay_margin_samples:g} samples"
            lines.append(f"{name}: delay margin {delay:.1f} must be {least} ({_place(latest)})")
    return lines


def _worst(found: list[_Found]) -> str:
    here = min(found, key=lambda here: here.least.disk)
    return f"{_place(here)}, {here.worst_car}"


def _place(here: _Found) -> str:
    return f"direction {here.direction:+.0f}, {here.speed_mps:g} m/s"


def _figures(found: list[_Found]) -> dict[str, Any]:
    return {
        "min_delay_margin_samples": min(here.least.delay_samples for here in found),
        "min_disk_margin": min(here.least.disk for here in found),
        "min_gain_margin": min(here.least.gain for here in found),
        "min_phase_margin_rad": min(here.least.phase_rad for here in found),
        "all_d_stable": all(here.d_stable for here in found),
        "worst": _worst(found),
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
