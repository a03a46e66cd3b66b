"""For what watches over the service."""

from __future__ import annotations

from importlib.metadata import version
from typing import Any

from fastapi import APIRouter, Response
from prometheus_client import CONTENT_TYPE_LATEST

from server.requests import Health
from server.runner import runs
from server.service import Shared, problems

_TEXT: dict[int | str, dict[str, Any]] = {200: {"content": {"text/plain": {"schema": {"type": "string"}}}, "description": "Prometheus"}}

router = APIRouter(tags=["health"])


@router.get("/health", responses=problems())
def read_health(service: Shared) -> Health:
    """The service answers."""
    return _health(service)


@router.get("/ready", responses=problems())
def read_readiness(service: Shared) -> Health:
    """The service answers, and store and queue can be read; 503 and the reason where they cannot."""
    service.reader.totals()
    service.queue.waiting()
    return _health(service)


@router.get("/metrics", response_class=Response, responses=_TEXT | problems())
def read_metrics(service: Shared) -> Response:
    """Figures for Prometheus."""
    return Response(service.monitoring.text(), media_type=CONTENT_TYPE_LATEST)


def _health(service: Shared) -> Health:
    return Health(status="ok", runner=runs(service.settings.data), version=version("gamesr"))
