"""What a connection may take before it has asked for anything: uvicorn bounds neither how many there are nor how long a head takes."""

from __future__ import annotations

import asyncio

from uvicorn.protocols.http.h11_impl import H11Protocol

from server.settings import Limits


def bounded_protocol(limits: Limits) -> type[asyncio.Protocol]:
    """For uvicorn's `http`: closes a connection on which nothing is answered and no new request's head came whole for `idle_s`
    (at most twice as long), and one beyond `connections_at_once`."""

    class BoundedProtocol(H11Protocol):
        _answered: object = None  # the request that was the last one when it was looked at before
        _next_look: asyncio.TimerHandle | None = None

        def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
            super().connection_made(transport)
            if len(self.connections) > limits.connections_at_once:
                transport.close()
            else:
                self._next_look = self.loop.call_later(limits.idle_s, self._look)

        def connection_lost(self, exc: Exception | None) -> None:
            if self._next_look is not None:
                self._next_look.cancel()
            super().connection_lost(exc)

        def _look(self) -> None:
            if self.cycle is self._answered and (self.cycle is None or self.cycle.response_complete):
                self.transport.close()
            else:
                self._answered = self.cycle
                self._next_look = self.loop.call_later(limits.idle_s, self._look)

    return BoundedProtocol
