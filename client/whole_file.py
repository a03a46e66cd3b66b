"""Files that appear whole or not at all."""

from __future__ import annotations

import secrets
from pathlib import Path

from client.errors import OutputError


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file under a name of its own and rename it; raises OutputError, in one sentence."""
    partial = path.with_name(f".{path.name[:64]}.{secrets.token_hex(4)}.part")
    try:
        partial.write_bytes(content if isinstance(content, bytes) else content.encode())
        partial.replace(path)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}") from error
    finally:
        partial.unlink(missing_ok=True)
