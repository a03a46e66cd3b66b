"""What a file is called where its name is to be printed, written or sent: a name need not be text."""

from __future__ import annotations

import os


def shown(name: str) -> str:
    """The name, or a sentence with names in it, with \\xe9 in the place of a byte that is not of UTF-8."""
    return os.fsencode(name).decode(errors="backslashreplace")
