"""Roots of the characteristic for many gains at once, and their count outside a region where there is a delay.

Without delay all roots are eigenvalues of companion matrices. With one there are infinitely many: the ones near the
origin come from a Pade approximation of high order and are then polished by Newton's method on the exact
characteristic; whether any root lies outside the region is not left to them but counted by the argument principle on
the exact characteristic. The tests hold both against the eigenvalues of the delay equation itself.
"""

from __future__ import annotations

import math

import numpy as np

from tools.design.parameter_space.d_region import DRegion, Piece
from tools.design.parameter_space.loop import Characteristic, Complexes, Floats, coefficients, product_of

PADE_ORDER = 10
NEWTON_STEPS = 12
CONVERGED = 1e-9
"""Newton's last step over the size of the root."""

NOTHING = 1e-11
"""|p| over the sum of its terms' moduli."""

COUNT_POINTS = 1200
UNSURE_RAD = 2.0
"""A turn of the phase between two points that is larger than this is looked at again with more points."""
REFINEMENTS = 40
BLOCK = 400


def polynomial_roots(table: Floats) -> Complexes:
    """Roots of polynomials given by rows, highest power first: shape (n, degree); infinite for a leading zero."""
    rows, width = table.shape
    degree = width - 1
    if degree == 0:
        return np.empty((rows, 0), dtype=np.complex128)
    lead = np.where(table[:, :1] == 0.0, np.finfo(float).tiny, table[:, :1])
    with np.errstate(over="ignore", invalid="ignore"):
        monic = table[:, 1:] / lead
    # A common scale of s keeps the companion matrices balanced where poles are thousands of rad/s apart.
    sound = np.isfinite(monic).all(axis=1)
    roots = np.full((rows, degree), complex(math.inf, 0.0))
    if sound.any():
        last = np.median(np.abs(monic[sound]), axis=0)
        orders = np.arange(1, degree + 1)
        sizes = last[last > 0.0] ** (1.0 / orders[last > 0.0])
        scale = float(np.exp(np.mean(np.log(sizes)))) if sizes.size else 1.0
        companion = np.zeros((int(sound.sum()), degree, degree))
        companion[:, 0, :] = -monic[sound] / scale**orders
        companion[:, np.arange(1, degree), np.arange(degree - 1)] = 1.0
        roots[sound] = scale * np.linalg.eigvals(companion)
    return roots


def pade(delay_s: float, order: int) -> tuple[Floats, Floats]:
    """Numerator and denominator, highest power first, of the Pade approximation of exp(-delay_s s)."""
    terms = [
        math.factorial(2 * order - k)
        * math.factorial(order)
        / (math.factorial(2 * order) * math.factorial(k) * math.factorial(order - k))
        * delay_s**k
        for k in range(order + 1)
    ]
    den = np.array(terms[::-1])
    return den * (-1.0) ** np.arange(order, -1, -1), den


def rational(loop: Characteristic, order: int = PADE_ORDER) -> Characteristic:
    """The loop with its delay replaced by a Pade approximation; as it is where it has none."""
    if not loop.delay_s:
        return loop
    num, den = pade(loop.delay_s, order)
    late, of_x, of_y = (product_of(num, part) for part in (loop.late, loop.of_x, loop.of_y))
    return Characteristic(product_of(den, loop.free), late, of_x, of_y)


def closed_loop_poles(loop: Characteristic, x: Floats, y: Floats, order: int = PADE_ORDER) -> Complexes:
    """Poles s of the loop for gains x, y of shape (n,): shape (n, m), NaN where a candidate is no root.

    Sampled loops: s = ln(z) / period, -inf for z = 0. With a delay: those that Newton's method finds from a Pade
    approximation, each once; complete near the origin only, |s| up to about `order` / delay.
    """
    x, y = np.atleast_1d(np.asarray(x, dtype=float)), np.atleast_1d(np.asarray(y, dtype=float))
    approximate = rational(loop, order)
    roots = polynomial_roots(coefficients(approximate, x, y))
    if loop.period_s:
        with np.errstate(divide="ignore", invalid="ignore"):
            s = np.log(roots) / loop.period_s
        return np.where(roots == 0.0, complex(-math.inf, 0.0), s)
    return _polished(loop, x, y, roots) if loop.delay_s else roots


