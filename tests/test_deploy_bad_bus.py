"""A bus that is not as it should be: one line or a defined fault each, never a hang, never a traceback."""

from __future__ import annotations

import errno
import logging
import os
import signal
import socket
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import pytest

from firmware_py import bus as bus_module
from firmware_py import preflight
from firmware_py.__main__ import DEFAULT_DBC, DEFAULT_TABLES, main
from firmware_py.bus import FRAMES_PER_DRAIN, Bus
from firmware_py.codec import INPUT_MESSAGES, Sender, load_codec
from firmware_py.core.controller import PERIOD_S
from firmware_py.core.signals import MODE_MANUAL, MODE_READY
from firmware_py.loop import Loop, RunResult
from firmware_py.node import ControllerNode, build_tables
from firmware_py.rates import RateWatch
from firmware_py.realtime import Outcome
from firmware_py.table_file import load_tables

CODEC = load_codec(DEFAULT_DBC)
TABLE_SET = load_tables(DEFAULT_TABLES, "left", "car", PERIOD_S, DEFAULT_DBC.parent)
ORDINARY = Outcome("normal priority as asked, gc frozen", False, False, {}, None)
Frame = tuple[int, bytes]


# ------------------------------------------------------------------------------------------------- opening SocketCAN


@pytest.mark.parametrize(
    ("number", "line"),
    [
        (errno.ENODEV, "there is no such interface; `ip link` lists those that there are"),
        (errno.ENETDOWN, "the interface is down: "),
        (errno.EPERM, "no permission for raw CAN sockets"),
        (errno.EACCES, "no permission for raw CAN sockets"),
        (errno.EAFNOSUPPORT, "this kernel has no SocketCAN: load the modules can and can_raw, or use -i loopbus"),
        (errno.EIO, "[Errno 5] Input/output error"),
    ],
)
def test_what_the_kernel_refuses_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], number: int, line: str
) -> None:
    def refuse(**_: object) -> None:
        # python-can's driver logs what it raises, beside raising it.
        logging.getLogger("can.socketcan").error("Could not access SocketCAN device can7")
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(can, "Bus", refuse)
    assert main(["-i", "socketcan", "-c", "can7", "--no-config"]) == 2
    error = capfd.readouterr().err
    assert error.startswith(f"parkctl: error: CAN interface socketcan can7: cannot be opened ({line}")
    assert len(error.splitlines()) == 1


def test_an_interface_that_is_down_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """The kernel lets a socket be bound to it, and then nothing ever comes."""
    (tmp_path / "can7").mkdir()
    (tmp_path / "can7" / "flags").write_text("0x40080")
    (tmp_path / "can7" / "type").write_text("280")
    monkeypatch.setattr(preflight, "SYS_NET", tmp_path)
    monkeypatch.setattr(can, "Bus", lambda **_: Driver(lambda _: []))
    assert main(["-i", "socketcan", "-c", "can7", "--no-config"]) == 2
    line = "parkctl: error: not to be armed: interface: can7 is down: ip link set can7 up type can bitrate 500000"
    assert capfd.readouterr().err.startswith(line)


