"""The one procedure by which every controller is tuned: same training runs, same budget, same search.

Search in the logarithms of a controller's numbers within its box: first the hand-set guess and points that fill the box
evenly (Halton), then steps around the best one so far that become shorter and shorter. Nothing in it knows which
controller it tunes. The cost of a candidate is the mean over the training runs of a run's greatest cross-track error
and twice its rms, both of the rear axle's true error; a candidate is dropped as soon as it has cost more than the best.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from tools.compare.runs import CONTROLLERS, RunFigures

VERSION = 1
EVALUATIONS = 40
"""Candidates a controller may try, the guess included, where no other budget is asked for."""

EVEN_SHARE = 0.35
"""Share of them that are the guess and those that fill the box."""

FIRST_STEP, LAST_STEP = 0.2, 0.02
"""Standard deviation of the steps around the best candidate, in shares of the box."""

SCENARIOS = ("car", "car-unknown-lag")
SEEDS = (0, 10)
"""Training runs: each of these seeds in each scenario, far from those of measured runs."""

FAILED_COST_M = 1.0
RMS_WEIGHT = 2.0
PRIMES = (2, 3, 5, 7, 11, 13)

Evaluate = Callable[[tuple[float, ...], str, int], float]
"""(numbers, scenario, seed) -> cost of that run."""


class Tuned(NamedTuple):
    """What the procedure found: numbers by name, their cost in m, and what it took."""

    numbers: dict[str, float]
    cost_m: float
    evaluations: int
    runs: int


def cost_m(figures: RunFigures) -> float:
    """Return the cost of a run: greatest error plus twice the rms over both legs; 1 m for a run that was stopped."""
    if not figures.completed:
        return FAILED_COST_M
    largest = max(leg.max_cross_track_m for leg in figures.legs)
    squares = sum(leg.sum_of_squares_m2 for leg in figures.legs)
    samples = sum(leg.samples for leg in figures.legs)
    return min(largest + RMS_WEIGHT * math.sqrt(squares / max(samples, 1.0)), FAILED_COST_M)


def halton(index: int, base: int) -> float:
    """Return the radical inverse of a positive index, in (0, 1)."""
    value, share = 0.0, 1.0
    while index > 0:
        share /= base
        value += share * (index % base)
        index //= base
    return value


def candidates(
    box: dict[str, tuple[float, float]], guess: tuple[float, ...], budget: int
) -> Iterator[tuple[float, ...]]:
    """Yield as many candidates as the budget allows; the place of the best one so far is sent back after each."""
    rng = random.Random("tuning")
    ends = [(math.log(low), math.log(high)) for low, high in box.values()]
    size = len(ends)
    even = round(EVEN_SHARE * budget)

    def numbers(place: list[float]) -> tuple[float, ...]:
        return tuple(math.exp(low + share * (high - low)) for share, (low, high) in zip(place, ends, strict=True))

    best = [(math.log(value) - low) / (high - low) for value, (low, high) in zip(guess, ends, strict=True)]
    place = best
    for index in range(budget):
        if 0 < index < even:
            place = [halton(index, PRIMES[axis]) for axis in range(size)]
        elif index >= max(even, 1):
            done = (index - even) / max(budget - even - 1, 1)
            step = FIRST_STEP * (LAST_STEP / FIRST_STEP) ** done
            place = [min(max(share + rng.gauss(0.0, step), 0.0), 1.0) for share in best]
        is_best = yield numbers(place)
        if is_best:
            best = place


def tune(name: str, evaluate: Evaluate, budget: int = EVALUATIONS) -> Tuned:
    """Tune one controller for one kind of input, with so many candidates."""
    controller = CONTROLLERS[name]
    training = [(scenario, seed) for seed in SEEDS for scenario in SCENARIOS]
    best, least = controller.guess, math.inf
    search: Any = candidates(controller.box, controller.guess, budget)
    given = next(search)
    evaluations = runs = 0
    while given is not None:
        total = 0.0
        for scenario, seed in training:
            total += evaluate(given, scenario, seed)
            runs += 1
            if total >= least:
                break
        evaluations += 1
        is_best = total < least
        if is_best:
            best, least = given, total
        try:
            given = search.send(is_best)
        except StopIteration:
            given = None
    numbers = {key: float(f"{value:.5g}") for key, value in zip(controller.box, best, strict=True)}
    return Tuned(numbers, least / len(training), evaluations, runs)
