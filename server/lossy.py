"""gamesr-loss: what a network that loses does to a stream, and what each upscaler makes of the very same packets."""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from pathlib import Path
from statistics import median

from client.cloud import NetworkSettings
from client.command import command_parser, run_command, whole_number
from client.errors import InputError, OutputError, how_to_install
from client.models import find_model
from client.progress import clock
from client.stream_cli import kbps
from client.upscaler import OnnxUpscaler
from client.whole_file import write_whole
from server.document import table_line
from server.link import Weather
from server.viewing import View, Viewing

PROGRAM = "gamesr-loss"
EPILOG = """\
examples:
  gamesr-loss match_1080p.mp4
      the table for bicubic and the default model: 1080p from 540 lines at 8 Mbit/s
  gamesr-loss match_1080p.mp4 --models bicubic,gamesr,mine.onnx --frames 300 --out loss.svg
      also a picture of PSNR over time

how it is measured:
  The clip is reduced, encoded, packetised, received, judged and upscaled by what gamesr-stream and gamesr-play are made of, over a
  simulated network with a simulated clock: 15 ms each way, losses drawn from --seed. The same command gives the same figures, and
  in a row all models have the same packets. A clip shorter than --frames runs to and fro. The first picture always arrives.

  A picture is shown when it is decoded, also damaged; one that never comes is frozen: the last one shown stands for it. Recovery is the
  time from the first picture that is not clean to the next one that is. PSNR-Y: of the mean MSE of all pictures sent / their 5th
  percentile, in dB.

Exit status: 0 done, 1 refused or failed (one sentence says why), 2 wrong usage, 130 interrupted.
"""
MODES = {"IDR on PLI": False, "intra-refresh": True}
LINKS = {
    "no loss": Weather(),
    "0.5%": Weather(loss=0.005),
    "2%": Weather(loss=0.02),
    "5%": Weather(loss=0.05),
    "2% in bursts of 6": Weather(loss=0.02, burst_packets=6),
    "6 ms jitter, 2% 10 ms late": Weather(jitter_ns=6_000_000, reorder=0.02, reorder_ns=10_000_000),
}
DRAWN = ("0.5%", "2% in bursts of 6")


@dataclass(frozen=True)
class Row:
    """One way of encoding over one link. Recovery is None where nothing was lost, PSNR where the pictures are identical."""

    clip: str
    mode: str
    link: str
    seed: int
    packets: int
    packets_lost: int
    sent: int
    shown: int
    damaged: int
    freezes: int
    longest_freeze_ms: float
    recovery_p50_ms: float | None
    recovery_max_ms: float | None
    keyframe_requests: int
    psnr_y_db: dict[str, float | None]
    psnr_y_p5_db: dict[str, float | None]

    @classmethod
    def of(cls, clip: str, mode: str, link: str, seed: int, seen: Viewing) -> Row:
        period_ms = 1000 / seen.fps
        frozen, runs = seen.count(View.FROZEN), seen.recoveries
        return cls(
            clip,
            mode,
            link,
            seed,
            seen.packets,
            seen.lost,
            len(seen.views),
            len(seen.views) - frozen,
            seen.count(View.DAMAGED),
            len(seen.freezes),
            max(seen.freezes, default=0) * period_ms,
            median(runs) * period_ms if runs else None,
            max(runs) * period_ms if runs else None,
            seen.keyframe_requests,
            {name: seen.psnr_y_db(name) for name in seen.errors},
            {name: seen.psnr_y_p5_db(name) for name in seen.errors},
        )

    def cells(self) -> list[str]:
        recovery = "-" if self.recovery_p50_ms is None else f"{self.recovery_p50_ms:.0f} / {self.recovery_max_ms:.0f}"
        return [
            self.mode,
            self.link,
            f"{100 * self.packets_lost / self.packets:.1f}%",
            f"{self.shown} of {self.sent}",
            f"{100 * self.damaged / self.sent:.0f}%",
            f"{self.freezes} ({self.longest_freeze_ms:.0f} ms)" if self.freezes else "0",
            recovery,
            f"{self.keyframe_requests}",
            *(f"{_db(mean)} / {_db(self.psnr_y_p5_db[name])}" for name, mean in self.psnr_y_db.items()),
        ]


HEADS = ("encoded", "link", "packets lost", "shown", "damaged", "freezes (longest)", "recovery, ms: p50 / max", "IDRs asked for")


