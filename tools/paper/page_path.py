"""Sections of the page: path, model, speed."""

from collections.abc import Callable
from typing import Any

from tools.paper.html import OURS, SAYS, SO, WRONG, equation, note, number, p, table
from tools.paper.laws import DOB
from tools.paper.path_study import AS_PRINTED, CORRECTED
from tools.paper.plant import CORRECTED as CORRECTED_SIGN
from tools.paper.plant import FORWARD, PRINTED, REVERSE, Plant, zeros_and_poles
from tools.paper.printed import START_REVERSE
from tools.paper.study import TABLE_5, Study

Picture = Callable[[str, str], str]


def path(study: Study, content: dict[str, Any], picture: Picture) -> str:
    """Eq. 1 to 10."""
    figures = {name: result.figures() for name, result in study.paths.items()}
    rows = [
        (
            name,
            f"{f['constraint_residual']:.1e}",
            f"{f['curvature_jump_1pm']:.1e}",
            f"{f['curvature_slope_jump_1pm2']:.1e}",
            f"{1e3 * f['fit_rms_x_m']:.1f} / {1e3 * f['fit_rms_y_m']:.1f}",
            f"{f['start_curvature_1pm']:+.3f}",
            f"{f['stop_curvature_1pm']:+.3f}",
            f"{f['max_curvature_1pm']:.3f}",
            f"{f['rms_curvature_1pm']:.3f}",
            f"{f['stop_x_m']:.4f}, {f['stop_y_m']:.4f}",
        )
        for name, f in figures.items()
    ]
    printed, fixed = figures[AS_PRINTED], figures[CORRECTED]
    x_end = START_REVERSE[0]
    clearance = study.results[TABLE_5][DOB].min_clearance_m
    best = min((c for c in study.choices if c.m == 4 and c.q == 3), key=lambda c: c.rms_curvature_1pm)
    six = next(c for c in study.choices if (c.m, c.p, c.q) == (4, 6, 3))
    even = sorted((c for c in study.choices if c.m == 4 and c.q == 3), key=lambda c: c.p)
    list_p = ", ".join(f"p = {c.p}: {c.rms_curvature_1pm:.3f}" for c in even)
    three = next((c for c in study.choices if (c.m, c.p, c.q) == (4, 6, 2)), None)
    return "".join(
        [
            note(
                SAYS,
                "A few waypoints, spanned by modified Akima interpolation (Figure 2), are cut into m = 4 "
                "segments "
                "(Figure 3). Each segment is a polynomial of order p = 6 in &lambda; (eq. 1). Least "
                "squares (eq. 4) under "
                "equality of the derivatives up to q = 3 at the joints (eq. 5 to 8) is eq. 9, solved with "
                "fmincon. Curvature is eq. 10.",
            ),
            picture(
                "figure_01",
                "Figure 1. The course with both options, and the body that the path has to bring through "
                "it. The right side is the mirror image: its curvature is the exact negative.",
            ),
            picture("figure_02", "Figure 2. Sample waypoints and what modified Akima interpolation makes of them."),
            picture("figure_03", "Figure 3. Waypoints in four segments."),
            table(
                "Table 1. Setting parameters",
                ("", "paper", "ours"),
                [(k, str(c["paper"]), str(c["ours"])) for k, c in content["table1"].items()],
            ),
            note(
                OURS,
                "Eq. 9 is a linear least-squares problem with linear constraints; no optimiser is needed. "
                "It is solved in the null "
                f"space of &Gamma;: the residual of eq. 8 is {printed['constraint_residual']:.1e}, "
                "curvature jumps at joints by "
                f"{printed['curvature_jump_1pm']:.1e} 1/m and its slope by "
                f"{printed['curvature_slope_jump_1pm2']:.1e} 1/m². "
                "The paper prints no waypoints; these are fitted to the DOB-only cells of Tables 5 and 6 "
                "(four numbers to eight cells).",
            ),
            picture(
                "figure_04",
                "Figure 4. The optimised path among the cones; below, how far it is from the waypoints' curve.",
            ),
            picture(
                "figure_05",
                "Figure 5. Curvature forward, and in reverse by &ldquo;flip and invert&rdquo;: the path "
                "from its other end, seen in the direction of travel (heading + &pi;).",
            ),
            table(
                "Eq. 9 in four variants, same waypoints",
                (
                    "ends and joints",
                    "residual",
                    "jump of &kappa;",
                    "jump of &kappa;&prime;",
                    "misfit x / y (mm rms)",
                    "&kappa; at start",
                    "&kappa; at stop",
                    "max &kappa; (1/m)",
                    "rms &kappa;",
                    "stop x, y (m)",
                ),
                rows,
            ),
            note(
                WRONG,
                "Eq. 5 equates derivatives by &lambda;, in which every segment has length 1. Segments of "
                "unequal length then force the "
                "parameter to run unevenly; the k-th derivative has to be divided by h<sup>k</sup> (h: "
                "the segment's length). And nothing is "
                "asked of the two ends: the fitted path begins with a curvature of "
                f"{printed['start_curvature_1pm']:+.2f} 1/m and ends with "
                f"{printed['stop_curvature_1pm']:+.2f} 1/m, where the car should stand straight. The end "
                f"pose of eq. 21, x = {x_end} m instead of "
                f"15.24 m, is a mark of it; ours ends at ({printed['stop_x_m']:.4f}, {printed['stop_y_m']:.4f}) m.",
            ),
            note(
                SO,
                "Scale and pin: position, heading and curvature at both ends. The largest curvature is "
                f"then {fixed['max_curvature_1pm']:.3f} 1/m "
                "and zero at the ends. Pinning position and heading alone is not enough: the curvature "
                "must be pinned too.",
            ),
            "<h3>Is m = 4, p = 6, q = 3 the best choice?</h3>",
            note(
                SAYS,
                "Order 6 gives the smallest rms curvature; order 3 of continuity is needed for a smooth "
                "curvature; four segments, one turn each.",
            ),
            picture(
                "choices_m_p_q",
                "Sweep of m, p and q around Table 1 (marked). Beside the curvature by which the paper "
                "chose stands the misfit to the waypoints: a small rms curvature is easily had by missing "
                "them.",
            ),
            note(
                OURS,
                f"rms curvature in 1/m on the printed variant: {list_p}. The smallest is at p = {best.p} "
                f"({best.rms_curvature_1pm:.3f}), "
                f"p = 6 has {six.rms_curvature_1pm:.3f}. Misfits: {1e3 * best.fit_rms_m:.0f} mm at p = "
                f"{best.p}, {1e3 * six.fit_rms_m:.0f} mm at p = 6. "
                + (
                    f"With q = 2 the curvature's slope jumps by {three.slope_jump_1pm2:.2g} 1/m² at the joints."
                    if three
                    else ""
                ),
            ),
            note(
                SO,
                "The rms curvature alone does not single out p = 6: it trades curvature against misfit. q "
                "= 3 is needed, as claimed, "
                "and is also enough.",
            ),
            picture(
                "swept_body",
                "The body along the path. Above: the centre of gravity on the reconstructed path. Below: "
                "the rear axle on a lane change of its own, from 6 ft to 33 ft.",
            ),
            note(
                WRONG,
                "The paper never draws the body. Not every detail of its path can be known from its tables; on this "
                f"reconstruction the least clearance to a cone is {clearance:.2f} m forward (a cone counts as touched "
                f"within {study.course.cone_radius_m:.2f} m of its axis, below zero the body stands over it).",
            ),
        ]
    )


