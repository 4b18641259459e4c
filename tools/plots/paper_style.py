"""One look for all pictures of the paper's study: colours, sizes, and a picture saved as SVG and PNG at once."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Polygon

from sim.body import Outline, polygon
from sim.data_files import Course, Side

INK, GREY, PALE = "#1d2733", "#8793a0", "#d5dbe2"
BLUE, RED, GREEN, ORANGE, PURPLE = "#1f6fb4", "#d1495b", "#2b8a6e", "#e08a1e", "#7b5ea7"
SERIES = (BLUE, RED, GREEN, ORANGE, PURPLE, "#22a6b3", "#8a6d3b")
CONE = "#f07f13"
PNG_DPI = 150

mpl.rcParams.update(
    {
        "font.size": 10.5,
        "axes.titlesize": 11.5,
        "axes.titleweight": "bold",
        "axes.titlelocation": "left",
        "axes.edgecolor": GREY,
        "axes.labelcolor": INK,
        "axes.prop_cycle": cycler(color=SERIES),
        "axes.spines.top": False,
        "axes.spines.right": False,
        "grid.color": PALE,
        "grid.linewidth": 0.7,
        "legend.frameon": False,
        "legend.fontsize": 9.5,
        "xtick.color": INK,
        "ytick.color": INK,
        "svg.hashsalt": "parkctl",
        "svg.fonttype": "path",
    }
)


def sheet(rows: int = 1, columns: int = 1, *, width: float = 10.0, height: float = 4.0, **options: Any) -> Any:
    """Return (figure, axes) with the common layout; axes as an array where there is more than one."""
    return plt.subplots(rows, columns, figsize=(width, height), layout="constrained", **options)


def finish(axes: Axes, x: str, y: str, title: str = "", *, legend: Any = False) -> None:
    """Label an axes, give it a grid, and a legend where asked for (True, or where)."""
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    if title:
        axes.set_title(title)
    axes.grid(visible=True)
    axes.set_axisbelow(True)
    if legend:
        where: Any = legend if isinstance(legend, str) else "best"
        axes.legend(loc=where)


def save(figure: Any, stem: Path) -> None:
    """Write `stem`.svg and `stem`.png, each whole or not at all."""
    try:
        for kind, options in (("svg", {"metadata": {"Date": None}}), ("png", {"dpi": PNG_DPI})):
            temporary = stem.with_name(f".{stem.name}.{kind}")
            try:
                figure.savefig(temporary, format=kind, **options)
                temporary.replace(stem.with_name(f"{stem.name}.{kind}"))
            finally:
                temporary.unlink(missing_ok=True)
    finally:
        plt.close(figure)


def thin(*arrays: Any, most: int = 1500) -> list[Any]:
    """The same histories with at most so many points, first and last kept: a line's picture needs no more."""
    n = len(arrays[0])
    if n <= most:
        return [np.asarray(array) for array in arrays]
    keep = np.unique(np.linspace(0, n - 1, most).astype(int))
    return [np.asarray(array)[keep] for array in arrays]


def course(axes: Axes, which: Course, side: Side = "left", *, names: bool = True) -> None:
    """Cones to scale, with their names, and the frame's labels."""
    for (x, y), name in zip(which.cones_xy(side), which.cone_names(side), strict=True):
        axes.add_patch(Circle((x, y), which.cone_radius_m, color=CONE, zorder=5, lw=0))
        if names:
            above = y > 0.0 or (y == 0.0 and side == "right")
            axes.annotate(
                name, (x, y), (0, 8 if above else -8), textcoords="offset points", ha="center",
                va="bottom" if above else "top", fontsize=8.5, color=INK, zorder=6,
            )  # fmt: skip
    axes.autoscale_view()
    axes.set_aspect("equal")
    finish(axes, "x (m)", "y (m), left positive")


def body(axes: Axes, outline: Outline, x_m: float, y_m: float, yaw_rad: float, **style: Any) -> None:
    """The body's outline with its rear-axle centre at a pose."""
    options: dict[str, Any] = {"fill": False, "ec": INK, "lw": 1.2, "zorder": 4} | style
    axes.add_patch(Polygon(polygon(outline, x_m, y_m, yaw_rad), **options))


def swept(axes: Axes, outline: Outline, x_m: Any, y_m: Any, yaw_rad: Any, colour: str, every_m: float = 0.5) -> None:
    """The body's outlines along rear-axle poses, at steps of travel."""
    travelled = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x_m), np.diff(y_m)))])
    for at in np.searchsorted(travelled, np.arange(0.0, travelled[-1], every_m)):
        body(axes, outline, x_m[at], y_m[at], yaw_rad[at], ec=colour, lw=0.5, alpha=0.45, zorder=2)
        body(axes, outline, x_m[at], y_m[at], yaw_rad[at], fill=True, fc=colour, ec="none", alpha=0.05, zorder=1)
    for at in (0, -1):
        body(axes, outline, x_m[at], y_m[at], yaw_rad[at], lw=1.4, ls="--" if at == 0 else "-")
    axes.autoscale_view()