def test_the_kernel_is_asked_for_the_dbcs_ids_only_and_preflight_hears_all(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[dict[str, object]] = []

    def open_driver(**options: object) -> None:
        asked.append(options)
        raise OSError(errno.ENODEV, "No such device")

    monkeypatch.setattr(can, "Bus", open_driver)
    bus = ["-i", "socketcan", "-c", "can7", "--no-config"]
    for options in ([], ["--listen-only"], ["--preflight"]):
        assert main([*bus, *options]) == 2
    everything, inputs, unfiltered = asked
    expected = sorted(info.frame_id for info in CODEC.messages.values())
    assert everything["can_filters"] == [{"can_id": i, "can_mask": 0x7FF, "extended": False} for i in expected]
    filters = inputs["can_filters"]
    assert isinstance(filters, list)
    assert [entry["can_id"] for entry in filters] == sorted(CODEC.messages[name].frame_id for name in INPUT_MESSAGES)
    assert "can_filters" not in unfiltered


# ------------------------------------------------------------------------------------------------ a loop on a bad bus


class Driver:
    """A driver of python-can whose traffic `traffic(cycle)` decides; it ends the loop after so many drains."""

    channel_info = "fake"

    def __init__(
        self, traffic: Callable[[int], list[Frame]], cycles: int = 100, fails: Exception | None = None
    ) -> None:
        self._traffic = traffic
        self._cycles = cycles
        self._fails = fails
        self._queue: deque[Frame] = deque()
        self._cycle = 0
        self.calls = 0

    def recv(self, timeout: float | None) -> can.Message | None:
        assert timeout == 0
        self.calls += 1
        if self._fails:
            self._end_of_drain()
            raise self._fails
        if not self._queue:
            self._queue.extend(self._traffic(self._cycle))
            self._queue.append((-1, b""))
        number, data = self._queue.popleft()
        if number < 0:
            self._end_of_drain()
            return None
        return can.Message(arbitration_id=number, data=data, is_extended_id=False)

    def _end_of_drain(self) -> None:
        self._cycle += 1
        if self._cycle == self._cycles:
            signal.raise_signal(signal.SIGTERM)

    def send(self, _message: can.Message) -> None:
        if self._fails:
            raise self._fails

    def shutdown(self) -> None:
        pass


@pytest.fixture(autouse=True)
def no_listening_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("firmware_py.loop.LISTEN_NS", 0)


def run(driver: Driver, monkeypatch: pytest.MonkeyPatch) -> tuple[RunResult, list[int]]:
    """Run the loop to its end; return the result and the modes seen."""
    # Virtual time: every cycle wakes at its deadline, so that a late test machine is no late controller.
    monkeypatch.setattr(Loop, "_wait_until", lambda _self, deadline_ns: deadline_ns)
    node = ControllerNode(CODEC, build_tables(TABLE_SET, CODEC))
    modes: list[int] = []
    cycle = node.cycle

    def watched(now_ns: int, frames: list[Frame], overruns: int, send_failed: int = 0) -> list[Frame]:
        out = cycle(now_ns, frames, overruns, send_failed)
        modes.append(node.seen().mode)
        return out

    monkeypatch.setattr(node, "cycle", watched)
    bus = Bus(driver, "virtual", "x")  # type: ignore[arg-type]
    loop = Loop(node, bus, RateWatch(CODEC.messages, 10), realtime=ORDINARY, once=False, status_fd=None)
    return loop.run(), modes


def car(version_hash: int = TABLE_SET.vehicle_hash24, shift: int = 0) -> Callable[[int], list[Frame]]:
    """Reports of a car that stands ready at the start; `shift` moves its ids, as another DBC would."""
    sender = Sender(CODEC)
    leg = TABLE_SET.legs[0]
    values = {
        "VEH_SysRpt": {"vehicle_state": 1},
        "VEH_SteerRpt": {"steer_angle_valid": 1},
        "VEH_MotionRpt": {"speed_valid": 1, "yaw_rate_valid": 1},
        "VEH_LongRpt": {"gear_rpt": 1, "park_brake_applied": 1, "standstill": 1},
        "LOC_Position": {"position_x_m": leg.x_m[0], "position_y_m": leg.y_m[0], "position_quality": 3},
        "LOC_Attitude": {"yaw_rad": leg.yaw_rad[0], "yaw_quality": 3},
        "OPER_Cmd": {},
        "VEH_Version": {"veh_protocol": 1, "veh_dbc_hash": CODEC.dbc_hash24, "veh_vehicle_hash": version_hash},
    }

    def traffic(cycle: int) -> list[Frame]:
        frames = []
        for name, known in values.items():
            info = CODEC.messages[name]
            if cycle % (info.cycle_time_ms // 10) == 0:
                struct = info.struct._make([0] * len(info.struct._fields))._replace(**known)  # type: ignore[attr-defined]
                number, data = sender.pack(name, struct)
                frames.append((number + shift, data))
        return frames

    return traffic


def test_a_flood_of_foreign_ids_costs_a_bounded_drain_and_hides_no_report(monkeypatch: pytest.MonkeyPatch) -> None:
    """As many frames in front of every report as the fastest bus can carry in a cycle."""
    reports = car()
    flood = [(0x7F0, b"")] * 213
    driver = Driver(lambda cycle: flood + reports(cycle), cycles=150)
    result, modes = run(driver, monkeypatch)
    assert max(modes) == MODE_READY, result.final["reason_text"]
    assert result.final["frames_foreign"] >= 149 * 213
    assert (result.final["frames_rejected"], result.final["frames_lost"], result.final["drains_cut"]) == (0, 0, 0)


def test_a_drain_ends_at_its_bound_which_no_can_bus_reaches() -> None:
    shortest_frame_bits = 47  # 11-bit id, no data, no stuff bit, with the space after it
    assert 1_000_000 / shortest_frame_bits * PERIOD_S < FRAMES_PER_DRAIN
    driver = Driver(lambda _: [(0x7F0, b"")] * 5000, cycles=-1)
    bus = Bus(driver, "virtual", "x")  # type: ignore[arg-type]
    assert len(bus.drain()) == driver.calls == FRAMES_PER_DRAIN
    assert bus.drains_cut == 1


def test_an_endless_flood_does_not_hang_the_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten thousand frames behind every one that is read: a bus can only do that where it is emulated."""
    driver = Driver(lambda _: [(0x7F0, b"")] * 10_000, cycles=-1)
    monkeypatch.setattr(driver, "_end_of_drain", lambda: None)
    drains = 0
    drain = Bus.drain

    def counted(self: Bus) -> list[Frame]:
        nonlocal drains
        drains += 1
        if drains == 30:
            signal.raise_signal(signal.SIGTERM)
        return drain(self)

    monkeypatch.setattr(Bus, "drain", counted)
    result, modes = run(driver, monkeypatch)
    assert set(modes) == {MODE_MANUAL}
    assert result.final["reason_text"].startswith("waiting for reports")
    assert result.final["drains_cut"] >= 30


@pytest.mark.parametrize(
    "error",
    [can.CanOperationError("Error receiving: Network is down", errno.ENETDOWN), OSError(errno.ENETDOWN, "down")],
)
def test_an_interface_that_goes_down_is_silence_that_is_counted(
    monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    result, modes = run(Driver(lambda _: [], cycles=60, fails=error), monkeypatch)
    assert set(modes) == {MODE_MANUAL}
    assert result.final["reason_text"].startswith("waiting for reports")
    assert result.final["receive_failed"] >= 60
    assert result.final["send_failed"] > 300
    assert result.final["frames_sent"] == 0


def test_a_car_with_other_ids_is_never_armed(monkeypatch: pytest.MonkeyPatch) -> None:
    result, modes = run(Driver(car(shift=0x400 - 0x020), cycles=150), monkeypatch)
    assert set(modes) == {MODE_MANUAL}
    assert result.final["reason_text"].startswith("waiting for reports")


def test_a_car_with_other_parameters_is_never_armed_and_that_is_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    result, modes = run(Driver(car(version_hash=1), cycles=150), monkeypatch)
    assert set(modes) == {MODE_MANUAL}
    assert result.final["reason_text"].startswith("the tables are for other vehicle parameters")


def test_a_car_at_half_its_rate_is_never_armed_and_that_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every report keeps its timeout, and yet nothing is driven with it."""
    reports = car()
    result, modes = run(Driver(lambda cycle: reports(cycle // 2) if cycle % 2 == 0 else [], cycles=250), monkeypatch)
    assert modes[-1] == MODE_MANUAL
    assert result.final["reason_text"].startswith("waiting for reports")
    assert any(text.startswith("VEH_SteerRpt comes every 2") for text in result.final["held_reports"])


# ----------------------------------------------------------------------------------------- the raw socket's short cut


@pytest.fixture
def pair() -> Iterator[tuple[socket.socket, socket.socket]]:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        yield ours, theirs


def test_the_short_cut_is_bounded_too(pair: tuple[socket.socket, socket.socket]) -> None:
    ours, theirs = pair
    frame = bus_module._CAN_FRAME.pack(0x7F0, 0, b"")
    theirs.setblocking(False)
    sent = 0
    while sent < FRAMES_PER_DRAIN + 20:
        try:
            theirs.send(frame)
        except BlockingIOError:
            break
        sent += 1
    bus = Bus(Driver(lambda _: []), "socketcan", "vcan0")  # type: ignore[arg-type]
    bus._socket = ours
    assert len(bus.drain()) == min(sent, FRAMES_PER_DRAIN)
    assert bus.drains_cut == (1 if sent >= FRAMES_PER_DRAIN else 0)
