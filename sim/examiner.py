"""The examiner: watches the true pose and writes the card. Knows course, body and side, nothing of the controller."""

from collections.abc import Sequence
from math import cos, sin
from typing import Any, NamedTuple

from sim.body import clearance_m, outline_of
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


class _Run:
    """A leg in the making."""

    def __init__(self, direction: int, t_s: float) -> None:
        self.direction = direction
        self.start_s = t_s
        self.end_s = t_s
        self.stops = 0
        self.end_pose = Pose(0.0, 0.0, 0.0)
        self.min_clearance_m = float("inf")
        self.nearest = -1
        self.max_speed_mps = 0.0


class Examiner:
    """Feed it every sample of the truth with `observe`, in order of time; ask for the card with `verdict`."""

    def __init__(self, vehicle: Vehicle, course: Course, side: Side) -> None:
        self._course = course
        self._side: Side = side
        self._outline = outline_of(vehicle)
        self._cones = course.cones_xy(side)
        self._names = course.cone_names(side)
        self._start = course.start_pose(vehicle, side)
        self._stop = course.stop_pose(vehicle, side)
        self._runs: list[_Run] = []
        self._is_moving = False
        self._touched: set[int] = set()
        self._knocked: set[int] = set()
        self._min_clearance_m = float("inf")
        self._nearest = -1

    @property
    def cones_touched(self) -> int:
        """Cones touched or knocked down so far."""
        return len(self._touched)

    def observe(self, t_s: float, x_m: float, y_m: float, yaw_rad: float, speed_mps: float) -> float:
        """Take one sample of the rear-axle centre's pose and signed speed; returns the clearance in m."""
        clearance, index = clearance_m(self._outline, x_m, y_m, yaw_rad, self._cones)
        if clearance < self._min_clearance_m:
            self._min_clearance_m, self._nearest = clearance, index
        if clearance < self._course.cone_radius_m:
            self._note_touches(x_m, y_m, yaw_rad)
        if speed_mps != 0.0:
            direction = 1 if speed_mps > 0.0 else -1
            if not self._runs or self._runs[-1].direction != direction:
                self._runs.append(_Run(direction, t_s))
            elif not self._is_moving:
                self._runs[-1].stops += 1
            self._is_moving = True
        if self._runs:
            run = self._runs[-1]
            if self._is_moving:
                run.end_s, run.end_pose = t_s, Pose(x_m, y_m, yaw_rad)
                run.max_speed_mps = max(run.max_speed_mps, abs(speed_mps))
            if clearance < run.min_clearance_m:
                run.min_clearance_m, run.nearest = clearance, index
        if speed_mps == 0.0:
            self._is_moving = False
        return clearance

    def _note_touches(self, x_m: float, y_m: float, yaw_rad: float) -> None:
        for index, cone in enumerate(self._cones):
            distance, _ = clearance_m(self._outline, x_m, y_m, yaw_rad, (cone,))
            if distance < self._course.cone_radius_m:
                self._touched.add(index)
                if distance < 0.0:
                    self._knocked.add(index)

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
            cones_touched=self._cone_names(self._touched),
            cones_knocked_down=self._cone_names(self._knocked),
            stops=sum(leg.stops for leg in legs) + extra_turns,
            direction_changes=max(0, len(legs) - 1),
            dwell_s=legs[1].start_s - legs[0].end_s if len(legs) > 1 else 0.0,
            duration_s=legs[-1].end_s - legs[0].start_s if legs else 0.0,
            min_clearance_m=self._min_clearance_m,
            nearest_cone=self._names[self._nearest],
            legs=legs,
            mistakes=mistakes,
        )

    def _cone_names(self, indices: set[int]) -> tuple[str, ...]:
        return tuple(self._names[index] for index in sorted(indices))

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
        found: list[tuple[str, str]] = []
        for index in sorted(self._touched):
            rule = "cone_knocked_down" if index in self._knocked else "cone_bumped"
            found.append((rule, f"cone {self._names[index]}"))
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
