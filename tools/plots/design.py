"""Pictures of a design: the sheet with path, steering, speed and margins, and the trade curve."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Polygon

from sim.body import clearance_array_m, outline_of, polygon
from sim.data_files import Course, Vehicle
from tools.plots.run import _course, _limits, _nearest_point, _save

BODY_STEP_M = 0.25
FORWARD_COLOUR, REVERSE_COLOUR = "tab:blue", "tab:red"


def design_sheet(
    file: Path,
    *,
    vehicle: Vehicle,
    course: Course,
    path: Any,
    profiles: Sequence[Any],
    steering: Mapping[str, np.ndarray[Any, Any]],
    margins: Sequence[Mapping[str, Any]],
    limits: Mapping[str, float],
    facts: Sequence[str],
    title: str,
) -> None:
    """Draw a whole design on one sheet.

    path: stations, pose, curvature and its slope (`tools.design.path.Path`). profiles: speed plans forward and reverse.
    steering: `angle_rad` and `slope_radpm` by station of the forward leg. margins: one mapping a direction with
    `direction`, `speed_mps`, `disk`, `delay_samples` (lists). limits: `angle_rad`, `planned_angle_rad`, `rate_radps`,
    `planned_rate_radps`, `speed_mps`. facts: lines of the text in the corner.
    """
    figure = plt.figure(figsize=(18, 15), layout="constrained")
    grid = figure.add_gridspec(4, 3, height_ratios=[1.55, 1.0, 1.0, 1.0])
    _swept(figure.add_subplot(grid[0, :]), vehicle, course, path)
    station = path.station_m
    stations = (station, station[-1] - station)
    names = ("forward", "reverse")
    colours = (FORWARD_COLOUR, REVERSE_COLOUR)

    axes = figure.add_subplot(grid[1, 0])
    axes.plot(station, path.curvature_1pm, color="black")
    _labels(axes, "curvature (1/m)")
    axes = figure.add_subplot(grid[2, 0])
    axes.plot(station, path.curvature_slope_1pm2, color="black")
    _labels(axes, "slope of the curvature (1/m²)")
    axes = figure.add_subplot(grid[3, 0])
    _clearance(axes, vehicle, course, path)

    axes = figure.add_subplot(grid[1, 1])
    axes.plot(station, steering["angle_rad"], color="black")
    _limits(axes, limits["angle_rad"], "car's limit")
    axes.axhline(limits["planned_angle_rad"], color="gray", ls=":", lw=1.0, label="planned with, at most")
    axes.axhline(-limits["planned_angle_rad"], color="gray", ls=":", lw=1.0)
    _labels(axes, "road-wheel angle (rad), left positive", legend=True)
    axes = figure.add_subplot(grid[2, 1])
    for at, profile, name, colour in zip(stations, profiles, names, colours, strict=True):
        slope = steering["slope_radpm"] if name == "forward" else -steering["slope_radpm"][::-1]
        axes.plot(at, slope * profile.speed_mps, color=colour, label=name)
    _limits(axes, limits["rate_radps"], "car's limit")
    axes.axhline(limits["planned_rate_radps"], color="gray", ls=":", lw=1.0, label="planned with, at most")
    axes.axhline(-limits["planned_rate_radps"], color="gray", ls=":", lw=1.0)
    _labels(axes, "road-wheel rate at the planned speed (rad/s)", legend=True)
    axes = figure.add_subplot(grid[3, 1])
    for at, profile, name, colour in zip(stations, profiles, names, colours, strict=True):
        axes.plot(at, profile.speed_mps, color=colour, label=f"{name}, {profile.duration_s:.1f} s")
    axes.axhline(limits["speed_mps"], color="black", ls="--", lw=1.0, label="limit")
    _labels(axes, "planned speed (m/s)", legend=True)
    axes.set_ylim(bottom=0.0)

    _margins(figure.add_subplot(grid[1, 2]), margins, "disk", "disk margin, worst car of the box")
    axes = figure.add_subplot(grid[2, 2])
    _margins(axes, margins, "delay_samples", "delay margin (samples), worst car of the box")
    least = min((value for entry in margins for value in entry["delay_samples"]), default=1.0)
    axes.set_yscale("log")  # it falls with the speed
    axes.set_ylim(bottom=0.5 * least)
    axes = figure.add_subplot(grid[3, 2])
    axes.axis("off")
    axes.text(0.0, 1.0, "\n".join(facts), va="top", family="monospace", fontsize=9, transform=axes.transAxes)
    figure.suptitle(title)
    _save(figure, file)


def _labels(axes: Axes, label: str, *, legend: bool = False) -> None:
    axes.set_title(label, fontsize=10)
    axes.set_xlabel("station along the path (m); reverse runs from right to left", fontsize=8)
    axes.grid(visible=True, alpha=0.3)
    axes.margins(x=0.01)
    if legend:
        axes.legend(fontsize=8)


def _swept(axes: Axes, vehicle: Vehicle, course: Course, path: Any) -> None:
    """Draw the body along the path and how near it comes to each cone's axis."""
    cones = _course(axes, course, "left")
    outline = outline_of(vehicle)
    pose = np.stack([path.x_m, path.y_m, path.yaw_rad], axis=1)
    fill = (*mpl.colors.to_rgb(FORWARD_COLOUR), 0.03)
    for at in np.searchsorted(path.station_m, np.arange(0.0, path.station_m[-1], BODY_STEP_M)):
        axes.add_patch(Polygon(polygon(outline, *pose[at]), fc=fill, ec="none"))
        axes.add_patch(Polygon(polygon(outline, *pose[at]), fill=False, ec=FORWARD_COLOUR, lw=0.3, alpha=0.5))
    for at, style, label in ((0, "--", "body at start and return"), (-1, "-", "body at the stop")):
        axes.add_patch(Polygon(polygon(outline, *pose[at]), fill=False, ec="black", lw=1.4, ls=style, label=label))
    axes.plot(path.x_m, path.y_m, color="black", lw=1.5, label="path (rear-axle centre)")
    distances = clearance_array_m(outline, path.x_m, path.y_m, path.yaw_rad, cones)
    for index, cone in enumerate(cones):
        row = int(distances[:, index].argmin())
        near = _nearest_point(np.array(polygon(outline, *pose[row])), cone)
        axes.plot([cone[0], near[0]], [cone[1], near[1]], color="black", lw=1.2, zorder=7)
        axes.annotate(
            f"{distances[row, index]:.3f} m", (0.5 * (cone[0] + near[0]), 0.5 * (cone[1] + near[1])), (10, 0),
            textcoords="offset points", fontsize=9, weight="bold", va="center", zorder=8,
            bbox={"boxstyle": "round,pad=0.2", "fc": "white", "ec": "none", "alpha": 0.8},
        )  # fmt: skip
    axes.autoscale_view()
    low, high = axes.get_ylim()
    axes.set_ylim(min(low, cones[:, 1].min() - 0.6), max(high, cones[:, 1].max() + 0.6))
    axes.set_title("swept body, and the least distance to each cone's axis (left side; the right is its mirror image)")
    axes.legend(loc="lower right", ncols=3, fontsize=8)


