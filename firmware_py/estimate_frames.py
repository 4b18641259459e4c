"""What the estimator has learnt and how sure it is, as it goes onto the bus ten times a second."""

from firmware_py.core import covariance, manoeuvre
from firmware_py.core.controller import PERIOD_S, State
from firmware_py.core.schedule import gains_at
from firmware_py.core.signals import NO_COUNTER, Estimate, Inputs
from firmware_py.core.tables import Tables


class EstimateFrames:
    """Carries the estimator's covariance along with the cycles, outside of the law, which does not need it."""

    def __init__(self, tables: Tables) -> None:
        self._tables = tables
        self._covariance = covariance.begin()
        self._cycles = 0
        self._poses = 0
        self._standing = 0
        self._with_yaw_rate = 0
        self._body_m = 0.0
        self._position_sigma_m = 0.0
        self._stood_at: tuple[float, float, float] | None = None

    def add(self, state: State, inputs: Inputs) -> None:
        """Count one cycle: its inputs, and the state after it."""
        self._cycles += 1
        self._body_m += state.speed_mps * PERIOD_S
        self._standing += state.standstill
        if inputs.used.used_motion_counter != NO_COUNTER and inputs.motion.yaw_rate_valid != 0:
            self._with_yaw_rate += 1
        stood_at, self._stood_at = self._stood_at, None
        if state.health.pose_is_new == 0 or state.estimator.disbelieved != 0:
            return
        self._poses += 1
        self._position_sigma_m = inputs.attitude.position_sigma_m
        if state.standstill != 0 and state.estimator.averaged > 0:
            self._stood_at = (inputs.position.position_x_m, inputs.position.position_y_m, inputs.attitude.yaw_rad)
            # A pose with which a new average begins is another place, not noise.
            if stood_at is not None and state.estimator.averaged > 1:
                dx_m, dy_m, turned_rad = (new - old for new, old in zip(self._stood_at, stood_at, strict=True))
                self._covariance = covariance.compare(self._covariance, dx_m, dy_m, turned_rad)

    def take(self, state: State) -> Estimate:
        """Return the frame's values at the end of the cycles since the last call."""
        tables, estimator = self._tables, state.estimator
        with_yaw_rate = 1 if 2 * self._with_yaw_rate >= self._cycles else 0
        gains = gains_at(
            tables.gains,
            manoeuvre.direction_of(state.manoeuvre.leg),
            abs(self._body_m) / (self._cycles * PERIOD_S),
            with_yaw_rate,
        )
        self._covariance = covariance.advance(
            self._covariance,
            gains,
            covariance.Interval(
                cycles=self._cycles,
                dt_s=self._cycles * PERIOD_S,
                body_m=self._body_m,
                poses=self._poses,
                averaged=estimator.averaged,
                standstill=1 if 2 * self._standing >= self._cycles else 0,
                with_yaw_rate=with_yaw_rate,
            ),
        )
        self._cycles = self._poses = self._standing = self._with_yaw_rate = 0
        self._body_m = 0.0
        cross_m, heading_rad = covariance.deviations(self._covariance, self._position_sigma_m)
        return Estimate(
            cross_m, heading_rad, estimator.steering_gain, estimator.steering_offset_rad, estimator.odometry_scale
        )
