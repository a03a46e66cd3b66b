"""Results of sweeps that never ran, of the shape that real ones have."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from client.cloud import CloudSettings
from client.quality import Quality
from client.timing import LatencySummary
from server.points import DEADLINES_FPS, LatencyResult, Point, PointResult

BITRATES_KBPS = (2000, 4000, 8000, 16000, 25000)
_GAIN = {"none": 0.0, "bicubic": 12.0, "lanczos": 11.5, "easu": 12.6, "fsr1": 14.0, "gamesr": 17.0}
_UPSCALE_MS = {"none": 0.0, "bicubic": 9.0, "lanczos": 11.0, "easu": 300.0, "fsr1": 390.0, "gamesr": 230.0}


def point_result(clip: str, upscaler: str, low_height: int, requested_kbps: int, **quality: Any) -> PointResult:
    """One point on a curve that rises with the logarithm of the bitrate; `quality` replaces figures."""
    reach = 1.0 if upscaler == "none" else {540: 0.62, 360: 0.45}[low_height]
    octaves = math.log2(requested_kbps / 1000)
    vmaf = 100 - (85 - _GAIN[upscaler]) * 2 ** (-0.45 * octaves) - (1 - reach) * 12 - (2 if clip == "track" else 0)
    figures: dict[str, Any] = {
        "frames": 60,
        "psnr_y_db": 27 + 2.2 * octaves + _GAIN[upscaler] / 8,
        "psnr_u_db": 38 + octaves,
        "psnr_v_db": 39 + octaves,
        "ssim_y": 1 - 0.2 * 2**-octaves,
        "temporal_error": 8 / (1 + octaves),
        "vmaf": vmaf,
        "vmaf_harmonic_mean": vmaf - 0.5,
        "vmaf_p5": vmaf - 6,
        "vmaf_neg": vmaf - 2,
        "vmaf_neg_harmonic_mean": vmaf - 2.5,
        "vmaf_neg_p5": vmaf - 8,
        **quality,
    }
    point = Point(
        clip=clip,
        clip_sha256=clip * 4,
        width=1920,
        height=1080,
        fps=60,
        frames=60,
        low_height=low_height,
        low_sha256=None,
        requested_kbps=requested_kbps,
        encoder=CloudSettings(requested_kbps, 60).record(),
        upscaler=upscaler,
        upscaler_sha256=None if upscaler == "none" else upscaler * 4,
        versions={"av": "18.1.0", "vmaf": "vmaf_v0.6.1"},
    )
    return PointResult(point, requested_kbps * 1.02, (), Quality(**figures), None, "no LPIPS model was given (--lpips FILE)")


def sweep_results(clips: tuple[str, ...] = ("map", "track"), heights: tuple[int, ...] = (540, 360)) -> list[PointResult]:
    series = [("none", 1080), *((name, height) for height in heights for name in list(_GAIN)[1:])]
    return [point_result(clip, name, height, kbps) for clip in clips for name, height in series for kbps in BITRATES_KBPS]


def latency_results(clips: tuple[str, ...] = ("map", "track"), heights: tuple[int, ...] = (540, 360)) -> list[LatencyResult]:
    series = [("none", 1080), *((name, height) for height in heights for name in list(_GAIN)[1:])]
    return [_latency(clip, name, height) for clip in clips for name, height in series]


def _latency(clip: str, upscaler: str, low_height: int) -> LatencyResult:
    decode = LatencySummary(100, 2100.0, 3000.0, 3500.0, 4000.0)
    spent = 1000 * _UPSCALE_MS[upscaler] * (1 if low_height == 540 else 0.8)
    upscale = LatencySummary(100, spent, 1.1 * spent, 1.2 * spent, 1.3 * spent)
    total = LatencySummary(100, decode.p50 + upscale.p50, decode.p95 + upscale.p95, decode.p99 + upscale.p99, decode.max + upscale.max)
    stages = {"decode": decode, "total": total} if upscaler == "none" else {"decode": decode, "upscale": upscale, "total": total}
    misses = {fps: 100 if total.p50 > 1e6 / fps else 3 if total.p99 > 1e6 / fps else 0 for fps in DEADLINES_FPS}
    return LatencyResult(
        clip=clip,
        clip_sha256=clip * 4,
        width=1920,
        height=1080,
        low_height=low_height,
        bitrate_kbps=8123.0,
        upscaler=upscaler,
        upscaler_sha256=None if upscaler == "none" else upscaler * 4,
        machine="a machine",
        threads=2,
        latency_us=stages,
        deadline_misses=misses,
    )


def with_quality(result: PointResult, **quality: Any) -> PointResult:
    return replace(result, quality=replace(result.quality, **quality))
