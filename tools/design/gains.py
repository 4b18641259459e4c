"""Gain schedules by direction and speed: observer from a Riccati equation, PID as fast as the margins allow.

Everything is designed per metre of travel and stated for curvature, so that it hardly depends on the wheelbase. The
observer's process noise is given per root metre and the pose's noise per sample: a slowly travelled metre is averaged
over more poses, and the observer's gains depend on the speed. The PID is one pattern of poles per metre (`pid_gains`),
scaled by a pace. At every speed of the grid the pace is the largest one, up to the law's own, with which the nominal
car and every corner of the vehicle's box keep their poles in the D-region (`d_stable`) and a disk margin of at least
`LEAST_DISK_MARGIN`. Of the observers tried, the one is taken that gives the nominal car the smallest modelled
cross-track error (rms, worst speed of the grid).
"""

import itertools
import math
from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np

from firmware_py.core.predictor import QUEUE_LENGTH
from sim.data_files import Vehicle
from sim.errors import UserError
from tools.design import model
from tools.design.model import Complexes, Floats, Row

LAWS = ("car", "pid_ff")
"""As in the names of their tables; `pid_ff` takes each pose as it comes."""

PREDICTING_LAWS = ("car",)
"""Laws that observe, and predict to the instant at which the command acts."""

COLUMNS = Row._fields

SPEED_GRID_MPS = (0.0, 0.01, 0.02, 0.035, 0.05, 0.075, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)

POSITION_NOISE_M = 0.01
HEADING_NOISE_RAD = math.radians(0.1)
"""Noise of one pose, of the localisation that the design assumes."""

DISTURBANCE = (0.5e-3, 2e-3, 5e-3)
"""What the car does by itself: noise of cross-track error (m), heading (rad) and curvature disturbance (1/m) per root
metre of travel. The last stands for steering bias, steering gain and tyres, whose effect changes as the path bends."""

OBSERVER_PACES = (0.8, 0.65, 0.5, 0.4)
"""Observers tried: process noise of `DISTURBANCE` with its poles moved by about these factors. Faster ones spend
more of the steering's rate on the pose's noise and bring no smaller largest error."""

PREVIEW_S = 0.5
"""The preview distance in seconds of travel."""

FASTEST_PACE = {"car": 1.25, "pid_ff": 0.65}
"""Largest pace of the PID: above it the pose's noise costs more than the quicker answer gains. Unfiltered, that noise
saturates the steering's rate, which no linear margin shows: twice this pace loses a 4 m wheelbase off the path."""

SLOWEST_PACE = 0.3
"""Below it a start off the path would not be corrected within a leg."""

LEAST_DISK_MARGIN = 0.34
"""Of every car in the box: 1.4 times the steering gain, or 19 degrees of phase, whatever mixture of both."""

SLOWEST_POLE_1PM = -0.08
"""Every pole decays within 12 m of travel, the shorter leg."""

LEAST_DAMPING = 0.1
"""Of every pole of every car in the box; the nominal car has far more, and the disk margin mostly asks for more."""

BLEND_RESERVE = 1.2
"""The rows' damping over the least one: what is blended between two rows has a little less than they."""

QUICK_1PS = 10.0
"""Poles that decay faster, within 0.1 s, belong to delay chain and lag and need no damping."""

GAIN_SPREAD = 0.1
"""Steering gain of the cars in the box, besides the wheelbase."""


def pid_gains(pace: float) -> tuple[float, float, float]:
    """PID gains kp (1/m^2), ki (1/m^3), kd (1/m) whose poles per metre are those of (2, 0.4, 2.5) times the pace."""
    return 2.0 * pace**2, 0.4 * pace**3, 2.5 * pace


def observer_noise(pace: float) -> tuple[float, float, float]:
    """Process noise (m, rad, 1/m per root metre) of an observer whose poles are about `pace` times the first one's."""
    e, heading, disturbance = DISTURBANCE
    return e * math.sqrt(pace), heading * pace**1.5, disturbance * pace**2.5


def checked_speeds(vehicle: Vehicle) -> tuple[float, ...]:
    """Speeds of the grid that the car can have, without standstill; in the rows beyond, it never is."""
    reached = [speed for speed in SPEED_GRID_MPS[:-1] if speed < vehicle.max_speed_mps]
    return SPEED_GRID_MPS[1 : len(reached) + 1]


