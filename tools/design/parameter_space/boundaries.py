"""Boundaries of the admissible set in a plane of two gains: CRB, RRB and IRB, each with the name of its piece.

On the edge of the region p(s; x, y) = a + x b + y c = 0 is two real equations in x and y (CRB: a pole pair on the
edge), on the real axis one (RRB: a line), and for the leading coefficient one (IRB: a pole at infinity). Where
Im(conj(b) c) = 0 the two equations say the same or contradict each other: a singular frequency. If it is singular
along a whole piece of the edge (ki-kd plane on the imaginary axis), the boundary is a straight line at each frequency
where they agree. A delay stays exp(-s T) throughout.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from tools.design.parameter_space.d_region import DRegion, Piece
from tools.design.parameter_space.loop import Bools, Characteristic, Complexes, Floats

SINGULAR = 1e-9
"""|Im(conj(b) c)| over |b c|, below which the two equations count as dependent."""
POINTS = 1500
FINEST = 1.0 / 300.0
"""Longest step along a boundary, over the sides of the window."""
ROUNDS = 12


class Window(NamedTuple):
    """A rectangle of the plane."""

    x_low: float
    x_high: float
    y_low: float
    y_high: float

    @property
    def sides(self) -> tuple[float, float]:
        """Width and height."""
        return self.x_high - self.x_low, self.y_high - self.y_low


class Boundary(NamedTuple):
    """A boundary in the window of its plane.

    kind: "CRB", "RRB" or "IRB"; piece: "d1", "d2", "d3", or "" for the IRB. x, y: shape (n,), NaN between branches; s:
    the pole on the edge at each point (NaN for the IRB). line: (a, b, c) of a x + b y + c = 0 where it is straight.
    case: name of the plant and speed that it belongs to.
    """

    kind: str
    piece: str
    x: Floats
    y: Floats
    s: Complexes
    line: tuple[float, float, float] | None = None
    case: str = ""

    @property
    def name(self) -> str:
        """As in "CRB d1"."""
        return f"{self.kind} {self.piece}".strip()


def boundaries(
    loop: Characteristic, region: DRegion, window: Window, case: str = ""
) -> tuple[list[Boundary], dict[str, str]]:
    """All boundaries that pass through the window, and for each that does not exist at all why (by name)."""
    found: list[Boundary] = []
    absent: dict[str, str] = {}
    for piece in region.pieces(loop.period_s):
        found += _complex(loop, piece, window)
    for name, s in region.real_points(loop.period_s):
        line = _real_line(loop, s)
        if isinstance(line, str):
            absent[f"RRB {name}"] = line
        else:
            found += _straight("RRB", name, line, s, window)
    infinite = _infinite(loop, region)
    if isinstance(infinite, str):
        absent["IRB"] = infinite
    else:
        for line in infinite:
            found += _straight("IRB", "", line, complex(math.nan, math.nan), window)
    return [boundary._replace(case=case) for boundary in found], absent


# --------------------------------------------------------------------------------------------------------------------
# Complex roots
# --------------------------------------------------------------------------------------------------------------------


def solve(loop: Characteristic, s: Complexes) -> tuple[Floats, Floats]:
    """Gains (x, y) that put a pole at each s (Im s > 0); NaN where the frequency is singular."""
    a, b, c = loop.parts(s)
    determinant = np.imag(np.conj(b) * c)
    singular = np.abs(determinant) <= SINGULAR * np.abs(b) * np.abs(c)
    with np.errstate(all="ignore"):
        x = np.imag(np.conj(c) * a) / determinant
        y = -np.imag(np.conj(b) * a) / determinant
    return np.where(singular, np.nan, x), np.where(singular, np.nan, y)


def _range(loop: Characteristic, piece: Piece, window: Window) -> tuple[float, float]:
    """Part of a piece on which some gains of the window could put a pole: elsewhere |a| > X |b| + Y |c|."""
    start, stop = piece.start, piece.stop
    if math.isfinite(stop):
        return start, stop
    marks = [np.abs(np.roots(part)) for part in loop[:4] if np.trim_zeros(part, "f").size > 1]
    sizes = np.concatenate([*marks, [start, 1.0 / loop.delay_s if loop.delay_s else 1.0]])
    sizes = sizes[sizes > 0.0]
    t = start + np.geomspace(1e-6 * sizes.min(), 1e6 * sizes.max(), 4000)
    most_x, most_y = max(abs(window.x_low), abs(window.x_high)), max(abs(window.y_low), abs(window.y_high))
    a, b, c = (np.abs(part) for part in loop.parts(piece.point(t)))
    possible = np.flatnonzero(a <= 2.0 * (most_x * b + most_y * c))
    last = t[min(possible[-1] + 1, len(t) - 1)] if possible.size else t[len(t) // 2]
    return start, float(last)


def _complex(loop: Characteristic, piece: Piece, window: Window) -> list[Boundary]:
    start, stop = _range(loop, piece, window)
    span = stop - start
    if not span > 0.0:
        return []
    t = start + span * np.unique(np.concatenate([np.linspace(0.0, 1.0, POINTS), np.geomspace(1e-9, 1.0, POINTS)]))
    if loop.delay_s:
        count = min(int(span * loop.delay_s / 0.05), 200_000)
        t = np.unique(np.concatenate([t, np.linspace(start, stop, max(count, 2))]))
    _, b, c = loop.parts(piece.point(t))
    determinant = np.imag(np.conj(b) * c)
    if np.all(np.abs(determinant) <= SINGULAR * np.abs(b) * np.abs(c)):
        return _singular_lines(loop, piece, t, window)
    width, height = window.sides
    for _ in range(ROUNDS):
        s = piece.point(t)
        x, y = solve(loop, s)
        near = _near(window, x, y)
        with np.errstate(invalid="ignore"):
            step = np.hypot(np.diff(x) / width, np.diff(y) / height)
            coarse = (step > FINEST) & (near[1:] | near[:-1])
        if not coarse.any() or len(t) > 100_000:
            break
        t = np.sort(np.concatenate([t, 0.5 * (t[1:] + t[:-1])[coarse]]))
    return _branches(piece.name, x, y, s, window)


def _near(window: Window, x: Floats, y: Floats, room: float = 0.5) -> Bools:
    width, height = window.sides
    with np.errstate(invalid="ignore"):
        near = (x >= window.x_low - room * width) & (x <= window.x_high + room * width)
        near &= (y >= window.y_low - room * height) & (y <= window.y_high + room * height)
    return np.asarray(near)


def _branches(name: str, x: Floats, y: Floats, s: Complexes, window: Window) -> list[Boundary]:
    """The curve with what is far outside of the window cut off and NaN in the gaps."""
    near = _near(window, x, y)
    if not near.any():
        return []
    keep = near.copy()
    keep[1:] |= near[:-1]
    keep[:-1] |= near[1:]
    x, y, s = np.where(keep, x, np.nan), np.where(keep, y, np.nan), np.where(keep, s, np.nan)
    # A jump across the window is a pole of the curve (a singular frequency between two points), not a part of it.
    width, height = window.sides
    with np.errstate(invalid="ignore"):
        jump = np.hypot(np.diff(x) / width, np.diff(y) / height) > 1.0
    at = np.flatnonzero(jump) + 1
    x, y, s = np.insert(x, at, np.nan), np.insert(y, at, np.nan), np.insert(s, at, np.nan)
    gap = np.isnan(x)
    keep = ~gap | np.concatenate([[False], ~gap[:-1]])
    return [Boundary("CRB", name, x[keep], y[keep], s[keep])]


def _singular_lines(loop: Characteristic, piece: Piece, t: Floats, window: Window) -> list[Boundary]:
    """Straight boundaries of a piece that is singular everywhere: at frequencies with a, b, c on one line through 0."""

    def mismatch(at: Floats) -> Floats:
        a, b, c = loop.parts(piece.point(at))
        other = b if np.any(np.abs(b) > 0.0) else c
        with np.errstate(all="ignore"):
            return np.asarray(np.imag(a * np.conj(other)) / (np.abs(a) * np.abs(other) + 1e-300))

    inner = t[t > piece.start]
    value = mismatch(inner)
    found: list[Boundary] = []
    for index in np.flatnonzero((value[1:] * value[:-1] < 0.0) | (value[1:] == 0.0)):
        low, high = float(inner[index]), float(inner[index + 1])
        sign = mismatch(np.array([low]))[0]
        for _ in range(100):
            middle = 0.5 * (low + high)
            if mismatch(np.array([middle]))[0] * sign > 0.0:
                low = middle
            else:
                high = middle
        s = piece.point(np.array([0.5 * (low + high)]))
        a, b, c = (complex(part[0]) for part in loop.parts(s))
        larger = b if abs(b) >= abs(c) else c
        if abs((a * larger.conjugate()).imag) > 1e-6 * abs(a * larger):
            continue  # a sign change through infinity: a zero of the plant on the edge
        line = ((b / larger).real, (c / larger).real, (a / larger).real)
        found += _straight("CRB", piece.name, line, complex(s[0]), window)
    return found


# --------------------------------------------------------------------------------------------------------------------
# Real and infinite roots
# --------------------------------------------------------------------------------------------------------------------


def _real_line(loop: Characteristic, s: complex) -> tuple[float, float, float] | str:
    a, b, c = (float(part[0].real) for part in loop.parts(np.array([s])))
    size = float(np.abs(np.polyval(np.abs(loop.free), abs(s)))) + abs(a)
    if max(abs(b), abs(c)) <= 1e-12 * max(size, 1e-300):
        return f"no gain moves a pole to s = {s.real:.4g} rad/s: the gains have no effect there"
    return b, c, a


def _infinite(loop: Characteristic, region: DRegion) -> list[tuple[float, float, float]] | str:
    if loop.period_s:
        return "a sampled loop has no pole at infinity inside its region: |z| is bounded"
    if region.bounded:
        return "the region is bounded by its radius: a pole would cross d3 first"
    degree = loop.degree
    lead = [float(part[len(part) - 1 - degree]) if len(part) > degree else 0.0 for part in loop[:4]]
    free, late, of_x, of_y = lead
    if of_x == 0.0 and of_y == 0.0:
        numerator = max(len(np.trim_zeros(part, "f")) for part in (loop.of_x, loop.of_y)) - 1
        return (
            f"the gains reach s^{numerator} at most and the leading power is s^{degree}: "
            "no gain of this plane takes a pole through infinity"
        )
    if not loop.delay_s:
        return [(of_x, of_y, free + late)]
    # Neutral loop: its far poles lie along |exp(-s T)| = |free / (late + x of_x + y of_y)|.
    limit = abs(free) * math.exp(-region.sigma_radps * loop.delay_s)
    return [(of_x, of_y, late - limit), (of_x, of_y, late + limit)]


def _straight(kind: str, piece: str, line: tuple[float, float, float], s: complex, window: Window) -> list[Boundary]:
    """A line as a boundary, where it passes through the window."""
    a, b, c = line
    width, height = window.sides
    size = math.hypot(a * width, b * height)
    if size == 0.0:
        return []
    # In coordinates of the window the line is p + t d; it is cut off by the window's four edges.
    na, nb = a * width / size, b * height / size
    nc = (c + a * window.x_low + b * window.y_low) / size
    px, py, dx, dy = -na * nc, -nb * nc, -nb, na
    low, high = -math.inf, math.inf
    for position, direction in ((px, dx), (py, dy)):
        if abs(direction) < 1e-14:
            if not -1e-12 <= position <= 1.0 + 1e-12:
                return []
            continue
        ends = sorted(((0.0 - position) / direction, (1.0 - position) / direction))
        low, high = max(low, ends[0]), min(high, ends[1])
    if not low <= high:
        return []
    t = np.linspace(low, high, 301)
    x, y = window.x_low + width * (px + t * dx), window.y_low + height * (py + t * dy)
    return [Boundary(kind, piece, x, y, np.full(len(t), s), line)]
