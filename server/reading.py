"""A sweep's store as those see it who only look: the file is opened to read, claims and leases are none of their business."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from urllib.parse import quote

from client.errors import OutputError
from server.asked import AskedSweep
from server.points import LatencyResult, PointResult
from server.records import read_record
from server.store import APPLICATION_ID, SCHEMA_VERSION

MOST_LATENCIES = 1000
_BUSY_S = 5.0


@dataclass(frozen=True)
class KeptSweep:
    """A sweep of the store; `created_at` is in seconds since 1970, UTC."""

    asked: AskedSweep
    created_at: float


class StoreReader:
    """Reads from any thread; a store that is not there yet is an empty one.

    Raises OutputError, in one sentence, where the file cannot be read, is not a store of this version, or holds a record that no
    sweep has written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def sweeps(self) -> dict[str, KeptSweep]:
        """By key, the newest first."""
        with self._open() as connection:
            if connection is None or not _has_sweeps(connection):
                return {}
            rows = connection.execute("SELECT key, created_at, record FROM sweeps ORDER BY created_at DESC").fetchall()
        return {key: KeptSweep(_asked(record, self.path), created_at) for key, created_at, record in rows}

    def sweep(self, beginning: str) -> tuple[str, KeptSweep] | None:
        """The key and the sweep whose key begins so."""
        with self._open() as connection:
            if connection is None or not _has_sweeps(connection):
                return None
            query = "SELECT key, created_at, record FROM sweeps WHERE substr(key, 1, ?) = ?"
            row = connection.execute(query, (len(beginning), beginning)).fetchone()
        return None if row is None else (row[0], KeptSweep(_asked(row[2], self.path), row[1]))

    def points(self, asked: AskedSweep) -> list[PointResult]:
        """Those of its points that are there, in its order and under its names."""
        records = self._records("points", [point.key for point in asked.points])
        results = []
        for point in asked.points:
            if point.key in records:
                result = read_record(PointResult, records[point.key], self.path)
                results.append(replace(result, point=replace(result.point, clip=point.clip, upscaler=point.upscaler)))
        return results

    def latencies(self, asked: AskedSweep) -> list[LatencyResult]:
        """Those of its latencies that are there, in its order and under its names."""
        records = self._records("latencies", asked.latencies)
        results = [read_record(LatencyResult, records[key], self.path) for key in asked.latencies if key in records]
        # What is asked has the names and no contents; the points have both.
        points = [result.point for result in self.points(asked)] if results else []
        clips = {clip.sha256: clip.name for clip in asked.clips}
        upscalers = {point.upscaler_sha256: point.upscaler for point in points}
        return [
            replace(
                result,
                clip=clips.get(result.clip_sha256, result.clip),
                upscaler=upscalers.get(result.upscaler_sha256, result.upscaler),
            )
            for result in results
        ]

    def all_latencies(self) -> list[LatencyResult]:
        """Of every sweep, the newest first, at most MOST_LATENCIES."""
        with self._open() as connection:
            query = f"SELECT record FROM latencies ORDER BY rowid DESC LIMIT {MOST_LATENCIES}"
            rows = [] if connection is None else connection.execute(query).fetchall()
        return [read_record(LatencyResult, record, self.path) for (record,) in rows]

    def counts(self, asked: AskedSweep) -> tuple[int, int]:
        """How many of its points and of its latencies are there. Neither ever falls: results are not taken back."""
        with self._open() as connection:
            if connection is None:
                return 0, 0
            keys = [point.key for point in asked.points], list(asked.latencies)
            query = "SELECT count(*) FROM {} WHERE key IN (SELECT value FROM json_each(?))"
            points, latencies = (
                int(connection.execute(query.format(table), (json.dumps(of_table),)).fetchone()[0])
                for table, of_table in zip(("points", "latencies"), keys, strict=True)
            )
        return points, latencies

    def totals(self) -> tuple[int, int]:
        """How many points and latencies the store holds."""
        with self._open() as connection:
            if connection is None:
                return 0, 0
            points, latencies = (int(connection.execute(f"SELECT count(*) FROM {t}").fetchone()[0]) for t in ("points", "latencies"))
        return points, latencies

    def _records(self, table: str, keys: Sequence[str]) -> dict[str, str]:
        with self._open() as connection:
            if connection is None:
                return {}
            query = f"SELECT key, record FROM {table} WHERE key IN (SELECT value FROM json_each(?))"
            return dict(connection.execute(query, (json.dumps(list(keys)),)).fetchall())

    @contextmanager
    def _open(self) -> Iterator[sqlite3.Connection | None]:
        if not self.path.exists():
            yield None
            return
        try:
            with closing(sqlite3.connect(f"file:{quote(str(self.path.absolute()))}?mode=ro", uri=True, timeout=_BUSY_S)) as connection:
                (application,) = connection.execute("PRAGMA application_id").fetchone()
                (version,) = connection.execute("PRAGMA user_version").fetchone()
                new = (application, version) == (0, 0) and not connection.execute("SELECT 1 FROM sqlite_master").fetchone()
                if not new and (application, version) != (APPLICATION_ID, SCHEMA_VERSION):
                    raise OutputError(f"{self.path} is not a store of gamesr-sweep, or of another schema version")
                yield None if new else connection
        except sqlite3.Error as error:
            raise OutputError(f"the store {self.path} cannot be read: {error}") from error


@lru_cache(maxsize=256)
def _asked(record: str, store: Path) -> AskedSweep:
    return read_record(AskedSweep, record, store)


def _has_sweeps(connection: sqlite3.Connection) -> bool:
    """A store whose sweeps were all made by an earlier version has no table of them."""
    return connection.execute("SELECT 1 FROM sqlite_master WHERE name = 'sweeps'").fetchone() is not None