def model(study: Study, content: dict[str, Any], picture: Picture) -> str:
    """Eq. 11."""
    rows = []
    for plant in (
        Plant(study.car, FORWARD, PRINTED),
        Plant(study.car, REVERSE, PRINTED),
        Plant(study.car, REVERSE, CORRECTED_SIGN),
    ):
        for v in (0.1, 0.5, 1.0):
            g = zeros_and_poles(plant, v)
            slow, fast = g.zeros
            rows.append(
                (
                    plant.name,
                    f"{v:g}",
                    ("!" if slow.real > 0 else "") + f"{slow.real:+.4f}",
                    f"{fast.real:.0f}",
                    ", ".join(_root(q) for q in g.poles),
                    f"{g.gain:.1f}",
                )
            )
    table_2 = [(symbol, cell["paper"], cell["ours"]) for symbol, cell in content["table2"].items()]
    lr = study.car.rear_m if study.car.is_papers else study.car.front_m
    return "".join(
        [
            note(
                SAYS,
                "A linear single-track model with the path-tracking error at a preview point "
                "l<sub>s</sub> = K V ahead of the centre of gravity (Figure 6). "
                "Reverse is a car that steers with its rear wheels, with front and rear parameters interchanged.",
            ),
            picture(
                "figure_06",
                "Figure 6. The path-tracking scenario. e<sub>y</sub> is measured at the preview point "
                "against the tangent at the foot point of the centre of gravity; the true error is "
                "another length.",
            ),
            equation(
                "d/dt [&beta;, r, &Delta;&psi;, e<sub>y</sub>] = A(V) [&beta;, r, &Delta;&psi;, "
                "e<sub>y</sub>] + B(V) [&delta;<sub>f</sub>, &delta;<sub>r</sub>] + [0, 0, &minus;V, "
                "&minus;l<sub>s</sub>V] &rho;<sub>ref</sub>, &nbsp; "
                "B<sub>22</sub> printed: + C<sub>r</sub> l<sub>r</sub> / I<sub>z</sub>, &nbsp; right: "
                "&minus; C<sub>r</sub> l<sub>r</sub> / I<sub>z</sub>"
            ),
            table("Table 2. Parameters", ("symbol", "paper", "here"), table_2, words=True),
            note(
                WRONG,
                "A force at the rear axle to the left turns the car to the right: B<sub>22</sub> is "
                "negative. With the printed sign "
                "and the axles interchanged, the car in reverse is a copy of the car going forward; "
                "everything that follows looks as good in "
                "Table 6 as in Table 5, on a car that does not exist.",
            ),
            table(
                "G(s) = e<sub>y</sub> / &delta;: zeros and poles in rad/s",
                ("plant", "V (m/s)", "slow zero", "fast zero", "poles", "high-frequency gain"),
                rows,
            ),
            picture(
                "poles_and_zeros",
                "Zeros and poles over the speed. Left: the slow zero, at &minus;V/(lr + ls) for the "
                "printed plant in both directions, at +V/(lr &minus; ls) for the true one in reverse. "
                "Right: the tyres, beyond what a 100 Hz controller sees.",
            ),
            note(
                OURS,
                "The printed plant in reverse has the zeros of the forward one. With the right sign the "
                "slow zero lies in the right half-plane, at "
                f"V/(l &minus; l<sub>s</sub>) with l = {lr:g} m: the point that the paper tracks swings "
                "out to the wrong side first.",
            ),
            picture(
                "right_half_plane",
                "What the DOB does with it: it inverts G, the zero becomes an unstable pole. "
                "e<sub>y</sub> stays as small as before while the steering runs away and the car leaves "
                "the cones. A test that looks only at e<sub>y</sub> passes.",
            ),
            note(
                SO,
                "Track the rear axle instead: kinematically it is minimum phase in both directions, with "
                "the same gains. "
                "Model the tyres in the plant, but invert only the kinematics: the tyre poles at "
                "&minus;200 to &minus;4700 rad/s lie beyond the sampling rate, "
                "and the fast zero is theirs too.",
            ),
        ]
    )


