"""A summary to a service, over HTTP: one request, to that address and no other."""

from __future__ import annotations

import http.client
import json
import os
import urllib.error
import urllib.request
from collections.abc import Mapping
from typing import Any
from urllib.parse import urlsplit

from client.errors import OutputError
from client.play_source import shown_url

PATH = "/api/v1/client-latencies"
KEY_VARIABLE = "GAMESR_API_KEY"
_TIMEOUT_S = 5.0
_ANSWER_BYTES = 1 << 16


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    def redirect_request(self, *arguments: Any, **named: Any) -> None:
        """The key is for the address that was named."""
        return None


def post_summary(url: str, record: Mapping[str, object]) -> None:
    """Send a record to a gamesr-serve at `url`, with the key of GAMESR_API_KEY if there is one; raises OutputError, in one sentence."""
    headers = {"Content-Type": "application/json"}
    if key := os.environ.get(KEY_VARIABLE, "").strip():  # a file that it was read from ends in a new line
        if not key.isascii() or not key.isprintable():
            raise OutputError(f"{KEY_VARIABLE} holds what no key has: it is printable characters")
        headers["X-API-Key"] = key
    try:
        if urlsplit(url).scheme not in ("http", "https") or not urlsplit(url).hostname:
            raise ValueError("it is no http address")
        target = url if urlsplit(url).path.rstrip("/") == PATH else url.rstrip("/") + PATH
        request = urllib.request.Request(target, json.dumps(record).encode(), headers, method="POST")
        with urllib.request.build_opener(_NoRedirect, urllib.request.ProxyHandler({})).open(request, timeout=_TIMEOUT_S) as answer:
            answer.read(_ANSWER_BYTES)
    except urllib.error.HTTPError as error:
        with error:
            raise OutputError(f"{shown_url(url)} did not take the summary: {error.code} {_detail(error)}") from error
    except (OSError, ValueError, http.client.HTTPException) as error:
        reason = getattr(error, "reason", error)
        reason = getattr(reason, "strerror", None) or str(reason) or type(error).__name__
        raise OutputError(f"the summary could not be posted to {shown_url(url)}: {reason}") from error


def _detail(error: urllib.error.HTTPError) -> str:
    """What gamesr-serve says in its refusal, else the status in words."""
    try:
        detail = json.loads(error.read(_ANSWER_BYTES))["detail"]
    except (OSError, ValueError, KeyError, TypeError, http.client.HTTPException):
        return str(error.reason)
    return "".join(letter for letter in str(detail)[:200] if letter.isprintable())
