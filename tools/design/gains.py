"""Gain schedules by direction and speed: the estimator's noises, and a PID as fast as the margins allow.

Everything is designed per metre of travel and stated for curvature, so that it hardly depends on the wheelbase. The
estimator's filter makes its gains itself, while it runs; margins are those with the gains that it has in the long run
(`tools.design.filter`). The PID is one pattern of poles per metre (`pid_gains`), scaled by a pace. At every speed of
the grid the pace is the largest one, up to the law's own, with which the nominal car and every corner of the vehicle's
box keep their poles in the D-region (`d_stable`), their disk margin and their delay margin, with a reserve over what
the vehicle's file asks for (`Demand`). The rate at which the steering's gain is learnt is the largest one with which
they do in a bend; without the yaw rate a smaller disk margin is enough, and no delay margin is asked for.
"""

import math
from collections.abc import Callable, Iterable
from functools import cache
from typing import NamedTuple

import numpy as np

from firmware_py.core.estimator import ODOMETRY_LENGTH
from firmware_py.core.kalman import YAW_RATE_NOISE_RADPS
from firmware_py.core.motion import QUEUE_LENGTH
from sim.data_files import Criteria, Vehicle
from sim.errors import UserError
from tools.design import model
from tools.design.box import CarsAtSpeed, cars_at_speed, corners
from tools.design.margins import disk_margin, frequencies, margins_of, on_circle
from tools.design.model import Complexes, Floats, Mode, Row

LAWS = ("car", "pid_ff")
"""As in the names of their tables; `pid_ff` takes each pose as it comes."""

MODES: dict[str, dict[str, Mode]] = {
    "car": {
        "car": Mode(),
        "car, poses without noise": Mode(localisation="exact"),
        "car, poses without noise, in a bend": Mode(localisation="exact", in_bend=True),
        "car, poses with slow noise": Mode(localisation="slow"),
        "car, poses with slow noise, in a bend": Mode(localisation="slow", in_bend=True),
        "car, without the yaw rate": Mode(with_yaw_rate=False),
        "car, without the yaw rate, in a bend": Mode(with_yaw_rate=False, in_bend=True),
    },
    "pid_ff": {"pid_ff": Mode(predicts=False)},
}
"""How each law runs; the one of the law's own name is the usual."""

COLUMNS = Row._fields

SPEED_GRID_MPS = (0.0, 0.01, 0.02, 0.035, 0.05, 0.075, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)

ROAD_WALK_1PM = 0.5e-3
"""Change of the road disturbance per root metre: the play of the steering goes from one side to the other."""

OFFSET_LENGTH_M = 6.0
"""Way over which the steering offset is learnt: long against what an unknown lag of the steering looks like, whose gap
would be taken for an offset in every bend, and short enough that a leg shows a real one. From 3 to 12 m the errors are
the same; the disk margin of the paper's car at 1 m/s is 0.78 with 3 m, 0.82 with 6 m and 0.84 with 12 m."""

GAIN_RATE_MAX_1PM = 1.5
"""What the steering's gain takes at most of a gap between measured and nominal angle, per metre in a bend, where it is
an integral about the wheels. With it a weak steering is known before the first bend is over; with 3 the errors are up
to 2 % smaller, and the paper's car has too little margin in a bend. Where the loop there would keep too little it is
less."""

DISTURBANCE = (0.5e-3, 2e-3, 5e-3)
"""Without the yaw rate: noise of cross-track error (m), heading (rad) and road disturbance (1/m) per root metre. The
last stands for steering bias, steering gain and tyres, whose effect changes as the path bends."""

OBSERVER_PACES = (0.8, 0.65, 0.5, 0.4, 0.3)
"""Observers tried without the yaw rate: process noise of `DISTURBANCE` with its poles moved by about these factors."""

PREVIEW_S = 0.2
"""The preview distance in seconds of travel."""

FASTEST_PACE = {"car": 1.4, "pid_ff": 0.65}
"""Largest pace of the PID. With `car` the one from which on a quicker PID hardly errs less: what is left then is the
estimate's error. It costs margin: with 1.2 the paper's car has at 1 m/s a disk margin of 0.93 and a delay margin of
19.3 samples, with 1.4 of 0.82 and 17.7. Where the wheels or their rate are at a limit no linear margin holds, there
the law's own bound on the correction does (`firmware_py.core.pid`). Unfiltered, the pose's noise saturates the
steering's rate."""

