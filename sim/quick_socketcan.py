"""SocketCAN by python-can with a quarter of its system calls; what they cost is most of a slow kernel's load."""

from __future__ import annotations

import errno
import select
from collections.abc import Collection
from typing import Any

import can
from can.interfaces.socketcan.socketcan import SocketcanBus, build_can_frame, capture_message


class QuickSocketcanBus(SocketcanBus):
    """python-can's SocketcanBus, which asks the kernel about time and readiness before each transfer; this one tries.

    `recv` and `send` keep their meaning and their errors, but a full queue is refused at once whatever the timeout.
    """

    def __init__(self, channel: str, only_ids: Collection[int] = ()) -> None:
        """Open the channel; with `only_ids` the kernel passes on these 11-bit ids and error frames, nothing else."""
        filters: Any = [{"can_id": i, "can_mask": 0x7FF, "extended": False} for i in sorted(only_ids)]
        super().__init__(channel, can_filters=filters or None)
        self.socket.setblocking(False)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Return the next frame, or None where none has come within `timeout` s (None: wait for ever)."""
        message = self._waiting()
        if message is not None or timeout == 0.0:
            return message
        select.select([self.socket], [], [], timeout)
        return self._waiting()

    def _waiting(self) -> can.Message | None:
        try:
            return capture_message(self.socket)
        except can.CanOperationError as error:
            if error.error_code in {errno.EAGAIN, errno.EINTR}:
                return None
            raise

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a frame. Raises CanOperationError where the kernel refuses it."""
        try:
            self.socket.send(build_can_frame(msg))
        except OSError as error:
            raise can.CanOperationError(f"Failed to transmit: {error.strerror}", error.errno) from error
