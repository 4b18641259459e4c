"""The paper's controller at 100 Hz: what each way to discretise Q and Q/Gn does, with delay and actuator lag.

The plant is exact behind a zero-order hold, with a first-order steering lag and a delay of whole samples; the
controller is u = -C y - F y + Q u with F = Q/Gn and Q discretised alike. Stability is the spectral radius.
"""

from typing import NamedTuple

import numpy as np

from tools.design.waypoints import Floats
from tools.paper.laws import BOTH, DOB, PID, Law, Observer
from tools.paper.plant import FORWARD, Plant, matrices, zeros_and_poles

PERIOD_S = 0.01
TUSTIN, PREWARPED, ZOH, FORWARD_EULER, BACKWARD_EULER, MATCHED, KINEMATIC = (
    "Tustin", "Tustin, prewarped", "zero-order hold", "forward Euler", "backward Euler", "matched",
    "kinematic ZOH inverse",
)  # fmt: skip
METHODS = (TUSTIN, PREWARPED, ZOH, FORWARD_EULER, BACKWARD_EULER, MATCHED, KINEMATIC)
BANDWIDTHS_RADPS = tuple(float(w) for w in np.geomspace(2.0, 200.0, 41))
SPEEDS_MPS = (0.1, 0.5, 1.0)
STABLE_WITHIN = 1.0 + 2e-4
"""The DOB alone leaves the plant's double integrator on the unit circle, where rounding moves it by about 1e-5."""


class System(NamedTuple):
    """Discrete or continuous state space (a, b, c, d), one input and one output: shapes (n, n), (n,), (n,), scalar."""

    a: Floats
    b: Floats
    c: Floats
    d: float


class Path(NamedTuple):
    """What lies between command and wheels: delay in whole samples, first-order lag in s."""

    delay_samples: int = 0
    lag_s: float = 0.0


def low_pass(observer: Observer) -> System:
    """Q of eq. 18."""
    w = observer.bandwidth_radps
    return System(
        np.array([[0.0, 1.0], [-w * w, -2.0 * observer.damping * w]]), np.array([0.0, w * w]), np.array([1.0, 0.0]), 0.0
    )


def filtered_inverse(plant: Plant, observer: Observer, speed_mps: float) -> System:
    """Q/Gn from e_y to steering angle: states Q's two, yaw rate and heading of the inverse (see `laws`)."""
    a, b, _, _ = matrices(plant, speed_mps)
    v, ls, w = speed_mps, plant.preview_time_s * speed_mps, observer.bandwidth_radps
    factor = observer.nominal_factor
    gain = v * b[0] + ls * b[1]
    curve = np.array([-w * w, -2.0 * observer.damping * w, 0.0, 0.0])
    beta = np.array([0.0, 1.0 / (factor * v), -ls / v, -1.0])
    c = (curve / factor - (v * a[0, 0] + ls * a[1, 0]) * beta) / gain
    c[2] -= (v * a[0, 1] + ls * a[1, 1] + v) / gain
    d = w * w / (factor * gain)
    big = np.zeros((4, 4))
    big[0, 1] = 1.0
    big[1] = curve
    big[2] = a[1, 0] * beta + b[1] * c
    big[2, 2] += a[1, 1]
    big[3, 2] = 1.0
    return System(big, np.array([0.0, w * w, b[1] * d, 0.0]), c, d)


def discretise(system: System, method: str, prewarp_radps: float) -> System:
    """Discretise by a named method at 100 Hz."""
    import control  # noqa: PLC0415

    names = {
        TUSTIN: "bilinear", PREWARPED: "bilinear", ZOH: "zoh", FORWARD_EULER: "euler", BACKWARD_EULER: "backward_diff"
    }  # fmt: skip
    continuous = control.StateSpace(system.a, system.b[:, None], system.c[None, :], [[system.d]])
    warp = {"prewarp_frequency": prewarp_radps} if method == PREWARPED else {}
    sampled = control.sample_system(continuous, PERIOD_S, method=names[method], **warp)
    return System(
        np.asarray(sampled.A), np.asarray(sampled.B)[:, 0], np.asarray(sampled.C)[0], float(np.asarray(sampled.D)[0, 0])
    )


