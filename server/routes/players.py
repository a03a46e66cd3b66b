"""What players really get: latencies that their clients post."""

from __future__ import annotations

from fastapi import APIRouter, Depends

from server.guards import require_key
from server.requests import ClientLatency, ClientLatencyList, ClientLatencyRequest
from server.service import Shared, problems

router = APIRouter(prefix="/client-latencies", tags=["client latencies"])


@router.get("", responses=problems())
def list_client_latencies(service: Shared) -> ClientLatencyList:
    """The newest 200."""
    return ClientLatencyList(latencies=service.players.newest())


@router.post("", status_code=201, responses=problems(400, 401, 408, 413), dependencies=[Depends(require_key)])
def post_client_latency(posted: ClientLatencyRequest, service: Shared) -> ClientLatency:
    """One summary of one player's client."""
    return service.players.add(posted)
