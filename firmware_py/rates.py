"""How often each report comes, judged while the loop runs: who does not keep the DBC's cycle time is not driven with.

A report that comes much too seldom or too often (another cycle time, two senders) may still keep its timeout. As long
as the controller is not responsible for a moving car, such a report is held back: to the control law it is missing, so
the controller does not arm. While it drives only the timeouts count.
"""

from firmware_py.codec import INPUT_MESSAGES, MessageInfo

LEAST_SHARE = 0.7
MOST_SHARE = 1.5
"""Bounds of the measured rate over the DBC's: a stall of 0.3 s in a second passes, half or twice the rate does not."""

WINDOW_PERIODS = 100
LEAST_PERIODS = 50
"""A rate is judged once a second, over at least half of one."""

Frame = tuple[int, bytes]


class RateWatch:
    """Counts the reports' frames; `held` names the ids held back at present and why."""

    def __init__(self, messages: dict[str, MessageInfo], period_ms: int) -> None:
        self._messages = tuple(messages[name] for name in INPUT_MESSAGES)
        self._period_ms = period_ms
        self._count = {message.frame_id: 0 for message in self._messages}
        self._begun = {message.frame_id: -1 for message in self._messages}  # period of the first frame, -1 without one
        self._now = 0
        self._judge_at = WINDOW_PERIODS
        self.held: dict[int, str] = {}

    def sift(self, frames: list[Frame], periods: int, *, holding: bool) -> list[Frame]:
        """Count the frames of one cycle, `periods` after the last one; return them without what is to be held back."""
        self._now += periods
        count = self._count
        for arbitration_id, _ in frames:
            if arbitration_id in count:
                if self._begun[arbitration_id] < 0:
                    self._begun[arbitration_id] = self._now  # the frame that opens a window is not of its rate
                else:
                    count[arbitration_id] += 1
        if self._now >= self._judge_at:
            self._judge_at = self._now + WINDOW_PERIODS
            self._judge()
        if holding and self.held:
            return [frame for frame in frames if frame[0] not in self.held]
        return frames

    def _judge(self) -> None:
        held = {}
        for message in self._messages:
            number = message.frame_id
            count, periods = self._count[number], self._now - self._begun[number]
            if self._begun[number] < 0:
                continue
            if periods < LEAST_PERIODS:
                if number in self.held:
                    held[number] = self.held[number]
                continue
            share = count * message.cycle_time_ms / (periods * self._period_ms)
            if count and not LEAST_SHARE <= share <= MOST_SHARE:
                every_ms = message.cycle_time_ms / share
                held[number] = f"{message.name} comes every {every_ms:.1f} ms, must be {message.cycle_time_ms} ms"
            self._count[number] = 0
            self._begun[number] = self._now if count else -1
        self.held = held
