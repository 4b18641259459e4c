"""Why a car cannot do a course: the dimensions whose change alone would let it pass."""

import numpy as np

from sim.data_files import Course, Vehicle
from sim.errors import UserError
from tools.design.families import FreeWaypoints
from tools.design.optimise import CHOSEN, PathDesign, make_path
from tools.design.search import Judge, improve
from tools.design.waypoints import Floats

CHANGES = (0.05, 0.12, 0.25, 0.4, 0.55, 0.7)
"""Relative changes of a dimension that are tried where a car cannot pass."""

CHANGED_ROUNDS = 10
"""Steps of the local search after each change, from where the one before ended."""

LENGTHS = ("wheelbase_m", "front_overhang_m", "rear_overhang_m")


def preventing(vehicle: Vehicle, course: Course, design: PathDesign) -> str:
    """Return which dimensions prevent the path: each whose change alone lets the car pass, the least change first."""
    changed: dict[tuple[str, ...], Floats] = {
        names: np.array(design.numbers)
        for names in (("max_road_wheel_angle_rad",), ("wheelbase_m",), ("body_width_m",), ("mirror_width_m",), LENGTHS)
        if names != ("mirror_width_m",) or vehicle.mirror_width_m > vehicle.body_width_m
    }
    enough = []
    for change in CHANGES:
        for names, before in list(changed.items()):
            factor = 1.0 / (1.0 - change) if names == ("max_road_wheel_angle_rad",) else 1.0 - change
            other = _with(vehicle, names, factor)
            if other is None:
                del changed[names]
                continue
            judge = Judge(other, course, other.max_road_wheel_angle_rad, CHOSEN.slope_price_m)
            free = FreeWaypoints(course.start_pose(other), course.stop_pose(other))
            changed[names], _ = improve(judge, free, before, CHANGED_ROUNDS)
            found = make_path(other, course, tuple(changed[names]))
            if (
                found.clearance_m >= course.cone_radius_m
                and found.max_road_wheel_angle_rad <= 1.001 * other.max_road_wheel_angle_rad
            ):
                value = sum(float(getattr(vehicle, name)) for name in names)
                enough.append(f"{' + '.join(names)} = {value:.3g} ({factor * value:.2g} would do)")
                del changed[names]
    if not enough:
        return "no single dimension prevents it: wheelbase_m, body_width_m and max_road_wheel_angle_rad together do"
    return f"what prevents it: {', or '.join(enough)}"


def _with(vehicle: Vehicle, names: tuple[str, ...], factor: float) -> Vehicle | None:
    """Return the car with dimensions changed by a factor, and what belongs to them; None where there is no such car."""
    overlay = {name: factor * float(getattr(vehicle, name)) for name in names}
    if "mirror_width_m" in names:
        overlay["mirror_width_m"] = max(overlay["mirror_width_m"], vehicle.body_width_m)
    if "body_width_m" in names and vehicle.mirror_width_m <= vehicle.body_width_m:
        overlay["mirror_width_m"] = overlay["body_width_m"]
    if "wheelbase_m" in names:
        overlay["cg_to_rear_axle_m"] = factor * vehicle.cg_to_rear_axle_m
    try:
        return vehicle.with_overlay(overlay)
    except UserError:
        return None
