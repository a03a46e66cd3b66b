"""What a player is given in the tests: a stream, a sink that keeps, an ear for what is told, and a deadline that is far away."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from client.frames import Frame

LONG_NS = 100_000_000_000  # no frame misses that
ROOT = Path(__file__).parent.parent
CLIP = ROOT / "tests/footage/oa_koth1_540p.mp4"


@contextmanager
def streamed(address: str, *, fps: int = 60) -> Iterator[None]:
    """gamesr-stream in a process of its own sends the clip that ships here to HOST:PORT, over and over."""
    program = "import sys; from client.stream_cli import main; sys.exit(main())"
    command = [sys.executable, "-c", program, str(CLIP), "--to", address, "--copy", "--loop", "--fps", str(fps)]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL) as sender:
        try:
            yield
        finally:
            sender.terminate()


class Kept:
    """A sink that keeps what it is given."""

    def __init__(self) -> None:
        self.pictures: list[Frame] = []

    def write(self, frame: Frame) -> None:
        self.pictures.append(frame)


class Told:
    """Keeps what is told, by kind and sentence."""

    def __init__(self) -> None:
        self.said: list[tuple[str, str]] = []

    def __call__(self, kind: str, sentence: str) -> None:
        self.said.append((kind, sentence))

    def kinds(self) -> list[str]:
        return [kind for kind, _ in self.said]
