"""Lateral force of an axle's tyres: brush model on a relaxing slip."""

CARCASS_DAMPING_RATIO = 0.3
"""Damping of the tyre carcass against the mass that it carries (assumed; bushings and suspension included).

Without it the relaxing tyre is a spring almost without loss at walking speed, and the car would sway for metres.
"""


def brush_factor(linear_force_n: float, friction_force_n: float) -> float:
    """Share of the linear force `C * slip` that the brush model lets through, from 1 (no slip) down.

    `friction_force_n` is friction coefficient times axle load, the most that the axle can hold. Brush model with
    parabolic pressure: F = z (1 - |z|/3 + z^2/27) * friction force with z = C * slip / friction force, sliding
    from |z| = 3 (Pacejka, Tire and Vehicle Dynamics, chapter 3).
    """
    z = linear_force_n / friction_force_n
    if z < 0.0:
        z = -z
    if z < 3.0:
        return 1.0 - z * (0.3333333333333333 - z * 0.037037037037037035)
    return 1.0 / z
