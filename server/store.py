"""Where a sweep keeps what it has measured, and which sweep is at work on what: one SQLite file."""

from __future__ import annotations

import contextlib
import json
import secrets
import sqlite3
import threading
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Self

from client.errors import OutputError
from server.asked import AskedSweep
from server.points import LatencyResult, PointResult
from server.records import read_record
from server.wal import write_ahead

SCHEMA_VERSION = 1
APPLICATION_ID = 0x67616D65  # SQLite's field for "whose file is this": "game"
LEASE_S = 30.0
_BUSY_S = 60.0
_SCHEMA = """
CREATE TABLE points (key TEXT PRIMARY KEY, record TEXT NOT NULL);
CREATE TABLE latencies (key TEXT PRIMARY KEY, record TEXT NOT NULL);
CREATE TABLE claims (key TEXT PRIMARY KEY, owner TEXT NOT NULL, expires REAL NOT NULL);
"""
# Not in every store of this version: the first ones did not say which points were asked for together.
_SWEEPS = "CREATE TABLE IF NOT EXISTS sweeps (key TEXT PRIMARY KEY, created_at REAL NOT NULL, record TEXT NOT NULL)"
_ALONE = "alone"


class Store:
    """Results by the key of what was asked, as JSON, and claims; a context manager for one sweep at a time.

    Every change is one transaction of a write-ahead log, so a process may be killed at any moment. A claim says that this
    sweep is at work on a key. It is a lease of `lease_s` seconds that a thread renews while the store is open: when a sweep
    was killed, what it had claimed is free again after that time. Leaving the context gives all claims back.

    Raises OutputError, in one sentence, for a file that is not a store, is of another schema version, or cannot be written, and for
    a record that no sweep has written.
    """

    def __init__(self, path: Path, *, lease_s: float = LEASE_S) -> None:
        self.path = path
        self._lease_s = lease_s
        self._owner = secrets.token_hex(8)
        self._closing = threading.Event()
        self._heartbeat = threading.Thread(target=self._renew, daemon=True)
        with self._as_sentence():
            self._connection = self._connect()
            try:
                self._open()
            except BaseException:
                self._connection.close()
                raise
        self._heartbeat.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._closing.set()
        self._heartbeat.join()
        with contextlib.suppress(OutputError):  # on a full disk they run out by themselves
            self._give_back("owner = ?", self._owner)
        self._connection.close()

    def point(self, key: str) -> PointResult | None:
        record = self._record("points", key)
        return None if record is None else read_record(PointResult, record, self.path)

    def latency(self, key: str) -> LatencyResult | None:
        record = self._record("latencies", key)
        return None if record is None else read_record(LatencyResult, record, self.path)

    def keep_point(self, result: PointResult) -> None:
        """Store a result and give its claim back, both or neither; a result that is there already stays."""
        self._keep("points", result.point.key, json.dumps(result.record()))

    def keep_latency(self, key: str, result: LatencyResult) -> None:
        """As `keep_point`, but the claim on the whole store stays."""
        self._keep("latencies", key, json.dumps(result.record()))

    def keep_sweep(self, sweep: AskedSweep) -> None:
        """Say that these points and latencies were asked for together; a sweep that is there already stays."""
        with self._transaction() as connection:
            row = (sweep.key, time.time(), json.dumps(sweep.record()))
            connection.execute("INSERT OR IGNORE INTO sweeps VALUES (?, ?, ?)", row)

    def claim(self, keys: Iterable[str]) -> list[str]:
        """Those of the keys that are now this sweep's to compute: neither stored nor claimed by a sweep that is alive."""
        with self._transaction() as connection:
            if connection.execute("SELECT 1 FROM claims WHERE key = ?", (_ALONE,)).fetchone():
                return []
            known = "SELECT 1 FROM points WHERE key = ? UNION ALL SELECT 1 FROM claims WHERE key = ?"
            mine = [key for key in keys if not connection.execute(known, (key, key)).fetchone()]
            connection.executemany("INSERT INTO claims VALUES (?, ?, ?)", [(key, self._owner, self._expiry()) for key in mine])
        return mine

    def claim_alone(self) -> bool:
        """Whether this sweep now has the store, and so the machine, for itself: no other computes, and none begins."""
        with self._transaction() as connection:
            if connection.execute("SELECT 1 FROM claims").fetchone():
                return False
            connection.execute("INSERT INTO claims VALUES (?, ?, ?)", (_ALONE, self._owner, self._expiry()))
        return True

    def release(self, key: str) -> None:
        """Give one claim back without a result."""
        self._give_back("key = ? AND owner = ?", key, self._owner)

    def release_alone(self) -> None:
        self.release(_ALONE)

    def _connect(self) -> sqlite3.Connection:
        return sqlite3.connect(self.path, timeout=_BUSY_S, isolation_level=None)

    def _open(self) -> None:
        self._connection.execute("BEGIN")  # one view of a file that another sweep may be creating
        version = self._version()
        self._connection.execute("COMMIT")
        if version not in (None, SCHEMA_VERSION):
            raise OutputError(
                f"{self.path} is a store of schema version {version}, not {SCHEMA_VERSION} as this program's: name another with --store"
            )
        write_ahead(self._connection, _BUSY_S)
        self._connection.execute("PRAGMA synchronous = NORMAL")
        self._connection.execute("BEGIN IMMEDIATE")
        if self._version() is None:  # not while another sweep creates it
            for statement in _SCHEMA.strip().split("\n"):
                self._connection.execute(statement)
            self._connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
            self._connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")
        self._connection.execute(_SWEEPS)
        self._connection.execute("COMMIT")

    def _version(self) -> int | None:
        """None for a new file; raises OutputError for a database of someone else."""
        (application,) = self._connection.execute("PRAGMA application_id").fetchone()
        (version,) = self._connection.execute("PRAGMA user_version").fetchone()
        if application == APPLICATION_ID:
            return int(version)
        if version or self._connection.execute("SELECT 1 FROM sqlite_master").fetchone():
            raise OutputError(f"{self.path} is a database, but not of gamesr-sweep: name another file with --store")
        return None

    def _record(self, table: str, key: str) -> str | None:
        with self._as_sentence():
            row = self._connection.execute(f"SELECT record FROM {table} WHERE key = ?", (key,)).fetchone()
        return None if row is None else str(row[0])

    def _keep(self, table: str, key: str, record: str) -> None:
        with self._transaction() as connection:
            connection.execute(f"INSERT OR IGNORE INTO {table} VALUES (?, ?)", (key, record))
            connection.execute("DELETE FROM claims WHERE key = ? AND owner = ?", (key, self._owner))

    def _give_back(self, condition: str, *values: str) -> None:
        with self._transaction() as connection:
            connection.execute(f"DELETE FROM claims WHERE {condition}", values)

    @contextlib.contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        with self._as_sentence():
            self._connection.execute("BEGIN IMMEDIATE")
            try:
                self._connection.execute("DELETE FROM claims WHERE expires < ?", (time.time(),))
                yield self._connection
                self._connection.execute("COMMIT")
            except BaseException:
                if self._connection.in_transaction:  # a full disk has ended it already
                    self._connection.execute("ROLLBACK")
                raise

    @contextlib.contextmanager
    def _as_sentence(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.Error as error:
            raise OutputError(f"the store {self.path} cannot be used: {error}") from error

    def _expiry(self) -> float:
        return time.time() + self._lease_s

    def _renew(self) -> None:
        connection = self._connect()
        while not self._closing.wait(self._lease_s / 6):
            with contextlib.suppress(sqlite3.Error):  # the next beat may succeed; a lease that ran out only costs work done twice
                connection.execute("UPDATE claims SET expires = ? WHERE owner = ?", (self._expiry(), self._owner))
        connection.close()
