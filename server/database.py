"""The service's own file: sweeps in the queue, what is known of clips, latencies of players. Results are in the sweep's store."""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

from client.errors import OutputError
from server.wal import write_ahead

_BUSY_S = 10.0
_APPLICATION_ID = 0x67616D73  # "gams"
_SCHEMA_VERSION = 1
_SCHEMA = """
CREATE TABLE sweeps (id TEXT PRIMARY KEY, created_at REAL NOT NULL, state TEXT NOT NULL, cancel INTEGER NOT NULL, request TEXT NOT NULL,
    plan_key TEXT, progress TEXT NOT NULL, failures TEXT NOT NULL);
CREATE TABLE clips (name TEXT PRIMARY KEY, stamp TEXT NOT NULL, title TEXT NOT NULL, known TEXT, refused TEXT);
CREATE TABLE client_latencies (id TEXT PRIMARY KEY, received_at REAL NOT NULL, record TEXT NOT NULL);
"""


class Database:
    """One SQLite file with a write-ahead log, used by the service, its runner and the sweep's process, from any thread.

    Raises OutputError, in one sentence, for a file that is not the service's, is of another version, or cannot be used.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with self.transaction() as connection:
            (application,) = connection.execute("PRAGMA application_id").fetchone()
            (version,) = connection.execute("PRAGMA user_version").fetchone()
            if (application, version) == (0, 0):
                for statement in _SCHEMA.strip().split(";\n"):
                    connection.execute(statement)
                connection.execute(f"PRAGMA application_id = {_APPLICATION_ID}")
                connection.execute(f"PRAGMA user_version = {_SCHEMA_VERSION}")
            elif (application, version) != (_APPLICATION_ID, _SCHEMA_VERSION):
                raise OutputError(f"{path} is not of this version of gamesr-serve: name another folder with --data")

    def rows(self, query: str, *values: Any) -> list[tuple[Any, ...]]:
        """What a SELECT finds."""
        with self._connection() as connection:
            return connection.execute(query, values).fetchall()

    @contextlib.contextmanager
    def transaction(self) -> Iterator[sqlite3.Connection]:
        """Everything in the block happens, or nothing."""
        with self._connection() as connection:
            connection.execute("BEGIN IMMEDIATE")
            try:
                yield connection
                connection.execute("COMMIT")
            except BaseException:
                if connection.in_transaction:
                    connection.execute("ROLLBACK")
                raise

    @contextlib.contextmanager
    def _connection(self) -> Iterator[sqlite3.Connection]:
        try:
            with closing(sqlite3.connect(self.path, timeout=_BUSY_S, isolation_level=None)) as connection:
                write_ahead(connection, _BUSY_S)
                connection.execute("PRAGMA synchronous = NORMAL")
                yield connection
        except sqlite3.Error as error:
            raise OutputError(f"{self.path} cannot be used: {error}") from error
