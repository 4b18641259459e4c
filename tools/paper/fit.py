"""What the paper does not print, found from what it prints: waypoints from the DOB's cells, gains from the PID's.

Waypoints and cuts are fitted to the eight DOB-only cells of Tables 5 and 6, then the PID's gains to the PID-only cells;
the cells of PID + DOB take no part and are predictions. The fit is not unique (where along the course the turn lies
hardly shows in the cells), so a weak pull towards a plain drawing makes it one. The result is kept in `fit.toml`;
`parkctl paper --fit` makes it again.
"""

import math
import platform
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sim.errors import UserError
from tools.design.waypoints import Floats, Waypoints, check_waypoints, interpolate
from tools.paper.laws import DOB, PID, Gains, Law
from tools.paper.path_study import FOOT_M, VARIANTS, PathResult, fitted
from tools.paper.plant import FORWARD, REVERSE, TABLE_4, PaperCar, Plant
from tools.paper.printed import TABLES_5_6
from tools.paper.simulate import Figures, Steps, figures_of, simulate
from tools.paper.speed import TABLE_3, motion
from tools.paper.track import track_of

STORED = Path(__file__).with_name("fit.toml")

AHEAD_FT, ASIDE_FT = 50.0, 4.5
"""The manoeuvre: 50 ft ahead and 4.5 ft aside (eq. 21 in feet)."""

STRAIGHT_FT = (12.5, 36.0)
"""Where a second waypoint marks the straight ends; how far from the turn hardly shows, so it is not fitted."""
CUTS_FT = (12.5, 25.0, 37.5)
"""Four equal segments: of equal length, raw lambda and length along the path are the same but for a factor."""
DRAWING = (16.5, 24.5, 32.5, 2.25)
"""Where the fit begins, ft: x at which the turn begins, of its middle and of its end; y of the middle."""
SCALE = (1.5, 1.5, 1.5, 0.3)
"""How far each of them may well lie from the drawing, ft."""
PULL = 0.02
"""Weight of one SCALE away from the drawing, beside a cell's relative error of 1."""
RATE_WEIGHT = 0.4
"""The steering rate counts less: it is the second derivative of the curve that is looked for."""
DRAWN_GAINS = Gains(60.0, 10.0, 0.5)
GAIN_PULL = 0.02
"""The same for the gains, in parts of themselves: kd hardly shows in the cells."""
STARTS = 10
FIT_STEP_S, FIT_SAMPLE_M = 5e-3, 0.01


class StoredFit(NamedTuple):
    """The fit: waypoints in m with their cuts, gains of eq. 19, and where it came from."""

    waypoints: Waypoints
    gains: Gains
    provenance: dict[str, str | float | int]


def gains_for(car: PaperCar, stored: StoredFit) -> Gains:
    """The fitted gains, scaled with the wheelbase, so that the loop in terms of curvature is the same for every car."""
    scale = car.wheelbase_m / TABLE_4.wheelbase_m
    return Gains(*(scale * gain for gain in stored.gains))


def waypoints_of(numbers_ft: Floats) -> Waypoints:
    """Waypoints from the four numbers of the fit; two on each straight end, so that makima leaves these straight."""
    begin, middle, end, middle_y = (float(number) for number in numbers_ft)
    x = (0.0, STRAIGHT_FT[0], begin, middle, end, STRAIGHT_FT[1], AHEAD_FT)
    y = (0.0, 0.0, 0.0, middle_y, ASIDE_FT, ASIDE_FT, ASIDE_FT)
    return Waypoints(tuple(FOOT_M * v for v in x), tuple(FOOT_M * v for v in y), tuple(FOOT_M * v for v in CUTS_FT))


def printed_path(waypoints: Waypoints, step_m: float = FIT_SAMPLE_M) -> PathResult:
    """The path as printed: raw lambda, free ends."""
    check_waypoints(waypoints)
    return fitted(interpolate(waypoints), waypoints, VARIANTS[0], step_m=step_m)


class Cells:
    """The cells of Tables 5 and 6 of one law on the paper's car; keeps what does not depend on the path."""

    def __init__(self, law: Law) -> None:
        self._steps = {direction: Steps(Plant(TABLE_4, direction), law, FIT_STEP_S) for direction in (FORWARD, REVERSE)}

    def figures(self, result: PathResult) -> list[Figures]:
        """Figures forward and in reverse."""
        answer = []
        for direction, steps in self._steps.items():
            track = track_of(result.path, direction)
            answer.append(
                figures_of(simulate(steps, track, motion(track.station_m, track.curvature_1pm, TABLE_3, FIT_STEP_S)))
            )
        return answer