KD_MAX_1PM = 2.4
"""Greatest kd. Beyond it the error is as small with less of it, and the delay margin larger: the push on the wheels
(`firmware_py.core.pid.push_rad`) damps as well as a quick steering lets it."""

KI_OVER_KP_MAX_1PM = {"car": 0.12, "pid_ff": math.inf}
"""Greatest ki over kp, which is about the pole that the integral adds. With `car` the observer has learnt what turns
the car and what carries it aside; an integral as quick as the rest would only follow the estimate's errors, and swing
past the path after each. Slower than the D-region allows (`slowest_pole_1pm`) it must not be."""

SLOWEST_PACE = 0.3
"""Below it a start off the path would not be corrected within a leg."""

RESERVE = 1.2
"""What the usual loop keeps over what the vehicle's file asks for, in margins and damping: what is blended between two
rows has a little less than they, and a finer grid of frequencies finds a little less."""

BEND_RESERVE = 1.05
"""The same in a bend, for what the grids miss: the learnt gain may have nearly all the margin that the PID leaves."""

LEAST_DISK_MARGIN_OF_PLAIN = 0.34
"""Of the law `pid_ff`, which is there to compare with: 1.4 times the steering gain or 19 degrees of phase."""

LEAST_DISK_MARGIN_WITHOUT_YAW_RATE = 0.34
"""For the rest of a run in which the yaw rate has gone missing: 1.4 times the gain or 19 degrees."""

QUICK_1PS = 10.0
"""Poles that decay faster, within 0.1 s, belong to delay chain and lag and need no damping."""


def pid_gains(law: str, pace: float) -> tuple[float, float, float]:
    """PID gains kp (1/m^2), ki (1/m^3), kd (1/m) whose poles per metre are those of (3, 0.8, 2.7) times the pace.

    With less ki and kd where they are at their greatest, as those of `car` mostly are: its slowest pole is then at
    about KI_OVER_KP_MAX_1PM.

    Up to the pace at which kd comes to its greatest the two poles of the error, with the preview at full speed, fall
    together; a higher one makes the error smaller, and less damped. What pushes the car aside while it points along
    the path, as the slip of the rear tyres does, leaves an error of kd / kp times its angle.
    """
    kp = 3.0 * pace**2
    return kp, min(0.8 * pace**3, KI_OVER_KP_MAX_1PM[law] * kp), min(2.7 * pace, KD_MAX_1PM)


def observer_noise(pace: float) -> tuple[float, float, float]:
    """Process noise (m, rad, 1/m per root metre) of an observer whose poles are about `pace` times the first one's."""
    e, heading, disturbance = DISTURBANCE
    return e * math.sqrt(pace), heading * pace**1.5, disturbance * pace**2.5


def checked_speeds(vehicle: Vehicle) -> tuple[float, ...]:
    """Speeds of the grid that the car can have, without standstill; in the rows beyond, it never is."""
    reached = [speed for speed in SPEED_GRID_MPS[:-1] if speed < vehicle.max_speed_mps]
    return SPEED_GRID_MPS[1 : len(reached) + 1]


# --------------------------------------------------------------------------------------------------------------------
# One row
# --------------------------------------------------------------------------------------------------------------------


@cache
def road_gain(direction: float, speed_mps: float) -> float:
    """Kalman gain of the road disturbance for the gap between yaw rate and steering over a cycle, 1/m for a radian."""
    if speed_mps == 0.0:
        return 0.0
    ds = direction * speed_mps * model.PERIOD_S
    grown = ROAD_WALK_1PM**2 * abs(ds)
    noise = (YAW_RATE_NOISE_RADPS * model.PERIOD_S) ** 2
    # The scalar Riccati equation p = p r / (p ds^2 + r) + q, solved for its positive root.
    variance = 0.5 * grown + math.sqrt(0.25 * grown * grown + grown * noise / (ds * ds))
    return variance * ds / (variance * ds * ds + noise)


