"""Sweeps that were asked for over HTTP: they wait, run one at a time, and are remembered. All of it is in the service's file."""

from __future__ import annotations

import json
import secrets
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

from server.database import Database
from server.requests import SweepRequest
from server.schemas import TERMINAL, Failure, Progress, SweepState

_COLUMNS = "id, created_at, state, cancel, request, plan_key, progress, failures"
_ACTIVE = "state IN ('queued', 'running')"


class QueueFullError(Exception):
    """As many sweeps wait as may."""


@dataclass(frozen=True)
class QueuedSweep:
    """One sweep; `cancel` says that somebody wants it to end, `plan_key` is of its `AskedSweep` once it is planned."""

    id: str
    created_at: float
    cancel: bool
    request: SweepRequest
    plan_key: str | None
    progress: Progress
    failures: tuple[Failure, ...]

    @property
    def over(self) -> bool:
        return self.progress.state in TERMINAL


def fresh_progress(state: SweepState, reason: str | None = None) -> Progress:
    """Nothing done yet."""
    return Progress(
        state=state,
        points_total=None,
        points_done=0,
        points_failed=0,
        latencies_total=None,
        latencies_done=0,
        latencies_failed=0,
        elapsed_s=None,
        remaining_s=None,
        waiting=None,
        reason=reason,
    )


class SweepQueue:
    """At most `most` wait; of those that are over the newest `kept` are remembered."""

    def __init__(self, database: Database, *, most: int, kept: int) -> None:
        self._database, self._most, self._kept = database, most, kept
        self.path = database.path

    def add(self, request: SweepRequest) -> QueuedSweep:
        """Put a sweep at the end; raises QueueFullError."""
        sweep = secrets.token_hex(8)
        progress = fresh_progress("queued").model_dump_json()
        with self._database.transaction() as connection:
            (waiting,) = connection.execute("SELECT count(*) FROM sweeps WHERE state = 'queued'").fetchone()
            if waiting >= self._most:
                raise QueueFullError
            row = (sweep, time.time(), "queued", 0, request.model_dump_json(), None, progress, "[]")
            connection.execute(f"INSERT INTO sweeps ({_COLUMNS}) VALUES (?, ?, ?, ?, ?, ?, ?, ?)", row)
            old = f"SELECT id FROM sweeps WHERE NOT {_ACTIVE} ORDER BY created_at DESC LIMIT -1 OFFSET ?"
            connection.execute(f"DELETE FROM sweeps WHERE id IN ({old})", (self._kept,))
        return self[sweep]

    def __getitem__(self, sweep: str) -> QueuedSweep:
        found = self.find(sweep)
        if found is None:
            raise KeyError(sweep)
        return found

    def find(self, sweep: str) -> QueuedSweep | None:
        rows = self._database.rows(f"SELECT {_COLUMNS} FROM sweeps WHERE id = ?", sweep)
        return _queued(rows[0]) if rows else None

    def all(self) -> list[QueuedSweep]:
        """The newest first."""
        return [_queued(row) for row in self._database.rows(f"SELECT {_COLUMNS} FROM sweeps ORDER BY created_at DESC, rowid DESC")]

    def waiting(self) -> int:
        return int(self._database.rows("SELECT count(*) FROM sweeps WHERE state = 'queued'")[0][0])

    def running(self) -> int:
        return int(self._database.rows("SELECT count(*) FROM sweeps WHERE state = 'running'")[0][0])

    def needs(self, clip: str) -> bool:
        """Whether a sweep that is not over was asked for with this clip."""
        rows = self._database.rows(f"SELECT request FROM sweeps WHERE {_ACTIVE}")
        return any(clip in json.loads(request)["clips"] for (request,) in rows)

    def cancel(self, sweep: str) -> None:
        """One that waits is cancelled with this; one that runs is told, and its runner ends it."""
        progress = fresh_progress("cancelled").model_dump_json()
        with self._database.transaction() as connection:
            connection.execute(
                "UPDATE sweeps SET state = 'cancelled', progress = ? WHERE id = ? AND state = 'queued'",
                (progress, sweep),
            )
            connection.execute("UPDATE sweeps SET cancel = 1 WHERE id = ? AND state = 'running'", (sweep,))

    def take(self) -> str | None:
        """The one that has waited longest, which runs from now on."""
        with self._database.transaction() as connection:
            row = connection.execute("SELECT id FROM sweeps WHERE state = 'queued' ORDER BY created_at, rowid LIMIT 1").fetchone()
            if row is None:
                return None
            progress = fresh_progress("running").model_dump_json()
            connection.execute("UPDATE sweeps SET state = 'running', progress = ? WHERE id = ?", (progress, row[0]))
        return str(row[0])

    def put_back(self) -> None:
        """What runs waits again, in its old place: its runner ends, or ended without a word."""
        progress = fresh_progress("queued").model_dump_json()
        with self._database.transaction() as connection:
            connection.execute("UPDATE sweeps SET state = 'queued', progress = ? WHERE state = 'running'", (progress,))

    def report(self, sweep: str, progress: Progress, failures: Sequence[Failure], plan_key: str | None) -> None:
        """What its process has to say of a sweep that runs; nothing changes where it is over already."""
        listed = json.dumps([failure.model_dump() for failure in failures])
        with self._database.transaction() as connection:
            connection.execute(
                "UPDATE sweeps SET state = ?, progress = ?, failures = ?, plan_key = ? WHERE id = ? AND state = 'running'",
                (progress.state, progress.model_dump_json(), listed, plan_key, sweep),
            )

    def end(self, sweep: str, state: SweepState, reason: str | None = None) -> None:
        """Say for its process how a sweep ended; what that reported stays."""
        progress = self[sweep].progress.model_copy(update={"state": state, "reason": reason, "remaining_s": None, "waiting": None})
        with self._database.transaction() as connection:
            connection.execute(
                "UPDATE sweeps SET state = ?, progress = ? WHERE id = ? AND state = 'running'", (state, progress.model_dump_json(), sweep)
            )


def _queued(row: tuple[Any, ...]) -> QueuedSweep:
    sweep, created_at, _, cancel, request, plan_key, progress, failures = row
    return QueuedSweep(
        id=sweep,
        created_at=created_at,
        cancel=bool(cancel),
        request=SweepRequest.model_validate_json(request),
        plan_key=cast("str | None", plan_key),
        progress=Progress.model_validate_json(progress),
        failures=tuple(Failure(**failure) for failure in json.loads(failures)),
    )
