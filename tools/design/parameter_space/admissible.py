"""The admissible set: gains that put all poles into the region, for every case at once; the chosen point."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from sim.errors import UserError
from tools.design.parameter_space.boundaries import Boundary, Window, boundaries
from tools.design.parameter_space.d_region import DRegion
from tools.design.parameter_space.loop import (
    Bools,
    Characteristic,
    Complexes,
    Floats,
    Pid,
    Plane,
    characteristic,
    plant_of,
)
from tools.design.parameter_space.roots import closed_loop_poles, depth_radps

CELLS = 81
RULES = ("centre", "smallest", "smallest on CRB d1")
LEAST_CLEARANCE = 0.02
"""Distance to every boundary, over the sides of the window, that the rule "smallest" keeps."""


class Case(NamedTuple):
    """One loop that must keep its poles in its region; `name` says which, as "0.5 m/s, mass low"."""

    name: str
    loop: Characteristic
    region: DRegion


def case_of(
    name: str,
    plant: Any,
    plane: Plane,
    region: DRegion,
    pid: Pid = Pid(),  # noqa: B008 -- immutable
    delay_s: float = 0.0,
) -> Case:
    """Case of a plant (anything that `plant_of` takes) in a PID loop; raises UserError as `plant_of` does."""
    return checked_case(Case(name, characteristic(plant_of(plant, delay_s=delay_s, name=name), plane, pid), region))


def checked_case(case: Case) -> Case:
    """The case, or a UserError where its region is beyond the reach of any gains for a reason known beforehand."""
    loop, region = case.loop, case.region
    degree = len(np.trim_zeros(loop.free, "f")) - 1
    if loop.delay_s:
        late = max(len(np.trim_zeros(part, "f")) for part in (loop.late, loop.of_x, loop.of_y)) - 1
        if late > degree:
            raise UserError(
                f"{case.name}: a pure derivative on a plant as fast as its input, behind a delay, is never stable; "
                "give the derivative a lag"
            )
        if region.bounded:
            raise UserError(
                f"{case.name}: no radius can be kept with a delay, whose loop has infinitely many poles; "
                "leave the radius out"
            )
        if region.zeta > 0.0 and not math.isfinite(region.zeta_within_radps):
            raise UserError(
                f"{case.name}: with a delay the damping of far poles goes to zero, whatever the gains; say up to which "
                "|s| the damping counts (zeta_within_radps)"
            )
    for root in np.roots(loop.free):
        if loop.period_s and root == 0.0:
            continue
        s = complex(np.log(root + 0j)) / loop.period_s if loop.period_s else complex(root)
        parts = [abs(np.polyval(part, root)) for part in (loop.late, loop.of_x, loop.of_y)]
        sizes = [np.polyval(np.abs(part), abs(root)) for part in (loop.late, loop.of_x, loop.of_y)]
        fixed = all(value <= 1e-10 * size for value, size in zip(parts, sizes, strict=True))
        if fixed and region.depth_radps(s) < 0.0:
            raise UserError(
                f"{case.name}: no gain moves the pole at s = {s:.4g} rad/s (a zero of the plant cancels it), "
                f"and it is outside the region ({region.text()})"
            )
    return case


def cases_over(
    plant_at: Callable[..., Any],
    speeds_mps: Sequence[float],
    plane: Plane,
    region_at: Callable[[float], DRegion] | DRegion,
    *,
    box: Mapping[str, tuple[float, float]] | None = None,
    pid: Pid = Pid(),  # noqa: B008 -- immutable
    delay_s: float = 0.0,
) -> list[Case]:
    """One case for each speed and each corner of an uncertainty box.

    plant_at: called as plant_at(speed_mps, name=value, ...) with the names of the box; box: {name: (low, high)}.
    region_at: the region, or what gives it for a speed (as one that scales with the speed). delay_s: at the plant's
    input. Without a box: one case a speed, plant_at(speed_mps).
    """
    names = sorted(box or {})
    found = []
    for speed in speeds_mps:
        region = region_at(speed) if callable(region_at) else region_at
        for ends in product(*(("low", "high") if box and box[n][0] != box[n][1] else ("low",) for n in names)):
            values = {n: (box or {})[n][end == "high"] for n, end in zip(names, ends, strict=True)}
            name = ", ".join([f"{speed:g} m/s", *(f"{n} {end}" for n, end in zip(names, ends, strict=True))])
            found.append(case_of(name, plant_at(speed, **values), plane, region, pid, delay_s))
    return found


class Distance(NamedTuple):
    """Shortest way to a boundary, in scaled coordinates (x over scale[0], y over scale[1]); it ends at (x, y)."""

    distance: float
    x: float
    y: float
    case: str


class Point(NamedTuple):
    """A point of the plane. distances: by the boundary's name, nearest first; only boundaries seen in the window."""

    x: float
    y: float
    gains: dict[str, float]
    inside: bool
    margin: float
    scale: tuple[float, float]
    distances: dict[str, Distance]


