"""What the design's tests share: the firmware's own functions on straight and circle, and cars behind their delay."""

import math
from functools import cache

from firmware_py.core import estimator, pid, predictor
from firmware_py.core.motion import QUEUE_LENGTH
from firmware_py.core.path import feedforward_curvature_1pm
from firmware_py.core.schedule import gains_at
from firmware_py.core.tables import GainTable
from sim.data_files import load_scenario, load_vehicle
from tools.design import gains as design
from tools.design import model
from tools.design.filter import LOCALISATIONS
from tools.design.model import Corner, Mode, Nominal, Row, nominal_car, straight_leg

PERIOD_S = 0.01
NOMINAL = Nominal(4.0, 0.1, 1, 1, 0.45)


def vehicle_of(name="paper", scenario=None, **overlay):
    if scenario is not None:
        overlay = {**load_scenario(scenario).vehicle_overlay, **overlay}
    return load_vehicle(name, overlay)


@cache
def designed(name="paper", scenario=None):
    return design.design_gains(vehicle_of(name, scenario))


def row_at(table, direction, speed_mps):
    return next(Row(*row) for row in table if row[:2] == (direction, speed_mps))


def corner(**values):
    """The paper's car; keywords as the fields of a corner."""
    own = Corner("", 0.1, 1, 1.0, 1.0, 4.0, 2.0, 3000.0, 5113.0, 3e5, 3e5)
    return own._replace(**values)


def known_exactly(vehicle):
    """The vehicle with nothing uncertain but the steering's gain: few corners."""
    return type(vehicle)(**{**vars(vehicle), "box": {key: (getattr(vehicle, key),) * 2 for key in vehicle.box}})


class FirmwareLaw:
    """Estimator, predictor and PID of the firmware on a straight leg at constant speed, limits out of the way."""

    def __init__(self, row: Row, nominal: Nominal, mode: Mode = Mode()):  # noqa: B008
        self.leg = straight_leg(row.direction)
        self.car = nominal_car(nominal)
        self.mode = mode
        self.speed_mps = row.speed_mps
        table = GainTable((0.0, row.speed_mps), 1, ((row[2:], row[2:]),) * 2)
        self.gains = gains_at(table, 0, row.speed_mps)
        self.x_m = 100.0 if row.direction > 0 else 900.0
        self.poses_x = [self.x_m] * 60
        self.localisation = LOCALISATIONS[mode.localisation]
        self.state = estimator.begin()._replace(
            x_m=self.x_m,
            station_m=100.0,
            cycles=0,
            noise=self.localisation.noise,
            filter=model.filter_of(row, mode),
        )
        self.integral_m2 = 0.0
        self.sent_rad = (0.0,) * QUEUE_LENGTH

    def command_rad(self, e_m, yaw_rad, yaw_rate_radps, angle_rad):
        """One cycle: what the reports say in, the road-wheel angle out."""
        car = self.car
        ds_m = self.speed_mps * PERIOD_S
        self.x_m += self.leg.sigma * ds_m
        self.poses_x.append(self.x_m)
        n = car.command_latency_samples
        acted = self.sent_rad[n] + car.late_weight * (self.sent_rad[n + 1] - self.sent_rad[n])
        motion = estimator.Motion(
            ds_m, PERIOD_S, acted, angle_rad, 1, yaw_rate_radps, int(self.mode.with_yaw_rate), 0, 1
        )
        latency = car.pose_latency_samples if self.mode.predicts else 0
        return self.cycle(motion, self.poses_x[-1 - latency], e_m, yaw_rad)

    def cycle(self, motion, pose_x_m, pose_y_m, yaw_rad):
        """One cycle with a pose anywhere on the leg; the road-wheel angle out."""
        leg, car, sigma = self.leg, self.car, self.leg.sigma
        latency = car.pose_latency_samples if self.mode.predicts else 0
        stated_m, filters = self.localisation.stated_m, int(self.mode.predicts)
        self.state = estimator.estimate(
            leg, car, self.gains, self.state, motion, 1, pose_x_m, pose_y_m, yaw_rad, latency, stated_m, filters
        )  # fmt: skip
        assert self.state.disbelieved == 0
        station_m, e, heading, wheels_rad = predictor.predict(
            leg, car, self.state, self.sent_rad, self.speed_mps, PERIOD_S
        )
        if not self.mode.predicts:
            e, heading = self.state.cross_track_error_m, self.state.heading_error_rad
        preview = pid.preview_error_m(e, heading, self.gains.preview_m, sigma)
        feedback = pid.feedback_1pm(preview, heading, self.integral_m2, self.gains, sigma)
        reference = feedforward_curvature_1pm(leg, station_m)
        angle = math.atan(car.wheelbase_m * (reference - feedback)) - self.state.road_disturbance_rad
        if self.mode.predicts:
            angle += pid.push_rad(angle - wheels_rad, car)
        angle = (angle - self.state.steering_offset_rad) / self.state.steering_gain
        self.integral_m2 = pid.integrate_m2(self.integral_m2, preview, motion.odometry_m, self.gains, 0)
        self.sent_rad = (angle, *self.sent_rad[:-1])
        return angle


