"""gamesr-play: the player's end of a game stream, upscaled as it comes."""

from __future__ import annotations

import argparse
import gc
import json
import re
import signal
import sys
import time
import traceback
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from types import FrameType

from client.choice import AUTO, FLOAT_TIERS, INT8_TIERS, chosen_provider, chosen_tiers
from client.command import command_parser, fail, fail_on_file, on_signals, open_streams, reader_gone, whole_number
from client.errors import GamesrError, how_to_install
from client.pipeline import Sink
from client.play_overlay import OverlayLines
from client.play_post import post_summary
from client.play_sink import ResizingSink, Y4mSink
from client.play_source import open_source, shown_source
from client.play_summary import PlaySummary
from client.player import Player
from client.runtime import PROVIDERS
from client.sink import NullSink
from client.tiers import TieredUpscaler
from client.video import MAX_SIDE

PROGRAM = "gamesr-play"
MIN_QUIET_S, MAX_QUIET_S = 1.0, 60.0
EXAMPLES = """\
examples:
  gamesr-play 127.0.0.1:5004
      listens for gamesr-stream, or any RTP sender of H.264, and shows it in a window; F1 says how it goes, W wipes against bicubic
  gamesr-play sender.sdp --fullscreen --tiers live,fast,bicubic
      the same by a session description, without the models that are too slow here anyway
  gamesr-play :5004 --sink null --seconds 60 --json
      measures: nothing is shown, one JSON object says what would have been
  gamesr-play rtsp://192.0.2.7/game --display 1920x1080 --sink match.y4m
      what FFmpeg opens (no losses are known there), resized to the display, into a file

Keys: q or Esc ends, F or F11 fullscreen, F1 the overlay, W the wipe. Exit status: 0 done, 1 refused or failed, 2 wrong usage,
129, 130 and 143 after SIGHUP, Ctrl-C and SIGTERM, with the summary.
"""


def parser() -> argparse.ArgumentParser:
    parser = command_parser(PROGRAM, "Play a live game stream, every frame upscaled in time.", EXAMPLES)
    parser.add_argument("source", metavar="SOURCE", help="[HOST]:PORT to listen on, an .sdp file, a video file, or a URL such as rtsp://")
    parser.add_argument("--sink", metavar="null|window|FILE", default="window", help="nowhere, a window, or a .y4m file (default: window)")
    parser.add_argument("--fullscreen", action="store_true", help="begin with the window over the whole screen")
    parser.add_argument(
        "--display", metavar="WxH", type=_size, help="the display's size: chooses the scale, 2 or 3, and resizes what is left"
    )
    tiers = parser.add_mutually_exclusive_group()
    tiers.add_argument(
        "--tiers",
        metavar="NAMES",
        type=_names,
        help=f"models to move between, the best first (default: {','.join(FLOAT_TIERS)}; in OpenVINO without AMX {','.join(INT8_TIERS)})",
    )
    tiers.add_argument("--model", metavar="NAME|FILE", help="this model alone, in time or not")
    parser.add_argument(
        "--provider",
        choices=(AUTO, *PROVIDERS),
        default=AUTO,
        help="what runs the networks (default: OpenVINO where it is installed, in bfloat16 where the processor has it, else cpu)",
    )
    parser.add_argument(
        "--threads", metavar="N", type=whole_number(most=1024), help="threads of the networks (default: the physical cores)"
    )
    parser.add_argument(
        "--deadline-ms", metavar="MS", type=_positive, help="from a frame's arrival to its presentation (default: one frame's duration)"
    )
    parser.add_argument("--frames", metavar="N", type=whole_number(), help="end after so many frames were shown")
    parser.add_argument("--seconds", metavar="S", type=_positive, help="end after so long")
    parser.add_argument("--until-bye", action="store_true", help="end with the stream (default: wait for the next one)")
    parser.add_argument("--post", metavar="URL", help="post the latencies to a gamesr-serve; its key is taken from GAMESR_API_KEY")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of the summary")
    parser.add_argument("--force", action="store_true", help="replace the file if it exists")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    open_streams()
    arguments = parser().parse_args(argv)
    if arguments.sink not in ("null", "window") and Path(arguments.sink).suffix.lower() != ".y4m":
        parser().error(f"--sink {arguments.sink} is neither null nor window nor a .y4m file")
    if arguments.fullscreen and arguments.sink != "window":
        parser().error("--fullscreen is for --sink window")
    asked = Asked()
    on_signals(asked.end)
    status = 0
    try:
        summary = play(arguments, asked)
        print(json.dumps(summary.record()) if arguments.json else summary.text(), flush=True)
        if arguments.post:
            post_summary(arguments.post, summary.posted())
    except KeyboardInterrupt:
        status = fail(PROGRAM, "interrupted")
    except GamesrError as error:
        if arguments.debug:
            traceback.print_exc()
        status = fail(PROGRAM, str(error))
    except ModuleNotFoundError as error:
        if error.name not in ("aiortc", "sdl2"):
            raise
        status = fail(PROGRAM, f"playing needs the extra `play`: {how_to_install('play')}")
    except BrokenPipeError:
        status = reader_gone()
    except OSError as error:
        if arguments.debug:
            traceback.print_exc()
        status = fail_on_file(PROGRAM, error)
    return asked.status or status