def corners(vehicle: Vehicle) -> list[model.Corner]:
    """The cars to survive: the nominal one, then the corners of the box in lag, latency, steering gain and wheelbase.

    Each has `model.LOOP_AGE_S` of latency besides its own. Mass and tyres do not enter: at walking speed the tyres
    answer within a cycle or two, and what slip turns the car is the feedforward's and the disturbance's business.
    """
    age = model.LOOP_AGE_S / model.PERIOD_S
    pose, command = vehicle.box["pose_latency_samples"], vehicle.box["command_latency_samples"]
    own = vehicle.pose_latency_samples + vehicle.command_latency_samples
    cars = [model.Corner("nominal car", vehicle.steering_lag_s, own + age, 1.0)]
    spread = (1.0 - GAIN_SPREAD, 1.0 + GAIN_SPREAD)
    latencies = (pose[0] + command[0], pose[1] + command[1])
    for lag, latency, gain, wheelbase in itertools.product(
        _ends(vehicle.box["steering_lag_s"]), _ends(latencies), spread, _ends(vehicle.box["wheelbase_m"])
    ):
        name = f"lag {lag:g} s, latency {latency:g} samples, steering gain {gain:g}, wheelbase {wheelbase:g} m"
        cars.append(model.Corner(name, lag, latency + age, gain * vehicle.wheelbase_m / wheelbase))
    return cars


def _ends(interval: tuple[float, float]) -> tuple[float, ...]:
    return interval[:1] if interval[0] == interval[1] else interval


# --------------------------------------------------------------------------------------------------------------------
# One row
# --------------------------------------------------------------------------------------------------------------------


def observer_model(
    direction: float, speed_mps: float, noise: tuple[float, float, float]
) -> tuple[Floats, Floats, Floats, Floats]:
    """The observer's F (3, 3), H (2, 3), process noise (3, 3) and measurement noise (2, 2) of one cycle."""
    f, _ = model.motion(speed_mps, direction, 0.0)
    ds = speed_mps * model.PERIOD_S
    return (
        f[:3, :3],
        np.eye(2, 3),
        np.diag([value * value * ds for value in noise]),
        np.diag([POSITION_NOISE_M**2, HEADING_NOISE_RAD**2]),
    )


@cache
def observer_gains(direction: float, speed_mps: float, noise: tuple[float, float, float]) -> Floats:
    """Steady-state Kalman gains per cycle of (e, heading error, disturbance), shape (3, 2); zeros at standstill.

    noise: process noise of the three per root metre of travel. The array cannot be written to.
    """
    from scipy.linalg import solve_discrete_are  # noqa: PLC0415  (heavy, and only the design needs it)

    if speed_mps == 0.0:
        return np.broadcast_to(0.0, (3, 2))
    f, h, q, r = observer_model(direction, speed_mps, noise)
    # In units of the measurement's noise: the solver is accurate where numbers are alike.
    unit = np.array([POSITION_NOISE_M, HEADING_NOISE_RAD, HEADING_NOISE_RAD])
    covariance = solve_discrete_are(
        (f * unit / unit[:, None]).T, h.T, q / np.outer(unit, unit), r / np.outer(unit[:2], unit[:2])
    ) * np.outer(unit, unit)
    gains = np.asarray(covariance @ h.T @ np.linalg.inv(h @ covariance @ h.T + r))
    gains.setflags(write=False)
    return gains


def row_of(law: str, direction: float, speed_mps: float, pid_pace: float, observer_pace: float) -> Row:
    """A row of the gain table; a law that takes each pose as it comes has no observer, whatever its pace."""
    correction = np.eye(3, 2)
    if law in PREDICTING_LAWS:
        correction = observer_gains(direction, speed_mps, observer_noise(observer_pace))
    kp, ki, kd = pid_gains(pid_pace)
    l_ee, l_ep, l_pe, l_pp, l_de, l_dp = (float(value) for value in correction.reshape(-1))
    return Row(direction, speed_mps, PREVIEW_S * speed_mps, kp, ki, kd, l_ee, l_ep, l_pe, l_pp, l_de, l_dp)


# --------------------------------------------------------------------------------------------------------------------
# The criteria
# --------------------------------------------------------------------------------------------------------------------


def frequencies(speed_mps: float, count: int = 200) -> Floats:
    """Angular frequencies, rad/s, by even ratios from one period in 300 m of travel to half the rate of cycles."""
    return np.geomspace(0.02 * speed_mps, 0.999 * math.pi / model.PERIOD_S, count)


