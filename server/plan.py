"""What a sweep is going to measure, settled and checked before any work is done."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from client.cloud import CloudSettings
from client.errors import InputError
from client.frames import Frame
from server.asked import AskedSweep
from server.clips import PARTS, SCALES, Clip, clip_names
from server.job import Ask, Job
from server.latency import latency_key, unmeasured
from server.lpips import Lpips
from server.points import Point
from server.upscalers import Artifact, Upscalers
from server.versions import versions


@dataclass(frozen=True)
class Request:
    """What the user asks for. `renders` are pairs of a clip and the same clip rendered small, which replaces its downscaling.

    `heights` and `fps` are None for the default: the parts of every clip's height that `scales` name, and its own rate. `frames`
    is the most frames of a clip, None for all. `names` is what the clips are called, None for the names of their files.
    """

    clips: Sequence[Path]
    bitrates_kbps: Sequence[int]
    upscalers: Sequence[str]
    heights: Sequence[int] | None = None
    scales: Sequence[int] = SCALES
    renders: Sequence[tuple[Path, Path]] = ()
    fps: int | None = None
    frames: int | None = None
    lpips: Path | None = None
    names: Sequence[str] | None = None


@dataclass(frozen=True)
class Plan:
    """The jobs of a sweep, each of them one encode; and of every clip and height the one whose stream latency is taken on.

    There are none of the latter where no frames would be left after the warm-up.
    """

    jobs: tuple[Job, ...]
    latency_jobs: tuple[Job, ...]

    @property
    def points(self) -> list[Point]:
        """Curve by curve: by clip, the largest height first, by upscaler, by bitrate."""
        points = [ask.point for job in self.jobs for ask in job.asks]
        clips, upscalers = (list(dict.fromkeys(names)) for names in ([p.clip for p in points], [p.upscaler for p in points]))
        return sorted(points, key=lambda p: (clips.index(p.clip), -p.low_height, upscalers.index(p.upscaler), p.requested_kbps))

    @property
    def asked(self) -> AskedSweep:
        """What the store keeps of it."""
        latencies = [latency_key(ask) for job in self.latency_jobs for ask in job.asks]
        return AskedSweep.of(self.points, latencies)


def make_plan(request: Request) -> Plan:
    """Every point that is asked for; raises InputError or ModelError, in one sentence, before anything is computed.

    An upscaler serves the heights whose scale it has, and needs at least one of them.
    """
    clips = [Clip.read(path) for path in request.clips]
    names = clip_names(clips)
    if request.names is not None:
        names = dict(zip(request.clips, request.names, strict=True))
    renders = _renders(request, clips)
    upscalers = Upscalers(request.upscalers)
    lpips = {"lpips": _lpips_version(request.lpips, clips)} if request.lpips else {}
    jobs: list[Job] = []
    latency_jobs: list[Job] = []
    for clip in clips:
        encode = _Encode(request, clip, names[clip.path], {**versions(clip.width, clip.height), **lpips})
        for low_height in _heights(request, clip, renders):
            scale = clip.scale_to(low_height)
            artifacts = upscalers.at(scale)
            if not artifacts:
                continue
            if not clip.divides(scale):
                size = f"{clip.width}x{clip.height}"
                raise InputError(f"{clip.path} is {size}, of which the {PARTS[scale]} is not an even number of pixels each way")
            low = renders.get((clip.path, low_height))
            row = [encode.job(low_height, low, artifacts, bitrate_kbps) for bitrate_kbps in sorted(set(request.bitrates_kbps))]
            jobs += row
            if unmeasured(request.frames) is None:
                latency_jobs.append(row[len(row) // 2])
    upscalers.check_all_used()
    # The longest first, so that no worker is left alone with one at the end.
    return Plan(tuple(sorted(jobs, key=lambda job: -len(job.asks))), tuple(latency_jobs))


@dataclass(frozen=True)
class _Encode:
    """What the jobs of one clip have in common. Paths are absolute: a cluster's workers have other working directories."""

    request: Request
    clip: Clip
    name: str
    versions: dict[str, str]

    def job(self, low_height: int, low: Clip | None, artifacts: Mapping[str, Artifact | None], bitrate_kbps: int) -> Job:
        request, clip = self.request, self.clip
        step = clip.step_to(request.fps)
        fps = clip.fps // step
        asks = []
        for upscaler, artifact in artifacts.items():
            point = Point(
                clip=self.name,
                clip_sha256=clip.sha256,
                width=clip.width,
                height=clip.height,
                fps=fps,
                frames=request.frames,
                low_height=low_height,
                low_sha256=low.sha256 if low else None,
                requested_kbps=bitrate_kbps,
                encoder=CloudSettings(bitrate_kbps, fps).record(),
                upscaler=upscaler,
                upscaler_sha256=artifact.sha256 if artifact else None,
                versions=self.versions,
            )
            asks.append(Ask(point, artifact.path.absolute() if artifact else None))
        small, lpips = (path.absolute() if path else None for path in (low.path if low else None, request.lpips))
        return Job(clip.path.absolute(), small, step, lpips, tuple(asks))


def _renders(request: Request, clips: Sequence[Clip]) -> dict[tuple[Path, int], Clip]:
    """By clip and height, the files that were rendered small."""
    by_path = {clip.path: clip for clip in clips}
    renders: dict[tuple[Path, int], Clip] = {}
    for path, low_path in request.renders:
        clip, low = by_path.get(path), Clip.read(low_path)
        if clip is None:
            raise InputError(f"{low_path} is said to be a render of {path}, which is not one of the clips")
        if (low.width, low.height) not in [(clip.width / scale, clip.height / scale) for scale in SCALES]:
            size = f"{low.width}x{low.height}"
            raise InputError(f"{low_path} is {size}, which is neither half nor a third of {path}, {clip.width}x{clip.height}")
        if low.fps != clip.fps:
            raise InputError(f"{low_path} has {low.fps} frames a second and {path} has {clip.fps}: they must have the same")
        if low.frames and clip.frames and low.frames != clip.frames and min(low.frames, clip.frames) < _needed(request, clip):
            raise InputError(f"{low_path} has {low.frames} frames and {path} has {clip.frames}: give --frames, or clips of one length")
        renders[path, low.height] = low
    return renders


def _needed(request: Request, clip: Clip) -> float:
    return float("inf") if request.frames is None else request.frames * clip.step_to(request.fps)


def _heights(request: Request, clip: Clip, renders: Mapping[tuple[Path, int], Clip]) -> list[int]:
    """The clip's own for the native curve, those that were asked for, by default its parts that fit, and those of renders."""
    parts = [clip.height // scale for scale in request.scales if clip.divides(scale)]
    wanted = parts if request.heights is None else request.heights
    return sorted({clip.height, *wanted, *(height for path, height in renders if path == clip.path)}, reverse=True)


def _lpips_version(path: Path, clips: Sequence[Clip]) -> str:
    """Tried on a grey picture of every size, so that a file which does not fit is refused now."""
    lpips = Lpips(path, threads=1)
    for width, height in {(clip.width, clip.height) for clip in clips}:
        luma, chroma = np.full((height, width), 128, np.uint8), np.full((-(-height // 2), -(-width // 2)), 128, np.uint8)
        grey = Frame(luma, chroma, chroma)
        lpips.distance(grey, grey)
    return lpips.version
