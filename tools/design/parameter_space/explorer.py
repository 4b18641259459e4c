"""A page of its own, without a server, in which a reader moves speed and region and sees the admissible set move.

The set is precomputed: at each speed and point of a grid the page holds how far left all poles are, their least damping
and their greatest modulus, over all corners of the box, from `closed_loop_poles`. So the set for any shift, damping and
radius is a comparison. The boundaries are computed in the page from the loop's polynomials, with the exact delay: two
ways that must agree before the reader's eyes.
"""

from __future__ import annotations

import base64
import html
import json
import math
from collections.abc import Callable, Mapping, Sequence
from importlib.resources import files
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from sim.errors import UserError
from tools.design.parameter_space.admissible import CELLS, Case, admissible_region, checked_case
from tools.design.parameter_space.boundaries import Window
from tools.design.parameter_space.d_region import DRegion
from tools.design.parameter_space.loop import Characteristic, Floats, Pid, Plane, characteristic, plant_of
from tools.design.parameter_space.roots import closed_loop_poles, rational

TEMPLATE = "explorer.html"
FAR = 1e6
"""Stands for infinity in the page's fields."""


class Units(NamedTuple):
    """Units of the plant's input and output, for the labels of the axes; "" where they are not known."""

    plant_input: str = ""
    plant_output: str = ""

    def of(self, gain: str) -> str:
        """Unit of a gain, from output to input."""
        if not self.plant_input or not self.plant_output:
            return {"kp": "input/output", "ki": "input/(output s)", "kd": "input s/output"}[gain]
        i, o = self.plant_input, self.plant_output
        return {"kp": f"{i}/{o}", "ki": f"{i}/({o} s)", "kd": f"{i} s/{o}"}[gain]

    def label(self, gain: str) -> str:
        """Label of an axis."""
        return f"{gain} ({self.of(gain)})"


def explorer_page(
    title: str,
    plant_at: Callable[..., Any],
    speeds_mps: Sequence[float],
    planes: Sequence[Plane],
    region: DRegion,
    *,
    sigma_per_metre: bool = False,
    windows: Mapping[str, Window] | None = None,
    points: Mapping[str, tuple[float, float]] | None = None,
    box: Mapping[str, tuple[float, float]] | None = None,
    corners: Sequence[Mapping[str, float]] = (),
    pid: Pid = Pid(),  # noqa: B008 -- immutable
    delay_s: float = 0.0,
    cells: int = 61,
    units: Units = Units(),  # noqa: B008 -- immutable
    speed_name: str = "Speed V",
    speed_unit: str = "m/s",
    intro: str = "",
) -> str:
    """The page as one HTML text that needs nothing else; it opens at the middle of the speeds.

    plant_at: called with a speed alone, for the nominal plant, and for each corner of `box` and each of `corners` with
    its values as keywords. For one plant: `lambda _: plant` with one speed. region: where the sliders
    start; with `sigma_per_metre` its sigma counts per metre of travel (1/m), so that it scales with the speed. windows,
    points: by the plane's name; without them they are looked for at the first region, which must then have admissible
    gains. Raises UserError as `admissible_region` does.
    """
    if not planes or len(speeds_mps) < 1:
        raise UserError("explorer: at least one plane and one speed are needed")
    start = len(speeds_mps) // 2
    every = [*_corners(box or {}), *corners]
    content: list[dict[str, Any]] = []
    for plane in planes:
        loops = [_loops(plant_at, speed, plane, every, pid, delay_s) for speed in speeds_mps]
        cases = [
            Case(name, loop, at_speed(region, speed, sigma_per_metre))
            for speed, named in zip(speeds_mps, loops, strict=True)
            for name, loop in named
        ]
        for case in cases:
            checked_case(case)
        of_start = [case for case in cases if case.region == at_speed(region, speeds_mps[start], sigma_per_metre)]
        of_start = of_start if sigma_per_metre else [Case(n, one, region) for n, one in loops[start]]
        window, point = (windows or {}).get(plane.name), (points or {}).get(plane.name)
        if window is None or point is None:
            found = admissible_region(of_start, plane, window, cells=CELLS)
            chosen = found.choose("centre")
            window, point = found.window, point or (chosen.x, chosen.y)
        content.append(_plane_content(plane, window, loops, region, point, cells, units))
    sigmas = [plane["sigma_best"] / (speeds_mps[start] if sigma_per_metre else 1.0) for plane in content]
    sigma_max = 4.0 * region.sigma_radps if region.sigma_radps else max(sigmas)
    radii = [plane["radius_range"] for plane in content]
    least, most = min(low for low, _ in radii), max(high for _, high in radii)
    if region.bounded:
        least, most = min(least, 0.5 * region.radius_radps), max(most, 2.0 * region.radius_radps)
    data = {
        "planes": [{key: value for key, value in plane.items() if key not in SPARE} for plane in content],
        "speeds": [float(speed) for speed in speeds_mps],
        "speed_name": speed_name,
        "speed_unit": speed_unit,
        "per_metre": sigma_per_metre,
        "sigma_max": float(f"{sigma_max:.3g}") or 1.0,
        "radius_range": None if delay_s or any(p["delayed"] for p in content) else [least, most],
        "start": {
            "speed": start,
            "sigma": region.sigma_radps,
            "zeta": region.zeta,
            "radius": _finite(region.radius_radps),
            "within": _finite(region.zeta_within_radps),
        },
    }
    template = files(__package__).joinpath(TEMPLATE).read_text("utf-8")
    # "<" would end the script element from within a name.
    text = json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    page = template.replace("@TITLE@", html.escape(title)).replace("@INTRO@", html.escape(intro))
    return page.replace("@DATA@", text)