def _clearance(axes: Axes, vehicle: Vehicle, course: Course, path: Any) -> None:
    distances = clearance_array_m(outline_of(vehicle), path.x_m, path.y_m, path.yaw_rad, course.cones_xy())
    for index, name in enumerate(course.cone_names("left")):
        axes.plot(path.station_m, distances[:, index], label=name)
    axes.axhline(course.cone_radius_m, color="black", ls="--", lw=1.0, label="touched below")
    axes.set_ylim(0.0, 1.6)
    _labels(axes, "distance to each cone's axis (m)", legend=True)


def _margins(axes: Axes, margins: Sequence[Mapping[str, Any]], key: str, label: str) -> None:
    for entry, colour, style in zip(margins, (FORWARD_COLOUR, REVERSE_COLOUR), ("-", "--"), strict=False):
        axes.plot(entry["speed_mps"], entry[key], color=colour, ls=style, marker=".", label=entry["direction"])
    if not margins:
        axes.text(0.5, 0.5, "not computed", ha="center", transform=axes.transAxes)
    axes.set_title(label, fontsize=10)
    axes.set_xlabel("speed (m/s)", fontsize=8)
    axes.set_ylim(bottom=0.0)
    axes.grid(visible=True, alpha=0.3)
    if margins:
        axes.legend(fontsize=8, loc="center right")


def trade(file: Path, *, points: Sequence[Mapping[str, Any]], title: str) -> None:
    """Draw the trade curve: what each centimetre of clearance costs; one point a path, the chosen one marked.

    points: as in trade.json, from the clearest path to the gentlest.
    """
    rows = (
        ("largest road-wheel angle (rad)", "max_road_wheel_angle_rad"),
        ("largest steering slope (rad/m)", "max_road_wheel_slope_radpm"),
        ("largest rate at the planned speed (rad/s)", "max_road_wheel_rate_radps"),
        ("duration of a leg (s)", "leg_duration_s"),
    )
    panels = [(label, [float(point[key]) for point in points]) for label, key in rows]
    if all(point["tracking"] for point in points):
        runs = points[0]["tracking"]["runs"]
        for label, key in (("largest", "max_cross_track_m"), ("rms", "rms_cross_track_m")):
            values = [1e3 * point["tracking"][key] for point in points]
            panels.append((f"{label} true cross-track error (mm), `car`, {runs} runs", values))
    figure, grid = plt.subplots(len(panels) // 2, 2, figsize=(13, 4.0 * (len(panels) // 2)), layout="constrained")
    clearance = [point["min_body_clearance_m"] for point in points]
    chosen = [index for index, point in enumerate(points) if point["chosen"]]
    for axes, (label, values) in zip(grid.ravel(), panels, strict=True):
        axes.plot(clearance, values, "-o", color=FORWARD_COLOUR, ms=5)
        axes.plot(
            [clearance[i] for i in chosen], [values[i] for i in chosen], "*", color="tab:red", ms=18, label="chosen"
        )
        for index, (x, y) in enumerate(zip(clearance, values, strict=True), 1):
            axes.annotate(str(index), (x, y), (5, 6), textcoords="offset points", fontsize=8)
        axes.set_title(label, fontsize=10)
        axes.set_xlabel("clearance of the body on the path (m)")
        axes.grid(visible=True, alpha=0.3)
        axes.set_ylim(0.0, 1.12 * max(values))
        axes.legend(fontsize=8)
    figure.suptitle(title)
    _save(figure, file)
