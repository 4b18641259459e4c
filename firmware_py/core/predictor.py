"""From the newest reports to the instant at which the next command acts."""

from firmware_py.core.estimator import EstimatorState
from firmware_py.core.motion import advance
from firmware_py.core.tables import CarTable, LegTable


def predict(
    leg: LegTable,
    car: CarTable,
    state: EstimatorState,
    sent_angles_rad: tuple[float, ...],
    travel_speed_mps: float,
    period_s: float,
) -> tuple[float, float, float, float]:
    """Return where the car is when a command that is sent now begins to act.

    Station (m), cross-track error (m), heading error (rad) and road-wheel angle (rad, as it is measured).

    `sent_angles_rad[0]` is the newest command on its way. The commands that are still to act are the last
    (command latency) of them; the speed is taken as constant over that time.
    """
    station_m = state.station_m
    cross_m = state.cross_track_error_m
    heading_rad = state.heading_error_rad
    road_rad = state.road_disturbance_rad
    gain = state.steering_gain
    offset_rad = state.steering_offset_rad
    angle_rad = state.road_wheel_angle_rad
    remaining = car.command_latency_samples
    while remaining > 0:
        remaining -= 1
        station_m, cross_m, heading_rad, angle_rad = advance(
            leg,
            car,
            station_m,
            cross_m,
            heading_rad,
            angle_rad,
            gain * sent_angles_rad[remaining] + offset_rad,
            road_rad,
            travel_speed_mps,
            period_s,
        )
    return station_m, cross_m, heading_rad, angle_rad
