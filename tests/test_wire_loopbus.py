"""The embedded bus: what python-can promises of an interface, and what a bus without a server must survive."""

from __future__ import annotations

import os
import select
import socket
import struct
import time
import timeit

import can
import pytest
from wire_support import HOST, Open, base_fixture, drain, frame, open_node_fixture  # noqa: F401 -- fixtures

from sim import loopbus
from sim.loopbus import LoopBus

# ------------------------------------------------------------------------------------------------- what passes


def test_python_can_finds_it_by_its_entry_point(open_node: Open) -> None:
    node = open_node()
    assert type(node) is LoopBus
    assert "loopbus" in can.VALID_INTERFACES


KINDS = [
    frame(0x000, b""),
    frame(0x7FF, b"\xff" * 8),
    *[frame(0x100 + n, bytes(range(n))) for n in range(9)],
    frame(0x1FFFFFFF, b"abc", is_extended_id=True),
    frame(0x123, b"abc", is_extended_id=True),
    can.Message(arbitration_id=0x321, is_remote_frame=True, dlc=5, is_extended_id=False),
    can.Message(arbitration_id=0x004, is_error_frame=True, data=b"\x00" * 8, is_extended_id=False),
]


@pytest.mark.parametrize("sent", KINDS, ids=str)
def test_every_kind_of_classical_frame_arrives_as_it_was_sent(open_node: Open, base: int, sent: can.Message) -> None:
    first, second = open_node(), open_node()
    before = time.time()
    first.send(sent)
    got = second.recv(1.0)
    assert got is not None
    assert got.equals(sent, timestamp_delta=None, check_channel=False, check_direction=False)
    assert before - 0.01 <= got.timestamp <= time.time() + 0.01
    assert got.channel == base
    assert got.is_rx


def test_the_time_stamp_is_that_of_arrival_not_of_reading(open_node: Open) -> None:
    first, second = open_node(), open_node()
    before = time.time()
    first.send(frame())
    after = time.time()
    time.sleep(0.05)
    got = second.recv(0)
    assert got is not None
    assert before - 1e-3 <= got.timestamp <= after + 1e-3


def test_all_other_nodes_hear_a_frame_and_the_sender_does_not(open_node: Open) -> None:
    nodes = [open_node() for _ in range(loopbus.NODES)]
    for number, sender in enumerate(nodes):
        sender.send(frame(number))
    for number, node in enumerate(nodes):
        assert [m.arbitration_id for m in drain(node)] == [n for n in range(loopbus.NODES) if n != number]


def test_a_node_that_asks_for_it_hears_itself(open_node: Open) -> None:
    node, other = open_node(receive_own_messages=True), open_node()
    node.send(frame(1))
    other.send(frame(2))
    assert [(m.arbitration_id, m.is_rx) for m in drain(node)] == [(1, False), (2, True)]


def test_order_is_kept_and_a_burst_is_not_lost(open_node: Open) -> None:
    first, second = open_node(), open_node()
    for number in range(200):
        first.send(frame(number))
    assert [m.arbitration_id for m in drain(second)] == list(range(200))


def test_filters_of_python_can_work(open_node: Open) -> None:
    first = open_node()
    second = open_node(can_filters=[{"can_id": 0x101, "can_mask": 0x7FF}])
    for number in (0x100, 0x101, 0x102):
        first.send(frame(number))
    got = second.recv(0.2)
    assert got is not None
    assert got.arbitration_id == 0x101
    assert second.recv(0.01) is None


def test_waiting_ends_at_the_timeout_or_with_the_frame(open_node: Open) -> None:
    first, second = open_node(), open_node()
    start = time.monotonic()
    assert second.recv(0) is None
    assert second.recv(0.05) is None
    assert time.monotonic() - start >= 0.05
    first.send(frame())
    assert second.recv(None) is not None


def test_the_descriptor_becomes_readable(open_node: Open) -> None:
    first, second = open_node(), open_node()
    second.recv(0)
    assert select.select([second.fileno()], [], [], 0)[0] == []
    first.send(frame())
    assert select.select([second.fileno()], [], [], 1.0)[0] == [second.fileno()]


