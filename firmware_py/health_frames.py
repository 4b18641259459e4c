"""The loop's own health, as it goes onto the bus once a second."""

from firmware_py.codec import Mailbox
from firmware_py.core.signals import HealthCounts, HealthTiming
from firmware_py.histogram import Histogram


class HealthFrames:
    """Collects lateness and step time for the frames of the next second."""

    def __init__(self) -> None:
        self._late = Histogram()
        self._step = Histogram()

    def add(self, late_ns: int, step_ns: int) -> None:
        """Count one cycle: lateness of its wake-up, time from wake-up to the last frame sent."""
        self._late.add(late_ns)
        self._step.add(step_ns)

    def timing(self) -> HealthTiming:
        """Return the timing since the last call."""
        timing = HealthTiming(
            wake_late_p50_us=round(self._late.quantile_us(0.5)),
            wake_late_p99_us=round(self._late.quantile_us(0.99)),
            wake_late_max_us=round(self._late.max_us),
            step_time_p99_us=round(self._step.quantile_us(0.99)),
        )
        self._late.clear()
        self._step.clear()
        return timing

    @staticmethod
    def counts(mailbox: Mailbox, overruns: int, send_failed: int) -> HealthCounts:
        """Return what went wrong since start; the codec holds each count at its signal's greatest value."""
        return HealthCounts(
            overrun_count=overruns,
            rejected_crc_count=mailbox.rejected_crc,
            rejected_counter_count=mailbox.rejected_counter,
            rejected_length_count=mailbox.rejected_length,
            send_failed_count=send_failed,
        )
