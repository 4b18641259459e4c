"""The cycle's view of the bus: bounded drains, refused frames, interfaces that are not there."""

from __future__ import annotations

from collections import deque
from pathlib import Path
from typing import Any

import can
import pytest
from wire_support import base_fixture, frame, open_node_fixture  # noqa: F401 -- fixtures

from firmware_py.bus import FRAMES_PER_DRAIN, Bus, open_bus
from firmware_py.errors import UserError


class FakeDriver:
    """A driver with a queue to read from and a reason to refuse."""

    channel_info = "fake"

    def __init__(self, *frames: can.Message) -> None:
        self.queue = deque(frames)
        self.sent: list[can.Message] = []
        self.refusal: Exception | None = None
        self.closed = False

    def recv(self, timeout: float | None) -> can.Message | None:
        assert timeout == 0, "the cycle never waits for the bus"
        if self.refusal:
            raise self.refusal
        return self.queue.popleft() if self.queue else None

    def send(self, message: can.Message, timeout: float | None = None) -> None:
        assert timeout is None
        if self.refusal:
            raise self.refusal
        self.sent.append(message)

    def shutdown(self) -> None:
        self.closed = True
        if self.refusal:
            raise self.refusal


REFUSALS = [
    can.CanOperationError("Failed to transmit: No buffer space available", 105),
    can.CanOperationError("Transmit buffer full"),
    can.CanError("network is down"),
    OSError(100, "Network is down"),
    BrokenPipeError(32, "Broken pipe"),
]


def wrapped(*frames: can.Message) -> tuple[Bus, Any]:
    driver = FakeDriver(*frames)
    return Bus(driver), driver  # type: ignore[arg-type]


def test_frames_come_out_as_pairs_in_their_order() -> None:
    bus, _ = wrapped(frame(1, b"a"), frame(2, b""), frame(3))
    assert bus.drain() == [(1, b"a"), (2, b""), (3, b"\x01\x02\x03\x04\x05\x06\x07\x08")]
    assert bus.drain() == []


def test_one_drain_is_bounded_and_the_rest_waits() -> None:
    bus, driver = wrapped(*[frame(n % 0x700) for n in range(FRAMES_PER_DRAIN + 10)])
    assert len(bus.drain()) == FRAMES_PER_DRAIN
    assert (len(driver.queue), bus.drains_cut) == (10, 1)
    assert len(bus.drain()) == 10
    assert bus.drains_cut == 1


def test_what_the_dbc_does_not_know_is_counted_and_left_out() -> None:
    """A 29-bit id of the same number, a remote frame, CAN FD, an error frame: none may pass for a message."""
    bus, _ = wrapped(
        frame(0x101, is_extended_id=True),
        can.Message(arbitration_id=0x101, is_remote_frame=True, dlc=8, is_extended_id=False),
        can.Message(arbitration_id=0x101, is_fd=True, data=bytes(8), is_extended_id=False),
        can.Message(arbitration_id=0x101, is_error_frame=True, data=bytes(8), is_extended_id=False),
        frame(0x101),
    )
    assert [number for number, _ in bus.drain()] == [0x101]
    assert (bus.foreign, bus.error_frames) == (3, 1)


@pytest.mark.parametrize("refusal", REFUSALS, ids=repr)
def test_a_driver_that_refuses_is_counted_and_never_fatal(refusal: Exception) -> None:
    bus, driver = wrapped(frame(1))
    driver.refusal = refusal
    assert bus.drain() == []
    assert bus.send([(0x200, bytes(8)), (0x201, bytes(8))]) == 2
    assert (bus.receive_failed, bus.send_failed) == (1, 2)
    driver.refusal = None
    assert bus.drain() == [(1, bytes(frame(1).data))]
    assert bus.send([(0x200, b"12345678")]) == 0
    assert [(m.arbitration_id, bytes(m.data), m.is_extended_id) for m in driver.sent] == [(0x200, b"12345678", False)]
    assert (bus.receive_failed, bus.send_failed) == (1, 2)
    driver.refusal = refusal
    bus.close()
    assert driver.closed


def test_both_ways_over_the_embedded_bus(open_node: Any, base: int) -> None:
    bus, other = open_bus("loopbus", str(base)), open_node()
    try:
        assert bus.description == f"loopbus {base}, node 0"
        assert bus.send([(n, bytes([n])) for n in range(20)]) == 0
        assert [other.recv(0.5).arbitration_id for _ in range(20)] == list(range(20))
        other.send(frame(0x7F, b"xyz"))
        assert bus.drain() == [(0x7F, b"xyz")]
    finally:
        bus.close()


def test_a_peer_that_dies_is_silence(open_node: Any, base: int) -> None:
    bus, other = open_bus("loopbus", str(base)), open_node()
    try:
        other.shutdown()
        for _ in range(100):
            assert bus.send([(0x200, bytes(8))]) == 0
            assert bus.drain() == []
        assert (bus.send_failed, bus.receive_failed) == (0, 0)
    finally:
        bus.close()


@pytest.mark.parametrize(
    ("interface", "channel", "hint"),
    [
        ("socketcan", "none0", "socketcan none0"),
        ("nonsense", "x", "nonsense"),
        ("loopbus", "vcan0", "no port number"),
        ("loopbus", "80", "no port number"),
        ("kvaser", "0", "library of its driver is not installed"),
        ("pcan", "PCAN_USBBUS1", "library"),
        ("vector", "0", "vector 0"),
    ],
)
def test_an_interface_that_is_not_there_is_one_clear_line(
    interface: str, channel: str, hint: str, caplog: pytest.LogCaptureFixture
) -> None:
    with pytest.raises(UserError) as caught:
        open_bus(interface, channel)
    text = str(caught.value)
    assert text.startswith(f"CAN interface {interface} {channel}: cannot be opened (")
    assert hint in text
    assert "\n" not in text
    assert caplog.text == "", "nothing beside the line"


def test_an_interface_without_its_channel_is_refused() -> None:
    """python-can would open its driver's default, which for socketcan is the physical can0."""
    with pytest.raises(UserError, match="--channel: interface socketcan needs one"):
        open_bus("socketcan")


def test_without_options_the_environment_names_the_bus_where_it_may(
    monkeypatch: pytest.MonkeyPatch,
    base: int,
) -> None:
    monkeypatch.setenv("CAN_INTERFACE", "loopbus")
    monkeypatch.setenv("CAN_CHANNEL", str(base))
    bus = open_bus()
    try:
        assert bus.description.startswith(f"loopbus {base},")
    finally:
        bus.close()
    monkeypatch.setenv("CAN_INTERFACE", "socketcan")
    monkeypatch.setenv("CAN_CHANNEL", "can0")
    bus = open_bus(channel=str(base), use_config=False)
    try:
        assert bus.description.startswith(f"loopbus {base},")
    finally:
        bus.close()


def test_without_options_and_settings_the_embedded_bus_is_opened(
    monkeypatch: pytest.MonkeyPatch, base: int, tmp_path: Path
) -> None:
    for name in ("CAN_INTERFACE", "CAN_CHANNEL", "CAN_CONFIG"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    bus = open_bus(channel=str(base))
    try:
        assert bus.description.startswith(f"loopbus {base},")
    finally:
        bus.close()


def test_a_bad_entry_in_the_environment_is_one_clear_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CAN_INTERFACE", "sockettcan")
    with pytest.raises(UserError, match=r"CAN interface .*sockettcan"):
        open_bus()
