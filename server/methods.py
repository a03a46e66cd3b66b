"""With which methods an address can be asked: HEAD wherever GET is taken, and a refusal that names all of them."""

from __future__ import annotations

import anyio
from fastapi import FastAPI
from starlette.routing import Match
from starlette.types import ASGIApp, Message, Receive, Scope, Send

_METHODS = ("GET", "POST", "DELETE")


class Heads:
    """The middleware that answers HEAD with the head of what GET would get; the rest is not waited for, events never end."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or scope["method"] != "HEAD":
            await self._app(scope, receive, send)
            return
        asked = {**scope, "method": "GET"}
        with anyio.CancelScope() as answering:

            async def head_only(message: Message) -> None:
                if message["type"] == "http.response.start":
                    scope["route"] = asked.get("route")  # for who counts by it
                    await send(message)
                    await send({"type": "http.response.body"})
                    answering.cancel()

            await self._app(asked, receive, head_only)


def allowed(app: FastAPI, scope: Scope) -> str:
    """The methods that are taken at this address, as the header Allow has them; a route knows but its own."""
    taken = [method for method in _METHODS if any(route.matches({**scope, "method": method})[0] is Match.FULL for route in app.routes)]
    return ", ".join(["HEAD", *taken] if "GET" in taken else taken)
