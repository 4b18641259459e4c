"""The examiner: watches the true pose and writes the card. Knows course, body and side, nothing of the controller.

What is noted of each sample is a pure function on records (`observe`), so that the same source runs live and compiled;
the card is written from the records (`Examiner.verdict`).
"""

from collections.abc import MutableSequence, Sequence
from math import cos, inf, sin
from typing import Any, NamedTuple

from sim.body import Outline, clearance_m, outline_of
from sim.data_files import Course, Pose, Side, Vehicle


class Leg(NamedTuple):
    """One drive in one direction, from the first movement to standstill before the direction changes.

    Errors are those of the rear-axle centre at the end of the leg against the pose that the course asks for, in that
    pose's frame: `final_ahead_m` positive = too far ahead, `final_aside_m` positive = too far left,
    `final_heading_error_rad` positive = turned to the left. `stops` are the ones before the end.
    """

    direction: int
    start_s: float
    end_s: float
    duration_s: float
    stops: int
    final_ahead_m: float
    final_aside_m: float
    final_heading_error_rad: float
    min_clearance_m: float
    nearest_cone: str
    max_speed_mps: float


class Mistake(NamedTuple):
    """A line of the card: the score sheet's rule, what it costs (points), whether it fails the test, and the facts."""

    rule: str
    points: int
    fails: bool
    text: str


