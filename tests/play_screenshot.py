"""A picture of a stream that is being played, overlay and wipe on: `python -m tests.play_screenshot OUT.png [OPTION of gamesr-play]...`.

gamesr-stream sends the clip that ships here, gamesr-play shows it on a screen that nobody looks at (xvfb). That screen has no GPU, and the
wipe computes bicubic besides, so 30 pictures a second are sent.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from ctypes import byref
from pathlib import Path

from PIL import Image

from client.play_cli import main as play
from client.rgb import RgbPicture
from tests.headless import Screen, headless_screen
from tests.playing import streamed

ADDRESS = "127.0.0.1:5104"
BEFORE_S, SECONDS = 6.0, 14  # the models are ready by then; the overlay has figures by the end


def take(screen: Screen, pictures: list[RgbPicture]) -> None:
    """Press F1 and W, wait, and keep what the screen shows."""
    import sdl2

    time.sleep(BEFORE_S)
    for key in (sdl2.SDLK_F1, sdl2.SDLK_w):
        event = sdl2.SDL_Event()
        event.type, event.key.keysym.sym = sdl2.SDL_KEYDOWN, key
        sdl2.SDL_PushEvent(byref(event))
    time.sleep(SECONDS - BEFORE_S - 2)
    pictures.append(screen.picture())


def main() -> None:
    path, options = Path(sys.argv[1]), sys.argv[2:]
    pictures: list[RgbPicture] = []
    with headless_screen(1920, 1080) as screen:
        os.environ["DISPLAY"] = screen.display
        with streamed(ADDRESS, fps=30):
            threading.Thread(target=take, args=(screen, pictures), daemon=True).start()
            status = play([ADDRESS, "--seconds", str(SECONDS), *options])
    Image.fromarray(pictures[0]).save(path, optimize=True)
    print(path, path.stat().st_size)
    sys.exit(status)


if __name__ == "__main__":
    main()
