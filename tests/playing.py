"""What a player is given in the tests: a sink that keeps, an ear for what is told, and a deadline that is far away."""

from __future__ import annotations

from client.frames import Frame

LONG_NS = 100_000_000_000  # no frame misses that


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
