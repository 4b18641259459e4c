"""The firmware's codec against cantools, against known CRCs and against bad values; what it refuses; what it costs."""

from __future__ import annotations

import math
import random
import timeit
from fractions import Fraction
from pathlib import Path
from typing import Any

import cantools
import crccheck
import pytest
from cantools.database.can import Message, Signal

from firmware_py import codec as codec_module
from firmware_py import e2e
from firmware_py.codec import INPUT_MESSAGES, PAIR, STRUCTS, VALID_BITS, Codec, Mailbox, Sender, load_codec
from firmware_py.core.signals import NO_COUNTER, Inputs, LongCommand, SteerCommand, UsedCounters
from firmware_py.errors import UserError
from firmware_py.reasons import TEXT as REASON_TEXTS
from sim.can_side import CanSide

DBC = Path(__file__).resolve().parent.parent / "dbc/parking.dbc"
CODEC = load_codec(DBC)
MESSAGES: dict[str, Message] = {m.name: m for m in cantools.database.load_file(DBC).messages}
NODES = {"CTRL", "VEH", "LOC", "OPER"}

each_message = pytest.mark.parametrize("name", STRUCTS)


def payload(name: str) -> list[Signal]:
    return [s for s in MESSAGES[name].signals if not s.name.startswith(name)]


def raw_limits(signal: Signal) -> tuple[int, int]:
    half = 1 << (signal.length - 1)
    return (-half, half - 1) if signal.is_signed else (0, 2 * half - 1)


def boundary_raws(signal: Signal) -> list[int]:
    low, high = raw_limits(signal)
    return sorted({raw for raw in (low, low + 1, -1, 0, 1, high - 1, high) if low <= raw <= high})


class Faults:
    nan_count = 0


# ------------------------------------------------------------------------------------------------ agreement both ways


@each_message
def test_firmware_packs_what_cantools_decodes(name: str) -> None:
    rng = random.Random(name)
    for trial in range(300):
        raws = {
            s.name: rng.choice(boundary_raws(s)) if trial % 3 else rng.randint(*raw_limits(s)) for s in payload(name)
        }
        values = [raws[s.name] * s.scale for s in payload(name)]
        counter = trial % 15
        data = CODEC.pack[name](STRUCTS[name]._make(values), counter, Faults())
        seen = MESSAGES[name].decode(data, decode_choices=False, scaling=False)
        assert {key: seen[key] for key in raws} == raws
        assert seen[f"{name}_counter"] == counter
        assert seen[f"{name}_crc"] == e2e.crc8(MESSAGES[name].frame_id, data)


@each_message
def test_firmware_unpacks_what_cantools_encodes(name: str) -> None:
    rng = random.Random(name)
    for trial in range(300):
        raws = {
            s.name: rng.choice(boundary_raws(s)) if trial % 3 else rng.randint(*raw_limits(s)) for s in payload(name)
        }
        whole = {**raws, f"{name}_crc": 0, f"{name}_counter": trial % 15}
        data = MESSAGES[name].encode(whole, scaling=False)
        decoded = MESSAGES[name].decode(data, decode_choices=False)
        values = CODEC.unpack[name](data)
        assert values._asdict() == {s.name: decoded[s.name] for s in payload(name)}  # to the last bit


@each_message
def test_both_round_to_the_nearest_step(name: str) -> None:
    """Random physical values, not on a step: the same bytes as cantools, which rounds too (ties aside)."""
    rng = random.Random(name)
    for counter in range(15):
        values = {}
        for s in payload(name):
            low, high = raw_limits(s)
            raw = rng.uniform(low, high)
            raw += 0.01 if abs(raw % 1 - 0.5) < 0.01 else 0.0
            values[s.name] = raw * s.scale if s.scale != 1 else round(raw)
        ours = CODEC.pack[name](STRUCTS[name](**values), counter, Faults())
        theirs = MESSAGES[name].encode({**values, f"{name}_crc": ours[0], f"{name}_counter": counter}, strict=False)
        assert ours == theirs


@each_message
def test_value_types_are_those_of_the_structs(name: str) -> None:
    """An int field stays an int, a float field a float: the control law sees the same types from the first cycle on."""
    hints = STRUCTS[name].__annotations__
    values = CODEC.unpack[name](bytes(8))
    for field, value in values._asdict().items():
        wanted = hints[field] if isinstance(hints[field], str) else hints[field].__name__
        assert type(value).__name__ == wanted, field


