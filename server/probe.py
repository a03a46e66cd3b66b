"""What a clip is, found out in a process of its own that memory, time and files are rationed for: the clip may be anybody's.

    python -m server.probe '{"path": ..., "whole": true, ...}'

prints one object of JSON: `known` (a `Known`), or `refused` (a sentence).
"""

from __future__ import annotations

import hashlib
import json
import math
import resource
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from client.errors import InputError
from server.rate import whole_rate
from server.settings import Limits

_FILES = 64


@dataclass(frozen=True)
class Known:
    """`fps` is the rate as a whole number; `frames` are those that were decoded where the clip was decoded whole, else its packets."""

    sha256: str
    width: int
    height: int
    fps: int
    frames: int


@dataclass(frozen=True)
class _Task:
    path: str
    whole: bool
    decode_s: int
    decode_bytes: int
    clip_s: float
    clip_frames: int
    clip_pixels: int


def probe(path: Path, limits: Limits, *, whole: bool) -> Known:
    """Look at a clip, and with `whole` decode all of it and hold it to the limits; raises InputError, in one sentence."""
    task = _Task(str(path.absolute()), whole, limits.decode_s, limits.decode_bytes, limits.clip_s, limits.clip_frames, limits.clip_pixels)
    command = [sys.executable, "-m", "server.probe", json.dumps(asdict(task))]
    too_long = f"it takes more than {limits.decode_s} s to decode: use a shorter or smaller clip"
    try:
        # Its own clock bounds the processor's time, this one the wall's: a process that only waits uses none of the other.
        done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, timeout=4 * limits.decode_s, check=False)
    except subprocess.TimeoutExpired:
        raise InputError(too_long) from None
    try:
        said: Mapping[str, object] = json.loads(done.stdout)
    except ValueError:
        hopeless = "its decoder gave up: the clip is damaged, or needs more memory than it may have"
        raise InputError(too_long if done.returncode in (-24, -9) else hopeless) from None  # SIGXCPU, and SIGKILL after it
    if "refused" in said:
        raise InputError(str(said["refused"]))
    known = said["known"]
    assert isinstance(known, dict)
    return Known(**known)


def main(argument: str) -> None:
    task = _Task(**json.loads(argument))
    for kind, most in (
        (resource.RLIMIT_AS, task.decode_bytes),
        (resource.RLIMIT_CPU, task.decode_s),
        (resource.RLIMIT_NOFILE, _FILES),
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_FSIZE, 0),
    ):
        _, hard = resource.getrlimit(kind)
        resource.setrlimit(kind, (most, most) if hard == resource.RLIM_INFINITY or most <= hard else (hard, hard))
    said: dict[str, object]
    try:
        said = {"known": asdict(_look(task))}
    except InputError as error:
        said = {"refused": str(error).replace(f"{task.path} ", "the clip ").replace(task.path, "the clip")}
    except MemoryError:
        said = {"refused": "it needs more memory to decode than it may have: use a smaller clip"}
    print(json.dumps(said))


def _look(task: _Task) -> Known:
    from client.video import VideoSource  # not above: what it loads counts against the limits

    path = Path(task.path)
    with VideoSource(path) as source:
        fps, frames = whole_rate(source)
    with VideoSource(path) as source:
        width, height = source.width, source.height
        if task.whole:
            if width * height > task.clip_pixels:
                raise InputError(f"the clip is {width}x{height}: a picture may have {task.clip_pixels} pixels")
            most = min(task.clip_frames, math.floor(task.clip_s * fps))
            if frames > most:
                raise InputError(_too_many(frames, most, task))
            frames = _decoded(source, most, task)
    with path.open("rb") as file:
        return Known(hashlib.file_digest(file, "sha256").hexdigest(), width, height, fps, frames)


def _decoded(source: object, most: int, task: _Task) -> int:
    from client.video import VideoSource
    from client.whole_frames import whole_frames

    assert isinstance(source, VideoSource)
    frames = 0
    for _ in whole_frames(source, "is damaged, or needs more memory to decode than it may have: nothing can be measured against it"):
        frames += 1
        if frames > most:
            raise InputError(_too_many(frames, most, task))
    return frames


def _too_many(frames: int, most: int, task: _Task) -> str:
    return f"the clip has {frames} frames or more: at its rate it may have {most}, which is {task.clip_s:g} s or {task.clip_frames} frames"


if __name__ == "__main__":
    main(sys.argv[1])
