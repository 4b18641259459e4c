"""LQR gains over speed for the laws that have them: rows for FIRST_SPEED_MPS and its multiples up to full speed."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from firmware_py.core.tables import CarTable
from tools.compare.laws import FIRST_SPEED_MPS, PERIOD_S, PREVIEW_CYCLES

Floats = npt.NDArray[np.float64]
ROWS = 20


def speeds_mps() -> Floats:
    """Return the speeds of the rows."""
    return np.array([FIRST_SPEED_MPS * row for row in range(1, ROWS + 1)])


def blind_model(speed_mps: float, period_s: float = PERIOD_S) -> tuple[Floats, Floats]:
    """Return A (2, 2) and B (2, 1) of (e, theta) with the curvature error held over a period."""
    ds = speed_mps * period_s
    return np.array([[1.0, ds], [0.0, 1.0]]), np.array([[0.5 * ds * ds], [ds]])


def lagging_model(speed_mps: float, lag_s: float, period_s: float = PERIOD_S) -> tuple[Floats, Floats, Floats]:
    """Return A (3, 3), B (3, 1), D (3, 1) of (e, theta, wheels' curvature less the path's).

    The wheels close the share `alpha` of their gap in a period; `mean` is the share closed in its mean. D takes the
    step of the path's curvature from this period to the next.
    """
    ds = speed_mps * period_s
    if lag_s > 0.0:
        alpha = 1.0 - np.exp(-period_s / lag_s)
        mean = 1.0 - lag_s / period_s * alpha
    else:
        alpha = mean = 1.0
    a = np.array([[1.0, ds, 0.5 * ds * ds * (1.0 - mean)], [0.0, 1.0, ds * (1.0 - mean)], [0.0, 0.0, 1.0 - alpha]])
    b = np.array([[0.5 * ds * ds * mean], [ds * mean], [alpha]])
    return a, b, np.array([[0.0], [0.0], [-1.0]])


def riccati(a: Floats, b: Floats, q: Floats, r: float) -> Any:
    """Return the stabilising solution of the discrete Riccati equation."""
    from scipy.linalg import solve_discrete_are  # noqa: PLC0415 -- heavy, and only these laws need it

    return solve_discrete_are(a, b, q, np.array([[r]]))


def lqr_rows(q_e: float, q_theta: float) -> Floats:
    """Return rows (ROWS, 2): K of e (1/m^2) and of theta (1/m).

    Cost per metre: q_e (1/m^4) e^2 + q_theta (1/m^2) theta^2 + c^2.
    """
    rows = []
    for speed in speeds_mps():
        a, b = blind_model(speed)
        ds = speed * PERIOD_S
        p = riccati(a, b, ds * np.diag([q_e, q_theta]), ds)
        rows.append(np.linalg.solve(ds + b.T @ p @ b, b.T @ p @ a)[0])
    return np.array(rows)


def lqr_preview_rows(car: CarTable, q_e: float, q_theta: float) -> Floats:
    """Return rows (ROWS, 3 + PREVIEW_CYCLES): K of e, theta and the wheels' curvature, then of the path's steps ahead.

    The same cost with the nominal car's lag: u = -K x - sum_j (R + B'PB)^-1 B' (A - BK)'^j P D step_j.
    """
    rows = []
    for speed in speeds_mps():
        a, b, d = lagging_model(speed, car.steering_lag_s)
        ds = speed * PERIOD_S
        p = riccati(a, b, ds * np.diag([q_e, q_theta, 0.0]), ds)
        inverse = np.linalg.inv(ds + b.T @ p @ b)
        k = inverse @ b.T @ p @ a
        closed = (a - b @ k).T
        ahead = p @ d
        row = list(k[0])
        for _ in range(PREVIEW_CYCLES):
            row.append((inverse @ b.T @ ahead)[0, 0])
            ahead = closed @ ahead
        rows.append(row)
    return np.array(rows)
