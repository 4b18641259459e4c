"""Sections of the page: summary, simulations, reverse with the corrected sign, method."""

from collections.abc import Callable
from typing import Any

from tools.paper.html import OURS, SAYS, SO, WRONG, note, number, p, table
from tools.paper.laws import BOTH, DOB, FEEDFORWARD, LAWS, PID
from tools.paper.path_study import AS_PRINTED, CORRECTED
from tools.paper.plant import FORWARD, REVERSE
from tools.paper.rates import AT_POSE, ON_PATH
from tools.paper.study import TABLE_5, TABLE_6, TABLE_6_CORRECTED, Study

Picture = Callable[[str, str], str]

FIELDS = {
    "max_e_y_m": ("max e<sub>y</sub> (mm)", 1e3),
    "rms_e_y_m": ("rms e<sub>y</sub> (mm)", 1e3),
    "max_steer_rad": ("max steering angle (rad)", 1.0),
    "max_steer_rate_radps": ("max steering rate (rad/s)", 1.0),
    "max_cross_track_m": ("max true error of the CG (mm)", 1e3),
    "rms_cross_track_m": ("rms true error of the CG (mm)", 1e3),
    "min_clearance_m": ("least clearance to a cone (m)", 1.0),
}


def big_table(content: dict[str, Any], name: str, caption: str) -> str:
    """Table 5 or 6: paper / ours in each cell."""
    rows = []
    for field, (heading, scale) in FIELDS.items():
        cells = [content[name][law][field] for law in LAWS]
        shown = []
        for cell in cells:
            paper = None if cell["paper"] is None else scale * cell["paper"]
            shown.append(f"{number(paper, 4)} / <b>{number(scale * cell['ours'], 3)}</b>")
        rows.append((heading, *shown))
    return table(f"{caption}: paper / <b>ours</b>", ("", *LAWS), rows)


def summary(study: Study, content: dict[str, Any], picture: Picture) -> str:
    """The page in a screen."""
    both, alone = study.results[TABLE_5][BOTH].figures, study.results[TABLE_5]
    factor = min(alone[DOB].figures.max_e_y_m, alone[PID].figures.max_e_y_m) / both.max_e_y_m
    leaving = study.leaving[BOTH].room_m
    rear = max(figures["max_cross_track_m"] for figures in content["rear_axle_law"].values())
    checks = content["checks"]
    held = sum(check["holds"] for check in checks)
    boxes = (
        (
            f"{1e3 * both.max_e_y_m:.3f} mm",
            "largest e<sub>y</sub> of PID + DOB, forward" + (", the paper has 0.134 mm" if study.car.is_papers else ""),
        ),
        (f"{1e3 * both.max_cross_track_m:.0f} mm", "largest true error of the same run"),
        (
            "stays" if leaving is None else f"{leaving:.1f} m",
            "of travel in reverse with the right sign until the car has left its room between the cones",
        ),
        (f"{1e3 * rear:.2f} mm", "largest true error of the rear-axle law on the same plant, both directions"),
    )
    big = "".join(f"<div><strong>{value}</strong><span>{text}</span></div>" for value, text in boxes)
    rows = [
        (
            check["name"],
            ("~" if check["holds"] else "!") + f"{check['value']:.3g}",
            check["limit"].replace("+-", "&plusmn;").replace(">=", "&ge;").replace("<=", "&le;"),
        )
        for check in checks
    ]
    claims = [
        ("the path's curvature is smooth across the joints", "~yes", "to rounding, with q = 3"),
        ("p = 6 has the smallest rms curvature", "!no", "see the sweep: it trades curvature against misfit"),
        ("PID + DOB is far better than either alone in e<sub>y</sub>", "~yes", f"{factor:.0f} times"),
        (
            "the tracking is accurate",
            "!no",
            f"e<sub>y</sub> is; the car is {1e3 * both.max_cross_track_m:.0f} mm beside its path",
        ),
        (
            "PID smooths the DOB's steering",
            "!no",
            "it is a high-gain loop; its share of the steering is small because the error is",
        ),
        ("reverse is as good as forward", "!no", "only with the sign of eq. 11 as printed"),
        ("gains as small as possible", "!no", "Tables 5 and 6 need more than ten times as much"),
        ("steering rates of 2.4 to 3.2 rad/s", "!artefact", "of a path with free ends and of the simulation's step"),
    ]
    return "".join(
        [
            f'<div class="big">{big}</div>',
            table("The paper's claims", ("claim", "holds", ""), claims, words=True),
            picture(
                "cells",
                "Tables 5 and 6: ours over printed. Waypoints and gains are fitted to the green and "
                "orange columns, the blue ones are predictions; the rates of PID and PID + DOB are "
                "explained under &ldquo;Simulations&rdquo;.",
            ),
            f"<details><summary>{held} of {len(checks)} checks "
            f"hold</summary>{table('Checks', ('what', 'value', 'limit'), rows)}</details>",
        ]
    )


