"""The certificate: against python-control, and against the firmware's own functions driven until they diverge."""

import math
from itertools import pairwise

import numpy as np
import pytest
from design_support import FirmwareLaw, StraightRoad, designed, drive, row_at, vehicle_of

from tools.design import gains as design
from tools.design import model
from tools.design.certificate import Certificate, certify, margins_of

NOMINAL = model.Nominal(0.1, 2)
SLOW = {"lag": model.Corner("", 0.2, 3.35, 1.1), "nominal": model.Corner("", 0.1, 2.35, 1.0)}


# Against python-control


@pytest.mark.parametrize("corner", list(SLOW))
@pytest.mark.parametrize(
    ("law", "direction", "speed_mps"), [("car", -1.0, 1.0), ("car", 1.0, 0.1), ("pid_ff", 1.0, 0.8)]
)
def test_margins_are_those_of_python_control(law, direction, speed_mps, corner):
    import control  # noqa: PLC0415 -- slow to load, and only this test needs it

    predicts = law in design.PREDICTING_LAWS
    row = row_at(designed()[law], direction, speed_mps)
    omega = design.frequencies(speed_mps, 600)
    system = model.open_loop(row, NOMINAL, SLOW[corner], predicts)
    loop = control.ss(*system, 0.01)
    own = margins_of(model.loop_response(row, NOMINAL, [SLOW[corner]], design.on_circle(omega), predicts)[0], omega)
    disk, _, _ = control.disk_margins(loop, omega)
    assert own.disk == pytest.approx(disk, rel=1e-3)
    response = control.frd(control.frequency_response(loop, np.geomspace(omega[0], omega[-1], 1200)), smooth=True)
    gain, phase_deg, _, _, crossing, _ = control.stability_margins(response, returnall=True)
    assert own.gain == pytest.approx(min(max(g, 1.0 / g) for g in gain), rel=0.01)
    assert own.phase_rad == pytest.approx(math.radians(np.abs(phase_deg).min()), rel=0.01)
    # The delay's: the lag that is left at each crossing, over its frequency.
    lag_left = np.mod(np.radians(phase_deg), 2.0 * math.pi)
    assert own.delay_samples == pytest.approx((lag_left / crossing).min() / 0.01, rel=0.01)


def test_a_finer_grid_of_frequencies_finds_the_same_margins():
    row = row_at(designed()["car"], 1.0, 1.0)
    found = []
    for count in (600, 6000):
        omega = design.frequencies(1.0, count)
        found.append(margins_of(model.loop_response(row, NOMINAL, [SLOW["lag"]], design.on_circle(omega))[0], omega))
    assert found[0] == pytest.approx(found[1], rel=0.02)


# Against the firmware's functions in time


def diverges(row, corner, predicts=True):
    """Whether a millimetre off the path grows over 30 m of straight road, under the firmware's own functions."""
    cycles = round(30.0 / row.speed_mps / 0.01)
    law = FirmwareLaw(row, NOMINAL, predicts)
    errors = np.abs(drive(law, StraightRoad(corner, row.speed_mps, row.direction, e_m=1e-3), cycles))
    if len(errors) < cycles:
        return True
    quarter = cycles // 4
    return bool(errors[-quarter:].max() > errors[quarter : 2 * quarter].max())


def first_unstable(test, low, high, steps=5):
    assert not test(low)
    assert test(high)
    for _ in range(steps):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if test(middle) else (middle, high)
    return 0.5 * (low + high)


@pytest.mark.parametrize(("direction", "law"), [(1.0, "car"), (-1.0, "car"), (-1.0, "pid_ff")])
def test_the_lag_at_which_it_breaks_is_the_one_that_the_model_foretells(direction, law):
    predicts = law in design.PREDICTING_LAWS
    row = row_at(designed()[law], direction, 1.0)

    def car(lag_s):
        return model.Corner("", lag_s, 2.35, 1.0)

    foretold = first_unstable(
        lambda lag: not model.is_stable(model.closed_loop(row, NOMINAL, car(lag), predicts)), 0.1, 4.0, 12
    )
    simulated = first_unstable(lambda lag: diverges(row, car(lag), predicts), 0.6 * foretold, 1.6 * foretold)
    assert simulated == pytest.approx(foretold, rel=0.2)
    assert foretold > 0.3


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_the_delay_margin_is_the_latency_at_which_it_breaks(direction):
    row = row_at(designed()["car"], direction, 1.0)
    base = SLOW["lag"]
    omega = design.frequencies(1.0, 600)
    margin = margins_of(model.loop_response(row, NOMINAL, [base], design.on_circle(omega))[0], omega).delay_samples

    def late(samples):
        return base._replace(latency_samples=base.latency_samples + samples)

    foretold = first_unstable(
        lambda samples: not model.is_stable(model.closed_loop(row, NOMINAL, late(samples))), 0.0, 60.0, 12
    )
    assert foretold == pytest.approx(margin, rel=0.03)
    simulated = first_unstable(lambda samples: diverges(row, late(samples)), 0.5 * margin, 2.0 * margin)
    assert simulated == pytest.approx(margin, rel=0.2)


