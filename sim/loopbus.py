"""The embedded bus: a python-can interface on UDP datagrams between processes of one machine; no kernel CAN, no server.

    can.Bus(interface="loopbus", channel=29500)      can_logger -i loopbus -c 29500

A bus is eight ports on 127.0.0.1 from the channel's number on. A node binds the first free one and sends every frame
to the others, as one Linux `struct can_frame` a datagram. The kernel holds what a node has not read yet, up to its
buffer's size, and drops what comes then. A node that dies is silence; one that starts on its port is heard at once.

A datagram to a closed port costs twice one to an open port, so a node stops sending to a port whose closing the kernel
reports, and resumes when anything comes from it: every node says hello (an empty datagram) when it opens. For the case
that a hello waits behind frames that nobody reads, one datagram is sent to a closed port now and then.
"""

import errno
import select
import socket
import struct
import sys
import threading
import time
from typing import Any

import can

HOST = "127.0.0.1"
DEFAULT_PORT = 29500
NODES = 8
RECEIVE_BUFFER_BYTES = 4 << 20  # asked for; the kernel may give less (net.core.rmem_max)
RETRY_PERIOD_S = 0.02  # one closed port is tried in each, in turn

_FRAME = struct.Struct("=IB3x8s")  # linux/can.h: struct can_frame
_EXTENDED, _REMOTE, _ERROR = 0x80000000, 0x40000000, 0x20000000
_STANDARD_MASK, _EXTENDED_MASK = 0x7FF, 0x1FFFFFFF
_MAX_DATAGRAMS = 256  # looked at in one call that does not wait; bounds the cost of a flood of foreign ones

_LINUX = sys.platform == "linux"
_SO_TIMESTAMPNS = 35  # asm-generic/socket.h; the socket module does not name it
_TIMESPEC = struct.Struct("@qq") if struct.calcsize("@l") == 8 else struct.Struct("@ll")
_IP_RECVERR = 11  # linux/in.h