@pytest.mark.parametrize("name", [n for n in STRUCTS if not n.startswith("CTRL")])
def test_plant_to_controller_frame_by_frame(name: str) -> None:
    """What the plant's side encodes, the controller's mailbox accepts and reads, over two turns of the counter."""
    side = CanSide(DBC, nodes=("VEH", "LOC", "OPER"))
    mailbox = Mailbox(CODEC)
    rng = random.Random(name)
    for cycle in range(40):
        values = {s.name: rng.randint(*raw_limits(s)) * s.scale for s in payload(name)}
        values |= {bit: 1 for bit, _ in VALID_BITS.get(name, ())}
        mailbox.put(cycle * 10_000_000, *side.encode(name, values))
        if name in PAIR:
            mailbox.put(cycle * 10_000_000, *side.encode(PAIR[name == PAIR[0]], zeros(PAIR[name == PAIR[0]])))
        inputs = mailbox.take(cycle * 10_000, 0)
        index = INPUT_MESSAGES.index(name)
        assert inputs.used[index] == cycle % 15
        assert inputs[2 + index] == STRUCTS[name](**values)
    assert mailbox.received == (80 if name in PAIR else 40)
    assert (mailbox.rejected_crc, mailbox.rejected_counter, mailbox.lost) == (0, 0, 0)


def zeros(name: str) -> dict[str, float]:
    return {signal.name: 0 for signal in payload(name)}


@pytest.mark.parametrize(
    ("name", "bit", "value"), [(name, bit, value) for name, bits in VALID_BITS.items() for bit, value in bits]
)
def test_a_value_that_is_not_valid_keeps_its_last(name: str, bit: str, value: str) -> None:
    side, mailbox = CanSide(DBC, nodes=("VEH",)), Mailbox(CODEC)
    index = 2 + INPUT_MESSAGES.index(name)
    for cycle, (valid, sent, read) in enumerate([(1, 0.4, 0.4), (0, 0.1, 0.4), (1, 0.2, 0.2)]):
        mailbox.put(cycle * 10_000_000, *side.encode(name, zeros(name) | {bit: valid, value: sent}))
        inputs = mailbox.take(cycle * 10_000, 0)
        assert getattr(inputs[index], value) == pytest.approx(read)
        assert getattr(inputs[index], bit) == valid


def test_the_two_frames_of_a_pose_are_handed_out_together_whichever_cycles_they_fall_into() -> None:
    side, mailbox = CanSide(DBC, nodes=("LOC",)), Mailbox(CODEC)
    first, second = PAIR
    late = side.encode(second, zeros(second))
    mailbox.put(0, *side.encode(first, zeros(first)))
    inputs = mailbox.take(0, 0)
    assert (inputs.used.used_position_counter, inputs.used.used_attitude_counter) == (NO_COUNTER, NO_COUNTER)
    for cycle in range(1, 40):  # every cycle falls between the two frames of a sample
        mailbox.put(cycle * 10_000_000, *late)
        mailbox.put(cycle * 10_000_000, *side.encode(first, zeros(first) | {"position_x_m": 0.01 * cycle}))
        late = side.encode(second, zeros(second) | {"yaw_rad": 0.01 * cycle})
        inputs = mailbox.take(cycle * 10_000, 0)
        assert inputs.used.used_position_counter == inputs.used.used_attitude_counter == (cycle - 1) % 15
        assert inputs.position.position_x_m == pytest.approx(0.01 * (cycle - 1), abs=1e-5)
        assert inputs.attitude.yaw_rad == pytest.approx(0.01 * (cycle - 1), abs=1e-5)


def test_a_frame_that_lost_its_partner_is_not_paired_with_the_next_one_of_the_same_counter() -> None:
    side, mailbox = CanSide(DBC, nodes=("LOC",)), Mailbox(CODEC)
    first, second = PAIR
    for cycle in range(40):
        if cycle <= 3:
            mailbox.put(cycle * 10_000_000, *side.encode(first, zeros(first) | {"position_x_m": 0.01 * cycle}))
        attitude = side.encode(second, zeros(second))
        if cycle != 3:  # lost; its position waits, and 15 cycles later the counter is the same
            mailbox.put(cycle * 10_000_000, *attitude)
        inputs = mailbox.take(cycle * 10_000, 0)
        assert (inputs.used.used_position_counter != NO_COUNTER) == (cycle < 3), cycle
        assert inputs.position.position_x_m <= 0.02