def play(arguments: argparse.Namespace, asked: Asked) -> PlaySummary:
    """Everything between the arguments and the summary. Raises GamesrError."""
    say, display = Say(), arguments.display
    with ExitStack() as stack:
        provider = chosen_provider() if arguments.provider == AUTO else arguments.provider
        names = [arguments.model] if arguments.model else arguments.tiers or chosen_tiers(provider)
        height = display and display[1]
        tiers = stack.enter_context(TieredUpscaler(names, display_height=height, provider=provider, threads=arguments.threads))
        sink: Sink = NullSink()
        window = file = None
        if arguments.sink == "window":
            from client.play_window import WindowSink  # needs the extra `play`
            from client.window import Window

            shown = stack.enter_context(Window(f"{PROGRAM} {shown_source(arguments.source)}", fullscreen=arguments.fullscreen))
            sink = window = WindowSink(shown, lambda: lines(), provider=provider, threads=arguments.threads)
        elif arguments.sink != "null":
            sink = file = stack.enter_context(Y4mSink(Path(arguments.sink), force=arguments.force))
        if display and window is None:
            sink = ResizingSink(sink, *display)
        source = stack.enter_context(open_source(arguments.source, until_bye=arguments.until_bye, tell=say))
        player = Player(
            source,
            tiers,
            sink,
            tell=say,
            over=lambda: asked.reason or ("the window was closed" if window and window.quits() else None),
            deadline_ns=arguments.deadline_ms and int(arguments.deadline_ms * 1e6),
            frames=arguments.frames,
            seconds=arguments.seconds,
            decoded=window.follow if window else lambda frame: None,
        )
        lines = OverlayLines(player, source, tiers)
        gc.collect()
        gc.freeze()  # searching all that the libraries made takes tens of milliseconds, in the middle of the stream
        stack.callback(gc.unfreeze)
        ended = player.play()
        if file:
            file.period_ns = player.period.ns
        return player.summary(ended, dict(say.counts))


class Asked:
    """Whether a signal asked to end: the first lets the frame that is under way be finished, the second does not."""

    def __init__(self) -> None:
        self.status = 0
        self.reason: str | None = None

    def end(self, signum: int, frame: FrameType | None) -> None:
        if self.status:
            raise KeyboardInterrupt
        self.status = 128 + signum
        self.reason = "interrupted" if signum == signal.SIGINT else "told to end"


class Say:
    """A line on stderr for what happens to a stream; all are counted.

    Of each kind at most one a second, and while it goes on happening ever fewer, down to one a minute.
    """

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._said: dict[str, tuple[float, float]] = {}  # when, and how long nothing follows

    def __call__(self, kind: str, sentence: str) -> None:
        self.counts[kind] += 1
        now = time.monotonic()
        at, quiet_s = self._said.get(kind, (-MAX_QUIET_S, MIN_QUIET_S))
        if now - at >= quiet_s:
            again = now - at < 2 * quiet_s
            self._said[kind] = now, min(2 * quiet_s, MAX_QUIET_S) if again else MIN_QUIET_S
            print(f"{PROGRAM}: {sentence}", file=sys.stderr, flush=True)


def _size(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    width, height = (int(found[1]), int(found[2])) if found else (0, 0)
    if not 2 <= min(width, height) <= max(width, height) <= MAX_SIDE or width % 2 or height % 2:
        raise argparse.ArgumentTypeError(f"{text} is not a size such as 1920x1080, even and at most {MAX_SIDE}")
    return width, height


def _names(text: str) -> list[str]:
    names = text.split(",")
    if not all(names) or len(set(names)) < len(names):
        raise argparse.ArgumentTypeError(f"{text} is not a list of different models such as live,bicubic")
    return names


def _positive(text: str) -> float:
    number = float(text)
    if not 1e-3 <= number <= 1e6:
        raise argparse.ArgumentTypeError(f"{text} is not between 0.001 and 1000000")
    return number
