"""The certificate: against python-control, and against the firmware's own functions driven until they diverge."""

import math
from itertools import pairwise

import numpy as np
import pytest
from design_support import (
    NOMINAL,
    Bend,
    FirmwareLaw,
    StraightRoad,
    corner,
    designed,
    drive,
    known_exactly,
    row_at,
    vehicle_of,
)

from sim.errors import UserError
from tools.design import gains as design
from tools.design import model
from tools.design.certificate import Certificate, certify
from tools.design.margins import frequencies, margins_of, on_circle

SLOW = {"lag": corner(steering_lag_s=0.2, pose_latency_samples=2, steering_gain=1.1), "nominal": corner()}


def of_rows(law, direction, speed_mps):
    """A row and its controller, in the law's usual mode."""
    row = row_at(designed()[law], direction, speed_mps)
    return row, model.controller(row, NOMINAL, design.MODES[law][law])


# Against python-control


@pytest.mark.parametrize("car", list(SLOW))
@pytest.mark.parametrize(
    ("law", "direction", "speed_mps"), [("car", -1.0, 1.0), ("car", 1.0, 0.1), ("pid_ff", 1.0, 0.8)]
)
def test_margins_are_those_of_python_control(law, direction, speed_mps, car):
    import control  # noqa: PLC0415 -- slow to load, and only this test needs it

    row, system = of_rows(law, direction, speed_mps)
    omega = frequencies(speed_mps, 600)
    loop = control.ss(*model.open_loop(system, model.car(SLOW[car], speed_mps, direction)), 0.01)
    own = margins_of(model.loop_response(system, row, [SLOW[car]], on_circle(omega))[0], omega)
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
    row, system = of_rows("car", 1.0, 1.0)
    found = []
    for count in (600, 6000):
        omega = frequencies(1.0, count)
        found.append(margins_of(model.loop_response(system, row, [SLOW["lag"]], on_circle(omega))[0], omega))
    assert found[0] == pytest.approx(found[1], rel=0.02)


# Against the firmware's functions in time


def diverges(row, car, mode):
    """Whether a millimetre off the path grows over 60 m of straight road, under the firmware's own functions."""
    cycles = round(60.0 / row.speed_mps / 0.01)
    law = FirmwareLaw(row, NOMINAL, mode)
    return grow(drive(law, StraightRoad(car, row.speed_mps, row.direction, e_m=1e-3), cycles), cycles)


def grow(errors_m, cycles):
    """Whether errors grow, or were broken off as they had left the believable."""
    if len(errors_m) < cycles:
        return True
    quarter = cycles // 4
    errors = np.abs(errors_m)
    return bool(errors[-quarter:].max() > errors[quarter : 2 * quarter].max())


def first_unstable(test, low, high, steps=5):
    assert not test(low)
    assert test(high)
    for _ in range(steps):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if test(middle) else (middle, high)
    return 0.5 * (low + high)


CASES = [
    (1.0, "car", "car"),
    (1.0, "car", "car, poses with slow noise"),
    (-1.0, "car", "car, without the yaw rate"),
    (-1.0, "pid_ff", "pid_ff"),
]


@pytest.mark.parametrize(("direction", "law", "mode"), CASES)
def test_the_lag_at_which_it_breaks_is_the_one_that_the_model_foretells(direction, law, mode):
    row = row_at(designed()[law], direction, 1.0)
    mode = design.MODES[law][mode]
    system = model.controller(row, NOMINAL, mode)

    def is_unstable(lag_s):
        plant = model.car(corner(steering_lag_s=lag_s), 1.0, direction)
        return not model.is_stable(model.closed_loop(system, plant))

    foretold = first_unstable(is_unstable, 0.1, 4.0, 12)
    simulated = first_unstable(
        lambda lag: diverges(row, corner(steering_lag_s=lag), mode), 0.6 * foretold, 1.6 * foretold
    )
    assert simulated == pytest.approx(foretold, rel=0.2)
    assert foretold > 0.3


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_the_delay_margin_is_the_latency_at_which_it_breaks(direction):
    row, system = of_rows("car", direction, 1.0)
    mode = design.MODES["car"]["car"]
    base = SLOW["lag"]
    omega = frequencies(1.0, 600)
    margin = margins_of(model.loop_response(system, row, [base], on_circle(omega))[0], omega).delay_samples

    def late(samples):
        return base._replace(command_latency_samples=base.command_latency_samples + samples)

    def is_unstable(samples):
        return not model.is_stable(model.closed_loop(system, model.car(late(samples), 1.0, direction)))

    foretold = first_unstable(is_unstable, 0.0, 60.0, 12)
    assert foretold == pytest.approx(margin, rel=0.03)
    simulated = first_unstable(lambda samples: diverges(row, late(samples), mode), 0.5 * margin, 2.0 * margin)
    assert simulated == pytest.approx(margin, rel=0.2)


