"""What the runs say of the shipped law beside the others: the claims, and whether each holds."""

from __future__ import annotations

import math
import statistics
from typing import NamedTuple

from tools.compare.latency import SCENARIO as LATENCY_SCENARIO
from tools.compare.latency import Borne
from tools.compare.rows import both_of
from tools.compare.runs import ESTIMATOR, RAW, RunFigures

RAW_SHARE = 0.5
"""Greatest share that the shipped law's error in `car` may be of the best other one's on raw inputs."""

Figures = dict[tuple[str, str, str], list[RunFigures]]
"""Runs by (scenario, controller, inputs), in order of their seeds."""


class Verdict(NamedTuple):
    """A claim about the shipped law and what was measured: errors in m of it and of the best other one.

    `mean_difference_m`: its greatest error in a run less the other's, in the mean over the runs, with the standard
    error of that mean; `smaller_in` of `runs` runs its own is the smaller one. All these are None where no other law
    bears the latency that a claim asks for. `bears_itself`: whether the shipped one bears it; None where none is asked.
    """

    claim: str
    car_m: float
    best_other_m: float | None
    best_other: str | None
    holds: bool
    mean_difference_m: float | None
    standard_error_m: float | None
    smaller_in: int | None
    runs: int
    bears_itself: bool | None = None


def verdicts(figures: Figures, borne: Borne | None = None) -> list[Verdict]:
    """Return the claims that these runs allow to judge, by the greatest error over both legs of all runs.

    `borne` is the latency that each law bears, None where it was not measured: then nothing is claimed about it.
    """
    claims = (
        ("car", RAW, RAW_SHARE, "at most half of the best other on raw inputs"),
        ("car", ESTIMATOR, 1.0, "no worse than the best other behind the same estimator"),
        ("car-unknown-lag", RAW, 1.0, "better than every other on raw inputs"),
    )
    judged = []
    for scenario, inputs, share, text in claims:
        runs = _runs_in(figures, scenario, inputs)
        if len(runs) > 1 and "car" in runs:
            judged.append(_judged(f"{scenario}: {text}", runs, share))
    runs = _runs_in(figures, LATENCY_SCENARIO, ESTIMATOR)
    if borne is not None and len(runs) > 1 and "car" in runs:
        claim = (
            f"{LATENCY_SCENARIO}: no worse than the best other that bears {borne.asked_samples:g} samples of latency "
            "more, behind the same estimator"
        )
        bearing = {name: of for name, of in runs.items() if name == "car" or borne.is_enough(name, ESTIMATOR)}
        judged.append(_judged(claim, bearing, 1.0, borne.is_enough("car", ESTIMATOR)))
    return judged


def _runs_in(figures: Figures, scenario: str, inputs: str) -> dict[str, list[RunFigures]]:
    return {name: runs for (where, name, how), runs in figures.items() if (where, how) == (scenario, inputs)}


def _judged(
    claim: str, all_runs: dict[str, list[RunFigures]], share: float, bears_itself: bool | None = None
) -> Verdict:
    """Judge `car`, whose error may be at most this share of the best other's; it holds where there is no other."""
    errors = {name: both_of(runs).max_m for name, runs in all_runs.items()}
    car_m = errors.pop("car")
    count = len(all_runs["car"])
    if not errors:
        return Verdict(claim, car_m, None, None, bears_itself is True, None, None, None, count, bears_itself)
    best = min(errors, key=lambda name: errors[name])
    differences = [
        both_of([own]).max_m - both_of([other]).max_m
        for own, other in zip(all_runs["car"], all_runs[best], strict=True)
    ]
    spread = statistics.stdev(differences) if count > 1 else 0.0
    return Verdict(
        claim,
        car_m,
        errors[best],
        best,
        bears_itself is not False and car_m <= share * errors[best],
        statistics.fmean(differences),
        spread / math.sqrt(count),
        sum(difference < 0.0 for difference in differences),
        count,
        bears_itself,
    )


def line_of(verdict: Verdict) -> str:
    """Return the line that is printed."""
    text = f"{'yes' if verdict.holds else 'NO '}  {verdict.claim}: {1e3 * verdict.car_m:.2f} mm"
    if verdict.best_other_m is None or verdict.mean_difference_m is None or verdict.standard_error_m is None:
        text += "; no other bears it"
    else:
        text += (
            f", {verdict.best_other} {1e3 * verdict.best_other_m:.2f} mm; a run "
            f"{1e3 * verdict.mean_difference_m:+.2f} +- {1e3 * verdict.standard_error_m:.2f} mm, smaller in "
            f"{verdict.smaller_in} of {verdict.runs}"
        )
    return f"{text}; car does not bear it itself" if verdict.bears_itself is False else text
