"""The one procedure by which every controller is tuned: same training runs, same budget, same search.

Search in the logarithms of a controller's numbers within its box: first the hand-set guess and points that fill the box
evenly (Halton), then steps around the best one so far that become shorter and shorter. Nothing in it knows which
controller it tunes. The cost of a candidate is the mean over the training runs of a run's greatest cross-track error
and twice its rms, both of the rear axle's true error; a candidate is dropped as soon as it has cost more than the best.
"""

from __future__ import annotations

import ast
import hashlib
import json
import math
import random
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from sim.data_files import Course, Vehicle
from sim.errors import UserError
from tools.compare.runs import CONTROLLERS, RunFigures
from tools.run_folder import write_whole

VERSION = 1
EVALUATIONS = 40
"""Candidates a controller may try, the guess included."""

EVEN = 14
"""Of them, the guess and those that fill the box."""

FIRST_STEP, LAST_STEP = 0.2, 0.02
"""Standard deviation of the steps around the best candidate, in shares of the box."""

SCENARIOS = ("car", "car-unknown-lag")
SEEDS = (0, 5, 10, 15)
"""Training runs: each of these seeds in each scenario, far from those of measured runs."""

FAILED_COST_M = 1.0
RMS_WEIGHT = 2.0
STORED = Path(__file__).resolve().parent / "tunings.json"
SOURCES = ("laws.py", "steered.py", "gains.py", "mpc.py", "procedure.py")
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


def candidates(box: dict[str, tuple[float, float]], guess: tuple[float, ...]) -> Iterator[tuple[float, ...]]:
    """Yield EVALUATIONS candidates; the place of the best one so far is sent back after each."""
    rng = random.Random("tuning")
    ends = [(math.log(low), math.log(high)) for low, high in box.values()]
    size = len(ends)

    def numbers(place: list[float]) -> tuple[float, ...]:
        return tuple(math.exp(low + share * (high - low)) for share, (low, high) in zip(place, ends, strict=True))

    best = [(math.log(value) - low) / (high - low) for value, (low, high) in zip(guess, ends, strict=True)]
    place = best
    for index in range(EVALUATIONS):
        if 0 < index < EVEN:
            place = [halton(index, PRIMES[axis]) for axis in range(size)]
        elif index >= EVEN:
            done = (index - EVEN) / max(EVALUATIONS - EVEN - 1, 1)
            step = FIRST_STEP * (LAST_STEP / FIRST_STEP) ** done
            place = [min(max(share + rng.gauss(0.0, step), 0.0), 1.0) for share in best]
        is_best = yield numbers(place)
        if is_best:
            best = place


def tune(name: str, evaluate: Evaluate) -> Tuned:
    """Tune one controller for one kind of input."""
    controller = CONTROLLERS[name]
    training = [(scenario, seed) for seed in SEEDS for scenario in SCENARIOS]
    best, least = controller.guess, math.inf
    search: Any = candidates(controller.box, controller.guess)
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


# -- the file of tunings ----------------------------------------------------------------------------------------------


def code_digest() -> str:
    """Return a hash of the controllers and the procedure: of what they do, whatever their comments say."""
    digest = hashlib.sha256()
    for name in SOURCES:
        tree = ast.parse(STORED.with_name(name).read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            body = getattr(node, "body", None)
            if isinstance(body, list):
                node.body = [part for part in body if not _is_text(part)]  # type: ignore[attr-defined]
        digest.update(ast.dump(tree).encode())
    return digest.hexdigest()[:24]


def _is_text(part: ast.AST) -> bool:
    return isinstance(part, ast.Expr) and isinstance(part.value, ast.Constant) and isinstance(part.value.value, str)


def digests(vehicle: Vehicle, tables_dir: Path) -> dict[str, str]:
    """Return the hashes of all that a tuning depends on."""
    path = b"".join((tables_dir / name).read_bytes() for name in ("path.csv", "speed.csv"))
    return {
        "controllers": code_digest(),
        "vehicle": f"{vehicle.hash24:06x}",
        "path": hashlib.sha256(path.replace(b"\r\n", b"\n")).hexdigest()[:24],
    }


def text_of(tuned: dict[str, dict[str, Tuned]], vehicle: Vehicle, course: Course, tables_dir: Path) -> str:
    """Return the text of a file of tunings, with what they were made from."""
    content = {
        "about": "tuned numbers of the controllers; GENERATED by `parkctl compare --tune`, do not edit",
        "vehicle": vehicle.name,
        "course": course.name,
        "procedure": {
            "version": VERSION,
            "evaluations": EVALUATIONS,
            "even": EVEN,
            "scenarios": list(SCENARIOS),
            "seeds": list(SEEDS),
            "cost": "mean over the runs of max + 2 rms of the true cross-track error, m",
        },
        "digests": digests(vehicle, tables_dir),
        "tunings": {
            name: {inputs: found._asdict() for inputs, found in by_inputs.items()} for name, by_inputs in tuned.items()
        },
    }
    return json.dumps(content, indent=1) + "\n"


def store(file: Path, tuned: dict[str, dict[str, Tuned]], vehicle: Vehicle, course: Course, tables_dir: Path) -> None:
    """Write a file of tunings, whole or not at all."""
    write_whole(file, text_of(tuned, vehicle, course, tables_dir))


class Stored(NamedTuple):
    """A file of tunings: numbers by (controller, inputs), and what has changed since they were made."""

    numbers: dict[tuple[str, str], tuple[float, ...]]
    stale: list[str]


def load(file: Path, vehicle: Vehicle, course: Course, tables_dir: Path) -> Stored:
    """Read a file of tunings. Raises UserError where it is none, or lacks a number."""
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"--tunings {file}: cannot be read: {error.strerror}; make it with --tune") from None
    except ValueError:
        raise UserError(f"--tunings {file}: is no JSON file; make it with --tune") from None
    numbers: dict[tuple[str, str], tuple[float, ...]] = {}
    for name, controller in CONTROLLERS.items():
        for inputs in controller.inputs if controller.box else ():
            try:
                found = content["tunings"][name][inputs]["numbers"]
                values = tuple(float(found[key]) for key in controller.box)
            except (KeyError, TypeError, ValueError):
                raise UserError(
                    f"--tunings {file}: tunings.{name}.{inputs} is missing or incomplete; make it with --tune"
                ) from None
            if not all(math.isfinite(value) and value > 0.0 for value in values):
                raise UserError(f"--tunings {file}: tunings.{name}.{inputs}: numbers must be positive")
            numbers[name, inputs] = values
    stale = []
    if (content.get("vehicle"), content.get("course")) != (vehicle.name, course.name):
        stale.append(f"made for {content.get('vehicle')} on {content.get('course')}")
    made_from = content.get("digests") or {}
    stale += [f"{what} changed" for what, now in digests(vehicle, tables_dir).items() if made_from.get(what) != now]
    return Stored(numbers, stale)
