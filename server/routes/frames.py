"""Pictures for the frame viewer."""

from __future__ import annotations

import hashlib
from typing import Annotated, Any

from fastapi import APIRouter, Header, HTTPException, Path, Query, Response
from fastapi.responses import JSONResponse

from client.errors import GamesrError
from server.cards import model_path
from server.points import NO_UPSCALER
from server.requests import NAME, StoredClip
from server.routes.clips import ClipPath, find_clip
from server.schemas import Problem
from server.service import Service, Shared, problems
from server.still import Still
from server.stills import StillsBusyError

REFERENCE = "reference"
_AGAIN_S = 1
_PICTURE: dict[int | str, dict[str, Any]] = {
    200: {"content": {"image/png": {"schema": {"type": "string", "format": "binary"}}}, "description": "the picture"},
    202: {"model": Problem, "description": "it is being computed: ask again after Retry-After seconds"},
    304: {"description": "it is what If-None-Match names"},
}

router = APIRouter(prefix="/frames", tags=["frames"])


@router.get("/{clip}/{frame}", response_class=Response, responses=_PICTURE | problems(404, 429))
def read_frame(
    clip: ClipPath,
    frame: Annotated[int, Path(ge=0, le=1_000_000, description="from 0, in the frames that count")],
    service: Shared,
    picture: Annotated[str, Query(pattern=NAME, description="reference, none for native resolution, or a model")] = REFERENCE,
    low_height: Annotated[int | None, Query(ge=2, le=8192, description="where it is encoded; for a model only")] = None,
    bitrate_kbps: Annotated[int | None, Query(ge=1, le=1_000_000, description="as asked of the encoder; not for reference")] = None,
    fps: Annotated[int | None, Query(ge=1, le=1000, description="of the sweep, by default the clip's own")] = None,
    if_none_match: Annotated[str | None, Header(description="the ETag of a picture that the caller has")] = None,
) -> Response:
    """One picture as a player would see it, the same that the sweep measured."""
    found = find_clip(service, clip)
    still = _still(service, found, frame, picture, low_height, bitrate_kbps, fps)
    try:
        content = service.stills.find(still)
    except StillsBusyError:
        raise HTTPException(429, "many frames are being computed: ask again later", {"Retry-After": "5"}) from None
    except GamesrError as error:
        raise HTTPException(422, str(error)) from None
    if content is None:
        waits = Problem(detail="this frame is being computed: ask again")
        return JSONResponse(waits.model_dump(), 202, {"Retry-After": str(_AGAIN_S)})
    tag = f'"{hashlib.sha256(content).hexdigest()[:16]}"'
    headers = {"Cache-Control": "private, max-age=3600", "ETag": tag}
    if tag in [each.strip().removeprefix("W/") for each in (if_none_match or "").split(",")]:
        return Response(status_code=304, headers=headers)
    return Response(content, media_type="image/png", headers=headers)


def _still(
    service: Service, clip: StoredClip, frame: int, picture: str, low_height: int | None, bitrate_kbps: int | None, fps: int | None
) -> Still:
    """Raises HTTPException where these do not fit together."""
    limits = service.settings.limits
    if frame > limits.frame_last:
        raise HTTPException(422, f"frames up to {limits.frame_last} can be looked at")
    if fps is not None and clip.fps % fps:
        raise HTTPException(422, f"{clip.name} has {clip.fps} frames a second, of which {fps} is no whole part")
    step = clip.fps // fps if fps else 1
    if frame * step >= clip.frames:
        raise HTTPException(404, f"{clip.name} has no frame {frame}")
    scale, model = 1, None
    if picture != REFERENCE and bitrate_kbps is None:
        raise HTTPException(422, "a picture that is not the reference needs bitrate_kbps")
    if picture not in (REFERENCE, NO_UPSCALER):
        if low_height is None or low_height == clip.height or low_height not in clip.low_heights:
            parts = ", ".join(str(height) for height in clip.low_heights[1:]) or "none"
            raise HTTPException(422, f"an upscaled picture of {clip.name} needs low_height, one of {parts}")
        scale = clip.height // low_height
        model = model_path(picture, scale)
        if model is None:
            raise HTTPException(422, f"there is no model {picture} for {scale} times as many lines")
    path = service.library.path(clip.name)
    if path is None:
        raise HTTPException(404, f"there is no clip {clip.name}")
    return Still(
        clip=path,
        clip_sha256=clip.sha256,
        index=frame,
        step=step,
        fps=clip.fps // step,
        bitrate_kbps=None if picture == REFERENCE else bitrate_kbps,
        scale=scale,
        model=model,
        seconds=limits.frame_s,
    )