def _polished(loop: Characteristic, x: Floats, y: Floats, roots: Complexes) -> Complexes:
    x, y = x[:, None], y[:, None]
    delayed = loop.late, loop.of_x, loop.of_y
    slopes = tuple(np.polyder(part) for part in delayed)
    free_slope = np.polyder(loop.free)
    s = roots.copy()
    step = np.zeros_like(s)
    with np.errstate(all="ignore"):
        for _ in range(NEWTON_STEPS):
            shift = np.exp(-loop.delay_s * s)
            late, late_slope = (
                np.polyval(parts[0], s) + x * np.polyval(parts[1], s) + y * np.polyval(parts[2], s)
                for parts in (delayed, slopes)
            )
            value = np.polyval(loop.free, s) + shift * late
            slope = np.polyval(free_slope, s) + shift * (late_slope - loop.delay_s * late)
            step = np.where(value == 0.0, 0.0, value / slope)
            s = s - step
        size = np.abs(s) + 1e-3 / loop.delay_s
        # At a double root the steps shrink slowly, but there is nothing left of p.
        terms = np.polyval(np.abs(loop.late), np.abs(s)) + np.abs(x) * np.polyval(np.abs(loop.of_x), np.abs(s))
        terms += np.abs(y) * np.polyval(np.abs(loop.of_y), np.abs(s))
        terms = np.polyval(np.abs(loop.free), np.abs(s)) + np.abs(shift) * terms
        found = (np.abs(step) < CONVERGED * size) | ((np.abs(value) < NOTHING * terms) & (np.abs(step) < 1e-3 * size))
        s[~found] = np.nan
    return _once_each(s)


def _once_each(s: Complexes) -> Complexes:
    """Set to NaN what stands for a root that another candidate has found already."""
    for index in range(1, s.shape[1]):
        with np.errstate(invalid="ignore"):
            near = np.abs(s[:, :index] - s[:, index : index + 1]) < 1e-6 * (1e-9 + np.abs(s[:, index : index + 1]))
        s[near.any(axis=1), index] = np.nan
    return s


def depth_radps(loop: Characteristic, region: DRegion, x: Floats, y: Floats) -> Floats:
    """Depth in the region of the pole that lies least deep, shape (n,): negative where a pole is outside.

    With a delay the sign is that of the exact count.
    """
    x, y = np.asarray(x, dtype=float).ravel(), np.asarray(y, dtype=float).ravel()
    poles = closed_loop_poles(loop, x, y)
    each = np.where(np.isnan(poles), math.inf, region.depth_radps(np.where(np.isnan(poles), 0.0, poles)))
    depth = each.min(axis=1, initial=math.inf)
    if loop.delay_s:  # a found pole outside settles it; that none was overlooked is for the count to say
        candidates = np.flatnonzero(depth >= 0.0)
        missed = poles_outside(loop, region, x[candidates], y[candidates]) != 0
        depth[candidates[missed]] = -np.where(np.isfinite(depth[candidates[missed]]), depth[candidates[missed]], 1.0)
    return np.asarray(np.where(np.isnan(depth), -math.inf, depth))


def poles_outside(loop: Characteristic, region: DRegion, x: Floats, y: Floats) -> Floats:
    """Number of poles outside the region, shape (n,), by the argument principle on the exact characteristic.

    Along the edge of the region p / q turns by -pi for each pole outside (upper half of the edge), q being a polynomial
    of p's degree with all its roots inside. Points of the plane on a boundary give NaN: there a root is on the edge.
    The loop must be retarded (a relative degree of at least one in all that the delay multiplies) or so weakly neutral
    that |p / q - 1| < 1 far out; the caller sees to it.
    """
    x, y = np.asarray(x, dtype=float).ravel(), np.asarray(y, dtype=float).ravel()
    edge = _edge(loop, region)
    counts = np.empty(len(x))
    for start in range(0, len(x), BLOCK):
        block = slice(start, start + BLOCK)
        counts[block] = _turns(loop, region, [piece.point(t) for piece, t in edge], x[block], y[block])
    for index in np.flatnonzero(np.isnan(counts)):
        counts[index] = _turns_of_one(loop, region, edge, float(x[index]), float(y[index]))
    return counts