class StraightRoad:
    """A car on a straight road in small steps of time: dead time, first-order lag, exact arc; nothing linearised.

    It has no tyres: they answer within a cycle or two at walking speed.
    """

    STEPS = 10  # a cycle

    def __init__(self, corner: Corner, speed_mps, direction, e_m=0.0):
        self.corner = corner
        self.velocity_mps = direction * speed_mps
        self.e_m, self.yaw_rad, self.rack_rad, self.yaw_rate_radps = e_m, 0.0, 0.0, 0.0
        self.line = [0.0] * round((corner.command_latency_samples + 0.4) * self.STEPS)
        self.poses = [(e_m, 0.0)] * (corner.pose_latency_samples + 1)

    def reports(self):
        """Pose (late), yaw rate and measured angle."""
        return (*self.poses[-1 - self.corner.pose_latency_samples], self.yaw_rate_radps, self.rack_rad)

    def drive(self, command_rad):
        """One cycle, from reports to reports, with the command that the reports led to."""
        h = PERIOD_S / self.STEPS
        lag = self.corner.steering_lag_s
        answer = 1.0 if lag == 0.0 else 1.0 - math.exp(-h / lag)
        self.line += [self.corner.steering_gain * command_rad] * self.STEPS
        for target in self.line[: self.STEPS]:
            behind = target - self.rack_rad
            mean_rad = target - behind * lag / h * answer
            self.rack_rad += answer * behind
            turned = math.tan(mean_rad) / self.corner.wheelbase_m * self.velocity_mps * h
            self.e_m += self.velocity_mps * h * math.sin(self.yaw_rad + 0.5 * turned)
            self.yaw_rad += turned
        self.yaw_rate_radps = math.tan(self.rack_rad) / self.corner.wheelbase_m * self.velocity_mps
        del self.line[: self.STEPS]
        self.poses.append((self.e_m, self.yaw_rad))


def drive(law: FirmwareLaw, road: StraightRoad, cycles):
    """Close the loop; return the cross-track errors, m, up to where they leave the believable."""
    errors = []
    for _ in range(cycles):
        errors.append(road.e_m)
        if abs(road.e_m) > 0.1 or abs(road.yaw_rad) > 0.06 or abs(road.rack_rad) > 0.5:
            break
        road.drive(law.command_rad(*road.reports()))
    return errors


class Bend:
    """A law that drives a circle forward for good with the wheels at `angle_rad`, and its car, nothing linearised.

    The car has no tyres and no latency of the pose. `late_samples` is what its command takes longer than known.
    """

    LENGTH_M, STEP_M = 70.0, 0.05

    def __init__(self, row: Row, nominal: Nominal, mode: Mode, angle_rad, late_samples, e_m):
        self.law = FirmwareLaw(row, nominal._replace(pose_latency_samples=0), mode)
        self.nominal, self.speed_mps, self.angle_rad = nominal, row.speed_mps, angle_rad
        self.curvature_1pm = math.tan(angle_rad) / nominal.wheelbase_m
        count = round(self.LENGTH_M / self.STEP_M) + 1
        yaws = [self.curvature_1pm * self.STEP_M * index for index in range(count)]
        zero = (0.0,) * count
        self.law.leg = straight_leg(1.0)._replace(
            step_m=self.STEP_M,
            length_m=self.LENGTH_M,
            last_row=count - 1,
            x_m=tuple(math.sin(yaw) / self.curvature_1pm for yaw in yaws),
            y_m=tuple((1.0 - math.cos(yaw)) / self.curvature_1pm for yaw in yaws),
            yaw_rad=tuple(yaws),
            slip_heading_rad=zero,
            slip_curvature_1pm=zero,
            feedforward_curvature_1pm=(self.curvature_1pm,) * count,
            feedforward_slope_1pm2=zero,
            speed_mps=(self.speed_mps,) * count,
            accel_mps2=zero,
        )
        self.law.sent_rad = (angle_rad,) * QUEUE_LENGTH
        self.x_m, self.y_m, self.yaw_rad, self.rack_rad = 0.0, e_m, 0.0, angle_rad
        self.law.state = self.law.state._replace(
            x_m=0.0,
            y_m=e_m,
            station_m=0.0,
            road_wheel_angle_rad=angle_rad,
            modelled_angle_rad=angle_rad,
            yaw_rate_radps=self.speed_mps * self.curvature_1pm,
        )
        dead = nominal.command_latency_samples + 0.4 + late_samples
        self.line = [angle_rad] * round(dead * StraightRoad.STEPS)

    def cross_track_errors_m(self, cycles):
        """The errors of so many cycles, up to where they leave the believable."""
        errors = []
        law, h = self.law, PERIOD_S / StraightRoad.STEPS
        answer = 1.0 - math.exp(-h / self.nominal.steering_lag_s)
        for _ in range(cycles):
            radius_m = 1.0 / self.curvature_1pm
            errors.append(radius_m - math.hypot(self.x_m, self.y_m - radius_m))
            if abs(errors[-1]) > 0.1 or abs(self.rack_rad - self.angle_rad) > 0.5:
                break
            n = law.car.command_latency_samples
            acted = law.sent_rad[n] + law.car.late_weight * (law.sent_rad[n + 1] - law.sent_rad[n])
            yaw_rate_radps = self.speed_mps * math.tan(self.rack_rad) / self.nominal.wheelbase_m
            motion = estimator.Motion(
                self.speed_mps * PERIOD_S, PERIOD_S, acted, self.rack_rad, 1, yaw_rate_radps, 1, 0, 1
            )
            command_rad = law.cycle(motion, self.x_m, self.y_m, self.yaw_rad)
            self.line += [command_rad] * StraightRoad.STEPS
            for target in self.line[: StraightRoad.STEPS]:
                self.rack_rad += answer * (target - self.rack_rad)
                turned = math.tan(self.rack_rad) / self.nominal.wheelbase_m * self.speed_mps * h
                self.x_m += self.speed_mps * h * math.cos(self.yaw_rad + 0.5 * turned)
                self.y_m += self.speed_mps * h * math.sin(self.yaw_rad + 0.5 * turned)
                self.yaw_rad += turned
            del self.line[: StraightRoad.STEPS]
        return errors
