"""The window without a screen: SDL's dummy driver and its software renderer, whose pixels are read back."""

from __future__ import annotations

import gc
import re
import signal
import sys
import time
import weakref
from collections.abc import Iterator
from ctypes import byref, c_int
from pathlib import Path

import numpy as np
import psutil
import pytest

from client import lettering
from client.errors import OutputError
from client.frames import ColourTags, Frame, Plane
from client.textures import load_sdl
from client.window import Action, Window
from tests.headless import headless_screen

sdl2 = load_sdl()

BT601, BT709 = ColourTags(1, 6, 6, 6), ColourTags(1, 1, 1, 1)
BT601_FULL, BT709_FULL = ColourTags(2, 6, 6, 6), ColourTags(2, 1, 1, 1)
KR_KB = {6: (0.299, 0.114), 1: (0.2126, 0.0722)}  # ITU-R BT.601 and BT.709


@pytest.fixture(autouse=True)
def no_screen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


@pytest.fixture
def window() -> Iterator[Window]:
    with Window("test") as window:
        yield window


def noise(width: int = 64, height: int = 48, seed: int = 0, colour: ColourTags = BT709) -> Frame:
    """Every pixel another code, inside the range and not too colourful."""
    random = np.random.default_rng(seed)
    low, high = (0, 256) if colour.range == 2 else (16, 236)
    chroma = -(-height // 2), -(-width // 2)
    y, u, v = (
        random.integers(*span, shape, dtype=np.uint8) for span, shape in (((low, high), (height, width)), *[((88, 169), chroma)] * 2)
    )
    return Frame(y, u, v, colour=colour)


def flat(code: int, width: int, height: int) -> Frame:
    chroma = np.full((-(-height // 2), -(-width // 2)), 128, np.uint8)
    return Frame(np.full((height, width), code, np.uint8), chroma, chroma)


def native() -> tuple[object, object]:
    """SDL's window and renderer: the first ones since it was begun, so the last one was shut down whole."""
    found = sdl2.SDL_GetWindowFromID(1)
    assert found
    return found, sdl2.SDL_GetRenderer(found)


def pixels() -> np.ndarray:
    """What the window shows, R'G'B' (H, W, 3)."""
    width, height = c_int(), c_int()
    _, renderer = native()
    sdl2.SDL_GetRendererOutputSize(renderer, byref(width), byref(height))
    read = np.zeros((height.value, width.value, 4), np.uint8)
    assert sdl2.SDL_RenderReadPixels(renderer, None, sdl2.SDL_PIXELFORMAT_ABGR8888, read.ctypes.data, read.strides[0]) == 0
    return read[..., :3].astype(int) if sys.byteorder == "little" else read[..., :0:-1].astype(int)


def resize(width: int, height: int) -> None:
    sdl2.SDL_SetWindowSize(native()[0], width, height)


def press(key: int, repeat: int = 0) -> None:
    event = sdl2.SDL_Event()
    event.type, event.key.keysym.sym, event.key.repeat = sdl2.SDL_KEYDOWN, key, repeat
    assert sdl2.SDL_PushEvent(byref(event)) == 1


def push(kind: int, x: int = 0) -> None:
    event = sdl2.SDL_Event()
    event.type = kind
    if kind == sdl2.SDL_MOUSEMOTION:
        event.motion.x = x
    assert sdl2.SDL_PushEvent(byref(event)) == 1


def expected(frame: Frame) -> np.ndarray:
    """ITU-T H.273, equations 38 to 44, chroma of the nearest sample as SDL's software has it."""
    kr, kb = KR_KB[frame.colour.matrix]
    black, luma_span, chroma_span = (0, 255, 255) if frame.colour.range == 2 else (16, 219, 224)
    y = (frame.y - float(black)) / luma_span
    cb, cr = ((plane.repeat(2, 0).repeat(2, 1)[: frame.height, : frame.width] - 128.0) / chroma_span for plane in (frame.u, frame.v))
    red, blue = y + 2 * (1 - kr) * cr, y + 2 * (1 - kb) * cb
    green = (y - kr * red - kb * blue) / (1 - kr - kb)
    return np.clip(255 * np.stack((red, green, blue), axis=-1), 0, 255)


@pytest.mark.parametrize("colour", [BT601, BT709, BT601_FULL], ids=["BT.601", "BT.709", "BT.601 full"])
@pytest.mark.parametrize(("width", "height"), [(64, 48), (63, 47), (1, 1)])
def test_colours_are_those_of_the_tags(window: Window, colour: ColourTags, width: int, height: int) -> None:
    frame = noise(width, height, colour=colour)
    window.present(frame)
    assert pixels().shape == (height, width, 3)
    assert np.abs(pixels() - expected(frame)).max() <= 2.5  # two codes, and the half that rounding may take


def test_what_sdl_does_not_know_is_right_in_grey(window: Window) -> None:
    """BT.709 in full range; and what has no tags is BT.709 in limited range, as elsewhere in the client."""
    ramp = np.arange(256, dtype=np.uint8).repeat(4).reshape(16, 64)
    chroma = np.full((8, 32), 128, np.uint8)
    window.present(Frame(ramp, chroma, chroma, colour=BT709_FULL))
    assert np.abs(pixels() - ramp[..., None].astype(int)).max() <= 1
    window.present(noise(colour=BT709))
    tagged = pixels()
    untagged = noise(colour=BT709)
    window.present(Frame(untagged.y, untagged.u, untagged.v, colour=ColourTags()))
    np.testing.assert_array_equal(pixels(), tagged)


def test_colours_may_change_in_mid_stream(window: Window) -> None:
    for colour in (BT709, BT601, BT601_FULL, BT709):
        frame = noise(colour=colour)
        window.present(frame)
        assert np.abs(pixels() - expected(frame)).max() <= 2.5


def test_rows_may_lie_apart(window: Window) -> None:
    frame = noise(63, 47)

    def apart(plane: Plane, stride: int) -> Plane:
        wide = np.full((plane.shape[0], stride), 255, np.uint8)
        wide[:, : plane.shape[1]] = plane
        return wide[:, : plane.shape[1]]

    window.present(frame)
    together = pixels()
    window.present(flat(90, 63, 47))
    window.present(Frame(apart(frame.y, 80), apart(frame.u, 48), apart(frame.v, 40)))
    np.testing.assert_array_equal(pixels(), together)


@pytest.mark.parametrize(
    ("size", "picture", "area"),
    [((100, 100), (64, 32), (0, 25, 100, 50)), ((200, 50), (32, 64), (87, 0, 25, 50)), ((99, 77), (33, 11), (0, 22, 99, 33))],
)
def test_the_ratio_is_kept(window: Window, size: tuple[int, int], picture: tuple[int, int], area: tuple[int, int, int, int]) -> None:
    window.present(flat(235, *picture))
    resize(*size)
    window.actions()
    window.present(flat(235, *picture))
    left, top, width, height = area
    shown = np.zeros((size[1], size[0]), bool)
    shown[top : top + height, left : left + width] = True
    np.testing.assert_array_equal(pixels().min(axis=2) > 200, shown)
    np.testing.assert_array_equal(pixels().max(axis=2) == 0, ~shown)


def test_a_picture_larger_than_the_screen_is_reduced(window: Window) -> None:
    """The dummy driver's screen is 1024x768."""
    window.present(flat(235, 1920, 1080))
    assert pixels().shape == (576, 1024, 3)
    assert pixels().min() > 200


@pytest.mark.parametrize("size", [None, (150, 90)], ids=["as it is", "scaled and letterboxed"])
@pytest.mark.parametrize(("width", "height"), [(64, 48), (63, 47)])
def test_the_wipe_has_one_picture_on_each_side(window: Window, width: int, height: int, size: tuple[int, int] | None) -> None:
    ours, theirs = noise(width, height, seed=1), noise(width, height, seed=2)
    window.present(ours)
    if size:
        resize(*size)
        window.actions()

    def shown(picture: Frame, left: Frame | None = None) -> np.ndarray:
        window.present(picture, left=left)
        return pixels()

    alone, other = shown(ours), shown(theirs)
    start, stop = (0, width) if not size else (14, 135) if width == 63 else (15, 135)
    for share in (0.02, 0.2, 0.5, 0.77):
        window.wipe_share = share
        both = shown(ours, theirs)
        split = start + round(2 * round(share * width / 2) / width * (stop - start))
        blurred = 2 if size else 0  # where scaling mixes the neighbours of the line
        np.testing.assert_array_equal(both[:, : max(0, split - blurred)], other[:, : max(0, split - blurred)])
        np.testing.assert_array_equal(both[:, split + 1 + blurred :], alone[:, split + 1 + blurred :])
        lines = (both == 255).all(axis=2)[:, start:stop].all(axis=0)
        assert np.flatnonzero(lines).tolist() == [split - start]
    window.wipe_share = -0.5  # what is outside counts as the edge
    np.testing.assert_array_equal(shown(ours, theirs), alone)
    window.wipe_share = 0.0
    np.testing.assert_array_equal(shown(ours, theirs), alone)
    window.wipe_share = 1.0
    np.testing.assert_array_equal(shown(ours, theirs), other)


def test_the_overlay_is_lit_and_goes_away(window: Window) -> None:
    picture = flat(126, 320, 180)
    window.present(picture)
    bare = pixels()
    for text in ("ab", "cd", "longer", ""):
        window.present(picture, overlay=[text, "p95 12.3 ms"])
        lit = (pixels() == 255).all(axis=2)
        below = lettering.letters("p95 12.3 ms", 1)
        assert lit.sum() == lettering.letters(text, 1).sum() + below.sum()
        (rows,), (columns,) = np.nonzero(lit.any(axis=1))[:1], np.nonzero(lit.any(axis=0))[:1]
        assert lit[rows.max() - 6 : rows.max() + 1, columns.min() :][:, : below.shape[1]].sum() == below.sum()
        changed = (pixels() != bare).any(axis=2)
        assert (pixels()[changed & ~lit] < bare[changed & ~lit]).all() and not changed[90:].any()
        window.present(picture)
        np.testing.assert_array_equal(pixels(), bare)


def test_the_picture_may_change_size_in_mid_stream(window: Window) -> None:
    """The window stays as it is; what it shows is the same as where it never was another size."""
    frame, other = noise(48, 36, seed=3), noise(96, 64, seed=4)
    window.present(frame)
    resize(120, 80)
    window.actions()
    window.present(other)
    before = pixels()
    for shown in (frame, noise(33, 17), other):
        window.present(shown, left=shown, overlay=["x"])
    window.present(other)
    np.testing.assert_array_equal(pixels(), before)
    assert before.shape == (80, 120, 3)


def test_keys(window: Window) -> None:
    assert window.actions() == []
    for key in (sdl2.SDLK_q, sdl2.SDLK_ESCAPE, sdl2.SDLK_F1, sdl2.SDLK_w, sdl2.SDLK_x):
        press(key)
    push(sdl2.SDL_QUIT)
    assert window.actions() == [Action.QUIT, Action.QUIT, Action.OVERLAY, Action.WIPE, Action.QUIT]
    press(sdl2.SDLK_w, repeat=1)  # held down: once is enough
    assert window.actions() == []


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

    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    with Window("test"):
        assert caught() == [True, False]


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


@pytest.mark.parametrize("renderer", ["software", "opengl", None], ids=["software", "OpenGL", "any"])
def test_a_real_window_shows_the_same(monkeypatch: pytest.MonkeyPatch, renderer: str | None) -> None:
    """As the X server has it, through SDL's renderers."""
    ours, theirs = (noise(320, 180, seed) for seed in (1, 2))
    with headless_screen(320, 180) as screen:
        monkeypatch.setenv("SDL_VIDEODRIVER", "x11")
        monkeypatch.setenv("DISPLAY", screen.display)
        if renderer:
            monkeypatch.setenv("SDL_RENDER_DRIVER", renderer)
        with Window("test") as window:
            window.present(theirs)
            window.present(ours, left=theirs)
            time.sleep(0.2)  # an OpenGL picture may come after present has returned
            shown = screen.picture().astype(int)
            for tags in (BT601, BT709, BT601_FULL):
                frame = Frame(np.full((180, 320), 120, np.uint8), *(np.full((90, 160), code, np.uint8) for code in (90, 170)), colour=tags)
                window.present(frame)
                time.sleep(0.2)
                assert np.abs(screen.picture() - expected(frame)).max() <= 2.5
    # OpenGL raises chroma linearly: luma's noise is told from the other picture's all the same.
    for side, frame in ((slice(0, 158), theirs), (slice(162, 320), ours)):
        distance = np.abs(shown - expected(frame))[:, side]
        assert distance.mean() < 25 if renderer == "opengl" else distance.max() <= 2.5
    assert (shown[:, 160] == 255).all()


def test_no_library_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "sdl2", None)
    with pytest.raises(OutputError, match=r"^no window can be opened without .*pip install 'gamesr\[play\]'.*libsdl2-2\.0-0[^\n]*$"):
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
