"""Many scenes filmed side by side: a stream of events, which a progress bar or a log reads."""

from __future__ import annotations

import contextlib
import queue
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from client.errors import GamesrError
from model.capture.display import hidden_display
from model.capture.filming import WINDOW, Shot, build_frame_clock
from model.capture.games import SceneSpec
from model.capture.library import Entry, Filmed, Library, film_to_file

CLOCKS = Path.home() / ".cache" / "gamesr"
SUPERSAMPLE = 2


@dataclass(frozen=True)
class FramesDone:
    """So many frames more are filmed."""

    frames: int


@dataclass(frozen=True)
class SceneDone:
    """A scene is filmed and measured; `entry` says what was kept."""

    scene: SceneSpec
    entry: Entry


@dataclass(frozen=True)
class SceneFailed:
    """A scene could not be filmed; the others go on."""

    scene: SceneSpec
    reason: str


Event = FramesDone | SceneDone | SceneFailed


def shots_of(scene: SceneSpec, heights: Sequence[int]) -> list[Shot]:
    """What is filmed of a scene: the reference, lower resolutions where they show the same, a supersampled one where it has one.

    The last costs four times what the reference does, and is what small renders are held against: with no smaller height it is left out.
    """
    reference, *lower = sorted(heights, reverse=True)
    shots = [Shot(reference), *(Shot(height) for height in lower if scene.native)]
    return [*shots, Shot(reference, SUPERSAMPLE)] if scene.antialiased and lower else shots


def render(scenes: Sequence[SceneSpec], library: Library, heights: Sequence[int], *, jobs: int, timeout_s: float) -> Iterator[Event]:
    """Film what is missing, `jobs` games at a time, each scene measured as soon as its last size is there.

    A shot is done once its file is whole and in the manifest: stopped at any moment, the next call films only the rest.
    Raises GamesrError where nothing can be filmed at all (no X server, no compiler).
    """
    missing = [(scene, library.missing(scene, shots_of(scene, heights))) for scene in scenes]
    todo = [(scene, shots) for scene, shots in missing if shots or library.is_unmeasured(scene)]
    if not todo:
        return
    library.folder.mkdir(parents=True, exist_ok=True)
    clock = build_frame_clock(CLOCKS)
    events: queue.Queue[Event] = queue.Queue()
    stop = threading.Event()
    screen = Shot(max([WINDOW[1], *(shot.height * shot.supersample for _, shots in todo for shot in shots)]))
    with hidden_display(screen.width, screen.height) as display, ThreadPoolExecutor(jobs) as pool:

        def work(scene: SceneSpec, shots: Sequence[Shot]) -> None:
            try:
                for shot in shots:
                    with closing(film_to_file(scene, shot, library.folder, clock=clock, display=display, timeout_s=timeout_s)) as filming:
                        for step in filming:
                            if stop.is_set():
                                return
                            if isinstance(step, Filmed):
                                library.put(scene, shot, step)
                            else:
                                events.put(FramesDone(1))
                events.put(SceneDone(scene, library.judge(scene)))
            except GamesrError as error:
                events.put(SceneFailed(scene, str(error)))

        running = [pool.submit(work, scene, shots) for scene, shots in todo]
        try:
            left = len(todo)
            while left:
                with contextlib.suppress(queue.Empty):
                    event = events.get(timeout=1)
                    left -= not isinstance(event, FramesDone)
                    yield event
                for future in running:
                    if future.done():
                        future.result()  # an error that is nobody's fault but ours
        finally:
            stop.set()
            for future in running:
                future.cancel()