def _edge(loop: Characteristic, region: DRegion) -> list[tuple[Piece, Floats]]:
    """Pieces of the upper half of the edge with parameters along them, from the real axis to far out."""
    marks = [np.abs(np.roots(part)) for part in loop[:4] if np.trim_zeros(part, "f").size > 1]
    sizes = np.concatenate([*marks, [region.sigma_radps, 1.0 / loop.delay_s if loop.delay_s else 0.0]])
    sizes = sizes[sizes > 0.0]
    low = 1e-4 * float(sizes.min()) if sizes.size else 1e-4
    high = 1e5 * float(sizes.max()) if sizes.size else 1e5
    edge = []
    for piece in region.pieces(loop.period_s):
        stop = piece.stop if math.isfinite(piece.stop) else piece.start + high
        span = stop - piece.start
        if span > 10.0 * low:
            t = piece.start + np.concatenate([[0.0], np.geomspace(low, span, COUNT_POINTS)])
        else:
            t = np.linspace(piece.start, stop, 100)
        if math.isfinite(piece.stop):
            t = np.concatenate([t, np.linspace(piece.start, stop, COUNT_POINTS // 2)])
        if loop.delay_s:
            t = np.concatenate([t, np.arange(piece.start, min(stop, 100.0 / loop.delay_s), 0.1 / loop.delay_s)])
        edge.append((piece, np.unique(np.clip(t, piece.start, stop))))
    return edge


def _normal(loop: Characteristic, region: DRegion, s: Complexes) -> tuple[Complexes, Complexes, Complexes]:
    """Parts of p over a polynomial of its degree with all roots inside the region, as far out as the loop's own."""
    own = np.sort(np.abs(np.roots(np.trim_zeros(loop.free, "f"))))[::-1]
    own = np.concatenate([own, np.zeros(max(0, loop.degree - len(own)))])[: loop.degree]
    floor = region.sigma_radps + 1e-3 * (own.max(initial=0.0) + region.sigma_radps) + 1e-9
    reference = np.prod(s[:, None] + np.maximum(own, floor), axis=1)
    a, b, c = loop.parts(s)
    return a / reference, b / reference, c / reference


def _turns(loop: Characteristic, region: DRegion, edge: list[Complexes], x: Floats, y: Floats) -> Floats:
    a, b, c = _normal(loop, region, np.concatenate(edge))
    f = a + x[:, None] * b + y[:, None] * c
    steps = np.angle(f[:, 1:] * np.conj(f[:, :-1]))
    # p / q is real where the edge leaves the real axis and tends to 1 at its far end.
    first = np.where(f[:, 0].real < 0.0, -f[:, 0], f[:, 0])
    total = steps.sum(axis=1) + np.angle(first) - np.angle(f[:, -1])
    counts = -total / math.pi
    unsure = (np.abs(steps) > UNSURE_RAD).any(axis=1) | ~(np.abs(counts - np.round(counts)) < 0.05)
    return np.where(unsure | (f == 0.0).any(axis=1), np.nan, np.round(counts))


def _turns_of_one(loop: Characteristic, region: DRegion, edge: list[tuple[Piece, Floats]], x: float, y: float) -> float:
    """The count for one point, with more points along the edge wherever the phase turns fast."""
    fine = []
    for piece, parameters in edge:
        t = parameters
        for _ in range(REFINEMENTS):
            a, b, c = _normal(loop, region, piece.point(t))
            f = a + x * b + y * c
            fast = np.abs(np.angle(f[1:] * np.conj(f[:-1]))) > 0.5 * UNSURE_RAD
            if not fast.any() or len(t) > 50 * COUNT_POINTS:
                break
            t = np.sort(np.concatenate([t, 0.5 * (t[1:] + t[:-1])[fast]]))
        fine.append(piece.point(t))
    return float(_turns(loop, region, fine, np.array([x]), np.array([y]))[0])