def on_circle(omega: Floats) -> Complexes:
    """The points z of angular frequencies in rad/s."""
    return np.asarray(np.exp(1j * omega * model.PERIOD_S))


def disk_margin(loop: Complexes) -> Floats:
    """Balanced disk margin of loops over the last axis: any gain and phase in the disk keeps a stable loop stable.

    2 / max |S - T|, as python-control's `disk_margins` with skew 0 (Seiler, Packard, Gahinet 2020).
    """
    return np.asarray(2.0 * np.min(np.abs((1.0 + loop) / (1.0 - loop)), axis=-1))


def d_stable(matrix: Floats, speed_mps: float, least_damping: float = LEAST_DAMPING) -> bool:
    """Whether all poles of a closed loop lie in the D-region: fast enough per metre of travel, and damped."""
    poles = model.poles_1pm(matrix, speed_mps)
    if float(poles.real.max()) > SLOWEST_POLE_1PM:
        return False
    slow = poles[poles.real > -QUICK_1PS / speed_mps]
    return bool(np.all(-slow.real >= least_damping * np.abs(slow)))


def modelled_error_m(row: Row, nominal: model.Nominal, car: model.Corner, predicts: bool) -> float:
    """Stationary rms of the cross-track error of a stable closed loop, m.

    Driven by the noise of the poses and by `DISTURBANCE`; by integration of the spectra.
    """
    theta = np.geomspace(1e-4 * row.speed_mps, math.pi, 400)
    z = np.exp(1j * theta)
    plant = model.car_response(car, row.speed_mps, row.direction, z)
    law = model.controller_response(row, nominal, z, predicts)
    f, _, process, measurement = observer_model(row.direction, row.speed_mps, DISTURBANCE)
    drift = np.linalg.solve(z[:, None, None] * np.eye(3) - f, np.sqrt(process)[None])[:, :2]
    # All five sources as the pose would show them without feedback.
    pose = np.concatenate([drift, np.broadcast_to(np.sqrt(measurement), (len(z), 2, 2))], axis=2)
    command = np.einsum("zi,zij->zj", law, pose) / (1.0 - np.sum(law * plant, axis=1))[:, None]
    error = plant[:, :1] * command
    error[:, :3] += drift[:, 0]
    power = np.sum(np.abs(error) ** 2, axis=1)
    area = float(np.sum(0.5 * (power[1:] + power[:-1]) * np.diff(theta)) + power[0] * theta[0])
    return math.sqrt(area / math.pi)


# --------------------------------------------------------------------------------------------------------------------
# The choice
# --------------------------------------------------------------------------------------------------------------------


class Schedule(NamedTuple):
    """What was chosen for a law: the observer's pace, the PID's pace at each speed, and the modelled error."""

    observer_pace: float
    pid_pace: tuple[float, ...]
    cross_track_rms_m: float


def design_gains(vehicle: Vehicle) -> dict[str, list[tuple[float, ...]]]:
    """Gain tables of every law for a vehicle: rows in the order of `COLUMNS`, directions +1 and -1 over the speed grid.

    Deterministic. Raises UserError where no gains survive the vehicle's box, naming the dimension to narrow.
    """
    latency = model.nominal_of(vehicle).latency_samples
    if latency >= QUEUE_LENGTH:
        raise UserError(
            f"vehicle {vehicle.name}: pose_latency_samples + command_latency_samples = {latency}: must be below"
            f" {QUEUE_LENGTH}, the number of commands that the controller remembers"
        )
    tables: dict[str, list[tuple[float, ...]]] = {}
    for law in LAWS:
        schedule = choose(vehicle, law)
        tables[law] = [
            tuple(row_of(law, direction, speed, pace, schedule.observer_pace))
            for direction in (1.0, -1.0)
            for speed, pace in zip(SPEED_GRID_MPS, schedule.pid_pace, strict=True)
        ]
    return tables


def choose(vehicle: Vehicle, law: str) -> Schedule:
    """The best schedule of a vehicle and law, by the criterion of this module."""
    best: Schedule | None = None
    for observer_pace in OBSERVER_PACES if law in PREDICTING_LAWS else OBSERVER_PACES[:1]:
        schedule = _schedule(vehicle, law, observer_pace)
        if schedule is None:
            continue
        if best is not None and schedule.cross_track_rms_m >= best.cross_track_rms_m:
            break  # slower observers only lose from here on
        best = schedule
    if best is None:
        raise UserError(_why_not(vehicle, model.nominal_of(vehicle), law))
    return best


