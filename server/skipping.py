"""gamesr-skipping: what it saves to compute only what changed, and what it costs, on stills and motion made of clips of yours."""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import chain
from pathlib import Path

import numpy as np

from client.cloud import CloudSettings, area_downscale
from client.command import command_parser, run_command, whole_number
from client.errors import InputError
from client.frames import Frame
from client.models import DEFAULT_MODEL, find_model
from client.pipeline import upscale_stream
from client.quality import psnr_db, squared_error
from client.runtime import PROVIDERS
from client.sink import NullSink
from client.skipping import skipping_upscaler
from client.upscaler import OnnxUpscaler
from server.document import table_line
from server.encoding import EncodedStream, clip_frames

PROGRAM = "gamesr-skipping"
EPILOG = """\
examples:
  gamesr-skipping match_1080p.mkv
      the table for the default model, on scenes made of the clip's first frames

how it is measured:
  Every scene is downscaled by area, encoded as a cloud server does, decoded and upscaled twice, frame by frame in turn: all
  of it, and only what changed. ms is processor time a frame, decoding in it, the model on one thread: a busy machine does
  not change it much. Lost is PSNR-Y against the clip, of all minus of skipping: below zero, skipping came out nearer. Differ:
  the share of luma pixels that are not what computing all gives, over the whole scene, and by how many code values at most.

Exit status: 0 done, 1 refused or failed (one sentence says why), 2 wrong usage, 130 interrupted.
"""
FPS = 60


@dataclass(frozen=True)
class RateControl(CloudSettings):
    """The cloud's settings with some of x264's put over them."""

    over: str = ""

    def x264_params(self) -> str:
        return super().x264_params() + self.over


RATE_CONTROLS = {
    "CBR": "",
    "CBR, intra-refresh": ":intra-refresh=1",
    "CRF 23": ":crf=23:vbv-maxrate=0:vbv-bufsize=0",
    "lossless": ":qp=0:vbv-maxrate=0:vbv-bufsize=0",
}


def motion(frames: list[Frame]) -> Iterator[Frame]:
    """The clip as it is."""
    yield from frames


