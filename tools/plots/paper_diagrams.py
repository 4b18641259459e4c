"""Figures 6 and 8 to 10 of the paper: the path-tracking scenario and the block diagrams, drawn as diagrams."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Arc, Circle, FancyBboxPatch, Polygon

from tools.plots.paper_style import BLUE, GREEN, GREY, INK, ORANGE, RED, save, sheet

Point = tuple[float, float]


def _canvas(width: float, height: float) -> tuple[Any, Axes]:
    figure, axes = sheet(width=width, height=height)
    axes.set(xlim=(0.0, width), ylim=(0.0, height))
    axes.set_aspect("equal")
    axes.axis("off")
    return figure, axes


def _box(axes: Axes, at: Point, text: str, *, width: float = 1.3, height: float = 0.8, colour: str = BLUE) -> None:
    x, y = at
    axes.add_patch(
        FancyBboxPatch(
            (x - 0.5 * width, y - 0.5 * height),
            width,
            height,
            boxstyle="round,pad=0,rounding_size=0.08",
            fc=colour + "1c",
            ec=colour,
            lw=1.8,
            zorder=3,
        )
    )
    axes.text(x, y, text, ha="center", va="center", fontsize=13, color=INK, zorder=4)


def _sum(axes: Axes, at: Point, signs: dict[str, str]) -> None:
    axes.add_patch(Circle(at, 0.16, fc="white", ec=INK, lw=1.6, zorder=3))
    offset = {"left": (-0.32, 0.16), "top": (0.18, 0.3), "bottom": (0.18, -0.32), "right": (0.32, 0.16)}
    for side, sign in signs.items():
        axes.text(at[0] + offset[side][0], at[1] + offset[side][1], sign, ha="center", va="center", fontsize=12)


def _wire(axes: Axes, *points: Point, arrow: bool = True, text: str = "", colour: str = INK) -> None:
    x, y = zip(*points, strict=True)
    axes.plot(x[:-1] if arrow else x, y[:-1] if arrow else y, color=colour, lw=1.6, zorder=2, solid_capstyle="round")
    if arrow:
        axes.annotate(
            "",
            points[-1],
            points[-2],
            zorder=2,
            arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.6, "shrinkA": 0, "shrinkB": 0},
        )
    if text:
        middle = 0.5 * (np.array(points[0]) + np.array(points[1]))
        axes.text(middle[0], middle[1] + 0.16, text, ha="center", va="bottom", fontsize=12.5, color=colour)


def _dot(axes: Axes, at: Point) -> None:
    axes.add_patch(Circle(at, 0.05, color=INK, zorder=3))


def figure_6(stem: Path) -> None:
    """The path-tracking scenario, with the point that the paper brings to the path and the one that it leaves aside."""
    figure, axes = sheet(width=11.0, height=5.0)
    s = np.linspace(-1.0, 9.5, 200)
    k = 0.045
    axes.plot(s, 0.5 * k * s**2, color=INK, lw=2.4)
    axes.text(9.0, 0.5 * k * 81 + 0.25, "path", fontsize=12)
    heading, ahead = 0.36, 3.0
    cg = np.array([3.0, 1.15])
    along, aside = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
    for arm in (-2.0, 2.0):
        axle = cg + arm * along
        axes.plot(*zip(axle - 0.75 * aside, axle + 0.75 * aside, strict=True), color=GREY, lw=2)
        angle = heading + (0.3 if arm > 0 else 0.0)
        for end in (-0.75, 0.75):
            wheel = axle + end * aside
            d = 0.38 * np.array([np.cos(angle), np.sin(angle)])
            axes.plot(*zip(wheel - d, wheel + d, strict=True), color=INK, lw=6, solid_capstyle="round")
    corners = [cg + a * along + b * aside for a, b in ((-2.7, -0.9), (2.7, -0.9), (2.7, 0.9), (-2.7, 0.9))]
    axes.add_patch(Polygon(corners, fc=BLUE + "14", ec=BLUE, lw=1.6))
    axes.plot(*cg, "o", color=BLUE, ms=8, zorder=6)
    axes.annotate("CG", cg, (-16, 12), textcoords="offset points", fontsize=12, color=BLUE)
    preview = cg + (ahead + 1.2) * along
    axes.plot(*zip(cg, preview, strict=True), color=RED, lw=1.5, ls="--")
    axes.plot(*preview, "o", color=RED, ms=8, zorder=6)
    axes.annotate("preview point", preview, (10, 4), textcoords="offset points", color=RED, fontsize=12)
    foot_s = 3.45
    foot = np.array([foot_s, 0.5 * k * foot_s**2])
    slope = np.arctan(k * foot_s)
    tangent = np.array([np.cos(slope), np.sin(slope)])
    axes.plot(*zip(foot - 1.5 * tangent, foot + 5.6 * tangent, strict=True), color=GREY, lw=1.2, ls="-.")
    axes.text(*(foot + 5.65 * tangent), "tangent at\nthe foot point", color=GREY, fontsize=10.5, va="center")
    reach = float((preview - foot) @ tangent)
    below = foot + reach * tangent
    axes.annotate("", below, preview, arrowprops={"arrowstyle": "<->", "color": RED, "lw": 1.6})
    axes.text(*(0.5 * (below + preview) + (0.15, -0.05)), r"$e_y$", color=RED, fontsize=16)
    near = foot + float((cg - foot) @ tangent) * tangent
    axes.annotate("", near, cg, arrowprops={"arrowstyle": "<->", "color": ORANGE, "lw": 1.6})
    axes.text(*(0.5 * (near + cg) + (-1.75, -0.1)), "true error", color=ORANGE, fontsize=12)
    axes.text(*(0.5 * (cg + preview) + 0.3 * aside + 0.9 * along), r"$l_s = K V$", color=RED, fontsize=13)
    course_angle = heading - 0.26
    tip = cg + 2.3 * np.array([np.cos(course_angle), np.sin(course_angle)])
    axes.annotate("", tip, cg, arrowprops={"arrowstyle": "-|>", "color": GREEN, "lw": 2})
    axes.text(*(tip + np.array([-0.1, -0.42])), r"$V$", color=GREEN, fontsize=14)
    axes.add_patch(
        Arc(tuple(cg), 3.0, 3.0, theta1=np.degrees(course_angle), theta2=np.degrees(heading), color=GREEN, lw=1.4)
    )
    axes.text(
        *(cg + 1.62 * np.array([np.cos(heading - 0.12), np.sin(heading - 0.12)])), r"$-\beta$", color=GREEN, fontsize=12
    )
    wheel = cg + 2.0 * along + 0.75 * aside
    axes.text(*(wheel + np.array([-0.1, 0.5])), r"$\delta_f$", fontsize=14)
    rear = cg - 2.0 * along
    axes.plot(*rear, "s", color=GREEN, ms=8, zorder=6)
    axes.annotate(
        "rear axle: the point\nthat should be tracked",
        rear,
        (-150, 70),
        textcoords="offset points",
        color=GREEN,
        fontsize=11,
        arrowprops={"arrowstyle": "-", "color": GREEN},
    )
    axes.set_aspect("equal")
    axes.set(xlim=(-1.2, 11.2), ylim=(-1.0, 4.6))
    axes.axis("off")
    save(figure, stem)


def figure_8(stem: Path) -> None:
    """Plant with multiplicative uncertainty and output disturbance."""
    figure, axes = _canvas(9.0, 2.8)
    y = 1.0
    _box(axes, (5.0, y), r"$G_n$")
    _box(axes, (3.2, y + 1.1), r"$\Delta_m$", colour=ORANGE)
    _sum(axes, (4.0, y), {"left": "+", "top": "+"})
    _sum(axes, (7.0, y), {"left": "+", "top": "+"})
    _wire(axes, (0.6, y), (1.6, y), arrow=False, text="u")
    _wire(axes, (1.6, y), (3.84, y))
    _dot(axes, (1.9, y))
    _wire(axes, (1.9, y), (1.9, y + 1.1), (2.55, y + 1.1))
    _wire(axes, (3.85, y + 1.1), (4.0, y + 1.1), (4.0, y + 0.16))
    _wire(axes, (4.16, y), (4.35, y))
    _wire(axes, (5.65, y), (6.84, y))
    _wire(axes, (7.0, 2.4), (7.0, y + 0.16))
    axes.text(7.15, 2.3, "d", fontsize=13, color=RED)
    _wire(axes, (7.16, y), (8.6, y))
    axes.text(8.3, y + 0.15, "y", fontsize=13)
    axes.text(5.0, 0.25, r"$G = G_n(1 + \Delta_m)$", ha="center", fontsize=12, color=GREY)
    save(figure, stem)


def _dob(axes: Axes, x: float, y: float) -> None:
    """The observer's loop with its command summing point at (x, y); the output leaves at x + 6.6."""
    _sum(axes, (x, y), {"left": "+", "bottom": "+"})
    _box(axes, (x + 2.6, y), r"$G$")
    _sum(axes, (x + 4.6, y), {"left": "+", "top": "+"})
    _wire(axes, (x + 0.16, y), (x + 1.95, y), text="u")
    _dot(axes, (x + 1.2, y))
    _wire(axes, (x + 3.25, y), (x + 4.44, y))
    _wire(axes, (x + 4.6, y + 1.2), (x + 4.6, y + 0.16))
    axes.text(x + 4.75, y + 1.05, "d", fontsize=13, color=RED)
    _wire(axes, (x + 4.76, y), (x + 6.6, y))
    axes.text(x + 6.4, y + 0.15, "y", fontsize=13)
    _dot(axes, (x + 5.6, y))
    _sum(axes, (x + 5.6, y - 1.9), {"top": "+", "right": "+"})
    _wire(axes, (x + 5.6, y), (x + 5.6, y - 1.74))
    _wire(axes, (x + 6.6, y - 1.9), (x + 5.76, y - 1.9))
    axes.text(x + 6.7, y - 1.9, "n", fontsize=13, va="center", color=ORANGE)
    _box(axes, (x + 3.6, y - 1.9), r"$Q / G_n$", colour=GREEN)
    _box(axes, (x + 1.2, y - 0.95), r"$Q$", width=0.8, height=0.6, colour=GREEN)
    _wire(axes, (x + 5.44, y - 1.9), (x + 4.25, y - 1.9))
    _wire(axes, (x + 1.2, y), (x + 1.2, y - 0.65))
    _sum(axes, (x + 1.2, y - 1.9), {"top": "+", "right": "-"})
    _wire(axes, (x + 1.2, y - 1.25), (x + 1.2, y - 1.74))
    _wire(axes, (x + 2.95, y - 1.9), (x + 1.36, y - 1.9))
    _wire(axes, (x + 1.04, y - 1.9), (x, y - 1.9), (x, y - 0.16))


