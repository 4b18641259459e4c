"""Constrained model predictive control of the steering, solved by OSQP in every cycle.

Model: the kinematic car per metre of travel behind its nominal first-order lag, in deviations from the path
(`gains.lagging_model`), from the state predicted over the latencies; the path's curvature is known over the horizon.
Constraints: the car's greatest road-wheel angle and its rate, exact in the angle at the path's own steering. Terminal
cost: that of the unconstrained LQR. Formulation: Rawlings, Mayne, Diehl 2017, section 1.3; for path tracking Falcone et
al. 2007 (IEEE T-CST 15(3)); solver: Stellato et al. 2020 (OSQP).
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from firmware_py.core.tables import CarTable, LegTable
from tools.compare.gains import lagging_model, riccati
from tools.compare.laws import MPC_ARGUMENTS

Floats = npt.NDArray[np.float64]

STEPS = 15
STEP_S = 0.08
"""Horizon: 1.2 s, a dozen lags; the terminal cost stands for the rest."""

SPEED_STEP_MPS = 0.05
"""Speeds are rounded to this for the model's matrices, so that each is made and factorised once."""

SCALE = 100.0
"""Curvatures in 1/cm: numbers near one suit the solver."""

ACCURACY = 1e-4
"""Of the solver, in units of SCALE: a millionth of 1/m."""

MOST_ITERATIONS = 300
SOLVED, NEARLY_SOLVED, MOST_ITERATIONS_DONE = 1, 2, 7


class _Problem:
    """Matrices and solver for one speed and set of costs."""

    def __init__(self, car: CarTable, speed_mps: float, q_e: float, q_theta: float, q_change: float) -> None:
        import osqp  # noqa: PLC0415 -- only this law needs it
        from scipy import sparse  # noqa: PLC0415

        a, b, d = lagging_model(speed_mps, car.steering_lag_s, STEP_S)
        ds = speed_mps * STEP_S
        cost = ds * np.diag([q_e, q_theta, 0.0])
        terminal = riccati(a, b, cost, ds)
        self.free = np.zeros((3 * STEPS, 3))
        self.steps = np.zeros((3 * STEPS, STEPS))
        forced = np.zeros((3 * STEPS, STEPS))
        power, columns_b, columns_d = np.eye(3), np.zeros((3, STEPS)), np.zeros((3, STEPS))
        for index in range(STEPS):
            columns_b, columns_d = a @ columns_b, a @ columns_d
            columns_b[:, index], columns_d[:, index] = b[:, 0], d[:, 0]
            power = a @ power
            rows = slice(3 * index, 3 * index + 3)
            self.free[rows], forced[rows], self.steps[rows] = power, columns_b, columns_d
        weight = np.kron(np.eye(STEPS), cost)
        weight[-3:, -3:] = terminal
        change = np.eye(STEPS) - np.eye(STEPS, k=-1)
        change_weight = q_change * STEP_S**2 / ds
        hessian = forced.T @ weight @ forced + ds * np.eye(STEPS) + change_weight * change.T @ change
        self.pull = forced.T @ weight
        self.change = change_weight * change.T
        # Everything over ds, so that slow and fast problems look alike to the solver.
        self.unit = 1.0 / ds
        constraints = sparse.csc_matrix(np.vstack([np.eye(STEPS), change]))
        self.solver: Any = osqp.OSQP()
        self.solver.setup(
            P=sparse.csc_matrix(np.triu(self.unit * hessian)),
            q=np.zeros(STEPS),
            A=constraints,
            l=-np.ones(2 * STEPS),
            u=np.ones(2 * STEPS),
            verbose=False,
            eps_abs=ACCURACY,
            eps_rel=ACCURACY,
            max_iter=MOST_ITERATIONS,
            check_termination=10,
        )