@pytest.mark.parametrize("name", [n for n in STRUCTS if n.startswith("CTRL")])
def test_controller_to_plant_frame_by_frame(name: str) -> None:
    side = CanSide(DBC, check_only=())
    sender = Sender(CODEC)
    rng = random.Random(name)
    for cycle in range(40):
        values = {s.name: rng.randint(*raw_limits(s)) * s.scale for s in payload(name)}
        decoded = side.decode(cycle * 10_000_000, *sender.pack(name, STRUCTS[name](**values)))
        assert decoded is not None
        assert decoded[0] == name
        assert decoded[1] == {**values, f"{name}_crc": decoded[1][f"{name}_crc"], f"{name}_counter": cycle % 15}
    assert side.rejected_count == 0


def test_the_plants_side_checks_but_does_not_decode_what_is_for_the_log() -> None:
    side, sender = CanSide(DBC), Sender(CODEC)
    frame_id, data = sender.pack("CTRL_Cycle", STRUCTS["CTRL_Cycle"](1, 2))
    assert side.decode(0, frame_id, data) == ("CTRL_Cycle", {})
    assert side.decode(0, frame_id, data[:7] + b"\xff") is None
    assert side.received["CTRL_Cycle"].bad_crc


# --------------------------------------------------------------------------------------------------------- the CRC

# Bytes of frames that the library autosar-e2e 1.0.0 protected with profile 1 in the mode "data id both"; the first two
# are the examples of AUTOSAR PRS_E2EProtocol (data id 0x123, counters 0 and 1).
P01_FRAMES = [
    (0x0123, "cc 00 00 00 00 00 00 00"),
    (0x0123, "91 01 00 00 00 00 00 00"),
    (0x0123, "2b 03 00 00 00 00 00 00"),
    (0x0123, "a4 0a 00 00 00 00 00 00"),
    (0x0010, "cf 6d f1 d8 30 3e 61 cd"),
    (0x0200, "72 c2 27 10 3c 34 4c 41"),
    (0x0201, "47 d8 d4 7e 44 6f ce c2"),
    (0x0601, "5b 17 e5 78 1b cc ce a6"),
    (0xFFFF, "b3 c2 e9 c9 2d 99 bf 35"),
    (0x0000, "fd 2e e4 7c a8 c7 41 07"),
]


@pytest.mark.parametrize(("data_id", "text"), P01_FRAMES)
def test_crc_is_that_of_autosar_profile_1(data_id: int, text: str) -> None:
    data = bytes.fromhex(text)
    assert e2e.crc8(data_id, data) == data[0]
    assert e2e.crc8(data_id ^ 0x100, data) != data[0]
    assert e2e.crc8(data_id, data[:7] + bytes([data[7] ^ 1])) != data[0]


def test_crc_is_the_catalogue_s_crc_8_gsm_a() -> None:
    """Polynomial 0x1D of SAE J1850 with start 0 and no final exclusive-or has a name of its own in the catalogue."""
    rng = random.Random(1)
    for _ in range(500):
        data_id, data = rng.randrange(0x10000), rng.randbytes(8)
        covered = bytes([data_id & 0xFF, data_id >> 8]) + data[1:]
        assert e2e.crc8(data_id, data) == crccheck.crc.Crc8GsmA.calc(covered)


@each_message
def test_receive_takes_right_crcs_only_whatever_the_unused_bits_hold(name: str) -> None:
    """Generated with the CRC written out, and shorter where unused bytes are zero: the same verdict as byte by byte."""
    rng = random.Random(name)
    frame_id = MESSAGES[name].frame_id
    used_bytes = max(s.start + s.length - 1 for s in payload(name)) // 8 + 1
    for trial in range(200):
        zeros = (0, 8 - used_bytes, rng.randrange(7))[trial % 3]
        data = bytes(1) + rng.randbytes(7 - zeros) + bytes(zeros)
        right = bytes([e2e.crc8(frame_id, data)]) + data[1:]
        assert CODEC.receive[name](right) == CODEC.unpack[name](right)
        assert type(CODEC.receive[name](right)) is STRUCTS[name]
        flipped = bytearray(right)
        flipped[rng.randrange(8)] ^= 1 << rng.randrange(8)
        assert CODEC.receive[name](bytes(flipped)) is None
    assert CODEC.receive[name](bytes(8)) is None