@dataclass(frozen=True, eq=False)
class AdmissibleRegion:
    """The admissible set in a window of the plane, by the poles at each point of a grid.

    x (nx,), y (ny,): the grid. margin (ny, nx): least depth of any pole of any case in its region, in rad/s, over the
    region's sigma where it has one; inside: margin >= 0. outline: its edges, polylines of shape (n, 2). boundaries: of
    all cases; absent: by name, why a boundary does not exist.
    """

    plane: Plane
    window: Window
    cases: tuple[Case, ...]
    x: Floats
    y: Floats
    margin: Floats
    outline: tuple[Floats, ...]
    boundaries: tuple[Boundary, ...]
    absent: dict[str, str]

    @property
    def inside(self) -> Bools:
        """Which points of the grid are admissible, shape (ny, nx)."""
        return np.asarray(self.margin >= 0.0)

    @property
    def scale(self) -> tuple[float, float]:
        """Units of scaled coordinates: the sides of the window."""
        return self.window.sides

    def named(self, name: str) -> list[Boundary]:
        """Boundaries of a name in the window; raises UserError where there is none, saying why."""
        found = [boundary for boundary in self.boundaries if boundary.name == name]
        if not found:
            known = ", ".join(sorted({boundary.name for boundary in self.boundaries})) or "none"
            why = self.absent.get(name, f"it does not pass through the window; those that do: {known}")
            raise UserError(f"boundary {name} does not exist in the plane {self.plane.name}: {why}")
        return found

    def point(self, x: float, y: float) -> Point:
        """A point with its distance to every boundary in the window."""
        margin = float(_margins(self.cases, np.array([x]), np.array([y]))[0])
        width, height = self.scale
        distances: dict[str, Distance] = {}
        for boundary in self.boundaries:
            nearest = _nearest_on(boundary, x, y, width, height)
            if nearest.distance < distances.get(boundary.name, nearest._replace(distance=math.inf)).distance:
                distances[boundary.name] = nearest
        ordered = dict(sorted(distances.items(), key=lambda item: item[1].distance))
        return Point(x, y, self.plane.gains(x, y), margin >= 0.0, margin, self.scale, ordered)

    def choose(self, rule: str = "centre", clearance: float = LEAST_CLEARANCE) -> Point:
        """Choose a point by a rule of `RULES`.

        "centre" is farthest from all boundaries, "smallest" has the least gains (in scaled coordinates) that keep
        `clearance` to all boundaries, "smallest on CRB d1" the least gains on that boundary, which is the paper's rule.
        Raises UserError for another rule and where nothing is admissible.
        """
        if rule not in RULES:
            raise UserError(f"rule {rule!r}: must be one of {', '.join(RULES)}")
        width, height = self.scale
        if rule == "smallest on CRB d1":
            lines = self.named("CRB d1")
            x, y = (np.concatenate([getattr(line, axis) for line in lines]) for axis in "xy")
            known = ~np.isnan(x)
            x, y = _thinned(x[known], y[known], self.window)
            allowed = _margins(self.cases, x, y) >= -1e-3
            if not allowed.any():
                raise UserError(f"{self.plane.name}: the boundary CRB d1 does not bound the admissible set here")
        else:
            rows, columns = np.nonzero(self.inside)
            x, y = self.x[columns], self.y[rows]
            room = self._room(x, y)
            allowed = room >= min(clearance, float(room.max(initial=0.0)))
            if rule == "centre":
                allowed = room >= room.max(initial=0.0)
            if not allowed.any():
                raise empty_error(self.plane, self.window, self.cases)
        size = np.hypot(x / width, y / height)
        best = int(np.flatnonzero(allowed)[np.argmin(size[allowed])])
        return self.point(float(x[best]), float(y[best]))

    def _room(self, x: Floats, y: Floats) -> Floats:
        """Distance of points to the nearest boundary and to the window's edge, scaled."""
        from scipy.spatial import cKDTree  # noqa: PLC0415

        width, height = self.scale
        along = [(x - self.window.x_low) / width, (self.window.x_high - x) / width]
        along += [(y - self.window.y_low) / height, (self.window.y_high - y) / height]
        room = np.min(along, axis=0)
        lines = [np.column_stack([line.x / width, line.y / height]) for line in self.boundaries]
        if lines:
            dots = np.concatenate(lines)
            dots = dots[~np.isnan(dots[:, 0])]
            if len(dots):
                room = np.minimum(room, cKDTree(dots).query(np.column_stack([x / width, y / height]))[0])
        return np.asarray(room)

    def poles(self, x: float, y: float) -> dict[str, Complexes]:
        """Closed-loop poles of every case at a point, by the case's name."""
        found = {}
        for case in self.cases:
            poles = closed_loop_poles(case.loop, np.array([x]), np.array([y]))[0]
            found[case.name] = poles[~np.isnan(poles)]
        return found