SPARE = ("sigma_best", "radius_range", "delayed")


def at_speed(region: DRegion, speed_mps: float, sigma_per_metre: bool) -> DRegion:
    """The region at a speed, where its sigma may count per metre of travel."""
    sigma = region.sigma_radps * (speed_mps if sigma_per_metre else 1.0)
    return DRegion(sigma, region.zeta, region.radius_radps, region.zeta_within_radps)


def _corners(box: Mapping[str, tuple[float, float]]) -> list[dict[str, float]]:
    return [dict(zip(sorted(box), ends, strict=True)) for ends in product(*(box[name] for name in sorted(box))) if ends]


def _loops(
    plant_at: Callable[..., Any],
    speed: float,
    plane: Plane,
    corners: Sequence[Mapping[str, float]],
    pid: Pid,
    delay_s: float,
) -> list[tuple[str, Characteristic]]:
    """The nominal loop first, then the corners."""
    found = []
    for values in ({}, *corners):
        name = ", ".join(f"{key} = {value:g}" for key, value in values.items()) or "nominal"
        plant = plant_of(plant_at(speed, **values), delay_s=delay_s, name=f"{speed:g}, {name}")
        found.append((name, characteristic(plant, plane, pid)))
    return found


def _plane_content(
    plane: Plane,
    window: Window,
    loops: list[list[tuple[str, Characteristic]]],
    region: DRegion,
    point: tuple[float, float],
    cells: int,
    units: Units,
) -> dict[str, Any]:
    x, y = np.linspace(*window[:2], cells), np.linspace(*window[2:], cells)
    grid_x, grid_y = (grid.ravel() for grid in np.meshgrid(x, y))
    frames, radii, best = [], [], 0.0
    for named in loops:
        fields = [pole_fields(loop, grid_x, grid_y, region.zeta_within_radps) for _, loop in named]
        sigma, zeta = (np.min([field[k] for field in fields], axis=0) for k in (0, 1))
        radius = np.max([field[2] for field in fields], axis=0)
        best = max(best, float(sigma.max()))
        radii += [float(np.quantile(radius[radius < FAR], q)) for q in (0.0, 0.9)] if (radius < FAR).any() else []
        reach = max(float(sigma.max()), region.sigma_radps, 1e-9)
        frames.append(
            {
                "sigma": _packed(np.clip(sigma, -reach, reach)),
                "zeta": _packed(zeta),
                "radius": _packed(np.log(np.clip(radius, 1e-12, FAR))),
                "loops": [_loop_content(loop, name) for name, loop in named],
            }
        )
    third = plane.third_name
    return {
        "name": plane.name,
        "x": units.label(plane.x),
        "y": units.label(plane.y),
        "third": f"{third} = {plane.third:g} {units.of(third)}" if plane.third else f"{third} = 0",
        "gains": [
            ["kp", units.of("kp"), _axis(plane, "kp"), plane.third],
            ["ki", units.of("ki"), _axis(plane, "ki"), plane.third],
            ["kd", units.of("kd"), _axis(plane, "kd"), plane.third],
        ],
        "window": [float(side) for side in window],
        "cells": cells,
        "point": [float(point[0]), float(point[1])],
        "frames": frames,
        "sigma_best": best,
        "radius_range": (min(radii, default=1.0), max(radii, default=10.0)),
        "delayed": any(loop.delay_s for _, loop in loops[0]),
    }


