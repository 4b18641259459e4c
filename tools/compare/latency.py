"""How much more latency of the steering command a law bears than it knows of: measured, the same way for all."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

from sim.data_files import Vehicle
from sim.data_files.vehicle import PARAMETERS
from tools.compare.runs import Driver, RunFigures, Setting

SCENARIO = "car"
"""Where it is measured; the latency is added to that scenario's car."""

RUNS = 16
"""Every corner of the car on either side: the lowest four bits of the seed."""

MOST_SAMPLES = 24
TOLERATED_M = 0.05
"""Greatest true cross-track error of a run that still counts as borne; loops that go unstable pass it soon."""


class Borne(NamedTuple):
    """Added samples of 10 ms of command latency that are borne, by (controller, inputs); None: not even 0.

    `most_samples`: the most that was tried; `asked_samples`: what the vehicle file asks of a design.
    """

    samples: dict[tuple[str, str], int | None]
    most_samples: int
    asked_samples: float

    def is_enough(self, controller: str, inputs: str) -> bool:
        """Return whether a controller bears what is asked."""
        samples = self.samples[controller, inputs]
        return samples is not None and samples >= self.asked_samples


def most_samples(vehicle: Vehicle) -> int:
    """Return how many added samples are tried at most.

    No fewer than the vehicle file asks of a design, and no more than the plant has room for.
    """
    wanted = max(MOST_SAMPLES, math.ceil(vehicle.criteria.least_delay_margin_samples))
    room = PARAMETERS["command_latency_samples"].maximum - vehicle.command_latency_samples
    return math.floor(min(wanted, room))


def most_borne(survives: Callable[[int], bool], most: int) -> int | None:
    """Return the greatest number from 0 to `most` that survives, found by bisection; None where not even 0 does.

    The answer is taken to be monotonic, that is, what survives a number survives all smaller ones. Where it is not,
    the result is a number that survives while the next one does not, but perhaps not the greatest.
    """
    borne, lost = -1, most + 1
    while lost - borne > 1:
        tried = (borne + lost) // 2
        if survives(tried):
            borne = tried
        else:
            lost = tried
    return borne if borne >= 0 else None


def with_latency(setting: Setting, added_samples: int) -> Setting:
    """Return the setting with a car whose steering command takes so many samples longer than the tables say."""
    scenario, shared = setting
    samples = shared.vehicle.command_latency_samples + added_samples
    unknown = {**scenario.plant.unknown, "command_latency_samples": (samples, samples)}
    plant = scenario.plant.model_copy(update={"unknown": unknown})
    return Setting(scenario.model_copy(update={"plant": plant}), shared)


def is_borne(run: RunFigures) -> bool:
    """Return whether a run came to its end and stayed near the path on both legs."""
    return run.completed and max(leg.max_cross_track_m for leg in run.legs) <= TOLERATED_M


def borne_samples(
    setting: Setting, law: int, numbers: tuple[float, ...], inputs: str, seeds: Sequence[int]
) -> int | None:
    """Return how many added samples of 10 ms of command latency a law bears in the runs of all seeds.

    None where not even the runs without any are borne. Taken to be monotonic, see `most_borne`.
    """

    def survives(added_samples: int) -> bool:
        driver = Driver(with_latency(setting, added_samples))
        return all(is_borne(driver.run(law, numbers, inputs, seed)) for seed in seeds)

    return most_borne(survives, most_samples(setting.shared.vehicle))