def admissible_region(
    cases: Sequence[Case], plane: Plane, window: Window | None = None, *, cells: int = CELLS
) -> AdmissibleRegion:
    """The admissible set of all cases in a window of the plane, on a grid of `cells` x `cells` points.

    Without a window one is looked for (`find_window`). Raises UserError where the set is empty, with the reason.
    """
    if not cases:
        raise UserError(f"{plane.name}: at least one case (plant and region) is needed")
    for case in cases:
        checked_case(case)
    if window is None:
        window = find_window(cases, plane)
    elif not all(math.isfinite(side) and side > 0.0 for side in window.sides):
        raise UserError(f"window {tuple(window)}: must be {plane.x} low < high, {plane.y} low < high")
    if cells < 3:
        raise UserError(f"cells = {cells}: must be 3 or more")
    x, y = np.linspace(window.x_low, window.x_high, cells), np.linspace(window.y_low, window.y_high, cells)
    grid_x, grid_y = np.meshgrid(x, y)
    margin = _margins(cases, grid_x.ravel(), grid_y.ravel()).reshape(grid_x.shape)
    if not (margin >= 0.0).any():
        raise empty_error(plane, window, cases)
    lines: list[Boundary] = []
    absent: dict[str, str] = {}
    for case in cases:
        found, missing = boundaries(case.loop, case.region, window, case.name)
        lines += found
        absent |= missing
    return AdmissibleRegion(plane, window, tuple(cases), x, y, margin, _outline(x, y, margin), tuple(lines), absent)


LEAST_LOOKED_AT = 1e-6
LOOKED_AT = (3, 9)
"""Values a decade, first and, where nothing is found, then."""
WHOLE, SMALL_GAINS = 60.0, 12.0
"""A window ends at the greatest admissible gain if that is below WHOLE times the least, else at SMALL_GAINS times."""


def _margins(cases: Iterable[Case], x: Floats, y: Floats) -> Floats:
    worst = np.full(len(x), math.inf)
    for case in cases:
        unit = case.region.sigma_radps or 1.0
        worst = np.minimum(worst, depth_radps(case.loop, case.region, x, y) / unit)
    return worst


