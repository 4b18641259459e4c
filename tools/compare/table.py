"""The tables that a comparison prints: errors, the latency that is borne, and the time that a law takes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.table import Table

from tools.compare.latency import SCENARIO, Borne
from tools.compare.rows import Both

if TYPE_CHECKING:
    from rich.console import Console

WIDE = 100
"""Columns of a terminal from which on a maximum and its rms stand side by side; else one above the other."""


def print_tables(
    console: Console,
    titles: dict[str, str],
    both: dict[tuple[str, str, str], Both],
    ticks: dict[tuple[str, str], float],
    borne: Borne | None,
) -> None:
    """Print a table for each kind of input: a line a controller, a column a scenario, the latency borne beside its.

    `titles` are those of the columns by scenario; `both` is by scenario, controller and inputs, `ticks` by the latter
    two, in the order of the lines.
    """
    between = "/" if console.width >= WIDE else "\n"
    for inputs in dict.fromkeys(inputs for _, inputs in ticks):
        of = "raw inputs" if inputs == "raw" else "behind the same estimator"
        table = Table(title=f"{of}: cross-track max / rms in mm", title_justify="left", padding=(0, 0))
        table.add_column("", no_wrap=True)
        for scenario, title in titles.items():
            table.add_column(title, justify="right", overflow="fold")
            if borne is not None and scenario == SCENARIO:
                table.add_column("latency", justify="right", no_wrap=True)
        table.add_column("us", justify="right", no_wrap=True)
        for name in [name for name, given in ticks if given == inputs]:
            cells = []
            for scenario in titles:
                cells.append(_cell(both[scenario, name, inputs], between))
                if borne is not None and scenario == SCENARIO:
                    cells.append(samples_cell(borne.samples[name, inputs], borne.most_samples))
            style = "bold" if name == "car" else None
            table.add_row(name, *cells, f"{ticks[name, inputs]:.0f}", style=style)
        console.print(table)
    console.print(
        "us: the law alone in a cycle, in CPython; * some runs were stopped by the supervisor", highlight=False
    )
    if borne is not None:
        console.print(
            f"latency: added samples of 10 ms of command latency in {SCENARIO} that it bears (+: the most tried)",
            highlight=False,
        )


def samples_cell(samples: int | None, most: int) -> str:
    """Return the cell of so many added samples that are borne, `most` having been tried."""
    if samples is None:
        return "-"
    return f"{samples}+" if samples == most else f"{samples}"


def _cell(figures: Both, between: str) -> str:
    return f"{_millimetres(figures.max_m)}{between}{_millimetres(figures.rms_m)}{'*' if figures.stopped else ''}"


def _millimetres(error_m: float) -> str:
    error = 1e3 * error_m
    return f"{error:.0f}" if error >= 99.5 else f"{error:.1f}" if error >= 9.95 else f"{error:.2f}"
