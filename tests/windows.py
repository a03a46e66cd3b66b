"""A window without a screen, by SDL's dummy driver and its software renderer: what it shows is read back, what happens to it is pushed."""

from __future__ import annotations

import sys
from ctypes import byref, c_int

import numpy as np

from client.frames import ColourTags, Frame
from client.textures import load_sdl

sdl2 = load_sdl()

BT601, BT709 = ColourTags(1, 6, 6, 6), ColourTags(1, 1, 1, 1)
BT601_FULL, BT709_FULL = ColourTags(2, 6, 6, 6), ColourTags(2, 1, 1, 1)
KR_KB = {6: (0.299, 0.114), 1: (0.2126, 0.0722)}  # ITU-R BT.601 and BT.709


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
