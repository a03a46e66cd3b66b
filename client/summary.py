"""What a run of gamesr-upscale says at its end, for people and for programs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from client.artifact import ModelSpec
from client.quality import Quality
from client.timing import LatencySummary, Stamps, stage_latencies

_QUALITY_COLUMNS = {
    "PSNR-Y dB": "psnr_y_db",
    "PSNR-U dB": "psnr_u_db",
    "PSNR-V dB": "psnr_v_db",
    "SSIM-Y": "ssim_y",
    "VMAF": "vmaf",
    "VMAF-NEG": "vmaf_neg",
}


@dataclass(frozen=True)
class Summary:
    """Everything known after a run. Sizes are (width, height); `stamps` holds one entry for every frame, at least one.

    `skipped_share` is the share of all tiles of all frames that were not computed; None where skipping was not asked for.
    """

    input: Path
    output: Path
    input_size: tuple[int, int]
    output_size: tuple[int, int]
    model: ModelSpec
    provider: str
    threads: int
    stamps: Sequence[Stamps]
    decode_errors: int
    damaged_frames: int
    state_resets: int
    skipped_share: float | None = None
    network_share: float | None = None
    quality: Mapping[str, Quality] = field(default_factory=dict)
    notes: Sequence[str] = ()

    @property
    def fps(self) -> float:
        """Frames per second of decode, upscale and write together; warm-up and measuring are not counted."""
        return len(self.stamps) / (sum(s.written_ns - s.packet_ns for s in self.stamps) / 1e9)

    def record(self) -> dict[str, object]:
        """One object for JSON; latencies in microseconds, undefined figures of quality are null with their reason beside."""
        record: dict[str, object] = {
            "frames": len(self.stamps),
            "decode_errors": self.decode_errors,
            "damaged_frames": self.damaged_frames,
            "state_resets": self.state_resets,
            "skipped_share": self.skipped_share,
            "network_share": self.network_share,
            "input": {"path": str(self.input), "width": self.input_size[0], "height": self.input_size[1]},
            "output": {"path": str(self.output), "width": self.output_size[0], "height": self.output_size[1]},
            "model": {
                "name": self.model.name,
                "sha256": self.model.sha256,
                "scale": self.model.scale,
                "precision": self.model.precision,
            },
            "provider": self.provider,
            "threads": self.threads,
            "latency_us": {stage: latency.record() for stage, latency in stage_latencies(self.stamps).items()},
            "fps": self.fps,
            "notes": list(self.notes),
        }
        if self.quality:
            record["quality"] = {name: quality.record() for name, quality in self.quality.items()}
        return record

    def text(self) -> str:
        """One screen of plain text."""
        lines = [
            f"{self.input} -> {self.output}",
            f"  picture  {_size(self.input_size)} -> {_size(self.output_size)}, {len(self.stamps)} frames",
            f"  model    {self.model.name} x{self.model.scale} {self.model.precision}, sha256 {self.model.sha256[:12]}",
            f"  runtime  {self.fps:.1f} frames/s on {self.provider}, threads {self.threads} (warm-up not counted)",
        ]
        if self.decode_errors or self.damaged_frames or self.state_resets:
            resets = f"{self.damaged_frames} frames damaged, {self.state_resets} state resets"
            lines.append(f"  trouble  {self.decode_errors} packets not decoded, {resets}")
        if self.skipped_share is not None:
            lines.append(f"  skipped  {100 * self.skipped_share:.1f}% of the tiles or frames, which had not changed")
        if self.network_share is not None:
            lines.append(f"  network  on {100 * self.network_share:.1f}% of the picture, where most detail is; bicubic elsewhere")
        lines += latency_table(stage_latencies(self.stamps))
        if self.quality:
            lines.append(f"  {'quality':<12}" + "".join(f"{head:>10}" for head in _QUALITY_COLUMNS))
            lines += [f"    {name:<10}" + _quality_cells(quality) for name, quality in self.quality.items()]
        lines += [f"  note: {note}" for note in (*self.notes, *self._reasons())]
        return "\n".join(lines)

    def _reasons(self) -> list[str]:
        """Why figures are missing, each reason once."""
        missing: dict[str, list[str]] = {}
        for quality in self.quality.values():
            for head, name in _QUALITY_COLUMNS.items():
                heads = missing.setdefault(quality.undefined[name], []) if name in quality.undefined else [head]
                if head not in heads:
                    heads.append(head)
        return [f"no {', '.join(heads)}: {reason}" for reason, heads in missing.items()]


def latency_table(latencies: Mapping[str, LatencySummary]) -> list[str]:
    """A line a stage, in milliseconds, below a head."""
    lines = [f"  {'latency, ms':<12}" + "".join(f"{head:>10}" for head in ("p50", "p95", "p99", "max"))]
    for stage, latency in latencies.items():
        values = (latency.p50, latency.p95, latency.p99, latency.max)
        lines.append(f"    {stage:<10}" + "".join(f"{value / 1000:>10.2f}" for value in values))
    return lines


def _quality_cells(quality: Quality) -> str:
    values = (getattr(quality, name) for name in _QUALITY_COLUMNS.values())
    return "".join(f"{'-' if value is None else format(value, '.4f' if value <= 1 else '.2f'):>10}" for value in values)


def _size(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]}"
