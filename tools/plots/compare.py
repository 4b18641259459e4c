"""Picture of a comparison: the greatest errors and their rms, a panel a kind of input, a row a controller."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
from matplotlib.lines import Line2D

from tools.plots.run import _save

PANELS = {"raw": "raw inputs", "estimator": "behind the same estimator"}


def compare_picture(file: Path, both: Mapping[tuple[str, str, str], Any], *, title: str) -> None:
    """Draw dots on a logarithmic axis: max (full) and rms (hollow) in mm, a colour a scenario, the best first.

    both: figures (`tools.compare.rows.Both`) by (scenario, controller, inputs).
    """
    scenarios = list(dict.fromkeys(key[0] for key in both))
    panels = [inputs for inputs in PANELS if any(key[2] == inputs for key in both)]
    figure, grid = plt.subplots(
        1, len(panels), figsize=(7.5 * len(panels), 7.0), layout="constrained", sharex=True, squeeze=False
    )
    colours = plt.get_cmap("tab10")
    for axes, inputs in zip(grid[0], panels, strict=True):
        judged = "car" if "car" in scenarios else scenarios[0]
        names = sorted(
            dict.fromkeys(key[1] for key in both),
            key=lambda name: both[judged, name, inputs].max_m,
            reverse=True,
        )
        for place, name in enumerate(names):
            for index, scenario in enumerate(scenarios):
                figures = both[scenario, name, inputs]
                y = place + 0.11 * ((len(scenarios) - 1) / 2.0 - index)
                colour = colours(index % 10)
                axes.plot([1e3 * figures.rms_m, 1e3 * figures.max_m], [y, y], color=colour, linewidth=0.8, alpha=0.6)
                axes.plot(1e3 * figures.max_m, y, "o", color=colour, markersize=5)
                axes.plot(1e3 * figures.rms_m, y, "o", color=colour, markersize=4, markerfacecolor="white")
        axes.set_xscale("log")
        axes.set_yticks(range(len(names)), names)
        for label in axes.get_yticklabels():
            label.set_fontweight("bold" if label.get_text() == "car" else "normal")
        axes.set_title(PANELS[inputs])
        axes.set_xlabel("mm")
        axes.grid(which="major", axis="both", alpha=0.4)
        axes.grid(which="minor", axis="x", alpha=0.15)
    handles = [
        Line2D([], [], color=colours(index % 10), marker="o", linewidth=0.8, label=scenario)
        for index, scenario in enumerate(scenarios)
    ]
    handles += [
        Line2D([], [], color="black", marker="o", linestyle="", label="max"),
        Line2D([], [], color="black", marker="o", linestyle="", markerfacecolor="white", label="rms"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
    figure.suptitle(title)
    _save(figure, file)