class Mpc:
    """The law for one car and path; `solve` has the arguments of `laws.Solve`. `failures` counts unsolved cycles."""

    def __init__(self, car: CarTable, legs: tuple[LegTable, LegTable], numbers: tuple[float, ...]) -> None:
        self._car = car
        self._numbers = numbers
        self._curvature = {leg.sigma: np.asarray(leg.feedforward_curvature_1pm, dtype=float) for leg in legs}
        self._grid = {leg.sigma: leg.step_m * np.arange(len(leg.feedforward_curvature_1pm)) for leg in legs}
        self._problems: dict[int, _Problem] = {}
        self.failures = 0

    def solve(
        self,
        sigma: float,
        station_m: float,
        speed_mps: float,
        cross_m: float,
        theta_rad: float,
        angle_rad: float,
        command_rad: float,
    ) -> float:
        """Return the road-wheel angle to command (rad); the last one where the solver finds none."""
        car = self._car
        length = car.wheelbase_m
        key = max(round(speed_mps / SPEED_STEP_MPS), 1)
        problem = self._problems.get(key)
        if problem is None:
            problem = self._problems[key] = _Problem(car, key * SPEED_STEP_MPS, *self._numbers)
        # The path as the wheels are to follow it, from the middle of the cycle in which the command acts.
        stations = station_m + speed_mps * (0.0085 + STEP_S * np.arange(STEPS + 1))
        path = np.interp(stations, self._grid[sigma], self._curvature[sigma])
        steps = np.diff(path)
        state = np.array([cross_m, theta_rad, math.tan(angle_rad) / length - path[0]])
        last = math.tan(command_rad) / length
        ahead = problem.free @ state + problem.steps @ steps
        # Changes are those of the curvature itself: of the deviation, and of the path under it.
        drift = np.concatenate([[path[0] - last], steps[:-1]])
        linear = problem.unit * (problem.pull @ ahead + problem.change @ drift)
        most = max(math.tan(car.max_road_wheel_angle_rad) / length, abs(last))
        slope = (1.0 + (length * path[:-1]) ** 2) / length
        step = car.max_road_wheel_rate_radps * STEP_S * slope
        lower = np.concatenate([-most - path[:-1], -step - drift])
        upper = np.concatenate([most - path[:-1], step - drift])
        problem.solver.update(q=SCALE * linear, l=SCALE * lower, u=SCALE * upper)
        result = problem.solver.solve(raise_error=False)
        # What ran out of iterations is near enough: the limits are applied once more by the loop.
        usable = result.info.status_val in (SOLVED, NEARLY_SOLVED, MOST_ITERATIONS_DONE)
        if not usable or not math.isfinite(result.x[0]):
            self.failures += 1
            return command_rad
        return math.atan(length * (path[0] + float(result.x[0]) / SCALE))


_SIGNATURE = ctypes.CFUNCTYPE(ctypes.c_double, *[ctypes.c_double] * MPC_ARGUMENTS)


def callback(solve: Callable[..., float]) -> Any:
    """Return a Python function as one that compiled code can call; errors in it are kept in its `error`."""
    from numba import types  # noqa: PLC0415
    from numba.experimental import function_type  # noqa: F401, PLC0415 -- it is what lets numba take such an argument

    class Callback(types.WrapperAddressProtocol):
        """A C function pointer with its signature."""

        def __init__(self) -> None:
            self.error: BaseException | None = None
            self._pointer = _SIGNATURE(self._call)

        def _call(self, *numbers: float) -> float:
            try:
                return float(solve(*numbers))
            except BaseException as error:  # it cannot pass through compiled code
                self.error = error
                return math.nan

        def __wrapper_address__(self) -> int:
            return int(ctypes.cast(self._pointer, ctypes.c_void_p).value or 0)

        def signature(self) -> Any:
            return types.float64(*[types.float64] * MPC_ARGUMENTS)

    return Callback()


def no_solver(*_numbers: float) -> float:
    """Stand where a law needs no solver."""
    return 0.0
