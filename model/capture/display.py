"""A screen that nobody sees, for games that want one."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager

from client.errors import GamesrError


@contextmanager
def hidden_display(width: int, height: int) -> Iterator[str]:
    """An X server without a screen (Xvfb), as the value of DISPLAY; it ends with the block. Raises GamesrError where there is none."""
    program = shutil.which("Xvfb")
    if program is None:
        raise GamesrError("there is no Xvfb: apt-get install xvfb")
    read_fd, write_fd = os.pipe()
    command = [program, "-displayfd", str(write_fd), "-screen", "0", f"{width}x{height}x24", "-nolisten", "tcp", "-ac"]
    # A session of its own: Ctrl-C is for the games to end first, not for their screen to go from under them.
    server = subprocess.Popen(
        command,
        pass_fds=(write_fd,),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    os.close(write_fd)
    try:
        with os.fdopen(read_fd) as pipe:
            number = pipe.readline().strip()  # written when it accepts connections; the pipe ends when it dies
        if not number:
            raise GamesrError(f"Xvfb does not start (exit status {server.wait()})")
        yield f":{number}"
    finally:
        server.terminate()
        server.wait()
