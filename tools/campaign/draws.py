"""What a campaign draws: from the scenario and the vehicle's box to one run that nobody knew before.

Every run has a seed of its own, first seed + index, and by it alone a scenario without any freedom left: lock-step and
the emulator drive the same run from it. Sides alternate with the seed: even left, odd right.
"""

from __future__ import annotations

import random
import textwrap
from typing import NamedTuple

from sim.data_files import SIDES, PlantDeviation, Scenario, Side, StartOffset, Vehicle

DRAWN_FROM_BOX = (
    "mass_kg",
    "yaw_inertia_kgm2",
    "wheelbase_m",
    "cornering_stiffness_front_n_per_rad",
    "cornering_stiffness_rear_n_per_rad",
    "tyre_friction",
    "relaxation_length_m",
    "steering_lag_s",
    "max_road_wheel_rate_radps",
    "pose_latency_samples",
    "command_latency_samples",
    "drive_lag_s",
    "brake_lag_s",
    "gear_change_s",
)
"""Vehicle parameters that lie anywhere in the file's low..high. The body's outline is that of the file: clearance is
measured to it. The centre of gravity keeps its distance to the rear axle."""

STEERING_GAIN = (0.9, 1.1)
START_AHEAD_M = (-0.02, 0.02)
START_ASIDE_M = (-0.01, 0.01)
START_HEADING_RAD = (-0.0035, 0.0035)

TABLE = (
    ("vehicle", ", ".join(DRAWN_FROM_BOX), "evenly from low..high of the vehicle file (its box)"),
    ("", "any of these in the scenario's vehicle_overlay", "as the overlay says: it is known"),
    ("", "any of these in the scenario's plant.unknown", "evenly from there instead"),
    ("", "any other in the scenario's plant.corners", "either end, by the bits of the seed"),
    ("plant", "steering gain", "evenly from 0.9..1.1, wider where the scenario's is"),
    ("", "steering bias, odometry scale", "evenly from -x..+x, x the scenario's largest"),
    ("", "steering backlash", "evenly from 0..x, x the scenario's largest"),
    ("", "command resolution, longitudinal latency", "the scenario's"),
    ("sensors", "noise of pose, speed and gyro, gyro's bias, drop-outs", "the scenario's, by the seed"),
    ("start", "ahead, aside, heading", "evenly from +-2 cm, +-1 cm, +-0.2 deg; the scenario's own where it has one"),
    ("side", "", "even seeds left, odd seeds right"),
)
"""What is drawn from what: (part, what, how)."""


class Drawn(NamedTuple):
    """One run of a campaign: its scenario has no freedom left but the noise, which is the seed's."""

    seed: int
    side: Side
    scenario: Scenario


def text_of_table() -> str:
    """Return the table as lines for people."""
    lines = []
    for part, what, how in TABLE:
        text = f"{what}: {how}" if what else how
        lines += textwrap.wrap(text, 100, initial_indent=f"  {part:<8} ", subsequent_indent=" " * 13)
    return "\n".join(lines)


def drawn_names(vehicle: Vehicle, scenario: Scenario) -> tuple[str, ...]:
    """Return the vehicle parameters that a campaign draws from the box: those that the scenario leaves free."""
    taken = {**scenario.vehicle_overlay, **scenario.plant.unknown}
    return tuple(name for name in DRAWN_FROM_BOX if name not in taken and vehicle.box[name][0] < vehicle.box[name][1])


def draw(vehicle: Vehicle, scenario: Scenario, seed: int) -> Drawn:
    """Return the run with this seed. The vehicle carries the scenario's overlay already."""
    rng = random.Random(f"campaign {seed}")
    plant = scenario.plant
    unknown = {}
    for name in drawn_names(vehicle, scenario):
        unknown[name] = _point(rng.uniform(*vehicle.box[name]))
    for name, bounds in plant.unknown.items():
        unknown[name] = _point(rng.uniform(*bounds))
    gain = (min(STEERING_GAIN[0], plant.steering_gain[0]), max(STEERING_GAIN[1], plant.steering_gain[1]))
    bias = max(abs(end) for end in plant.steering_bias_rad)
    scale = max(abs(end) for end in scenario.sensors.odometry_scale)
    start = scenario.start
    has_start = start != StartOffset()
    return Drawn(
        seed,
        SIDES[seed % 2],
        scenario.model_copy(
            update={
                "plant": PlantDeviation.model_construct(
                    steering_gain=_point(rng.uniform(*gain)),
                    steering_bias_rad=_point(rng.uniform(-bias, bias)),
                    steering_backlash_rad=_point(rng.uniform(0.0, plant.steering_backlash_rad[1])),
                    steering_command_resolution_rad=_point(rng.uniform(*plant.steering_command_resolution_rad)),
                    longitudinal_latency_samples=_point(rng.uniform(*plant.longitudinal_latency_samples)),
                    unknown=unknown,
                    corners={name: spread for name, spread in plant.corners.items() if name not in unknown},
                ),
                "sensors": scenario.sensors.model_copy(update={"odometry_scale": _point(rng.uniform(-scale, scale))}),
                "start": StartOffset.model_construct(
                    ahead_m=_point(rng.uniform(*(start.ahead_m if has_start else START_AHEAD_M))),
                    aside_m=_point(rng.uniform(*(start.aside_m if has_start else START_ASIDE_M))),
                    heading_rad=_point(rng.uniform(*(start.heading_rad if has_start else START_HEADING_RAD))),
                ),
            }
        ),
    )


def _point(value: float) -> tuple[float, float]:
    return (value, value)
