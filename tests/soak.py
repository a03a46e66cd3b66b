"""A player over minutes: `python -m tests.soak MINUTES [--stolen] [--provider P] [--tiers A,B]` prints a row a minute.

gamesr-stream sends the clip that ships here over and over; nothing is shown. With --stolen another process keeps one core busy
for the second third of the time: the governor has to step down, and to come back.
"""

from __future__ import annotations

import argparse
import gc
import multiprocessing
import sys
import time
from pathlib import Path

from client.play_source import open_source
from client.player import Player
from client.runtime import PROVIDERS
from client.sink import NullSink
from client.tiers import TieredUpscaler
from tests.playing import streamed

ADDRESS = "127.0.0.1:5106"


class Minutes:
    """Asked by the player after every frame whether to end: prints what has happened since the row before."""

    def __init__(self, minutes: float, row_s: float) -> None:
        self.player: Player | None = None
        self._row_ns, self._begin_ns = int(row_s * 1e9), 0
        self._rows = round(minutes * 60 / row_s)
        self._row = self._shown = self._missed = 0

    def __call__(self) -> str | None:
        assert self.player is not None
        tally, now_ns = self.player.tally, time.perf_counter_ns()
        if not tally.shown:
            return None
        self._begin_ns = self._begin_ns or now_ns
        if now_ns - self._begin_ns < (self._row + 1) * self._row_ns:
            return None
        shown, missed = tally.shown - self._shown, tally.missed - self._missed
        total = tally.latencies(network=True, newest=max(1, shown))["total"]
        tiers = ", ".join(f"{name} {count}" for name, count in tally.tier_frames.items())
        cells = [
            f"{self._row + 1}",
            f"{shown}",
            f"{100 * (1 - missed / max(1, shown + missed)):.2f}",
            *(f"{us / 1000:.1f}" for us in (total.p50, total.p95, total.p99)),
            f"{tally.left_out}",
            f"{tally.switched}",
            tiers,
            f"{resident_mib():.1f}",
        ]
        print("| " + " | ".join(cells) + " |", flush=True)
        self._row, self._shown, self._missed = self._row + 1, tally.shown, tally.missed
        return "the time was over" if self._row == self._rows else None


def resident_mib() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 2**20


def steal(after_s: float, for_s: float) -> None:
    time.sleep(after_s)
    end = time.perf_counter() + for_s
    while time.perf_counter() < end:
        pass


def main() -> None:
    parser = argparse.ArgumentParser(prog="tests.soak")
    parser.add_argument("minutes", type=float)
    parser.add_argument("--row-seconds", type=float, default=60.0)
    parser.add_argument("--stolen", action="store_true")
    parser.add_argument("--provider", choices=PROVIDERS, default="cpu")
    parser.add_argument("--tiers", default="live,bicubic")
    parser.add_argument("--deadline-ms", type=float)
    arguments = parser.parse_args()
    third_s = arguments.minutes * 20
    thief = multiprocessing.Process(target=steal, args=(third_s, third_s), daemon=True)
    over = Minutes(arguments.minutes, arguments.row_seconds)

    def say(kind: str, sentence: str) -> None:
        print(f"  {kind}: {sentence}", file=sys.stderr)

    deadline_ns = arguments.deadline_ms and int(arguments.deadline_ms * 1e6)
    print("| row | shown | deadlines kept, % | total p50, ms | p95 | p99 | left out | switches | frames by tier | resident MiB |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    with (
        streamed(ADDRESS),
        TieredUpscaler(arguments.tiers.split(","), display_height=None, provider=arguments.provider, threads=None) as tiers,
        open_source(ADDRESS, until_bye=False, tell=say) as source,
    ):
        over.player = Player(source, tiers, NullSink(), tell=say, over=over, deadline_ns=deadline_ns)
        gc.collect()
        gc.freeze()
        if arguments.stolen:
            thief.start()
        over.player.play()


if __name__ == "__main__":
    main()
