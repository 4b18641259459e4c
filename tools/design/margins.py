"""Margins of a loop from its frequency response: disk, delay, gain and phase.

The loop is cut in one place, its feedback is negative (1 + L), and the closed loop is stable: of one that is not, these
numbers tell nothing.
"""

import math
from typing import NamedTuple

import numpy as np

from tools.design.model import PERIOD_S, Complexes, Floats


class Margins(NamedTuple):
    """What a stable loop bears before it is not stable any more.

    Delay in samples of 10 ms; the balanced disk margin, any mixture of gain and phase; gain as a factor, up or down;
    phase in rad.
    """

    delay_samples: float
    disk: float
    gain: float
    phase_rad: float


UNSTABLE = Margins(0.0, 0.0, 1.0, 0.0)
"""What stands for the margins of a loop that is not stable."""


def frequencies(speed_mps: float, count: int = 200) -> Floats:
    """Angular frequencies, rad/s, by even ratios from one period in 300 m of travel to half the rate of cycles."""
    return np.geomspace(0.02 * speed_mps, 0.999 * math.pi / PERIOD_S, count)


def on_circle(omega: Floats) -> Complexes:
    """The points z of angular frequencies in rad/s."""
    return np.asarray(np.exp(1j * omega * PERIOD_S))


def disk_margin(loop: Complexes) -> Floats:
    """Balanced disk margin of loops over the last axis: any gain and phase in the disk keeps a stable loop stable.

    2 / max |S - T|, as python-control's `disk_margins` with skew 0 (Seiler, Packard, Gahinet 2020).
    """
    return np.asarray(2.0 * np.min(np.abs((1.0 + loop) / (1.0 - loop)), axis=-1))


def margins_of(loop: Complexes, omega: Floats) -> Margins:
    """Margins of a loop from its response at increasing frequencies in rad/s, shape (n,); the closed loop is stable.

    Between the frequencies the logarithm of the gain and the phase are taken as linear in the logarithm of frequency.
    """
    log_gain = np.log(np.abs(loop))
    phase = np.unwrap(np.angle(loop))
    # Gain is 1: the phase left to -180 degrees either way, and the delay that uses up the lag to it.
    at, share = _crossings(log_gain)
    angle = phase[at] + share * np.diff(phase)[at]
    rate = omega[at] * (omega[at + 1] / omega[at]) ** share
    lag_left = np.mod(angle + math.pi, 2.0 * math.pi)
    phase_margin = np.minimum(lag_left, 2.0 * math.pi - lag_left)
    delay = lag_left / rate / PERIOD_S
    # Phase is -180 degrees, whatever the number of turns: the gain left up or down to 1.
    gain_left = [np.array([], dtype=np.float64)]
    first, last = math.floor(float(phase.min()) / (2.0 * math.pi)) - 1, math.ceil(float(phase.max()) / (2.0 * math.pi))
    for turn in range(first, last + 1):
        at, share = _crossings(phase - (2.0 * turn + 1.0) * math.pi)
        gain_left.append(np.abs(log_gain[at] + share * np.diff(log_gain)[at]))
    return Margins(
        delay_samples=float(delay.min(initial=math.inf)),
        disk=float(disk_margin(loop)),
        gain=math.exp(float(np.concatenate(gain_left).min(initial=math.inf))),
        phase_rad=float(phase_margin.min(initial=math.inf)),
    )


def _crossings(values: Floats) -> tuple[np.ndarray[tuple[int], np.dtype[np.intp]], Floats]:
    """Indices before each change of sign, and where in the interval it is (0 to 1)."""
    at = np.flatnonzero(np.signbit(values[:-1]) != np.signbit(values[1:]))
    return at, np.asarray(values[at] / (values[at] - values[at + 1]))
