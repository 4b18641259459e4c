"""Figures 1 to 5 and 7 of the paper, and what m, p, q and the ends do to its path."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from sim.data_files import Side
from tools.design.waypoints import interpolate
from tools.paper.path_study import AS_PRINTED, CORRECTED, FOOT_M, segment_points
from tools.paper.plant import FORWARD, REVERSE
from tools.paper.study import Study
from tools.plots.paper_style import (
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
    RED,
    SERIES,
    course,
    finish,
    save,
    sheet,
    swept,
    thin,
)


def rear_axle_poses(study: Study, every: int = 20) -> tuple[Any, Any, Any]:
    """Rear-axle poses of a car whose centre of gravity rides exactly on the path, without side slip."""
    path = study.paths[CORRECTED].path  # free ends would turn the standing body
    behind = study.vehicle.cg_to_rear_axle_m
    # The rear wheels do not slip sideways: the heading follows the way of the centre of gravity like a trailer.
    yaw = np.zeros_like(path.yaw_rad)
    yaw[0] = path.yaw_rad[0]
    for k, course_rad in enumerate(path.yaw_rad[:-1]):
        yaw[k + 1] = yaw[k] + path.step_m * np.sin(course_rad - yaw[k]) / behind
    x, y = path.x_m - behind * np.cos(yaw), path.y_m - behind * np.sin(yaw)
    return x[::every], y[::every], yaw[::every]


def figure_1(study: Study, stem: Path) -> None:
    """Course with both options."""
    sides: tuple[tuple[Side, float, str], ...] = (
        ("left", 1.0, "(a) lane change to the left"),
        ("right", -1.0, "(b) lane change to the right"),
    )
    figure, axes = sheet(1, 2, width=13.0, height=3.2, sharey=True)
    x, y, yaw = rear_axle_poses(study)
    for one, (side, sign, title) in zip(axes, sides, strict=True):
        course(one, study.course, side)
        swept(one, study.outline, x, sign * y, sign * yaw, BLUE, 0.75)
        path = study.paths[AS_PRINTED].path
        one.plot(path.x_m, sign * path.y_m, color=INK, lw=1.6)
        cones = np.array(study.course.cones_xy())
        box = cones[np.abs(cones[:, 1]) > 0.0]
        width, length = np.ptp(box[:, 1]), np.ptp(box[:, 0])
        low = cones[:, 1].min() - 1.5
        one.annotate(
            "", (box[:, 0].min(), low), (box[:, 0].max(), low), arrowprops={"arrowstyle": "<->", "color": GREY}
        )
        one.text(box[:, 0].mean(), low - 0.12, f"{length / FOOT_M:.0f} ft", ha="center", va="top", color=GREY)
        one.annotate(
            "", (box[:, 0].max(), low), (cones[:, 0].max(), low), arrowprops={"arrowstyle": "<->", "color": GREY}
        )
        one.text(
            0.5 * (box[:, 0].max() + cones[:, 0].max()),
            low - 0.12,
            f"{(cones[:, 0].max() - box[:, 0].max()) / FOOT_M:.0f} ft",
            ha="center",
            va="top",
            color=GREY,
        )
        left = box[:, 0].min() - 1.3
        one.annotate(
            "", (left, box[:, 1].min()), (left, box[:, 1].max()), arrowprops={"arrowstyle": "<->", "color": GREY}
        )
        one.text(left - 0.15, 0.0, f"{width / FOOT_M:.0f} ft", ha="right", va="center", color=GREY)
        one.set_title(title)
        one.set_ylim(-4.2, 4.2)
        one.set_xlim(left - 1.6, None)
    save(figure, stem)


def figure_2(study: Study, stem: Path) -> None:
    """Few waypoints, many waypoints."""
    w = study.stored.waypoints
    dense = interpolate(w)
    figure, axes = sheet(width=10.0, height=3.4)
    axes.plot(
        dense.x_m.ravel(),
        dense.y_m.ravel(),
        ".",
        ms=4,
        color=BLUE,
        label=f"{dense.x_m.size} waypoints by modified Akima interpolation",
    )
    axes.plot(
        w.x_m,
        w.y_m,
        "o",
        ms=9,
        mfc="white",
        mec=RED,
        mew=2.0,
        label=f"{len(w.x_m)} sample waypoints (fitted, see text)",
    )
    finish(axes, "x (m)", "y (m)", legend="upper left")
    save(figure, stem)


def figure_3(study: Study, stem: Path) -> None:
    """Segmented waypoints."""
    dense = interpolate(study.stored.waypoints)
    figure, axes = sheet(width=10.0, height=3.4)
    for number, (x, y) in enumerate(zip(dense.x_m, dense.y_m, strict=True)):
        axes.plot(x, y, ".", ms=5, color=SERIES[number], label=f"segment {number + 1}")
    finish(axes, "x (m)", "y (m)", legend="upper left")
    save(figure, stem)


def figure_4(study: Study, stem: Path) -> None:
    """Optimised path among the cones, as printed and as corrected, and how far they are apart."""
    figure, axes = sheet(2, 1, width=10.5, height=6.6, gridspec_kw={"height_ratios": [1.5, 1.0]}, sharex=True)
    course(axes[0], study.course)
    for number, (x, y, _) in enumerate(segment_points(study.paths[AS_PRINTED])):
        axes[0].plot(x, y, color=SERIES[number], lw=2.4, label=f"segment {number + 1}")
    axes[0].legend(loc="upper right", ncols=4)
    axes[0].set_ylim(-2.1, 2.9)
    axes[0].set_title("optimised path, as printed")
    w = study.stored.waypoints
    from scipy.interpolate import Akima1DInterpolator  # noqa: PLC0415

    way = Akima1DInterpolator(np.array(w.x_m), np.array(w.y_m), method="makima")
    for name, colour in ((AS_PRINTED, BLUE), (CORRECTED, GREEN)):
        path = study.paths[name].path
        inside = (path.x_m >= w.x_m[0]) & (path.x_m <= w.x_m[-1])
        axes[1].plot(path.x_m[inside], 1e3 * (path.y_m[inside] - way(path.x_m[inside])), color=colour, label=name)
    finish(axes[1], "x (m)", "path - waypoints (mm)", legend="upper left")
    save(figure, stem)


def figure_5(study: Study, stem: Path) -> None:
    """Curvature forward and in reverse."""
    figure, axes = sheet(1, 2, width=11.5, height=3.8, sharey=True)
    for one, (direction, title) in zip(
        axes, ((FORWARD, "forward"), (REVERSE, "reverse: flipped and inverted")), strict=True
    ):
        from tools.paper.track import track_of  # noqa: PLC0415

        for name, colour, style in ((AS_PRINTED, BLUE, "-"), (CORRECTED, GREEN, "--")):
            track = track_of(study.paths[name].path, direction)
            one.plot(*thin(track.station_m, track.curvature_1pm), color=colour, ls=style, label=name)
        finish(
            one, "travelled (m)", "curvature (1/m), left positive" if direction == FORWARD else "", title, legend=True
        )
        for edge in (0, -1):
            track = track_of(study.paths[AS_PRINTED].path, direction)
            one.plot(track.station_m[edge], track.curvature_1pm[edge], "o", color=RED, ms=6)
    axes[0].annotate(
        "free end: the path\nbegins with a curvature",
        (0.0, study.tracks[FORWARD].curvature_1pm[0]),
        (2.2, -0.24),
        color=RED,
        fontsize=9.5,
        arrowprops={"arrowstyle": "->", "color": RED},
    )
    save(figure, stem)


def figure_7(study: Study, stem: Path) -> None:
    """Speed and preview distance."""
    figure, axes = sheet(1, 2, width=11.0, height=3.4)
    plan = study.motions[FORWARD]
    t, v = thin(plan.time_s, plan.speed_mps)
    axes[0].plot(t, v, color=BLUE)
    finish(axes[0], "time (s)", "speed (m/s)", "scheduled speed")
    axes[1].plot(t, study.schedule.preview_time_s * v, color=GREEN)
    finish(axes[1], "time (s)", "preview distance (m)", "l_s = K V")
    for one in axes:
        one.set_ylim(bottom=0.0)
    save(figure, stem)


def choices(study: Study, stem: Path) -> None:
    """What m, p and q do: rms curvature, misfit and the jumps at the joints, as printed and as corrected."""
    figure, axes = sheet(3, 3, width=11.5, height=8.0, sharex="col", sharey="row")
    for sweep, colour, name, mark in (
        (study.choices, BLUE, AS_PRINTED, "o-"),
        (study.choices_corrected, GREEN, CORRECTED, "s--"),
    ):
        for column, key in enumerate(("m", "p", "q")):
            fixed = {"m": 4, "p": 6, "q": 3}
            rows = sorted(
                (c for c in sweep if all(getattr(c, k) == v for k, v in fixed.items() if k != key)),
                key=lambda c: getattr(c, key),
            )
            at = [getattr(c, key) for c in rows]
            axes[0, column].plot(at, [c.rms_curvature_1pm for c in rows], mark, color=colour, label=name)
            axes[1, column].plot(at, [1e3 * c.fit_rms_m for c in rows], mark, color=colour)
            axes[2, column].semilogy(at, [max(c.slope_jump_1pm2, 1e-17) for c in rows], mark, color=colour)
            for row in range(3):
                axes[row, column].axvline(fixed[key], color=ORANGE, lw=6, alpha=0.18)
    axes[0, 0].set_ylim(0.06, 0.16)
    axes[1, 0].set_ylim(0.0, 100.0)
    for column, text in enumerate(
        ("m, segments (p = 6, q = 3)", "p, order (m = 4, q = 3)", "q, continuity (m = 4, p = 6)")
    ):
        for row, label in enumerate(
            ("rms curvature (1/m)", "misfit to waypoints (mm rms)", "jump of the curvature's\nslope at joints (1/m²)")
        ):
            finish(axes[row, column], text if row == 2 else "", label if column == 0 else "")
    axes[0, 0].legend(loc="upper right")
    save(figure, stem)


def rear_axle(study: Study, stem: Path) -> None:
    """The path of the rear axle with its swept body: what the paper's path should have been."""
    figure, axes = sheet(2, 1, width=10.5, height=7.4)
    x, y, yaw = rear_axle_poses(study)
    for one, (poses, colour, title) in zip(
        axes,
        (
            ((x, y, yaw), RED, "centre of gravity on the reconstructed path"),
            (
                (study.rear_path.x_m, study.rear_path.y_m, study.rear_path.yaw_rad),
                GREEN,
                "rear axle on a path of its own",
            ),
        ),
        strict=True,
    ):
        course(one, study.course)
        swept(one, study.outline, *poses, colour, 0.4)
        one.set_title(title)
        one.set_ylim(-2.6, 3.2)
    save(figure, stem)