def test_no_single_or_double_bit_error_and_no_burst_up_to_8_bits_passes() -> None:
    """Bursts in the order of the wire, within bytes 1 to 7: the CRC stands before them, not in its place behind."""
    name = "CTRL_SteerCmd"
    frame_id = MESSAGES[name].frame_id
    good = int.from_bytes(CODEC.pack[name](SteerCommand(-0.1234, 1), 7, Faults()), "big")

    def passes(flips: int) -> bool:
        data = (good ^ flips).to_bytes(8, "big")
        assert (CODEC.receive[name](data) is None) == (e2e.crc8(frame_id, data) != data[0])
        return e2e.crc8(frame_id, data) == data[0]

    assert passes(0)
    assert not any(passes(1 << a | 1 << b) for a in range(64) for b in range(a + 1))
    assert not any(passes(burst << place) for burst in range(1, 256, 2) for place in range(49))


@each_message
def test_a_dead_bus_line_and_the_frame_of_another_message_are_invalid(name: str) -> None:
    frame_id = MESSAGES[name].frame_id
    assert e2e.crc8(frame_id, bytes(8)) != 0
    receiver = e2e.Receiver(100)
    all_ones = b"\xff" * 8
    assert e2e.crc8(frame_id, all_ones) != 0xFF or receiver.check(0, 15) != e2e.OK
    own = CODEC.pack[name](CODEC.unpack[name](bytes(8)), 3, Faults())
    for other in MESSAGES.values():
        if other.name != name:
            assert e2e.crc8(other.frame_id, own) != own[0], f"{name} would pass as {other.name}"


# ----------------------------------------------------------------------------------------------------- bad values


@each_message
@pytest.mark.parametrize(
    "value", [math.inf, -math.inf, 1e308, -1e308, 1e19, -1e19, 5e-324, -0.0, 2.0**63, -(10**30), 10**30]
)
def test_any_number_is_cut_at_the_ends_and_never_raises(name: str, value: float) -> None:
    faults = Faults()
    data = CODEC.pack[name]([value] * len(payload(name)), 0, faults)
    decoded = MESSAGES[name].decode(data, decode_choices=False, scaling=False)
    for s in payload(name):
        low, high = raw_limits(s)
        assert decoded[s.name] == (high if value > 1 else low if value < -1 else 0), s.name
    assert faults.nan_count == 0
    assert e2e.crc8(MESSAGES[name].frame_id, data) == data[0]


@each_message
def test_one_step_beyond_the_end_is_cut_and_the_end_is_kept(name: str) -> None:
    for s in payload(name):
        for raw in raw_limits(s):
            for beyond in (0, 0.49, 0.5, 0.51, 1, 1.5):
                wanted = raw or min(raw_limits(s)[1], math.floor(beyond + 0.5))
                values = CODEC.unpack[name](bytes(8))._replace(**{s.name: (raw + math.copysign(beyond, raw)) * s.scale})
                data = CODEC.pack[name](values, 0, Faults())
                got = MESSAGES[name].decode(data, decode_choices=False, scaling=False)[s.name]
                assert got == wanted, (s.name, raw, beyond)


@each_message
def test_nan_becomes_the_start_value_and_is_counted(name: str) -> None:
    sender = Sender(CODEC)
    _, data = sender.pack(name, STRUCTS[name]._make([math.nan] * len(payload(name))))
    decoded = MESSAGES[name].decode(data, decode_choices=False, scaling=False)
    assert {s.name: decoded[s.name] for s in payload(name)} == {s.name: s.raw_initial for s in payload(name)}
    assert sender.nan_count == len(payload(name))
    _, data = sender.pack(name, CODEC.unpack[name](data))
    assert sender.nan_count == len(payload(name)), "a NaN leaves nothing behind"
    assert data[1] & 0x0F == 1


