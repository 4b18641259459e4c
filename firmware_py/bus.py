"""The CAN bus as the cycle sees it: drain all that has come, send what is due; no thread, no waiting, no exception."""

import contextlib
import errno
import logging
import socket
import struct
from collections.abc import Collection, Iterable
from typing import TYPE_CHECKING, NamedTuple

from firmware_py.errors import UserError

if TYPE_CHECKING:
    from can import BusABC

DEFAULT_INTERFACE = "loopbus"
FRAMES_PER_DRAIN = 256
"""Bound of one drain: a flooded bus costs the cycle a bounded time; the rest waits for the next cycle."""

EMULATED_INTERFACES = frozenset({DEFAULT_INTERFACE, "virtual"})
EMULATED_CHANNEL_PREFIX = "vcan"

Frame = tuple[int, bytes]

_CAN_FRAME = struct.Struct("=IB3x8s")
"""struct can_frame of linux/can.h: id with flags, length, data."""
_ERROR_FLAG = 0x20000000
_OTHER_KIND_FLAGS = 0xC0000000
"""29-bit id, remote frame."""
_LONGEST_FRAME = 72


class Heard(NamedTuple):
    """One frame of any kind with its arrival time by the driver's clock, s (0 where the driver gives none)."""

    stamp_s: float
    arbitration_id: int
    data: bytes
    bits: int
    is_error: bool
    is_plain: bool


class Bus:
    """One open interface. All counts are since start.

    `interface`, `channel`, `bitrate` are python-can's names of it, the bit rate only where one was given.
    `sent`: frames given to the driver. `error_frames`: error frames received. `foreign`: frames of a kind that the DBC
    does not know (29-bit id, remote, CAN FD). `drains_cut`: drains that ended at their bound. `receive_failed`,
    `send_failed`: calls that the driver refused (bus off, interface down, full queue); to the cycle they are silence,
    which its timeouts judge.
    """

    is_listening_only = False

    def __init__(self, bus: "BusABC", interface: str = "", channel: str = "", bitrate: int | None = None) -> None:
        from can import CanError, Message  # noqa: PLC0415 -- heavy; see open_bus

        self.interface = interface
        self.channel = channel
        self.bitrate = bitrate
        self._bus = bus
        self._message = Message
        self._driver_errors = (CanError, OSError)
        # python-can's recv and send make four system calls a frame (poll and clocks beside the transfer); on SocketCAN
        # its socket is used directly, with one.
        is_socketcan = type(bus).__module__.startswith("can.interfaces.socketcan")
        self._socket: socket.socket | None = getattr(bus, "socket", None) if is_socketcan else None
        self.error_frames = 0
        self.foreign = 0
        self.drains_cut = 0
        self.receive_failed = 0
        self.send_failed = 0
        self.sent = 0

    @property
    def description(self) -> str:
        """What the driver says it is connected to."""
        return str(self._bus.channel_info)

    @property
    def is_physical(self) -> bool:
        """Whether a real car may be on the other end: everything that is not known to be emulated."""
        return self.interface not in EMULATED_INTERFACES and not self.channel.startswith(EMULATED_CHANNEL_PREFIX)

    def drain(self) -> list[Frame]:
        """Return all frames that wait, oldest first, at most FRAMES_PER_DRAIN."""
        if self._socket is not None:
            return self._drain_socket(self._socket)
        frames: list[Frame] = []
        for _ in range(FRAMES_PER_DRAIN):
            try:
                message = self._bus.recv(0)
            except self._driver_errors:
                self.receive_failed += 1
                return frames
            if message is None:
                return frames
            if message.is_error_frame:
                self.error_frames += 1
            elif message.is_extended_id or message.is_remote_frame or message.is_fd:
                self.foreign += 1
            else:
                frames.append((message.arbitration_id, bytes(message.data)))
        self.drains_cut += 1
        return frames

    def hear(self) -> list[Heard]:
        """Return all frames that wait, of every kind, with their stamps; bounded like `drain`, and slower."""
        heard: list[Heard] = []
        for _ in range(FRAMES_PER_DRAIN):
            try:
                message = self._bus.recv(0)
            except self._driver_errors:
                self.receive_failed += 1
                return heard
            if message is None:
                return heard
            self.error_frames += message.is_error_frame
            plain = not (message.is_extended_id or message.is_remote_frame or message.is_fd)
            data = bytes(message.data)
            bits = frame_bits(len(data), extended=message.is_extended_id)
            error = message.is_error_frame
            heard.append(Heard(message.timestamp, message.arbitration_id, data, bits, error, plain and not error))
        self.drains_cut += 1
        return heard

    def _drain_socket(self, can_socket: socket.socket) -> list[Frame]:
        frames: list[Frame] = []
        for _ in range(FRAMES_PER_DRAIN):
            try:
                content = can_socket.recv(_LONGEST_FRAME, socket.MSG_DONTWAIT)
            except BlockingIOError:
                return frames
            except OSError:
                self.receive_failed += 1
                return frames
            if len(content) != _CAN_FRAME.size:
                self.foreign += 1
                continue
            can_id, length, data = _CAN_FRAME.unpack(content)
            if can_id & _ERROR_FLAG:
                self.error_frames += 1
            elif can_id & _OTHER_KIND_FLAGS:
                self.foreign += 1
            else:
                frames.append((can_id, data[:length]))
        self.drains_cut += 1
        return frames

    def send(self, frames: Iterable[Frame]) -> int:
        """Send the frames in their order; return how many of them the driver refused."""
        failed = sent = 0
        for arbitration_id, data in frames:
            try:
                if self._socket is not None:
                    self._socket.send(_CAN_FRAME.pack(arbitration_id, len(data), data), socket.MSG_DONTWAIT)
                else:
                    self._bus.send(self._message(arbitration_id=arbitration_id, data=data, is_extended_id=False))
                sent += 1
            except self._driver_errors:
                failed += 1
        self.sent += sent
        self.send_failed += failed
        return failed

    def close(self) -> None:
        """Give the interface back."""
        with contextlib.suppress(*self._driver_errors):
            self._bus.shutdown()


