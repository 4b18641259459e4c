"""End-to-end protection of every message: CRC-8 in byte 0, rolling counter in the low half of byte 1.

The layout and the bytes are those of AUTOSAR E2E profiles P01 and P11 in the mode "data id both"; the frame id is the
data id. The acceptance rules of a receiver stand in dbc/CONVENTIONS.md, section "Counters".
"""

COUNTER_VALUES = 15
"""Counters run 0 to 14; 15 is never sent."""

MAX_STEP = 5
"""Greatest step from the last accepted counter at which a frame is still accepted: up to four frames may be lost."""

RESYNC_RUN = 3
"""So many frames that follow each other replace a baseline that they do not follow."""

OK = 0
REPEATED = 1
WRONG_SEQUENCE = 2

_POLYNOMIAL = 0x1D  # SAE J1850: x^8 + x^4 + x^3 + x^2 + 1


def _crc_of_byte(byte: int) -> int:
    for _ in range(8):
        byte = (byte << 1) ^ (_POLYNOMIAL if byte & 0x80 else 0)
        byte &= 0xFF
    return byte


_TABLE = tuple(_crc_of_byte(byte) for byte in range(256))


def crc8(data_id: int, data: bytes) -> int:
    """CRC-8 over the data id (low byte, then high byte) and `data[1:]`; start 0, no final exclusive-or.

    `data_id` has 16 bits; `data` is the whole payload, whose first byte is the place of the CRC and is left out.
    """
    table = _TABLE
    crc = table[table[data_id & 0xFF] ^ (data_id >> 8)]
    if len(data) == 8:  # every message of the DBC, a dozen times a cycle: the loop below, written out
        _, b1, b2, b3, b4, b5, b6, b7 = data
        return table[table[table[table[table[table[table[crc ^ b1] ^ b2] ^ b3] ^ b4] ^ b5] ^ b6] ^ b7]
    for byte in data[1:]:
        crc = table[crc ^ byte]
    return crc


def crc8_of_id(data_id: int) -> int:
    """CRC-8 over the data id alone: where the bytes of a frame go on."""
    return _TABLE[_TABLE[data_id & 0xFF] ^ (data_id >> 8)]


def table_before_zeros(zeros: int) -> tuple[int, ...]:
    """Return the table of one step of the CRC and of as many steps over zero bytes after it."""
    table = _TABLE
    for _ in range(zeros):
        table = tuple(_TABLE[crc] for crc in table)
    return table


class Receiver:
    """Judges the rolling counter of one message of one sender; bounded state, never raises.

    `status` is the verdict on the last frame, `lost` the frames that the accepted counters have skipped.
    """

    __slots__ = ("_baseline", "_heard_ns", "_newest", "_run", "_timeout_ns", "lost", "status")

    def __init__(self, timeout_ns: int) -> None:
        self._timeout_ns = timeout_ns
        self._baseline = -1  # last accepted counter; -1 before the first
        self._newest = -1  # last counter heard, accepted or not
        self._run = 0  # frames in a row that follow each other but not the baseline
        self._heard_ns = 0
        self.lost = 0
        self.status = OK

    def check(self, now_ns: int, counter: int) -> int:
        """Return OK, REPEATED or WRONG_SEQUENCE for a frame whose CRC is right.

        A rejected frame never moves the baseline. Only silence (no frame at all for the timeout) makes the next frame
        a first one: a sender whose counter hangs keeps talking and so is never accepted again.
        """
        if not 0 <= counter < COUNTER_VALUES:
            self.status = WRONG_SEQUENCE
        else:
            silent = now_ns - self._heard_ns > self._timeout_ns
            self._heard_ns = now_ns
            self.status = self._judge(counter, self._baseline < 0 or silent)
        return self.status

    def _judge(self, counter: int, first: bool) -> int:
        newest, self._newest = self._newest, counter
        step = (counter - self._baseline) % COUNTER_VALUES
        if not first and 0 < step <= MAX_STEP:
            self.lost += step - 1
        elif not first:
            follows = self._run > 0 and 0 < (counter - newest) % COUNTER_VALUES <= MAX_STEP
            self._run = self._run + 1 if follows else 1
            if self._run < RESYNC_RUN:
                return REPEATED if step == 0 else WRONG_SEQUENCE
        self._baseline = counter
        self._run = 0
        return OK
