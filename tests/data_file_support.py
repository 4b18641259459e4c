"""What the tests of vehicle, course and scenario files share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from sim.data_files import FOLDERS, load_course, load_scenario, load_vehicle
from sim.errors import UserError

PAPER = FOLDERS["vehicle"] / "paper.toml"
OHIO = FOLDERS["course"] / "ohio.toml"
CAR = FOLDERS["scenario"] / "car.toml"
LOADERS: dict[str, Callable[[str | Path], object]] = {
    "vehicle": load_vehicle,
    "course": load_course,
    "scenario": load_scenario,
}


def one_line(error: pytest.ExceptionInfo[UserError]) -> str:
    text = str(error.value)
    assert "\n" not in text
    return text
