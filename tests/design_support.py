"""What the design's tests share: a straight leg for the firmware's own functions, and the car behind its delay."""

import math
from functools import cache

from firmware_py.core import observer, pid, predictor
from firmware_py.core.motion import PathState
from firmware_py.core.path import locate
from firmware_py.core.schedule import Gains
from firmware_py.core.tables import CarTable, LegTable
from sim.data_files import load_scenario, load_vehicle
from tools.design import gains as design
from tools.design.model import Corner, Nominal, Row

PERIOD_S = 0.01


def vehicle_of(name="paper", scenario=None, **overlay):
    if scenario is not None:
        overlay = {**load_scenario(scenario).vehicle_overlay, **overlay}
    return load_vehicle(name, overlay)


@cache
def designed(name="paper", scenario=None):
    return design.design_gains(vehicle_of(name, scenario))


def row_at(table, direction, speed_mps):
    return next(Row(*row) for row in table if row[:2] == (direction, speed_mps))


def straight_leg(direction):
    """Leg of 1000 m along x, driven with body yaw 0 (forward) or backwards to the origin (reverse)."""
    length = 1000.0
    x = (0.0, length) if direction > 0 else (length, 0.0)
    zero = (0.0, 0.0)
    return LegTable(
        sigma=direction,
        step_m=length,
        length_m=length,
        last_row=1,
        x_m=x,
        y_m=zero,
        yaw_rad=zero,
        curvature_1pm=zero,
        slip_heading_rad=zero,
        feedforward_curvature_1pm=zero,
        feedforward_slope_1pm2=zero,
        speed_mps=(1.0, 1.0),
        accel_mps2=zero,
    )


def car_table(nominal: Nominal, wheelbase_m=4.0, max_rate_radps=100.0):
    lag = nominal.steering_lag_s
    alpha = 1.0 if lag == 0.0 else 1.0 - math.exp(-PERIOD_S / lag)
    return CarTable(
        wheelbase_m=wheelbase_m,
        steering_lag_s=lag,
        lag_alpha=alpha,
        lag_mean_weight=0.0 if lag == 0.0 else lag / PERIOD_S * alpha,
        pose_latency_samples=min(1, nominal.latency_samples),
        command_latency_samples=nominal.latency_samples - min(1, nominal.latency_samples),
        drive_lag_s=0.3,
        brake_lag_s=0.1,
        gear_change_s=0.5,
        max_road_wheel_angle_rad=0.5,
        max_road_wheel_rate_radps=max_rate_radps,
        max_speed_mps=1.0,
        controlled_decel_mps2=1.0,
        emergency_decel_mps2=2.4,
    )


class FirmwareLaw:
    """Observer, predictor and PID of the firmware on a straight leg at constant speed, limits out of the way."""

    def __init__(self, row: Row, nominal: Nominal, predicts=True):
        self.leg = straight_leg(row.direction)
        self.car = car_table(nominal)
        self.gains = Gains(*row[2:])
        self.speed_mps = row.speed_mps
        self.predicts = predicts
        self.observed = observer.begin(100.0, 0.0)
        self.integral_m2 = 0.0
        self.sent_rad = (0.0,) * predictor.QUEUE_LENGTH

    def command_rad(self, e_m, heading_rad):
        """One cycle: the pose's cross-track and heading error in, the road-wheel angle out."""
        leg, car, sigma = self.leg, self.car, self.leg.sigma
        acted = self.sent_rad[car.pose_latency_samples + car.command_latency_samples]
        observed = observer.predict_to_pose(leg, car, self.observed, acted, self.speed_mps, PERIOD_S)
        at = locate(leg, observed.path.station_m)
        error = observer.innovation(leg, observed, at.x_m, at.y_m + e_m, heading_rad)
        observed = observer.correct_moving(observed, self.gains, error)
        assert observed.disbelieved == 0
        self.observed = observed
        ahead = observed.path
        if self.predicts:
            ahead = predictor.predict(leg, car, ahead, self.sent_rad, self.speed_mps, PERIOD_S)
        feedback = pid.feedback_1pm(
            ahead.cross_track_error_m, ahead.heading_error_rad, self.integral_m2, self.gains, sigma
        )
        angle = math.atan(-car.wheelbase_m * (feedback + ahead.curvature_disturbance_1pm))
        preview = pid.preview_error_m(ahead.cross_track_error_m, ahead.heading_error_rad, self.gains.preview_m, sigma)
        self.integral_m2 = pid.integrate_m2(self.integral_m2, preview, self.speed_mps * PERIOD_S, self.gains, 0)
        self.sent_rad = (angle, *self.sent_rad[:-1])
        return angle


class StraightRoad:
    """A car on a straight road in small steps of time: dead time, first-order lag, exact arc; nothing linearised."""

    STEPS = 10  # a cycle

    def __init__(self, corner: Corner, speed_mps, direction, e_m=0.0, wheelbase_m=4.0):
        self.corner, self.wheelbase_m = corner, wheelbase_m
        self.velocity_mps = direction * speed_mps
        self.e_m, self.heading_rad, self.wheel_rad = e_m, 0.0, 0.0
        self.late_steps = round(corner.latency_samples * self.STEPS)
        self.line = [0.0] * self.late_steps

    def drive(self, command_rad):
        """One cycle with a command; the pose's latency is part of the dead time."""
        h = PERIOD_S / self.STEPS
        lag = self.corner.steering_lag_s
        answer = 1.0 if lag == 0.0 else 1.0 - math.exp(-h / lag)
        self.line += [command_rad] * self.STEPS
        for target in self.line[: self.STEPS]:
            behind = target - self.wheel_rad
            mean_rad = target - behind * lag / h * answer
            self.wheel_rad += answer * behind
            curvature = self.corner.gain * math.tan(mean_rad) / self.wheelbase_m
            turned = curvature * self.velocity_mps * h
            self.e_m += self.velocity_mps * h * math.sin(self.heading_rad + 0.5 * turned)
            self.heading_rad += turned
        del self.line[: self.STEPS]


def drive(law: FirmwareLaw, road: StraightRoad, cycles):
    """Close the loop; return the cross-track errors, m, up to where they leave the believable."""
    errors = []
    for _ in range(cycles):
        errors.append(road.e_m)
        if abs(road.e_m) > 0.1 or abs(road.heading_rad) > 0.06:
            break
        road.drive(law.command_rad(road.e_m, road.heading_rad))
    return errors


def station_state(state: PathState):
    return (
        state.cross_track_error_m,
        state.heading_error_rad,
        state.curvature_disturbance_1pm,
        state.road_wheel_angle_rad,
    )
