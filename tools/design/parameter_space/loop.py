"""Plants, the PID family, and the closed loop's characteristic as an affine function of two of its gains."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sim.errors import UserError

Floats = npt.NDArray[np.float64]
Complexes = npt.NDArray[np.complex128]
Bools = npt.NDArray[np.bool_]

GAINS = ("kp", "ki", "kd")
S = np.array([1.0, 0.0])
ONE = np.array([1.0])


# --------------------------------------------------------------------------------------------------------------------
# Plants
# --------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Plant:
    """One input, one output: num(s) / den(s) exp(-delay_s s), or num(z) / den(z) where `period_s` is given.

    num, den: coefficients, highest power first, without leading zeros. Make it with `plant_of`, which checks.
    """

    num: Floats
    den: Floats
    delay_s: float = 0.0
    period_s: float | None = None
    name: str = "plant"

    @property
    def relative_degree(self) -> int:
        """Poles more than zeros."""
        return len(self.den) - len(self.num)

    def poles(self) -> Complexes:
        """Poles of the rational part."""
        return np.roots(self.den).astype(np.complex128)

    def zeros(self) -> Complexes:
        """Zeros of the rational part."""
        return np.roots(self.num).astype(np.complex128)

    def with_delay(self, delay_s: float) -> Plant:
        """The same plant with another delay in s."""
        return _checked(Plant(self.num, self.den, delay_s, self.period_s, self.name))


def plant_of(system: Any, *, delay_s: float = 0.0, name: str = "plant", must_be_stable: bool = False) -> Plant:
    """Take a plant from python-control (TransferFunction, StateSpace), from a pair (num, den), or as it is.

    delay_s: dead time at its input. A state space keeps its relative degree: zeros come from its matrices, not from a
    difference of polynomials. Raises UserError where it is not one proper plant with one input and one output, and,
    with `must_be_stable`, where it has a pole that does not decay.
    """
    if isinstance(system, Plant):
        plant = _checked(Plant(system.num, system.den, system.delay_s + delay_s, system.period_s, system.name))
    else:
        num, den, period_s = _coefficients(system, name)
        plant = _checked(Plant(num, den, delay_s, period_s, name))
    if must_be_stable:
        poles = plant.poles()
        bad = poles[np.abs(poles) >= 1.0] if plant.period_s else poles[poles.real >= 0.0]
        if bad.size:
            raise UserError(f"{plant.name}: unstable (pole at {_number(bad[0])}), and only a stable one may stand here")
    return plant


def _coefficients(system: Any, name: str) -> tuple[Floats, Floats, float | None]:
    if hasattr(system, "ninputs") and (system.ninputs, system.noutputs) != (1, 1):
        raise UserError(
            f"{name}: has {system.ninputs} inputs and {system.noutputs} outputs; choose one of each, as in plant[0, 0]"
        )
    if all(hasattr(system, matrix) for matrix in "ABCD"):
        a, b, c, d = (np.asarray(getattr(system, matrix), dtype=float) for matrix in "ABCD")
        num, den = _of_matrices(a, b, c, d, name)
    elif hasattr(system, "num") and hasattr(system, "den"):
        num, den = (np.asarray(part[0][0], dtype=float) for part in (system.num, system.den))
    elif isinstance(system, Sequence) and not isinstance(system, str) and len(system) == 2:
        num, den = (_polynomial(part, f"{name}: {what}") for part, what in zip(system, ("num", "den"), strict=True))
    else:
        raise UserError(
            f"{name}: a TransferFunction or StateSpace of python-control or a pair (num, den) is needed, "
            f"not {type(system).__name__}"
        )
    period = getattr(system, "dt", None)
    if period is True:
        raise UserError(f"{name}: sampled, but its period is not given; make it with dt = the period in s")
    return num, den, float(period) if period else None


def _polynomial(values: Any, what: str) -> Floats:
    try:
        coefficients = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        raise UserError(f"{what}: must be a list of numbers, highest power first") from None
    if coefficients.ndim != 1 or not coefficients.size:
        raise UserError(f"{what}: must be one list of numbers, highest power first")
    return coefficients


def _of_matrices(a: Floats, b: Floats, c: Floats, d: Floats, name: str) -> tuple[Floats, Floats]:
    """Numerator and denominator of a state space with one input and one output."""
    from scipy.linalg import eigvals  # noqa: PLC0415

    if not all(np.isfinite(matrix).all() for matrix in (a, b, c, d)):
        raise UserError(f"{name}: a matrix holds a value that is not a finite number")
    order = len(a)
    poles = np.linalg.eigvals(a) if order else np.array([])
    # Relative degree from the Markov parameters D, CB, CAB, ...: rounding must not invent zeros far away.
    vector, size, relative = b[:, 0], 1.0, 0
    lead = float(d[0, 0])
    while lead == 0.0 and relative < order:
        relative += 1
        value = float(c[0] @ vector)
        if abs(value) > 1e-12 * np.linalg.norm(c[0]) * np.linalg.norm(vector) + 1e-300:
            lead = value
        vector = a @ vector
        size = max(size, float(np.linalg.norm(vector)))
    if lead == 0.0:
        raise UserError(f"{name}: its output does not depend on its input")
    if order == 0:
        return np.array([lead]), ONE
    system = np.block([[a, b], [c, d]])
    mass = np.zeros_like(system)
    mass[:order, :order] = np.eye(order)
    found = eigvals(system, mass)
    finite = found[np.isfinite(found)]
    zeros = finite[np.argsort(np.abs(finite))][: order - relative]
    return lead * np.real(np.atleast_1d(np.poly(zeros))), np.real(np.atleast_1d(np.poly(poles)))


def _checked(plant: Plant) -> Plant:
    """The plant with leading zeros taken off, or a UserError that says what is wrong with it."""
    for what, values in (("num", plant.num), ("den", plant.den)):
        if not np.isfinite(values).all():
            raise UserError(f"{plant.name}: {what} holds a value that is not a finite number")
    num, den = np.trim_zeros(plant.num, "f"), np.trim_zeros(plant.den, "f")
    if not den.size:
        raise UserError(f"{plant.name}: den is zero")
    if not num.size:
        raise UserError(f"{plant.name}: num is zero, so its output does not depend on its input")
    if len(num) > len(den):
        raise UserError(
            f"{plant.name}: improper: num has degree {len(num) - 1}, den {len(den) - 1}; "
            "add the missing poles (a lag), or put a derivative into the controller"
        )
    if not math.isfinite(plant.delay_s) or plant.delay_s < 0.0:
        raise UserError(f"{plant.name}: delay_s = {plant.delay_s}: must be 0 or more seconds")
    if plant.period_s is not None and plant.delay_s > 0.0:
        samples = plant.delay_s / plant.period_s
        if abs(samples - round(samples)) > 1e-6:
            raise UserError(
                f"{plant.name}: delay_s = {plant.delay_s} is not a whole number of periods of {plant.period_s} s; "
                "put the part of a period into the sampled plant"
            )
        den = np.concatenate([den, np.zeros(round(samples))])
    delay_s = 0.0 if plant.period_s is not None else plant.delay_s
    return Plant(num / den[0], den / den[0], delay_s, plant.period_s, plant.name)


# --------------------------------------------------------------------------------------------------------------------
# The controller's family and the plane
# --------------------------------------------------------------------------------------------------------------------


class Pid(NamedTuple):
    """C(s) = kp + ki / s + kd s / (derivative_lag_s s + 1), times a fixed compensator. Negative feedback, u = -C y.

    For a sampled plant s stands for (z - 1) / (period z), backward Euler. A gain that is fixed at zero brings neither
    its integrator nor its filter into the loop.
    """

    derivative_lag_s: float = 0.0
    compensator: Plant | None = None


class Plane(NamedTuple):
    """The plane of the gains `x` and `y`; `third` is the fixed value of the one that is left."""

    x: str
    y: str
    third: float = 0.0

    @property
    def third_name(self) -> str:
        """Name of the gain that is fixed."""
        return next(gain for gain in GAINS if gain not in (self.x, self.y))

    @property
    def name(self) -> str:
        """As in "kp-ki"."""
        return f"{self.x}-{self.y}"

    def gains(self, x: float, y: float) -> dict[str, float]:
        """All three gains of a point."""
        return {self.x: x, self.y: y, self.third_name: self.third}


def plane_of(name: str, third: float = 0.0) -> Plane:
    """Plane by its name, as "kp-ki"; raises UserError where it names not two of the three gains."""
    parts = name.split("-")
    if len(parts) != 2 or parts[0] == parts[1] or not set(parts) <= set(GAINS):
        raise UserError(f"plane {name!r}: must be two of kp, ki, kd with a dash, as kp-ki, kp-kd or ki-kd")
    if not math.isfinite(third):
        raise UserError(f"plane {name}: the value of the third gain must be a finite number, not {third}")
    return Plane(parts[0], parts[1], third)


# --------------------------------------------------------------------------------------------------------------------
# The characteristic
# --------------------------------------------------------------------------------------------------------------------


class Characteristic(NamedTuple):
    """p(s; x, y) = free(s) + exp(-delay_s s) (late(s) + x of_x(s) + y of_y(s)); in z without delay where sampled.

    Real coefficients, highest power first. Any loop that is affine in two parameters can be written like this; for a
    PID loop `characteristic` does it.
    """

    free: Floats
    late: Floats
    of_x: Floats
    of_y: Floats
    delay_s: float = 0.0
    period_s: float | None = None

    @property
    def degree(self) -> int:
        """Degree in s (or z) for almost all gains."""
        return max(len(np.trim_zeros(part, "f")) for part in self[:4]) - 1

    def parts(self, s: Complexes) -> tuple[Complexes, Complexes, Complexes]:
        """(a, b, c) with p = a + x b + y c at points of the s-plane (a sampled loop is taken at z = exp(s period))."""
        v = np.exp(s * self.period_s) if self.period_s else s
        shift = np.exp(-s * self.delay_s) if self.delay_s else 1.0
        return (
            np.polyval(self.free, v) + shift * np.polyval(self.late, v),
            np.asarray(shift * np.polyval(self.of_x, v)),
            np.asarray(shift * np.polyval(self.of_y, v)),
        )


def product_of(*factors: Floats) -> Floats:
    """Product of polynomials."""
    return reduce(lambda one, other: np.asarray(np.polymul(one, other), dtype=np.float64), factors)


def characteristic(plant: Plant, plane: Plane, pid: Pid = Pid()) -> Characteristic:  # noqa: B008 -- immutable
    """Characteristic of the loop of plant and PID in the plane of two of its gains.

    Raises UserError where the compensator does not fit the plant or the filter's time constant is negative.
    """
    if not math.isfinite(pid.derivative_lag_s) or pid.derivative_lag_s < 0.0:
        raise UserError(f"derivative_lag_s = {pid.derivative_lag_s}: must be 0 or more seconds")
    num, den, delay_s = plant.num, plant.den, plant.delay_s
    if pid.compensator is not None:
        if pid.compensator.period_s != plant.period_s:
            raise UserError(f"{pid.compensator.name}: must have the same sampling period as {plant.name}")
        num, den = product_of(num, pid.compensator.num), product_of(den, pid.compensator.den)
        delay_s += pid.compensator.delay_s
    in_plane = {plane.x, plane.y}
    has_ki = "ki" in in_plane or plane.third != 0.0
    has_kd = "kd" in in_plane or plane.third != 0.0
    if plant.period_s:
        period = plant.period_s
        integral_num, integral_den = np.array([period, 0.0]), np.array([1.0, -1.0])
        lag = pid.derivative_lag_s
        derivative_num, derivative_den = np.array([1.0, -1.0]), np.array([lag + period, -lag])
    else:
        integral_num, integral_den = ONE, S
        derivative_num = S
        derivative_den = np.array([pid.derivative_lag_s, 1.0]) if pid.derivative_lag_s else ONE
    if not has_ki:
        integral_den = ONE
    if not has_kd:
        derivative_den = ONE
    effect = {
        "kp": product_of(integral_den, derivative_den, num),
        "ki": product_of(integral_num, derivative_den, num),
        "kd": product_of(integral_den, derivative_num, num),
    }
    return Characteristic(
        free=product_of(integral_den, derivative_den, den),
        late=plane.third * effect[plane.third_name],
        of_x=effect[plane.x],
        of_y=effect[plane.y],
        delay_s=delay_s,
        period_s=plant.period_s,
    )


def coefficients(loop: Characteristic, x: Floats, y: Floats) -> Floats:
    """Coefficients of p for gains x, y of shape (n,), without regard to a delay: shape (n, degree + 1)."""
    width = loop.degree + 1
    free, late, of_x, of_y = (_widened(part, width) for part in loop[:4])
    return np.asarray(free + late + x[:, None] * of_x + y[:, None] * of_y)


def _widened(part: Floats, width: int) -> Floats:
    trimmed = part[max(0, len(part) - width) :]
    return np.concatenate([np.zeros(width - len(trimmed)), trimmed])


def _number(value: complex) -> str:
    return f"{value.real:.3g}" if abs(value.imag) < 1e-9 * abs(value) else f"{value.real:.3g}{value.imag:+.3g}j"


def given_gains(gains: Mapping[str, float], plane: Plane) -> tuple[float, float]:
    """The point of the plane that stands for given gains."""
    return gains[plane.x], gains[plane.y]
