"""Pictures of a run: the swept body, the signals, histograms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Polygon

from sim.body import Outline, clearance_array_m, outline_of, polygon
from sim.data_files import Course, Side, Vehicle
from tools.estimates import Estimates
from tools.figures import FORWARD, Leg, PathTable, Truth, command_rate, leg_figures

COLOUR = {FORWARD: "tab:blue", "reverse": "tab:red"}
OUTLINE_STEP_M = 0.25
LABEL_ROOM_M = 0.6
MAX_LEGS = 4
"""A test has two; one that went wrong may have any number."""
DPI = 130
BINS, LEAST_US = 80, 0.05


def swept_body(
    file: Path,
    *,
    vehicle: Vehicle,
    course: Course,
    side: Side,
    truth: Truth,
    path: PathTable,
    legs: Sequence[Leg],
    title: str,
) -> None:
    """Draw the body's outline along both legs among the cones, with the path of the rear axle, to scale."""
    outline, legs = outline_of(vehicle), legs[:MAX_LEGS]
    figure, rows = plt.subplots(
        max(1, len(legs)), 1, figsize=(13, 0.8 + 4.1 * max(1, len(legs))), squeeze=False, layout="constrained"
    )
    for axes, leg in zip(rows[:, 0], legs, strict=False):
        _swept_leg(axes, outline, course, side, truth, path, leg)
    if not legs:
        _course(rows[0, 0], course, side)
        rows[0, 0].text(0.5, 0.5, "the car did not move", transform=rows[0, 0].transAxes, ha="center")
    figure.suptitle(title)
    _save(figure, file)


def _course(axes: Axes, course: Course, side: Side) -> np.ndarray[Any, Any]:
    cones = np.array(course.cones_xy(side))
    for (x, y), name in zip(cones, course.cone_names(side), strict=True):
        axes.add_patch(Circle((x, y), course.cone_radius_m, color="darkorange", zorder=5))
        below = y < 0.0 or (y == 0.0 and side == "left")  # away from the car
        axes.annotate(
            name, (x, y), (0, -9 if below else 9), textcoords="offset points", ha="center",
            va="top" if below else "bottom", fontsize=8, zorder=6,
        )  # fmt: skip
    axes.set_aspect("equal")
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m), left positive")
    axes.grid(visible=True, alpha=0.3)
    return cones


def _swept_leg(
    axes: Axes, outline: Outline, course: Course, side: Side, truth: Truth, path: PathTable, leg: Leg
) -> None:
    cones = _course(axes, course, side)
    colour = COLOUR[leg.direction]
    x, y, yaw = truth.x_m[leg.rows], truth.y_m[leg.rows], truth.yaw_rad[leg.rows]
    travelled = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    for at in np.searchsorted(travelled, np.arange(0.0, travelled[-1], OUTLINE_STEP_M)):
        axes.add_patch(
            Polygon(polygon(outline, x[at], y[at], yaw[at]), fc=(*mpl.colors.to_rgb(colour), 0.03), ec="none")
        )
        axes.add_patch(Polygon(polygon(outline, x[at], y[at], yaw[at]), fill=False, ec=colour, lw=0.3, alpha=0.5))
    for at, style, label in ((0, "--", "body at its start"), (-1, "-", "body at its stop")):
        axes.add_patch(
            Polygon(
                polygon(outline, x[at], y[at], yaw[at]), fill=False, ec="black", lw=1.4, ls=style, label=label, zorder=4
            )
        )
    axes.plot(path.x_m, path.y_m, color="black", lw=3.0, alpha=0.25, label="path (rear-axle centre)")
    axes.plot(x, y, color=colour, lw=1.2, label="driven (rear-axle centre, true)")
    clearances = clearance_array_m(outline, x, y, yaw, cones)
    row, cone = np.unravel_index(np.argmin(clearances), clearances.shape)
    near = _nearest_point(np.array(polygon(outline, x[row], y[row], yaw[row])), cones[cone])
    axes.plot([cones[cone, 0], near[0]], [cones[cone, 1], near[1]], color="black", lw=1.2, zorder=7)
    axes.annotate(
        f"{clearances[row, cone]:.3f} m", ((cones[cone, 0] + near[0]) / 2, (cones[cone, 1] + near[1]) / 2), (14, 0),
        textcoords="offset points", fontsize=9, weight="bold", va="center", zorder=7,
        bbox={"boxstyle": "round,pad=0.2", "fc": "white", "ec": "none", "alpha": 0.8},
    )  # fmt: skip
    axes.set_title(
        f"{leg.direction}: nearest to a cone's axis at {course.cone_names(side)[cone]} "
        f"(a cone counts as touched within {course.cone_radius_m:.2f} m of its axis)", fontsize=10,
    )  # fmt: skip
    axes.autoscale_view()
    low, high = axes.get_ylim()
    axes.set_ylim(min(low, cones[:, 1].min() - LABEL_ROOM_M), max(high, cones[:, 1].max() + LABEL_ROOM_M))
    axes.legend(loc="lower right" if side == "left" else "upper right", ncols=2, fontsize=8)