def _root(root: complex) -> str:
    return f"{root.real:.0f}" if abs(root.imag) < 1e-9 else f"{root.real:.0f} &plusmn; {abs(root.imag):.0f}j"


def speed(study: Study, content: dict[str, Any], picture: Picture) -> str:
    """Table 3."""
    rows = [(name, number(cell["paper"]), number(cell["ours"])) for name, cell in content["table3"].items()]
    plan = study.motions[FORWARD]
    lateral = float((plan.speed_mps**2 * abs(study.results[TABLE_5][DOB].run.curvature_1pm)).max()) / 9.80665
    ramp = float(
        plan.time_s[(plan.speed_mps < 0.999 * plan.speed_mps.max()) & (plan.station_m < 0.5 * plan.station_m[-1])].max()
    )
    return "".join(
        [
            table("Table 3. Conditions of the schedule", ("", "paper", "ours"), rows),
            picture("figure_07", "Figure 7. Scheduled speed and preview distance."),
            note(
                OURS,
                f"{plan.time_s[-1]:.1f} s for {study.tracks[FORWARD].length_m:.2f} m. The lateral limit "
                "never binds: the largest lateral "
                f"acceleration is {lateral:.3f} g of 0.05 g. Each ramp takes {ramp:.2f} s.",
            ),
            note(
                WRONG,
                "What limits the speed of a drive-by-wire car here is not in Table 3: the steering rate. "
                "A rack of 500 deg/s at 14.8:1 turns "
                "the wheels by 0.59 rad/s.",
            ),
            note(
                SO,
                "Put the steering rate among the limits of the profile, and start from standstill instead of 0.1 m/s.",
            ),
            p(""),
        ]
    )