def test_rounding_is_half_up_and_never_truncation() -> None:
    scale = CODEC.scale("road_wheel_angle_cmd_rad")
    rng = random.Random(2)
    for _ in range(2000):
        value = rng.uniform(-1.3, 1.3)
        data = CODEC.pack["CTRL_SteerCmd"](SteerCommand(value, 1), 0, Faults())
        assert abs(CODEC.unpack["CTRL_SteerCmd"](data).road_wheel_angle_cmd_rad - value) <= scale * 0.500001
    for half, rounded in ((0.5, 1), (1.5, 2), (2.5, 3), (-0.5, 0), (-1.5, -1)):
        exact = float(Fraction(half) * Fraction(scale))
        data = CODEC.pack["CTRL_SteerCmd"](SteerCommand(exact, 1), 0, Faults())
        if exact / scale == half:  # only where the quotient is the tie itself
            assert MESSAGES["CTRL_SteerCmd"].decode(data, scaling=False)["road_wheel_angle_cmd_rad"] == rounded


@each_message
def test_the_plants_side_cuts_as_the_firmware_does(name: str) -> None:
    side = CanSide(DBC, nodes=NODES)
    names = [s.name for s in payload(name)]
    for counter, value in enumerate([math.inf, -math.inf, 1e19, -1e19, math.nan, 0.0]):
        _, theirs = side.encode(name, dict.fromkeys(names, value))
        assert theirs == CODEC.pack[name]([value] * len(names), counter, Faults())


# -------------------------------------------------------------------------------------------------------- mailbox


def report_frames(name: str, count: int) -> list[tuple[int, bytes]]:
    sender = Sender(CODEC)
    values = CODEC.unpack[name](bytes(8))._replace(**{bit: 1 for bit, _ in VALID_BITS.get(name, ())})
    return [sender.pack(name, values) for _ in range(count)]


def test_before_any_frame_everything_is_zero_and_nothing_is_new() -> None:
    inputs = Mailbox(CODEC).take(123, 0)
    assert inputs.now_us == 123
    assert inputs.used == UsedCounters(*[NO_COUNTER] * 8, 0)
    assert {value for struct in inputs[2:-1] for value in struct} == {0}
    assert inputs.second_controller == 0


def test_inputs_carry_each_message_in_its_own_field() -> None:
    """Struct by struct: a swap of two messages in the mailbox would show."""
    fields = dict(zip(INPUT_MESSAGES, Inputs._fields[2:-1], strict=True))
    used = dict(zip(INPUT_MESSAGES, UsedCounters._fields, strict=False))
    for name in INPUT_MESSAGES:
        assert Inputs.__annotations__[fields[name]] is STRUCTS[name]
        assert name in (next(s.comment for s in payload("CTRL_CycleInputs") if s.name == used[name]) or "")
        mailbox = Mailbox(CODEC)
        values = STRUCTS[name]._make([1] * len(payload(name)))
        mailbox.put(0, *Sender(CODEC).pack(name, values))
        expected = [used[name]]
        if name in PAIR:  # handed out with its partner only
            partner = PAIR[name == PAIR[0]]
            mailbox.put(0, *Sender(CODEC).pack(partner, CODEC.unpack[partner](bytes(8))))
            expected = [used[each] for each in PAIR]
        inputs = mailbox.take(0, 0)
        assert getattr(inputs, fields[name]) != CODEC.unpack[name](bytes(8))
        new = [key for key, counter in inputs.used._asdict().items() if counter == 0]
        assert new == [*expected, "overruns_before_cycle"]


def test_a_value_is_new_once_and_stays_known() -> None:
    mailbox, sender = Mailbox(CODEC), Sender(CODEC)
    mailbox.put(0, *sender.pack("VEH_MotionRpt", STRUCTS["VEH_MotionRpt"](0.5, -0.25, 1, 1)))
    first, second = mailbox.take(0, 0), mailbox.take(1, 0)
    assert (first.used.used_motion_counter, second.used.used_motion_counter) == (0, NO_COUNTER)
    assert first.motion == second.motion == STRUCTS["VEH_MotionRpt"](0.5, -0.25, 1, 1)


def test_of_several_frames_the_last_counts() -> None:
    mailbox, sender = Mailbox(CODEC), Sender(CODEC)
    for speed in (0.1, 0.2, 0.3):
        mailbox.put(0, *sender.pack("VEH_MotionRpt", STRUCTS["VEH_MotionRpt"](speed, 0.0, 1, 1)))
    inputs = mailbox.take(0, 0)
    assert inputs.motion.speed_meas_mps == pytest.approx(0.3)
    assert inputs.used.used_motion_counter == 2