def _schedule(vehicle: Vehicle, law: str, observer_pace: float) -> Schedule | None:
    """The schedule with one observer; None where some speed has no gains that survive."""
    cars = corners(vehicle)
    nominal = model.nominal_of(vehicle)
    checked = checked_speeds(vehicle)
    fastest = FASTEST_PACE[law]
    paces: list[float] = []
    worst = 0.0
    # The loop in reverse is the same but for the sign of the heading error: one direction tells all.
    for speed in reversed(checked):

        def survives(pace: float, speed: float = speed) -> bool:
            return _survives(row_of(law, 1.0, speed, pace, observer_pace), nominal, cars, law in PREDICTING_LAWS)

        pace = _largest(survives, SLOWEST_PACE, fastest)
        if pace is None:
            return None
        paces.append(pace)
        chosen = row_of(law, 1.0, speed, pace, observer_pace)
        worst = max(worst, modelled_error_m(chosen, nominal, cars[0], law in PREDICTING_LAWS))
    beyond = len(SPEED_GRID_MPS) - 1 - len(checked)
    by_speed = (paces[-1], *reversed(paces), *(paces[0],) * beyond)
    return Schedule(observer_pace, by_speed, worst)


def _survives(row: Row, nominal: model.Nominal, cars: list[model.Corner], predicts: bool) -> bool:
    z = on_circle(frequencies(row.speed_mps))
    loops = model.loop_response(row, nominal, cars, z, predicts)
    if float(disk_margin(loops).min()) < LEAST_DISK_MARGIN:
        return False
    least_damping = BLEND_RESERVE * LEAST_DAMPING
    return all(d_stable(model.closed_loop(row, nominal, car, predicts), row.speed_mps, least_damping) for car in cars)


def _largest(holds: Callable[[float], bool], low: float, high: float, steps: int = 7) -> float | None:
    """Largest value from low to high for which a property holds that is lost on the way up; None where low lacks it."""
    if holds(high):
        return high
    if not holds(low):
        return None
    for _ in range(steps):
        middle = 0.5 * (low + high)
        if holds(middle):
            low = middle
        else:
            high = middle
    return low


def _why_not(vehicle: Vehicle, nominal: model.Nominal, law: str) -> str:
    """One line that names the dimension of the box which keeps the softest gains from surviving."""
    speed = checked_speeds(vehicle)[-1]
    row = row_of(law, 1.0, speed, SLOWEST_PACE, OBSERVER_PACES[-1])
    z = on_circle(frequencies(speed))

    def margin(car: model.Corner) -> float:
        if not d_stable(model.closed_loop(row, nominal, car, law in PREDICTING_LAWS), speed):
            return 0.0
        return float(disk_margin(model.loop_response(row, nominal, [car], z, law in PREDICTING_LAWS))[0])

    cars = corners(vehicle)
    worst = min(cars, key=margin)
    # The dimension that helps most when it alone is nominal; where none helps enough, when it alone does not delay.
    blamed = _dimension_that_helps(worst, cars[0], margin)
    if blamed[0] < LEAST_DISK_MARGIN:
        blamed = _dimension_that_helps(worst, model.Corner("", 0.0, 0.0, 1.0), margin)
    keys = blamed[1]
    own, low, high = (
        sum(values) for values in zip(*((getattr(vehicle, key), *vehicle.box[key]) for key in keys), strict=True)
    )
    return (
        f"vehicle {vehicle.name}: {' + '.join(keys)} = {own:g} ({low:g} to {high:g}): no gains of law {law} keep a disk"
        f" margin of {LEAST_DISK_MARGIN:g} at {speed:g} m/s with {worst.name}; narrow low..high, or a quicker car"
    )


def _dimension_that_helps(
    car: model.Corner, home: model.Corner, margin: Callable[[model.Corner], float]
) -> tuple[float, tuple[str, ...]]:
    """The largest margin of a car with one dimension taken from `home`, and that dimension's keys in the file."""
    only_steering = max(min(car.gain, 1.0 + GAIN_SPREAD), 1.0 - GAIN_SPREAD)
    trials = {
        ("steering_lag_s",): car._replace(steering_lag_s=home.steering_lag_s),
        ("pose_latency_samples", "command_latency_samples"): car._replace(latency_samples=home.latency_samples),
        ("wheelbase_m",): car._replace(gain=only_steering),
    }
    margins = {keys: margin(trial) for keys, trial in trials.items()}
    best = max(margins, key=lambda keys: margins[keys])
    return margins[best], best
