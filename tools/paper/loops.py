"""The loop studied apart from the path: margins over the speed, sampling at 100 Hz, the parameter space of the PID."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from sim.errors import UserError
from tools.design.parameter_space import (
    AdmissibleRegion,
    DRegion,
    Point,
    Window,
    admissible_region,
    case_of,
    plane_of,
)
from tools.design.parameter_space.explorer import Units, explorer_page
from tools.design.waypoints import Floats
from tools.paper import sampled_run
from tools.paper.frequency import Margins, margins_over_speed
from tools.paper.laws import BOTH, DOB, PID, Gains, Law
from tools.paper.plant import (
    CORRECTED,
    FORWARD,
    PREVIEW_TIME_S,
    PRINTED,
    REVERSE,
    PaperCar,
    Plant,
    transfer_function,
    zeros_and_poles,
)
from tools.paper.sampled import METHODS, Path, highest_stable_bandwidth
from tools.paper.sampled_run import SampledRun
from tools.paper.track import Track

SPEEDS_MPS = np.geomspace(0.1, 1.0, 25)
SAMPLING_PATHS = (Path(0), Path(1), Path(2), Path(0, 0.02), Path(2, 0.1))
SHIFT_OF_ZERO, DAMPING = 0.5, 0.7
"""The D-stability region, which the paper draws without numbers: shift in parts of the slow zero, and damping ratio."""
EXPLORER_SPEEDS_MPS = (0.1, 0.2, 0.3, 0.5, 0.7, 1.0)
EXPLORER_CELLS = 51
FIXED_SHIFT_RADPS = 0.13
"""A shift that is feasible at 1 m/s; the paper's Figure 11 has one for all speeds."""


class RegionCase(NamedTuple):
    """One admissible region: plant, speed, the region, the least gains, and the fitted gains with distances."""

    plant: Plant
    speed_mps: float
    region: DRegion
    found: AdmissibleRegion
    least: Point
    wide: AdmissibleRegion
    fitted: Point


class Loops(NamedTuple):
    """Results: margins [law] over `speeds_mps`; stable bandwidths rad/s [law][path][method]; runs at 100 Hz; regions.

    refusals: regions that have no admissible gains, and the one line that says why. explorer: a page of its own.
    """

    speeds_mps: Floats
    margins: dict[str, list[Margins]]
    bandwidths: dict[str, dict[Path, dict[str, float]]]
    sampled: list[SampledRun]
    regions: dict[str, RegionCase]
    refusals: dict[str, str]
    explorer: str


def slow_zero_radps(plant: Plant, speed_mps: float) -> float:
    """Distance of the slow zero from the origin."""
    return abs(zeros_and_poles(plant, speed_mps).zeros[0])


def region_case(plant: Plant, speed_mps: float, gains: Gains) -> RegionCase:
    """Admissible (kp, ki) at the fitted kd, near the origin and out to the fitted gains."""
    region = DRegion(sigma_radps=SHIFT_OF_ZERO * slow_zero_radps(plant, speed_mps), zeta=DAMPING)
    plane = plane_of("kp-ki", third=gains.kd)
    case = case_of(plant.name, transfer_function(plant, speed_mps), plane, region)
    wide = admissible_region([case], plane, Window(0.0, 1.25 * gains.kp, 0.0, 2.0 * gains.ki))
    near = admissible_region([case], plane, Window(0.0, 0.16 * gains.kp, 0.0, 0.3 * gains.ki))
    return RegionCase(plant, speed_mps, region, near, near.choose("smallest"), wide, wide.point(gains.kp, gains.ki))


def explorer(car: PaperCar, gains: Gains) -> str:
    """The page in which a reader steps through speeds and regions: forward, the car's mass at +-30 % too."""
    arm_m = car.rear_m + PREVIEW_TIME_S * EXPLORER_SPEEDS_MPS[-1]

    def plant_at(speed_mps: float, mass_kg: float = car.mass_kg) -> Any:
        return transfer_function(Plant(car._replace(mass_kg=mass_kg)), speed_mps)

    return explorer_page(
        f"Admissible gains of eq. 19: {car.name}, forward",
        plant_at,
        EXPLORER_SPEEDS_MPS,
        [plane_of("kp-ki", third=gains.kd), plane_of("kp-kd", third=gains.ki)],
        DRegion(sigma_radps=SHIFT_OF_ZERO / arm_m, zeta=DAMPING),
        sigma_per_metre=True,
        windows={
            "kp-ki": Window(0.0, 1.25 * gains.kp, 0.0, 2.0 * gains.ki),
            "kp-kd": Window(0.0, 1.25 * gains.kp, 0.0, 40.0 * gains.kd),
        },
        points={"kp-ki": (gains.kp, gains.ki), "kp-kd": (gains.kp, gains.kd)},
        box={"mass_kg": (0.7 * car.mass_kg, 1.3 * car.mass_kg)},
        cells=EXPLORER_CELLS,
        units=Units("rad", "m"),
        intro="Plant: eq. 11 from steering angle to the error at the preview point, its mass between -30 % and +30 %. "
        "The point shown is the one fitted to Table 5; drag it.",
    )


def study(car: PaperCar, gains: Gains, track: Track, tell: Callable[[str], None]) -> Loops:
    """Compute all of it."""
    forward = Plant(car, FORWARD, PRINTED)
    laws = {name: Law(name, gains) for name in (DOB, PID, BOTH)}
    tell("margins over the speed")
    margins = {name: margins_over_speed(forward, law, SPEEDS_MPS) for name, law in laws.items()}
    tell("parameter space: Figures 11 to 13")
    regions, refusals = {}, {}
    for name, plant, speed in (
        ("figure 12", forward, 0.1),
        ("figure 13", Plant(car, REVERSE, PRINTED), 1.0),
        ("forward at 1 m/s", forward, 1.0),
        ("reverse at 1 m/s, corrected sign", Plant(car, REVERSE, CORRECTED), 1.0),
    ):
        try:
            regions[name] = region_case(plant, speed, gains)
        except UserError as error:
            refusals[name] = str(error)
    plane = plane_of("kp-ki", third=gains.kd)
    try:
        fixed = DRegion(sigma_radps=FIXED_SHIFT_RADPS, zeta=DAMPING)
        admissible_region([case_of("forward", transfer_function(forward, 0.1), plane, fixed)], plane)
    except UserError as error:
        refusals[f"forward at 0.1 m/s, shift fixed at {FIXED_SHIFT_RADPS:g} rad/s"] = str(error)
    tell("100 Hz: where each discretisation goes unstable")
    bandwidths = {
        name: {
            path: {method: highest_stable_bandwidth(forward, laws[name], method, path) for method in METHODS}
            for path in SAMPLING_PATHS
        }
        for name in (DOB, BOTH)
    }
    tell("100 Hz: the simulations with delay and lag")
    sampled = sampled_run.study(forward, gains, track)
    tell("parameter space: the page to step through")
    return Loops(SPEEDS_MPS, margins, bandwidths, sampled, regions, refusals, explorer(car, gains))
