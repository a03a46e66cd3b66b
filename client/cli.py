"""gamesr-upscale: a low-resolution game video in, the upscaled video out."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from client.baselines import Baselines
from client.command import command_parser, run_command, whole_number
from client.compare import ComparisonWriter
from client.detail import DetailUpscaler
from client.errors import InputError, ModelError, OutputError
from client.models import DEFAULT_MODEL, find_model
from client.pipe import PIPE, PipedVideo, PipeSink, path_or_pipe
from client.pipeline import Upscaler, upscale_stream
from client.progress import Progress
from client.reference import Reference
from client.runtime import PROVIDERS
from client.sink import FileSink
from client.skipping import skipping_upscaler
from client.summary import Summary
from client.timing import Stamps
from client.upscaler import OnnxUpscaler
from client.video import OpenVideo, VideoSource
from client.whole_file import landing

PROGRAM = "gamesr-upscale"
EXAMPLES = """\
examples:
  gamesr-upscale match.mp4
      writes match_gamesr_x2.mp4 beside it, twice as wide and high, audio and subtitles copied
  gamesr-upscale match_540p.mp4 -o match.mkv --reference match_1080p.mp4 --compare wipe.png
      also says how close this came to the original, bicubic and Lanczos beside it, and draws the difference
  gamesr-upscale match.mp4 --model bicubic --scale 3
      a baseline in the network's place
  ffmpeg -i match.mp4 -f yuv4mpegpipe - | gamesr-upscale - -o - | mpv -
      between other programs: any stream that can be read from its beginning in, .y4m out