def test_rejected_frames_change_nothing_and_are_counted_by_reason() -> None:
    mailbox, sender = Mailbox(CODEC), Sender(CODEC)
    good = [sender.pack("VEH_MotionRpt", STRUCTS["VEH_MotionRpt"](speed / 10, 0.0, 1, 1)) for speed in range(15)]
    frame_id, data = good[0]
    mailbox.put(0, frame_id, data)
    before = mailbox.take(0, 0)
    mailbox.put(1, frame_id, data)  # repeated
    mailbox.put(2, *good[9])  # jump
    mailbox.put(3, frame_id, good[1][1][:7])  # too short
    mailbox.put(4, frame_id, good[1][1] + b"\x00")  # too long
    mailbox.put(5, frame_id, b"")
    mailbox.put(6, frame_id, bytes([good[1][1][0] ^ 0x80]) + good[1][1][1:])  # CRC
    mailbox.put(7, 0x102, good[1][1])  # a right frame under another message's id
    mailbox.put(8, 0x555, data)
    after = mailbox.take(0, 0)
    assert after == before._replace(used=UsedCounters(*[NO_COUNTER] * 8, 0))
    assert (mailbox.rejected_counter, mailbox.rejected_length, mailbox.rejected_crc, mailbox.foreign) == (2, 3, 2, 1)
    mailbox.put(9, *good[2])  # one was lost: accepted, since no rejected frame moved the baseline
    assert mailbox.take(0, 0).motion.speed_meas_mps == pytest.approx(0.2)
    assert mailbox.lost == 1
    assert mailbox.received == 2


@pytest.mark.parametrize("name", [n for n in STRUCTS if n.startswith("CTRL")])
def test_any_frame_of_a_controller_shows_a_second_controller_once(name: str) -> None:
    mailbox = Mailbox(CODEC)
    mailbox.put(0, MESSAGES[name].frame_id, bytes(8))  # whatever is in it
    assert mailbox.take(0, 0).second_controller == 1
    assert mailbox.take(1, 0).second_controller == 0
    assert mailbox.foreign == 0


def test_overruns_are_held_at_what_the_bus_can_carry() -> None:
    """A replayed log must give the control law what it saw."""
    mailbox, sender = Mailbox(CODEC), Sender(CODEC)
    for overruns, seen in ((0, 0), (7, 7), (255, 255), (256, 255), (100_000, 255)):
        used = mailbox.take(0, overruns).used
        assert used.overruns_before_cycle == seen
        _, data = sender.pack("CTRL_CycleInputs", used)
        assert CODEC.unpack["CTRL_CycleInputs"](data) == used


def test_counters_of_messages_are_independent_and_wrap_at_15() -> None:
    sender = Sender(CODEC)
    steer = [sender.pack("CTRL_SteerCmd", SteerCommand(0.0, 0))[1][1] & 15 for _ in range(31)]
    assert steer == [*range(15), *range(15), 0]
    assert sender.pack("CTRL_LongCmd", LongCommand(0.0, 0.0, 0, 0, 0))[1][1] & 15 == 0


# ------------------------------------------------------------------------------------------------ what is refused

DBC_TEXT = DBC.read_text()


def edited(old: str, new: str) -> str:
    assert old in DBC_TEXT
    return DBC_TEXT.replace(old, new)


