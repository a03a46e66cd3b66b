"""Figures for Prometheus: requests as they pass, everything else as it is at the moment of the scrape."""

from __future__ import annotations

import time
from collections.abc import Iterator

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.registry import Collector
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from server.points import LatencyResult
from server.queue import SweepQueue
from server.reading import StoreReader
from server.runner import runs
from server.settings import Settings

_BUCKETS_S = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 10.0)
_QUANTILES = ("p50", "p95", "p99")


class Monitoring:
    """The registry of one service."""

    def __init__(self, settings: Settings, reader: StoreReader, queue: SweepQueue) -> None:
        self._registry = CollectorRegistry()
        self.requests = Counter("gamesr_http_requests", "Requests answered", ("method", "route", "status"), registry=self._registry)
        self.seconds = Histogram(
            "gamesr_http_request_seconds",
            "Time to the head of the answer",
            ("method", "route"),
            buckets=_BUCKETS_S,
            registry=self._registry,
        )
        self.uploads_refused = Counter("gamesr_uploads_refused", "Uploads that were no usable clip", registry=self._registry)
        self.event_streams = Gauge("gamesr_event_streams", "Open streams of server-sent events", registry=self._registry)
        self._registry.register(_State(settings, reader, queue))

    def text(self) -> bytes:
        return generate_latest(self._registry)


class _State(Collector):
    def __init__(self, settings: Settings, reader: StoreReader, queue: SweepQueue) -> None:
        self._settings, self._reader, self._queue = settings, reader, queue

    def collect(self) -> Iterator[GaugeMetricFamily]:
        points, latencies = self._reader.totals()
        yield GaugeMetricFamily("gamesr_store_points", "Measured points in the store", points)
        yield GaugeMetricFamily("gamesr_store_latencies", "Measured latencies in the store", latencies)
        yield GaugeMetricFamily("gamesr_sweeps_waiting", "Sweeps in the queue", self._queue.waiting())
        yield GaugeMetricFamily("gamesr_sweeps_running", "Sweeps that run", self._queue.running())
        yield GaugeMetricFamily("gamesr_runner_up", "Whether sweeps are being run", runs(self._settings.data))
        yield _latencies(self._reader.all_latencies())

    def describe(self) -> list[GaugeMetricFamily]:
        return []


def _latencies(results: list[LatencyResult]) -> GaugeMetricFamily:
    """The newest of every upscaler, size and stage, in seconds as Prometheus wants it."""
    names = ("upscaler", "height", "low_height", "stage", "quantile")
    family = GaugeMetricFamily("gamesr_frame_seconds", "Measured time of a stage of one frame", labels=names)
    seen = set()
    for result in results:
        for stage, summary in result.latency_us.items():
            labels = [result.upscaler, str(result.height), str(result.low_height), stage]
            if tuple(labels) not in seen:
                seen.add(tuple(labels))
                for quantile in _QUANTILES:
                    family.add_metric([*labels, quantile], getattr(summary, quantile) / 1e6)
    return family


class Watched:
    """The middleware that counts and times; a route is its pattern, so that no caller makes new ones up."""

    def __init__(self, app: ASGIApp, *, monitoring: Monitoring) -> None:
        self._app, self._monitoring = app, monitoring

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        begin = time.perf_counter()

        async def watched(message: Message) -> None:
            if message["type"] == "http.response.start":
                route = getattr(scope.get("route"), "path", "other")
                method = scope["method"] if scope["method"] in ("GET", "POST", "DELETE", "HEAD") else "other"
                self._monitoring.requests.labels(method, route, message["status"]).inc()
                self._monitoring.seconds.labels(method, route).observe(time.perf_counter() - begin)
            await send(message)

        await self._app(scope, receive, watched)