def parser() -> argparse.ArgumentParser:
    parser = command_parser(PROGRAM, "Measure what a network that loses does to a stream, and what each upscaler makes of it.", EPILOG)
    parser.add_argument("clip", metavar="CLIP", type=Path, help="a video at full size, which everything is measured against")
    parser.add_argument(
        "--height", metavar="N", type=whole_number(most=100_000), default=540, help="height that is sent (default: %(default)s)"
    )
    parser.add_argument("--bitrate", metavar="RATE", type=kbps, default="8M", help="such as 8M or 4500k (default: %(default)s)")
    parser.add_argument(
        "--frames", metavar="N", type=whole_number(most=100_000), default=120, help="pictures to send in each row (default: %(default)s)"
    )
    parser.add_argument("--models", metavar="A,B", type=_names, default="bicubic,gamesr", help="shipped or files (default: %(default)s)")
    parser.add_argument("--seed", metavar="N", type=int, default=1, help="of the losses (default: %(default)s)")
    drawn = ", ".join(DRAWN).replace("%", "%%")  # argparse would fill it in
    parser.add_argument("--out", metavar="FILE.svg", type=Path, help=f"draw PSNR over time ({drawn}) into a file")
    parser.add_argument("--force", action="store_true", help="replace that file if it exists")
    parser.add_argument("--json", action="store_true", help="print one JSON object a row instead of the table")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    arguments = parser().parse_args(argv)
    begin = time.monotonic()

    def work() -> None:
        _prepare(arguments.out, arguments.force)
        drawn: dict[str, Viewing] = {}
        for number, (row, seen) in enumerate(report(arguments)):
            if not number and not arguments.json:
                heads = [*HEADS, *(f"{Path(model).stem}, dB" for model in arguments.models)]
                print(table_line(heads), table_line(["---"] * len(heads)), sep="\n")
            print(json.dumps(asdict(row)) if arguments.json else table_line(row.cells()), flush=True)
            if row.link in DRAWN:
                drawn[f"{row.mode}, {row.link}"] = seen
        if arguments.out is not None:
            from server.plots import over_time_figure, rendered  # a drawing library, which is an extra

            write_whole(arguments.out, rendered(over_time_figure(drawn), "svg"))
        print(f"{PROGRAM}: {len(LINKS) * len(MODES)} rows in {clock(time.monotonic() - begin)}", file=sys.stderr)

    return run_command(PROGRAM, work, debug=arguments.debug)


def report(arguments: argparse.Namespace) -> Iterator[tuple[Row, Viewing]]:
    """Every row as soon as it is measured; raises GamesrError."""
    from server.crossing import Clip, watch  # needs the extra `play`

    clip = Clip(arguments.clip, arguments.height, arguments.frames)
    upscalers = {Path(model).stem: OnnxUpscaler(find_model(model, clip.scale)) for model in arguments.models}
    if len(upscalers) < len(arguments.models):
        raise InputError(f"two of {', '.join(arguments.models)} have the same name: rename one")
    for name, upscaler in upscalers.items():
        if upscaler.spec.scale != clip.scale:
            raise InputError(f"{name} upscales by {upscaler.spec.scale}, but {arguments.height} lines are the clip's by {clip.scale}")
    for link, weather in LINKS.items():
        for mode, intra_refresh in MODES.items():
            settings = NetworkSettings(arguments.bitrate, clip.fps, intra_refresh=intra_refresh)
            seen = watch(clip, settings, weather, arguments.seed, arguments.frames, upscalers)
            yield Row.of(clip.name, mode, link, arguments.seed, seen), seen


def _prepare(out: Path | None, force: bool) -> None:
    """All is there before minutes of work go into it; raises OutputError."""
    missing = {"aiortc": "play"} if out is None else {"aiortc": "play", "matplotlib": "sweep"}
    for module, extra in missing.items():
        if find_spec(module) is None:
            raise OutputError(f"this needs {module}: {how_to_install(extra)}")
    if out is None:
        return
    if out.suffix != ".svg":
        raise OutputError(f"{out} does not end in .svg, which is what --out draws")
    if not out.parent.is_dir():
        raise OutputError(f"{out.parent} is no folder to write into")
    if not os.access(out.parent, os.W_OK):
        raise OutputError(f"cannot write {out}: {out.parent} is not writable")
    if out.exists() and not force:
        raise OutputError(f"{out} exists: name another file with --out, or replace it with --force")


def _db(value: float | None) -> str:
    return "identical" if value is None else f"{value:.2f}"


def _names(text: str) -> list[str]:
    return text.split(",")
