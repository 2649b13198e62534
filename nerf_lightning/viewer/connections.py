"""Connections that a stranger can neither overload nor let grow: between websockets and viser."""

import asyncio
import time
from typing import Any

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosedError

from nerf_lightning.viewer import limits
from nerf_lightning.viewer.messages import admitted


class Allowance:
    """So many messages a second, and as many at once.

    >>> allowance = Allowance(2, now=0.0)
    >>> [allowance.takes(now) for now in (0.0, 0.0, 0.0, 0.5, 0.5)]
    [True, True, False, True, False]
    """

    def __init__(self, per_second: int, now: float):
        self.per_second, self.left, self.last = per_second, float(per_second), now

    def takes(self, now: float) -> bool:
        """Tell whether one more is within the allowance at this time (seconds)."""
        self.left = min(self.per_second, self.left + self.per_second * (now - self.last))
        self.last = now
        if self.left < 1:
            return False
        self.left -= 1
        return True


class GuardedConnection(ServerConnection):
    """viser reads only what passes the gate, and waits for nobody for long."""

    def __init__(self, *arguments: Any, **options: Any):
        super().__init__(*arguments, **options)
        self._allowance = Allowance(limits.MOST_MESSAGES_PER_SECOND, time.monotonic())

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Hang up where very many are connected already, be it half."""
        super().connection_made(transport)
        if len(self.server.handlers) > limits.MOST_SOCKETS:
            self.transport.abort()

    async def recv(self, decode: bool | None = None) -> bytes:  # type: ignore[override]
        """Return the next message that passes the gate."""
        while True:
            raw = await super().recv(decode)
            if self._allowance.takes(time.monotonic()) and (message := admitted(raw)) is not None:
                return message

    async def send(self, message: Any, text: bool | None = None) -> None:
        """Send, or hang up on who does not take it: viser keeps what waits in memory."""
        try:
            async with asyncio.timeout(limits.SEND_SECONDS):
                await super().send(message, text)
        except TimeoutError:
            self.transport.abort()
            raise ConnectionClosedError(None, None) from None
