"""What the campaign's tests share: the shipped tables, and one compilation for all test processes of a machine."""

from __future__ import annotations

import fcntl
import tempfile
from functools import cache
from pathlib import Path

from sim.data_files import load_course, load_vehicle
from tools.campaign.single import Runner, Shared, share

TABLES = Path(__file__).resolve().parent.parent / "firmware_py" / "tables" / "paper-ohio"


@cache
def shared(law: str = "car") -> Shared:
    return share(load_vehicle("paper"), load_course("ohio"), law, TABLES)


@cache
def compiled_runner() -> Runner:
    """The first process compiles, the others wait and find it done."""
    from sim.data_files import load_scenario  # noqa: PLC0415

    with (Path(tempfile.gettempdir()) / "parkctl-tests-compiling.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        runner = Runner(shared())
        runner.run(load_scenario("ideal"), "left", 1)
    return runner
