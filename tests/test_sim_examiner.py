"""The examiner's card, from scripted drives: what passes, and every mistake by itself."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import NamedTuple

import pytest

from sim.data_files import FOLDERS, Course, Side, Vehicle, load_course, load_vehicle
from sim.examiner import Examiner, Verdict

STEP_S = 0.01


class Point(NamedTuple):
    x_m: float
    y_m: float
    yaw_rad: float = 0.0


def between(a: Point, b: Point, share: float) -> Point:
    """On a smooth shift: heading along the way, zero at both ends."""
    dx, dy = b.x_m - a.x_m, b.y_m - a.y_m
    blend = share**3 * (10.0 + share * (6.0 * share - 15.0))
    slope = 30.0 * share**2 * (1.0 - share) ** 2
    yaw = a.yaw_rad + (b.yaw_rad - a.yaw_rad) * share + math.atan2(dy * slope, dx) if dx else a.yaw_rad
    return Point(a.x_m + dx * share, a.y_m + dy * blend, yaw)


class Drive:
    """Moves a car for an examiner: `to` a point, `wait` at standstill."""

    def __init__(self, vehicle: Vehicle, course: Course, side: Side = "left") -> None:
        self.examiner = Examiner(vehicle, course, side)
        self.t_s = 0.0
        start = course.start_pose(vehicle, side)
        self.start = self.at = Point(*start)
        self.stop = Point(*course.stop_pose(vehicle, side))
        self.wait(0.1)

    def see(self, speed: float) -> None:
        self.examiner.observe(self.t_s, *self.at, speed)
        self.t_s += STEP_S

    def wait(self, seconds: float = 0.5) -> Drive:
        for _ in range(round(seconds / STEP_S)):
            self.see(0.0)
        return self

    def to(self, target: Point, count: int = 400) -> Drive:
        begin = self.at
        direction = 1.0 if target.x_m > begin.x_m else -1.0
        forward = direction > 0
        for i in range(1, count + 1):
            share = i / count
            self.at = between(begin, target, share) if forward else between(target, begin, 1.0 - share)
            self.see(direction * 0.8 if i < count else 0.0)
        return self

    def forward(self, ahead: float = 0.0, aside: float = 0.0, turned: float = 0.0) -> Drive:
        x, y, yaw = self.stop
        return self.to(Point(x + ahead, y + aside, yaw + turned))

    def back(self, ahead: float = 0.0, aside: float = 0.0, turned: float = 0.0) -> Drive:
        x, y, yaw = self.start
        return self.to(Point(x + ahead, y + aside, yaw + turned))

    def card(self) -> Verdict:
        return self.examiner.verdict()


def rules(card: Verdict) -> list[str]:
    return [mistake.rule for mistake in card.mistakes]


@pytest.fixture
def small() -> Vehicle:
    """A small car, for which a simple shift has room on the course."""
    return load_vehicle(
        "paper",
        {
            "wheelbase_m": 2.0,
            "cg_to_rear_axle_m": 1.0,
            "front_overhang_m": 0.4,
            "rear_overhang_m": 0.4,
            "body_width_m": 1.0,
            "mirror_width_m": 1.0,
        },
    )


@pytest.fixture
def ohio() -> Course:
    return load_course("ohio")


@pytest.fixture(params=["left", "right"])
def side(request: pytest.FixtureRequest) -> Side:
    chosen: Side = request.param
    return chosen


# ------------------------------------------------------------------------------------------------------- it is right


def test_a_clean_drive_scores_full_on_both_sides(small: Vehicle, ohio: Course, side: Side) -> None:
    card = Drive(small, ohio, side).forward().wait(0.8).back().wait().card()
    assert card.mistakes == ()
    assert (card.passed, card.score, card.full_score, card.pass_score) == (True, 100, 100, 75)
    assert card.completed
    assert (card.stops, card.direction_changes) == (0, 1)
    assert card.cones_touched == card.cones_knocked_down == ()
    assert card.dwell_s == pytest.approx(0.8, abs=0.02)
    assert card.duration_s == pytest.approx(3.99 + 0.8 + 3.99, abs=0.05)
    first, second = card.legs
    assert (first.direction, second.direction) == (1, -1)
    assert first.duration_s == pytest.approx(3.99, abs=0.02)
    assert first.max_speed_mps == 0.8
    for leg in card.legs:
        assert (leg.final_ahead_m, leg.final_aside_m, leg.final_heading_error_rad) == pytest.approx((0, 0, 0), abs=1e-9)
        assert leg.min_clearance_m > 0.2
        assert leg.nearest_cone in {"front-left", "front-right", "point"}
    assert card.min_clearance_m == min(leg.min_clearance_m for leg in card.legs)


def test_final_errors_have_their_signs(small: Vehicle, ohio: Course, side: Side) -> None:
    card = Drive(small, ohio, side).forward(0.03, -0.02, 0.01).wait().back(-0.04, 0.05, -0.02).wait().card()
    first, second = card.legs
    assert (first.final_ahead_m, first.final_aside_m, first.final_heading_error_rad) == pytest.approx(
        (0.03, -0.02, 0.01)
    )
    assert (second.final_ahead_m, second.final_aside_m, second.final_heading_error_rad) == pytest.approx(
        (-0.04, 0.05, -0.02)
    )
    assert card.passed
    assert card.score == 100


def test_a_reversal_without_a_pause_is_a_change_of_direction_all_the_same(small: Vehicle, ohio: Course) -> None:
    drive = Drive(small, ohio).forward()
    card = drive.back().wait().card()
    assert card.direction_changes == 1
    assert card.passed


# ------------------------------------------------------------------------------------------------- one mistake a time


@pytest.mark.parametrize("stops", [1, 2])
@pytest.mark.parametrize("leg", [0, 1])
def test_stopping_on_the_way(small: Vehicle, ohio: Course, leg: int, stops: int) -> None:
    drive = Drive(small, ohio)
    for number in range(2):
        begin, end = (drive.start, drive.stop) if number == 0 else (drive.stop, drive.start)
        if number == leg:
            for i in range(1, stops + 1):
                # Part of the shift, so that the way is the same; `between` of the whole is cut by hand.
                share = i / (stops + 1)
                for j in range(200):
                    local = (i - 1 + j / 200) / (stops + 1)
                    drive.at = between(begin, end, local) if number == 0 else between(end, begin, 1.0 - local)
                    drive.see(0.5 if number == 0 else -0.5)
                drive.at = between(begin, end, share) if number == 0 else between(end, begin, 1.0 - share)
                drive.wait(0.2)
            for j in range(200):
                local = (stops + j / 200) / (stops + 1)
                drive.at = between(begin, end, local) if number == 0 else between(end, begin, 1.0 - local)
                drive.see(0.5 if number == 0 else -0.5)
            drive.at = end
            drive.wait(0.3)
        else:
            drive.to(end).wait(0.3)
    card = drive.card()
    assert rules(card) == ["stop_to_check_progress"] * stops
    assert card.score == 100 - 5 * stops
    assert card.passed
    assert card.stops == stops
    assert [each.stops for each in card.legs] == [stops if number == leg else 0 for number in range(2)]
    assert card.direction_changes == 1


def test_creeping_on_after_the_stop_is_a_stop_too_many(small: Vehicle, ohio: Course) -> None:
    drive = Drive(small, ohio).forward(-0.05).wait()
    drive.to(drive.stop, 10).wait()
    card = drive.back().wait().card()
    assert rules(card) == ["stop_to_check_progress"]
    assert card.legs[0].final_ahead_m == pytest.approx(0.0, abs=1e-9)


def test_another_try_costs_a_stop_for_each_change_of_direction(small: Vehicle, ohio: Course) -> None:
    drive = Drive(small, ohio).forward().wait().back().wait()
    card = drive.forward().wait().back().wait().card()
    assert rules(card) == ["stop_to_check_progress"] * 2
    assert card.direction_changes == 3
    assert card.stops == 2


@pytest.mark.parametrize(("ahead", "text"), [(0.16, "0.160 m too far ahead"), (-0.16, "0.160 m too far back")])
@pytest.mark.parametrize("leg", ["forward stop", "return"])
def test_misjudging_the_distance(small: Vehicle, ohio: Course, leg: str, ahead: float, text: str) -> None:
    errors = (ahead, 0.0) if leg == "forward stop" else (0.0, ahead)
    card = Drive(small, ohio).forward(errors[0]).wait().back(errors[1]).wait().card()
    assert [(m.rule, m.points, m.text) for m in card.mistakes] == [("stop_distance_misjudged", 5, f"{leg}: {text}")]
    assert card.score == 95


@pytest.mark.parametrize("leg", ["forward stop", "return"])
@pytest.mark.parametrize("turned", [0.06, -0.06])
def test_not_parallel(small: Vehicle, ohio: Course, leg: str, turned: float) -> None:
    errors = (turned, 0.0) if leg == "forward stop" else (0.0, turned)
    card = Drive(small, ohio).forward(turned=errors[0]).wait().back(turned=errors[1]).wait().card()
    assert [(m.rule, m.points) for m in card.mistakes] == [("not_parallel", 10)]
    assert card.mistakes[0].text == f"{leg}: turned by {turned:+.4f} rad"
    within = Drive(small, ohio).forward(turned=turned * 0.8).wait().back().wait().card()
    assert within.mistakes == ()


def test_points_add_up_until_it_fails(small: Vehicle, ohio: Course) -> None:
    card = Drive(small, ohio).forward(0.2, 0.0, 0.06).wait().back(0.2, 0.0, 0.06).wait().card()
    assert rules(card) == ["stop_distance_misjudged", "not_parallel"] * 2
    assert card.score == 70
    assert card.completed
    assert not card.passed


def test_the_wrong_side(small: Vehicle, ohio: Course, side: Side) -> None:
    drive = Drive(small, ohio, side)
    drive.stop = drive.stop._replace(y_m=-drive.stop.y_m)
    card = drive.forward().wait().back().wait().card()
    assert rules(card) == ["wrong_side"]
    assert card.mistakes[0].text == f"forward stop: not on the {side}"
    assert not card.passed
    assert card.score == 0


# ------------------------------------------------------------------------------------------------------------- cones


@pytest.mark.parametrize(
    ("offset", "touched", "knocked"),
    [
        (0.27, (), ()),  # 1.3716 - 1.0 - 0.27 = 0.1016 m
        (0.28, ("rear-left", "front-left"), ()),
        (0.37, ("rear-left", "front-left"), ()),
        (0.38, ("rear-left", "front-left"), ("rear-left", "front-left")),
        (-0.28, ("rear-right", "front-right"), ()),
    ],
)
def test_bumped_and_knocked_down_by_the_distance_to_the_axis(
    ohio: Course, offset: float, touched: tuple[str, ...], knocked: tuple[str, ...]
) -> None:
    drive = Drive(load_vehicle("paper"), ohio)
    for x in range(-400, 400):
        drive.at = Point(0.01 * x, offset)
        drive.see(1.0)
    card = drive.card()
    assert card.cones_touched == touched
    assert card.cones_knocked_down == knocked
    assert drive.examiner.cones_touched == len(touched)
    expected = ["cone_knocked_down" if name in knocked else "cone_bumped" for name in touched]
    assert [rule for rule in rules(card) if rule.startswith("cone")] == expected


def test_a_bump_costs_points_once_a_cone_and_knocking_down_fails(small: Vehicle, ohio: Course) -> None:
    point = next(cone for cone in ohio.cones if cone.name == "point")

    def past(distance: float) -> Verdict:
        """A clean drive, and on the way a sample in which the outline is so far from the point cone."""
        drive = Drive(small, ohio).forward().wait()
        home = drive.at
        for _ in range(3):
            drive.at = Point(point.x_m, 0.5 + distance)
            drive.see(-0.5)
        drive.at = home
        return drive.back().wait().card()

    clean, bump, fall = past(0.11), past(0.09), past(-0.01)
    assert clean.mistakes == ()
    assert [(m.rule, m.points, m.fails, m.text) for m in bump.mistakes] == [("cone_bumped", 5, False, "cone point")]
    assert (bump.score, bump.passed, bump.cones_touched) == (95, True, ("point",))
    assert [(m.rule, m.fails) for m in fall.mistakes] == [("cone_knocked_down", True)]
    assert (fall.score, fall.passed, fall.cones_knocked_down) == (0, False, ("point",))
    assert bump.min_clearance_m == pytest.approx(0.09)
    assert bump.nearest_cone == "point"


def test_mirrors_touch_too(ohio: Course) -> None:
    plain = load_vehicle("fusion", {"mirror_width_m": 1.85})
    mirrored = load_vehicle("fusion")
    cards = []
    for vehicle in (plain, mirrored):
        examiner = Examiner(vehicle, ohio, "left")
        for x in range(-700, 200):
            examiner.observe(0.0, 0.01 * x, 0.25, 0.0, 1.0)
        cards.append(examiner.verdict())
    assert cards[0].cones_touched == ()
    assert cards[0].min_clearance_m == pytest.approx(1.3716 - 0.925 - 0.25)
    assert cards[1].cones_touched == ("rear-left", "front-left")
    assert cards[1].min_clearance_m == pytest.approx(1.3716 - 1.06 - 0.25)


# ---------------------------------------------------------------------------------------------------- not to the end


def test_a_car_that_never_moved_has_not_completed(small: Vehicle, ohio: Course) -> None:
    card = Drive(small, ohio).wait().card()
    assert rules(card) == ["not_completed"]
    assert (card.passed, card.completed, card.score, card.legs) == (False, False, 0, ())
    assert (card.duration_s, card.dwell_s, card.direction_changes) == (0.0, 0.0, 0)


def test_half_of_it_is_not_completed(small: Vehicle, ohio: Course) -> None:
    card = Drive(small, ohio).forward().wait().card()
    assert rules(card) == ["not_completed"]
    assert not card.passed


def test_a_car_that_still_moves_has_not_completed_nor_misjudged(small: Vehicle, ohio: Course) -> None:
    drive = Drive(small, ohio).forward().wait()
    drive.at = between(drive.start, drive.stop, 0.6)
    drive.see(-0.8)
    assert rules(drive.card()) == ["not_completed"]


@pytest.mark.parametrize(("first", "second"), [(-1.2, 0.0), (0.0, 1.2)])
def test_stopping_far_from_the_place_is_not_completed(
    small: Vehicle, ohio: Course, first: float, second: float
) -> None:
    card = Drive(small, ohio).forward(first).wait().back(second).wait().card()
    assert "not_completed" in rules(card)
    assert not card.passed


def test_beginning_backwards_is_not_the_test(small: Vehicle, ohio: Course) -> None:
    drive = Drive(small, ohio)
    drive.to(drive.start._replace(x_m=drive.start.x_m - 0.3), 40).wait()
    card = drive.forward().wait().back().wait().card()
    assert not card.passed
    assert "not_completed" in rules(card)


def test_rolling_away_at_the_end_spoils_it(small: Vehicle, ohio: Course) -> None:
    drive = Drive(small, ohio).forward().wait().back().wait()
    assert drive.card().passed
    drive.to(drive.start._replace(x_m=drive.start.x_m - 2.0), 100).wait()
    assert not drive.card().passed


# --------------------------------------------------------------------------------------------------------- the sheet


def test_another_sheet_other_points(small: Vehicle, tmp_path: Path) -> None:
    text = (FOLDERS["course"] / "ohio.toml").read_text()
    path = tmp_path / "strict.toml"
    path.write_text(text.replace("points = 10", "points = 30").replace('name = "ohio"', 'name = "strict"'))
    card = Drive(small, load_course(path)).forward(turned=0.06).wait().back().wait().card()
    assert (card.score, card.passed) == (70, False)


def test_a_rule_that_the_sheet_does_not_have_costs_nothing_but_an_unfinished_test_fails(
    small: Vehicle, tmp_path: Path
) -> None:
    text = (FOLDERS["course"] / "ohio.toml").read_text()
    path = tmp_path / "mild.toml"
    path.write_text(text[: text.index("[[score.mistakes]]")].replace("pass = 75", "pass = 75\nmistakes = []"))
    course = load_course(path)
    card = Drive(small, course).forward(turned=0.06).wait().back().wait().card()
    assert (card.score, card.passed) == (100, True)
    assert rules(card) == ["not_parallel"]
    assert not Drive(small, course).forward().wait().card().passed


def test_the_card_as_json(small: Vehicle, ohio: Course) -> None:
    card = Drive(small, ohio).forward(turned=0.06).wait().back().wait().card()
    read = json.loads(json.dumps(card.as_dict()))
    assert read["passed"] is True
    assert read["legs"][0]["direction"] == 1
    assert read["mistakes"] == [{"rule": "not_parallel", "points": 10, "fails": False, "text": card.mistakes[0].text}]
    assert set(read) == set(card._fields)
