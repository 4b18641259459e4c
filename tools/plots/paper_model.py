"""The model and its loop in pictures: poles and zeros, margins, sampling at 100 Hz, parameter space."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tools.paper import frequency
from tools.paper.laws import BOTH, DOB, PID, TABLE_4_OBSERVER
from tools.paper.loops import Loops
from tools.paper.plant import CORRECTED, FORWARD, PRINTED, REVERSE, Plant, zeros_and_poles
from tools.paper.sampled import METHODS
from tools.paper.study import TABLE_6, TABLE_6_CORRECTED, Study
from tools.plots.paper_style import (
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
    RED,
    SERIES,
    finish,
    save,
    sheet,
    thin,
)
from tools.plots.parameter_space import draw_plane, draw_poles

MANY_SPEEDS = np.geomspace(0.1, 1.0, 60)


def plants(study: Study) -> dict[str, Plant]:
    """The three plants of eq. 11."""
    return {
        "forward": Plant(study.car, FORWARD, PRINTED),
        "reverse, sign as printed": Plant(study.car, REVERSE, PRINTED),
        "reverse, sign corrected": Plant(study.car, REVERSE, CORRECTED),
    }


def poles_and_zeros(study: Study, stem: Path) -> None:
    """Slow zero and fast poles and zero of G over the speed, both directions."""
    figure, axes = sheet(1, 2, width=12.0, height=4.6)
    for (name, plant), colour, style in zip(plants(study).items(), (BLUE, ORANGE, RED), ("-", "--", "-"), strict=True):
        found = [zeros_and_poles(plant, float(v)) for v in MANY_SPEEDS]
        slow = np.array([z.zeros[0].real for z in found])
        axes[0].plot(MANY_SPEEDS, slow, style, color=colour, lw=2.2, label=name)
        fast = np.array([abs(z.zeros[1]) for z in found])
        axes[1].loglog(MANY_SPEEDS, fast, style, color=colour, lw=2.0, label=f"fast zero, {name}")
    poles = np.array(
        [[abs(p) for p in zeros_and_poles(plants(study)["forward"], float(v)).poles[2:]] for v in MANY_SPEEDS]
    )
    axes[1].loglog(MANY_SPEEDS, poles, ":", color=INK, lw=1.6, label=None)
    axes[1].plot([], [], ":", color=INK, lw=1.6, label="tyre poles (all plants)")
    axes[1].axhline(2.0 * np.pi * 50.0, color=GREY, lw=1.0)
    axes[1].text(0.104, 2.0 * np.pi * 50.0 * 0.82, "half the sampling rate at 100 Hz", fontsize=9, color=GREY, va="top")
    arm = study.car.rear_m
    axes[0].plot(MANY_SPEEDS, -MANY_SPEEDS / (arm + 0.5 * MANY_SPEEDS), ":", color=GREY, label="-V / (lr + ls)")
    axes[0].plot(MANY_SPEEDS, MANY_SPEEDS / (arm - 0.5 * MANY_SPEEDS), "-.", color=GREY, label="V / (lr - ls)")
    axes[0].axhspan(0.0, 0.75, color=RED, alpha=0.06)
    axes[0].text(0.12, 0.62, "right half-plane", color=RED)
    axes[0].set_ylim(-0.55, 0.75)
    finish(axes[0], "speed (m/s)", "slow zero (rad/s)", "the zero that decides", legend="lower left")
    finish(
        axes[1],
        "speed (m/s)",
        "distance from the origin (rad/s)",
        "what lies beyond a 100 Hz controller",
        legend="lower left",
    )
    axes[1].set_ylim(80.0, None)
    axes[1].set_xticks([0.1, 0.2, 0.5, 1.0], ["0.1", "0.2", "0.5", "1"])
    save(figure, stem)


def right_half_plane(study: Study, stem: Path) -> None:
    """What inverting a right-half-plane zero does: e_y small, steering without bound, the car among the cones."""
    figure, axes = sheet(2, 2, width=12.5, height=7.4)
    good, bad = study.results[TABLE_6][DOB].run, study.results[TABLE_6_CORRECTED][DOB].run
    for run, colour, name in ((good, BLUE, "sign as printed"), (bad, RED, "sign corrected")):
        stop = np.flatnonzero(np.abs(run.steer_rad) > 100.0)
        end = int(stop[0]) if len(stop) else len(run.steer_rad)
        s, steer, e, true = thin(
            run.travelled_m[:end], run.steer_rad[:end], run.preview_error_m[:end], run.cross_track_error_m[:end]
        )
        axes[0, 0].plot(s, np.degrees(steer), color=colour, label=name)
        axes[0, 1].plot(s, 1e3 * e, color=colour, label=f"e_y, {name}")
        axes[1, 0].plot(s, true, color=colour, label=f"true error of the CG, {name}")
    axes[0, 0].set_ylim(-180, 180)
    axes[0, 0].axhspan(-28.6, 28.6, color=GREEN, alpha=0.1)
    axes[0, 0].text(0.2, 34, "what wheels can do", color=GREEN, fontsize=9)
    axes[0, 1].set_ylim(-20, 20)
    room = study.room_m
    axes[1, 0].axhspan(-room, room, color=GREEN, alpha=0.1)
    axes[1, 0].text(0.2, room - 0.09, f"room between body and cones, {room:.2f} m", color=GREEN, fontsize=9)
    axes[1, 0].set_ylim(-1.5, 1.5)
    leaving = study.leaving[DOB]
    if leaving.room_m is not None:
        axes[1, 0].axvline(leaving.room_m, color=RED, lw=1.0, ls=":")
        axes[1, 0].text(leaving.room_m + 0.15, -1.3, f"leaves it after {leaving.room_m:.1f} m", color=RED)
    finish(axes[0, 0], "", "road-wheel angle (deg)", "DOB alone in reverse: the steering", legend="lower left")
    finish(axes[0, 1], "", "e_y (mm)", "what the paper's measure sees", legend="lower left")
    finish(axes[1, 0], "travelled (m)", "m", "where the car is", legend="upper right")
    for plant, colour, name in (
        (plants(study)["reverse, sign as printed"], BLUE, "as printed"),
        (plants(study)["reverse, sign corrected"], RED, "corrected"),
    ):
        zeros = [zeros_and_poles(plant, float(v)).zeros[0].real for v in (0.1, 0.5, 1.0)]
        axes[1, 1].plot(
            zeros,
            np.zeros(3),
            "o",
            ms=11,
            mfc="white",
            mec=colour,
            mew=2.2,
            label=f"zeros of G, {name} (0.1, 0.5, 1 m/s)",
        )
    axes[1, 1].plot([0.0], [0.0], "x", ms=12, mew=2.5, color=INK, label="double pole of G")
    axes[1, 1].axvspan(0.0, 1.0, color=RED, alpha=0.06)
    axes[1, 1].axvline(0.0, color=GREY, lw=1.0)
    axes[1, 1].set(xlim=(-1.0, 1.0), ylim=(-0.6, 0.6))
    finish(axes[1, 1], "Re s (rad/s)", "Im s (rad/s)", "1/G has a pole where G has a zero", legend="lower center")
    save(figure, stem)


def equation_17(study: Study, stem: Path) -> None:
    """Eq. 17 with the nominal plant as designed, and with a rack of 50 ms in the true one."""
    figure, axes = sheet(1, 3, width=13.0, height=4.0)
    omega = np.geomspace(1e-1, 1e4, 1500)
    plant = plants(study)["forward"]
    g = frequency.plant_response(plant, 1.0, omega)
    q = frequency.low_pass(TABLE_4_OBSERVER, omega)
    nominal = TABLE_4_OBSERVER.nominal_factor * g
    for factor, colour, style, name in (
        (np.ones_like(g), BLUE, "-", "G = Gn / 1.01"),
        (1.0 / (1.0 + 0.05j * omega), RED, "--", "50 ms lag in G"),
        (np.exp(-0.01j * omega), ORANGE, "-.", "10 ms delay in G"),
    ):
        response = frequency.equation_17(g * factor, nominal, q)
        for one, values in zip(
            axes, (response.from_command / g, response.from_disturbance, response.from_noise), strict=True
        ):
            one.loglog(omega, np.abs(values), style, color=colour, label=name)
    for one, title in zip(axes, ("y / u_n, over G", "y / d", "y / n"), strict=True):
        finish(one, "frequency (rad/s)", "magnitude" if one is axes[0] else "", title)
        one.axvline(TABLE_4_OBSERVER.bandwidth_radps, color=GREY, lw=1.0, ls=":")
    axes[0].set_ylim(1e-2, 1e2)
    axes[1].set_ylim(1e-3, 1e2)
    axes[2].set_ylim(1e-3, 1e2)
    axes[0].legend(loc="lower left")
    save(figure, stem)


def margins(loops: Loops, stem: Path) -> None:
    """Phase, delay and disk margins over the speed, and the delay margin over the observer's bandwidth."""
    figure, axes = sheet(1, 4, width=15.0, height=3.9)
    for law, colour in ((DOB, GREEN), (PID, ORANGE), (BOTH, BLUE)):
        rows = loops.margins[law]
        axes[0].plot(loops.speeds_mps, [m.phase_deg for m in rows], color=colour, label=law)
        axes[1].semilogy(loops.speeds_mps, [1e3 * m.delay_s for m in rows], color=colour)
        axes[2].plot(loops.speeds_mps, [m.disk for m in rows], color=colour)
    axes[1].axhline(10.0, color=RED, lw=1.0, ls="--")
    axes[1].text(0.1, 10.4, "one sample at 100 Hz", color=RED, fontsize=9, va="bottom")
    bandwidth = np.geomspace(2.0, 300.0, 50)
    at_100 = loops.margins[DOB][0].delay_s * 100.0
    axes[3].loglog(bandwidth, 1e3 * at_100 / bandwidth, color=GREEN)
    for latency_ms, text in ((10.0, "1 sample"), (20.0, "2 samples"), (120.0, "2 samples + 0.1 s of rack")):
        axes[3].axhline(latency_ms, color=RED, lw=1.0, ls="--")
        axes[3].text(2.1, latency_ms * 1.06, text, color=RED, fontsize=9)
    finish(axes[0], "speed (m/s)", "phase margin (deg)", "phase", legend=True)
    finish(axes[1], "speed (m/s)", "delay margin (ms)", "delay")
    finish(axes[2], "speed (m/s)", "disk margin", "gain and phase at once")
    finish(axes[3], "bandwidth of Q (rad/s)", "delay margin of the DOB (ms)", f"DOB: {at_100:.2f} / ωn")
    axes[0].set_ylim(0, 120)
    axes[2].set_ylim(0, 2.1)
    save(figure, stem)


