"""Figures 14 to 19 of the paper: the simulations, with the true error and the body among the cones beside e_y."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tools.paper.in_lockstep import BUS, CAR, LATE, find
from tools.paper.laws import BOTH, DOB, FEEDFORWARD, LAWS, PID
from tools.paper.plant import CORRECTED, FORWARD, PRINTED, REVERSE
from tools.paper.printed import TABLES_5_6
from tools.paper.study import CASES, TABLE_5, TABLE_6, TABLE_6_CORRECTED, Result, Study
from tools.plots.paper_style import (
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
    PURPLE,
    RED,
    SERIES,
    course,
    finish,
    save,
    sheet,
    swept,
    thin,
)


def axle_poses(study: Study, result: Result, direction: str, every: int = 100) -> tuple[Any, Any, Any]:
    """Rear-axle poses of the body during a run."""
    run = result.run
    yaw = run.yaw_rad[::every] - (0.0 if direction == FORWARD else np.pi)
    behind = study.vehicle.cg_to_rear_axle_m
    return run.x_m[::every] - behind * np.cos(yaw), run.y_m[::every] - behind * np.sin(yaw), yaw


def simulation(study: Study, table: str, law: str, stem: Path) -> None:
    """One of Figures 14 to 19: the car among the cones, e_y with the true error, steering and its rate."""
    direction = CASES[table][0]
    result = study.results[table][law]
    run, figures = result.run, result.figures
    figure, axes = sheet(2, 2, width=13.0, height=6.8)
    t, e, true, steer, pid, rate = thin(
        run.time_s, run.preview_error_m, run.cross_track_error_m, run.steer_rad, run.steer_pid_rad, run.steer_rate_radps
    )
    top = axes[0, 0]
    course(top, study.course)
    swept(top, study.outline, *axle_poses(study, result, direction), BLUE, 0.75)
    track = study.tracks[direction]
    top.plot(*thin(track.x_m, track.y_m), color=INK, lw=3.0, alpha=0.3, label="path")
    top.plot(*thin(run.x_m, run.y_m), color=RED, lw=1.3, label="centre of gravity, driven")
    top.set_ylim(-2.6, 4.4)
    top.legend(loc="upper right", ncols=2)
    top.set_title(f"{direction}, {law}: least clearance {result.min_clearance_m:.2f} m")
    axes[0, 1].plot(t, 1e3 * e, color=BLUE)
    finish(
        axes[0, 1],
        "time (s)",
        "e_y (mm)",
        f"e_y: max {1e3 * figures.max_e_y_m:.3g} mm, rms {1e3 * figures.rms_e_y_m:.3g} mm",
    )
    inset = axes[0, 1].inset_axes((0.05, 0.62, 0.36, 0.28))
    inset.plot(t, 1e3 * true, color=RED, lw=1.2)
    inset.plot(t, 1e3 * e, color=BLUE, lw=1.2)
    inset.set_title("with the true error of the CG (mm)", fontsize=8, color=RED, weight="normal")
    inset.tick_params(labelsize=7)
    low, high = axes[0, 1].get_ylim()
    axes[0, 1].set_ylim(low, high + 0.75 * (high - low))
    axes[1, 0].plot(t, steer, color=INK, lw=1.8, label="road-wheel angle")
    if law in (BOTH, FEEDFORWARD):
        axes[1, 0].plot(
            t, pid if law == BOTH else steer, color=ORANGE, lw=1.3, label="part of the PID" if law == BOTH else None
        )
    if law == BOTH:
        axes[1, 0].plot(t, steer - pid, color=GREEN, lw=1.3, ls="--", label="part of the DOB")
    finish(
        axes[1, 0],
        "time (s)",
        "rad, left positive",
        f"steering: max {figures.max_steer_rad:.3f} rad",
        legend=law == BOTH,
    )
    axes[1, 1].plot(t, rate, color=PURPLE)
    finish(axes[1, 1], "time (s)", "rad/s", f"steering rate: max {figures.max_steer_rate_radps:.2f} rad/s")
    bound = 1.3 * float(np.quantile(np.abs(run.steer_rate_radps), 0.999))
    axes[1, 1].set_ylim(-bound, bound)
    save(figure, stem)


def cells(study: Study, stem: Path) -> None:
    """Tables 5 and 6 at a glance: ours over printed, with the tolerances."""
    figure, axes = sheet(1, 2, width=12.0, height=4.0, sharey=True)
    fields = ("max_e_y_m", "rms_e_y_m", "max_steer_rad", "max_steer_rate_radps")
    for one, table, direction in ((axes[0], TABLE_5, FORWARD), (axes[1], TABLE_6, REVERSE)):
        for number, law in enumerate((DOB, PID, BOTH)):
            ratios = [
                getattr(study.results[table][law].figures, f) / getattr(TABLES_5_6[direction][law], f) for f in fields
            ]
            at = np.arange(4) + 0.25 * (number - 1)
            one.bar(
                at,
                ratios,
                0.23,
                color=(GREEN, ORANGE, BLUE)[number],
                label=law + (" (predicted)" if law == BOTH else " (fitted)"),
            )
            for x, ratio in zip(at, ratios, strict=True):
                one.text(x, ratio + 0.015, f"{ratio:.2f}", ha="center", fontsize=8)
        one.axhspan(0.8, 1.2, color=GREEN, alpha=0.1)
        one.axhline(1.0, color=INK, lw=1.0)
        one.set_xticks(range(4), ["max e_y", "rms e_y", "max angle", "max rate"])
        finish(
            one,
            "",
            "ours over printed" if one is axes[0] else "",
            f"{'Table 5, forward' if table == TABLE_5 else 'Table 6, reverse, sign as printed'}",
        )
        one.grid(visible=False, axis="x")
        one.set_ylim(0, 1.5)
    axes[0].legend(loc="upper left", ncols=3)
    save(figure, stem)


def true_error(study: Study, stem: Path) -> None:
    """e_y against the true error, forward and in reverse: what the paper's measure does not show."""
    figure, axes = sheet(1, 2, width=12.0, height=4.0, sharey=True)
    for one, table in ((axes[0], TABLE_5), (axes[1], TABLE_6)):
        run = study.results[table][BOTH].run
        t, e, true, heading, v = thin(
            run.time_s, run.preview_error_m, run.cross_track_error_m, run.state[:, 2], run.speed_mps
        )
        one.plot(t, 1e3 * true, color=RED, lw=2.0, label="true error of the centre of gravity")
        one.plot(t, -1e3 * 0.5 * v * heading, ":", color=INK, lw=1.6, label="- l_s times heading error")
        one.plot(t, 1e3 * e, color=BLUE, lw=2.0, label="e_y, what is controlled and reported")
        finish(
            one,
            "time (s)",
            "mm, left positive" if one is axes[0] else "",
            "forward" if table == TABLE_5 else "reverse, sign as printed",
        )
    axes[0].legend(loc="upper left", bbox_to_anchor=(0.0, 1.0))
    low, high = axes[0].get_ylim()
    axes[0].set_ylim(low, high + 0.45 * (high - low))
    save(figure, stem)