def simulations(study: Study, content: dict[str, Any], picture: Picture) -> str:
    """Tables 4 to 6."""
    table_4 = [(name, number(cell["paper"], 4), number(cell["ours"], 4)) for name, cell in content["table4"].items()]
    parts = [
        note(
            SAYS,
            "Eq. 11 with the parameters of Table 4, from the poses of eq. 20 and 21; DOB, PID and PID "
            "+ DOB (Figures 14 to 19), evaluated in Tables 5 and 6. "
            "The abstract also promises PID with feedforward; the tables lack it.",
        ),
        table("Table 4. Parameters", ("", "paper", "ours"), table_4),
        big_table(content, TABLE_5, "Table 5, forward"),
        big_table(content, TABLE_6, "Table 6, reverse, sign as printed"),
    ]
    number_of = 14
    for words in ("forward", "reverse with the printed sign"):
        for law in (DOB, PID, BOTH):
            parts.append(
                picture(
                    f"figure_{number_of}",
                    f"Figure {number_of}. {law}, {words}; in the inset e<sub>y</sub> in the scale of the true error.",
                )
            )
            number_of += 1
    figures = study.results[TABLE_5]
    parts += [
        note(
            OURS,
            "Waypoints come from the DOB-only cells, gains from the PID-only cells; PID + DOB is then "
            "a prediction. "
            "PID with feedforward (&delta; = L&rho;) reaches "
            f"{1e3 * figures[FEEDFORWARD].figures.max_e_y_m:.1f} mm: the feedforward is right for a "
            "steady turn, not for the "
            "point ahead of the car that e<sub>y</sub> means.",
        ),
        picture("feedforward", "PID with feedforward beside the others, forward."),
        picture(
            "true_error",
            "What e<sub>y</sub> hides: e<sub>y</sub> = 0 keeps the preview point on the tangent; the "
            "car itself is l<sub>s</sub> times its heading error beside the path.",
        ),
        note(
            WRONG,
            f"An e<sub>y</sub> of {1e3 * figures[BOTH].figures.max_e_y_m:.2f} mm is a true error of "
            f"the centre of gravity of {1e3 * figures[BOTH].figures.max_cross_track_m:.0f} mm, and "
            f"{abs(figures[BOTH].figures.final_heading_error_rad) * 57.3:.1f}&deg; of heading remain "
            "at the end. Whoever tracks the centre of gravity must let the heading differ from the "
            "path's by the side slip "
            "angle (0.2 rad here); a preview error forbids just that.",
        ),
        "<h3>Steering rates of 2.4 to 3.2 rad/s</h3>",
        _rates(study),
        picture(
            "rates",
            "Largest steering rate of the first 0.05 s over the step of the simulation, start exactly "
            "on the path. The PID's is a step over the step size: it has no limit.",
        ),
        note(
            SO,
            "Report the true error of the point that matters and the clearance of the body, not the "
            "quantity that the controller is built to make zero. "
            "Pin the path's ends; count a rate only where it does not depend on the step.",
        ),
    ]
    return "".join(parts)


def _rates(study: Study) -> str:
    rows = []
    for direction in (FORWARD, REVERSE):
        for path, start in ((AS_PRINTED, ON_PATH), (AS_PRINTED, AT_POSE), (CORRECTED, ON_PATH)):
            runs = {r.law: r for r in study.rates.runs if (r.direction, r.path, r.start) == (direction, path, start)}
            one = runs[PID]
            rows.append(
                (
                    f"{direction}, {path}, start {start}",
                    f"{one.start_curvature_1pm:+.3f}",
                    f"{1e3 * one.start_error_m:+.2f}",
                    f"{1e3 * one.start_heading_rad:+.1f}",
                    *(f"{runs[law].max_rate_radps:.3g} ({runs[law].max_rate_later_radps:.2f})" for law in LAWS),
                )
            )
    steps = [study.rates.printed_step_s[d] for d in (FORWARD, REVERSE)]
    words = (
        f"The printed 2.43 and 3.16 rad/s come out at steps of {1e3 * steps[0]:.2f} and {1e3 * steps[1]:.2f} ms."
        if steps[0] is not None and steps[1] is not None and study.car.is_papers
        else "Where the printed rates lie on these lines is the paper's own step."
    )
    return "".join(
        [
            table(
                "Largest steering rate in rad/s at a step of 1 ms (in brackets: from 0.5 m on)",
                (
                    "path and start",
                    "&kappa; at start (1/m)",
                    "e<sub>y</sub> at start (mm)",
                    "heading error (mrad)",
                    *LAWS,
                ),
                rows,
            ),
            note(
                OURS,
                "A path with free ends begins with a curvature: at the first instant e<sub>y</sub> has a "
                "slope of &minus;l<sub>s</sub>V&rho;, and the PID's derivative makes a step of "
                "k<sub>d</sub>l<sub>s</sub>V&rho; of it. As a rate, that is the step over the sampling "
                "interval; it comes with every law that has the derivative and not with the DOB alone, as "
                "in the paper. "
                f"{words} On a pinned path it vanishes. The start poses of eq. 20 and 21 beside a path "
                "with free ends give tens of rad/s, and the feedforward's step of L&rho; hundreds.",
            ),
        ]
    )