def row_of(
    law: str, direction: float, speed_mps: float, pid_pace: float, observer_pace: float, gain_rate_1pm: float
) -> Row:
    """A row of the gain table; a law that takes each pose as it comes estimates nothing, whatever its pace."""
    offset = gain = road = 0.0
    walks = (0.0, 0.0, 0.0)
    if law == "car":
        offset = 1.0 - math.exp(-speed_mps * model.PERIOD_S / OFFSET_LENGTH_M)
        gain = gain_rate_1pm * speed_mps * model.PERIOD_S
        road = road_gain(direction, speed_mps)
        walks = observer_noise(observer_pace)
    numbers = (
        direction,
        speed_mps,
        PREVIEW_S * speed_mps,
        *pid_gains(law, pid_pace),
        offset,
        gain,
        road,
        *walks,
    )
    return Row._make(float(number) for number in numbers)


# --------------------------------------------------------------------------------------------------------------------
# The criteria
# --------------------------------------------------------------------------------------------------------------------


def d_stable(matrix: Floats, speed_mps: float, criteria: Criteria, reserve: float = 1.0) -> bool:
    """Whether all poles of a closed loop's matrix lie in the D-region (`in_region`)."""
    return in_region(model.poles_1pm(matrix, speed_mps), speed_mps, criteria, reserve)


def in_region(poles: Complexes, speed_mps: float, criteria: Criteria, reserve: float = 1.0) -> bool:
    """Whether poles (1/m) lie in the D-region: fast enough per metre of travel, and damped.

    `reserve` is the factor on the least damping.
    """
    if float(poles.real.max()) > criteria.slowest_pole_1pm:
        return False
    slow = poles[poles.real > -QUICK_1PS / speed_mps]
    return bool(np.all(-slow.real >= reserve * criteria.least_damping * np.abs(slow)))


class Demand(NamedTuple):
    """What every car of the box should keep with the gains of a law, in one of its modes."""

    disk_margin: float
    delay_margin_samples: float
    region: Criteria
    damping_reserve: float


def region_of(criteria: Criteria, mode: Mode) -> Criteria:
    """The D-region of a mode: with slow noise damped poles only, as such poses teach a gyro's bias slowly anyway."""
    return criteria.model_copy(update={"slowest_pole_1pm": 0.0}) if mode.localisation == "slow" else criteria


def demand_of(vehicle: Vehicle, law: str, mode: Mode) -> Demand:
    """What a vehicle's file asks of a law's mode, with its reserve."""
    criteria = vehicle.criteria
    reserve = BEND_RESERVE if mode.in_bend else RESERVE
    disk_margin, delay_samples = reserve * criteria.least_disk_margin, reserve * criteria.least_delay_margin_samples
    if law != "car":
        disk_margin, delay_samples = LEAST_DISK_MARGIN_OF_PLAIN, 0.0
    elif not mode.with_yaw_rate:
        disk_margin, delay_samples = LEAST_DISK_MARGIN_WITHOUT_YAW_RATE, 0.0
    return Demand(disk_margin, delay_samples, region_of(criteria, mode), reserve)


# --------------------------------------------------------------------------------------------------------------------
# The choice
# --------------------------------------------------------------------------------------------------------------------


class Schedule(NamedTuple):
    """What was chosen for a law: the observer's pace without the yaw rate, and at each speed the other two.

    They are the PID's pace, and how fast the steering's gain is learnt in a bend.
    """

    observer_pace: float
    pid_pace: tuple[float, ...]
    gain_rate_1pm: tuple[float, ...]


def design_gains(vehicle: Vehicle) -> dict[str, list[tuple[float, ...]]]:
    """Gain tables of every law for a vehicle: rows in the order of `COLUMNS`, directions +1 and -1 over the speed grid.

    Deterministic. Raises UserError where no gains survive the vehicle's box, naming the dimension to narrow.
    """
    for key, longest in (("pose_latency_samples", ODOMETRY_LENGTH - 1), ("command_latency_samples", QUEUE_LENGTH - 2)):
        if round(getattr(vehicle, key)) > longest:
            raise UserError(
                f"vehicle {vehicle.name}: {key} = {getattr(vehicle, key):g}: must be at most {longest}, what the"
                " controller remembers"
            )
    tables: dict[str, list[tuple[float, ...]]] = {}
    for law in LAWS:
        schedule = choose(vehicle, law)
        tables[law] = [
            tuple(row_of(law, direction, speed, pace, schedule.observer_pace, rate_1pm))
            for direction in (1.0, -1.0)
            for speed, pace, rate_1pm in zip(SPEED_GRID_MPS, schedule.pid_pace, schedule.gain_rate_1pm, strict=True)
        ]
    return tables


