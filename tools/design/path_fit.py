"""The paper's segmented polynomial fit (its eq. 1 to 10): equality-constrained least squares, solved exactly.

Each segment i is x_i(lambda), y_i(lambda), polynomials of order p on [0, 1]. Neighbours share the derivatives up to
order q. The paper equates derivatives in raw lambda, which bends the parameter where segments differ in length; here
the k-th derivative is divided by h^k, h being the segment's length in the waypoints' parameter, so that what is
continuous are the derivatives along the path. The raw variant and free ends stay available for comparison with the
paper.

The minimiser is found in the null space of the constraints (no iteration, no penalty): constraint residuals are at the
level of rounding.
"""

from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim.errors import UserError
from tools.design.waypoints import DenseWaypoints, Floats

Integers = NDArray[np.integer[Any]]


class FitResult(NamedTuple):
    """Polynomial segments of a path.

    coefficients: shape (m, p + 1, 2), m, in rising powers of lambda, columns x and y. length_m: shape (m,), extent h of
    each segment in the waypoints' parameter. constraint_residual: the largest violation of any joint or end condition,
    in m per (unit of the scaled parameter)^k. fit_rms_m: root mean square of the distances to the waypoints, x and y.
    """

    coefficients: Floats
    length_m: Floats
    constraint_residual: float
    fit_rms_m: tuple[float, float]


def derivative_row(order: int, lambda_: float, p: int) -> Floats:
    """Row that gives the `order`-th derivative at `lambda_` from coefficients in rising powers; shape (p + 1,)."""
    row = np.zeros(p + 1)
    for power in range(order, p + 1):
        factor = 1.0
        for step in range(order):
            factor *= power - step
        row[power] = factor * (lambda_ ** (power - order) if power > order else 1.0)
    return row


@cache
def _derivatives(lambda_: float, p: int) -> Floats:
    """All derivatives at one point: row k gives the k-th; shape (p + 1, p + 1), not to be written to."""
    table = np.array([derivative_row(order, lambda_, p) for order in range(p + 1)])
    table.flags.writeable = False
    return table


def fit_path(
    waypoints: DenseWaypoints,
    *,
    p: int = 6,
    q: int = 3,
    start: Floats | None = None,
    stop: Floats | None = None,
    length_scaled: bool = True,
) -> FitResult:
    """Fit m polynomial segments of order `p` with derivatives continuous up to order `q` to the waypoints.

    waypoints: m segments of n waypoints each. start, stop: shape (r, 2), values of the derivatives of order 0 to r - 1
    of (x, y) by the waypoints' parameter that are pinned at the ends (position, tangent, second derivative); None
    leaves the end free, as printed in the paper. length_scaled: False equates raw derivatives by lambda (the paper's
    eq. 5). Raises UserError where the conditions leave nothing to fit or contradict each other.
    """
    system = _system(waypoints.parameter_m, start, stop, p, q, length_scaled)
    measured = np.stack([waypoints.x_m.ravel(), waypoints.y_m.ravel()], axis=1)
    theta = _least_squares(system.phi, measured, system.gamma, system.target)
    residual = float(np.max(np.abs(system.gamma @ theta - system.target), initial=0.0))
    misfit = np.sqrt(np.mean((system.phi @ theta - measured) ** 2, axis=0))
    coefficients = theta.reshape(len(system.length_m), p + 1, 2)
    return FitResult(coefficients, system.length_m, residual, (float(misfit[0]), float(misfit[1])))


def fit_changes(parameter_m: Floats, changes: Floats, *, p: int = 6, q: int = 3, pinned: int = 3) -> Floats:
    """Change of the coefficients of one coordinate, shape (m, p + 1, k), for k changes of its waypoints.

    The fit is linear in the waypoints. parameter_m: shape (m, n); changes: shape (m * n, k); at both ends the
    derivatives of order 0 to `pinned` - 1 stay as they are.
    """
    unmoved = np.zeros((pinned, 2))
    system = _system(parameter_m, unmoved, unmoved, p, q, length_scaled=True)
    target = np.zeros((len(system.gamma), changes.shape[1]))
    return _least_squares(system.phi, changes, system.gamma, target).reshape(len(parameter_m), p + 1, -1)


class _System(NamedTuple):
    """Least squares |phi theta - waypoints| subject to gamma theta = target; columns x and y."""

    phi: Floats
    gamma: Floats
    target: Floats
    length_m: Floats