def test_a_notifier_delivers(open_node: Open) -> None:
    first, second = open_node(), open_node()
    reader = can.BufferedReader()
    notifier = can.Notifier(second, [reader], timeout=0.1)
    try:
        for number in range(20):
            first.send(frame(number))
        assert [m.arbitration_id for m in (reader.get_message(1.0) for _ in range(20)) if m] == list(range(20))
    finally:
        notifier.stop()


def test_one_thread_may_send_while_another_receives(open_node: Open) -> None:
    """As every program with a Notifier does; newcomers say hello all the while."""
    first, second = open_node(), open_node()
    got: list[int] = []
    listener = can.Notifier(first, [lambda message: got.append(message.arbitration_id)], timeout=0.1)
    try:
        for number in range(1500):
            second.send(frame(number))
            first.send(frame(number))
            if number % 100 == 0:
                open_node().shutdown()
            if number % 20 == 0:
                time.sleep(0.001)
        deadline = time.monotonic() + 2.0
        while len(got) < 1500 and time.monotonic() < deadline:
            time.sleep(0.01)
    finally:
        listener.stop()
    assert got == list(range(1500))


def test_can_fd_is_refused(open_node: Open) -> None:
    with pytest.raises(can.CanOperationError, match="classical"):
        open_node().send(can.Message(arbitration_id=1, is_fd=True, data=bytes(12)))


# ------------------------------------------------------------------------------------------- coming, going, dying


def test_sending_to_nobody_never_fails(open_node: Open) -> None:
    node = open_node()
    for _ in range(500):
        node.send(frame())
    assert node.recv(0) is None
    assert node.recv(0.01) is None


def test_a_node_that_opens_later_is_heard_and_hears_at_once(open_node: Open) -> None:
    """Though the first one neither reads nor waits between its own frames."""
    first = open_node()
    for _ in range(50):
        first.send(frame(1))
    second = open_node()
    first.send(frame(2))
    assert [m.arbitration_id for m in drain(second)] == [2]
    second.send(frame(3))
    assert [m.arbitration_id for m in drain(first)] == [3]


def test_a_node_that_leaves_frees_its_port_and_its_successor_works_at_once(open_node: Open) -> None:
    first, second = open_node(), open_node()
    for turn in range(20):
        first.send(frame(turn))
        assert [m.arbitration_id for m in drain(second)] == [turn]
        second.shutdown()
        first.send(frame(0x700))  # into the void
        assert first.recv(0) is None
        second = open_node()
        assert second.channel_info.endswith("node 1")


def test_a_newcomer_is_found_though_its_hello_waits_behind_unread_frames(open_node: Open) -> None:
    sender, chatter = open_node(), open_node()
    for _ in range(10):
        chatter.send(frame(0x100))  # the sender never reads
        sender.send(frame(0x200))
    newcomer = open_node()
    deadline = time.monotonic() + 5.0
    while newcomer.recv(0) is None:
        assert time.monotonic() < deadline
        sender.send(frame(0x201))
        time.sleep(0.002)
    for number in range(10):  # found once, found for good
        sender.send(frame(number))
    assert [m.arbitration_id for m in drain(newcomer) if m.arbitration_id < 0x100] == list(range(10))


def test_silent_listeners_keep_hearing(open_node: Open) -> None:
    """A logger never sends: the closing of other ports must not make it forgotten."""
    first, logger = open_node(), open_node()
    third = open_node()
    for turn in range(30):
        first.send(frame(turn))
        if turn == 10:
            third.shutdown()
    assert [m.arbitration_id for m in drain(logger)] == list(range(30))


# ------------------------------------------------------------------------------------------------ ports and bounds


def test_all_ports_taken_is_said_clearly(open_node: Open, base: int) -> None:
    for _ in range(loopbus.NODES):
        open_node()
    with pytest.raises(can.CanInitializationError) as caught:
        open_node()
    text = str(caught.value)
    assert f"all UDP ports {base} to {base + 7} of 127.0.0.1 are taken" in text
    assert "--channel" in text or "another channel" in text
    assert "\n" not in text


def test_a_port_held_by_another_program_is_passed_over(open_node: Open, base: int) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind((HOST, base))
        first, second = open_node(), open_node()
        assert [first.channel_info, second.channel_info] == [f"loopbus {base}, node 1", f"loopbus {base}, node 2"]
        first.send(frame())
        assert second.recv(0.5) is not None


