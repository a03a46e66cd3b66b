"""Clips: list, upload, forget."""

from __future__ import annotations

import secrets
import time
from pathlib import Path as FilePath
from typing import Annotated, Any

from anyio import to_thread
from fastapi import APIRouter, Depends, HTTPException, Path, Query, Request, Response
from starlette.requests import ClientDisconnect

from client.errors import InputError, OutputError
from server.guards import require_key
from server.library import UPLOADED
from server.requests import NAME, ClipList, StoredClip
from server.service import Service, Shared, problems

SUFFIXES = {
    "video/mp4": ".mp4",
    "video/x-matroska": ".mkv",
    "video/matroska": ".mkv",
    "video/webm": ".mkv",
    "video/quicktime": ".mp4",
    "video/mp2t": ".ts",
    "video/h264": ".h264",
    "application/octet-stream": ".video",
}
_BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "description": "the file itself, nothing around it",
        "content": {kind: {"schema": {"type": "string", "format": "binary"}} for kind in SUFFIXES},
    }
}
ClipPath = Annotated[str, Path(pattern=NAME, description="as /api/v1/clips lists it")]

router = APIRouter(prefix="/clips", tags=["clips"])


@router.get("", responses=problems())
def list_clips(service: Shared) -> ClipList:
    """The clips of the configured folder and those that were uploaded."""
    clips, refused = service.library.clips()
    return ClipList(clips=clips, refused=refused)


@router.post(
    "",
    status_code=201,
    responses=problems(401, 408, 409, 413, 415, 429),
    dependencies=[Depends(require_key)],
    openapi_extra=_BODY,
)
async def upload_clip(
    request: Request,
    service: Shared,
    title: Annotated[str | None, Query(max_length=120, description="what people call it")] = None,
) -> StoredClip:
    """Keep a clip, once all of it could be decoded within the limits. The same file twice is one clip."""
    kind = request.headers.get("content-type", "").split(";")[0].strip().lower()
    if kind not in SUFFIXES:
        raise HTTPException(415, f"a clip comes as one of {', '.join(SUFFIXES)}, not as {kind or 'nothing'}")
    if not service.uploading.acquire(blocking=False):
        raise HTTPException(429, "others are uploading: try again later", {"Retry-After": "10"})
    part = service.settings.uploads / f"{secrets.token_hex(8)}.part"
    try:
        if await to_thread.run_sync(service.library.uploads) >= service.settings.limits.uploads_kept:
            raise HTTPException(409, f"{service.settings.limits.uploads_kept} uploads are kept already: delete one first")
        await _receive(request, part, service)
        shown = "".join(letter for letter in title or "" if letter.isprintable())
        return await to_thread.run_sync(service.library.take_in, part, SUFFIXES[kind], shown)
    except InputError as error:
        service.monitoring.uploads_refused.inc()
        raise HTTPException(422, str(error)) from None
    except ClientDisconnect:
        raise HTTPException(408, "the caller left before all of it was here") from None  # nobody reads it; it is counted
    except OSError as error:
        raise OutputError(f"an upload cannot be kept in {service.settings.uploads}: {error.strerror}") from error
    finally:
        part.unlink(missing_ok=True)
        service.uploading.release()


@router.get("/{clip}", responses=problems(404))
def read_clip(clip: ClipPath, service: Shared) -> StoredClip:
    """What is known of a clip."""
    return find_clip(service, clip)


@router.delete("/{clip}", status_code=204, response_class=Response, responses=problems(401, 404, 409), dependencies=[Depends(require_key)])
def delete_clip(clip: ClipPath, service: Shared) -> Response:
    """Delete an uploaded clip; what was measured of it stays."""
    find_clip(service, clip)
    if not clip.startswith(UPLOADED):
        raise HTTPException(409, "this clip is a file of the folder that the service was given: it is not the service's to delete")
    if service.queue.needs(clip):
        raise HTTPException(409, "a sweep needs this clip: wait until it is over, or cancel it")
    service.library.remove(clip)
    return Response(status_code=204)


def find_clip(service: Service, name: str) -> StoredClip:
    """Raises HTTPException 404 for a clip that is not there, 422 for one that cannot be used."""
    try:
        clip = service.library.clip(name)
    except InputError as error:
        raise HTTPException(422, f"clip {name} cannot be used: {error}") from None
    if clip is None:
        raise HTTPException(404, f"there is no clip {name}")
    return clip


async def _receive(request: Request, part: FilePath, service: Service) -> None:
    """The body into a file; how much may come, and how slowly a piece, is guarded before this."""
    end = time.monotonic() + service.settings.limits.upload_s
    with part.open("wb") as file:
        async for piece in request.stream():
            await to_thread.run_sync(file.write, piece)
            if time.monotonic() > end:
                raise HTTPException(408, f"it was not here after {service.settings.limits.upload_s:g} s", {"Connection": "close"})