@pytest.mark.parametrize("times_the_rate", [1.0, 2.0])
def test_in_a_bend_it_breaks_at_less_latency_as_foretold(times_the_rate):
    """With the wheels far from straight the steering's gain is learnt at once, which is an integral about them."""
    row = row_at(designed()["car"], 1.0, 1.0)
    row = row._replace(l_g=times_the_rate * row.l_g)
    nominal = NOMINAL._replace(pose_latency_samples=0)
    car = corner(pose_latency_samples=0, stiffness_front_n_per_rad=3e8, stiffness_rear_n_per_rad=3e8)  # as `Bend`

    def foretold(mode):
        system = model.controller(row, nominal, design.MODES["car"][mode])

        def is_unstable(samples):
            late = car._replace(command_latency_samples=car.command_latency_samples + samples)
            return not model.is_stable(model.closed_loop(system, model.car(late, 1.0, 1.0)))

        return first_unstable(is_unstable, 0.0, 80.0, 12)

    name = "car, poses without noise, in a bend"
    margin = foretold(name)
    cycles = 5000

    def breaks(angle_rad, samples):
        """Whether it does not come to rest; the bound on the learnt gain ends the growth at less than 2 mm."""
        bend = Bend(row, nominal, design.MODES["car"][name], angle_rad, samples, e_m=1e-6)
        errors_m = bend.cross_track_errors_m(cycles)
        return len(errors_m) < cycles or np.abs(errors_m[-cycles // 4 :]).max() > 0.2e-3

    found = first_unstable(
        lambda samples: breaks(nominal.max_road_wheel_angle_rad, samples), 0.8 * margin, 1.2 * margin
    )
    assert found == pytest.approx(margin, rel=0.05)
    assert not breaks(0.05, 1.1 * margin), "next to straight little of a gap is taken for a gain"
    assert foretold("car, poses without noise") > 1.2 * margin


# The certificate


@pytest.fixture(scope="module")
def certificate():
    return certify(vehicle_of(), designed())


def test_the_shipped_cars_are_certified(certificate):
    assert certificate.all_d_stable
    assert certificate.holds
    assert certificate.min_disk_margin >= 0.75
    assert certificate.min_delay_margin_samples >= 15.0
    assert certificate.min_gain_margin >= 5.5
    assert certificate.min_phase_margin_rad >= math.radians(43.0)
    for word in ("direction", "m/s", "lag 0.2 s", "1 samples", "steering gain", "mass 1.3", "stiffness 0.7"):
        assert word in certificate.worst
    without = certificate.others["car, without the yaw rate"]
    assert without["min_disk_margin"] >= 0.34
    assert without["min_delay_margin_samples"] >= 8.0
    for poses in ("without noise", "with slow noise"):
        found = certificate.others[f"car, poses {poses}"]
        assert found["min_disk_margin"] >= 0.6
        assert found["min_delay_margin_samples"] >= 12.0
    for poses in ("poses without noise", "poses with slow noise"):
        straight, in_bend = certificate.others[f"car, {poses}"], certificate.others[f"car, {poses}, in a bend"]
        assert 0.5 <= in_bend["min_disk_margin"] < straight["min_disk_margin"]
        assert 10.0 <= in_bend["min_delay_margin_samples"] < straight["min_delay_margin_samples"]
    assert certificate.others["car, without the yaw rate, in a bend"]["min_disk_margin"] >= 0.34
    assert certificate.lacks == []
    assert certificate.min_disk_margin == min(disk for _, _, disk, _ in certificate.by_speed)


@pytest.mark.parametrize("scenario", ["ideal", "slow-rack"])
def test_overlays_are_certified(scenario):
    found = certify(vehicle_of("paper", scenario), designed("paper", scenario))
    assert found.holds


def changed(direction, speed_mps, **values):
    """The car's gains with one row of one direction changed."""
    table = [
        tuple(model.Row(*row)._replace(**values)) if row[:2] == (direction, speed_mps) else row
        for row in designed()["car"]
    ]
    return {"car": table}


@pytest.mark.parametrize(("direction", "speed_mps"), [(1.0, 0.3), (-1.0, 0.6)])
def test_one_spoilt_row_is_found_and_named(direction, speed_mps):
    found = certify(known_exactly(vehicle_of()), changed(direction, speed_mps, kp=8000.0))
    assert not found.all_d_stable
    # The row itself, or what is blended from it and its neighbour.
    row = design.SPEED_GRID_MPS.index(speed_mps)
    before = 0.5 * (design.SPEED_GRID_MPS[row - 1] + speed_mps)
    assert found.worst.startswith(tuple(f"direction {direction:+.0f}, {v:g} m/s, " for v in (before, speed_mps)))
    assert found[:4] == (0.0, 0.0, 1.0, 0.0), "what is not stable has no margins"
    assert not found.holds
    assert any(line.startswith("car: poles outside the D-region (direction") for line in found.lacks)


def test_forwards_signs_in_reverse_are_found():
    ahead = [row for row in designed()["car"] if row[0] > 0]
    found = certify(known_exactly(vehicle_of()), {"car": ahead + [(-1.0, *row[1:]) for row in ahead]})
    assert not found.all_d_stable
    assert "direction -1" in found.worst


def test_a_car_that_is_known_better_has_larger_margins(certificate):
    known = certify(known_exactly(vehicle_of()), designed())
    assert known.min_disk_margin > 1.2 * certificate.min_disk_margin
    assert "latency 1 + 1 samples" in known.worst or "nominal car" in known.worst


def test_the_vehicles_file_says_what_must_be_kept():
    known = known_exactly(vehicle_of())
    assert certify(known, designed()).holds
    for demand, named in (
        ({"slowest_pole_1pm": -0.5}, "car: poles outside the D-region"),
        ({"least_disk_margin": 1.5}, "car: disk margin"),
        ({"least_delay_margin_samples": 40.0}, "car: delay margin"),
    ):
        found = certify(asking(known, **demand), designed())
        assert not found.holds
        assert any(line.startswith(named) for line in found.lacks), found.lacks


def asking(vehicle, **demand):
    """The vehicle with other criteria."""
    return type(vehicle)(**{**vars(vehicle), "criteria": vehicle.criteria.model_copy(update=demand)})


def test_a_gain_that_is_learnt_too_fast_is_found_in_the_bend_alone():
    table = [tuple(model.Row(*row)._replace(l_g=4.0 * model.Row(*row).l_g)) for row in designed()["car"]]
    known = known_exactly(vehicle_of())
    slower = type(known)(**{**vars(known), "box": {**known.box, "steering_lag_s": (0.2, 0.2)}})
    found = certify(slower, {"car": table})
    assert not found.holds
    assert any(line.startswith("car, poses without noise, in a bend: delay margin") for line in found.lacks)
    assert all("in a bend" in line for line in found.lacks)


def test_a_vehicle_that_asks_for_more_delay_margin_gets_a_design_that_has_it():
    """In a bend by learning the steering's gain more slowly; beyond that by a slower PID."""
    vehicles = {n: asking(vehicle_of("pickup"), least_delay_margin_samples=n) for n in (10.0, 12.0, 15.0)}
    gains = {n: design.design_gains(vehicle) for n, vehicle in vehicles.items()}
    assert certify(vehicles[12.0], gains[12.0]).lacks == []
    rows = {n: row_at(table["car"], 1.0, 1.0) for n, table in gains.items()}
    assert rows[10.0].l_g > 1.5 * rows[12.0].l_g > 0.0
    assert rows[10.0].kp == rows[12.0].kp > rows[15.0].kp


@pytest.mark.parametrize(
    ("demand", "named"),
    [
        (
            {"least_disk_margin": 1.1},
            r"a disk margin of 1\.32 and a delay margin of 12 samples",
        ),
        ({"least_delay_margin_samples": 80.0}, "and a delay margin of 96 samples at"),
        ({"slowest_pole_1pm": -0.9}, r"\[design\] slowest_pole_1pm = -0\.9, least_damping = 0\.1: no gains of law car"),
    ],
)
def test_margins_that_no_gains_have_are_refused_in_one_line(demand, named):
    with pytest.raises(UserError, match=named) as caught:
        design.choose(asking(known_exactly(vehicle_of()), **demand), "car")
    assert "\n" not in str(caught.value)


def test_a_pole_that_hardly_moves_is_stable_but_not_in_the_region():
    lazy = [tuple(model.Row(*row)._replace(kp=0.05, ki=0.001)) for row in designed()["car"]]
    found = certify(known_exactly(vehicle_of()), {"car": lazy})
    assert not found.all_d_stable
    assert found.min_disk_margin > 0.3


def test_middles_between_rows_and_only_speeds_that_the_car_has_are_looked_at():
    certificate = certify(known_exactly(vehicle_of(max_speed_mps=0.3)), {"car": designed()["car"]})
    assert isinstance(certificate, Certificate)
    expected = [
        (direction, speed)
        for direction in (1.0, -1.0)
        for low, high in pairwise(design.SPEED_GRID_MPS)
        if high <= 0.3
        for speed in (0.5 * (low + high), high)
    ]
    assert [row[:2] for row in certificate.by_speed] == expected