@pytest.mark.parametrize("channel", ["vcan0", "", "80", "1023", "65529", "-1", "29500.5", None, "1e4"])
def test_a_channel_that_is_no_port_is_refused(channel: str | None) -> None:
    with pytest.raises(can.CanInitializationError, match=r"loopbus: channel .* is no port number from 1024 to 65528"):
        LoopBus(channel)


def test_a_program_with_a_bare_udp_socket_can_join(open_node: Open, base: int) -> None:
    """In any language, by what dbc/CONVENTIONS.md says of the bus."""
    node = open_node()
    for _ in range(5):
        node.send(frame(0x7FF))  # to nobody
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as outsider:
        outsider.bind((HOST, base + 1))
        outsider.settimeout(2.0)
        others = [(HOST, base + n) for n in range(8) if n != 1]
        for address in others:
            outsider.sendto(b"", address)
        node.send(frame(0x123, b"\x11\x22\x33"))
        number, length, data = struct.unpack("=IB3x8s", outsider.recv(100))
        assert (number, length, data) == (0x123, 3, b"\x11\x22\x33" + bytes(5))
        for address in others:
            outsider.sendto(struct.pack("=IB3x8s", 0x321, 8, b"abcdefgh"), address)
        answer = node.recv(2.0)
        assert answer is not None
        assert (answer.arbitration_id, bytes(answer.data), answer.is_extended_id) == (0x321, b"abcdefgh", False)


def test_only_the_loopback_address_is_used(open_node: Open) -> None:
    """Where it listens; `HOST` is the one address that it sends to."""
    node = open_node()
    with socket.socket(fileno=os.dup(node.fileno())) as twin:
        assert twin.getsockname()[0] == "127.0.0.1"
    assert loopbus.HOST == "127.0.0.1"


def test_datagrams_that_are_no_frames_and_frames_from_elsewhere_are_dropped(open_node: Open, base: int) -> None:
    node = open_node()
    good = loopbus._FRAME.pack(0x123, 8, b"12345678")
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as member,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger,
    ):
        member.bind((HOST, base + 5))
        stranger.bind((HOST, base + 8))
        for datagram in (b"", b"x", good[:15], good + b"\0", good * 2, loopbus._FRAME.pack(1, 9, b""), bytes(2000)):
            member.sendto(datagram, (HOST, base))
        for _ in range(600):  # more than one call looks at
            stranger.sendto(good, (HOST, base))
        assert [message for _ in range(4) for message in drain(node)] == []
        for _ in range(3):
            stranger.sendto(good, (HOST, base))
            member.sendto(good, (HOST, base))
        assert [bytes(m.data) for m in drain(node)] == [b"12345678"] * 3


def test_a_reader_that_sleeps_costs_bounded_memory_and_nobody_else_s_time(open_node: Open) -> None:
    sender, sleeper, reader = open_node(), open_node(), open_node()
    heard = 0
    for number in range(20_000):
        sender.send(frame(number % 0x700))
        heard += len(drain(reader)) if number % 50 == 0 else 0
    heard += len(drain(reader))
    assert heard == 20_000, "the others hear everything"
    kept = drain(sleeper)
    assert 100 <= len(kept) < 20_000, "the kernel's buffer is the bound"
    assert [m.arbitration_id for m in kept] == [n % 0x700 for n in range(len(kept))], "the oldest are kept, none twice"
    sender.send(frame(0x7AA))
    assert [m.arbitration_id for m in drain(sleeper)] == [0x7AA]


def test_closed_ports_cost_next_to_nothing(open_node: Open) -> None:
    """A frame to one node among six closed ports against one bare datagram, taken in turns."""
    sender, receiver = open_node(), open_node()
    bare_receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    bare = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    with bare, bare_receiver:
        bare_receiver.bind((HOST, 0))
        address = bare_receiver.getsockname()
        message, datagram = frame(), bytes(16)
        pairs = []
        for _ in range(40):
            pairs.append(
                (
                    timeit.timeit(lambda: sender.send(message), number=20),
                    timeit.timeit(lambda: bare.sendto(datagram, address), number=20),
                )
            )
            drain(receiver)
            drain(sender)
            bare_receiver.recv(16)
    assert min(a for a, _ in pairs) < 4 * min(b for _, b in pairs)