def reverse(study: Study, content: dict[str, Any], picture: Picture) -> str:
    """The corrected sign, and the law that works."""
    rows = []
    for law in LAWS:
        leaving = study.leaving[law]
        rows.append((law, *(("-" if value is None else f"{value:.2f}") for value in leaving)))
    rear = {d: f["max_cross_track_m"] for d, f in content["rear_axle_law"].items()}
    return "".join(
        [
            big_table(content, TABLE_6_CORRECTED, "Table 6 with the corrected sign (not in the paper)"),
            table(
                "Distance travelled in m until ...",
                (
                    "law",
                    f"the true error exceeds the {study.room_m:.2f} m between body and cones",
                    "a cone of the box is touched",
                    "the wheels would stand at 90&deg;",
                ),
                rows,
            ),
            picture(
                "divergence",
                "Reverse with the corrected sign, same gains: all four laws leave the path on the first "
                "metres, while the steering runs away.",
            ),
            note(
                WRONG,
                "All of Table 6. The PID's gain has the wrong sign for the true plant at low frequency, "
                "and the DOB inverts a zero in the right half-plane; both diverge, "
                "and the combination diverges while its e<sub>y</sub> still looks like a result.",
            ),
            picture(
                "rear_axle_law",
                "The rear-axle law on the same plant: feedforward of the curvature with the tyres' slip, "
                "PID per metre of travel, observer of the curvature disturbance.",
            ),
            note(
                SO,
                f"The same plant is easily driven when the point is chosen well: {1e3 * rear[FORWARD]:.2f} "
                f"mm forward and {1e3 * rear[REVERSE]:.2f} mm in reverse, true error of the rear axle, "
                "same "
                "gains in both directions (pose from exact kinematics, tyres of eq. 11). This is the law "
                "that the controller of this project drives by default.",
            ),
        ]
    )


def method(study: Study, content: dict[str, Any]) -> str:
    """How it was computed."""
    rows = [
        (
            f"{1e3 * step:g}",
            f"{1e3 * f.max_e_y_m:.6f}",
            f"{1e3 * f.rms_e_y_m:.6f}",
            f"{f.max_steer_rad:.6f}",
            f"{1e3 * f.max_cross_track_m:.4f}",
        )
        for step, f in study.convergence.items()
    ]
    fit = content["fit"]
    provenance = "; ".join(f"{key}: {fit[key]}" for key in fit if key not in ("waypoints_m", "gains"))
    points = ", ".join(f"({x:.3f}, {y:.3f})" for x, y in fit["waypoints_m"])
    scaled = (
        ""
        if study.car.is_papers
        else " The gains are scaled with the wheelbase, so that the loop in terms of curvature is the "
        "same; waypoints are the paper's."
    )
    return "".join(
        [
            p(
                "Eq. 11 with its law is one linear system whose matrix varies with the speed. The speed "
                "is held over a step and the curvature is linear in it; the step itself is "
                "a matrix exponential, exact however stiff the tyres are (poles to &minus;4700 rad/s at "
                "0.1 m/s, where explicit integration needs steps below 0.6 ms). What remains is of second "
                "order in the "
                "step; the tests hold it against an implicit Runge-Kutta method (Radau). The true "
                "position is integrated from yaw rate and side slip and projected on the path."
            ),
            table(
                "Convergence: PID + DOB forward",
                (
                    "step (ms)",
                    "max e<sub>y</sub> (mm)",
                    "rms e<sub>y</sub> (mm)",
                    "max angle (rad)",
                    "max true error (mm)",
                ),
                rows,
            ),
            p(f"Fit ({provenance}). Waypoints in m: {points}.{scaled}"),
            p(
                "The reconstruction is not unique: where along the course the turn lies hardly shows in "
                "the printed cells. The path's frame (origin at the centre of gravity in the middle of "
                "the box) is "
                "inferred; it is the only one in which the car starts inside the box with the end pose of eq. 21."
            ),
        ]
    )