class Verdict(NamedTuple):
    """The card. Cones by name; `stops` are those that the test does not ask for; times in s, distances in m."""

    passed: bool
    score: int
    full_score: int
    pass_score: int
    completed: bool
    cones_touched: tuple[str, ...]
    cones_knocked_down: tuple[str, ...]
    stops: int
    direction_changes: int
    dwell_s: float
    duration_s: float
    min_clearance_m: float
    nearest_cone: str
    legs: tuple[Leg, ...]
    mistakes: tuple[Mistake, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return the card as JSON can hold it."""
        card = self._asdict()
        card["legs"] = [leg._asdict() for leg in self.legs]
        card["mistakes"] = [mistake._asdict() for mistake in self.mistakes]
        return card


# What the examiner has seen lives in two records (mutable rows of numbers: lists here, arrays when compiled).
MAX_LEGS = 16
"""Legs that are told apart; the last one holds all that come after it."""

# Slots of the record of counts, then a few a leg.
LEGS, IS_MOVING, TOUCHED, KNOCKED, NEAREST = range(5)  # touched and knocked: a bit a cone; nearest: -1 before any
LEG_COUNTS = 5
DIRECTION, STOPS, LEG_NEAREST = range(3)
COUNTS_A_LEG = 3
COUNT_SLOTS = LEG_COUNTS + MAX_LEGS * COUNTS_A_LEG

# Slots of the record of values, then a few a leg; times in s, poses in m and rad.
MIN_CLEARANCE_M = 0
LEG_VALUES = 1
START_S, END_S, END_X_M, END_Y_M, END_YAW_RAD, LEG_CLEARANCE_M, MAX_SPEED_MPS = range(7)
VALUES_A_LEG = 7
VALUE_SLOTS = LEG_VALUES + MAX_LEGS * VALUES_A_LEG


class Yardstick(NamedTuple):
    """What the examiner measures by; `cones` are pairs (x, y) in m."""

    outline: Outline
    cones: Sequence[Sequence[float]]
    cone_radius_m: float


class Notes(NamedTuple):
    """Records of what has been seen; see the slots above."""

    number: MutableSequence[int]
    value: MutableSequence[float]


def begin_notes() -> Notes:
    """Return the records before the first sample, as lists."""
    notes = Notes([0] * COUNT_SLOTS, [inf] * VALUE_SLOTS)
    notes.number[NEAREST] = -1
    return notes


def observe(by: Yardstick, notes: Notes, t_s: float, x_m: float, y_m: float, yaw_rad: float, speed_mps: float) -> float:
    """Note one sample of the rear-axle centre's pose and signed speed; returns the clearance in m. Compiles."""
    count = notes.number
    value = notes.value
    clearance, index = clearance_m(by.outline, x_m, y_m, yaw_rad, by.cones)
    if clearance < value[MIN_CLEARANCE_M]:
        value[MIN_CLEARANCE_M] = clearance
        count[NEAREST] = index
    if clearance < by.cone_radius_m:
        _note_touches(by, notes, x_m, y_m, yaw_rad)
    leg = LEG_COUNTS + (count[LEGS] - 1) * COUNTS_A_LEG
    if speed_mps != 0.0:
        direction = 1 if speed_mps > 0.0 else -1
        if count[LEGS] == 0 or count[leg + DIRECTION] != direction:
            _begin_leg(notes, direction, t_s)
        elif count[IS_MOVING] == 0:
            count[leg + STOPS] += 1
        count[IS_MOVING] = 1
    if count[LEGS] > 0:
        leg = LEG_COUNTS + (count[LEGS] - 1) * COUNTS_A_LEG
        row = LEG_VALUES + (count[LEGS] - 1) * VALUES_A_LEG
        if count[IS_MOVING] != 0:
            value[row + END_S] = t_s
            value[row + END_X_M] = x_m
            value[row + END_Y_M] = y_m
            value[row + END_YAW_RAD] = yaw_rad
            value[row + MAX_SPEED_MPS] = max(value[row + MAX_SPEED_MPS], abs(speed_mps))
        if clearance < value[row + LEG_CLEARANCE_M]:
            value[row + LEG_CLEARANCE_M] = clearance
            count[leg + LEG_NEAREST] = index
    if speed_mps == 0.0:
        count[IS_MOVING] = 0
    return clearance


def _begin_leg(notes: Notes, direction: int, t_s: float) -> None:
    count = notes.number
    count[LEGS] = min(count[LEGS] + 1, MAX_LEGS)
    leg = LEG_COUNTS + (count[LEGS] - 1) * COUNTS_A_LEG
    count[leg + DIRECTION] = direction
    count[leg + STOPS] = 0
    count[leg + LEG_NEAREST] = -1
    row = LEG_VALUES + (count[LEGS] - 1) * VALUES_A_LEG
    notes.value[row + START_S] = t_s
    notes.value[row + LEG_CLEARANCE_M] = inf
    notes.value[row + MAX_SPEED_MPS] = 0.0


def _note_touches(by: Yardstick, notes: Notes, x_m: float, y_m: float, yaw_rad: float) -> None:
    for index in range(len(by.cones)):
        distance, _ = clearance_m(by.outline, x_m, y_m, yaw_rad, by.cones[index : index + 1])
        if distance < by.cone_radius_m:
            notes.number[TOUCHED] |= 1 << index
            if distance < 0.0:
                notes.number[KNOCKED] |= 1 << index


class _Run(NamedTuple):
    """A leg as the records hold it."""

    direction: int
    stops: int
    nearest: int
    start_s: float
    end_s: float
    end_pose: Pose
    min_clearance_m: float
    max_speed_mps: float


class Examiner:
    """Feed it every sample of the truth with `observe`, in order of time; ask for the card with `verdict`."""

    def __init__(self, vehicle: Vehicle, course: Course, side: Side) -> None:
        self._course = course
        self._side: Side = side
        self._yardstick = Yardstick(outline_of(vehicle), course.cones_xy(side), course.cone_radius_m)
        self._notes = begin_notes()
        self._names = course.cone_names(side)
        self._start = course.start_pose(vehicle, side)
        self._stop = course.stop_pose(vehicle, side)

    @property
    def cones_touched(self) -> int:
        """Cones touched or knocked down so far."""
        return self._notes.number[TOUCHED].bit_count()

    def observe(self, t_s: float, x_m: float, y_m: float, yaw_rad: float, speed_mps: float) -> float:
        """Take one sample of the rear-axle centre's pose and signed speed; returns the clearance in m."""
        return observe(self._yardstick, self._notes, t_s, x_m, y_m, yaw_rad, speed_mps)

    @property
    def _is_moving(self) -> bool:
        return self._notes.number[IS_MOVING] != 0

    @property
    def _runs(self) -> list[_Run]:
        runs = []
        for index in range(self._notes.number[LEGS]):
            place, row = LEG_COUNTS + index * COUNTS_A_LEG, LEG_VALUES + index * VALUES_A_LEG
            direction, stops, nearest = self._notes.number[place : place + COUNTS_A_LEG]
            start_s, end_s, x, y, yaw, clearance, speed = self._notes.value[row : row + VALUES_A_LEG]
            runs.append(_Run(direction, stops, nearest, start_s, end_s, Pose(x, y, yaw), clearance, speed))
        return runs

    def verdict(self) -> Verdict:
        """Write the card for what has been seen so far."""
        legs = tuple(self._leg(run) for run in self._runs)
        completed = self._is_completed(legs)
        mistakes = self._mistakes(legs, completed)
        lost = sum(mistake.points for mistake in mistakes)
        sheet = self._course.score
        fails = any(mistake.fails for mistake in mistakes) or not completed
        score = 0 if fails else max(0, sheet.full - lost)
        extra_turns = max(0, len(legs) - 2)
        return Verdict(
            passed=not fails and score >= sheet.pass_,
            score=score,
            full_score=sheet.full,
            pass_score=sheet.pass_,
            completed=completed,
            cones_touched=self._cone_names(self._notes.number[TOUCHED]),
            cones_knocked_down=self._cone_names(self._notes.number[KNOCKED]),
            stops=sum(leg.stops for leg in legs) + extra_turns,
            direction_changes=max(0, len(legs) - 1),
            dwell_s=legs[1].start_s - legs[0].end_s if len(legs) > 1 else 0.0,
            duration_s=legs[-1].end_s - legs[0].start_s if legs else 0.0,
            min_clearance_m=self._notes.value[MIN_CLEARANCE_M],
            nearest_cone=self._names[self._notes.number[NEAREST]],
            legs=legs,
            mistakes=mistakes,
        )

    def _cone_names(self, bits: int) -> tuple[str, ...]:
        return tuple(name for index, name in enumerate(self._names) if bits >> index & 1)

    def _target(self, direction: int) -> Pose:
        return self._stop if direction > 0 else self._start

    def _leg(self, run: _Run) -> Leg:
        target = self._target(run.direction)
        dx, dy = run.end_pose.x_m - target.x_m, run.end_pose.y_m - target.y_m
        c, s = cos(target.yaw_rad), sin(target.yaw_rad)
        return Leg(
            direction=run.direction,
            start_s=run.start_s,
            end_s=run.end_s,
            duration_s=run.end_s - run.start_s,
            stops=run.stops,
            final_ahead_m=c * dx + s * dy,
            final_aside_m=c * dy - s * dx,
            final_heading_error_rad=run.end_pose.yaw_rad - target.yaw_rad,
            min_clearance_m=run.min_clearance_m,
            nearest_cone=self._names[run.nearest],
            max_speed_mps=run.max_speed_mps,
        )

    def _is_completed(self, legs: Sequence[Leg]) -> bool:
        if len(legs) < 2 or self._is_moving or legs[0].direction != 1 or legs[-1].direction != -1:
            return False
        most = self._course.tolerances.completed_within_m
        return all(abs(leg.final_ahead_m) <= most for leg in (legs[0], legs[-1]))

    def _mistakes(self, legs: Sequence[Leg], completed: bool) -> tuple[Mistake, ...]:
        tolerances = self._course.tolerances
        knocked_down = self._cone_names(self._notes.number[KNOCKED])
        found = [
            ("cone_knocked_down" if name in knocked_down else "cone_bumped", f"cone {name}")
            for name in self._cone_names(self._notes.number[TOUCHED])
        ]
        for number, leg in enumerate(legs):
            found += [("stop_to_check_progress", f"leg {number + 1}: a stop on the way")] * leg.stops
            if number >= 2:
                found.append(("stop_to_check_progress", f"leg {number + 1}: a change of direction too many"))
        if not completed:
            found.append(("not_completed", "not driven forward to the stop and back to the start"))
        if legs:
            judged = [("forward stop", legs[0])] if legs[0].direction == 1 else []
            judged += [("return", legs[-1])] if len(legs) > 1 and legs[-1].direction == -1 else []
            for what, leg in judged:
                if leg is legs[-1] and self._is_moving:
                    continue
                if abs(leg.final_ahead_m) > tolerances.stop_distance_m:
                    where = "too far ahead" if leg.final_ahead_m > 0.0 else "too far back"
                    found.append(("stop_distance_misjudged", f"{what}: {abs(leg.final_ahead_m):.3f} m {where}"))
                if abs(leg.final_heading_error_rad) > tolerances.parallel_rad:
                    found.append(("not_parallel", f"{what}: turned by {leg.final_heading_error_rad:+.4f} rad"))
            if legs[0].direction == 1 and not self._passed_on_the_right_side():
                found.append(("wrong_side", f"forward stop: not on the {self._side}"))
        return tuple(self._priced(rule, text) for rule, text in found)

    def _passed_on_the_right_side(self) -> bool:
        """Judge a first leg that got past half of the way: it must have left the start's line to the side asked for."""
        end = self._runs[0].end_pose
        if 2.0 * end.x_m < self._start.x_m + self._stop.x_m:
            return True
        return (end.y_m - self._start.y_m) * (self._stop.y_m - self._start.y_m) > 0.0

    def _priced(self, rule: str, text: str) -> Mistake:
        for line in self._course.score.mistakes:
            if line.rule == rule:
                return Mistake(rule, line.points, line.fails, text)
        return Mistake(rule, 0, False, text)