def _matched(zeros: list[complex], poles: list[complex], gain: float, at_radps: float) -> System:
    """Pole-zero matching: z = exp(s T) for poles and finite zeros, the gain matched at a frequency."""
    from scipy import signal  # noqa: PLC0415

    s = 1j * at_radps
    wanted = gain * np.prod(s - np.array(zeros)) / np.prod(s - np.array(poles))
    z = np.exp(s * PERIOD_S)
    zero_z, pole_z = (np.exp(np.array(roots, dtype=complex) * PERIOD_S) for roots in (zeros, poles))
    scale = float(np.abs(wanted * np.prod(z - pole_z) / np.prod(z - zero_z)))
    a, b, c, d = signal.zpk2ss(zero_z, pole_z, scale)
    return System(a, b[:, 0], c[0], float(np.squeeze(d)))


def _matched_observer(plant: Plant, observer: Observer, speed_mps: float) -> tuple[System, System]:
    """Q and Q/Gn by pole-zero matching, gains matched at a tenth of the bandwidth."""
    w = observer.bandwidth_radps
    q_poles = [complex(pole) for pole in np.roots([1.0, 2.0 * observer.damping * w, w * w])]
    g = zeros_and_poles(plant, speed_mps)
    q = _matched([], q_poles, w * w, 0.1 * w)
    inverse_gain = w * w / (observer.nominal_factor * g.gain)
    return q, _matched(list(g.poles), [*q_poles, *g.zeros], inverse_gain, 0.1 * w)


def _kinematic_inverse(plant: Plant, observer: Observer, speed_mps: float) -> System:
    """Q(z) over the zero-order-hold model of the kinematic plant (V/L)((lr + ls) s + V)/s^2, Q by zero-order hold."""
    from scipy import signal  # noqa: PLC0415

    q = discretise(low_pass(observer), ZOH, observer.bandwidth_radps)
    v, t = speed_mps, PERIOD_S
    arm = (plant.car.rear_m if plant.direction == FORWARD else plant.car.front_m) + plant.preview_time_s * v
    scale = observer.nominal_factor * v / plant.car.wheelbase_m
    # ZOH of (arm s + v)/s^2: arm T/(z - 1) + v T^2/2 (z + 1)/(z - 1)^2
    num = scale * np.array([arm * t + 0.5 * v * t * t, 0.5 * v * t * t - arm * t])
    q_num, q_den = signal.ss2tf(q.a, q.b[:, None], q.c[None, :], [[q.d]])
    top = np.polymul(np.trim_zeros(np.round(q_num[0], 15), "f"), [1.0, -2.0, 1.0])
    a, b, c, d = signal.tf2ss(top, np.polymul(q_den, num))
    return System(a, b[:, 0], c[0], float(np.squeeze(d)))


def observer_at(plant: Plant, observer: Observer, speed_mps: float, method: str) -> tuple[System, System]:
    """Q(z) and F(z) = (Q/Gn)(z) by a method."""
    if method == KINEMATIC:
        return discretise(low_pass(observer), ZOH, 0.0), _kinematic_inverse(plant, observer, speed_mps)
    if method == MATCHED:
        return _matched_observer(plant, observer, speed_mps)
    w = observer.bandwidth_radps
    return (
        discretise(low_pass(observer), method, w),
        discretise(filtered_inverse(plant, observer, speed_mps), method, w),
    )