class ListeningBus(Bus):
    """A bus to which nothing is ever sent, and on which another controller may drive: its frames are not heard."""

    is_listening_only = True
    only_ids: Collection[int] = frozenset()

    def drain(self) -> list[Frame]:
        """Return the frames that wait, without those of other ids."""
        return [frame for frame in super().drain() if frame[0] in self.only_ids]

    def send(self, frames: Iterable[Frame]) -> int:
        """Send nothing."""
        return 0


def frame_bits(data_bytes: int, *, extended: bool = False) -> int:
    """Return the greatest length of a frame on the wire, bits: with the most stuff bits and the space after it.

    Source: ISO 11898-1; 34 (54) bits before the data are subject to stuffing, one after each run of five.
    """
    stuffed = (54 if extended else 34) + 8 * data_bytes
    return stuffed + 13 + (stuffed - 1) // 4


def open_bus(
    interface: str | None = None,
    channel: str | None = None,
    bitrate: int | None = None,
    *,
    use_config: bool = True,
    only_ids: Collection[int] = (),
    listen_only: bool = False,
) -> Bus:
    """Open the bus that the options name, in python-can's terms.

    What is None comes from python-can's own configuration (CAN_* variables, can.conf) where `use_config` allows it;
    without any of it the embedded bus is opened. With `only_ids` the kernel passes on these 11-bit ids only, where the
    driver has filters of the kernel: what others flood the bus with then costs the cycle nothing. With `listen_only`
    nothing is ever sent, and `only_ids` alone are heard, whatever the driver. Raises UserError.
    """
    import can  # noqa: PLC0415 -- heavy, and the tests of everything else do without it

    logging.getLogger("can").setLevel(logging.CRITICAL)  # drivers also log what they raise; one line is enough
    options: dict[str, object] = {"interface": interface, "channel": channel, "bitrate": bitrate}
    options = {key: value for key, value in options.items() if value is not None}
    try:
        if use_config:
            configured = {**can.util.load_file_config(), **can.util.load_environment_config(), **can.rc}
            if not configured.get("interface"):
                options.setdefault("interface", DEFAULT_INTERFACE)
            options = {key: value for key, value in can.util.load_config(config=options).items() if value is not None}
        options.setdefault("interface", DEFAULT_INTERFACE)
        if options["interface"] != DEFAULT_INTERFACE and "channel" not in options:
            # python-can would take its driver's default, which for socketcan is the physical can0.
            raise UserError(f"--channel: interface {options['interface']} needs one, e.g. --channel vcan0")
        if options["interface"] == "socketcan" and only_ids:
            # Filters nowhere else: python-can's recv(0) ends at a frame that its software filter drops, with more
            # frames waiting. SocketCAN's filters are the kernel's; error frames have a filter of their own.
            options["can_filters"] = [{"can_id": i, "can_mask": 0x7FF, "extended": False} for i in sorted(only_ids)]
        bus = can.Bus(ignore_config=True, **options)  # type: ignore[arg-type]
    except UserError:
        raise
    except Exception as error:  # drivers raise anything for hardware or libraries that are not there, NameError too
        name = f"{options.get('interface', DEFAULT_INTERFACE)} {options.get('channel', '')}".strip()
        raise UserError(f"CAN interface {name}: cannot be opened ({_reason(error, options)})") from None
    given = options.get("bitrate")
    names = (str(options["interface"]), str(options.get("channel", "")), given if isinstance(given, int) else None)
    if not listen_only:
        return Bus(bus, *names)
    silent = ListeningBus(bus, *names)
    silent.only_ids = frozenset(only_ids)
    return silent


def _reason(error: Exception, options: dict[str, object]) -> str:
    """Return what is wrong and what would be right, in one line."""
    if isinstance(error, OSError) and error.errno in _OPEN_ERRORS:
        return _OPEN_ERRORS[error.errno]
    if isinstance(error, NotImplementedError) and options.get("interface") == DEFAULT_INTERFACE:
        return "the embedded bus comes with the emulator and is not installed here; name a bus, as in -i socketcan"
    if isinstance(error, (NameError, ImportError)):  # kvaser's way of saying that its library is missing
        return "the library of its driver is not installed"
    return " ".join(str(error).split()) or type(error).__name__


_OPEN_ERRORS = {
    errno.EAFNOSUPPORT: "this kernel has no SocketCAN: load the modules can and can_raw, or use -i loopbus",
    errno.ENODEV: "there is no such interface; `ip link` lists those that there are",
    errno.ENETDOWN: "the interface is down: `ip link set CHANNEL up`",
    errno.EPERM: "no permission for raw CAN sockets",
    errno.EACCES: "no permission for raw CAN sockets",
}
