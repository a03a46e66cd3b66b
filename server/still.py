"""One picture of a clip as a player would see it: the clip's own, or encoded at a bitrate and upscaled, as a PNG."""

from __future__ import annotations

import hashlib
import json
import os
import resource
from contextlib import closing
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path

from client.cloud import CloudSettings, area_downscale
from client.errors import GamesrError, InputError
from client.frames import Frame
from client.pipeline import upscale_stream
from client.rgb import to_png, to_rgb
from client.sink import NullSink
from client.upscaler import OnnxUpscaler
from server.encoding import EncodedStream, clip_frames
from server.following import end_with_parent
from server.job import content_sha256

NICENESS = 10


@dataclass(frozen=True)
class Still:
    """Frame `index` of a clip: of every `step`-th of its frames, at `fps`; the clip's own picture where `bitrate_kbps` is None.

    `scale` is how many times as small it is encoded, 1 with no `model`. `seconds` of the processor's time are what it may take.
    """

    clip: Path
    clip_sha256: str
    index: int
    step: int
    fps: int
    bitrate_kbps: int | None
    scale: int
    model: Path | None
    seconds: int

    @property
    def key(self) -> str:
        """The sha256 of what the picture depends on."""
        content = {name: str(value) for name, value in asdict(self).items() if name not in ("clip", "seconds")}
        if self.model is not None:
            content["model"] = content_sha256(self.model)
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def render(still: Still) -> bytes:
    """The PNG, computed in a process of its own beside whatever this machine is really for; raises GamesrError."""
    os.nice(NICENESS)
    end_with_parent()
    resource.setrlimit(resource.RLIMIT_CPU, (still.seconds, still.seconds))
    try:
        return to_png(to_rgb(_frame(still)))
    except MemoryError:
        raise GamesrError("there is not enough memory for this frame") from None


def _frame(still: Still) -> Frame:
    """An encoder has no look at what comes after: a stream that ends with this frame is the beginning of the whole one."""
    with closing(clip_frames(still.clip, still.step, still.index + 1)) as frames:
        if still.bitrate_kbps is None:
            return _at(still, list(islice(frames, still.index, None)))
        small = (frame if still.scale == 1 else area_downscale(frame, still.scale) for frame in frames)
        with EncodedStream(small, CloudSettings(still.bitrate_kbps, still.fps)) as stream:
            if still.model is None:
                return _at(still, [decoded.frame for decoded in islice(stream, still.index, None)])
            upscaler = OnnxUpscaler(still.model)
            done = upscale_stream(stream, upscaler, NullSink())
            return _at(still, [frame.picture for frame in islice(done, still.index, None)])


def _at(still: Still, last: list[Frame]) -> Frame:
    if not last:
        raise InputError(f"the clip has no frame {still.index}")
    return last[0]
