"""The examiner's card and the table of figures, for people at a terminal."""

from __future__ import annotations

from typing import Any

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from sim.data_files import Course, Vehicle

Row = tuple[str, str, float, int, float | None]

MAX_LEGS = 4
"""A test has two; one that went wrong may have any number."""
MM, DEG = 1e3, 57.29577951308232
LEG_ROWS: tuple[tuple[str, str, str, float, int], ...] = (
    # label, figure, unit, factor to the unit, decimals
    ("cross-track error, max", "max_cross_track_m", "mm", MM, 2),
    ("cross-track error, rms", "rms_cross_track_m", "mm", MM, 2),
    ("cross-track error, final", "final_cross_track_m", "mm", MM, 2),
    ("error at the preview point, max", "max_preview_error_m", "mm", MM, 2),
    ("stopped beyond its mark", "final_station_error_m", "mm", MM, 1),
    ("heading error, final", "final_heading_error_rad", "deg", DEG, 3),
    ("clearance to cone's axis, min", "min_clearance_m", "m", 1.0, 3),
    ("road-wheel angle, max", "max_road_wheel_angle_rad", "rad", 1.0, 3),
    ("road-wheel rate, max", "max_road_wheel_rate_radps", "rad/s", 1.0, 3),
    ("road-wheel rate, command, max", "max_road_wheel_rate_cmd_radps", "rad/s", 1.0, 3),
    ("speed, max", "max_speed_mps", "m/s", 1.0, 3),
    ("acceleration along, max", "max_accel_x_mps2", "m/s²", 1.0, 3),
    ("deceleration, last 10 cm, max", "max_stop_decel_mps2", "m/s²", 1.0, 3),
    ("acceleration across, max", "max_accel_y_mps2", "m/s²", 1.0, 3),
    ("duration", "duration_s", "s", 1.0, 2),
)


def print_card(console: Console, figures: dict[str, Any], course: Course) -> None:
    """Print the examiner's card; where there is no verdict, say so."""
    exam = figures["exam"]
    if exam is None:
        console.print(Panel("no verdict: the run ended before the plant could write one", title="examiner's card"))
        return
    passed = exam["passed"]
    lines = Table.grid(padding=(0, 2))
    lines.add_column()
    lines.add_column()
    touched = exam["cones_touched"]
    lines.add_row("markers touched", ", ".join(touched) if touched else "none")
    lines.add_row(
        "stops on the way", f"{exam['stops']}, and {exam['direction_changes']} change of direction (1 allowed)"
    )
    if exam["legs"]:
        allowed_cm, allowed_deg = 100 * course.tolerances.stop_distance_m, DEG * course.tolerances.parallel_rad
        stop_cm = 100.0 * max(abs(leg["final_ahead_m"]) for leg in exam["legs"])
        parallel_deg = DEG * max(abs(leg["final_heading_error_rad"]) for leg in exam["legs"])
        lines.add_row("stop and return", f"{stop_cm:.1f} cm off at most (allowed {allowed_cm:.0f})")
        lines.add_row("parallel", f"{parallel_deg:.2f} deg off at most (allowed {allowed_deg:.1f})")
    lines.add_row(
        "clearance",
        f"{exam['min_clearance_m']:.3f} m at {exam['nearest_cone']} (cone radius {course.cone_radius_m:.2f})",
    )
    lines.add_row("time", f"{exam['duration_s']:.1f} s, {exam['dwell_s']:.1f} s of it at the change of direction")
    for mistake in exam["mistakes"]:
        cost = "test failed" if mistake["fails"] else f"-{mistake['points']}"
        lines.add_row(Text(mistake["rule"].replace("_", " "), style="red"), f"{escape(mistake['text'])}: {cost}")
    verdict = "PASS" if passed else "FAIL"
    score = f"{exam['score']} of {exam['full_score']} points, {exam['pass_score']} needed"
    lines.add_row("score", Text(f"{score}: {verdict}", style="bold green" if passed else "bold red"))
    console.print(Panel(lines, title=f"examiner's card: {escape(course.name)}, {figures['side']} side", expand=False))


def print_figures(console: Console, figures: dict[str, Any], vehicle: Vehicle) -> None:
    """Print the figures of both legs beside the car's limits, then those of the loop and of the frames."""
    limits = {
        "max_road_wheel_angle_rad": vehicle.max_road_wheel_angle_rad,
        "max_road_wheel_rate_radps": vehicle.max_road_wheel_rate_radps,
        "max_road_wheel_rate_cmd_radps": vehicle.max_road_wheel_rate_radps,
        "max_speed_mps": vehicle.max_speed_mps,
    }
    legs = figures["legs"][:MAX_LEGS]
    table = Table(box=box.SIMPLE_HEAD, title="true figures of the rear axle, both legs", title_justify="left")
    table.add_column("")
    table.add_column("unit")
    for leg in legs:
        table.add_column(leg["direction"], justify="right")
    table.add_column("car's limit", justify="right")
    for label, name, unit, factor, decimals in LEG_ROWS:
        limit = f"{limits[name]:g}" if name in limits else ""
        table.add_row(label, unit, *(f"{factor * leg[name]:.{decimals}f}" for leg in legs), limit)
    if legs:
        console.print(table)
    console.print(loop_line(figures), soft_wrap=True)
    console.print(frames_line(figures), soft_wrap=True)


def _us(value: Any) -> str:
    return "?" if value is None else f"{value:.0f}"


def loop_line(figures: dict[str, Any]) -> str:
    """Return how well the loop held its cycle, in one line."""
    loop = figures["loop"]
    if not loop["cycles"]:
        return "loop: the controller did not report its cycles"
    if loop["wake_p99_us"] is None:
        return f"loop: {loop['cycles']} cycles in virtual time"
    return (
        f"loop: {loop['cycles']} cycles, {loop['overruns']} overruns; wake-up late by p50/p99/p99.9 "
        f"{_us(loop['wake_p50_us'])}/{_us(loop['wake_p99_us'])}/{_us(loop['wake_p999_us'])} us; step p50/p99 "
        f"{_us(loop['step_p50_us'])}/{_us(loop['step_p99_us'])} us; sensor to command p50/p99 "
        f"{_us(loop['turnaround_p50_us'])}/{_us(loop['turnaround_p99_us'])} us; {loop['scheduler']}"
    )


def frames_line(figures: dict[str, Any]) -> str:
    """Return what went over the bus, as the controller saw it."""
    frames = figures["frames"]
    return "frames: " + ", ".join(f"{'?' if n is None else n} {name.replace('_', ' ')}" for name, n in frames.items())
