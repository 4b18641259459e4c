"""The paper's tables with ours beside it, for people, for machines, and what must hold of them."""

from math import isinf
from typing import Any, NamedTuple

from tools.paper.firmware_law import NAMES
from tools.paper.in_lockstep import BUS, LATE, find
from tools.paper.laws import BOTH, DOB, LAWS, PID, TABLE_4_OBSERVER
from tools.paper.path_study import CORRECTED
from tools.paper.plant import FORWARD, PRINTED, REVERSE
from tools.paper.printed import TABLE_1, TABLES_5_6, Printed
from tools.paper.study import CASES, TABLE_5, TABLE_6, TABLE_6_CORRECTED, Result, Study

ALONE_WITHIN, TOGETHER_WITHIN = 0.20, 0.35
"""How far the reproduction may be from the printed cells: DOB and PID, which were fitted, and PID + DOB, predicted."""
JUDGED = ("max_e_y_m", "rms_e_y_m", "max_steer_rad")
BETTER_BY = 40.0
REAR_AXLE_WITHIN_M = 1e-3
RESIDUAL_WITHIN, JUMP_WITHIN = 1e-10, 1e-9
FIELDS = (*JUDGED, "max_steer_rate_radps", "max_cross_track_m", "rms_cross_track_m", "min_clearance_m")


class Check(NamedTuple):
    """One thing that must hold: what, its value and the limit it is held against, and whether it holds."""

    name: str
    value: float
    limit: str
    holds: bool


def cell(paper: float | str | None, ours: float | str) -> dict[str, Any]:
    """One cell: the printed figure, or None where the paper has none, beside ours."""
    return {"paper": paper, "ours": ours}


def printed_cells(table: str, law: str, study: Study) -> Printed | None:
    """What the paper prints for a column; nothing for another car than its own or the sign that it did not use."""
    if table == TABLE_6_CORRECTED or not study.car.is_papers:
        return None
    return TABLES_5_6[CASES[table][0]].get(law)


def column(table: str, law: str, study: Study) -> dict[str, dict[str, Any]]:
    """One column of Table 5 or 6, by field."""
    result: Result = study.results[table][law]
    printed = printed_cells(table, law, study)
    paper = printed._asdict() if printed else {}
    ours = {**result.figures._asdict(), "min_clearance_m": result.min_clearance_m}
    return {field: cell(paper.get(field), ours[field]) for field in FIELDS}


def small_tables(study: Study) -> dict[str, dict[str, dict[str, Any]]]:
    """Tables 1 to 4: the paper's numbers beside those that this run used."""
    car, own = study.car, study.car.is_papers
    schedule = study.schedule
    table4 = {
        "Cf_n_per_rad": (3e5, car.front_stiffness), "lf_m": (2.0, car.front_m),
        "Cr_n_per_rad": (3e5, car.rear_stiffness), "lr_m": (2.0, car.rear_m),
        "M_kg": (3000.0, car.mass_kg), "Iz_kgm2": (5113.0, car.inertia_kgm2),
        "omega_n_radps": (100.0, TABLE_4_OBSERVER.bandwidth_radps), "xi": (0.707, TABLE_4_OBSERVER.damping),
    }  # fmt: skip
    table3 = {
        "max_lateral_g": (0.05, schedule.lateral_g), "max_longitudinal_g": (0.05, schedule.longitudinal_g),
        "max_speed_mps": (1.0, schedule.max_speed_mps), "min_speed_mps": (0.1, schedule.min_speed_mps),
        "preview_constant_s": (0.5, schedule.preview_time_s),
    }  # fmt: skip
    path = study.paths[CORRECTED]
    ours_1 = {
        "m": len(path.fit.length_m), "p": path.fit.coefficients.shape[1] - 1, "q": TABLE_1["q"]
    }  # fmt: skip
    return {
        "table1": {key: cell(TABLE_1[key], ours_1[key]) for key in TABLE_1},
        "table2": {symbol: cell(meaning, name) for symbol, (meaning, name) in TABLE_2.items()},
        "table3": {key: cell(*pair) for key, pair in table3.items()},
        "table4": {key: cell(paper if own else None, ours) for key, (paper, ours) in table4.items()},
    }


TABLE_2 = {
    "beta": ("side slip angle", "beta, rad, at the centre of gravity"),
    "r": ("yaw rate", "yaw_rate, rad/s, left positive"),
    "dpsi_p": ("heading error", "heading_error, rad, against the path's tangent at the foot point"),
    "e_y": ("path-tracking error", "preview_error, m, at l_s ahead of the centre of gravity, left positive"),
    "C_f": ("front tyre cornering stiffness", "front_stiffness, N/rad, per axle"),
    "l_f": ("distance from CG to front axle", "front_m, m"),
    "C_r": ("rear tyre cornering stiffness", "rear_stiffness, N/rad, per axle"),
    "l_r": ("distance from CG to rear axle", "rear_m, m"),
    "M": ("vehicle mass", "mass_kg, kg"),
    "V": ("vehicle velocity", "speed_mps, m/s, above zero in the direction of travel"),
    "l_s": ("preview distance", "preview_time_s * speed_mps, m"),
    "I_z": ("yaw moment of inertia", "inertia_kgm2, kg m^2"),
    "rho_ref": ("reference path curvature", "curvature_1pm, 1/m, left positive in travel"),
    "M_zd": ("yaw moment disturbance", "zero in the paper and here"),
    "K": ("preview scheduling constant", "preview_time_s, s"),
}
"""Symbol: what the paper calls it, what it is here."""


