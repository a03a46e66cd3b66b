"""The service: what a sweep's store holds, over HTTP, and sweeps that are started over HTTP.

Everything is JSON (`server.schemas`, `server.requests`), everything of a status from 400 on is `Problem`, and /api/v1/openapi.json
describes all of it. What changes something takes the header X-API-Key where a key is configured.

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
                                                         404 no such clip or frame, 422 unfit, 429 too many at once

A picture is `reference`, `none` (native: the clip itself, encoded; `low_height` is then the clip's) or the name of a model. A clip
of a sweep is found by `Sweep.clips[].source`, null where the service has not got the file. A frame is a number from 0.
"""
