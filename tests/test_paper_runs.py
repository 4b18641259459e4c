"""The paper's simulations: accuracy, the stored fit, what must hold of Tables 5 and 6, and what breaks them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sim.data_files import load_course, load_vehicle
from sim.errors import UserError
from tools.paper import fit, laws, path_study, rates, sampled_run, study, tables
from tools.paper.laws import BOTH, DOB, LAWS, PID, Law, close_loop
from tools.paper.path_study import AS_PRINTED, CORRECTED, PathResult
from tools.paper.plant import CORRECTED as CORRECTED_SIGN
from tools.paper.plant import FORWARD, REVERSE, TABLE_4, Plant
from tools.paper.printed import TABLES_5_6
from tools.paper.sampled import Path as Delay
from tools.paper.simulate import Figures, Start, Steps, figures_of, simulate
from tools.paper.speed import TABLE_3, motion, speed_squared
from tools.paper.track import Track, curvature_at, project, track_of


@pytest.fixture(scope="module")
def stored() -> fit.StoredFit:
    return fit.load_fit()


@pytest.fixture(scope="module")
def paths(stored: fit.StoredFit) -> dict[str, PathResult]:
    return path_study.all_variants(stored.waypoints)


def run(paths: dict[str, PathResult], stored: fit.StoredFit, plant: Plant, law: str, step_s: float = 2e-3) -> Figures:
    track = track_of(paths[AS_PRINTED].path, plant.direction)
    plan = motion(track.station_m, track.curvature_1pm, TABLE_3, step_s)
    return figures_of(simulate(Steps(plant, Law(law, stored.gains), step_s), track, plan))


def test_exact_steps_agree_with_an_implicit_integrator(paths: dict[str, PathResult], stored: fit.StoredFit) -> None:
    track = track_of(paths[AS_PRINTED].path, FORWARD)
    law = Law(BOTH, stored.gains)
    plan = motion(track.station_m, track.curvature_1pm, TABLE_3, 1e-3)
    steps = Steps(Plant(TABLE_4), law, 1e-3)
    ours = simulate(steps, track, plan)
    # The ramp with its changing speed, and the begin of the turn.
    seconds = 7.0

    def rate(t: float, x: np.ndarray) -> np.ndarray:
        v = float(np.interp(t, plan.time_s, plan.speed_mps))
        loop = close_loop(steps.plant, law, v)
        return np.asarray(
            loop.a @ x + loop.e * float(curvature_at(track, np.array([np.interp(t, plan.time_s, plan.station_m)]))[0])
        )

    times = np.arange(1.0, seconds, 0.5)
    answer = solve_ivp(
        rate, (0.0, seconds), np.zeros(laws.STATES), method="Radau", t_eval=times, rtol=1e-6, atol=1e-10, max_step=0.2
    )
    mine = ours.state[np.round(times / 1e-3).astype(int), laws.ERROR]
    assert np.max(np.abs(answer.y[laws.ERROR])) > 5e-5
    assert mine == pytest.approx(answer.y[laws.ERROR], abs=3e-7)


def test_figures_do_not_depend_on_the_step(paths: dict[str, PathResult], stored: fit.StoredFit) -> None:
    coarse, fine = (run(paths, stored, Plant(TABLE_4), BOTH, step) for step in (4e-3, 1e-3))
    for field in ("max_e_y_m", "rms_e_y_m", "max_steer_rad", "max_cross_track_m"):
        assert getattr(coarse, field) == pytest.approx(getattr(fine, field), rel=2e-3)


@pytest.mark.parametrize("direction", [FORWARD, REVERSE])
def test_the_stored_fit_meets_the_printed_cells(
    paths: dict[str, PathResult], stored: fit.StoredFit, direction: str
) -> None:
    found = {law: run(paths, stored, Plant(TABLE_4, direction), law) for law in (DOB, PID, BOTH)}
    for law, within in ((DOB, 0.20), (PID, 0.20), (BOTH, 0.35)):
        for field in tables.JUDGED:
            ratio = getattr(found[law], field) / getattr(TABLES_5_6[direction][law], field)
            assert ratio == pytest.approx(1.0, abs=within), (law, field)
    assert found[DOB].max_steer_rate_radps == pytest.approx(TABLES_5_6[direction][DOB].max_steer_rate_radps, rel=0.20)
    assert min(found[DOB].max_e_y_m, found[PID].max_e_y_m) >= 40.0 * found[BOTH].max_e_y_m
    assert found[BOTH].max_cross_track_m > 0.07


def test_the_stored_fit_is_where_its_own_search_ends(stored: fit.StoredFit) -> None:
    """The cost at the stored numbers is the recorded one, and every step away from them costs more."""
    cells = fit.Cells(Law(DOB, laws.Gains(0.0, 0.0, 0.0)))
    w = stored.waypoints
    best = np.array([w.x_m[2], w.x_m[3], w.x_m[4], w.y_m[3]]) / path_study.FOOT_M

    def cost(numbers: np.ndarray) -> float:
        return 0.5 * float(np.sum(fit.waypoint_residuals(numbers, cells) ** 2))

    assert fit.waypoints_of(best).x_m == pytest.approx(w.x_m, abs=1e-6)
    assert cost(best) == pytest.approx(float(stored.provenance["waypoint_cost"]), rel=0.02)
    for index, step in ((0, 0.3), (1, 0.3), (2, 0.3), (3, 0.1)):
        for sign in (-1.0, 1.0):
            moved = best.copy()
            moved[index] += sign * step
            assert cost(moved) > cost(best)


def test_path_constraints(paths: dict[str, PathResult]) -> None:
    for result in paths.values():
        assert result.fit.constraint_residual <= 1e-10
        assert result.curvature_jump_1pm <= 1e-9
        assert result.slope_jump_1pm2 <= 1e-9
    printed, fixed = paths[AS_PRINTED].figures(), paths[CORRECTED].figures()
    assert abs(printed["start_curvature_1pm"]) > 0.05
    assert abs(fixed["start_curvature_1pm"]) < 1e-9
    assert (fixed["stop_x_m"], fixed["stop_y_m"]) == pytest.approx((15.24, 1.3716), abs=1e-9)


def test_sweep_tells_where_there_is_no_path(stored: fit.StoredFit) -> None:
    found = {(c.m, c.p, c.q): c for c in path_study.sweep(stored.waypoints, path_study.VARIANTS[0])}
    assert found[(4, 6, 2)].slope_jump_1pm2 > 1e-3
    assert found[(4, 6, 3)].slope_jump_1pm2 < 1e-9
    w = stored.waypoints
    dense = path_study.interpolate(w)
    with pytest.raises(UserError, match="p = 3"):
        path_study.fitted(dense, w, path_study.VARIANTS[-1], p=3, q=3)


def test_reverse_is_flipped_and_inverted(paths: dict[str, PathResult]) -> None:
    path = paths[AS_PRINTED].path
    there, back = track_of(path, FORWARD), track_of(path, REVERSE)
    assert np.array_equal(back.curvature_1pm, -there.curvature_1pm[::-1])
    # Against the geometry itself: heading turned by pi must change by the curvature along the way back.
    turned = np.gradient(back.yaw_rad, back.station_m)[5:-5]
    assert turned == pytest.approx(back.curvature_1pm[5:-5], abs=2e-4)


def test_projection() -> None:
    angle = np.linspace(0.0, 2.0, 401)
    circle = Track(5.0 * angle, 5.0 * np.sin(angle), 5.0 - 5.0 * np.cos(angle), angle, np.full(401, 0.2), np.zeros(401))
    found = project(circle, 4.0 * np.sin(angle), 5.0 - 4.0 * np.cos(angle), 5.0 * angle + 0.2)
    assert found.cross_track_error_m[1:-1] == pytest.approx(1.0, abs=1e-4)
    beyond = project(circle, np.array([-1.0]), np.array([0.5]), np.array([0.0]))
    assert (beyond.station_m[0], beyond.cross_track_error_m[0]) == pytest.approx((-1.0, 0.5))


def test_speed_keeps_table_3(paths: dict[str, PathResult]) -> None:
    track = track_of(paths[AS_PRINTED].path, FORWARD)
    plan = motion(track.station_m, track.curvature_1pm, TABLE_3, 1e-3)
    accel = np.diff(plan.speed_mps) / 1e-3
    assert np.max(np.abs(accel)) <= 0.05 * 9.80665 * (1 + 1e-6)
    assert (plan.speed_mps[0], plan.speed_mps.max()) == (0.1, 1.0)
    assert plan.station_m[-1] == pytest.approx(track.length_m, abs=2e-4)
    tight = speed_squared(track.station_m, 100.0 * np.minimum(np.abs(track.curvature_1pm), 0.2) / 40.0, TABLE_3)
    assert tight.max() < 1.0 + 1e-12
    with pytest.raises(UserError, match="turn too sharply"):
        speed_squared(track.station_m, 1e3 * track.curvature_1pm, TABLE_3)


def test_corrected_sign_leaves_its_room_and_the_rear_axle_law_does_not(
    paths: dict[str, PathResult], stored: fit.StoredFit
) -> None:
    vehicle, course = load_vehicle("paper"), load_course("paper")
    track = track_of(paths[AS_PRINTED].path, REVERSE)
    plan = motion(track.station_m, track.curvature_1pm, TABLE_3, 2e-3)
    room = study.box_half_width_m(course) - 1.0
    for law in (DOB, BOTH):
        result = study.drive(
            vehicle, course, Plant(TABLE_4, REVERSE, CORRECTED_SIGN), Law(law, stored.gains), track, plan
        )
        leaving = study.leaving_of(result, room, course)
        assert leaving.room_m is not None
        assert 2.0 < leaving.room_m < 10.0
        before = result.run.travelled_m < leaving.room_m
        assert np.max(np.abs(result.run.preview_error_m[before])) < 0.02, "e_y shows nothing of it"
    good = study.drive(vehicle, course, Plant(TABLE_4, REVERSE), Law(DOB, stored.gains), track, plan)
    assert study.leaving_of(good, room, course).room_m is None
    rear = study.rear_axle.rear_axle_path(vehicle, course)
    way = track_of(rear, REVERSE)
    driven = study.rear_axle.drive(
        Plant(TABLE_4, REVERSE, CORRECTED_SIGN), way, motion(way.station_m, way.curvature_1pm, TABLE_3, 2e-3)
    )
    assert np.max(np.abs(driven.cross_track_error_m)) <= 1e-3
    with_wrong_plant = study.rear_axle.drive(
        Plant(TABLE_4, REVERSE)._replace(preview_time_s=0.5),
        way,
        motion(way.station_m, way.curvature_1pm, TABLE_3, 2e-3),
    )
    assert np.max(np.abs(with_wrong_plant.cross_track_error_m)) > 1e-3, "the printed sign is another plant"


def test_the_kick_is_the_derivatives_step_over_the_sampling_step(
    paths: dict[str, PathResult], stored: fit.StoredFit
) -> None:
    track = track_of(paths[AS_PRINTED].path, FORWARD)
    step = abs(stored.gains.kd * 0.5 * 0.1 * 0.1 * track.curvature_1pm[0])
    for step_s in (5e-5, 2e-4):
        kick = rates.kick_radps(TABLE_4, FORWARD, Law(PID, stored.gains), track, step_s)
        assert kick == pytest.approx(step / step_s, rel=0.05)
    pinned = track_of(paths[CORRECTED].path, FORWARD)
    assert rates.kick_radps(TABLE_4, FORWARD, Law(PID, stored.gains), pinned, 5e-5) < 0.05
    without = rates.kick_radps(TABLE_4, FORWARD, Law(DOB, stored.gains), track, 5e-5)
    assert without == pytest.approx(rates.kick_radps(TABLE_4, FORWARD, Law(DOB, stored.gains), track, 2e-4), rel=0.05)


def test_start_beside_the_path(paths: dict[str, PathResult]) -> None:
    track = track_of(paths[CORRECTED].path, FORWARD)
    assert rates.start_at(track, (0.0, 0.002, 0.01), 0.05) == pytest.approx(Start(0.01, 0.0025))


def test_one_sample_of_delay_breaks_the_papers_bandwidth(paths: dict[str, PathResult], stored: fit.StoredFit) -> None:
    track = track_of(paths[AS_PRINTED].path, FORWARD)
    law = Law(BOTH, stored.gains)
    assert sampled_run.run(Plant(TABLE_4), law, track, Delay()).max_e_y_m < 0.25e-3
    late = sampled_run.run(Plant(TABLE_4), law, track, Delay(1))
    assert late.max_e_y_m == np.inf
    assert late.time_s[-1] < 10.0


def test_cells_are_empty_for_another_car_and_the_corrected_sign() -> None:
    class Another:
        car = TABLE_4._replace(mass_kg=2000.0)

    class Own:
        car = TABLE_4._replace(name="a copy by another name")

    assert tables.printed_cells(study.TABLE_5, DOB, Another()) is None  # type: ignore[arg-type]
    assert tables.printed_cells(study.TABLE_6_CORRECTED, DOB, Own()) is None  # type: ignore[arg-type]
    assert tables.printed_cells(study.TABLE_5, LAWS[-1], Own()) is None  # type: ignore[arg-type]
    assert tables.printed_cells(study.TABLE_6, BOTH, Own()) == TABLES_5_6[REVERSE][BOTH]  # type: ignore[arg-type]
