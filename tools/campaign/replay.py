"""A run of a campaign driven again through real frames, with pictures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from firmware_py.reasons import TEXT
from sim.data_files import Course, Scenario, Vehicle
from sim.errors import UserError
from tools.campaign.draws import draw
from tools.figures import leg_figures, load_path, load_preview, split_legs, truth_of_rows
from tools.lockstep import run_lockstep
from tools.run_folder import write_whole


def replay(
    vehicle: Vehicle, course: Course, scenario: Scenario, law: str, tables: Path, row: dict[str, float], folder: Path
) -> dict[str, Any]:
    """Drive a row's run in lock-step and write figures and pictures to folder/seed-SEED.

    `same` in what is returned: whether clearance, cones and cycles are those of the row, bit for bit.
    """
    from tools.plots import signals, swept_body  # noqa: PLC0415

    seed = int(row["seed"])
    drawn = draw(vehicle, scenario, seed)
    place = folder / f"seed-{seed}"
    try:
        place.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{place}: cannot be made a folder: {error.strerror}") from None
    result = run_lockstep(vehicle, course, drawn.scenario, drawn.side, seed, law, tables)
    path = load_path(tables, drawn.side)
    truth = truth_of_rows(result.truth)
    legs = split_legs(truth, path, load_preview(tables, law))
    exam = result.exam
    same = row["cycles"] == 0.0 or (  # without cycles: the run was broken off, and is looked at here
        exam.min_clearance_m == row["min_clearance_m"]
        and len(exam.cones_touched) == int(row["cones_touched"])
        and result.controller["cycles"] == int(row["cycles"])
    )
    ended = "completed" if result.controller["completed"] else TEXT[result.controller["reason"]]
    told: dict[str, Any] = {
        "seed": seed,
        "side": drawn.side,
        "min_clearance_m": exam.min_clearance_m,
        "cones_touched": list(exam.cones_touched),
        "max_cross_track_m": row["max_cross_track_m"],
        "ended": ended,
        "same": same,
        "folder": str(place),
        "legs": [leg_figures(leg, truth, path) for leg in legs],
        "row": row,
        "exam": exam.as_dict(),
    }
    write_whole(place / "figures.json", json.dumps(told, indent=2) + "\n")
    title = f"{vehicle.name} on {course.name}, {drawn.side} side; campaign of {scenario.name}, law {law}, seed {seed}"
    common: dict[str, Any] = {
        "vehicle": vehicle,
        "course": course,
        "truth": truth,
        "path": path,
        "legs": legs,
        "title": f"{title}: {ended}, clearance {exam.min_clearance_m:.3f} m",
    }
    swept_body(place / "swept_body.png", side=drawn.side, **common)
    if legs:
        signals(place / "signals.png", **common)
    return told