# The certificate


@pytest.fixture(scope="module")
def certificate():
    return certify(vehicle_of(), designed())


def test_the_shipped_cars_are_certified(certificate):
    assert certificate.all_d_stable
    assert certificate.min_disk_margin >= 0.33
    assert certificate.min_delay_margin_samples >= 8.0
    assert certificate.min_gain_margin >= 2.0
    assert certificate.min_phase_margin_rad >= math.radians(19.0)
    for word in ("law car", "direction", "m/s", "lag 0.2 s", "latency 3 samples", "steering gain 1.1"):
        assert word in certificate.worst


@pytest.mark.parametrize("scenario", ["ideal", "slow-rack"])
def test_overlays_are_certified(scenario):
    found = certify(vehicle_of("paper", scenario), designed("paper", scenario))
    assert found.all_d_stable
    assert found.min_disk_margin >= 0.32
    assert found.min_delay_margin_samples > 5.0


def changed(direction, speed_mps, **values):
    """The car's gains with one row of one direction changed."""
    table = [
        tuple(model.Row(*row)._replace(**values)) if row[:2] == (direction, speed_mps) else row
        for row in designed()["car"]
    ]
    return {"car": table}


@pytest.mark.parametrize(("direction", "speed_mps"), [(1.0, 0.3), (-1.0, 0.6)])
def test_one_spoilt_row_is_found_and_named(direction, speed_mps):
    found = certify(vehicle_of(), changed(direction, speed_mps, kp=2000.0))
    assert not found.all_d_stable
    # The row itself, or what is blended from it and its neighbour.
    row = design.SPEED_GRID_MPS.index(speed_mps)
    before = 0.5 * (design.SPEED_GRID_MPS[row - 1] + speed_mps)
    assert found.worst.startswith(
        tuple(f"law car, direction {direction:+.0f}, {v:g} m/s, " for v in (before, speed_mps))
    )
    assert found[:4] == (0.0, 0.0, 1.0, 0.0), "what is not stable has no margins"


def test_forwards_signs_in_reverse_are_found():
    ahead = [row for row in designed()["car"] if row[0] > 0]
    found = certify(vehicle_of(), {"car": ahead + [(-1.0, *row[1:]) for row in ahead]})
    assert not found.all_d_stable
    assert "direction -1" in found.worst


def test_a_car_that_is_known_better_has_larger_margins(certificate):
    vehicle = vehicle_of()
    points = {key: (getattr(vehicle, key),) * 2 for key in vehicle.box}
    known = certify(type(vehicle)(**{**vars(vehicle), "box": points}), designed())
    assert known.min_disk_margin > 1.3 * certificate.min_disk_margin
    assert "latency 2 samples" in known.worst


def test_a_pole_that_hardly_moves_is_stable_but_not_in_the_region():
    lazy = [tuple(model.Row(*row)._replace(kp=0.05, ki=0.001)) for row in designed()["car"]]
    found = certify(vehicle_of(), {"car": lazy})
    assert not found.all_d_stable
    assert found.min_disk_margin > 0.3


def test_middles_between_rows_and_only_speeds_that_the_car_has_are_looked_at(monkeypatch):
    seen = []
    response = model.loop_response

    def listen(row, *rest):
        seen.append((row.direction, row.speed_mps))
        return response(row, *rest)

    monkeypatch.setattr(model, "loop_response", listen)
    certificate = certify(vehicle_of(max_speed_mps=0.3), {"car": designed()["car"]})
    assert isinstance(certificate, Certificate)
    expected = [
        (direction, speed)
        for direction in (1.0, -1.0)
        for low, high in pairwise(design.SPEED_GRID_MPS)
        if high <= 0.3
        for speed in (0.5 * (low + high), high)
    ]
    assert seen == expected