def _nearest_point(corners: np.ndarray[Any, Any], point: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Return the point of a closed polygon's edges that is nearest to a point."""
    a, b = corners, np.roll(corners, -1, axis=0)
    along = np.clip(np.sum((point - a) * (b - a), axis=1) / np.sum((b - a) ** 2, axis=1), 0.0, 1.0)
    feet = a + along[:, None] * (b - a)
    nearest: np.ndarray[Any, Any] = feet[np.argmin(np.sum((feet - point) ** 2, axis=1))]
    return nearest


def signals(
    file: Path,
    *,
    vehicle: Vehicle,
    course: Course,
    truth: Truth,
    path: PathTable,
    legs: Sequence[Leg],
    title: str,
    estimates: Mapping[str, Estimates] | None = None,
) -> None:
    """Draw speed, steering with its limits, errors and clearance of both legs over the path's station.

    Where `estimates` of a leg are given, what the controller believed of its error lies behind the true one.
    """
    figure, rows = plt.subplots(6, 1, figsize=(12, 17), sharex=True, layout="constrained")
    speed, angle, rate, error, heading, clearance = rows
    for leg in legs[:MAX_LEGS]:
        colour, name = COLOUR[leg.direction], leg.direction
        station = leg.on_path.station_m
        steering = leg.steering_rows
        # Before and after the motion the car stands: its station there is that of the nearest end of the leg.
        before, after = leg.rows.start - steering.start, steering.stop - leg.rows.stop
        steering_station = np.concatenate([np.full(before, station[0]), station, np.full(after, station[-1])])
        thin = {"color": colour, "lw": 0.6, "alpha": 0.55}
        speed.plot(station, truth.speed_mps[leg.rows], color=colour, label=name)
        angle.plot(steering_station, truth.road_wheel_angle_cmd_rad[steering], **thin, label=f"{name}, command")
        angle.plot(steering_station, truth.road_wheel_angle_rad[steering], color=colour, lw=1.2, label=f"{name}, true")
        rate.plot(steering_station, command_rate(truth, steering), **thin | {"alpha": 0.3}, label=f"{name}, command")
        rate.plot(
            steering_station,
            truth.road_wheel_rate_radps[steering],
            color=colour,
            lw=1.2,
            zorder=3,
            label=f"{name}, true",
        )
        figures = leg_figures(leg, truth, path)
        error.plot(station, 1e3 * leg.preview_error_m, **thin, label=f"{name}, at the preview point")
        error.plot(
            station, 1e3 * leg.on_path.cross_track_error_m, color=colour, lw=1.3,
            label=f"{name}, rear axle: max {1e3 * figures['max_cross_track_m']:.2f} mm, "
            f"rms {1e3 * figures['rms_cross_track_m']:.2f} mm",
        )  # fmt: skip
        believed = (estimates or {}).get(name)
        if believed is not None:
            middle, width = 1e3 * believed.cross_track_error_m, 2e3 * believed.cross_track_sigma_m
            error.fill_between(
                believed.station_m, middle - width, middle + width, color=colour, alpha=0.12, lw=0.0,
                label=f"{name}, estimate ±2 sigma",
            )  # fmt: skip
        heading.plot(station, np.degrees(leg.on_path.heading_error_rad), color=colour, label=name)
        clearance.plot(
            station,
            truth.min_clearance_m[leg.rows],
            color=colour,
            label=f"{name}: min {figures['min_clearance_m']:.3f} m",
        )
    _limits(speed, vehicle.max_speed_mps, "vehicle's limit")
    _limits(angle, vehicle.max_road_wheel_angle_rad, "vehicle's limit")
    _limits(rate, vehicle.max_road_wheel_rate_radps, "vehicle's limit")
    clearance.axhline(course.cone_radius_m, color="black", ls="--", lw=1.0, label="cone touched below")
    clearance.set_ylim(bottom=min(0.0, float(np.min(truth.min_clearance_m, initial=0.0))))
    for axes, label in (
        (speed, "speed (m/s)"),
        (angle, "road-wheel angle\n(rad), left positive"),
        (rate, "road-wheel rate\n(rad/s)"),
        (error, "true cross-track error\n(mm), left positive"),
        (heading, "true heading error\n(deg), left positive"),
        (clearance, "clearance to the nearest\ncone's axis (m)"),
    ):
        axes.set_ylabel(label)
        axes.grid(visible=True, alpha=0.3)
        axes.margins(x=0.01)
        axes.legend(
            loc="lower left", bbox_to_anchor=(0.0, 0.985), ncols=3 if axes is error else 6, fontsize=8, frameon=False
        )
    clearance.set_xlabel("station along the path (m): the forward leg runs to the right, reverse to the left")
    figure.suptitle(title)
    _save(figure, file)


def _limits(axes: Axes, limit: float, label: str) -> None:
    axes.axhline(limit, color="black", ls="--", lw=1.0, label=f"{label} ±{limit:g}")
    axes.axhline(-limit, color="black", ls="--", lw=1.0)


def histogram(file: Path, title: str, samples_us: Mapping[str, Sequence[float]]) -> None:
    """Draw one histogram a name over the same logarithmic axis in us."""
    least = max(min(min(samples) for samples in samples_us.values()), LEAST_US)
    most = max(2.0 * least, *(max(samples) for samples in samples_us.values()))
    edges = [float(edge) for edge in np.geomspace(least, most, BINS)]
    figure, axes = plt.subplots(figsize=(9, 4.5), layout="constrained")
    for name, samples in samples_us.items():
        axes.hist(np.maximum(samples, least), bins=edges, histtype="step", linewidth=1.5, label=name)
    axes.set(xscale="log", yscale="log", xlabel="us", ylabel="samples", title=title)
    axes.legend()
    axes.grid(alpha=0.3)
    _save(figure, file)


def _save(figure: Any, file: Path) -> None:
    """Write the picture whole or not at all."""
    temporary = file.with_name(f".{file.name}")
    try:
        figure.savefig(temporary, dpi=DPI, format="png")
        temporary.replace(file)
    finally:
        plt.close(figure)
        temporary.unlink(missing_ok=True)