def _outline(x: Floats, y: Floats, margin: Floats) -> tuple[Floats, ...]:
    import contourpy  # noqa: PLC0415

    # A frame of outside closes the set where it runs out of the window; far outside counts no more than near outside.
    limit = float(np.quantile(np.abs(margin[np.isfinite(margin)]), 0.5)) or 1.0
    inner = np.clip(margin, -limit, None)
    generator = contourpy.contour_generator(x, y, inner)
    return tuple(np.asarray(line) for line in generator.lines(0.0))


def find_window(cases: Sequence[Case], plane: Plane) -> Window:
    """A window that shows the admissible set: all of it where it is bounded, else its part with the small gains.

    Looks over twelve decades of either sign about the gains that weigh as much as the rest of the characteristic.
    Raises UserError where nothing is admissible there.
    """
    weights = np.array([_balancing_gains(case) for case in cases])
    unit_x, unit_y = np.exp(np.mean(np.log(weights), axis=0))
    x, y = np.empty(0), np.empty(0)
    for decades_of in LOOKED_AT:
        sizes = np.geomspace(LEAST_LOOKED_AT, 1.0 / LEAST_LOOKED_AT, decades_of * 12 + 1)
        values = np.concatenate([-sizes[::-1], [0.0], sizes])
        grid_x, grid_y = (grid.ravel() for grid in np.meshgrid(unit_x * values, unit_y * values))
        inside = _all_inside(cases, grid_x, grid_y)
        x, y = grid_x[inside], grid_y[inside]
        if len(x):
            break
    else:
        far_x, far_y = unit_x / LEAST_LOOKED_AT, unit_y / LEAST_LOOKED_AT
        raise empty_error(plane, Window(-far_x, far_x, -far_y, far_y), cases, (grid_x, grid_y))
    x_low, x_high = _span(x, unit_x)
    seen = (x >= x_low) & (x <= x_high)
    rough = Window(x_low, x_high, *_span(y[seen], unit_y))
    # The steps are wide: look again, closer, at a window that reaches a step farther.
    step = (1.0 / LEAST_LOOKED_AT**2) ** (1.0 / (len(sizes) - 1))
    wide_x, wide_y = (np.linspace(*_wider(low, high, step), 61) for low, high in (rough[:2], rough[2:]))
    grid_x, grid_y = (grid.ravel() for grid in np.meshgrid(wide_x, wide_y))
    inside = _all_inside(cases, grid_x, grid_y)
    if not inside.any():
        return rough
    return Window(*_span(grid_x[inside], unit_x, rough[:2]), *_span(grid_y[inside], unit_y, rough[2:]))


def _all_inside(cases: Sequence[Case], x: Floats, y: Floats) -> Bools:
    inside = np.ones(len(x), dtype=bool)
    for case in cases:
        left = np.flatnonzero(inside)
        inside[left] = depth_radps(case.loop, case.region, x[left], y[left]) >= 0.0
    return inside


def _wider(low: float, high: float, step: float) -> tuple[float, float]:
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    return middle - step * half - 0.3 * abs(middle), middle + step * half + 0.3 * abs(middle)


def _balancing_gains(case: Case) -> tuple[float, float]:
    """Gains of either axis that weigh as much as all the rest, as geometric means over the edge of the region."""
    loop, region = case.loop, case.region
    marks = np.abs(np.roots(loop.free))
    if loop.period_s:
        marks = np.array([0.05, 0.5]) * math.pi / loop.period_s
    delay = [1.0 / loop.delay_s] if loop.delay_s else []
    marks = np.concatenate([marks[marks > 0.0], [region.sigma_radps] if region.sigma_radps else [], delay])
    if not marks.size:
        marks = np.array([1.0])
    s = np.geomspace(0.3 * marks.min(), 3.0 * marks.max(), 25) * complex(-region.zeta, math.sqrt(1.0 - region.zeta**2))
    a, b, c = (np.abs(part) + 1e-300 for part in loop.parts(s))
    return float(np.exp(np.mean(np.log(a / b)))), float(np.exp(np.mean(np.log(a / c))))


