"""Files that appear whole or not at all: made under a name of their own beside the one that they get at the end."""

from __future__ import annotations

import os
import secrets
from pathlib import Path

from client.errors import OutputError

_BYTES_OF_A_NAME = 64  # a name may have 255


def landing(path: Path) -> Path:
    """The file that is written by that name: where a link points, whether or not something is there."""
    return Path(os.path.realpath(path))


def partial_beside(path: Path) -> Path:
    """A hidden name that nothing else has, in the same folder."""
    begin = os.fsencode(path.name)[:_BYTES_OF_A_NAME].decode(errors="ignore")  # not half a character
    return path.with_name(f".{begin}.{secrets.token_hex(4)}.part")


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file under a name of its own and rename it; raises OutputError, in one sentence."""
    target = landing(path)
    partial = partial_beside(target)
    try:
        partial.write_bytes(content if isinstance(content, bytes) else content.encode())
        partial.replace(target)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}") from error
    finally:
        partial.unlink(missing_ok=True)
