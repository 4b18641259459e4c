"""The plant's quick packing gives the bytes and the values of cantools' own encode and decode."""

import random
import re
from itertools import pairwise

import cantools
import pytest
from core_support import DBC

from sim.can_side import CanSide
from sim.errors import UserError

DATABASE = cantools.database.load_file(DBC)
NODES = ("VEH", "LOC", "OPER", "CTRL")


def value_of(rng, signal):
    """Some value of the signal's range, its ends and halves of its scale included."""
    low, high = signal.minimum or 0, signal.maximum or 0
    if (signal.scale, signal.offset) == (1, 0):
        return rng.choice((low, high, rng.randint(int(low), int(high))))
    half = signal.offset + signal.scale * (rng.randint(1, 40) + 0.5)
    return rng.choice((low, high, rng.uniform(low, high), min(max(half, low), high)))


@pytest.mark.parametrize("message", DATABASE.messages, ids=lambda message: message.name)
def test_bytes_and_values_are_those_of_cantools(message):
    rng = random.Random(message.name)
    sender = CanSide(DBC, nodes=NODES)
    receiver = CanSide(DBC, nodes=(), check_only=())
    own = (f"{message.name}_crc", f"{message.name}_counter")
    for index in range(300):
        values = {s.name: value_of(rng, s) for s in message.signals if s.name not in own}
        frame_id, data = sender.encode(message.name, values)
        wanted = message.encode({**values, own[0]: data[0], own[1]: index % 15}, strict=False)
        assert (frame_id, data) == (message.frame_id, wanted)
        name, decoded = receiver.decode(index * 1_000_000, frame_id, data)
        assert name == message.name
        assert decoded == message.decode(data, decode_choices=False)


def test_every_single_bit_reaches_its_own_signal():
    receiver = CanSide(DBC, nodes=(), check_only=())
    for message in DATABASE.messages:
        reception = receiver.received[message.name]
        payloads = [(1 << bit).to_bytes(message.length, "little") for bit in range(8 * message.length)]
        decoded = [reception.values(data) for data in payloads]
        assert decoded == [message.decode(data, decode_choices=False) for data in payloads]
        assert any(one != other for one, other in pairwise(decoded))


def test_a_big_endian_signal_is_refused_by_name(tmp_path):
    broken = tmp_path / "broken.dbc"
    text, count = re.subn(r"( SG_ steer_enable : \d+\|1)@1", r"\1@0", DBC.read_text("utf-8"))
    assert count == 1
    broken.write_text(text, "utf-8")
    with pytest.raises(UserError, match=r"steer_enable .*Intel"):
        CanSide(broken)
