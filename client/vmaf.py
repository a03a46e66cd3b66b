"""VMAF and VMAF-NEG in one pass, by the ffmpeg program that the imageio-ffmpeg wheel carries (extra `metrics`)."""

from __future__ import annotations

import contextlib
import functools
import json
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from client.errors import GamesrError
from client.frames import Frame
from client.timing import percentile

MODELS = {"vmaf": "vmaf_v0.6.1", "vmaf_neg": "vmaf_v0.6.1neg"}
THREADS = 2
SMALLEST_SIDE = 32  # libvmaf looks at four scales; below this it crashes instead of saying so


@dataclass(frozen=True)
class VmafScores:
    """Per-frame scores of one model pooled over the clip, in 0..100: mean, harmonic mean of (score + 1), 5th percentile (nearest rank)."""

    mean: float
    harmonic_mean: float
    p5: float

    @classmethod
    def pool(cls, scores: NDArray[np.float64]) -> Self:
        harmonic = 1.0 / float(np.mean(1.0 / (scores + 1.0))) - 1.0  # libvmaf's own definition: a zero must not swallow the clip
        return cls(float(scores.mean()), harmonic, percentile(sorted(scores.tolist()), 5))


def why_unavailable(width: int, height: int) -> str | None:
    """Why VMAF cannot be measured at this size on this installation, or None where it can."""
    if min(width, height) < SMALLEST_SIDE:
        return f"VMAF needs pictures of at least {SMALLEST_SIDE}x{SMALLEST_SIDE}, not {width}x{height}"
    try:
        program = _ffmpeg()
    except ImportError:
        return "VMAF needs the extra `metrics` (imageio-ffmpeg)"
    except RuntimeError:
        return "imageio-ffmpeg finds no ffmpeg program"
    return None if _has_libvmaf(program) else f"{program} has no libvmaf"


def _ffmpeg() -> str:
    import imageio_ffmpeg

    return str(imageio_ffmpeg.get_ffmpeg_exe())


@functools.cache
def _has_libvmaf(program: str) -> bool:
    said = subprocess.run([program, "-hide_banner", "-h", "filter=libvmaf"], capture_output=True, stdin=subprocess.DEVNULL, check=False)
    return b"log_path" in said.stdout  # the exit status is 0 for an unknown filter too


class VmafRun:
    """One ffmpeg process that scores frames as they come; a context manager that leaves neither process nor file behind.

    Both pictures travel in one, the distorted one above the reference: a single pipe cannot deadlock, their timestamps
    are equal by construction, and nothing but the score log is written to disk. Frames are 8-bit 4:2:0, all of the size
    given here; VMAF itself looks at luma only. Z. Li et al., "VMAF: The Journey Continues", Netflix Technology Blog, 2018;
    NEG (no enhancement gain): Z. Li et al., "Toward a Better Quality Metric for the Video Community", same place, 2020.
    """

    def __init__(self, width: int, height: int, *, threads: int = THREADS) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="gamesr-vmaf-")
        rows = height + height % 2  # each half starts on a whole chroma row
        command = [_ffmpeg(), "-hide_banner", "-nostdin", "-loglevel", "error"]
        command += ["-f", "rawvideo", "-pix_fmt", "yuv420p", "-video_size", f"{width}x{2 * rows}", "-framerate", "60", "-i", "pipe:0"]
        command += ["-filter_complex", _graph(width, height, rows, threads), "-f", "null", "-"]
        self._log = Path(self._folder.name) / "stderr"
        try:
            with self._log.open("wb") as log:
                # A session of its own: Ctrl-C is for us to handle, not for ffmpeg to die of while we write to it.
                self._process = subprocess.Popen(
                    command,
                    stdin=subprocess.PIPE,
                    stdout=subprocess.DEVNULL,
                    stderr=log,
                    cwd=self._folder.name,
                    start_new_session=True,
                )
        except OSError as error:
            self._folder.cleanup()
            raise GamesrError(f"VMAF: cannot start {command[0]}: {error.strerror}") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def add(self, reference: Frame, distorted: Frame) -> None:
        """Score one pair of frames; blocks while ffmpeg is busy. Raises GamesrError with ffmpeg's last line if it died."""
        pipe = self._process.stdin
        if pipe is None or pipe.closed:
            raise ValueError("this VMAF run is over")
        try:
            for above, below in ((distorted.y, reference.y), (distorted.u, reference.u), (distorted.v, reference.v)):
                pipe.write(_even_luma_rows(above, distorted).data)
                pipe.write(_even_luma_rows(below, reference).data)
        except OSError as error:
            raise self._failure() from error

    def finish(self) -> dict[str, VmafScores]:
        """The pooled scores under `vmaf` and `vmaf_neg`; ends the run. Raises GamesrError with ffmpeg's last line if it failed."""
        self._hang_up()
        if self._process.wait() != 0:
            raise self._failure()
        report = json.loads((Path(self._folder.name) / "vmaf.json").read_bytes())
        return {name: VmafScores.pool(np.array([frame["metrics"][name] for frame in report["frames"]])) for name in MODELS}

    def close(self) -> None:
        """Stop the process if it still runs and remove its folder."""
        self._process.kill()
        self._hang_up()
        self._process.wait()
        self._folder.cleanup()

    def _hang_up(self) -> None:
        if self._process.stdin is not None:
            with contextlib.suppress(OSError):  # it died before it read everything: its exit status says so
                self._process.stdin.close()

    def _failure(self) -> GamesrError:
        self._process.kill()
        status = self._process.wait()
        lines = self._log.read_text(errors="replace").strip().splitlines()
        return GamesrError(f"VMAF: ffmpeg stopped: {lines[-1] if lines else f'exit status {status}'}")


def _graph(width: int, height: int, rows: int, threads: int) -> str:
    models = "|".join(rf"version={version}\:name={name}" for name, version in MODELS.items())
    crop = f"crop={width}:{height}:0"
    return (
        f"[0:v]split[above][below];[above]{crop}:0:exact=1[distorted];[below]{crop}:{rows}:exact=1[reference];"
        f"[distorted][reference]libvmaf=model='{models}':n_threads={threads}:log_fmt=json:log_path=vmaf.json"
    )


def _even_luma_rows(plane: NDArray[np.uint8], frame: Frame) -> NDArray[np.uint8]:
    if plane is frame.y and frame.height % 2:
        return np.pad(plane, ((0, 1), (0, 0)))  # cropped away again by ffmpeg
    return np.ascontiguousarray(plane)