Figures of speed leave out warm-up, measuring and comparing; the bicubic and Lanczos of --reference and --compare are always
computed on the cpu provider, whatever computes ours. The output is encoded with x264 at crf 12, so that it shows the
network's work. Exit status: 0 done, 1 refused or failed (one sentence says why, and no half of a file is left behind), 2 wrong
usage, 130 interrupted.
"""


def parser() -> argparse.ArgumentParser:
    parser = command_parser(PROGRAM, "Upscale a game video frame by frame with a small recurrent network.", EXAMPLES)
    parser.add_argument(
        "input", metavar="INPUT", type=path_or_pipe, help="the video: H.264 or another codec, 8-bit, progressive; - for a pipe"
    )
    parser.add_argument(
        "-o",
        "--output",
        metavar="OUT",
        type=path_or_pipe,
        help=".mp4 or .mkv, or - for .y4m into a pipe (default: INPUT_gamesr_xSCALE beside it)",
    )
    parser.add_argument(
        "--model", metavar="NAME|FILE", default=DEFAULT_MODEL, help="a shipped model or an .onnx file (default: %(default)s)"
    )
    parser.add_argument(
        "--scale", type=int, choices=(2, 3), help="how many times as wide and high (default: 2, or what the model FILE is for)"
    )
    parser.add_argument("--provider", choices=PROVIDERS, default="cpu", help="what runs the network (default: %(default)s)")
    parser.add_argument("--threads", metavar="N", type=whole_number(most=1024), help="threads of the network (default: the physical cores)")
    parser.add_argument(
        "--reference", metavar="HR", type=Path, help="the original, SCALE times as large: measure against it, frame by frame"
    )
    parser.add_argument("--compare", metavar="FILE", type=Path, help="draw bicubic against ours, as .png or .mp4")
    part = parser.add_mutually_exclusive_group()
    part.add_argument(
        "--skip-unchanged",
        action="store_true",
        help="compute only the tiles that changed (in OpenVINO, or with a state on a GPU: no frame twice); without a state exact, "
        "else some pixels differ a little",
    )
    part.add_argument(
        "--detail-share",
        metavar="S",
        type=_share,
        help="run the network only where most detail is, on about this share of the picture, such as 0.25; bicubic elsewhere",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of the summary (to stderr with -o -)")
    parser.add_argument("--force", action="store_true", help="replace files that exist")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    arguments = parser().parse_args(argv)

    def work() -> None:
        try:
            summary = upscale(arguments)
        except MemoryError:
            raise OutputError(f"not enough memory to upscale {arguments.input}: use a smaller video or scale") from None
        said = sys.stderr if summary.output == PIPE else sys.stdout
        print(json.dumps(summary.record()) if arguments.json else summary.text(), file=said, flush=True)

    interrupted = "interrupted" if arguments.output == PIPE else "interrupted, nothing was written"
    return run_command(PROGRAM, work, debug=arguments.debug, interrupted=interrupted)


def upscale(arguments: argparse.Namespace) -> Summary:
    """Everything between the arguments and the summary. Raises GamesrError, and leaves nothing half made behind when it does."""
    with ExitStack() as stack:
        piped = arguments.input == PIPE
        source = stack.enter_context(PipedVideo(sys.stdin.buffer) if piped else VideoSource(arguments.input))
        model = find_model(arguments.model, arguments.scale or 2)
        upscaler = OnnxUpscaler(model, provider=arguments.provider, threads=arguments.threads)
        scale = upscaler.spec.scale
        if arguments.scale not in (None, scale):
            raise ModelError(f"model {model} upscales by {scale}, not by {arguments.scale}: leave out --scale or name another model")
        output = arguments.output or _default_output(arguments.input, scale)
        _check_distinct(output, arguments)
        size = source.width * scale, source.height * scale
        skipping = skipping_upscaler(upscaler) if arguments.skip_unchanged else None
        detail = None
        if arguments.detail_share is not None:
            base = OnnxUpscaler(find_model("bicubic", scale), provider=arguments.provider, threads=arguments.threads)
            detail = DetailUpscaler(upscaler, base, arguments.detail_share)
        reference = comparison = baselines = None
        if arguments.reference:
            reference = stack.enter_context(Reference(arguments.reference, *size, ("ours", "bicubic", "lanczos")))
        if arguments.compare:
            comparison = stack.enter_context(
                ComparisonWriter(arguments.compare, source, labels=("bicubic", upscaler.spec.name), force=arguments.force)
            )
        if reference or comparison:
            names = ("bicubic", "lanczos") if reference else ("bicubic",)
            # The yardstick is one, whatever runs ours: what a runtime's precision costs must not be taken from it as well.
            baselines = Baselines(names, scale, provider="cpu", threads=arguments.threads)
        # After the comparison, so that it appears before it: what took the time is there whatever becomes of a picture of it.
        sink = (
            PipeSink(sys.stdout.buffer, source) if output == PIPE else stack.enter_context(FileSink(output, source, force=arguments.force))
        )
        (detail or upscaler).warm_up(source.height, source.width)
        chosen: Upscaler[Any] = skipping or detail or upscaler
        stream = upscale_stream(source, chosen, sink)

        stamps: list[Stamps] = []
        damaged_frames = state_resets = 0
        computed_shares: list[float] = []
        progress = stack.enter_context(Progress(sys.stderr, source.estimated_frames))
        for done in stream:
            stamps.append(done.stamps)
            computed_shares.append(done.computed_share)
            damaged_frames += done.decoded.damaged
            state_resets += done.restart is not None
            if baselines:
                pictures = baselines.upscale(done.decoded)
                if reference:
                    reference.add({"ours": done.picture, **pictures})
                if comparison:
                    comparison.add(pictures["bicubic"], done.picture)
            progress.advance()
        if not stamps:
            hint = "; an .mp4 has to be a file" if piped else ""
            raise InputError(f"no frame of {source.name} could be decoded ({source.decode_errors} packets were refused){hint}")
        quality = reference.result() if reference else {}
        notes = _source_notes(source, len(stamps), measured=reference is not None) + (reference.notes if reference else [])
    computed_share = sum(computed_shares) / len(computed_shares)
    return Summary(
        input=arguments.input,
        output=output,
        input_size=(source.width, source.height),
        output_size=size,
        model=upscaler.spec,
        provider=upscaler.provider,
        threads=upscaler.threads,
        stamps=stamps,
        decode_errors=source.decode_errors,
        damaged_frames=damaged_frames,
        state_resets=state_resets,
        skipped_share=1 - computed_share if skipping else None,
        network_share=computed_share if detail else None,
        quality=quality,
        notes=[*notes, *sink.notes],
    )


def _source_notes(source: OpenVideo, frames: int, *, measured: bool) -> list[str]:
    notes = []
    estimated = source.estimated_frames
    if source.announced_frames is None and estimated is not None and frames < 0.9 * estimated:  # a rate that varies is no cut
        notes.append(f"the file's duration means about {estimated} frames, {frames} could be decoded: it may be cut short")
    fewer = source.announced_frames is not None and source.announced_frames != frames
    if fewer:
        notes.append(f"the file announces {source.announced_frames} frames, {frames} could be decoded")
    if measured and (fewer or source.decode_errors):
        notes.append("frames are measured by their number, so after a missing one they meet the wrong frame of the reference")
    return notes


def _default_output(path: Path, scale: int) -> Path:
    if path == PIPE:
        raise OutputError("standard input has no name to name the output after: give one with -o")
    suffix = ".mkv" if path.suffix.lower() == ".mkv" else ".mp4"
    return path.with_name(f"{path.stem}_gamesr_x{scale}{suffix}")


def _check_distinct(output: Path, arguments: argparse.Namespace) -> None:
    """No file may be written that is read, or written twice, whatever --force says."""
    taken = {landing(path): what for path, what in ((arguments.input, "the input"), (arguments.reference, "the reference")) if path}
    for path in (output, arguments.compare):
        if path is None or path == PIPE:
            continue
        if landing(path) in taken:
            raise OutputError(f"cannot write {path}: it is {taken[landing(path)]}")
        taken[landing(path)] = "the output"


def _share(text: str) -> float:
    share = float(text)
    if not 0 < share < 1:
        raise argparse.ArgumentTypeError(f"{text} is not between 0 and 1")
    return share