class LoopBus(can.BusABC):
    """A node of the embedded bus.

    Args:
        channel: the first of the bus's eight UDP ports.
        can_filters: python-can's software filters.
        receive_own_messages: whether the node hears the frames that it sends.

    """

    def __init__(
        self,
        channel: Any = DEFAULT_PORT,
        can_filters: can.typechecking.CanFilters | None = None,
        receive_own_messages: bool = False,
        **_ignored: object,  # bitrate and the like, which a bus without wires does not have
    ) -> None:
        base = _base_port(channel)
        self._ports = range(base, base + NODES)
        self._socket = _bind_first_free(self._ports)
        self._own_port: int = self._socket.getsockname()[1]
        self._targets = [port for port in self._ports if receive_own_messages or port != self._own_port]
        self._open = set(self._targets)  # until the kernel says otherwise
        self._reading = threading.Lock()  # one thread may send while another receives: what is peeked at must stay
        self._next_retry_s = 0.0
        self._retries = 0
        self.channel_info = f"loopbus {base}, node {self._own_port - base}"
        self._can_protocol = can.CanProtocol.CAN_20
        self._send_to_all(b"")
        super().__init__(channel=base, can_filters=can_filters)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a classical CAN frame to all other nodes; never waits."""
        if msg.is_fd:
            raise can.CanOperationError("loopbus carries classical CAN frames only")
        flags = (
            (_EXTENDED if msg.is_extended_id else 0)
            | (_REMOTE if msg.is_remote_frame else 0)
            | (_ERROR if msg.is_error_frame else 0)
        )
        self._send_to_all(_FRAME.pack(msg.arbitration_id | flags, msg.dlc, bytes(msg.data)))

    def _send_to_all(self, datagram: bytes) -> None:
        if len(self._open) < len(self._targets):
            self._notice_newcomers()
            self._retry_a_closed_port()
        for port in self._targets:
            if port in self._open:
                self._send_to(port, datagram)

    def _send_to(self, port: int, datagram: bytes) -> None:
        for _ in range(NODES):
            try:
                self._socket.sendto(datagram, (HOST, port))
                return
            except ConnectionRefusedError:  # about an earlier datagram; this one has not been sent
                self._forget_closed_ports()
                self._notice_newcomers()  # the port may have opened since
            except OSError as error:
                raise can.CanOperationError(f"loopbus: cannot send: {error.strerror}", error.errno) from error

    def _notice_newcomers(self) -> None:
        """Read the hellos before the first frame that waits, for a node that sends without receiving."""
        for _ in range(_MAX_DATAGRAMS):
            try:
                with self._reading:
                    if self._socket.recv(1, socket.MSG_PEEK):
                        return
                    datagram, ancillary, _flags, address = self._socket.recvmsg(0)
            except ConnectionRefusedError:
                self._forget_closed_ports()
            except OSError:  # nothing waits; anything worse shows when sending
                return
            else:
                self._to_message(datagram, ancillary, address)

    def _retry_a_closed_port(self) -> None:
        now_s = time.monotonic()
        if now_s < self._next_retry_s:
            return
        self._next_retry_s = now_s + RETRY_PERIOD_S
        self._retries += 1
        closed = [port for port in self._targets if port not in self._open]
        if closed:
            self._open.add(closed[self._retries % len(closed)])  # until the kernel says that it is closed still

    def _forget_closed_ports(self) -> None:
        """Read the kernel's reports of ports that took no datagram."""
        for _ in range(_MAX_DATAGRAMS):
            try:
                _data, _ancillary, _flags, address = self._socket.recvmsg(0, 0, socket.MSG_ERRQUEUE)
            except OSError:
                return
            self._open.discard(address[1])

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        deadline_s = None if timeout is None else time.monotonic() + timeout
        while True:
            for _ in range(_MAX_DATAGRAMS):
                try:
                    with self._reading:
                        datagram, ancillary, _flags, address = self._socket.recvmsg(_FRAME.size + 1, 64)
                except BlockingIOError:
                    break
                except ConnectionRefusedError:
                    self._forget_closed_ports()
                    continue
                except OSError as error:
                    raise can.CanOperationError(f"loopbus: cannot receive: {error.strerror}", error.errno) from error
                message = self._to_message(datagram, ancillary, address)
                if message is not None:
                    return message, False
            wait_s = None if deadline_s is None else deadline_s - time.monotonic()
            if wait_s is not None and wait_s <= 0:
                return None, False
            select.select([self._socket], [], [], wait_s)

    def _to_message(self, datagram: bytes, ancillary: list[Any], address: tuple[str, int]) -> can.Message | None:
        """Return the frame in a datagram, None if it is none or comes from elsewhere."""
        host, port = address
        if host != HOST or port not in self._ports:
            return None
        if port in self._targets:
            self._open.add(port)
        if len(datagram) != _FRAME.size:
            return None
        can_id, length, data = _FRAME.unpack(datagram)
        if length > 8:
            return None
        extended = bool(can_id & _EXTENDED)
        remote = bool(can_id & _REMOTE)
        return can.Message(
            timestamp=_arrival_s(ancillary),
            arbitration_id=can_id & (_EXTENDED_MASK if extended else _STANDARD_MASK),
            is_extended_id=extended,
            is_remote_frame=remote,
            is_error_frame=bool(can_id & _ERROR),
            is_rx=port != self._own_port,
            channel=self._ports[0],
            dlc=length,
            data=None if remote else data[:length],
        )

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when a frame has come."""
        return self._socket.fileno()

    def shutdown(self) -> None:
        """Leave the bus; the port is free at once."""
        super().shutdown()
        self._socket.close()


def _base_port(channel: Any) -> int:
    try:
        base = int(channel)
    except (TypeError, ValueError):
        base = -1
    if not 1024 <= base <= 65535 - NODES + 1:
        raise can.CanInitializationError(
            f"loopbus: channel {channel!r} is no port number from 1024 to {65535 - NODES + 1}, e.g. {DEFAULT_PORT}"
        )
    return base


def _bind_first_free(ports: range) -> socket.socket:
    node = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        node.setblocking(False)
        node.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        if _LINUX:
            node.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
            node.setsockopt(socket.IPPROTO_IP, _IP_RECVERR, 1)
        for port in ports:
            try:
                node.bind((HOST, port))
                return node
            except OSError as error:
                if error.errno != errno.EADDRINUSE:
                    raise can.CanInitializationError(f"loopbus: port {port}: {error.strerror}", error.errno) from error
        raise can.CanInitializationError(
            f"loopbus: all UDP ports {ports[0]} to {ports[-1]} of {HOST} are taken; end what holds them or give "
            f"another channel, e.g. {ports[0] + 100}"
        )
    except BaseException:
        node.close()
        raise


def _arrival_s(ancillary: list[tuple[int, int, bytes]]) -> float:
    """Return the kernel's time of arrival, Unix time in s."""
    for level, kind, data in ancillary:
        if level == socket.SOL_SOCKET and kind == _SO_TIMESTAMPNS and len(data) >= _TIMESPEC.size:
            seconds, nanoseconds = _TIMESPEC.unpack_from(data)
            return float(seconds + nanoseconds * 1e-9)
    return time.time()
