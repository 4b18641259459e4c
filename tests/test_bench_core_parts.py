"""What the core takes a shorter way to is bit for bit what the long way gives."""

import random

from core_support import shipped_tables

from firmware_py.core import supervisor
from firmware_py.core.schedule import gains_at


def test_the_row_of_the_schedule_is_found_at_every_grid_speed_and_between():
    table = shipped_tables().gains
    grid = table.speed_grid_mps
    for row in range(table.last_row):
        for share in (0.0, 0.25, 1.0):
            speed_mps = grid[row] + share * (grid[row + 1] - grid[row])
            b = (speed_mps - grid[row]) / (grid[row + 1] - grid[row])
            low, high = table.gain[1][row], table.gain[1][row + 1]
            found = gains_at(table, 1, speed_mps)
            for value, one, other in zip(found, low, high, strict=True):
                assert abs(value - ((1.0 - b) * one + b * other)) <= 1e-12 * max(abs(one), abs(other))


def test_no_transition_is_missed():
    """Against a look at every row of the mode, for all single and random conditions."""

    def at_length(mode, conditions):
        for row, (of_mode, present, absent, *_) in enumerate(supervisor.TRANSITIONS):
            if of_mode == mode and conditions & present == present and conditions & absent == 0:
                return row
        return -1

    rng = random.Random(3)
    some = [0, *(1 << bit for bit in range(45)), *(rng.getrandbits(45) & rng.getrandbits(45) for _ in range(3000))]
    found = {
        (mode, conditions): supervisor.find_transition(mode, conditions) for mode in range(4) for conditions in some
    }
    assert found == {(mode, conditions): at_length(mode, conditions) for mode, conditions in found}
    assert set(found.values()) >= {-1, *range(12)}
