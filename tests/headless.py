"""A screen that nobody looks at: Debian's xvfb, whose picture is read out of the file that it draws in."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from client.rgb import RgbPicture

COLOUR_BYTES = 12  # one entry of the colour map between header and pixels


@dataclass(frozen=True, slots=True)
class Screen:
    """`display` is what the environment variable DISPLAY has to be."""

    display: str
    _file: Path

    def picture(self) -> RgbPicture:
        """What the screen shows: the root window in X's dump format (XWDFile.h), 32 bits a pixel, blue first."""
        content = self._file.read_bytes()
        header = np.frombuffer(content, ">u4", 25)
        size, width, height, bytes_per_line, colours = (int(header[index]) for index in (0, 4, 5, 12, 19))
        pixels = np.frombuffer(content, np.uint8, height * bytes_per_line, size + COLOUR_BYTES * colours)
        return pixels.reshape(height, -1, 4)[:, :width, 2::-1].copy()


@contextlib.contextmanager
def headless_screen(width: int, height: int) -> Iterator[Screen]:
    """Skips the test where there is no Xvfb: its package is the machine's, and nothing here may install it."""
    program = shutil.which("Xvfb")
    if program is None:
        pytest.skip("no window is tested on a real screen: Xvfb is missing (apt-get install xvfb)")
    with tempfile.TemporaryDirectory() as folder:
        read, write = os.pipe()
        options = ["-nocursor", "-noreset", "-nolisten", "tcp", "-screen", "0", f"{width}x{height}x24", "-fbdir", folder]
        server = subprocess.Popen([program, "-displayfd", str(write), *options], pass_fds=[write], stderr=subprocess.DEVNULL)
        os.close(write)
        try:
            with os.fdopen(read) as told:  # the number of a display that was free; nothing if the server ended
                number = told.readline().strip()
            if not number:
                raise RuntimeError(f"Xvfb ended with status {server.wait()}")
            yield Screen(f":{number}", Path(folder) / "Xvfb_screen0")
        finally:
            server.terminate()
            server.wait()