def discretisations(loops: Loops, stem: Path) -> None:
    """Highest stable bandwidth at 100 Hz by method, delay and lag."""
    figure, axes = sheet(1, 2, width=13.0, height=4.8, sharey=True)
    for one, (law, by_path) in zip(axes, loops.bandwidths.items(), strict=True):
        width = 0.8 / len(by_path)
        for number, (path, by_method) in enumerate(by_path.items()):
            at = np.arange(len(METHODS)) + (number - 0.5 * (len(by_path) - 1)) * width
            values = np.array([by_method[method] for method in METHODS])
            one.bar(
                at,
                np.maximum(values, 1.0),
                width,
                color=SERIES[number],
                label=path_name(path.delay_samples, path.lag_s),
            )
            for x, value in zip(at, values, strict=True):
                text = "never" if value == 0.0 else "≥200" if value >= 199.0 else f"{value:.0f}"
                one.text(x, max(value, 1.0) * 1.05, text, ha="center", va="bottom", fontsize=6.5, rotation=90)
        one.axhline(100.0, color=RED, lw=1.2, ls="--")
        one.set_yscale("log")
        one.set_ylim(1.0, 600.0)
        one.set_xticks(np.arange(len(METHODS)), [m.replace(" ", "\n") for m in METHODS], fontsize=8.5)
        finish(one, "", "highest stable bandwidth (rad/s)" if one is axes[0] else "", law)
        one.grid(visible=False, axis="x")
    axes[0].text(3.0, 104, "the paper's\n100 rad/s", color=RED, fontsize=9, va="bottom", ha="center")
    axes[1].legend(loc="upper center", ncols=3, fontsize=8.5)
    save(figure, stem)