def _span(values: Floats, unit: float, rough: tuple[float, float] | None = None) -> tuple[float, float]:
    """Side of a window about the admissible values of one gain, with the zero where it is near."""
    least, most = float(np.abs(values).min()), float(np.abs(values).max())
    reach = most
    if rough is not None:
        reach = min(most, 1.3 * max(abs(rough[0]), abs(rough[1])))
    elif least > 10.0 * LEAST_LOOKED_AT * unit:
        reach = most if most < WHOLE * least else SMALL_GAINS * least
    elif most > 0.1 * unit / LEAST_LOOKED_AT:
        reach = 2.0 * unit
    low, high = max(float(values.min()), -reach), min(float(values.max()), reach)
    room = 0.2 * max(high - low, 0.1 * reach)
    low, high = low - room, high + room
    if 0.0 < low < 0.5 * high:
        low = -0.05 * high
    if 0.5 * low < high < 0.0:
        high = -0.05 * low
    return low, high


def empty_error(
    plane: Plane, window: Window, cases: Sequence[Case], points: tuple[Floats, Floats] | None = None
) -> UserError:
    """The reason why nothing is admissible, as the exception to raise."""
    if points is None:
        grid = np.meshgrid(np.linspace(*window[:2], 41), np.linspace(*window[2:], 41))
        points = grid[0].ravel(), grid[1].ravel()
    where = (
        f"{plane.x} in [{window.x_low:.4g}, {window.x_high:.4g}], {plane.y} in [{window.y_low:.4g}, "
        f"{window.y_high:.4g}] at {plane.third_name} = {plane.third:.4g}"
    )
    for case in cases:
        if (depth_radps(case.loop, case.region, *points) >= 0.0).any():
            continue
        poles = closed_loop_poles(case.loop, *points)
        poles = np.where(np.isnan(poles), -1e300, poles)
        farthest = float(poles.real.max(axis=1).min())
        reason = f"the farthest left that all poles come there is Re s = {farthest:.4g} rad/s"
        if farthest <= -case.region.sigma_radps:
            reason = "each of shift, damping and radius may hold somewhere there, never all together"
        return UserError(f"{case.name}: no admissible gains with {where}: asked is {case.region.text()}; {reason}")
    names = ", ".join(case.name for case in cases[:4]) + (", ..." if len(cases) > 4 else "")
    return UserError(f"no gains with {where} are admissible for all of {names} at once, though for each alone")


def _thinned(x: Floats, y: Floats, window: Window) -> tuple[Floats, Floats]:
    """Points of the window, at most some thousands of them."""
    seen = (x >= window.x_low) & (x <= window.x_high) & (y >= window.y_low) & (y <= window.y_high)
    x, y = x[seen], y[seen]
    step = max(1, len(x) // 4000)
    return x[::step], y[::step]


def _nearest_on(boundary: Boundary, x: float, y: float, width: float, height: float) -> Distance:
    """Nearest point of a polyline with gaps."""
    px, py = (boundary.x - x) / width, (boundary.y - y) / height
    dx, dy = np.diff(px), np.diff(py)
    with np.errstate(invalid="ignore", divide="ignore"):
        t = np.clip(-(px[:-1] * dx + py[:-1] * dy) / (dx * dx + dy * dy), 0.0, 1.0)
        t = np.where(np.isfinite(t), t, 0.0)
        fx, fy = px[:-1] + t * dx, py[:-1] + t * dy
        gaps = np.hypot(fx, fy)
    if not np.isfinite(gaps).any():
        return Distance(math.inf, math.nan, math.nan, boundary.case)
    at = int(np.nanargmin(gaps))
    return Distance(float(gaps[at]), x + width * float(fx[at]), y + height * float(fy[at]), boundary.case)
