"""Sockets with a deadline.

A socket's own limit begins anew with every byte, so that whoever drips a header would hold the other side for hours.
"""

from __future__ import annotations

import io
import math
import socket
import time
from typing import Any


class Patient:
    """A socket as `http` uses it, whose reading and writing in all end at `until` (of time.monotonic)."""

    def __init__(self, connection: socket.socket):
        self.connection, self.until = connection, math.inf

    def makefile(self, _mode: str = "rb") -> io.BufferedReader:
        """For reading; it may outlive `close`, as a socket's does."""
        return io.BufferedReader(_Stream(self, self.connection.makefile("rb", buffering=0)))

    def sendall(self, data: bytes) -> None:
        """Writes all of it."""
        self.set_limit()
        self.connection.sendall(data)

    def close(self) -> None:
        """Ends the connection once nothing reads from it any more."""
        self.connection.close()

    def set_limit(self) -> None:
        """Lets the next operation of the socket last as long as there is time."""
        left = self.until - time.monotonic()
        if left <= 0:
            raise TimeoutError
        self.connection.settimeout(None if left == math.inf else left)


class _Stream(io.RawIOBase):
    def __init__(self, owner: Patient, stream: socket.SocketIO):
        self.owner, self.stream = owner, stream

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int | None:
        self.owner.set_limit()
        return self.stream.readinto(buffer)

    def close(self) -> None:
        self.stream.close()
        super().close()
