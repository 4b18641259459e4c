"""The disturbance observer in the frequency domain: eq. 17, and the margins of its loop over the speed (continuous)."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tools.design.waypoints import Floats
from tools.paper.laws import BOTH, DOB, Law, Observer
from tools.paper.plant import Plant, lateral_denominator, numerator

Complexes = npt.NDArray[np.complex128]

OMEGA_RADPS = np.geomspace(1e-3, 1e5, 16001)


def plant_response(plant: Plant, speed_mps: float, omega_radps: Floats) -> Complexes:
    """G(j omega), from steering angle to e_y; shape of omega."""
    s = 1j * omega_radps
    return np.asarray(
        np.polyval(numerator(plant, speed_mps), s) / (np.polyval(lateral_denominator(plant, speed_mps), s) * s * s)
    )


def low_pass(observer: Observer, omega_radps: Floats) -> Complexes:
    """Q(j omega), eq. 18."""
    s, w = 1j * omega_radps, observer.bandwidth_radps
    return np.asarray(w * w / (s * s + 2.0 * observer.damping * w * s + w * w))


class Equation17(NamedTuple):
    """The three transfer functions of eq. 17 on a frequency grid, and Q: complex arrays."""

    from_command: Complexes
    from_disturbance: Complexes
    from_noise: Complexes


def equation_17(plant: Complexes, nominal: Complexes, q: Complexes) -> Equation17:
    """Eq. 17: y over the command, over an output disturbance, over noise; arrays of one shape."""
    below = nominal * (1.0 - q) + plant * q
    return Equation17(nominal * plant / below, nominal * (1.0 - q) / below, -plant * q / below)


def loop_response(plant: Plant, law: Law, speed_mps: float, omega_radps: Floats) -> Complexes:
    """Open loop at the plant's input, L = G (C + Q / Gn) / (1 - Q), or what of it the law has."""
    g = plant_response(plant, speed_mps, omega_radps)
    s = 1j * omega_radps
    kp, ki, kd = law.gains
    c = kp + ki / s + kd * s if law.name != DOB else np.zeros_like(g)
    if law.name not in (DOB, BOTH):
        return np.asarray(g * c)
    q = low_pass(law.observer, omega_radps)
    return np.asarray((g * c + q / law.observer.nominal_factor) / (1.0 - q))


class Margins(NamedTuple):
    """Margins of one loop.

    gain: upwards, a factor, infinite if there is none. phase_deg, delay_s: least of all crossovers. disk: 2 over the
    peak of |(1 - L) / (1 + L)|, which bounds gain and phase changing at once.
    """

    gain: float
    phase_deg: float
    delay_s: float
    disk: float
    crossover_radps: float


def margins(response: Complexes, omega_radps: Floats) -> Margins:
    """Margins from a loop's frequency response; the grid must be fine enough that its phase turns little a step."""
    magnitude, phase = np.abs(response), np.unwrap(np.angle(response))
    crossings = np.flatnonzero(np.diff(np.sign(magnitude - 1.0)) != 0)
    phase_margin = delay = np.inf
    crossover = float("nan")
    for index in crossings:
        share = np.log(magnitude[index]) / np.log(magnitude[index] / magnitude[index + 1])
        omega = float(omega_radps[index] * (omega_radps[index + 1] / omega_radps[index]) ** share)
        angle = phase[index] + share * (phase[index + 1] - phase[index])
        above = float((angle + np.pi) % (2.0 * np.pi))  # how much lag until -180 degrees
        distance = min(above, 2.0 * np.pi - above)
        if distance < phase_margin:
            phase_margin, crossover = distance, omega
        delay = min(delay, above / omega)
    real_axis = np.flatnonzero((np.diff(np.sign(response.imag)) != 0) & (response.real[:-1] < 0.0))
    factors = [1.0 / abs(response[i].real) for i in real_axis if abs(response[i].real) < 1.0]
    disk = 2.0 / float(np.max(np.abs((1.0 - response) / (1.0 + response))))
    return Margins(min(factors, default=np.inf), float(np.degrees(phase_margin)), float(delay), disk, crossover)


def margins_over_speed(plant: Plant, law: Law, speeds_mps: Floats) -> list[Margins]:
    """Margins of a law's loop at each speed."""
    return [margins(loop_response(plant, law, float(v), OMEGA_RADPS), OMEGA_RADPS) for v in speeds_mps]
