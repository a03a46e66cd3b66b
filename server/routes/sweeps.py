"""Sweeps: list, start, cancel, follow."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator
from typing import Annotated, Any

from anyio import to_thread
from fastapi import APIRouter, Depends, HTTPException, Path
from fastapi.responses import StreamingResponse

from server.cards import artifacts
from server.clips import PARTS
from server.guards import require_key
from server.points import NO_UPSCALER
from server.queue import QueueFullError
from server.requests import StoredClip, SweepRequest
from server.routes.clips import find_clip
from server.schemas import TERMINAL, Sweep, SweepList
from server.service import Service, Shared, problems

SweepId = Annotated[str, Path(pattern=r"^[0-9a-f]{16}$", description="as /api/v1/sweeps lists it")]
_POLL_S = 0.3
_SIGN_OF_LIFE_S = 15.0
_EVENT = {
    "type": "object",
    "properties": {"event": {"const": "progress"}, "data": {"type": "string", "contentMediaType": "application/json"}},
    "required": ["event", "data"],
}
_EVENTS: dict[int | str, dict[str, Any]] = {
    200: {"content": {"text/event-stream": {"schema": _EVENT}}, "description": "events `progress`; the data of each is a Progress"}
}

router = APIRouter(prefix="/sweeps", tags=["sweeps"])


@router.get("", responses=problems())
def list_sweeps(service: Shared) -> SweepList:
    """Every sweep of the store and of the queue, the newest first."""
    return SweepList(sweeps=service.sweeps.all())


@router.post("", status_code=202, responses=problems(400, 401, 404, 408, 413, 429), dependencies=[Depends(require_key)])
def start_sweep(asked: SweepRequest, service: Shared) -> Sweep:
    """Put a sweep into the queue; it runs in a process of its own when those before it are over."""
    clips = [find_clip(service, name) for name in asked.clips]
    _check(asked, clips)
    try:
        queued = service.queue.add(asked)
    except QueueFullError:
        most = service.settings.limits.queued_sweeps
        raise HTTPException(429, f"{most} sweeps wait already: try again when one is over", {"Retry-After": "60"}) from None
    return _found(service, queued.id)


@router.get("/{sweep}", responses=problems(404))
def read_sweep(sweep: SweepId, service: Shared) -> Sweep:
    """What was asked for, and how far it is."""
    return _found(service, sweep)


@router.post("/{sweep}/cancel", status_code=202, responses=problems(401, 404, 409), dependencies=[Depends(require_key)])
def cancel_sweep(sweep: SweepId, service: Shared) -> Sweep:
    """End a sweep that waits or runs; what it measured stays in the store."""
    queued = service.queue.find(sweep)
    if queued is None and service.sweeps.progress(sweep) is None:
        raise HTTPException(404, f"there is no sweep {sweep}")
    if queued is None or queued.over:
        raise HTTPException(409, "this sweep is over, or is a command's own: there is nothing to cancel")
    service.queue.cancel(sweep)
    return _found(service, sweep)


@router.get("/{sweep}/events", response_class=StreamingResponse, responses=_EVENTS | problems(404, 429))
def follow_sweep(sweep: SweepId, service: Shared) -> StreamingResponse:
    """Its progress as server-sent events, until it is over or for some minutes; EventSource then connects again."""
    if service.sweeps.progress(sweep) is None:
        raise HTTPException(404, f"there is no sweep {sweep}")
    if not service.event_streams.acquire(blocking=False):
        raise HTTPException(429, "too many follow sweeps already: try again later", {"Retry-After": "10"})
    return StreamingResponse(_events(service, sweep), media_type="text/event-stream", headers={"X-Accel-Buffering": "no"})


async def _events(service: Service, sweep: str) -> AsyncIterator[str]:
    service.monitoring.event_streams.inc()
    try:
        end = time.monotonic() + service.settings.limits.events_s
        said_at, said = 0.0, ""
        while True:
            progress = await to_thread.run_sync(service.sweeps.progress, sweep)
            content = "" if progress is None else progress.model_dump_json()
            if content and content != said:
                said_at, said = time.monotonic(), content
                yield f"event: progress\ndata: {content}\n\n"
            elif time.monotonic() - said_at > _SIGN_OF_LIFE_S:
                said_at = time.monotonic()
                yield ": still here\n\n"
            if progress is None or progress.state in TERMINAL or time.monotonic() > end:
                return
            await asyncio.sleep(_POLL_S)
    finally:
        service.event_streams.release()
        service.monitoring.event_streams.dec()


def _found(service: Service, sweep: str) -> Sweep:
    found = service.sweeps.find(sweep)
    if found is None:
        raise HTTPException(404, f"there is no sweep {sweep}")
    return found


def _check(asked: SweepRequest, clips: list[StoredClip]) -> None:
    """What planning would refuse, said while the caller listens; planning knows more and may still refuse."""
    scales_of = {NO_UPSCALER: {1}}
    for artifact in artifacts():
        scales_of.setdefault(artifact.name, set()).add(artifact.scale)
    unknown = [name for name in asked.upscalers if name not in scales_of]
    if unknown:
        raise HTTPException(422, f"there is no upscaler {unknown[0]}: there is {', '.join(sorted(scales_of))}")
    by_content: dict[str, str] = {}
    scales = {1}
    for clip in clips:
        other = by_content.setdefault(clip.sha256, clip.name)
        if other != clip.name:
            raise HTTPException(422, f"{other} and {clip.name} are the same clip: name it once")
        wanted = asked.low_heights or [clip.height // scale for scale in asked.scales or []]
        native = [clip.height] if NO_UPSCALER in asked.upscalers else []
        unfit = [height for height in (*wanted, *native) if height not in clip.low_heights]
        if unfit:
            there = ", ".join(map(str, clip.low_heights)) or "none"
            raise HTTPException(422, f"{clip.name} cannot be encoded at {unfit[0]} lines, only at {there}")
        if asked.fps is not None and clip.fps % asked.fps:
            raise HTTPException(422, f"{clip.name} has {clip.fps} frames a second, of which {asked.fps} is no whole part")
        scales |= {clip.height // height for height in wanted or clip.low_heights}
    for name in asked.upscalers:
        if not scales_of[name] & scales:
            parts = " or ".join(f"a {PARTS[scale]}" for scale in sorted(scales_of[name]))
            raise HTTPException(422, f"upscaler {name} needs a height that is {parts} of a clip's")
