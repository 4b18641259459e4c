"""What the tests of the wire share: free channels of the embedded bus, nodes that are closed at the end, frames."""

from __future__ import annotations

import itertools
import os
import socket
from collections.abc import Callable, Iterator

import can
import pytest

from sim import loopbus

HOST = "127.0.0.1"
Open = Callable[..., can.BusABC]

# Below the range from which the kernel takes ports by itself; each test worker has 1000 of its own.
_WORKER = int("".join(filter(str.isdigit, os.environ.get("PYTEST_XDIST_WORKER", ""))) or 0) % 8
_BASES = itertools.cycle(range(20000 + 1000 * _WORKER, 20990 + 1000 * _WORKER, 10))


def free_base() -> int:
    """Return a channel whose eight ports are free."""
    for base in itertools.islice(_BASES, 99):
        probes = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(loopbus.NODES)]
        try:
            for offset, probe in enumerate(probes):
                probe.bind((HOST, base + offset))
        except OSError:
            continue
        else:
            return base
        finally:
            for probe in probes:
                probe.close()
    raise AssertionError("no free ports")


@pytest.fixture(name="base")
def base_fixture() -> int:
    return free_base()


@pytest.fixture(name="open_node")
def open_node_fixture(base: int) -> Iterator[Open]:
    nodes: list[can.BusABC] = []

    def open_node(**options: object) -> can.BusABC:
        nodes.append(can.Bus(interface="loopbus", channel=str(base), ignore_config=True, **options))
        return nodes[-1]

    yield open_node
    for node in nodes:
        node.shutdown()


def frame(number: int = 0x123, data: bytes = b"\x01\x02\x03\x04\x05\x06\x07\x08", **kinds: object) -> can.Message:
    return can.Message(arbitration_id=number, data=data, **{"is_extended_id": False, **kinds})


def drain(bus: can.BusABC) -> list[can.Message]:
    frames = []
    while (message := bus.recv(0)) is not None:
        frames.append(message)
    return frames
