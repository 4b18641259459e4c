"""The paper's law in the core: against the paper's filters, compiled, and on eq. 11 with and without delay."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest

from firmware_py.core import paper_law
from tools.compiled import compile_modules, core_modules
from tools.paper import firmware_law, fit, sampled_run
from tools.paper.laws import BOTH, DOB, PID, Gains, Law, Observer
from tools.paper.path_study import AS_PRINTED, all_variants
from tools.paper.plant import FORWARD, REVERSE, TABLE_4, Plant
from tools.paper.sampled import KINEMATIC, System, observer_at
from tools.paper.sampled import Path as Delay
from tools.paper.track import Track, track_of

GAINS = Gains(60.0, 10.0, 0.5)
UNBOUNDED = firmware_law.UNBOUNDED
SPEED_MPS = firmware_law.SPEEDS_MPS[20]


@pytest.fixture(scope="module")
def tracks() -> dict[str, Track]:
    path = all_variants(fit.load_fit().waypoints)[AS_PRINTED].path
    return {direction: track_of(path, direction) for direction in (FORWARD, REVERSE)}


def driven(law: str, errors: list[float], direction: int = 0) -> list[float]:
    table = firmware_law.tables_of(TABLE_4, Law(law, GAINS))
    state, angles = paper_law.clear(), []
    for error in errors:
        state, angle = paper_law.step(table, state, UNBOUNDED, direction, SPEED_MPS, error, 0.0)
        angles.append(angle)
    return angles


def filtered(system: System, inputs: list[float]) -> np.ndarray:
    x, outputs = np.zeros(len(system.b)), []
    for value in inputs:
        outputs.append(float(system.c @ x) + system.d * value)
        x = system.a @ x + system.b * value
    return np.array(outputs)


def test_pid_is_the_sum_of_its_parts() -> None:
    rng = random.Random(4)
    errors = [rng.uniform(-1e-3, 1e-3) for _ in range(50)]
    e = np.array(errors)
    slope = np.concatenate([[0.0], np.diff(e) / 0.01])
    wanted = -(60.0 * e + 10.0 * 0.01 * np.cumsum(e) + 0.5 * slope)
    assert driven(PID, errors) == pytest.approx(list(wanted), abs=1e-12)


def test_observer_is_q_over_the_kinematic_zero_order_hold_model() -> None:
    """u = -F y + Q u with the filters that the study discretises by another way."""
    rng = random.Random(5)
    errors = [rng.uniform(-1e-4, 1e-4) for _ in range(200)]
    angles = driven(DOB, errors)
    q, inverse = observer_at(Plant(TABLE_4), Observer(), SPEED_MPS, KINEMATIC)
    wanted = -filtered(inverse, errors) + filtered(q, angles)
    assert angles == pytest.approx(list(wanted), rel=1e-6, abs=1e-9)
    assert max(map(abs, angles)) > 1e-3


def test_rows_are_interpolated_and_held() -> None:
    table = firmware_law.tables_of(TABLE_4, Law(BOTH, GAINS))
    low, high = table.speed_grid_mps[3:5]
    middle = paper_law.row_at(table, 1, 0.5 * (low + high))
    assert middle.preview_m == pytest.approx(0.25 * (low + high))
    assert middle.inverse_gain == pytest.approx(0.5 * (table.row[1][3][4] + table.row[1][4][4]))
    assert paper_law.row_at(table, 0, 9.0) == pytest.approx(table.row[0][-1])
    assert paper_law.row_at(table, 0, 0.0) == pytest.approx(table.row[0][0])


def test_the_integral_is_clamped() -> None:
    """Ten seconds of an error that the wheels cannot take away: the integral's part stays within its authority."""
    angle = driven(PID, [1.0] * 1000)[-1]
    assert angle == pytest.approx(-(60.0 + paper_law.INTEGRAL_AUTHORITY_RAD))


def test_compiled_and_plain_agree_bit_for_bit() -> None:
    step = compile_modules(*core_modules())["firmware_py.core.paper_law"].step
    plain = firmware_law.tables_of(TABLE_4, Law(BOTH, GAINS))
    arrays = plain._replace(speed_grid_mps=np.array(plain.speed_grid_mps), row=np.array(plain.row))  # type: ignore[arg-type]
    rng = random.Random(6)
    ours = theirs = paper_law.clear()
    for _ in range(300):
        direction, speed, error = rng.randrange(2), rng.uniform(0.0, 1.2), rng.uniform(-0.01, 0.01)
        ours, angle = paper_law.step(plain, ours, UNBOUNDED, direction, speed, error, 0.0)
        theirs, compiled = step(arrays, theirs, UNBOUNDED, direction, speed, error, 0.0)
        assert (compiled, tuple(theirs)) == (angle, tuple(ours))


@pytest.mark.parametrize("direction", [FORWARD, REVERSE])
def test_tables_5_and_6_at_100_hz_and_one_sample_later(tracks: dict[str, Track], direction: str) -> None:
    gains = fit.load_fit().gains
    plant, track = Plant(TABLE_4, direction), tracks[direction]
    ideal, bus, late = (firmware_law.run(plant, Law(BOTH, gains), track, where) for where in firmware_law.BUSES)
    assert ideal.max_e_y_m < 0.2e-3
    assert bus.max_e_y_m < 0.25e-3
    assert math.isinf(late.max_e_y_m)
    alone = [firmware_law.run(plant, Law(PID, gains), track, where).max_e_y_m for where in firmware_law.BUSES]
    assert alone == pytest.approx([alone[0]] * 3, rel=2e-3)
    if direction == FORWARD:
        other_way = sampled_run.run(plant, Law(BOTH, gains), track, Delay())
        assert ideal.max_e_y_m == pytest.approx(other_way.max_e_y_m, rel=0.01)
