"""Which CAN bus a run uses: python-can's own names, and the guard before anything that could be a real car."""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import time
from collections.abc import Collection, Iterator, Mapping
from typing import TYPE_CHECKING, NamedTuple

from sim.errors import UserError

if TYPE_CHECKING:
    import argparse

    import can

DEFAULT_INTERFACE = "loopbus"
DEFAULT_LOOPBUS_CHANNEL = "29500"


class BusChoice(NamedTuple):
    """A bus by python-can's names; None in `bitrate` leaves the interface's own."""

    interface: str
    channel: str
    bitrate: int | None

    def arguments(self) -> list[str]:
        """Return the choice as command-line arguments of the controller's and the plant's process."""
        bitrate = [] if self.bitrate is None else ["-b", str(self.bitrate)]
        return ["-i", self.interface, "-c", self.channel, *bitrate]

    def __str__(self) -> str:
        return f"{self.interface} {self.channel}"


def add_bus_arguments(parser: argparse.ArgumentParser, *, default_text: str) -> None:
    """Add -i, -c and -b, named and meant as in python-can's own tools."""
    group = parser.add_argument_group("CAN bus (python-can's names)")
    group.add_argument("-i", "--interface", help=f"loopbus, socketcan, kvaser, pcan, vector, ... ({default_text})")
    group.add_argument("-c", "--channel", help="base UDP port of loopbus (29500), vcan0, can0, ...")
    group.add_argument("-b", "--bitrate", type=int, help="bit/s, where the interface sets it (the DBC says 500000)")


def choose_own_bus(interface: str | None, channel: str | None, bitrate: int | None) -> BusChoice:
    """Return the bus of a run that plays the car itself: the embedded one unless another is named in full.

    CAN_* variables and can.conf files are for real cars and do not count here. Raises UserError for a bus that only
    one process can see, and for a physical interface whose channel is not named.
    """
    if interface is None:
        if channel is not None and not channel.isdigit():
            raise UserError(f"-c {channel}: loopbus takes a port number; name the interface too, as in -i socketcan")
        interface = DEFAULT_INTERFACE
    if interface == "virtual":
        raise UserError("-i virtual: that bus ends at its own process; use loopbus between processes")
    if channel is None:
        if interface != DEFAULT_INTERFACE:
            raise UserError(f"-i {interface}: name the channel too, as in -c vcan0; a physical bus is never guessed")
        channel = DEFAULT_LOOPBUS_CHANNEL
    return BusChoice(interface, channel, bitrate)


def environment_without_can_settings() -> dict[str, str]:
    """Return the environment for a process that must not pick up a bus from CAN_* variables."""
    return {name: value for name, value in os.environ.items() if not name.startswith("CAN_")}


def open_bus(
    interface: str | None,
    channel: str | None,
    bitrate: int | None,
    *,
    ignore_settings: bool,
    only_ids: Collection[int] = (),
) -> can.BusABC:
    """Open a bus; with `ignore_settings` neither CAN_* variables nor can.conf files are read.

    With `only_ids` the kernel passes on these 11-bit ids only, where the interface is SocketCAN and named in full.
    Raises UserError, one line, where the interface, the channel or the settings are wrong.
    """
    import can  # noqa: PLC0415

    logging.getLogger("can").setLevel(logging.CRITICAL)  # what went wrong is said once, in the error below
    settings = {"interface": interface, "channel": channel, "bitrate": bitrate}
    given = {name: value for name, value in settings.items() if value is not None}
    name = " ".join(str(value) for value in (interface, channel) if value is not None) or "the configured bus"
    try:
        if interface == "socketcan" and channel is not None:
            from sim.quick_socketcan import QuickSocketcanBus  # noqa: PLC0415

            return QuickSocketcanBus(channel, only_ids)
        return can.Bus(ignore_config=ignore_settings, **given)  # type: ignore[arg-type]
    except OSError as error:
        if error.errno == errno.EAFNOSUPPORT:
            raise UserError(f"{name}: this kernel has no SocketCAN; -i loopbus needs none") from None
        if error.errno == errno.ENODEV:
            raise UserError(f"{name}: there is no such CAN interface (see: ip link)") from None
        raise UserError(f"{name}: {error.strerror or error}") from None
    except (can.CanError, ImportError, NotImplementedError, TypeError, ValueError) as error:
        raise UserError(f"{name}: {' '.join(str(error).split())}") from None


def refuse_occupied_bus(bus: can.BusABC, choice: BusChoice, frame_ids: Mapping[str, int], listen_s: float) -> None:
    """Listen for a while and raise UserError where somebody already plays a part on this bus.

    `frame_ids`: id of each message; the part of a message's name before `_` is the node that sends it.
    """
    nodes = {"CTRL": "a controller", "VEH": "a vehicle", "LOC": "a localisation", "OPER": "an operator station"}
    names = {frame_id: name for name, frame_id in frame_ids.items()}
    end = time.monotonic() + listen_s
    while (rest := end - time.monotonic()) > 0:
        message = bus.recv(rest)
        if message is None or message.is_error_frame or message.arbitration_id not in names:
            continue
        name = names[message.arbitration_id]
        raise UserError(
            f"{choice}: {nodes.get(name.partition('_')[0], 'somebody')} already sends there ({name}); "
            "end it, or take another channel with -c"
        )


@contextlib.contextmanager
def opened(bus: can.BusABC) -> Iterator[can.BusABC]:
    """Close the bus at the end of the block, whatever happens."""
    try:
        yield bus
    finally:
        bus.shutdown()
