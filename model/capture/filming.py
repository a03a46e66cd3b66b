"""One start of a game under the frame clock: its frames through a pipe, or the demo that it recorded."""

from __future__ import annotations

import hashlib
import os
import shutil
import signal
import socket
import subprocess
import tempfile
import threading
from collections.abc import Generator, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np

from client.errors import GamesrError
from client.frames import BT709_LIMITED, Frame
from model.capture.games import Run, SceneSpec

SOURCE = Path(__file__).parent / "frame_clock.c"
WINDOW = (1920, 1080)  # for games that refuse a smaller one
RECORDING = (256, 144)
LAST_WORDS_S = 5.0


@dataclass(frozen=True)
class Shot:
    """What is filmed of a scene: a height, and how many pixels a side are averaged into one of the picture's."""

    height: int
    supersample: int = 1

    @property
    def width(self) -> int:
        return self.height * 16 // 9

    @property
    def name(self) -> str:
        return f"{self.height}p" + ("_aa" if self.supersample > 1 else "")


def build_frame_clock(folder: Path) -> Path:
    """Compile the frame clock into `folder`, once for each version of its source; raises GamesrError without a C compiler."""
    library = folder / f"frame_clock-{hashlib.sha256(SOURCE.read_bytes()).hexdigest()[:16]}.so"
    if library.is_file():
        return library
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        raise GamesrError("there is no C compiler for the frame clock: apt-get install gcc libc6-dev")
    folder.mkdir(parents=True, exist_ok=True)
    partial = library.with_suffix(f".{os.getpid()}.part")
    done = subprocess.run(
        [compiler, "-O3", "-shared", "-fPIC", "-o", str(partial), str(SOURCE), "-ldl"], capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise GamesrError(f"the frame clock does not compile: {done.stderr.strip().splitlines()[-1]}")
    partial.replace(library)
    return library


def free_port() -> int:
    """A UDP port of this machine that nothing uses now."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as unused:
        unused.bind(("127.0.0.1", 0))
        return int(unused.getsockname()[1])


def film(scene: SceneSpec, shot: Shot, *, clock: Path, display: str, timeout_s: float) -> Generator[Frame]:
    """Play a scene and give its frames one by one, as the game drew them: I420, BT.709 limited, timed by its frame rate.

    The game runs in a home folder of its own, which is gone afterwards. Raises GamesrError with the game's last line
    when it ends before the last frame, and when a whole run lasts longer than `timeout_s`.
    """
    width, height = shot.width * shot.supersample, shot.height * shot.supersample
    small = scene.game.small_windows
    window = (width, height) if small else (max(width, WINDOW[0]), max(height, WINDOW[1]))
    settings = {"FPS": scene.game.fps, "SKIP": scene.skip, "COUNT": scene.frames, "WIDTH": width, "HEIGHT": height}
    settings |= {"SUPERSAMPLE": shot.supersample, "DRAWABLE": int(not small), "PACE_MS": scene.game.pace_ms}
    area = shot.width * shot.height
    read_fd, write_fd = os.pipe()
    # The game alone holds the writing end, so that the pipe ends when it does.
    with os.fdopen(read_fd, "rb") as pipe, os.fdopen(write_fd, "wb") as theirs:
        game = _game(scene, scene.game.play, window, settings, clock, display, timeout_s, theirs.fileno())
        with game as stage:
            theirs.close()
            for index in range(scene.frames):
                picture = pipe.read(area * 3 // 2)
                if len(picture) < area * 3 // 2:
                    raise GamesrError(f"{scene.title} {shot.name}: the game ended at frame {index} of {scene.frames}: {stage.last_words()}")
                planes = np.frombuffer(picture, np.uint8)
                y = planes[:area].reshape(shot.height, shot.width)
                u, v = planes[area:].reshape(2, shot.height // 2, shot.width // 2)
                yield Frame(y, u, v, index, Fraction(1, scene.game.fps), BT709_LIMITED)


def record(scene: SceneSpec, *, clock: Path, display: str, timeout_s: float) -> Path:
    """Make a scene's demo by its game's own recorder, faster than real time, nothing drawn; raises GamesrError if none comes out."""
    run, demo = scene.game.record, scene.demo
    if run is None or run.demo is None or demo is None:
        raise GamesrError(f"{scene.game.name} records no demos: its scenes play by themselves")
    settings = {"FPS": scene.game.fps, "COUNT": 0}
    with _game(scene, run, RECORDING, settings, clock, display, timeout_s, None) as stage:
        stage.wait_for_end()
        made = stage.home / scene.fill(run.demo, {})
        if not made.is_file() or not made.stat().st_size:
            raise GamesrError(f"{scene.title}: the game recorded no demo: {stage.last_words()}")
        demo.parent.mkdir(parents=True, exist_ok=True)
        partial = demo.with_name(f".{demo.name}.part")
        shutil.copyfile(made, partial)
        partial.replace(demo)
    return demo


@dataclass
class _Stage:
    home: Path
    log: Path
    process: subprocess.Popen[bytes]
    timeout_s: float
    timed_out: bool = False

    def give_up(self) -> None:
        self.timed_out = True
        _end(self.process)

    def wait_for_end(self) -> None:
        self.process.wait()

    def last_words(self) -> str:
        if self.timed_out:
            return f"it took longer than {self.timeout_s:g} s (--timeout)"
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(LAST_WORDS_S)  # it has closed the pipe, and may be about to say why
        lines = [line.strip() for line in self.log.read_text(errors="replace").splitlines()]
        return next((line for line in reversed(lines) if line), "it said nothing")[:200]


@contextmanager
def _game(
    scene: SceneSpec,
    run: Run,
    window: tuple[int, int],
    settings: Mapping[str, int],
    clock: Path,
    display: str,
    timeout_s: float,
    frames_fd: int | None,
) -> Iterator[_Stage]:
    with tempfile.TemporaryDirectory(prefix="gamesr-footage-", ignore_cleanup_errors=True) as folder:
        home = Path(folder)
        words = {"width": window[0], "height": window[1], "home": folder, "port": free_port()}
        for name, text in run.files.items():
            path = home / scene.fill(name, words)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(scene.fill(text, words))
        if run is scene.game.play and run.demo is not None and scene.demo is not None:
            if not scene.demo.is_file():
                raise GamesrError(f"{scene.title} has no demo {scene.demo}: gamesr-footage record {scene.title} makes one")
            path = home / scene.fill(run.demo, words)
            path.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(scene.demo, path)
        command = [scene.fill(word, words) for word in run.command]
        environment = {key: value for key, value in os.environ.items() if not key.startswith(("XDG_", "LD_"))}
        environment |= {"HOME": folder, "DISPLAY": display, "LIBGL_ALWAYS_SOFTWARE": "1", "LP_NUM_THREADS": "1"}
        environment |= {key: scene.fill(value, words) for key, value in run.environment.items()}
        environment |= {f"GAMESR_{key}": str(value) for key, value in settings.items()}
        environment |= {"LD_PRELOAD": str(clock), "GAMESR_PROCESS": scene.game.process}
        if frames_fd is not None:
            environment["GAMESR_FD"] = str(frames_fd)
        log = home / "log.txt"
        with log.open("wb") as output:
            try:
                process = subprocess.Popen(
                    command,
                    env=environment,
                    cwd=folder,
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=subprocess.STDOUT,
                    pass_fds=() if frames_fd is None else (frames_fd,),
                    start_new_session=True,
                )
            except OSError as error:
                packages = " ".join(scene.game.packages)
                raise GamesrError(f"{scene.game.title} does not start ({error.strerror}): apt-get install {packages}") from error
        stage = _Stage(home, log, process, timeout_s)
        watchdog = threading.Timer(timeout_s, stage.give_up)
        watchdog.start()
        try:
            yield stage
        finally:
            watchdog.cancel()
            _end(process)
            process.wait()


def _end(process: subprocess.Popen[bytes]) -> None:
    """The game and whatever it started."""
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
