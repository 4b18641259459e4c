"""An encoder and a decoder that know neither the codec nor cantools: bits placed by hand from the text of the DBC.

What they agree on with the firmware is what a plant written by someone else, in another language, will agree on.
"""

from __future__ import annotations

import random
import re
from pathlib import Path
from typing import NamedTuple

import pytest

from firmware_py.codec import PAIR, STRUCTS, Mailbox, Sender, load_codec
from sim.can_side import CanSide

DBC = Path(__file__).resolve().parent.parent / "dbc/parking.dbc"
CODEC = load_codec(DBC)


class Field(NamedTuple):
    name: str
    start: int
    length: int
    signed: bool
    scale: float


def read_layout(text: str) -> dict[str, tuple[int, list[Field]]]:
    """Read BO_ and SG_ lines with two regular expressions."""
    layout: dict[str, tuple[int, list[Field]]] = {}
    fields: list[Field] = []
    for line in text.splitlines():
        if found := re.match(r"BO_ (\d+) (\w+): 8 \w+$", line):
            fields = []
            layout[found[2]] = (int(found[1]), fields)
        elif found := re.match(r" SG_ (\w+) : (\d+)\|(\d+)@1([+-]) \(([^,]+),0\) ", line):
            fields.append(Field(found[1], int(found[2]), int(found[3]), found[4] == "-", float(found[5])))
    return layout


LAYOUT = read_layout(DBC.read_text())


def bitwise_crc(data: list[int]) -> int:
    """CRC-8, one bit at a time: shift in from the left, subtract 0x11D whenever bit 8 is set."""
    register = 0
    for byte in [*data, 0]:
        for place in range(7, -1, -1):
            register = register << 1 | byte >> place & 1
            if register & 0x100:
                register ^= 0x11D
    return register


def encode(name: str, raws: dict[str, int], counter: int) -> tuple[int, bytes]:
    frame_id, fields = LAYOUT[name]
    bits = [0] * 64
    for field in fields:
        raw = {f"{name}_crc": 0, f"{name}_counter": counter}.get(field.name, raws.get(field.name, 0))
        for k in range(field.length):
            bits[field.start + k] = raw >> k & 1  # works on negative numbers: Python's >> keeps the sign
    data = [sum(bits[8 * byte + k] << k for k in range(8)) for byte in range(8)]
    data[0] = bitwise_crc([frame_id & 0xFF, frame_id >> 8, *data[1:]])
    return frame_id, bytes(data)


def decode(name: str, data: bytes) -> dict[str, int]:
    bits = [byte >> k & 1 for byte in data for k in range(8)]
    raws = {}
    for field in LAYOUT[name][1]:
        raw = sum(bits[field.start + k] << k for k in range(field.length))
        raws[field.name] = raw - (1 << field.length) if field.signed and bits[field.start + field.length - 1] else raw
    return raws


def random_raws(name: str, rng: random.Random) -> dict[str, int]:
    raws = {}
    for field in LAYOUT[name][1][2:]:
        half = 1 << (field.length - 1)
        low, high = (-half, half - 1) if field.signed else (0, 2 * half - 1)
        raws[field.name] = rng.choice([low, high, 0, rng.randint(low, high)])
    return raws


def test_the_text_of_the_dbc_was_read_whole() -> None:
    assert set(LAYOUT) == set(STRUCTS)
    for name, (_, fields) in LAYOUT.items():
        assert [f.name for f in fields[:2]] == [f"{name}_crc", f"{name}_counter"]
        assert [f.name for f in fields[2:]] == list(STRUCTS[name]._fields)


def test_the_bitwise_crc_knows_the_catalogue_s_check_value() -> None:
    """CRC-8/GSM-A of the text 123456789."""
    assert bitwise_crc(list(b"123456789")) == 0x37


@pytest.mark.parametrize("name", [n for n in LAYOUT if not n.startswith("CTRL")])
def test_the_controller_understands_an_independent_plant(name: str) -> None:
    rng = random.Random(name)
    mailbox = Mailbox(CODEC)
    scales = {field.name: field.scale for field in LAYOUT[name][1]}
    for cycle in range(100):
        raws = random_raws(name, rng)
        raws |= {key: 1 for key in raws if key.endswith("_valid")}  # what is not valid is not taken over
        mailbox.put(cycle * 10_000_000, *encode(name, raws, cycle % 15))
        if name in PAIR:  # handed out with its partner only
            partner = PAIR[name == PAIR[0]]
            mailbox.put(cycle * 10_000_000, *encode(partner, {}, cycle % 15))
        inputs = mailbox.take(0, 0)
        wanted = STRUCTS[name](**{key: raw * scales[key] for key, raw in raws.items()})
        assert wanted in inputs[2:-1]
    assert mailbox.received == (200 if name in PAIR else 100)


@pytest.mark.parametrize("name", [n for n in LAYOUT if n.startswith("CTRL")])
def test_an_independent_plant_understands_the_controller(name: str) -> None:
    rng = random.Random(name)
    sender = Sender(CODEC)
    scales = {field.name: field.scale for field in LAYOUT[name][1]}
    for cycle in range(100):
        raws = random_raws(name, rng)
        values = STRUCTS[name](**{key: raw * scales[key] for key, raw in raws.items()})
        frame = sender.pack(name, values)
        assert frame == encode(name, raws, cycle % 15)
        seen = decode(name, frame[1])
        assert {key: seen[key] for key in raws} == raws


@pytest.mark.parametrize("name", [n for n in LAYOUT if n.startswith("CTRL") or n == "OPER_Cmd"])
def test_the_plant_understands_an_independent_controller(name: str) -> None:
    rng = random.Random(name)
    side = CanSide(DBC, check_only=())
    scales = {field.name: field.scale for field in LAYOUT[name][1]}
    for cycle in range(100):
        raws = random_raws(name, rng)
        decoded = side.decode(cycle * 10_000_000, *encode(name, raws, cycle % 15))
        assert decoded is not None
        assert {key: decoded[1][key] for key in raws} == {key: raw * scales[key] for key, raw in raws.items()}


@pytest.mark.parametrize("name", [n for n in LAYOUT if n.startswith(("VEH", "LOC"))])
def test_the_plants_frames_are_what_the_dbc_s_text_says(name: str) -> None:
    rng = random.Random(name)
    side = CanSide(DBC)
    scales = {field.name: field.scale for field in LAYOUT[name][1]}
    for cycle in range(100):
        raws = random_raws(name, rng)
        values = {key: raw * scales[key] for key, raw in raws.items()}
        assert side.encode(name, values) == encode(name, raws, cycle % 15)
