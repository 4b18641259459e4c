"""Where the closed loop's poles must lie: Hurwitz shift (d1), damping wedge (d2), radius (d3)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from sim.errors import UserError
from tools.design.parameter_space.loop import Complexes, Floats


class Piece(NamedTuple):
    """A piece of the region's edge in the upper half plane: s = point(t), start <= t <= stop (stop may be infinite)."""

    name: str
    point: Callable[[Floats], Complexes]
    start: float
    stop: float


@dataclass(frozen=True)
class DRegion:
    """Poles s with Re s <= -sigma_radps, damping >= zeta, |s| <= radius_radps.

    The damping is asked of poles with |s| <= zeta_within_radps only: a loop with a delay has infinitely many poles,
    whose damping goes to zero far out, so there an unlimited wedge holds for no gains at all.
    """

    sigma_radps: float = 0.0
    zeta: float = 0.0
    radius_radps: float = math.inf
    zeta_within_radps: float = math.inf

    def __post_init__(self) -> None:
        """Raise UserError where the region is none."""
        if not 0.0 <= self.sigma_radps < math.inf:
            raise UserError(f"region: sigma_radps = {self.sigma_radps}: must be 0 or more rad/s")
        if not 0.0 <= self.zeta < 1.0:
            raise UserError(f"region: zeta = {self.zeta}: must be at least 0 and below 1")
        if not self.radius_radps > self.sigma_radps:
            raise UserError(
                f"region: radius_radps = {self.radius_radps}: must be above sigma_radps = {self.sigma_radps}"
            )
        if not self.zeta_within_radps > 0.0:
            raise UserError(f"region: zeta_within_radps = {self.zeta_within_radps}: must be above 0 rad/s")

    @property
    def bounded(self) -> bool:
        """Whether a radius is asked for."""
        return math.isfinite(self.radius_radps)

    def depth_radps(self, s: Any) -> Floats:
        """How deep points lie inside, in rad/s: distance to the nearest line or arc, negative outside; continuous."""
        s = np.asarray(s)
        with np.errstate(invalid="ignore"):
            depth = -s.real - self.sigma_radps
            if self.zeta > 0.0:
                wedge = -s.real * math.sqrt(1.0 - self.zeta**2) - np.abs(s.imag) * self.zeta
                if math.isfinite(self.zeta_within_radps):
                    wedge = np.maximum(wedge, np.abs(s) - self.zeta_within_radps)
                depth = np.minimum(depth, wedge)
            if self.bounded:
                depth = np.minimum(depth, self.radius_radps - np.abs(s))
        return np.asarray(depth)

    def real_points(self, period_s: float | None = None) -> list[tuple[str, complex]]:
        """Where the edge meets the real axis: (name of the piece, s); a sampled loop's z < 0 has Im s = pi/period."""
        points: list[tuple[str, complex]] = [("d1", complex(-self.sigma_radps))]
        if self.bounded:
            points.append(("d3", complex(-self.radius_radps)))
        if period_s:
            nyquist = math.pi / period_s
            for piece in self.pieces(period_s):
                for end in (piece.start, piece.stop):
                    s = complex(piece.point(np.array([end]))[0])
                    if abs(s.imag - nyquist) < 1e-9 * nyquist:
                        points.append((piece.name, complex(s.real, nyquist)))
        return points

    def pieces(self, period_s: float | None = None) -> list[Piece]:
        """Pieces of the edge in the upper half plane, from the real axis outward, up to Im s = pi/period if sampled."""
        sigma, zeta, radius = self.sigma_radps, self.zeta, self.radius_radps
        sine = math.sqrt(1.0 - zeta**2)
        top = math.sqrt(radius**2 - sigma**2) if self.bounded else math.inf
        corner = sigma / zeta if zeta > 0.0 else math.inf
        wedge_end = min(radius, self.zeta_within_radps)

        def shift(t: Floats) -> Complexes:
            return np.asarray(-sigma + 1j * t)

        def wedge(t: Floats) -> Complexes:
            return np.asarray(t * complex(-zeta, sine))

        def arc(size: float) -> Callable[[Floats], Complexes]:
            return lambda t: np.asarray(-size * np.exp(-1j * t))

        found: list[Piece] = []
        if corner >= wedge_end:  # the wedge cuts nothing off
            found.append(Piece("d1", shift, 0.0, top))
            last_angle = math.acos(sigma / radius) if self.bounded else 0.0
        else:
            if corner > 0.0:
                found.append(Piece("d1", shift, 0.0, corner * sine))
            found.append(Piece("d2", wedge, corner, wedge_end))
            last_angle = math.acos(zeta)
            if self.zeta_within_radps < radius:
                within = self.zeta_within_radps
                found.append(Piece("d2", arc(within), math.acos(zeta), math.acos(sigma / within)))
                found.append(Piece("d1", shift, math.sqrt(within**2 - sigma**2), top))
                last_angle = math.acos(sigma / radius) if self.bounded else 0.0
        if self.bounded:
            found.append(Piece("d3", arc(radius), 0.0, last_angle))
        return [piece for whole in found for piece in _below_nyquist(whole, period_s)]

    def outline(self, far: float, points: int = 60) -> Complexes:
        """Edge of the region from below to above, cut off at |s| = far: for pictures."""
        upper = []
        for piece in self.pieces():
            if piece.name != "d3":
                upper.append(piece.point(np.linspace(piece.start, min(piece.stop, far), points)))
            else:
                upper.append(piece.point(np.linspace(piece.stop, piece.start, points)))
        line = np.concatenate(upper)
        return np.concatenate([np.conj(line[::-1]), line])

    def text(self) -> str:
        """The region in words."""
        parts = [f"Re s <= {-self.sigma_radps:.4g} rad/s" if self.sigma_radps else "Re s <= 0"]
        if self.zeta:
            within = f" for |s| <= {self.zeta_within_radps:.4g} rad/s" if math.isfinite(self.zeta_within_radps) else ""
            parts.append(f"damping >= {self.zeta:.4g}{within}")
        if self.bounded:
            parts.append(f"|s| <= {self.radius_radps:.4g} rad/s")
        return ", ".join(parts)


def _below_nyquist(piece: Piece, period_s: float | None) -> list[Piece]:
    """The piece, or what of it lies at Im s <= pi/period; Im s is monotonous along lines, on arcs it has one top."""
    if not period_s:
        return [piece]
    nyquist = math.pi / period_s

    def height(t: float) -> float:
        return float(piece.point(np.array([t]))[0].imag)

    def crossing(low: float, high: float) -> float:
        rising = height(low) < nyquist
        for _ in range(200):
            middle = 0.5 * (low + high)
            if (height(middle) < nyquist) == rising:
                low = middle
            else:
                high = middle
        return 0.5 * (low + high)

    start, stop = piece.start, piece.stop
    if math.isinf(stop):
        stop = max(4.0 * nyquist, 2.0 * start)
        while height(stop) <= nyquist:
            stop *= 2.0
    low_in, high_in = height(start) <= nyquist, height(stop) <= nyquist
    if low_in and high_in:
        return [piece]
    if low_in:
        return [piece._replace(stop=crossing(start, stop))]
    if high_in:
        return [piece._replace(start=crossing(start, stop))]
    return []