def choose(vehicle: Vehicle, law: str) -> Schedule:
    """The quickest schedule of a vehicle and law whose cars all survive; UserError where there is none."""
    choice = _Choice(vehicle, law)
    speeds = checked_speeds(vehicle)
    paces = [choice.pace_at(speed) for speed in reversed(speeds)][::-1]  # the fastest refuses first
    observer_pace = choice.observer_pace(dict(zip(speeds, paces, strict=True)))
    rates_1pm = [choice.gain_rate_at(speed, pace, observer_pace) for speed, pace in zip(speeds, paces, strict=True)]
    beyond = len(SPEED_GRID_MPS) - 1 - len(speeds)
    return Schedule(
        observer_pace,
        (paces[0], *paces, *(paces[-1],) * beyond),
        (rates_1pm[0], *rates_1pm, *(rates_1pm[-1],) * beyond),
    )


class _Choice:
    """The cars of a vehicle's box, what a law's modes must keep with each, and the largest values that do.

    The loop in reverse is the same but for the sign of the heading error: one direction tells all.
    """

    def __init__(self, vehicle: Vehicle, law: str) -> None:
        self.vehicle, self.law = vehicle, law
        self.demands = {mode: demand_of(vehicle, law, mode) for mode in MODES[law].values()}
        cars = corners(vehicle, softest_tyres=True)
        self.at = {
            speed: cars_at_speed(cars, speed, 1.0, on_circle(frequencies(speed))) for speed in checked_speeds(vehicle)
        }

    def survive(
        self, modes: Iterable[Mode], speed_mps: float, pace: float, observer_pace: float, rate_1pm: float
    ) -> bool:
        """Whether all cars keep in all these modes what is asked for."""
        row = row_of(self.law, 1.0, speed_mps, pace, observer_pace, rate_1pm)
        return all(_survives(row, self.vehicle, mode, self.at[speed_mps], self.demands[mode]) for mode in modes)

    def pace_at(self, speed_mps: float) -> float:
        """The PID's largest pace in the law's usual mode; UserError where none survives."""

        def survives(pace: float) -> bool:
            return self.survive([MODES[self.law][self.law]], speed_mps, pace, OBSERVER_PACES[0], 0.0)

        pace = _largest(survives, SLOWEST_PACE, FASTEST_PACE[self.law])
        if pace is None:
            raise UserError(_why_not(self.vehicle, self.law, speed_mps))
        return pace

    def observer_pace(self, paces: dict[float, float]) -> float:
        """The first of the observers without the yaw rate that survives with the PID's pace at every speed.

        The slowest where none does.
        """
        modes = [mode for mode in self.demands if not mode.with_yaw_rate]
        for tried in OBSERVER_PACES:
            if all(self.survive(modes, speed_mps, pace, tried, 0.0) for speed_mps, pace in paces.items()):
                return tried
        return OBSERVER_PACES[-1]

    def gain_rate_at(self, speed_mps: float, pace: float, observer_pace: float) -> float:
        """The largest rate at which the steering's gain may be learnt, 1/m; 0 where a bend bears none at all."""
        in_bends = [mode for mode in self.demands if mode.in_bend]
        if not in_bends:
            return 0.0

        def survives(rate_1pm: float) -> bool:
            return self.survive(in_bends, speed_mps, pace, observer_pace, rate_1pm)

        rate_1pm = _largest(survives, 0.0, GAIN_RATE_MAX_1PM)
        return 0.0 if rate_1pm is None else rate_1pm