def feedforward(study: Study, stem: Path) -> None:
    """PID with feedforward beside the others, forward."""
    figure, axes = sheet(1, 2, width=12.0, height=3.8)
    for number, law in enumerate(LAWS):
        run = study.results[TABLE_5][law].run
        t, e, steer = thin(run.time_s, run.preview_error_m, run.steer_rad)
        axes[0].plot(t, 1e3 * e, color=SERIES[number], label=law)
        axes[1].plot(t, steer, color=SERIES[number], label=law)
    finish(axes[0], "time (s)", "e_y (mm)", "path-tracking error", legend="upper right")
    finish(axes[1], "time (s)", "road-wheel angle (rad)", "steering")
    save(figure, stem)


def divergence(study: Study, stem: Path) -> None:
    """All four laws in reverse with the corrected sign, until they leave their room."""
    figure, axes = sheet(1, 2, width=13.0, height=4.4, gridspec_kw={"width_ratios": [1.7, 1.0]})
    course(axes[0], study.course)
    for number, law in enumerate(LAWS):
        result = study.results[TABLE_6_CORRECTED][law]
        run, leaving = result.run, study.leaving[law]
        end = np.searchsorted(run.travelled_m, (leaving.room_m or run.travelled_m[-1]) + 0.6)
        axes[0].plot(*thin(run.x_m[:end], run.y_m[:end]), color=SERIES[number], lw=2.0, label=law)
        s, true = thin(run.travelled_m, np.abs(run.cross_track_error_m))
        axes[1].semilogy(s, np.maximum(true, 1e-4), color=SERIES[number], label=law)
        if leaving.room_m is not None:
            axes[1].plot(leaving.room_m, study.room_m, "o", color=SERIES[number], ms=7)
    track = study.tracks[REVERSE]
    axes[0].plot(*thin(track.x_m, track.y_m), color=INK, lw=4.0, alpha=0.2, label="path")
    result = study.results[TABLE_6_CORRECTED][BOTH]
    x, y, yaw = axle_poses(study, result, REVERSE, 20)
    cut = np.searchsorted(result.run.travelled_m[::20], (study.leaving[BOTH].room_m or 8.0))
    swept(axes[0], study.outline, x[: cut + 1], y[: cut + 1], yaw[: cut + 1], GREY, 1.0)
    axes[0].set_ylim(-2.6, 4.6)
    axes[0].legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=5)
    axes[0].set_title("reverse, corrected sign, until the room is left")
    axes[1].axhline(study.room_m, color=INK, lw=1.0, ls="--")
    axes[1].text(0.2, study.room_m * 1.1, f"room: {study.room_m:.2f} m", fontsize=9)
    finish(axes[1], "travelled (m)", "true error of the CG (m)", "", legend="lower right")
    axes[1].set_ylim(1e-3, 5)
    save(figure, stem)


