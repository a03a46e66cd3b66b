"""Everything that the routes share, made once for a service."""

from __future__ import annotations

import asyncio
import threading
from typing import Annotated, Any

from fastapi import Depends, Request

from client.errors import OutputError
from server.database import Database
from server.library import Library
from server.monitoring import Monitoring
from server.players import Players
from server.queue import SweepQueue
from server.reading import StoreReader
from server.schemas import Problem
from server.settings import Settings
from server.stills import Stills
from server.sweeps import Sweeps


class Service:
    """Makes the folders that are missing, and removes what uploads left that were cut off; raises OutputError."""

    def __init__(self, settings: Settings) -> None:
        self.settings, limits = settings, settings.limits
        try:
            for folder in (settings.data, settings.uploads, settings.frames):
                folder.mkdir(mode=0o700, parents=True, exist_ok=True)  # clips may be nobody else's business
            for part in settings.uploads.glob("*.part"):
                part.unlink()
        except OSError as error:
            raise OutputError(f"cannot write into {settings.data}: {error.strerror}") from error
        database = Database(settings.database)
        self.reader = StoreReader(settings.store)
        self.reader.totals()  # a store that is none of ours is said now
        self.queue = SweepQueue(database, most=limits.queued_sweeps, kept=limits.kept_sweeps)
        self.library = Library(database, settings)
        self.library.look_at_all()
        self.sweeps = Sweeps(self.reader, self.queue, self.library)
        self.players = Players(database, kept=limits.kept_client_latencies)
        self.stills = Stills(settings.frames, most=limits.frames_at_once, kept_bytes=limits.frames_kept_bytes)
        self.monitoring = Monitoring(settings, self.reader, self.queue)
        self.building = asyncio.Lock()
        self.uploading = threading.BoundedSemaphore(limits.uploads_at_once)
        self.event_streams = threading.BoundedSemaphore(limits.events_at_once)


async def _of(request: Request) -> Service:  # not async, it would be run in a thread
    service = request.app.state.service
    assert isinstance(service, Service)
    return service


Shared = Annotated[Service, Depends(_of)]

_WORDS = {
    400: "The body is no text",
    401: "The API key is missing or wrong",
    403: "A page of another origin asks, or this machine is not asked by its own name",
    404: "There is no such thing",
    408: "The body stopped coming",
    409: "Not in this state",
    413: "The body is too large",
    415: "The body is not of a type that is taken",
    422: "Something that was sent does not fit",
    429: "Too much at once: try again later",
    503: "The store or the service's folder cannot be used",
}


def problems(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """For OpenAPI: which refusals a route knows, beside those of every route."""
    return {status: {"model": Problem, "description": _WORDS[status]} for status in sorted({403, 422, 503, *statuses})}