def fit(tell: Callable[[str], None] = print) -> StoredFit:
    """Fit waypoints, then gains; takes some minutes."""
    from scipy.optimize import least_squares  # noqa: PLC0415

    cells = Cells(Law(DOB, Gains(0.0, 0.0, 0.0)))
    drawing, scale = np.array(DRAWING), np.array(SCALE)
    rng = np.random.default_rng(0)
    best, best_numbers = math.inf, drawing
    for number in range(STARTS):
        begin = drawing if number == 0 else drawing + 0.7 * scale * rng.normal(size=len(drawing))
        answer = least_squares(lambda z: waypoint_residuals(z, cells), begin, diff_step=1e-3, max_nfev=60)
        tell(f"waypoints, start {number + 1} of {STARTS}: cost {answer.cost:.5f}")
        if answer.cost < best:
            best, best_numbers = float(answer.cost), answer.x
    waypoints = waypoints_of(np.round(best_numbers, 4))
    result = printed_path(waypoints)

    def gain_residuals(log_gains: Floats) -> Floats:
        kp, ki, kd = np.exp(log_gains)
        # The rate cells of the PID are left out: they come from the start (see the rate study).
        errors = _errors(Cells(Law(PID, Gains(kp, ki, kd))).figures(result), PID, 0.0)
        return np.concatenate([errors, GAIN_PULL * (log_gains - np.log(DRAWN_GAINS))])

    answer = least_squares(gain_residuals, np.log(DRAWN_GAINS), diff_step=1e-2, max_nfev=30)
    gains = Gains(*(float(f"{gain:.4g}") for gain in np.exp(answer.x)))
    tell(f"gains: cost {answer.cost:.5f}, kp, ki, kd = {gains.kp:g}, {gains.ki:g}, {gains.kd:g}")
    return StoredFit(
        waypoints,
        gains,
        {
            "command": "parkctl paper --fit",
            "waypoints_fitted_to": "DOB-only cells of Tables 5 and 6",
            "gains_fitted_to": "PID-only cells of Tables 5 and 6 without the steering rates",
            "waypoint_cost": float(f"{best:.4g}"),
            "gain_cost": float(f"{answer.cost:.4g}"),
            "starts": STARTS,
            "numpy": np.__version__,
            "python": platform.python_version(),
        },
    )


def _errors(figures: list[Figures], law: str, rate_weight: float) -> Floats:
    """Relative errors (logarithms of the ratio) of a law's cells, forward then reverse."""
    weights = np.array([1.0, 1.0, 1.0, rate_weight])
    printed = [TABLES_5_6[direction][law] for direction in (FORWARD, REVERSE)]
    rows = [
        weights * np.log(np.array(ours[:4]) / np.array(cells)) for ours, cells in zip(figures, printed, strict=True)
    ]
    return np.concatenate(rows)


def waypoint_residuals(numbers_ft: Floats, cells: Cells) -> Floats:
    """What the fit of the waypoints makes small: relative errors of the DOB's cells (8,), then the pull (4,)."""
    pull = PULL * (numbers_ft - np.array(DRAWING)) / np.array(SCALE)
    try:
        errors = _errors(cells.figures(printed_path(waypoints_of(numbers_ft))), DOB, RATE_WEIGHT)
    except UserError:  # waypoints out of order: nothing to compare
        errors = np.full(8, 3.0)
    return np.concatenate([errors, pull])


def to_toml(stored: StoredFit) -> str:
    """The text of `fit.toml`."""
    lines = [
        "# Waypoints and gains that the paper does not print, fitted to what it prints. Generated; do not edit.",
        "[provenance]",
        *(
            f'{key} = "{value}"' if isinstance(value, str) else f"{key} = {value!r}"
            for key, value in stored.provenance.items()
        ),
        "",
        "[waypoints] # m; the start of the centre of gravity is the origin",
        *(f"{key} = {[round(v, 6) for v in getattr(stored.waypoints, key)]}" for key in ("x_m", "y_m", "split_x_m")),
        "",
        "[gains] # eq. 19: rad/m, rad/(m s), rad s/m",
        *(f"{key} = {value!r}" for key, value in stored.gains._asdict().items()),
        "",
    ]
    return "\n".join(lines)


def load_fit(file: Path = STORED) -> StoredFit:
    """Read a stored fit; raises UserError, one line, where it does not hold one."""
    try:
        content = tomllib.loads(file.read_text(encoding="utf-8"))
        x_m, y_m, split_x_m = (_numbers(content["waypoints"], key) for key in ("x_m", "y_m", "split_x_m"))
        waypoints = Waypoints(x_m, y_m, split_x_m)
        gains = Gains(*(float(content["gains"][key]) for key in Gains._fields))
    except OSError as error:
        raise UserError(f"{file}: cannot be read: {error.strerror}") from None
    except KeyError as error:
        raise UserError(
            f"{file}: {error.args[0]} is missing; it holds [waypoints] x_m, y_m, split_x_m and [gains] kp, ki, kd"
        ) from None
    except (ValueError, TypeError, AttributeError) as error:
        raise UserError(f"{file}: {' '.join(str(error).split())}") from None
    if not all(math.isfinite(gain) and gain >= 0.0 for gain in gains):
        raise UserError(f"{file}: gains {tuple(gains)}: kp, ki and kd must be finite and not negative")
    try:
        check_waypoints(waypoints)
    except UserError as error:
        raise UserError(f"{file}: {error}") from None
    return StoredFit(waypoints, gains, dict(content.get("provenance", {})))


def _numbers(table: dict[str, object], key: str) -> tuple[float, ...]:
    values = table[key]
    if not isinstance(values, list) or not all(isinstance(v, int | float) and not isinstance(v, bool) for v in values):
        raise ValueError(f"waypoints.{key} must be a list of numbers in m")
    return tuple(float(v) for v in values)
