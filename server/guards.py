"""What stands before every route: who may ask, how much may be sent and how slowly, and what a browser is told to beware of."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import hmac
import ipaddress
import math
import re
import time
from typing import Annotated
from urllib.parse import urlsplit

from fastapi import HTTPException, Request, Security
from fastapi.security import APIKeyHeader
from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from server.settings import Limits

KEY_HEADER = "X-API-Key"
UPLOAD_PATH = "/api/v1/clips"
_CHANGING = ("POST", "PUT", "PATCH", "DELETE")
_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=()",
}
_DRAIN_BYTES = 8 * 2**20
_DRAIN_S = 2.0
_KEY = APIKeyHeader(name=KEY_HEADER, auto_error=False, description="for what changes something, where a key is configured")


def require_key(request: Request, key: Annotated[str | None, Security(_KEY)]) -> None:
    """Refuse what changes something without the configured key; digests are compared, in a time that tells nothing of it."""
    wanted = request.app.state.service.settings.api_key
    if wanted is not None and not same_key(key or "", wanted):
        raise HTTPException(401, f"this needs the service's key in the header {KEY_HEADER}", {"WWW-Authenticate": KEY_HEADER})


def same_key(given: str, wanted: str) -> bool:
    """Compared in constant time, as digests, so that not even the length shows."""
    digests = [hashlib.sha256(key.encode()).digest() for key in (given, wanted)]
    return hmac.compare_digest(*digests)


def is_public_name(name: str) -> bool:
    """Whether this is how a browser names a host: HOST or HOST:PORT in small letters, nothing around it."""
    return re.fullmatch(r"([a-z0-9_.-]+|\[[0-9a-f:]+\])(:[0-9]+)?", name) is not None


def is_loopback(host: str) -> bool:
    """Whether a name or an address can mean nothing but this machine."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


class Guards:
    """The middleware around the whole service.

    A browser that was led here from another site must not act for its user: a changing request of another origin is
    refused, and, where only this machine is meant to ask, so is any name of the host but the machine's own (a site can
    make its name point at this address) and the one under which a proxy on this machine offers the service. Bodies are
    bounded in bytes, in the time between two pieces, and in that of all of them, which for uploads is bounded where they
    are kept: their callers have shown the key by then.
    """

    def __init__(self, app: ASGIApp, *, limits: Limits, loopback: bool, public_name: str | None) -> None:
        self._app, self._limits, self._loopback, self._public_name = app, limits, loopback, public_name

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        guarded = _with_headers(send)
        refusal = self._refusal(scope["method"], headers)
        if refusal is not None:
            await JSONResponse({"detail": refusal}, 403)(scope, receive, guarded)
            return
        upload = scope["path"] == UPLOAD_PATH
        most = self._limits.upload_bytes if upload else self._limits.body_bytes
        length = headers.get("content-length", "0")
        if length.isdigit() and int(length) > most:
            await _drain(receive)
            await JSONResponse({"detail": _too_large(most)}, 413, {"Connection": "close"})(scope, receive, guarded)
            return
        whole_s = math.inf if upload else self._limits.body_s
        await self._app(scope, _bounded(receive, most, self._limits.idle_s, whole_s), guarded)

    def _refusal(self, method: str, headers: Headers) -> str | None:
        host = headers.get("host", "")
        public = [self._public_name] if self._public_name else []
        if self._loopback and not is_loopback(_hostname(host)) and _hostname(host) not in map(_hostname, public):
            return "this service is for its own machine: use 127.0.0.1 or localhost, or start it with --public-name behind a proxy"
        origin, site = headers.get("origin"), headers.get("sec-fetch-site", "none")
        other = origin is not None and _netloc(origin) not in (host, *public)
        if method in _CHANGING and (site not in ("none", "same-origin") or other):
            return "a page of another origin may not do this"
        return None


def _bounded(receive: Receive, most: int, idle_s: float, whole_s: float) -> Receive:
    received, end = 0, math.inf

    async def bounded() -> Message:
        nonlocal received, end
        if received < 0:  # the body is there: what comes next is that the caller leaves, whenever that is
            return await receive()
        end = min(end, time.monotonic() + whole_s)  # from when it is first waited for
        left_s = end - time.monotonic()
        try:
            message = await asyncio.wait_for(receive(), min(idle_s, left_s))
        except TimeoutError:
            late = f"nothing came for {idle_s:g} s" if idle_s < left_s else f"it was not here after {whole_s:g} s"
            raise HTTPException(408, f"{late}: send it again", {"Connection": "close"}) from None
        if message["type"] == "http.request":
            received += len(message.get("body", b""))
            if received > most:
                if message.get("more_body", False):
                    await _drain(receive)
                raise HTTPException(413, _too_large(most), {"Connection": "close"})
            if not message.get("more_body", False):
                received = -1
        return message

    return bounded


async def _drain(receive: Receive) -> None:
    """Let the rest of a body go by, within bounds: where a connection is closed with bytes unread, the answer can be lost."""
    drained = 0
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(_DRAIN_S):
            while drained < _DRAIN_BYTES:
                message = await receive()
                drained += len(message.get("body", b""))
                if not message.get("more_body", False):
                    return


def _with_headers(send: Send) -> Send:
    async def guarded(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            for name, value in _HEADERS.items():
                headers[name] = value
            headers.setdefault("Cache-Control", "no-store")
        await send(message)

    return guarded


def _too_large(most: int) -> str:
    return f"more than {most} bytes are not taken here"


def _hostname(host: str) -> str:
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""


def _netloc(origin: str) -> str | None:
    """Of a browser's word for where a page comes from; None for what is no address, and so no host of ours."""
    try:
        return urlsplit(origin).netloc
    except ValueError:
        return None