def repeated(frames: list[Frame]) -> Iterator[Frame]:
    """Each frame twice: a game at 30 fps in a stream at 60."""
    for frame in frames[: len(frames) // 2]:
        yield from (frame, frame)


def letterbox(frames: list[Frame]) -> Iterator[Frame]:
    """Black above and below, an eighth of the height each."""
    bar = frames[0].height // 16 * 2
    for frame in frames:
        yield _over(_black(frame), frame, slice(bar, frame.height - bar), slice(None))


def panel(frames: list[Frame]) -> Iterator[Frame]:
    """A still panel over motion, three tenths of the width on the left: a chat, a map, a score."""
    for frame in frames:
        yield _over(frame, frames[0], slice(None), slice(0, frame.width * 3 // 20 * 2))


def menu(frames: list[Frame]) -> Iterator[Frame]:
    """A still with motion in a sixteenth of it, in the middle: a menu, an inventory."""
    height, width = frames[0].height, frames[0].width
    rows, columns = (slice(size * 3 // 16 * 2, size * 5 // 16 * 2) for size in (height, width))
    for frame in frames:
        yield _over(frames[0], frame, rows, columns)


def pause(frames: list[Frame]) -> Iterator[Frame]:
    """Motion for a quarter of the clip, as long a still as the clip, motion again."""
    quarter = len(frames) // 4
    yield from chain(frames[:quarter], [frames[quarter]] * len(frames), frames[quarter : 2 * quarter])


def still(frames: list[Frame]) -> Iterator[Frame]:
    """One picture, twice as long as the clip."""
    yield from [frames[0]] * (2 * len(frames))


Scene = Callable[[list[Frame]], Iterator[Frame]]
ROWS: tuple[tuple[Scene, str], ...] = (
    (motion, "CBR"),
    (repeated, "lossless"),
    (repeated, "CRF 23"),
    (letterbox, "CRF 23"),
    (panel, "CRF 23"),
    (menu, "CRF 23"),
    (pause, "lossless"),
    (pause, "CRF 23"),
    (pause, "CBR"),
    (pause, "CBR, intra-refresh"),
    (still, "CRF 23"),
    (still, "CBR"),
    (still, "CBR, intra-refresh"),
)


@dataclass(frozen=True)
class Row:
    """One scene under one rate control. `whole` is of computing all, the rest of skipping. `sha256` is the model's.

    Times are processor time a frame, of all threads, for decoding and upscaling. A PSNR is None where nothing differs.
    """

    clip: str
    model: str
    sha256: str
    provider: str
    scene: str
    rate_control: str
    frames: int
    bitrate_kbps: float
    tiles_skipped: float
    whole_ms: float
    skipping_ms: float
    whole_psnr_y_db: float | None
    psnr_y_lost_db: float | None
    differing_pixels: float
    max_difference: int

    def cells(self) -> tuple[str, ...]:
        saved = self.whole_ms - self.skipping_ms
        return (
            self.clip,
            self.scene,
            self.rate_control,
            f"{100 * self.tiles_skipped:.1f}%",
            f"{self.whole_ms:.1f}",
            f"{saved:.1f} ({100 * saved / self.whole_ms:.1f}%)",
            "identical" if self.whole_psnr_y_db is None else f"{self.whole_psnr_y_db:.2f}",
            "undefined" if self.psnr_y_lost_db is None else f"{self.psnr_y_lost_db:+.4f}",
            f"{100 * self.differing_pixels:.3f}%",
            f"{self.max_difference}",
        )


HEADS = ("clip", "scene", "rate control", "tiles skipped", "ms, all", "ms saved", "PSNR-Y, all", "dB lost", "differ", "by at most")


def measure(clip: str, frames: list[Frame], scene: Scene, rate_control: str, kbps: int, upscaler: OnnxUpscaler) -> Row:
    """One row: a scene made of `frames`, through the codec, computed whole and with skipping in turn. Raises GamesrError."""
    scale = upscaler.spec.scale
    settings = RateControl(kbps, FPS, over=RATE_CONTROLS[rate_control])
    with EncodedStream((area_downscale(frame, scale) for frame in scene(frames)), settings) as stream:
        ways = upscale_stream(stream, upscaler, NullSink()), upscale_stream(stream, skipping_upscaler(upscaler), NullSink())
        share, times_ns, errors, differing, greatest = 0.0, [0, 0], [0, 0], 0, 0
        for number, reference in enumerate(scene(frames)):
            done = {}
            for index in (number % 2, 1 - number % 2):  # who comes second finds other things in the cache
                begin_ns = time.process_time_ns()
                done[index] = next(ways[index])
                times_ns[index] += time.process_time_ns() - begin_ns
                errors[index] += squared_error(reference.y, done[index].picture.y)
            share += done[1].computed_share
            difference = np.abs(np.subtract(done[0].picture.y, done[1].picture.y, dtype=np.int16))
            differing += int(np.count_nonzero(difference))
            greatest = max(greatest, int(difference.max()))
        count = stream.frames
        samples = count * frames[0].y.size
        whole_ms, skipping_ms = (ns / count / 1e6 for ns in times_ns)
        whole_db, skipping_db = (psnr_db(error / samples) if error else None for error in errors)
        return Row(
            clip,
            upscaler.spec.name,
            upscaler.spec.sha256,
            upscaler.provider,
            scene.__name__,
            rate_control,
            count,
            stream.bitrate_kbps,
            1 - share / count,
            whole_ms,
            skipping_ms,
            whole_db,
            None if whole_db is None or skipping_db is None else whole_db - skipping_db,
            differing / samples,
            greatest,
        )


def parser() -> argparse.ArgumentParser:
    parser = command_parser(PROGRAM, "Measure what skipping unchanged tiles saves and costs.", EPILOG)
    parser.add_argument("clips", metavar="CLIP", nargs="+", type=Path, help="a clip at full size, at least 8 frames")
    parser.add_argument("--model", metavar="NAME|FILE", default=DEFAULT_MODEL, help="a shipped x2 model or a file (default: %(default)s)")
    parser.add_argument("--provider", choices=PROVIDERS, default="cpu", help="what runs the model (default: %(default)s)")
    parser.add_argument("--frames", metavar="N", type=whole_number(8), default=60, help="frames of each clip to use (default: %(default)s)")
    parser.add_argument(
        "--kbps",
        metavar="N",
        type=whole_number(most=1_000_000),
        default=6000,
        help="bitrate of CBR and intra-refresh (default: %(default)s)",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object a row instead of the table")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    arguments = parser().parse_args(argv)

    def work() -> None:
        for number, row in enumerate(report(arguments)):
            if not number and not arguments.json:
                print(table_line(HEADS), table_line(["---"] * len(HEADS)), sep="\n")
            print(json.dumps(asdict(row)) if arguments.json else table_line(row.cells()), flush=True)

    return run_command(PROGRAM, work, debug=arguments.debug)


def report(arguments: argparse.Namespace) -> Iterator[Row]:
    """Every row of every clip, each as soon as it is measured; raises GamesrError."""
    model = find_model(arguments.model, 2)
    upscaler = OnnxUpscaler(model, provider=arguments.provider, threads=1)  # more would spin while they wait, in processor time too
    for path in arguments.clips:
        frames = list(clip_frames(path, 1, arguments.frames))
        multiple = 2 * upscaler.spec.scale
        if len(frames) < 8 or frames[0].height % multiple or frames[0].width % multiple:
            size = f"{frames[0].width}x{frames[0].height}"
            raise InputError(f"{path} has {len(frames)} frames of {size}: this needs 8, with sides that are multiples of {multiple}")
        upscaler.warm_up(frames[0].height // upscaler.spec.scale, frames[0].width // upscaler.spec.scale)
        for scene, rate_control in ROWS:
            yield measure(path.stem, frames, scene, rate_control, arguments.kbps, upscaler)


def _over(frame: Frame, patch: Frame, rows: slice, columns: slice) -> Frame:
    """A frame with an area of another in it; the edges of the area are even."""
    planes = []
    for plane, other, divisor in ((frame.y, patch.y, 1), (frame.u, patch.u, 2), (frame.v, patch.v, 2)):
        area = tuple(slice(side.start and side.start // divisor, side.stop and side.stop // divisor) for side in (rows, columns))
        planes.append(plane.copy())
        planes[-1][area] = other[area]
    return replace(frame, y=planes[0], u=planes[1], v=planes[2])


def _black(frame: Frame) -> Frame:
    level = 0 if frame.colour.range == 2 else 16
    return replace(frame, y=np.full_like(frame.y, level), u=np.full_like(frame.u, 128), v=np.full_like(frame.v, 128))