def as_json(study: Study) -> dict[str, Any]:
    """All figures for machines; the schema of `--json`."""
    tables = {table: {law: column(table, law, study) for law in LAWS} for table in CASES}
    return {
        "vehicle": study.vehicle.name,
        "course": study.course.name,
        "fit": {
            **study.stored.provenance,
            "waypoints_m": [list(p) for p in zip(study.stored.waypoints.x_m, study.stored.waypoints.y_m, strict=True)],
            "gains": study.gains._asdict(),
        },
        **small_tables(study),
        **tables,
        "paths": {name: result.figures() for name, result in study.paths.items()},
        "choices_m_p_q": [choice._asdict() for choice in study.choices],
        "rear_axle_law": {
            direction: {
                "max_cross_track_m": float(abs(run.cross_track_error_m).max()),
                "max_steer_rad": float(abs(run.steer_rad).max()),
            }
            for direction, run in study.rear_runs.items()
        },
        "divergence_corrected_sign": {law: leaving._asdict() for law, leaving in study.leaving.items()},
        "steering_rates": {
            "runs": [row._asdict() for row in study.rates.runs],
            "step_that_gives_the_printed_rate_s": study.rates.printed_step_s,
        },
        "firmware_law": [
            {
                "law": run.law,
                "direction": run.direction,
                "bus": run.bus,
                **{field: None if isinf(getattr(run, field)) else getattr(run, field) for field in JUDGED},
                "travelled_m": run.travelled_m,
            }
            for run in study.firmware
        ],
        "lockstep": [run.row._asdict() for run in study.lockstep.legs],
        "lockstep_with_real_parts": [run.row._asdict() for run in study.lockstep.with_part],
        "checks": [check._asdict() for check in checks(study)],
    }


def checks(study: Study) -> list[Check]:
    """What must hold; the printed cells only for the paper's own car."""
    found = []
    for table in (TABLE_5, TABLE_6):
        for law in (DOB, PID, BOTH):
            printed = printed_cells(table, law, study)
            if printed is None:
                continue
            within = TOGETHER_WITHIN if law == BOTH else ALONE_WITHIN
            for field in JUDGED:
                ratio = getattr(study.results[table][law].figures, field) / getattr(printed, field)
                holds = abs(ratio - 1.0) <= within
                found.append(Check(f"{table} {law} {field}: ours / printed", ratio, f"1 +- {within:g}", holds))
    for table in (TABLE_5, TABLE_6) if study.car.is_papers else ():
        together = study.results[table][BOTH].figures.max_e_y_m
        alone = min(study.results[table][law].figures.max_e_y_m for law in (DOB, PID))
        times = alone / together
        found.append(
            Check(
                f"{table}: max e_y, better of DOB and PID over PID+DOB", times, f">= {BETTER_BY:g}", times >= BETTER_BY
            )
        )
    found += lockstep_checks(study) if study.car.is_papers else []
    for name, result in study.paths.items():
        for what, value, limit in (
            ("constraint residual", result.fit.constraint_residual, RESIDUAL_WITHIN),
            ("curvature jump at joints, 1/m", result.curvature_jump_1pm, JUMP_WITHIN),
            ("jump of the curvature's slope at joints, 1/m^2", result.slope_jump_1pm2, JUMP_WITHIN),
        ):
            found.append(Check(f"path {name}: {what}", value, f"<= {limit:g}", value <= limit))
    for direction in (FORWARD, REVERSE):
        error = float(abs(study.rear_runs[direction].cross_track_error_m).max())
        found.append(
            Check(
                f"rear-axle law, {direction}: max true error, m",
                error,
                f"<= {REAR_AXLE_WITHIN_M:g}",
                error <= REAR_AXLE_WITHIN_M,
            )
        )
    return found


def lockstep_checks(study: Study) -> list[Check]:
    """The claim of PID + DOB in the real controller, printed sign: without and with one more sample of delay."""
    found = []
    for direction in (FORWARD, REVERSE):
        legs = {
            (law, delay): find(study.lockstep.legs, law, PRINTED, delay, direction)
            for law in NAMES
            for delay in (BUS, LATE)
        }
        if None in legs.values():
            continue
        figures = {key: leg.row for key, leg in legs.items() if leg is not None}
        alone = min(figures[(law, BUS)].max_e_y_after_start_m for law in ("dob", "pid"))
        times = alone / figures[("paper", BUS)].max_e_y_after_start_m
        found.append(
            Check(
                f"controller in lock-step, {direction}: max e_y after the start, better of DOB and PID over PID+DOB",
                times, f">= {BETTER_BY:g}", times >= BETTER_BY,
            )
        )  # fmt: skip
        worse = figures[("paper", LATE)].rms_e_y_m / figures[("pid", LATE)].rms_e_y_m
        found.append(
            Check(
                f"the same one sample later, {direction}: rms e_y, PID+DOB over PID alone", worse, ">= 1", worse >= 1.0
            )
        )
    return found