REFUSED = [
    ("no_message", edited("BO_ 512 CTRL_SteerCmd:", "BO_ 512 CTRL_SteerCmx:"), "lacks CTRL_SteerCmd"),
    ("no_signal", edited("SG_ steer_enable :", "SG_ steer_enabled :"), "signals of CTRL_SteerCmd: lacks steer_enable"),
    (
        "order",
        edited("SG_ enable_request : 12|1", "SG_ x : 12|1")
        .replace("SG_ clear_request : 13|1", "SG_ enable_request : 13|1")
        .replace("SG_ x : 12|1", "SG_ clear_request : 12|1"),
        "order enable_request, clear_request",
    ),
    ("gear", edited('VAL_ 513 gear_cmd 0 "None" 1 "Park"', 'VAL_ 513 gear_cmd 1 "None" 0 "Park"'), "gear_cmd"),
    ("mode", edited('VAL_ 32 vehicle_state 0 "Manual"', 'VAL_ 32 vehicle_state 0 "Off"'), '0 "Manual"'),
    ("reason", edited('19 "PoseInvalid" 20 "PoseJump"', '20 "PoseInvalid" 19 "PoseJump"'), '19 "PoseInvalid"'),
    ("no_table", edited("VAL_ 1537 yaw_quality", "VAL_ 1536 yaw_quality"), "yaw_quality"),
    ("no_cycle", edited('BA_ "GenMsgCycleTime" BO_ 257 10;\n', ""), "VEH_MotionRpt lacks the attribute"),
    ("no_timeout", edited('BA_ "GenMsgTimeout" BO_ 1537 100;\n', ""), 'LOC_Attitude lacks the attribute "GenMsgTime'),
    ("zero_timeout", edited('"GenMsgTimeout" BO_ 1537 100', '"GenMsgTimeout" BO_ 1537 0'), "LOC_Attitude"),
    ("data_id", edited('BA_ "E2EDataId" BO_ 512 512;', 'BA_ "E2EDataId" BO_ 512 513;'), "must be the frame id, 512"),
    ("frame_id", edited("BO_ 512 CTRL_SteerCmd:", "BO_ 517 CTRL_SteerCmd:"), "CTRL_SteerCmd"),
    ("crc_place", edited("CTRL_SteerCmd_crc : 0|8", "CTRL_SteerCmd_crc : 56|8"), "CTRL_SteerCmd_crc at bit 0|8"),
    ("length", edited("BO_ 512 CTRL_SteerCmd: 8", "BO_ 512 CTRL_SteerCmd: 7"), "8 bytes"),
    ("motorola", edited("SG_ steer_enable : 28|1@1+", "SG_ steer_enable : 28|1@0+"), "Intel"),
    ("29_bit", edited("BO_ 512 CTRL_SteerCmd:", f"BO_ {512 | 1 << 31} CTRL_SteerCmd:"), "11-bit"),
    ("overlap", edited("SG_ steer_enable : 28|1", "SG_ steer_enable : 20|1"), "not a valid DBC"),
    ("unknown", DBC_TEXT + "nonsense\n", "not a valid DBC"),
    ("empty", "", "not a valid DBC"),
    ("no_messages", 'VERSION ""\n', "messages: lacks CTRL_SysCmd"),
    ("picture", "\x89PNG\r\n\x1a\n\x00", "not a valid DBC"),
]


@pytest.mark.parametrize(("text", "hint"), [case[1:] for case in REFUSED], ids=[case[0] for case in REFUSED])
def test_a_dbc_that_differs_is_refused_in_one_line(tmp_path: Path, text: str, hint: str) -> None:
    path = tmp_path / "other.dbc"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(UserError) as caught:
        load_codec(path)
    message = str(caught.value)
    assert message.startswith(f"DBC file {path}: ")
    assert hint in message
    assert "\n" not in message
    assert len(message) < 400


def test_a_missing_dbc_is_refused_in_one_line_on_both_sides(tmp_path: Path) -> None:
    from sim.errors import UserError as PlantError  # noqa: PLC0415

    for load, error in ((load_codec, UserError), (CanSide, PlantError)):
        for path in (tmp_path / "none.dbc", tmp_path):
            with pytest.raises(error, match=rf"DBC file {path}: cannot be read \(.+\)"):
                load(path)


@pytest.mark.parametrize("case", [c for c in REFUSED if "not a valid" in c[2]], ids=lambda c: c[0])
def test_the_plants_side_refuses_what_is_no_dbc(tmp_path: Path, case: tuple[str, str, str]) -> None:
    from sim.errors import UserError as PlantError  # noqa: PLC0415

    path = tmp_path / "other.dbc"
    path.write_bytes(case[1].encode("latin-1"))
    with pytest.raises(PlantError, match=r"not a valid DBC \([^\n]+\)$"):
        CanSide(path)


def test_scales_and_offsets_of_a_changed_dbc_are_obeyed(tmp_path: Path) -> None:
    """The codec knows nothing by heart: another scale, an offset and another place are followed."""
    path = tmp_path / "other.dbc"
    moved = edited("road_wheel_angle_cmd_rad : 12|16@1- (4e-05,0)", "road_wheel_angle_cmd_rad : 29|16@1- (1e-4,0.5)")
    path.write_text(moved.replace("steer_enable : 28|1", "steer_enable : 60|1"))
    codec = load_codec(path)
    assert codec.scale("road_wheel_angle_cmd_rad") == 1e-4
    data = codec.pack["CTRL_SteerCmd"](SteerCommand(0.75, 1), 4, Faults())
    assert (int.from_bytes(data, "little") >> 29) & 0xFFFF == 2500
    assert codec.unpack["CTRL_SteerCmd"](data) == SteerCommand(pytest.approx(0.75), 1)
    assert codec.dbc_hash24 != CODEC.dbc_hash24


