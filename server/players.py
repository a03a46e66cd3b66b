"""What players' clients saw while they played, as they post it."""

from __future__ import annotations

import json
import secrets
import time

from server.answers import deadline
from server.database import Database
from server.requests import ClientLatency, ClientLatencyRequest
from server.schemas import StageLatency

LISTED = 200


class Players:
    """Latencies that were posted; the newest `kept` are remembered."""

    def __init__(self, database: Database, *, kept: int) -> None:
        self._database, self._kept = database, kept

    def add(self, request: ClientLatencyRequest) -> ClientLatency:
        row = (secrets.token_hex(8), time.time(), request.model_dump_json())
        with self._database.transaction() as connection:
            connection.execute("INSERT INTO client_latencies VALUES (?, ?, ?)", row)
            old = "SELECT rowid FROM client_latencies ORDER BY rowid DESC LIMIT -1 OFFSET ?"
            connection.execute(f"DELETE FROM client_latencies WHERE rowid IN ({old})", (self._kept,))
        return _posted(*row)

    def newest(self) -> list[ClientLatency]:
        """At most LISTED."""
        rows = self._database.rows("SELECT id, received_at, record FROM client_latencies ORDER BY rowid DESC LIMIT ?", LISTED)
        return [_posted(*row) for row in rows]


def _posted(identity: str, received_at: float, record: str) -> ClientLatency:
    request = ClientLatencyRequest.model_validate(json.loads(record))
    frames = request.latency_us.total.count
    return ClientLatency(
        id=identity,
        received_at=received_at,
        model=request.model,
        model_sha256=request.model_sha256,
        precision=request.precision,
        provider=request.provider,
        threads=request.threads,
        machine=request.machine,
        width=request.low_width * request.scale,
        height=request.low_height * request.scale,
        low_width=request.low_width,
        low_height=request.low_height,
        scale=request.scale,
        frames=frames,
        latency_us={
            name: StageLatency(**summary.model_dump())
            for name in type(request.latency_us).model_fields
            if (summary := getattr(request.latency_us, name)) is not None
        },
        deadlines=[deadline(int(fps), missed, frames) for fps, missed in sorted(request.deadline_misses.items(), key=lambda x: int(x[0]))],
    )
