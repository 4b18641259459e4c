"""Sections of the page: the disturbance observer, sampling, parameter space."""

from collections.abc import Callable

from tools.paper.firmware_law import FirmwareRun
from tools.paper.html import OURS, SAYS, SO, WRONG, embedded, equation, note, number, table
from tools.paper.in_lockstep import LegRow
from tools.paper.laws import BOTH, DOB, PID
from tools.paper.loops import Loops
from tools.paper.plant import FORWARD, REVERSE
from tools.paper.sampled import METHODS
from tools.paper.sampled_run import BANDWIDTHS_RADPS, PATHS
from tools.paper.simulate import Figures
from tools.paper.study import TABLE_5, TABLE_6, Study

Picture = Callable[[str, str], str]


def path_name(delay_samples: int, lag_s: float) -> str:
    """Delay and lag in words."""
    delay = "no delay" if delay_samples == 0 else f"{delay_samples} sample{'s' if delay_samples > 1 else ''}"
    return delay if lag_s == 0.0 else f"{delay}, {1e3 * lag_s:.0f} ms lag"


def observer(study: Study, loops: Loops, picture: Picture) -> str:
    """Eq. 12 to 18."""
    rows = []
    for law in (DOB, PID, BOTH):
        for index in (0, len(loops.speeds_mps) // 2, len(loops.speeds_mps) - 1):
            m = loops.margins[law][index]
            rows.append(
                (
                    law,
                    f"{loops.speeds_mps[index]:.2f}",
                    f"{m.crossover_radps:.1f}",
                    f"{m.phase_deg:.1f}",
                    "none" if m.gain == float("inf") else f"{m.gain:.1f}",
                    ("!" if m.delay_s < 0.02 else "") + f"{1e3 * m.delay_s:.1f}",
                    f"{m.disk:.2f}",
                )
            )
    at_100 = loops.margins[DOB][0].delay_s * 100.0
    choices = [
        (
            f"{o.bandwidth_radps:g}",
            f"{o.nominal_factor:g}",
            f"{1e3 * f.max_e_y_m:.2f}",
            f"{1e3 * f.max_cross_track_m:.0f}",
        )
        for o, f in study.observers.items()
    ]
    return "".join(
        [
            note(
                SAYS,
                "The plant with multiplicative uncertainty and a disturbance (eq. 12, Figure 8) should "
                "behave as its nominal model (eq. 14); "
                "filtered by Q so that it can be built, this is eq. 16 (Figure 9). Eq. 17 gives its "
                "transfer functions; Q is of second order (eq. 18), "
                "&omega;<sub>n</sub> = 100 rad/s, G<sub>n</sub> = 1.01 G. A feedback controller C may be "
                "added (Figure 10).",
            ),
            picture("figure_08", "Figure 8. Plant with uncertainty and disturbance."),
            picture("figure_09", "Figure 9. The disturbance observer."),
            picture("figure_10", "Figure 10. Observer with feedback controller."),
            equation(
                "eq. 17: &nbsp; y/u<sub>n</sub> = G<sub>n</sub>G / (G<sub>n</sub>(1&minus;Q) + GQ), "
                "&nbsp; y/d = G<sub>n</sub>(1&minus;Q) / (G<sub>n</sub>(1&minus;Q) + GQ), &nbsp; y/n = "
                "&minus;GQ / (G<sub>n</sub>(1&minus;Q) + GQ)"
            ),
            picture(
                "equation_17",
                "Eq. 17 at 1 m/s: the plant as modelled, and with 50 ms of lag or 10 ms of delay that the "
                "nominal model does not know.",
            ),
            table(
                "Margins of the loop, cut at the steering command (continuous, no delay)",
                (
                    "law",
                    "V (m/s)",
                    "crossover (rad/s)",
                    "phase margin (deg)",
                    "gain margin",
                    "delay margin (ms)",
                    "disk margin",
                ),
                rows,
            ),
            picture("margins", "Margins over the speed, and the DOB's delay margin over its bandwidth."),
            table(
                "DOB alone, forward: other bandwidths, other nominal plants",
                ("&omega;<sub>n</sub> (rad/s)", "G<sub>n</sub> / G", "max e<sub>y</sub> (mm)", "max true error (mm)"),
                choices,
            ),
            note(
                OURS,
                "As G<sub>n</sub> is a multiple of G, the DOB's loop is Q / (1.01 (1 &minus; Q)) at every "
                "speed: a phase margin of "
                f"{loops.margins[DOB][0].phase_deg:.0f}&deg; and a delay margin of "
                f"{at_100:.2f}/&omega;<sub>n</sub>, {1e3 * loops.margins[DOB][0].delay_s:.1f} ms at 100 "
                "rad/s. "
                "With the PID it shrinks as the speed grows. e<sub>y</sub> goes with "
                "1/&omega;<sub>n</sub>; the factor 1.01 in "
                "place of 1 changes it by one per cent, and the true error hardly depends on any of it.",
            ),
            note(
                WRONG,
                "Relative degree 2, for which Q was made of second order, is an artefact of the tyres: "
                "their poles are faster than any steering rack. "
                "And the observer alone is not a controller: between y and u<sub>n</sub> it leaves "
                "G<sub>n</sub>, a double integrator. "
                "In the DOB-only rows of Tables 5 and 6 nothing brings back a car that starts beside its path.",
            ),
            note(
                SO,
                "Delay and lag belong into G<sub>n</sub> (and a copy of them into the u-path of the "
                "observer), and the bandwidth has to respect them.",
            ),
        ]
    )


def sampling(study: Study, loops: Loops, picture: Picture) -> str:
    """100 Hz."""
    runs = {(run.law, run.bandwidth_radps, run.path): run for run in loops.sampled}
    rows = []
    for bandwidth in BANDWIDTHS_RADPS:
        cells = [runs[(BOTH, bandwidth, path)].max_e_y_m for path in PATHS]
        rows.append((f"PID+DOB, &omega;<sub>n</sub> = {bandwidth:g}", *(_cell(value) for value in cells)))
    rows.append(("PID alone", *(_cell(runs[(PID, 100.0, path)].max_e_y_m) for path in PATHS)))
    limits = [
        (f"{law}, {path_name(*path)}", *(_bandwidth(by_method[method]) for method in METHODS))
        for law, by_path in loops.bandwidths.items()
        for path, by_method in by_path.items()
    ]
    return "".join(
        [
            note(SAYS, "Nothing: the paper's controller is continuous, without delay and with an ideal actuator."),
            note(
                OURS,
                "The plant exact behind a zero-order hold, delay in whole samples of 10 ms, a first-order "
                "lag for the rack; Q and Q/G<sub>n</sub> "
                "discretised alike by each common method. Stable is what has no eigenvalue outside the "
                "unit circle at 0.1, 0.5 and 1 m/s (bandwidths up to 200 rad/s tried).",
            ),
            picture("discretisations", "Up to which bandwidth each discretisation is stable."),
            table("Highest stable &omega;<sub>n</sub> in rad/s at 100 Hz", ("", *METHODS), limits),
            table(
                "Simulations of Table 5 at 100 Hz: max e<sub>y</sub> in mm (kinematic ZOH inverse)",
                ("", *(path_name(*path) for path in PATHS)),
                rows,
            ),
            picture(
                "sampled_runs",
                "One sample of delay at the paper's bandwidth: a growing oscillation; the run ends where "
                "the wheels would have to turn by 90&deg;.",
            ),
            _firmware(study),
            note(
                WRONG,
                "&omega;<sub>n</sub> = 100 rad/s needs a system without latency. One sample at 100 Hz, or "
                "20 ms of rack, and PID + DOB is unstable by every method but "
                "pole-zero matching, which only wins because its Q carries two samples of delay of its "
                "own. Prewarping is irrelevant. Forward Euler never works: "
                "the inverse of the fast zero is faster than the sampling.",
            ),
            note(
                SO,
                "With a real car's latency (2 samples and 0.1 s of rack) the paper's structure is stable "
                "at a few rad/s only, with errors of more than a "
                "centimetre. The discretisation to take is the inverse of the kinematic zero-order-hold "
                "model; what buys bandwidth back is the model of delay and lag inside the observer.",
            ),
        ]
    )


def _firmware(study: Study) -> str:
    """The firmware's own discretised law on eq. 11."""
    buses = list(dict.fromkeys(run.bus for run in study.firmware))
    runs = {(run.law, run.direction, run.bus): run for run in study.firmware}
    tables = {FORWARD: TABLE_5, REVERSE: TABLE_6}
    rows = []
    for direction, name in tables.items():
        for law in (DOB, PID, BOTH):
            continuous = study.results[name][law].figures
            cells = []
            for bus in buses:
                run = runs[(law, direction, bus)]
                unstable = f"!unstable after {run.travelled_m:.1f} m"
                cells.append(unstable if run.max_e_y_m == float("inf") else three(run))
            rows.append((f"{law}, {direction}", three(continuous), *cells))
    return "".join(
        [
            table(
                "The firmware's law, from its tables by (direction, speed): max e<sub>y</sub> (mm) / rms "
                "(mm) / angle (rad)",
                ("law", "continuous", *buses),
                rows,
            ),
            note(
                OURS,
                "The same equations as the controller's code runs them (firmware_py/core/paper_law.py): "
                "what remains of "
                "Tables 5 and 6 at 100 Hz is the PID's cells as they are, the DOB's at about 1.4 times, the "
                "combination's at 1.2 to 1.4 times; one sample later only the two that hardly need the "
                "observer remain.",
            ),
        ]
    )


def three(found: Figures | FirmwareRun | LegRow) -> str:
    """Max and rms e_y in mm and the angle in rad, in a cell."""
    return f"{1e3 * found.max_e_y_m:.3g} / {1e3 * found.rms_e_y_m:.3g} / {found.max_steer_rad:.3f}"


def _cell(value_m: float) -> str:
    return "!unstable" if value_m == float("inf") else f"{1e3 * value_m:.3g}"


def _bandwidth(value: float) -> str:
    if value == 0.0:
        return "!never"
    return "&ge; 200" if value >= 199.0 else ("" if value >= 100.0 else "!") + f"{value:.0f}"


def parameter_space(study: Study, loops: Loops, picture: Picture) -> str:
    """Eq. 19."""
    rows, distances = [], []
    for case in loops.regions.values():
        least, fitted = case.least, case.fitted
        rows.append(
            (
                f"{case.plant.name}, {case.speed_mps:g} m/s",
                case.region.text().replace("<=", "&le;").replace(">=", "&ge;"),
                f"{least.x:.2f}, {least.y:.2f}",
                f"{fitted.x:.1f}, {fitted.y:.1f}",
                "~yes" if fitted.inside else "!no",
            )
        )
        for point, name in ((least, "least gains"), (fitted, "fitted gains")):
            found = "; ".join(f"{piece}: {d.distance:.3f}" for piece, d in point.distances.items())
            distances.append((f"{case.plant.name}, {case.speed_mps:g} m/s", name, found))
    refusals = "".join(f"<li>{name}: {why}</li>" for name, why in loops.refusals.items())
    gains = study.gains
    return "".join(
        [
            note(
                SAYS,
                "C(s) = k<sub>p</sub> + k<sub>i</sub>/s + k<sub>d</sub>s (eq. 19), scheduled by the "
                "speed; the gains are chosen as small as possible inside the "
                "admissible region of a D-stability region (Figures 11 to 13), on the boundary CRB d1. "
                "Neither region nor gains are printed. The text announces "
                "forward motion at maximum and minimum speed, Figure 13 is captioned &ldquo;backward "
                "motion at maximum speed&rdquo;.",
            ),
            picture(
                "figure_11",
                "Figure 11. The D-stability region, here with its shift proportional to the speed, and "
                "the poles at the smallest admissible gains.",
            ),
            picture(
                "figure_12",
                "Figure 12. Admissible gains forward at 0.1 m/s: near the origin, and out to the fitted gains.",
            ),
            picture(
                "figure_13",
                "Figure 13. Admissible gains in reverse at 1 m/s with the printed sign (the same as forward).",
            ),
            table(
                "Smallest admissible gains and the fitted ones (kp, ki)",
                ("plant", "region", "smallest", "fitted to Table 5", "inside"),
                rows,
            ),
            table(
                "Distances to the boundaries, in sides of the window",
                ("plant", "point", "boundary: distance"),
                distances,
            ),
            "<h3>Step through it</h3>",
            embedded("explorer", loops.explorer, "admissible gains over speed and region"),
            f"<p>Regions that are empty, in the tool's own words:</p><ul>{refusals}</ul>",
            note(
                OURS,
                f"Fitted to the PID-only cells: k<sub>p</sub> = {number(gains.kp, 4)} rad/m, k<sub>i</sub> "
                f"= {number(gains.ki, 4)} rad/(m s), k<sub>d</sub> = {number(gains.kd, 3)} rad s/m. "
                "The boundary that holds the smallest gains from below is the real-root one at the shift "
                "(RRB d1) together with the damping wedge (CRB d2); "
                "there is no infinite-root boundary: k<sub>d</sub> does not reach the leading coefficient.",
            ),
            note(
                WRONG,
                "&ldquo;As small as possible&rdquo; gives gains less than a tenth of what Tables 5 and 6 "
                "need. And a region with a fixed shift in rad/s is empty at low "
                "speed: the slow zero at V/(l<sub>r</sub> + l<sub>s</sub>), 0.05 rad/s at 0.1 m/s, draws "
                "a pole to itself.",
            ),
            note(
                SO,
                "Design per metre of travel: shift, radius and gains scale with the speed, and one row of "
                f"gains serves all speeds. A PID with k<sub>p</sub> = {gains.kp:.0f} rad/m is "
                "not what smooths the DOB, as the text has it; it is a high-gain loop of its own.",
            ),
        ]
    )