def test_line_ends_do_not_change_the_hash(tmp_path: Path) -> None:
    path = tmp_path / "windows.dbc"
    path.write_bytes(DBC.read_bytes().replace(b"\n", b"\r\n"))
    assert load_codec(path).dbc_hash24 == CODEC.dbc_hash24 == CanSide(path).dbc_hash24


def test_what_the_codec_says_of_messages_is_the_dbc_s() -> None:
    assert set(CODEC.messages) == set(MESSAGES)
    for name, info in CODEC.messages.items():
        message = MESSAGES[name]
        assert (info.name, info.frame_id, info.cycle_time_ms) == (name, message.frame_id, message.cycle_time)
        assert message.dbc is not None
        assert info.timeout_ms == message.dbc.attributes["GenMsgTimeout"].value
        assert [info.sender] == message.senders
        assert info.struct is STRUCTS[name]
    side = CanSide(DBC)
    assert {name: side.timeout_ns(name) for name in MESSAGES} == {
        name: info.timeout_ms * 1_000_000 for name, info in CODEC.messages.items()
    }


def test_every_enumeration_of_the_firmware_is_checked_whole() -> None:
    """All of the DBC's names but those that the firmware has no word for."""
    tables = {s.name: s.choices for m in MESSAGES.values() for s in m.signals if s.choices}
    assert set(tables) - set(codec_module.VALUE_TABLES) == {"vehicle_reason"}, "the vehicle's own; for people only"
    for name, wanted in codec_module.VALUE_TABLES.items():
        unknown = set(tables[name]) - set(wanted.values())
        assert unknown == ({0, 1, 2} if name.endswith("_quality") else set()), name
    assert set(codec_module.VALUE_TABLES["control_reason"].values()) == set(REASON_TEXTS)


def test_the_generated_source_is_kept_and_is_plain() -> None:
    for name in STRUCTS:
        assert f"def pack_{name}(" in CODEC.source
        assert f"def unpack_{name}(" in CODEC.source
    assert "import" not in CODEC.source
    compile(CODEC.source, "generated", "exec")


# ----------------------------------------------------------------------------------------------------------- speed


def ratio(fast: Any, slow: Any) -> float:
    """Return the time of `fast` over that of `slow`: best of many short turns, taken alternately on a busy machine."""
    pairs = [(timeit.timeit(fast, number=200), timeit.timeit(slow, number=200)) for _ in range(25)]
    return min(a for a, _ in pairs) / min(b for _, b in pairs)


@pytest.mark.live  # a ratio of times: with nothing of ours beside it
def test_the_codec_is_several_times_faster_than_cantools() -> None:
    name = "VEH_SteerRpt"
    message = MESSAGES[name]
    values = CODEC.unpack[name](bytes(8))._replace(road_wheel_angle_meas_rad=0.1, road_wheel_angle_echo_rad=-0.1)
    data = CODEC.pack[name](values, 0, Faults())
    whole = {**values._asdict(), f"{name}_crc": 0, f"{name}_counter": 0}
    faults = Faults()
    assert ratio(lambda: CODEC.pack[name](values, 0, faults), lambda: message.encode(whole, strict=False)) < 0.5
    assert ratio(lambda: CODEC.unpack[name](data), lambda: message.decode(data, decode_choices=False)) < 0.5


@pytest.mark.live  # a ratio of times: with nothing of ours beside it
def test_a_frame_in_costs_less_than_one_cantools_decode() -> None:
    """`Mailbox.put` with length, CRC, counter and unpacking against cantools' decode alone."""
    frames = report_frames("VEH_MotionRpt", 15)
    mailbox = Mailbox(CODEC)
    message = MESSAGES["VEH_MotionRpt"]
    turn = iter(frames * 1000)
    put = ratio(lambda: mailbox.put(0, *next(turn)), lambda: message.decode(frames[0][1], decode_choices=False))
    assert mailbox.rejected_counter == 0
    assert put < 1.2


def test_loading_is_done_once_and_leaves_plain_functions() -> None:
    assert isinstance(CODEC, Codec)
    assert all(callable(function) for function in [*CODEC.pack.values(), *CODEC.unpack.values()])
    assert "cantools" not in vars(codec_module)