def _system(
    parameter_m: Floats, start: Floats | None, stop: Floats | None, p: int, q: int, length_scaled: bool
) -> _System:
    m, n = parameter_m.shape
    unknowns = m * (p + 1)
    length_m = parameter_m[:, -1] - parameter_m[:, 0]
    scale = length_m if length_scaled else np.ones(m)

    begin, end = _derivatives(0.0, p), _derivatives(1.0, p)
    pinned = [
        (segment, table, np.asarray(pin))
        for segment, table, pin in ((0, begin, start), (m - 1, end, stop))
        if pin is not None
    ]
    joints = (m - 1) * (q + 1)
    conditions = joints + sum(len(pin) for _, _, pin in pinned)
    if max([q, *(len(pin) - 1 for _, _, pin in pinned)]) > p:
        raise UserError(f"path fit: a condition on a derivative that order p = {p} does not have; raise p")
    if conditions >= unknowns:
        raise UserError(
            f"path fit: {conditions} conditions on {unknowns} coefficients; raise the order p = {p} or lower q = {q}"
        )
    rows_of = np.zeros((conditions, m, p + 1))
    target = np.zeros((conditions, 2))
    order = np.arange(p + 1)
    for joint in range(m - 1):
        rows = slice(joint * (q + 1), (joint + 1) * (q + 1))
        rows_of[rows, joint] = end[: q + 1] / (scale[joint] ** order[: q + 1])[:, None]
        rows_of[rows, joint + 1] = -begin[: q + 1] / (scale[joint + 1] ** order[: q + 1])[:, None]
    row = joints
    for segment, table, pin in pinned:
        # A pin is a derivative along the path, whatever the joints are scaled by.
        count = len(pin)
        rows_of[row : row + count, segment] = table[:count] / (length_m[segment] ** order[:count])[:, None]
        target[row : row + count] = pin
        row += count

    share = (parameter_m - parameter_m[:, :1]) / length_m[:, None]
    powers = np.zeros((m, n, m, p + 1))
    for segment in range(m):
        powers[segment, :, segment] = np.vander(share[segment], p + 1, increasing=True)
    return _System(powers.reshape(m * n, unknowns), rows_of.reshape(conditions, unknowns), target, length_m)


def _least_squares(phi: Floats, measured: Floats, gamma: Floats, target: Floats) -> Floats:
    """Minimise |phi theta - measured| subject to gamma theta = target; null-space method with one refinement step."""
    if not len(gamma):
        return np.asarray(np.linalg.lstsq(phi, measured, rcond=None)[0])
    weight = np.linalg.norm(gamma, axis=1)
    rows, values = gamma / weight[:, None], target / weight[:, None]
    count = len(rows)
    basis, upper = np.linalg.qr(rows.T, mode="complete")
    triangle = upper[:count].T
    diagonal = np.abs(np.diag(triangle))
    if diagonal.min() < 1e-12 * diagonal.max():
        raise UserError("path fit: the joint and end conditions contradict or repeat each other; raise p or lower q")
    fixed = basis[:, :count] @ np.linalg.solve(triangle, values)
    free = basis[:, count:]
    theta = fixed + free @ np.linalg.lstsq(phi @ free, measured - phi @ fixed, rcond=None)[0]
    # What rounding left of the constraints is taken back along their own rows.
    return np.asarray(theta + basis[:, :count] @ np.linalg.solve(triangle, values - rows @ theta))


def pins(x_m: float, y_m: float, yaw_rad: float, curvature_1pm: float = 0.0) -> Floats:
    """Pin for `fit_path` of waypoints over x: position, heading and curvature at one end; shape (3, 2)."""
    slope = np.tan(yaw_rad)
    bend = curvature_1pm * (1.0 + slope * slope) ** 1.5
    return np.array([[x_m, y_m], [1.0, slope], [0.0, bend]])


def evaluate(fit: FitResult, segment: Integers, lambda_: Floats, order: int) -> Floats:
    """Derivative of the given order by lambda of (x, y) at `lambda_` of `segment` (index array); shape (..., 2)."""
    p = fit.coefficients.shape[1] - 1
    result = np.zeros((*np.shape(lambda_), 2))
    index = segment.astype(int)
    for power in range(p, order - 1, -1):
        factor = 1.0
        for step in range(order):
            factor *= power - step
        result = result * np.asarray(lambda_)[..., None] + factor * fit.coefficients[index, power]
    return result


class Geometry(NamedTuple):
    """Points of a path, arrays of one shape; curvature's slope is by arc length, `speed_m` is arc length by lambda."""

    x_m: Floats
    y_m: Floats
    yaw_rad: Floats
    curvature_1pm: Floats
    curvature_slope_1pm2: Floats
    speed_m: Floats


def geometry(fit: FitResult, segment: Integers, lambda_: Floats) -> Geometry:
    """Position, heading, curvature (paper, eq. 10) and the slope of the curvature, all from exact derivatives."""
    r0, r1, r2, r3 = (evaluate(fit, segment, lambda_, order) for order in range(4))
    speed = np.sqrt(r1[..., 0] * r1[..., 0] + r1[..., 1] * r1[..., 1])
    cross12 = r1[..., 0] * r2[..., 1] - r1[..., 1] * r2[..., 0]
    cross13 = r1[..., 0] * r3[..., 1] - r1[..., 1] * r3[..., 0]
    dot12 = r1[..., 0] * r2[..., 0] + r1[..., 1] * r2[..., 1]
    curvature = cross12 / speed**3
    slope = cross13 / speed**4 - 3.0 * cross12 * dot12 / speed**6
    return Geometry(r0[..., 0], r0[..., 1], np.arctan2(r1[..., 1], r1[..., 0]), curvature, slope, speed)


def joint_jumps(fit: FitResult) -> tuple[float, float]:
    """Largest jump of curvature (1/m) and of its slope (1/m^2) over the joints of the segments."""
    m = len(fit.length_m)
    if m < 2:
        return 0.0, 0.0
    before = geometry(fit, np.arange(m - 1), np.ones(m - 1))
    after = geometry(fit, np.arange(1, m), np.zeros(m - 1))
    return (
        float(np.max(np.abs(before.curvature_1pm - after.curvature_1pm))),
        float(np.max(np.abs(before.curvature_slope_1pm2 - after.curvature_slope_1pm2))),
    )
