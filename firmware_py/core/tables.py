"""The tables that the controller runs on, as the core sees them: numbers only, indexed by (direction, row).

Direction index: 0 = forward, 1 = reverse. In the live loop each column is a tuple of floats; under numba it is a
float64 array of the same shape. `firmware_py.table_file` builds them.
"""

from collections.abc import Sequence
from typing import NamedTuple

Column = Sequence[float]

FORWARD = 0
REVERSE = 1

# Columns of a gain schedule's row, in the order of the file.
PREVIEW, KP, KI, KD, L_O, L_G, L_DR, W_E, W_P, W_D = range(10)
GAIN_COLUMNS = 10

# The laws: PID on the poses as they come; on what estimator and predictor make of them; the paper's own (`paper_law`).
LAW_PLAIN, LAW_CAR, LAW_PAPER = range(3)


class LegTable(NamedTuple):
    """One leg of the path and its speed profile over travelled station, on a uniform grid of `step_m`.

    Yaw is the body's and curvature the body's (wheels to the left positive) in both directions; slopes are per metre
    of travel. `feedforward_*` is the curvature to steer so that the rear axle follows the path with tyre slip,
    `slip_heading_rad` the heading that the body then has relative to the path, and `slip_curvature_1pm` how much more
    curvature the wheels make then than the body has.
    """

    sigma: float
    step_m: float
    length_m: float
    last_row: int
    x_m: Column
    y_m: Column
    yaw_rad: Column
    slip_heading_rad: Column
    slip_curvature_1pm: Column
    feedforward_curvature_1pm: Column
    feedforward_slope_1pm2: Column
    speed_mps: Column
    accel_mps2: Column


class GainTable(NamedTuple):
    """Gain schedule: `gain[direction][row][column]` over `speed_grid_mps[row]`, strictly increasing from 0."""

    speed_grid_mps: Column
    last_row: int
    gain: Sequence[Sequence[Column]]


class PaperTable(NamedTuple):
    """The paper's law: `row[direction][index][column]` over `speed_grid_mps` (columns in `paper_law`), and Q(z).

    Angles in rad, e_y in m. Q(z) = (q_b1 z + q_b2) / (z^2 + q_a1 z + q_a2). uses_pid, uses_observer: 1 or 0.
    """

    speed_grid_mps: Column
    last_row: int
    row: Sequence[Sequence[Column]]
    q_b1: float
    q_b2: float
    q_a1: float
    q_a2: float
    uses_pid: int
    uses_observer: int


class ReferencePath(NamedTuple):
    """Where a point `ahead_m` ahead of the rear axle goes while this is on the legs: `x_m[direction][row]`.

    Rows are those of the legs; yaw is that of the point's path, which the body has not: it slips there by
    atan(ahead_m times curvature).
    """

    ahead_m: float
    x_m: Sequence[Column]
    y_m: Sequence[Column]
    yaw_rad: Sequence[Column]


class CarTable(NamedTuple):
    """The nominal car and its limits, as far as the control law needs them.

    `lag_alpha` is the share of its gap that the steering closes in a cycle, `lag_mean_weight` the gap's mean over the
    cycle, `late_weight` the share of the command before the newest in what acts between two reports.
    """

    wheelbase_m: float
    steering_lag_s: float
    lag_alpha: float
    lag_mean_weight: float
    late_weight: float
    pose_latency_samples: int
    command_latency_samples: int
    drive_lag_s: float
    brake_lag_s: float
    gear_change_s: float
    max_road_wheel_angle_rad: float
    max_road_wheel_rate_radps: float
    max_speed_mps: float
    controlled_decel_mps2: float
    emergency_decel_mps2: float


class Timeouts(NamedTuple):
    """Age at which a report counts as lost, microseconds, one a message (GenMsgTimeout of the DBC)."""

    sys_us: int
    steer_us: int
    motion_us: int
    long_us: int
    pose_us: int
    oper_us: int
    version_us: int


class Tables(NamedTuple):
    """All that the core knows besides its state and its inputs.

    `law` is one of LAW_*; `paper` and `reference` are the paper's law's and stand empty (zeros) for the others.
    """

    leg: tuple[LegTable, LegTable]
    gains: GainTable
    car: CarTable
    timeouts: Timeouts
    dbc_hash24: int
    vehicle_hash24: int
    road_wheel_angle_lsb_rad: float
    law: int
    paper: PaperTable
    reference: ReferencePath
