"""What the comparison's tests share: the shipped tables, and one compilation for all test processes of a machine."""

from __future__ import annotations

import fcntl
import tempfile
from functools import cache
from pathlib import Path

from campaign_support import TABLES, shared

from firmware_py.core.tables import Tables
from sim.data_files import Side, load_course, load_scenario, load_vehicle
from tools.compare import tunings
from tools.compare.runs import CONTROLLERS, Driver, setting_of


def tables(side: Side = "left") -> Tables:
    return shared().tables[side]


@cache
def stored() -> tunings.Stored:
    return tunings.load(tunings.STORED, load_vehicle("paper"), load_course("ohio"), TABLES)


def numbers_of(name: str, inputs: str = "raw") -> tuple[float, ...]:
    return stored().numbers[name, inputs] if CONTROLLERS[name].box else ()


@cache
def driver(scenario: str = "car") -> Driver:
    """The first process compiles, the others wait and find it done."""
    with (Path(tempfile.gettempdir()) / "parkctl-tests-compare.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        made = Driver(setting_of(load_vehicle("paper"), load_course("ohio"), load_scenario(scenario), TABLES))
        made.run(CONTROLLERS["car"].law, (), "raw", 1)
    return made
