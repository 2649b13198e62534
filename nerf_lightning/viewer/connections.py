"""Connections that a stranger can neither overload nor let grow: between websockets and viser."""

import asyncio
import time
from typing import Any

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosedError

from nerf_lightning.viewer import limits
from nerf_lightning.viewer.messages import admitted


class Allowance:
    """So many messages or bytes a second, and so many at once.

    >>> allowance = Allowance(2, at_once=2, now=0.0)
    >>> [allowance.takes(1, now) for now in (0.0, 0.0, 0.0, 0.5, 0.5)]
    [True, True, False, True, False]
    """

    def __init__(self, per_second: int, at_once: int, now: float):
        self.per_second, self.at_once, self.left, self.last = per_second, at_once, float(at_once), now

    def takes(self, count: int, now: float) -> bool:
        """Tell whether so many more are within the allowance at this time (seconds)."""
        self.left = min(self.at_once, self.left + self.per_second * (now - self.last))
        self.last = now
        if self.left < count:
            return False
        self.left -= count
        return True


class GuardedConnection(ServerConnection):
    """viser reads only what passes the gate, and waits for nobody for long."""

    def __init__(self, *arguments: Any, **options: Any):
        super().__init__(*arguments, **options)
        now, messages = time.monotonic(), limits.MOST_MESSAGES_PER_SECOND
        self._messages = Allowance(messages, messages, now)
        self._bytes = Allowance(limits.MOST_BYTES_PER_SECOND, limits.MOST_BYTES_AT_ONCE, now)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Hang up where very many are connected already, be it half."""
        super().connection_made(transport)
        if len(self.server.handlers) > limits.MOST_SOCKETS:
            self.transport.abort()

    def data_received(self, data: bytes) -> None:
        """Read, or hang up on who sends far more than the page: pings are answered before any message is counted."""
        if self._bytes.takes(len(data), time.monotonic()):
            super().data_received(data)
        else:
            self.transport.abort()

    async def recv(self, decode: bool | None = None) -> bytes:  # type: ignore[override]
        """Return the next message that passes the gate."""
        while True:
            raw = await super().recv(decode)
            if not self._messages.takes(1, time.monotonic()):
                await asyncio.sleep(1 / limits.MOST_MESSAGES_PER_SECOND)  # the sender waits, and not those who train
            elif (message := admitted(raw)) is not None:
                return message

    async def send(self, message: Any, text: bool | None = None) -> None:
        """Send, or hang up on who does not take it: viser keeps what waits in memory."""
        try:
            async with asyncio.timeout(limits.SEND_SECONDS):
                await super().send(message, text)
        except TimeoutError:
            self.transport.abort()
            raise ConnectionClosedError(None, None) from None