def figure_9(stem: Path) -> None:
    """The disturbance observer, eq. 16."""
    figure, axes = _canvas(10.0, 4.6)
    _wire(axes, (0.5, 3.2), (1.64, 3.2), text=r"$u_n$")
    _dob(axes, 1.8, 3.2)
    axes.text(5.0, 0.15, r"$u = u_n - \frac{Q}{G_n} y + Q u$   (eq. 16)", ha="center", fontsize=13, color=GREY)
    save(figure, stem)


def figure_10(stem: Path) -> None:
    """Observer and feedback controller."""
    figure, axes = _canvas(13.0, 4.6)
    y = 3.3
    _wire(axes, (0.3, y), (1.34, y), text="r = 0")
    _sum(axes, (1.5, y), {"left": "+", "bottom": "-"})
    _box(axes, (2.9, y), r"$C$", colour=RED)
    _wire(axes, (1.66, y), (2.25, y))
    _wire(axes, (3.55, y), (4.74, y), text=r"$u_n$")
    _dob(axes, 4.9, y)
    _dot(axes, (11.1, y))
    _wire(axes, (11.1, y), (11.1, 0.45), (1.5, 0.45), (1.5, y - 0.16))
    axes.text(
        6.2,
        0.52,
        r"$C = k_p + k_i/s + k_d s$   (eq. 19),   $u_n = \delta_f$,   $y = e_y$,   $d$: path curvature",
        ha="center",
        va="bottom",
        fontsize=12,
        color=GREY,
    )
    save(figure, stem)