def path_name(delay_samples: int, lag_s: float) -> str:
    """Delay and lag in words."""
    delay = "no delay" if delay_samples == 0 else f"{delay_samples} sample{'s' if delay_samples > 1 else ''}"
    return delay if lag_s == 0.0 else f"{delay} + {1e3 * lag_s:.0f} ms lag"


def sampled_runs(loops: Loops, stem: Path) -> None:
    """Steering of PID + DOB at 100 Hz without delay and with one sample."""
    figure, axes = sheet(1, 2, width=12.0, height=3.8)
    chosen = [r for r in loops.sampled if r.law == BOTH and r.bandwidth_radps == 100.0 and r.path.lag_s == 0.0][:2]
    for run, colour in zip(chosen, (BLUE, RED), strict=True):
        name = path_name(*run.path)
        axes[0].plot(run.time_s, run.steer_rad, color=colour, lw=1.0, label=name)
        axes[1].plot(run.time_s, 1e3 * run.e_y_m, color=colour, lw=1.0, label=name)
    axes[0].set_ylim(-1.7, 1.7)
    finish(axes[0], "time (s)", "road-wheel angle (rad)", "PID + DOB, ωn = 100 rad/s, at 100 Hz", legend="upper right")
    finish(axes[1], "time (s)", "e_y (mm)", "", legend="upper right")
    axes[1].set_ylim(-1.0, 1.0)
    save(figure, stem)


