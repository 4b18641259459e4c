"""Every struct that flows through one control cycle.

The message structs carry the names of the DBC's signals, in the DBC's order, without CRC and counter; the codec
refuses a DBC that differs. Axes and signs: ISO 8855, left positive (dbc/CONVENTIONS.md). Flags are 0 or 1.
"""

from typing import NamedTuple

NO_COUNTER = 15
"""Stands for "no new valid frame in this cycle" where a rolling counter (0 to 14) is expected."""

# Value tables of the DBC (VAL_): the codec refuses a DBC that differs.
MODE_MANUAL = 0
MODE_READY = 1
MODE_ACTIVE = 2
MODE_FAULT = 3

LEG_IDLE = 0
LEG_FORWARD = 1
LEG_DIRECTION_CHANGE = 2
LEG_REVERSE = 3
LEG_COMPLETE = 4

GEAR_NONE = 0
GEAR_PARK = 1
GEAR_REVERSE = 2
GEAR_NEUTRAL = 3
GEAR_DRIVE = 4

QUALITY_FIXED = 3


class SysReport(NamedTuple):
    """VEH_SysRpt: state of the drive-by-wire system."""

    vehicle_state: int
    vehicle_reason: int
    driver_override: int
    sys_cmd_timeout: int
    sys_cmd_bad_crc: int
    sys_cmd_bad_counter: int
    sys_cmd_rejected_count: int


class OperatorCommand(NamedTuple):
    """OPER_Cmd: push buttons of the operator station; the frame itself is the heartbeat."""

    oper_start: int
    oper_stop: int
    oper_estop: int
    oper_clear: int


class SteerReport(NamedTuple):
    """VEH_SteerRpt: angles in rad at the road wheel, positive to the left; torque in Nm."""

    road_wheel_angle_meas_rad: float
    road_wheel_angle_echo_rad: float
    steer_angle_valid: int
    steer_limiting_value: int
    steer_limiting_rate: int
    steer_cmd_timeout: int
    steer_cmd_bad_crc: int
    steer_cmd_bad_counter: int
    steer_override: int
    steer_fault: int
    steering_wheel_torque_nm: float


class MotionReport(NamedTuple):
    """VEH_MotionRpt: signed longitudinal velocity in m/s and yaw rate in rad/s."""

    speed_meas_mps: float
    yaw_rate_meas_radps: float
    speed_valid: int
    yaw_rate_valid: int


class LongReport(NamedTuple):
    """VEH_LongRpt: gear, brakes and the echo of the longitudinal command (m/s, m/s^2)."""

    gear_rpt: int
    park_brake_applied: int
    standstill: int
    speed_echo_mps: float
    brake_decel_echo_mps2: float
    long_cmd_timeout: int
    long_cmd_bad_crc: int
    long_cmd_bad_counter: int
    brake_override: int
    long_fault: int


class Position(NamedTuple):
    """LOC_Position: rear-axle centre in the course frame, m."""

    position_x_m: float
    position_y_m: float
    position_quality: int


class Attitude(NamedTuple):
    """LOC_Attitude: yaw in rad in [-pi, pi), latency in ms, standard deviation in m."""

    yaw_rad: float
    yaw_quality: int
    pose_latency_ms: float
    position_sigma_m: float


class VehicleVersion(NamedTuple):
    """VEH_Version: what the vehicle is; hashes are 24 bit."""

    veh_protocol: int
    veh_dbc_hash: int
    veh_vehicle_hash: int


class SysCommand(NamedTuple):
    """CTRL_SysCmd: requests to the vehicle and the supervisor's state."""

    enable_request: int
    clear_request: int
    control_mode: int
    control_leg: int
    control_reason: int


class SteerCommand(NamedTuple):
    """CTRL_SteerCmd: road-wheel angle in rad, positive to the left."""

    road_wheel_angle_cmd_rad: float
    steer_enable: int


class LongCommand(NamedTuple):
    """CTRL_LongCmd: signed speed in m/s, brake deceleration in m/s^2 (never negative), gear."""

    speed_cmd_mps: float
    brake_decel_cmd_mps2: float
    gear_cmd: int
    park_brake_cmd: int
    long_enable: int


class CycleStamp(NamedTuple):
    """CTRL_Cycle: index and wake-up time (us) of the cycle, both as sent (modulo)."""

    cycle_index: int
    wake_time_us: int


class UsedCounters(NamedTuple):
    """CTRL_CycleInputs: the rolling counter of each frame that the cycle consumed, or NO_COUNTER."""

    used_sys_counter: int
    used_steer_counter: int
    used_motion_counter: int
    used_long_counter: int
    used_position_counter: int
    used_attitude_counter: int
    used_oper_counter: int
    used_veh_version_counter: int
    overruns_before_cycle: int


class Track(NamedTuple):
    """CTRL_Track: where the controller believes to be (m, m, rad, 1/m)."""

    station_m: float
    cross_track_error_est_m: float
    heading_error_est_rad: float
    curvature_disturbance_est_1pm: float


class ControllerVersion(NamedTuple):
    """CTRL_Version: what the controller was built for; hashes are 24 bit."""

    ctrl_protocol: int
    ctrl_dbc_hash: int
    ctrl_vehicle_hash: int


class HealthTiming(NamedTuple):
    """CTRL_HealthTiming: lateness of the wake-up and duration of the cycle over the last second, us."""

    wake_late_p50_us: int
    wake_late_p99_us: int
    wake_late_max_us: int
    step_time_p99_us: int


class HealthCounts(NamedTuple):
    """CTRL_HealthCounts: what went wrong in the loop since start."""

    overrun_count: int
    rejected_crc_count: int
    rejected_counter_count: int
    rejected_length_count: int
    send_failed_count: int


class Estimate(NamedTuple):
    """CTRL_Estimate: how sure the controller is of its place (m, rad), and what it has learnt of the car."""

    cross_track_sigma_m: float
    heading_sigma_rad: float
    steering_gain_est: float
    steering_offset_est_rad: float
    odometry_scale_est: float


class Inputs(NamedTuple):
    """All that one cycle knows of the world: the newest valid values, and which of them are new.

    `now_us` is the wake-up time in whole microseconds on a monotonic clock (not wrapped); `used.*` says which values
    are new in this cycle (anything but NO_COUNTER) and how many periods were skipped before it.
    """

    now_us: int
    used: UsedCounters
    sys: SysReport
    steer: SteerReport
    motion: MotionReport
    long: LongReport
    position: Position
    attitude: Attitude
    oper: OperatorCommand
    version: VehicleVersion
    second_controller: int


class Outputs(NamedTuple):
    """All that one cycle says to the world."""

    sys: SysCommand
    steer: SteerCommand
    long: LongCommand
    track: Track
