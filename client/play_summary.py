"""What gamesr-play says at its end, for people, for programs and for a service that collects it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

from client.artifact import ModelSpec
from client.cores import machine_name
from client.errors import OutputError
from client.play_tally import KEPT_FRAMES, PlayTally
from client.summary import latency_table
from client.timing import deadline_misses, stage_latencies

if TYPE_CHECKING:
    from client.reception import ReceptionCounts

_POSTED_FPS = (30, 60, 120)


@dataclass(frozen=True)
class PlaySummary:
    """Everything known after playing; at least one frame was shown. `specs` and `costs_ns` are of the tiers, the best first."""

    source: str
    ended: str
    tally: PlayTally
    specs: Mapping[str, ModelSpec]
    costs_ns: Sequence[int]
    provider: str
    threads: int
    deadline_ns: int
    period_ns: int
    reception: ReceptionCounts | None
    decode_errors: int
    events: Mapping[str, int]

    def record(self) -> dict[str, object]:
        """One object for JSON; times of stages in microseconds, others as their names say."""
        tally = self.tally
        latencies = tally.latencies(network=self.reception is not None)
        return {
            "source": self.source,
            "ended": self.ended,
            "sizes": [list(size) for size in tally.sizes],
            "scale": self._spec.scale,
            "provider": self.provider,
            "threads": self.threads,
            "deadline_ms": self.deadline_ns / 1e6,
            "period_ms": self.period_ns / 1e6,
            "seconds": self._seconds,
            "frames": {
                "shown": tally.shown,
                "late": tally.late,
                "left_out": tally.left_out,
                "unready": tally.unready,
                "damaged": tally.damaged,
                "repeated": tally.repeated,
            },
            "deadlines_kept": self._kept,
            "freezes": tally.freezes,
            "longest_gap_ms": tally.longest_gap_ns / 1e6,
            "state_restarts": dict(tally.restarts),
            "tiers": [
                {"name": name, "sha256": spec.sha256, "warm_up_ms": cost_ns / 1e6, "frames": tally.tier_frames[name]}
                for (name, spec), cost_ns in zip(self.specs.items(), self.costs_ns, strict=True)
            ],
            "switched": tally.switched,
            "switches": [
                {
                    "at_s": self._at_s(switch.at_ns),
                    "from": self._names[switch.before],
                    "to": self._names[switch.after],
                    "reason": switch.reason,
                }
                for switch in tally.switches
            ],
            "decode_errors": self.decode_errors,
            "reception": None if self.reception is None else asdict(self.reception),
            "events": dict(self.events),
            "latency_us": {stage: latency.record() for stage, latency in latencies.items()},
        }

    def text(self) -> str:
        """One screen of plain text."""
        tally, spec = self.tally, self._spec
        sizes = ", then ".join(f"{width}x{height}" for width, height in list(tally.sizes)[-3:])
        tiers = ", ".join(
            f"{name} {tally.tier_frames[name]} ({cost_ns / 1e6:.1f} ms)" for name, cost_ns in zip(self._names, self.costs_ns, strict=True)
        )
        lines = [
            f"{self.source}: {self.ended}",
            f"  picture  {sizes}, x{spec.scale}; {tally.shown} frames shown in {self._seconds:.1f} s, {tally.damaged} damaged"
            f"{f', {tally.repeated} as the one before and not computed' if tally.repeated else ''}",
            f"  deadline {self.deadline_ns / 1e6:.1f} ms: {100 * self._kept:.2f}% kept; {tally.late} late, {tally.left_out} left out"
            f"{f', {tally.unready} came before all tiers were ready' if tally.unready else ''}",
            f"  freezes  {tally.freezes}, the longest gap {tally.longest_gap_ns / 1e6:.0f} ms",
            f"  tiers    {tiers} on {self.provider}, threads {self.threads}; {tally.switched} switches",
        ]
        for switch in list(tally.switches)[-5:]:
            names = f"{self._names[switch.before]} -> {self._names[switch.after]}"
            lines.append(f"    at {self._at_s(switch.at_ns):.1f} s {names}: {switch.reason}")
        if self.reception is not None:
            counts = self.reception
            rate = f"{counts.kbps:.0f} kbit/s, " if counts.span_ns >= 1_000_000_000 else ""
            lines.append(
                f"  network  {rate}{counts.packets} packets, {counts.lost} lost, {counts.late} late, {counts.duplicates} twice, "
                f"{counts.keyframe_requests} key frames asked for, {counts.senders} senders"
            )
        restarts = ", ".join(f"{count} by {reason}" for reason, count in tally.restarts.items())
        if restarts or self.decode_errors:
            lines.append(f"  trouble  {self.decode_errors} pictures not decoded; the memory began anew: {restarts or 'never'}")
        latencies = tally.latencies(network=self.reception is not None)
        lines += latency_table(latencies)
        if self.reception is None:
            lines.append("  note: this source tells nothing of losses nor of when a picture was sent")
        elif "sent" not in latencies:
            lines.append("  note: the sender does not say when it sent (no abs-send-time)")
        else:
            lines.append("  note: `sent`, from sending to presented, holds where sender and player share a clock")
        if tally.shown > KEPT_FRAMES:
            lines.append(f"  note: latencies are of the last {KEPT_FRAMES} frames")
        return "\n".join(lines)

    def posted(self) -> dict[str, object]:
        """What `POST /api/v1/client-latencies` of gamesr-serve takes: of the last size, the times of the tier that computed most of it.

        `total` is as the service's own sweep has it, decoding, upscaling and presenting. What waited before it, and what was left out, was
        the stream's doing as much as the model's, and is in none of this. Raises OutputError where no frame of that size was timed.
        """
        try:
            name, stamps = self.tally.most_shown()
        except ValueError as error:
            raise OutputError("nothing is posted: no picture of the last size was computed after the models were ready") from error
        spec, (width, height) = self.specs[name], self.tally.sizes[-1]
        totals_ns = [passed.written_ns - passed.packet_ns for passed in stamps]
        machine = "".join(letter if " " <= letter <= "~" else "?" for letter in machine_name())[:120]
        return {
            "model": spec.name,
            "model_sha256": spec.sha256,
            "precision": spec.precision,
            "provider": self.provider,
            "threads": self.threads,
            "machine": machine or "unknown",
            "low_width": width,
            "low_height": height,
            "scale": spec.scale,
            "latency_us": {stage: latency.record() for stage, latency in stage_latencies(stamps).items()},
            "deadline_misses": {str(fps): deadline_misses(totals_ns, fps) for fps in _POSTED_FPS},
        }

    @property
    def _names(self) -> list[str]:
        return list(self.specs)

    @property
    def _spec(self) -> ModelSpec:
        return next(iter(self.specs.values()))

    @property
    def _seconds(self) -> float:
        return (self.tally.last_ns - self.tally.first_ns) / 1e9

    @property
    def _kept(self) -> float:
        due = self.tally.shown + self.tally.left_out
        return (due - self.tally.missed) / due

    def _at_s(self, at_ns: int) -> float:
        return (at_ns - self.tally.first_ns) / 1e9