def sampled_plant(plant: Plant, speed_mps: float, path: Path) -> System:
    """Exact discretisation of eq. 11 behind hold, delay and lag."""
    from scipy.linalg import expm  # noqa: PLC0415

    a4, b4, _, c4 = matrices(plant, speed_mps)
    if path.lag_s > 0.0:
        a = np.zeros((5, 5))
        a[:4, :4], a[:4, 4], a[4, 4] = a4, b4, -1.0 / path.lag_s
        b, c = np.array([0.0] * 4 + [1.0 / path.lag_s]), np.append(c4, 0.0)
    else:
        a, b, c = a4, b4, c4
    n = len(b)
    whole = np.zeros((n + 1, n + 1))
    whole[:n, :n], whole[:n, n] = a * PERIOD_S, b * PERIOD_S
    step = expm(whole)
    phi, gamma = step[:n, :n], step[:n, n]
    size = n + path.delay_samples
    big, drive = np.zeros((size, size)), np.zeros(size)
    big[:n, :n] = phi
    if path.delay_samples == 0:
        drive[:n] = gamma
    else:
        big[:n, size - 1] = gamma
        drive[n] = 1.0
        for row in range(n + 1, size):
            big[row, row - 1] = 1.0
    return System(big, drive, np.concatenate([c, np.zeros(path.delay_samples)]), 0.0)


def pid_at(law: Law) -> System:
    """Eq. 19 at 100 Hz: sum of the errors so far, backward difference."""
    kp, ki, kd = law.gains
    return System(
        np.array([[1.0, 0.0], [0.0, 0.0]]),
        np.array([PERIOD_S, 1.0]),
        np.array([ki, -kd / PERIOD_S]),
        kp + ki * PERIOD_S + kd / PERIOD_S,
    )


def closed_loop_matrix(plant: System, law: Law, q: System, inverse: System) -> Floats:
    """State matrix of the sampled loop."""
    parts = [plant]
    rows: list[tuple[System, float]] = []  # (system that is driven by y, its sign in u)
    if law.name in (PID, BOTH):
        rows.append((pid_at(law), -1.0))
    if law.name in (DOB, BOTH):
        rows.append((inverse, -1.0))
    through_u = [q] if law.name in (DOB, BOTH) else []
    parts += [system for system, _ in rows] + through_u
    sizes = [len(part.b) for part in parts]
    at = np.concatenate([[0], np.cumsum(sizes)])
    total = int(at[-1])
    y = np.zeros(total)
    y[: sizes[0]] = plant.c
    u = np.zeros(total)
    for index, (system, sign) in enumerate(rows, start=1):
        u[at[index] : at[index + 1]] += sign * system.c
        u += sign * system.d * y
    if through_u:
        u[at[-2] :] += q.c
        u /= 1.0 - q.d
    whole = np.zeros((total, total))
    for index, part in enumerate(parts):
        own = slice(int(at[index]), int(at[index + 1]))
        whole[own, own] += part.a
        driven_by = u if index == 0 or (through_u and index == len(parts) - 1) else y
        whole[own] += np.outer(part.b, driven_by)
    return whole


def spectral_radius(plant: Plant, law: Law, speed_mps: float, method: str, path: Path) -> float:
    """Largest magnitude of the sampled loop's eigenvalues."""
    q, inverse = observer_at(plant, law.observer, speed_mps, method)
    whole = closed_loop_matrix(sampled_plant(plant, speed_mps, path), law, q, inverse)
    if not np.all(np.isfinite(whole)):
        return float("inf")
    return float(np.max(np.abs(np.linalg.eigvals(whole))))


def highest_stable_bandwidth(plant: Plant, law: Law, method: str, path: Path) -> float:
    """Bandwidth up to which the sampled loop is stable at 0.1, 0.5 and 1 m/s, rad/s; 0 where not even the lowest is."""
    best = 0.0
    for w in BANDWIDTHS_RADPS:
        tried = law._replace(observer=law.observer._replace(bandwidth_radps=w))
        if any(spectral_radius(plant, tried, v, method, path) > STABLE_WITHIN for v in SPEEDS_MPS):
            break
        best = w
    return best
