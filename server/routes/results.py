"""What sweeps measured: points, curves, BD-rates, savings, latencies."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Annotated

from fastapi import APIRouter, HTTPException, Query, Response
from pydantic import BaseModel
from starlette.concurrency import run_in_threadpool

from server import answers
from server.points import LatencyResult, PointResult
from server.requests import NAME
from server.routes.sweeps import SweepId
from server.schemas import BdRateList, CurveList, LatencyList, MetricName, PointList, SavingList, TargetMetricName
from server.service import Service, Shared, problems

MOST_NAME = 500
Build = Callable[[Sequence[PointResult], Sequence[LatencyResult]], BaseModel]

router = APIRouter(tags=["results"])


@router.get("/sweeps/{sweep}/points", response_model=PointList, responses=problems(404))
async def read_points(
    sweep: SweepId,
    service: Shared,
    clip: Annotated[str | None, Query(min_length=1, max_length=MOST_NAME, description="only of this clip")] = None,
) -> Response:
    """Every measured point, curve by curve."""

    def build(points: Sequence[PointResult], _: Sequence[LatencyResult]) -> BaseModel:
        return answers.point_list(sweep, [result for result in points if clip in (None, result.point.clip)])

    return await _answer(service, sweep, build, "points", clip)


@router.get("/sweeps/{sweep}/curves", response_model=CurveList, responses=problems(404))
async def read_curves(sweep: SweepId, service: Shared, metric: MetricName = "vmaf") -> Response:
    """RD curves: quality over true bitrate, clip by clip."""
    return await _answer(service, sweep, lambda points, _: answers.curve_list(sweep, points, metric), "curves", metric)


@router.get("/sweeps/{sweep}/bd-rates", response_model=BdRateList, responses=problems(404))
async def read_bd_rates(sweep: SweepId, service: Shared) -> Response:
    """Every curve against native resolution and against bicubic at its own height."""
    return await _answer(service, sweep, lambda points, _: answers.bd_rate_list(sweep, points), "bd-rates")


@router.get("/sweeps/{sweep}/savings", response_model=SavingList, responses=problems(404))
async def read_savings(
    sweep: SweepId,
    service: Shared,
    target: Annotated[float, Query(ge=0, le=100, allow_inf_nan=False, description="a quality in points of VMAF")] = 80.0,
    metric: TargetMetricName = "vmaf",
) -> Response:
    """The bitrate that reaches a quality, interpolated as BD-rate is and never extrapolated, and what that saves."""
    return await _answer(service, sweep, lambda points, _: answers.saving_list(sweep, points, metric, target), "savings", metric, target)


@router.get("/sweeps/{sweep}/latencies", response_model=LatencyList, responses=problems(404))
async def read_latencies(sweep: SweepId, service: Shared) -> Response:
    """Milliseconds of every upscaler, stage by stage, and the share of frames that missed 30, 60 and 120 fps."""
    return await _answer(service, sweep, lambda _, latencies: answers.latency_list(latencies), "latencies")


@router.get("/latencies", tags=["results"], responses=problems())
def read_all_latencies(
    service: Shared, upscaler: Annotated[str | None, Query(pattern=NAME, description="only of this one")] = None
) -> LatencyList:
    """As of one sweep, but everything that the store holds, the newest first."""
    return answers.latency_list([result for result in service.reader.all_latencies() if upscaler in (None, result.upscaler)])


async def _answer(service: Service, sweep: str, build: Build, *about: object) -> Response:
    content = service.sweeps.latest(sweep, *about)
    if content is None:
        async with service.building:  # of many who ask for the same at once, one builds it
            content = service.sweeps.latest(sweep, *about)
            if content is None:
                content = await run_in_threadpool(service.sweeps.answer, sweep, build, *about)
    if content is None:
        raise HTTPException(404, f"there is no sweep {sweep}")
    return Response(content, media_type="application/json")