def _survives(row: Row, vehicle: Vehicle, mode: Mode, at: CarsAtSpeed, demand: Demand) -> bool:
    law = model.controller(row, model.nominal_of(vehicle), mode)
    loops = model.loops(law, at.answers, at.z)
    if float(disk_margin(loops).min()) < demand.disk_margin:
        return False
    matrices = (model.closed_loop(law, plant) for plant in at.plants)
    if not all(d_stable(matrix, row.speed_mps, demand.region, demand.damping_reserve) for matrix in matrices):
        return False
    omega = frequencies(row.speed_mps, len(at.z))
    least_samples = demand.delay_margin_samples
    return least_samples <= 0.0 or all(margins_of(loop, omega).delay_samples >= least_samples for loop in loops)


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


def _why_not(vehicle: Vehicle, law: str, speed_mps: float) -> str:
    """One line that names what keeps the softest gains from surviving: the region itself, or a dimension of the box."""
    mode = MODES[law][law]
    demand = demand_of(vehicle, law, mode)
    row = row_of(law, 1.0, speed_mps, SLOWEST_PACE, OBSERVER_PACES[0], 0.0)
    omega = frequencies(speed_mps)
    system = model.controller(row, model.nominal_of(vehicle), mode)

    def share(car: model.Corner) -> float:
        """The least share that a car keeps of the margins asked for; 0 with poles outside the region."""
        matrix = model.closed_loop(system, model.car(car, speed_mps, 1.0))
        if not d_stable(matrix, speed_mps, demand.region, demand.damping_reserve):
            return 0.0
        found = margins_of(model.loop_response(system, row, [car], on_circle(omega))[0], omega)
        kept = found.disk / demand.disk_margin
        if demand.delay_margin_samples > 0.0:
            kept = min(kept, found.delay_samples / demand.delay_margin_samples)
        return kept

    cars = corners(vehicle, softest_tyres=True)
    at = f"at {speed_mps:g} m/s"
    if share(cars[0]) == 0.0:
        region = (
            f"slowest_pole_1pm = {demand.region.slowest_pole_1pm:g}, least_damping = {demand.region.least_damping:g}"
        )
        return (
            f"vehicle {vehicle.name}: [design] {region}: no gains of law {law} keep the nominal car's poles there {at}"
        )
    worst = min(cars, key=share)
    # The dimension that helps most when it alone is nominal; where none helps enough, when it alone does not delay.
    blamed = _dimension_that_helps(worst, cars[0], share)
    if blamed[0] < 1.0:
        ideal = cars[0]._replace(steering_lag_s=0.0, pose_latency_samples=0, command_latency_samples=0.0)
        blamed = _dimension_that_helps(worst, ideal, share)
    asked = f"the poles in the D-region and a disk margin of {demand.disk_margin:g}"
    if demand.delay_margin_samples > 0.0:
        asked = f"the poles in the D-region, a disk margin of {demand.disk_margin:g} and a delay margin of"
        asked += f" {demand.delay_margin_samples:g} samples"
    keys = blamed[1]
    own, low, high = (
        sum(values) for values in zip(*((getattr(vehicle, key), *vehicle.box[key]) for key in keys), strict=True)
    )
    return (
        f"vehicle {vehicle.name}: {' + '.join(keys)} = {own:g} ({low:g} to {high:g}): no gains of law {law} keep"
        f" {asked} {at} with {worst.name}; narrow low..high, or a quicker car"
    )


def _dimension_that_helps(
    car: model.Corner, home: model.Corner, share: Callable[[model.Corner], float]
) -> tuple[float, tuple[str, ...]]:
    """The largest share that a car keeps with one dimension taken from `home`, and that dimension's keys."""
    trials = {
        ("steering_lag_s",): car._replace(steering_lag_s=home.steering_lag_s),
        ("pose_latency_samples", "command_latency_samples"): car._replace(
            pose_latency_samples=home.pose_latency_samples, command_latency_samples=home.command_latency_samples
        ),
        ("wheelbase_m",): car._replace(wheelbase_m=home.wheelbase_m, cg_to_rear_axle_m=home.cg_to_rear_axle_m),
    }
    shares = {keys: share(trial) for keys, trial in trials.items()}
    best = max(shares, key=lambda keys: shares[keys])
    return shares[best], best
