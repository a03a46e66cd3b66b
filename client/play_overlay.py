"""The overlay's lines: what a player measured in its last seconds."""

from __future__ import annotations

import time

from client.play_source import PlaySource
from client.player import Player
from client.tiers import TieredUpscaler

_FRAMES = 120  # that percentiles are of
_STAGES = ("decode", "upscale", "present", "total")


class OverlayLines:
    """Call it now and then: bitrate and loss are those since the call before."""

    def __init__(self, player: Player, source: PlaySource, tiers: TieredUpscaler) -> None:
        self._player, self._source, self._tiers = player, source, tiers
        self._at_ns = time.perf_counter_ns()
        self._bytes = self._packets = self._lost = 0

    def __call__(self) -> list[str]:
        player, tally = self._player, self._player.tally
        fps = 1e9 / player.period.ns
        lines = [f"{self._tiers.names[self._tiers.tier]} x{self._tiers.specs[0].scale}, {fps:.0f} fps, {tally.switched} switches"]
        reception = self._source.reception
        if reception is None:
            lines.append("bitrate and loss are not known of this source")
        else:
            now_ns = time.perf_counter_ns()
            kbps = (reception.bytes - self._bytes) * 8e6 / max(1, now_ns - self._at_ns)
            lost, packets = reception.lost - self._lost, reception.packets - self._packets
            lines.append(f"{kbps / 1000:.1f} Mbit/s, {100 * lost / max(1, lost + packets):.1f}% lost")
            self._at_ns, self._bytes, self._packets, self._lost = now_ns, reception.bytes, reception.packets, reception.lost
        latencies = tally.latencies(network=False, newest=_FRAMES)
        lines.append(f"{'ms':<8}{'p50':>6} {'p95':>6}")
        lines += [
            f"{stage:<8}{latencies[stage].p50 / 1000:6.1f} {latencies[stage].p95 / 1000:6.1f}" for stage in _STAGES if stage in latencies
        ]
        lines.append(f"queue {self._source.waiting()}, late {tally.late}, left out {tally.left_out}, freezes {tally.freezes}")
        return lines