def rear_axle_law(study: Study, stem: Path) -> None:
    """The law for the rear axle on the same plant, both directions."""
    figure, axes = sheet(1, 2, width=12.0, height=3.8)
    for direction, colour in ((FORWARD, BLUE), (REVERSE, RED)):
        run = study.rear_runs[direction]
        s, error, steer = thin(run.travelled_m, run.cross_track_error_m, run.steer_rad)
        name = direction if direction == FORWARD else "reverse, corrected sign"
        axes[0].plot(
            s, 1e3 * error, color=colour, label=f"{name}: max {1e3 * np.abs(run.cross_track_error_m).max():.2f} mm"
        )
        axes[1].plot(s, steer, color=colour, label=name)
    for bound in (-1.0, 1.0):
        axes[0].axhline(bound, color=GREY, ls="--", lw=1.0)
    finish(
        axes[0], "travelled (m)", "true error of the rear axle (mm)", "rear-axle law on eq. 11", legend="upper right"
    )
    finish(axes[1], "travelled (m)", "road-wheel angle (rad)", "steering, left positive in travel", legend=True)
    axes[0].set_ylim(-1.3, 1.9)
    save(figure, stem)


def in_controller(study: Study, stem: Path) -> None:
    """The laws in the controller: PID + DOB on the bus and one sample later; reverse with the corrected sign."""
    figure, axes = sheet(1, 3, width=14.5, height=4.0)
    for delay, colour in ((LATE, RED), (BUS, BLUE)):
        leg = find(study.lockstep.legs, "paper", PRINTED, delay, FORWARD)
        if leg is not None:
            s, e, steer = thin(leg.station_m, leg.e_y_m, leg.steer_rad, most=3000)
            name = f"{delay.total_ms:g} ms: rms {1e3 * leg.row.rms_e_y_m:.2g} mm"
            axes[0].plot(s, 1e3 * e, color=colour, lw=0.8 if delay == LATE else 1.8, label=name)
            axes[1].plot(s, steer, color=colour, lw=0.8 if delay == LATE else 1.8, label=f"{delay.total_ms:g} ms")
    finish(axes[0], "station (m)", "e_y (mm)", "PID+DOB forward, one sample of delay", legend="lower left")
    finish(axes[1], "station (m)", "road-wheel angle (rad)", "its steering", legend="lower left")
    for one in axes[:2]:
        low, high = one.get_ylim()
        one.set_ylim(low - 0.25 * (high - low), high)
    for law, name, colour in (("dob", DOB, GREEN), ("pid", PID, ORANGE), ("paper", BOTH, BLUE)):
        leg = find(study.lockstep.legs, law, CORRECTED, BUS, REVERSE)
        if leg is not None:
            s, error = thin(leg.station_m, leg.cross_track_error_m)
            axes[2].plot(s, 1e3 * error, color=colour, label=name)
            if not leg.row.is_complete:
                axes[2].plot(s[-1], 1e3 * error[-1], "x", color=colour, ms=9, mew=2)
    leg = find(study.lockstep.legs, CAR, CORRECTED, BUS, REVERSE)
    if leg is not None:
        s, error = thin(leg.station_m, leg.cross_track_error_m)
        axes[2].plot(s, 1e3 * error, color=INK, label="law of this project")
    finish(axes[2], "station (m)", "true error of the CG (mm)", "reverse, corrected sign (x: stopped)", legend=True)
    save(figure, stem)


def rates(study: Study, stem: Path) -> None:
    """The kick at the start: the rate of a step is the step over the sampling interval."""
    figure, axes = sheet(1, 2, width=12.0, height=4.2, sharey=True)
    for one, direction in zip(axes, (FORWARD, REVERSE), strict=True):
        for law, colour, style in ((DOB, GREEN, "-"), (PID, ORANGE, "-"), (BOTH, BLUE, "--")):
            one.loglog(
                1e3 * study.rates.kick_steps_s,
                study.rates.kicks_radps[direction][law],
                style,
                color=colour,
                lw=2,
                label=law,
            )
        printed = TABLES_5_6[direction][PID].max_steer_rate_radps
        if study.car.is_papers:
            one.axhline(printed, color=RED, lw=1.0, ls="--")
            one.text(4.0, printed * 1.08, f"printed: {printed:.2f} rad/s", color=RED, fontsize=9.5, ha="right")
        step = study.rates.printed_step_s[direction]
        if step is not None:
            one.plot(1e3 * step, printed, "o", color=RED, ms=8)
            one.annotate(f"{1e3 * step:.2f} ms", (1e3 * step, printed), (8, 12), textcoords="offset points", color=RED)
        finish(
            one,
            "step of the simulation (ms)",
            "largest rate of the first 0.05 s (rad/s)" if one is axes[0] else "",
            direction,
            legend="lower left",
        )
    save(figure, stem)
