"""What the service answers about sweeps: results, curves and figures, with units in the names."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

MetricName = Literal["vmaf", "vmaf_neg", "psnr_y_db"]
TargetMetricName = Literal["vmaf", "vmaf_neg"]
SweepState = Literal["queued", "running", "done", "failed", "cancelled", "partial"]
TERMINAL: tuple[SweepState, ...] = ("done", "failed", "cancelled")


class Schema(BaseModel):
    """Numbers are finite; what is not defined is null and has its reason beside it."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)


class Problem(Schema):
    """Every answer of a status from 400 on: what is wrong, in one sentence."""

    detail: str


class Figure(Schema):
    """A number, or the reason why there is none; exactly one of the two is null."""

    value: float | None
    undefined: str | None = Field(description="why there is no value")


class ClipOfSweep(Schema):
    """A clip as a sweep measured it."""

    clip: str = Field(description="its name in points, curves and latencies")
    sha256: str
    width: int
    height: int
    fps: int
    frames: int | None = Field(description="the most frames that count, null for all")
    source: str | None = Field(description="its name under /api/v1/clips and /api/v1/frames, null where the service has not got the file")


class Failure(Schema):
    """A point (with `requested_kbps`) or a latency (without) that could not be measured; the others of the sweep stay."""

    clip: str
    low_height: int
    upscaler: str
    requested_kbps: int | None
    reason: str


class Progress(Schema):
    """How far a sweep is; totals are null until it is planned. Each event of `/events` is one of these, whole."""

    state: SweepState
    points_total: int | None
    points_done: int = Field(description="measured or found in the store")
    points_failed: int
    latencies_total: int | None
    latencies_done: int
    latencies_failed: int
    elapsed_s: float | None = Field(description="since it began to run")
    remaining_s: float | None = Field(description="for the points that are left, by the pace so far")
    waiting: str | None = Field(description="what it waits for, where it does")
    reason: str | None = Field(description="why it failed, where it did")


class Sweep(Schema):
    """One sweep; `id` is what every other address about it takes."""

    id: str
    origin: Literal["service", "command"] = Field(description="started over HTTP, or by gamesr-sweep on the same store")
    created_at: float = Field(description="seconds since 1970 in UTC")
    clips: list[ClipOfSweep] = Field(description="empty until the sweep is planned")
    upscalers: list[str] = Field(description="none is native resolution")
    low_heights: list[int] = Field(description="encoded heights, the largest first; empty until the sweep is planned")
    bitrates_kbps: list[int] = Field(description="as asked of the encoder")
    progress: Progress
    failures: list[Failure]


class SweepList(Schema):
    """The newest first."""

    sweeps: list[Sweep]


class Quality(Schema):
    """Means over a clip. PSNR in dB, SSIM in -1..1, temporal error in code values, VMAF in 0..100; null is explained in `undefined`."""

    frames: int
    psnr_y_db: float | None
    psnr_u_db: float | None
    psnr_v_db: float | None
    ssim_y: float | None
    temporal_error: float | None
    vmaf: float | None
    vmaf_harmonic_mean: float | None
    vmaf_p5: float | None
    vmaf_neg: float | None
    vmaf_neg_harmonic_mean: float | None
    vmaf_neg_p5: float | None
    undefined: dict[str, str] = Field(description="by figure, why it is null")


class SweepPoint(Schema):
    """One point of an RD curve; `flags` say in words what is to be known of its bitrate."""

    key: str
    clip: str
    upscaler: str
    label: str
    width: int
    height: int
    fps: int
    low_height: int
    rendered_small: bool = Field(description="the small picture was rendered by the game and not downscaled")
    requested_kbps: int
    bitrate_kbps: float = Field(description="the true one, counted from packets")
    flags: list[str]
    quality: Quality
    lpips: float | None
    lpips_undefined: str | None
    encoder: dict[str, Any]
    versions: dict[str, str]


class PointList(Schema):
    sweep: str
    points: list[SweepPoint]


class CurvePoint(Schema):
    bitrate_kbps: float
    requested_kbps: int
    quality: float | None = Field(description="null where `undefined` of the curve says why")


class SweepCurve(Schema):
    """Quality over true bitrate, by rising bitrate."""

    upscaler: str
    label: str
    low_height: int
    points: list[CurvePoint]
    undefined: str | None = Field(description="why a point has no quality, where one has none")


class ClipCurves(Schema):
    clip: str
    curves: list[SweepCurve]


class Grade(Schema):
    """A line to draw: the VMAF that is taken for a word."""

    vmaf: float
    word: str


class CurveList(Schema):
    sweep: str
    metric: MetricName
    metric_label: str
    grades: list[Grade] = Field(description="for VMAF and VMAF-NEG; empty for other metrics")
    clips: list[ClipCurves]


class SeriesName(Schema):
    upscaler: str
    label: str
    low_height: int


class BdRate(Schema):
    """What a curve saves over another one of its clip: percent of bits at equal quality, and quality at equal bits, by metric."""

    clip: str
    series: SeriesName
    anchor: SeriesName
    bd_rate_percent: dict[MetricName, Figure] = Field(description="negative: fewer bits")
    bd_quality: dict[MetricName, Figure] = Field(description="positive: better; dB for PSNR, points for VMAF")


class BdRateList(Schema):
    sweep: str
    bd_rates: list[BdRate]


class Saving(Schema):
    """The bitrate at which a curve reaches the target, and percent of bits that this saves; null where nothing is to be held against."""

    clip: str
    series: SeriesName
    bitrate_kbps: Figure
    over_native_percent: Figure | None
    over_bicubic_percent: Figure | None


class SavingList(Schema):
    sweep: str
    metric: TargetMetricName
    target: float
    savings: list[Saving]


class StageLatency(Schema):
    """Percentiles in microseconds over `count` frames, nearest rank."""

    count: int
    p50: float
    p95: float
    p99: float
    max: float


class Deadline(Schema):
    """The frames that took longer in total than one frame lasts at `fps`."""

    fps: int
    deadline_us: float
    missed_frames: int
    missed_share: float = Field(description="0..1")


class SweepLatency(Schema):
    """How long a client took over each frame of one stream, by stage: decode, upscale, write, total; native has decode and total."""

    clip: str
    upscaler: str
    label: str
    width: int
    height: int
    low_height: int
    bitrate_kbps: float
    machine: str
    threads: int
    frames: int
    latency_us: dict[str, StageLatency]
    deadlines: list[Deadline]


class LatencyList(Schema):
    """Taken while nothing else of a sweep ran."""

    latencies: list[SweepLatency]