def _axis(plane: Plane, gain: str) -> str:
    return {plane.x: "x", plane.y: "y"}.get(gain, "")


def pole_fields(loop: Characteristic, x: Floats, y: Floats, within_radps: float) -> tuple[Floats, Floats, Floats]:
    """For gains of shape (n,): least -Re s, least damping of poles with |s| <= within_radps, greatest |s| of all poles.

    A gain without a loop (a leading coefficient of zero) counts as worst.
    """
    poles = closed_loop_poles(loop, x, y)
    unknown = np.isnan(poles)
    size = np.abs(poles)
    with np.errstate(invalid="ignore", divide="ignore"):
        damping = np.where(size > 0.0, -poles.real / size, 0.0)
    sigma = np.where(unknown, math.inf, -poles.real).min(axis=1)
    zeta = np.where(unknown | (size > within_radps), 1.0, damping).min(axis=1)
    radius = np.where(unknown, 0.0, size).max(axis=1)
    broken = ~np.isfinite(radius)
    return np.where(broken, -FAR, sigma), np.where(broken | np.isnan(zeta), -1.0, zeta), np.where(broken, FAR, radius)


def _packed(field: Floats) -> dict[str, Any]:
    """Sixteen bits a value between two ends, little-endian, base 64."""
    low, high = float(field.min()), float(field.max())
    span = (high - low) or 1.0
    steps = np.round((field - low) / span * 65535.0).astype("<u2")
    return {"low": low, "high": low + span, "data": base64.b64encode(steps.tobytes()).decode("ascii")}


def _loop_content(loop: Characteristic, name: str) -> dict[str, Any]:
    sizes = np.concatenate([np.abs(np.roots(part)) for part in loop[:4] if np.trim_zeros(part, "f").size > 1])
    sizes = np.concatenate([sizes, [1.0 / loop.delay_s if loop.delay_s else 1.0]])
    sizes = sizes[sizes > 0.0]
    degree = loop.degree
    lead = [float(part[len(part) - 1 - degree]) if len(part) > degree else 0.0 for part in loop[:4]]
    reaches = max(len(np.trim_zeros(part, "f")) for part in (loop.of_x, loop.of_y)) - 1
    has_infinite = not loop.period_s and (lead[2] != 0.0 or lead[3] != 0.0)
    content: dict[str, Any] = {
        "name": name,
        **_polynomials(loop),
        "delay": loop.delay_s,
        "period": loop.period_s or 0.0,
        "scales": [1e-5 * float(sizes.min()), 1e5 * float(sizes.max())],
        "lead": lead if has_infinite else None,
        "no_irb": "a sampled loop has no pole at infinity inside its region"
        if loop.period_s
        else f"the gains of this plane reach s^{reaches} at most and the leading power is s^{degree}",
    }
    if loop.delay_s:
        content["rational"] = _polynomials(rational(loop))
    return content


def _polynomials(loop: Characteristic) -> dict[str, list[float]]:
    parts = {"free": loop.free, "late": loop.late, "of_x": loop.of_x, "of_y": loop.of_y}
    return {name: [float(c) for c in part] for name, part in parts.items()}


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
