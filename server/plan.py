"""What a sweep is going to measure, settled and checked before any work is done."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import av
import numpy as np
import onnxruntime

from client.artifact import ModelSpec
from client.cloud import CloudSettings
from client.errors import InputError, ModelError
from client.frames import Frame
from client.models import find_model, shipped_models
from client.upscaler import OnnxUpscaler
from client.video import VideoSource
from client.vmaf import MODELS, why_unavailable
from server.job import Ask, Job, content_sha256
from server.lpips import Lpips
from server.points import NO_UPSCALER, Point

SCALES = (2, 3)
_QUALITY_VERSION = "1"  # of the definitions in client.quality: raise it when a figure changes
_RATE_TOLERANCE = 0.002  # 59.94 is 60, 23.976 is 24


@dataclass(frozen=True)
class Request:
    """What the user asks for. `renders` are pairs of a clip and the same clip rendered small, which replaces its downscaling.

    `heights` and `fps` are None for the default: half and a third of every clip's height, and its own rate. `frames` is the
    most frames of a clip, None for all.
    """

    clips: Sequence[Path]
    bitrates_kbps: Sequence[int]
    upscalers: Sequence[str]
    heights: Sequence[int] | None = None
    renders: Sequence[tuple[Path, Path]] = ()
    fps: int | None = None
    frames: int | None = None
    lpips: Path | None = None


@dataclass(frozen=True)
class Plan:
    """The jobs of a sweep, each of them one encode; and of every clip and height the one whose stream latency is taken on."""

    jobs: tuple[Job, ...]
    latency_jobs: tuple[Job, ...]

    @property
    def points(self) -> list[Point]:
        """Curve by curve: by clip, the largest height first, by upscaler, by bitrate."""
        points = [ask.point for job in self.jobs for ask in job.asks]
        clips, upscalers = (list(dict.fromkeys(names)) for names in ([p.clip for p in points], [p.upscaler for p in points]))
        return sorted(points, key=lambda p: (clips.index(p.clip), -p.low_height, upscalers.index(p.upscaler), p.requested_kbps))


@dataclass(frozen=True)
class _Clip:
    path: Path
    sha256: str
    width: int
    height: int
    fps: int
    frames: int | None

    @classmethod
    def read(cls, path: Path) -> _Clip:
        with VideoSource(path) as source:
            rate = float(source.frame_rate)
            fps = round(rate)
            if not fps or abs(rate / fps - 1) > _RATE_TOLERANCE:
                raise InputError(f"{path} has {rate:.4g} frames a second, which is not a whole number: convert it first")
            return cls(path, content_sha256(path), source.width, source.height, fps, source.announced_frames)


def make_plan(request: Request) -> Plan:
    """Every point that is asked for; raises InputError or ModelError, in one sentence, before anything is computed.

    An upscaler serves the heights whose scale it has, and needs at least one of them.
    """
    clips = [_Clip.read(path) for path in request.clips]
    names = _names(clips)
    renders = _renders(request, clips)
    upscalers = _Upscalers(request.upscalers)
    lpips = {"lpips": _lpips_version(request.lpips, clips)} if request.lpips else {}
    jobs, latency_jobs = [], []
    for clip in clips:
        step = _step(clip, request.fps)
        for low_height in _heights(clip, request, renders):
            scale = clip.height // low_height
            models = upscalers.at(scale)
            if not models:
                continue
            if not _divides(clip, scale):
                size = f"{clip.width}x{clip.height}"
                raise InputError(f"{clip.path} is {size}, of which the {_PART[scale]} is not an even number of pixels each way")
            low = renders.get((clip.path, low_height))
            row = []
            for bitrate_kbps in sorted(set(request.bitrates_kbps)):
                fps = clip.fps // step
                asks = tuple(
                    Ask(
                        Point(
                            clip=names[clip.path],
                            clip_sha256=clip.sha256,
                            width=clip.width,
                            height=clip.height,
                            fps=fps,
                            frames=request.frames,
                            low_height=low_height,
                            low_sha256=low.sha256 if low else None,
                            requested_kbps=bitrate_kbps,
                            encoder=CloudSettings(bitrate_kbps, fps).record(),
                            upscaler=name,
                            upscaler_sha256=model.sha256 if model else None,
                            versions={**_versions(clip), **lpips},
                        ),
                        model.path if model else None,
                    )
                    for name, model in models.items()
                )
                row.append(Job(clip.path, low.path if low else None, step, request.lpips, asks))
            jobs += row
            latency_jobs.append(row[len(row) // 2])
    upscalers.check_all_used()
    # The longest first, so that no worker is left alone with one at the end.
    return Plan(tuple(sorted(jobs, key=lambda job: -len(job.asks))), tuple(latency_jobs))


@dataclass(frozen=True)
class _Model:
    path: Path
    sha256: str


class _Upscalers:
    """The artifacts that were asked for, by scale; scale 1 has `none` only."""

    def __init__(self, names: Sequence[str]) -> None:
        self._by_scale: dict[int, dict[str, _Model | None]] = {1: {}, **{scale: {} for scale in SCALES}}
        self._used: set[str] = set()
        self._names = list(dict.fromkeys(names))
        taken: dict[tuple[int, str], str] = {}
        for name in self._names:
            if name == NO_UPSCALER:
                self._by_scale[1][name] = None
                continue
            for path, spec in _artifacts(name):
                shown = Path(name).stem if Path(name).suffix == ".onnx" else name
                other = taken.setdefault((spec.scale, spec.sha256), name)
                if other != name or shown in self._by_scale[spec.scale]:
                    raise ModelError(f"upscaler {name} is asked for twice, also as {other}: name it once")
                self._by_scale[spec.scale][shown] = _Model(path, spec.sha256)

    def at(self, scale: int) -> Mapping[str, _Model | None]:
        self._used.update(self._by_scale[scale])
        return self._by_scale[scale]

    def check_all_used(self) -> None:
        scales: dict[str, list[str]] = {}
        for scale, models in self._by_scale.items():
            for name in models:
                scales.setdefault(name, []).append(_PART[scale])
        for name, parts in scales.items():
            if name not in self._used:
                part = " or ".join(f"a {part}" for part in parts)
                raise InputError(
                    f"upscaler {name} needs a height that is {part} of a clip's, an even number of pixels each way: see --heights"
                )


_PART = {1: "whole", 2: "half", 3: "third"}


def _artifacts(name: str) -> list[tuple[Path, ModelSpec]]:
    """A file, or a shipped model at every scale that it has."""
    shipped = {path.name for path in shipped_models()}
    scales = [scale for scale in SCALES if f"{name}_x{scale}.onnx" in shipped] or [SCALES[0]]
    paths = [find_model(name, scale) for scale in scales]
    return [(path, OnnxUpscaler(path, threads=1).spec) for path in paths]


def _names(clips: Sequence[_Clip]) -> dict[Path, str]:
    """What clips are called: the names of their files, with their folders where two are alike."""
    stems = [clip.path.stem for clip in clips]
    by_content: dict[str, Path] = {}
    for clip in clips:
        other = by_content.setdefault(clip.sha256, clip.path)
        if other is not clip.path:
            raise InputError(f"{other} and {clip.path} are the same clip: name it once")
    return {clip.path: clip.path.stem if stems.count(clip.path.stem) == 1 else str(clip.path) for clip in clips}


def _renders(request: Request, clips: Sequence[_Clip]) -> dict[tuple[Path, int], _Clip]:
    by_path = {clip.path: clip for clip in clips}
    renders: dict[tuple[Path, int], _Clip] = {}
    for path, low_path in request.renders:
        clip, low = by_path.get(path), _Clip.read(low_path)
        if clip is None:
            raise InputError(f"{low_path} is said to be a render of {path}, which is not one of the clips")
        if (low.width * clip.height, low.height) != (clip.width * low.height, clip.height // _scale(clip, low.height)):
            raise InputError(f"{low_path} is {low.width}x{low.height}, which is no whole part of {path}, {clip.width}x{clip.height}")
        if low.fps != clip.fps:
            raise InputError(f"{low_path} has {low.fps} frames a second and {path} has {clip.fps}: they must have the same")
        if low.frames and clip.frames and low.frames != clip.frames and min(low.frames, clip.frames) < _needed(request, clip):
            raise InputError(f"{low_path} has {low.frames} frames and {path} has {clip.frames}: give --frames, or clips of one length")
        renders[path, low.height] = low
    return renders


def _needed(request: Request, clip: _Clip) -> float:
    return float("inf") if request.frames is None else request.frames * _step(clip, request.fps)


def _heights(clip: _Clip, request: Request, renders: Mapping[tuple[Path, int], _Clip]) -> list[int]:
    """The clip's own for the native curve, and those that were asked for; by default half and a third, and those of renders."""
    if request.heights is None:
        wanted = {clip.height // scale for scale in SCALES if _divides(clip, scale)}
        wanted |= {height for path, height in renders if path == clip.path}
    else:
        wanted = set(request.heights)
    for height in wanted:
        _scale(clip, height)
    return sorted({clip.height, *wanted}, reverse=True)


def _scale(clip: _Clip, height: int) -> int:
    if height not in (clip.height, clip.height / 2, clip.height / 3):
        raise InputError(f"{clip.path} is {clip.height} high, of which {height} is neither the whole, nor half, nor a third")
    return clip.height // height


def _divides(clip: _Clip, scale: int) -> bool:
    """Whether that part of the clip is an even number of pixels each way, as H.264's 4:2:0 needs."""
    return clip.width % (2 * scale) == 0 and clip.height % (2 * scale) == 0


def _step(clip: _Clip, fps: int | None) -> int:
    if fps is None:
        return 1
    if clip.fps % fps:
        raise InputError(f"{clip.path} has {clip.fps} frames a second, of which {fps} is no whole part: give another --fps")
    return clip.fps // fps


def _versions(clip: _Clip) -> dict[str, str]:
    """What decides a figure beside the inputs: PyAV carries the encoder and the decoder, the wheel of ffmpeg carries VMAF."""
    missing = why_unavailable(clip.width, clip.height)
    return {
        "av": av.__version__,
        "onnxruntime": onnxruntime.__version__,
        "quality": _QUALITY_VERSION,
        "vmaf": f"{', '.join(MODELS.values())}, imageio-ffmpeg {_version('imageio-ffmpeg')}" if missing is None else missing,
    }


def _lpips_version(path: Path, clips: Sequence[_Clip]) -> str:
    """Tried on a grey picture of every size, so that a file which does not fit is refused now."""
    lpips = Lpips(path, threads=1)
    for width, height in {(clip.width, clip.height) for clip in clips}:
        luma, chroma = np.full((height, width), 128, np.uint8), np.full((-(-height // 2), -(-width // 2)), 128, np.uint8)
        grey = Frame(luma, chroma, chroma)
        lpips.distance(grey, grey)
    return lpips.version


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "unknown"
