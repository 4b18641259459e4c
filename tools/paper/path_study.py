"""The paper's path (eq. 1 to 10): as printed and as it should be, and what m, p and q do to it."""

from typing import NamedTuple

import numpy as np

from sim.errors import UserError
from tools.design.path import Path, sample
from tools.design.path_fit import FitResult, fit_path, geometry, joint_jumps, pins
from tools.design.waypoints import DenseWaypoints, Floats, Waypoints, interpolate
from tools.paper.printed import TABLE_1

FOOT_M = 0.3048
SAMPLE_M = 0.005

AS_PRINTED, CORRECTED = "as printed", "corrected"


class Variant(NamedTuple):
    """How eq. 5 and the ends are meant: derivatives by raw lambda or along the path, ends free or pinned."""

    name: str
    length_scaled: bool
    pinned: bool


VARIANTS = (
    Variant(AS_PRINTED, False, False),
    Variant("raw lambda, pinned", False, True),
    Variant("scaled, free ends", True, False),
    Variant(CORRECTED, True, True),
)


class PathResult(NamedTuple):
    """One path with its fit, its points, and the checks that stand in the report."""

    variant: Variant
    fit: FitResult
    path: Path
    curvature_jump_1pm: float
    slope_jump_1pm2: float

    def figures(self) -> dict[str, float]:
        """Figures for table and JSON."""
        path, fit = self.path, self.fit
        return {
            "constraint_residual": fit.constraint_residual,
            "curvature_jump_1pm": self.curvature_jump_1pm,
            "curvature_slope_jump_1pm2": self.slope_jump_1pm2,
            "fit_rms_x_m": fit.fit_rms_m[0],
            "fit_rms_y_m": fit.fit_rms_m[1],
            "max_curvature_1pm": float(np.max(np.abs(path.curvature_1pm))),
            "rms_curvature_1pm": rms_curvature_1pm(path),
            "start_curvature_1pm": float(path.curvature_1pm[0]),
            "stop_curvature_1pm": float(path.curvature_1pm[-1]),
            "start_x_m": float(path.x_m[0]),
            "start_y_m": float(path.y_m[0]),
            "start_heading_rad": float(path.yaw_rad[0]),
            "stop_x_m": float(path.x_m[-1]),
            "stop_y_m": float(path.y_m[-1]),
            "stop_heading_rad": float(path.yaw_rad[-1]),
            "length_m": path.length_m,
        }


def rms_curvature_1pm(path: Path) -> float:
    """Root mean square of the curvature over the path's length: what the paper chose the order by."""
    return float(np.sqrt(np.mean(path.curvature_1pm**2)))


def fitted(
    dense: DenseWaypoints, ends: Waypoints, variant: Variant, *, p: int = TABLE_1["p"], q: int = TABLE_1["q"],
    step_m: float = SAMPLE_M,
) -> PathResult:  # fmt: skip
    """Solve eq. 9 for one variant. Pinned ends: position and heading of the waypoints, no curvature."""
    start = stop = None
    if variant.pinned:
        start = pins(ends.x_m[0], ends.y_m[0], ends.start_yaw_rad)
        stop = pins(ends.x_m[-1], ends.y_m[-1], ends.stop_yaw_rad)
    fit = fit_path(dense, p=p, q=q, start=start, stop=stop, length_scaled=variant.length_scaled)
    curvature_jump, slope_jump = joint_jumps(fit)
    return PathResult(variant, fit, sample(fit, step_m), curvature_jump, slope_jump)


def all_variants(waypoints: Waypoints) -> dict[str, PathResult]:
    """All variants of eq. 9 on the same waypoints, by name."""
    dense = interpolate(waypoints)
    return {variant.name: fitted(dense, waypoints, variant) for variant in VARIANTS}


class Choice(NamedTuple):
    """One choice of m, p and q: the figures by which the paper chose; infinite where there is no such path."""

    m: int
    p: int
    q: int
    rms_curvature_1pm: float
    max_curvature_1pm: float
    fit_rms_m: float
    curvature_jump_1pm: float
    slope_jump_1pm2: float


def equal_cuts(waypoints: Waypoints, m: int) -> Waypoints:
    """The same waypoints, cut into m segments of equal length."""
    first, last = waypoints.x_m[0], waypoints.x_m[-1]
    return waypoints._replace(split_x_m=tuple(float(s) for s in np.linspace(first, last, m + 1)[1:-1]))


def sweep(waypoints: Waypoints, variant: Variant) -> list[Choice]:
    """Sweep m, p and q around Table 1; m = 4 keeps the fitted cuts, others cut evenly."""
    choices = [(m, TABLE_1["p"], TABLE_1["q"]) for m in range(1, 9)]
    choices += [(TABLE_1["m"], p, TABLE_1["q"]) for p in range(4, 13) if p != TABLE_1["p"]]
    choices += [(TABLE_1["m"], TABLE_1["p"], q) for q in range(0, 6) if q != TABLE_1["q"]]
    result = []
    for m, p, q in choices:
        cut = waypoints if m == len(waypoints.split_x_m) + 1 else equal_cuts(waypoints, m)
        try:
            one = fitted(interpolate(cut), cut, variant, p=p, q=q, step_m=0.01)
        except UserError:
            result.append(Choice(m, p, q, np.inf, np.inf, np.inf, np.inf, np.inf))
            continue
        figures = one.figures()
        misfit = float(np.hypot(*one.fit.fit_rms_m))
        result.append(
            Choice(m, p, q, figures["rms_curvature_1pm"], figures["max_curvature_1pm"], misfit,
                   one.curvature_jump_1pm, one.slope_jump_1pm2)
        )  # fmt: skip
    return result


def segment_points(result: PathResult, per_segment: int = 200) -> list[tuple[Floats, Floats, Floats]]:
    """Points (x, y, curvature) of each polynomial segment, for pictures."""
    lambda_ = np.linspace(0.0, 1.0, per_segment)
    points = []
    for segment in range(len(result.fit.length_m)):
        g = geometry(result.fit, np.full(per_segment, segment), lambda_)
        points.append((g.x_m, g.y_m, g.curvature_1pm))
    return points
