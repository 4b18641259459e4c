"""Pictures of the parameter space: the admissible set with its named boundaries, and the poles in their region."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from tools.design.parameter_space import AdmissibleRegion, DRegion, Point
from tools.plots.run import _save

COLOURS = {
    "CRB d1": "#1f6fb4",
    "CRB d2": "#d1495b",
    "CRB d3": "#7b5ea7",
    "RRB d1": "#22a6b3",
    "RRB d2": "#e59866",
    "RRB d3": "#b07cc6",
    "IRB": "#8a6d3b",
}
STYLES = {"CRB": "-", "RRB": "--", "IRB": ":"}
SET_COLOUR = "#2b8a6e"
NEAR = 6.0
"""Poles within this many times the modulus of those nearer to the origin belong to the same picture."""


def parameter_plane(
    file: Path,
    found: AdmissibleRegion,
    points: Mapping[str, Point] | None = None,
    *,
    x_label: str = "",
    y_label: str = "",
    title: str = "",
) -> None:
    """Draw the admissible set, all boundaries by name, and points with their names. Labels default to the gains."""
    figure, axes = plt.subplots(figsize=(9.0, 6.4), layout="constrained")
    draw_plane(axes, found, points, x_label=x_label, y_label=y_label)
    axes.set_title(title or _third(found), fontsize=11)
    _save(figure, file)


def draw_plane(
    axes: Axes,
    found: AdmissibleRegion,
    points: Mapping[str, Point] | None = None,
    *,
    x_label: str = "",
    y_label: str = "",
) -> None:
    """The same into given axes."""
    spread = np.quantile(np.abs(found.margin[np.isfinite(found.margin)]), 0.5) or 1.0
    shown = np.clip(found.margin, -spread, spread)
    axes.contourf(found.x, found.y, shown, levels=[0.0, 2.0 * spread], colors=[SET_COLOUR], alpha=0.22)
    axes.fill([], [], color=SET_COLOUR, alpha=0.22, label="admissible")
    many = len({boundary.case for boundary in found.boundaries}) > 1
    named: set[str] = set()
    for boundary in found.boundaries:
        label = None if boundary.name in named else boundary.name
        named.add(boundary.name)
        axes.plot(
            boundary.x, boundary.y, STYLES[boundary.kind], color=COLOURS[boundary.name],
            lw=0.9 if many else 2.0, alpha=0.7 if many else 1.0, label=label,
        )  # fmt: skip
    for name, point in (points or {}).items():
        axes.plot(point.x, point.y, "o", ms=8, mfc="#1d2733", mec="white", mew=1.5, zorder=5, label=name, ls="none")
    axes.set_xlim(found.window.x_low, found.window.x_high)
    axes.set_ylim(found.window.y_low, found.window.y_high)
    axes.set_xlabel(x_label or found.plane.x)
    axes.set_ylabel(y_label or found.plane.y)
    axes.grid(visible=True, alpha=0.3)
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=9, frameon=False)


def poles_in_region(
    file: Path, region: DRegion, poles: Mapping[str, Sequence[complex] | np.ndarray[Any, Any]], *, title: str = ""
) -> None:
    """Draw the region with its edges named d1, d2, d3, and poles near the origin by case; far ones are counted."""
    figure, axes = plt.subplots(figsize=(7.0, 6.0), layout="constrained")
    draw_poles(axes, region, poles)
    axes.set_title(title or region.text(), fontsize=11)
    _save(figure, file)


def draw_poles(
    axes: Axes, region: DRegion, poles: Mapping[str, Sequence[complex] | np.ndarray[Any, Any]] | None = None
) -> None:
    """The same into given axes; without poles the region alone."""
    everything = np.concatenate([np.asarray(some, dtype=complex) for some in (poles or {}).values()] or [np.zeros(0)])
    sizes = np.sort(np.abs(everything))
    reach = max(region.sigma_radps, float(sizes[0]) if sizes.size else 0.0) or 1.0
    for size in sizes:
        reach = max(reach, float(size)) if size <= NEAR * reach else reach
    if region.bounded and region.radius_radps < 3.0 * reach:
        reach = region.radius_radps
    reach *= 1.3
    edge = region.outline(4.0 * reach, 400)
    closing = [] if region.bounded else [-9.0 * reach + 9.0j * reach, -9.0 * reach - 9.0j * reach]
    area = np.concatenate([edge, closing])
    axes.fill(area.real, area.imag, color=SET_COLOUR, alpha=0.14, lw=0, label="region for the poles")
    named: set[str] = set()
    for piece in region.pieces():
        line = piece.point(np.linspace(piece.start, min(piece.stop, piece.start + 4.0 * reach), 200))
        colour = COLOURS[f"CRB {piece.name}"]
        for side in (line, np.conj(line)):
            label = None if piece.name in named else f"{piece.name}: {MEANING[piece.name]}"
            axes.plot(side.real, side.imag, color=colour, lw=2.0, label=label)
            named.add(piece.name)
    for name, some in (poles or {}).items():
        known = np.asarray(some, dtype=complex)
        far = int((np.abs(known) > reach).sum())
        axes.plot(
            known.real, known.imag, "x", ms=8, mew=2.0,
            label=f"poles{f', {name}' if name else ''}" + (f" ({far} farther out)" if far else ""),
        )  # fmt: skip
    axes.axhline(0.0, color="#8793a0", lw=0.8)
    axes.axvline(0.0, color="#8793a0", lw=0.8)
    axes.set(
        xlim=(-reach, 0.45 * reach), ylim=(-0.72 * reach, 0.72 * reach), xlabel="Re s (rad/s)", ylabel="Im s (rad/s)"
    )
    axes.set_aspect("equal")
    axes.grid(visible=True, alpha=0.3)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.1), fontsize=9, frameon=False, ncols=2)


MEANING = {"d1": "shift", "d2": "damping", "d3": "radius"}


def _third(found: AdmissibleRegion) -> str:
    return f"{found.plane.name} plane at {found.plane.third_name} = {found.plane.third:g}"