def figure_11(loops: Loops, stem: Path) -> None:
    """The D-stability region with the poles of the fitted gains, at both ends of the speed."""
    names = [name for name in ("figure 12", "forward at 1 m/s") if name in loops.regions]
    figure, axes = sheet(1, max(2, len(names)), width=12.5, height=5.6)
    for one, name in zip(axes, names, strict=False):
        case = loops.regions[name]
        poles = case.found.poles(case.least.x, case.least.y)
        draw_poles(one, case.region, {"": np.concatenate(list(poles.values()))})
        one.set_title(f"{case.plant.name}, {case.speed_mps:g} m/s: {case.region.text()}", fontsize=10)
    save(figure, stem)


def admissible(loops: Loops, name: str, stem: Path) -> None:
    """Figure 12 or 13: admissible (kp, ki), near the origin and out to the fitted gains."""
    case = loops.regions[name]
    figure, axes = sheet(1, 2, width=14.0, height=4.8)
    draw_plane(axes[0], case.found, {"least gains": case.least}, x_label="kp (rad/m)", y_label="ki (rad/(m s))")
    draw_plane(axes[1], case.wide, {"fitted to Table 5": case.fitted}, x_label="kp (rad/m)", y_label="ki (rad/(m s))")
    axes[0].set_title(f"{case.plant.name}, {case.speed_mps:g} m/s, kd = {case.found.plane.third:.2g}")
    axes[1].set_title("the same, out to the gains that Table 5 needs")
    save(figure, stem)
