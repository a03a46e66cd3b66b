"""SQLite's write-ahead log, which several processes may ask for at once."""

from __future__ import annotations

import sqlite3
import time


def write_ahead(connection: sqlite3.Connection, busy_s: float) -> None:
    """Put a file into WAL mode, which SQLite refuses at once, without its usual wait, while another process does the same to a new one.

    Tries for `busy_s` seconds; raises sqlite3.OperationalError.
    """
    deadline = time.monotonic() + busy_s
    while True:
        try:
            connection.execute("PRAGMA journal_mode = WAL")
            return
        except sqlite3.OperationalError as error:
            if error.sqlite_errorcode != sqlite3.SQLITE_BUSY or time.monotonic() > deadline:
                raise
        time.sleep(0.01)
