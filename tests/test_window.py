"""A window's keys, its sizes, its memory, its end, and what it says where it cannot be."""

from __future__ import annotations

import gc
import re
import signal
import sys
import weakref
from pathlib import Path

import numpy as np
import psutil
import pytest

from client.errors import OutputError, how_to_install
from client.window import Action, Window
from tests.windows import flat, native, noise, pixels, press, push, resize, sdl2

pytestmark = pytest.mark.usefixtures("no_screen")


def test_keys(window: Window) -> None:
    assert window.actions() == []
    for key in (sdl2.SDLK_q, sdl2.SDLK_ESCAPE, sdl2.SDLK_F1, sdl2.SDLK_w, sdl2.SDLK_x):
        press(key)
    push(sdl2.SDL_QUIT)
    assert window.actions() == [Action.QUIT, Action.QUIT, Action.OVERLAY, Action.WIPE, Action.QUIT]
    press(sdl2.SDLK_w, repeat=1)  # held down: once is enough
    assert window.actions() == []


def test_any_title_is_shown(no_screen: None) -> None:
    """Also a file's name that is no UTF-8."""
    with Window("clip \udcff.mp4"):
        assert sdl2.SDL_GetWindowTitle(native()[0]) == b"clip ?.mp4"


def test_fullscreen_and_back(window: Window) -> None:
    window.present(noise())
    for key, full in ((sdl2.SDLK_F11, True), (sdl2.SDLK_f, False)):
        press(key)
        assert window.actions() == [Action.FULLSCREEN]
        assert bool(sdl2.SDL_GetWindowFlags(native()[0]) & sdl2.SDL_WINDOW_FULLSCREEN) == full
        window.present(flat(235, 64, 48))
        assert not full or pixels().shape == (768, 1024, 3)  # the dummy driver does not come back to the size before
        assert pixels()[:, pixels().shape[1] // 2].min() > 200


def test_fullscreen_from_the_beginning() -> None:
    with Window("test", fullscreen=True) as window:
        window.present(noise())
        window.actions()
        window.present(noise())
        assert pixels().shape == (768, 1024, 3)


def test_the_wipe_follows_the_mouse_and_the_arrows_while_there_is_one(window: Window) -> None:
    ours, theirs = noise(100, 20, seed=1), noise(100, 20, seed=2)
    window.present(ours)
    resize(300, 40)  # the picture is 200 wide, between 50 and 250
    window.actions()
    window.present(ours)
    push(sdl2.SDL_MOUSEMOTION, x=100)
    assert window.actions() == [] and window.wipe_share == 0.5
    window.present(ours, left=theirs)
    for x, share in ((100, 0.25), (0, 0.0), (299, 1.0), (150, 0.5)):
        push(sdl2.SDL_MOUSEMOTION, x=x)
        assert window.actions() == [] and window.wipe_share == share
    press(sdl2.SDLK_RIGHT)
    press(sdl2.SDLK_RIGHT, repeat=1)
    press(sdl2.SDLK_LEFT)
    assert window.actions() == [] and window.wipe_share == pytest.approx(0.52)


def test_textures_are_made_anew_when_the_device_lost_them(window: Window) -> None:
    frame = noise()
    window.present(frame, overlay=["x"])
    before = pixels()
    push(sdl2.SDL_RENDER_DEVICE_RESET)
    assert window.actions() == []
    window.present(frame, overlay=["x"])
    np.testing.assert_array_equal(pixels(), before)


def test_300_frames_leave_nothing_behind(window: Window) -> None:
    """Sizes and texts that change with every frame: the textures of all would be 200 MB."""
    pictures = [noise(width, 180) for width in (320, 321)]

    def play(frames: int) -> int:
        for index in range(frames):
            picture = pictures[index % 2]
            window.present(picture, left=picture, overlay=["x" * (1 + index % 50)] * 15)
            window.actions()
        return int(psutil.Process().memory_info().rss)

    before = play(20)
    assert play(300) - before < 16_000_000


def test_a_picture_is_free_when_present_returns(window: Window) -> None:
    frame = noise()
    planes = [weakref.ref(plane) for plane in (frame.y, frame.u, frame.v)]
    gc.disable()
    try:
        window.present(frame, left=frame)
        del frame
        assert [plane() for plane in planes] == [None] * 3
    finally:
        gc.enable()


def test_sdl_is_shut_down_whatever_happens() -> None:
    with pytest.raises(ZeroDivisionError), Window("test") as window:
        window.present(noise())
        raise ZeroDivisionError
    assert not sdl2.SDL_WasInit(sdl2.SDL_INIT_VIDEO)


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="what handles a signal is asked of Linux")
def test_signals_stay_the_programs() -> None:
    """SDL would make an event of SIGTERM, which nobody may be polling."""

    def caught() -> list[bool]:
        (mask,) = re.findall(r"^SigCgt:\s+(\w+)$", Path("/proc/self/status").read_text(), re.MULTILINE)
        return [bool(int(mask, 16) >> (signum - 1) & 1) for signum in (signal.SIGINT, signal.SIGTERM)]

    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # which Python leaves alone in what a shell started with &
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        with Window("test"):
            assert caught() == [True, False]
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("driver", ["x11", None], ids=["asked for", "any"])
def test_no_display_is_one_sentence(monkeypatch: pytest.MonkeyPatch, driver: str | None) -> None:
    """Where SDL may choose, it falls back to drawing where nobody sees it, without a word."""
    monkeypatch.setenv("DISPLAY", ":4711")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.delenv("SDL_VIDEODRIVER")
    if driver:
        monkeypatch.setenv("SDL_VIDEODRIVER", driver)
    with pytest.raises(OutputError, match=r"^no window can be opened, as SDL finds no display.*: set DISPLAY .*libsdl2-2\.0-0[^\n]*$"):
        Window("test")
    assert not sdl2.SDL_WasInit(0)


def test_no_library_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "sdl2", None)
    with pytest.raises(
        OutputError, match=rf"^no window can be opened without .*{re.escape(how_to_install('play'))}.*libsdl2-2\.0-0[^\n]*$"
    ):
        Window("test")


def test_a_picture_that_cannot_be_shown_is_one_sentence(window: Window, monkeypatch: pytest.MonkeyPatch) -> None:
    window.present(noise())
    with pytest.raises(OutputError, match=r"^the wipe cannot be shown between pictures of 62x48 and 64x48: they must have one size$"):
        window.present(noise(), left=noise(62, 48))

    def refuse(*arguments: object) -> None:
        sdl2.SDL_SetError(b"Out of memory")

    monkeypatch.setattr(sdl2, "SDL_CreateTexture", refuse)
    window.present(noise())
    with pytest.raises(OutputError, match=r"^a picture of 50x48 cannot be shown: Out of memory$"):
        window.present(noise(50, 48))
