"""The design on one sheet: what a control engineer looks at before the car moves, as a picture."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from tools.design.certificate import Certificate
from tools.design.gains import MODES
from tools.design.optimise import CHOSEN, max_road_wheel_slope
from tools.design.speed_profile import road_wheel_slope
from tools.design.tables import MAX_SPEED_MPS, DesignReport, gains_at_top_speed, speed_limits


def margins_over_speed(certificate: Certificate) -> list[dict[str, Any]]:
    """Return disk and delay margin over speed, each of the worst car of the box, an entry a direction."""
    found = []
    for sign, name in ((1.0, "forward"), (-1.0, "reverse")):
        rows = sorted(row[1:] for row in certificate.by_speed if row[0] == sign)
        speed_mps, disk, delay_samples = (list(column) for column in zip(*rows, strict=True))
        found.append({"direction": name, "speed_mps": speed_mps, "disk": disk, "delay_samples": delay_samples})
    return found


def draw(report: DesignReport, certificate: Certificate, file: Path) -> None:
    """Draw the sheet."""
    from tools.plots import design_sheet  # noqa: PLC0415 -- matplotlib

    vehicle, design = report.vehicle, report.design
    path, limits = design.path, speed_limits(vehicle)
    slope = road_wheel_slope(path, vehicle.wheelbase_m)
    gains = gains_at_top_speed(report)
    in_bends = [certificate.others[name] for name, mode in MODES["car"].items() if mode.in_bend and mode.with_yaw_rate]
    disk, delay = (min(of[name] for of in in_bends) for name in ("min_disk_margin", "min_delay_margin_samples"))
    facts = [
        f"path length            {path.length_m:.2f} m",
        f"clearance, with mirrors {design.clearance_m:.3f} m ({design.nearest_cone})",
        f"clearance, body alone  {design.body_clearance_m:.3f} m",
        f"road-wheel angle       {design.max_road_wheel_angle_rad:.3f} of {vehicle.max_road_wheel_angle_rad:.3f} rad",
        f"steering slope         {max_road_wheel_slope(design, vehicle.wheelbase_m):.3f} rad/m",
        f"curvature, its slope   {np.abs(path.curvature_1pm).max():.4f} 1/m, "
        f"{np.abs(path.curvature_slope_1pm2).max():.4f} 1/m²",
        f"legs                   {report.profiles[0].duration_s:.2f} s, {report.profiles[1].duration_s:.2f} s",
        "",
        f"disk margin            {certificate.min_disk_margin:.2f}",
        f"delay margin           {certificate.min_delay_margin_samples:.1f} samples",
        f"gain, phase margin     {certificate.min_gain_margin:.2f}, "
        f"{math.degrees(certificate.min_phase_margin_rad):.0f} deg",
        f"poles in the D-region  {'all' if certificate.all_d_stable else 'NOT ALL'}",
        f"disk, delay in a bend  {disk:.2f}, {delay:.1f} samples",
        f"steering's gain        learnt by {gains['steering_gain_rate_1pm']:.2g} of a gap per m",
        "worst car and speed:",
        *(f"  {part}" for part in certificate.worst.split(", ")),
    ]
    design_sheet(
        file,
        vehicle=vehicle,
        course=report.course,
        path=path,
        profiles=report.profiles,
        steering={"angle_rad": np.arctan(vehicle.wheelbase_m * path.curvature_1pm), "slope_radpm": slope},
        margins=margins_over_speed(certificate),
        limits={
            "angle_rad": vehicle.max_road_wheel_angle_rad,
            "planned_angle_rad": CHOSEN.angle_share * vehicle.max_road_wheel_angle_rad,
            "rate_radps": vehicle.max_road_wheel_rate_radps,
            "planned_rate_radps": limits.road_wheel_rate_radps,
            "speed_mps": min(MAX_SPEED_MPS, vehicle.max_speed_mps),
        },
        facts=facts,
        title=f"vehicle {vehicle.name} on course {report.course.name}: {vehicle.description}",
    )
