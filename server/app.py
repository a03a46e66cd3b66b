"""The service: what a sweep's store holds, over HTTP, and sweeps that are started over HTTP.

Everything is JSON (`server.schemas`, `server.requests`), everything of a status from 400 on is `Problem`, and /api/v1/openapi.json
describes all of it. What changes something takes the header X-API-Key where a key is configured. HEAD is answered wherever GET is.

    GET    /                                             the page; /static/ is its files
    GET    /health  /ready                               Health; 503 when not ready
    GET    /metrics                                      Prometheus
    GET    /api/v1/sweeps                                SweepList
    POST   /api/v1/sweeps                   SweepRequest 202 Sweep; 404 no such clip, 422 unfit, 429 queue full
    GET    /api/v1/sweeps/{id}                           Sweep
    POST   /api/v1/sweeps/{id}/cancel                    202 Sweep; 409 when it is over
    GET    /api/v1/sweeps/{id}/events                    server-sent events `progress`: Progress, whole, whenever it changes;
                                                         ends when the sweep is over or after a while (EventSource connects again)
    GET    /api/v1/sweeps/{id}/points?clip=              PointList
    GET    /api/v1/sweeps/{id}/curves?metric=vmaf        CurveList; metric is vmaf, vmaf_neg or psnr_y_db
    GET    /api/v1/sweeps/{id}/bd-rates                  BdRateList
    GET    /api/v1/sweeps/{id}/savings?target=80         SavingList; metric=vmaf or vmaf_neg, target in 0..100
    GET    /api/v1/sweeps/{id}/latencies                 LatencyList
    GET    /api/v1/latencies?upscaler=                   LatencyList, of all sweeps
    GET    /api/v1/client-latencies                      ClientLatencyList
    POST   /api/v1/client-latencies ClientLatencyRequest 201 ClientLatency
    GET    /api/v1/models                                ModelList; /api/v1/models/{name}?scale=2 is one Artifact
    GET    /api/v1/clips                                 ClipList
    POST   /api/v1/clips?title=        the file itself   201 StoredClip; 408 stopped coming, 413 too large, 415 not a video type,
                                                         422 no video that can be used, 429 too many at once
    GET    /api/v1/clips/{name}                          StoredClip
    DELETE /api/v1/clips/{name}                          204, uploads only; 409 while a sweep needs it
    GET    /api/v1/frames/{clip}/{frame}?picture=reference
    GET    /api/v1/frames/{clip}/{frame}?picture=NAME&low_height=270&bitrate_kbps=1000
                                                         image/png; 202 while it is computed (ask again after Retry-After),
                                                         304 for the ETag of If-None-Match,
                                                         404 no such clip or frame, 422 unfit, 429 too many at once

A picture is `reference`, `none` (native: the clip itself, encoded; `low_height` is then the clip's) or the name of a model. A clip
of a sweep is found by `Sweep.clips[].source`, null where the service has not got the file. A frame is a number from 0.
"""

from __future__ import annotations

import logging
from importlib.metadata import version
from pathlib import Path

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from starlette.exceptions import HTTPException
from starlette.staticfiles import StaticFiles
from starlette.types import Scope

from client.errors import GamesrError
from server.cards import artifacts
from server.guards import Guards
from server.methods import Heads, allowed
from server.monitoring import Watched
from server.routes import clips, frames, health, models, players, results, sweeps
from server.service import Service
from server.settings import Settings

PREFIX = "/api/v1"
PAGE = Path(__file__).parent / "page"
DESCRIPTION = "Rate-distortion curves of upscalers on game footage, what they save, what they cost, and sweeps that measure them."
_LOG = logging.getLogger(__name__)


def create_app(settings: Settings) -> FastAPI:
    """The service for any ASGI server; raises OutputError for a store or a folder that cannot be used."""
    service = Service(settings)
    artifacts()  # read before the first request waits for it
    # The pages that FastAPI has for its own description load scripts from elsewhere.
    app = FastAPI(
        title="gamesr-serve",
        description=DESCRIPTION,
        version=version("gamesr"),
        openapi_url=f"{PREFIX}/openapi.json",
        docs_url=None,
        redoc_url=None,
    )
    app.state.service = service
    app.add_middleware(Heads)
    app.add_middleware(Guards, limits=settings.limits, loopback=settings.loopback, public_name=settings.public_name)
    app.add_middleware(Watched, monitoring=service.monitoring)
    app.add_exception_handler(HTTPException, _refused)
    app.add_exception_handler(RequestValidationError, _unfit)
    app.add_exception_handler(GamesrError, _unusable)
    app.add_exception_handler(Exception, _broken)
    app.include_router(health.router)
    for subject in (sweeps, results, clips, frames, models, players):
        app.include_router(subject.router, prefix=PREFIX)
    files = _PageFiles(directory=PAGE, check_dir=False)

    @app.get("/", include_in_schema=False)
    async def page(request: Request) -> Response:
        return await files.get_response("index.html", request.scope)

    app.mount("/static", files)
    app.openapi()  # written once, and not while requests wait
    return app


class _PageFiles(StaticFiles):
    """A browser keeps them, and asks whether they are still the same."""

    async def get_response(self, path: str, scope: Scope) -> Response:
        response = await super().get_response(path, scope)
        response.headers["Cache-Control"] = "no-cache"
        return response


async def _refused(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, HTTPException)
    methods = allowed(request.app, request.scope) if error.status_code == 405 else ""
    headers = {"Allow": methods} if methods else error.headers
    return JSONResponse({"detail": str(error.detail)}, error.status_code, headers)


async def _unfit(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError)
    found = [f"{'.'.join(str(part) for part in one['loc'])}: {one['msg']}" for one in error.errors()[:5]]
    return JSONResponse({"detail": "; ".join(found)}, 422)


async def _unusable(request: Request, error: Exception) -> JSONResponse:
    _LOG.error("%s", error)
    return JSONResponse({"detail": "the store or the service's folder cannot be used: see the service's log"}, 503)


async def _broken(request: Request, error: Exception) -> JSONResponse:
    return JSONResponse({"detail": "an error of the service: see its log"}, 500)  # the server writes the trace there
