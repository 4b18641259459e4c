"""How often each report comes, judged while the loop runs: who does not keep the DBC's cycle time is not driven with.

A report that comes much too seldom or too often (another cycle time, two senders) may still keep its timeout. As long
as the controller is not responsible for a moving car, such a report is held back: to the control law it is missing, so
the controller does not arm. While a report is being timed for the first time VEH_SysRpt is held back, which does the
same. While the controller drives only the timeouts count.
"""

from firmware_py.codec import INPUT_MESSAGES, MessageInfo

LEAST_SHARE = 0.7
MOST_SHARE = 1.5
"""Bounds of the measured rate over the DBC's: a stall of 0.3 s in a second passes, half or twice the rate does not."""

FIRST_PERIODS = 50
WINDOW_PERIODS = 100
"""A report is timed over its first half second, then over every second."""

JUDGE_PERIODS = 10

Frame = tuple[int, bytes]


class RateWatch:
    """Counts the reports' frames; `held` names the ids held back at present for their rate, and why."""

    def __init__(self, messages: dict[str, MessageInfo], period_ms: int) -> None:
        self._messages = tuple(messages[name] for name in INPUT_MESSAGES)
        self._key_id = messages["VEH_SysRpt"].frame_id
        self._period_ms = period_ms
        self._count = {message.frame_id: 0 for message in self._messages}
        self._begun = {message.frame_id: -1 for message in self._messages}  # period of the first frame, -1 without one
        self._being_timed: set[int] = set()
        self._now = 0
        self._judge_at = JUDGE_PERIODS
        self.held: dict[int, str] = {}

    def sift(self, frames: list[Frame], periods: int, *, holding: bool) -> list[Frame]:
        """Count the frames of one cycle, `periods` after the last one; return them without what is to be held back."""
        self._now += periods
        count = self._count
        for arbitration_id, _ in frames:
            if arbitration_id in count:
                if self._begun[arbitration_id] < 0:
                    self._begun[arbitration_id] = self._now  # the frame that opens a window is not of its rate
                    self._being_timed.add(arbitration_id)
                else:
                    count[arbitration_id] += 1
        if self._now >= self._judge_at:
            self._judge_at = self._now + JUDGE_PERIODS
            for message in self._messages:
                self._judge(message)
        if not holding or not (self.held or self._being_timed):
            return frames
        held = {*self.held, self._key_id} if self._being_timed else self.held
        return [frame for frame in frames if frame[0] not in held]

    def _judge(self, message: MessageInfo) -> None:
        number = message.frame_id
        periods = self._now - self._begun[number]
        if self._begun[number] < 0 or periods < (FIRST_PERIODS if number in self._being_timed else WINDOW_PERIODS):
            return
        count, self._count[number] = self._count[number], 0
        self._begun[number] = self._now
        self.held.pop(number, None)
        self._being_timed.discard(number)
        if count == 0:
            # Silent: its timeout's business; once it is back it is timed anew.
            self._begun[number] = -1
            return
        share = count * message.cycle_time_ms / (periods * self._period_ms)
        if not LEAST_SHARE <= share <= MOST_SHARE:
            every_ms = message.cycle_time_ms / share
            self.held[number] = f"{message.name} comes every {every_ms:.1f} ms, must be {message.cycle_time_ms} ms"
