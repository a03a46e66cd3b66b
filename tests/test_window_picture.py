"""What a window shows: the colours of the tags, the whole picture in its ratio, the wipe and the overlay; on a real screen the same."""

from __future__ import annotations

import time

import numpy as np
import pytest

from client import lettering
from client.frames import ColourTags, Frame, Plane
from client.window import Window
from tests.headless import headless_screen
from tests.windows import BT601, BT601_FULL, BT709, BT709_FULL, expected, flat, noise, pixels, resize


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
