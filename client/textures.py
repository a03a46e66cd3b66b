"""What lies in SDL's memory: a picture's planes, and the pixels of the overlay. Needs the extra `play`."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from ctypes import byref, c_uint8
from typing import Any

from client.errors import OutputError, how_to_install
from client.frames import ColourTags, Frame
from client.overlay import text_box


def load_sdl() -> Any:
    """PySDL2 and the library that it binds: the wheel pysdl2-dll's, else the system's. Raises OutputError where one is missing."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it says which library it took
            import sdl2
    except ImportError as error:
        hint = f"{how_to_install('play')}, and where that brings no SDL the system's libsdl2-2.0-0"
        raise OutputError(f"no window can be opened without PySDL2 and SDL 2 ({error}): {hint}") from error
    return sdl2


class PictureTexture:
    """A texture that takes 4:2:0 planes as they are; it is made anew when the size or the colours of the pictures change."""

    def __init__(self, sdl: Any, renderer: Any) -> None:
        self._sdl, self._renderer = sdl, renderer
        self._kind: tuple[int, int, int] | None = None
        self.texture: Any = None

    def upload(self, picture: Frame, left: Frame | None = None, columns: int = 0) -> None:
        """Copy the planes, whatever their strides: the first `columns` of `left`, the rest of `picture`; both are free afterwards.

        `columns` is even, so that no chroma sample belongs to both, or the width. Raises OutputError where SDL refuses.
        """
        sdl = self._sdl
        conversion = _conversion(sdl, picture.colour)
        # One setting for everything, read when planes are converted in software, and when a texture is made in hardware.
        sdl.SDL_SetYUVConversionMode(conversion)
        kind = picture.width, picture.height, conversion
        if kind != self._kind:
            self.drop()
            access = sdl.SDL_TEXTUREACCESS_STREAMING
            self.texture = sdl.SDL_CreateTexture(self._renderer, sdl.SDL_PIXELFORMAT_IYUV, access, picture.width, picture.height)
            if not self.texture:
                raise self._failure(picture)
            self._kind = kind
        if left is not None and columns:
            self._update(left, 0, columns)
        if columns < picture.width:
            self._update(picture, columns, picture.width)

    def _update(self, frame: Frame, start: int, stop: int) -> None:
        planes: list[Any] = []
        for plane, column in ((frame.y, start), (frame.u, start // 2), (frame.v, start // 2)):
            planes += byref(c_uint8.from_address(plane.ctypes.data + column)), plane.strides[0]
        area = self._sdl.SDL_Rect(start, 0, stop - start, frame.height)
        if self._sdl.SDL_UpdateYUVTexture(self.texture, area, *planes):
            raise self._failure(frame)

    def _failure(self, frame: Frame) -> OutputError:
        return OutputError(f"a picture of {frame.width}x{frame.height} cannot be shown: {sdl_error(self._sdl)}")

    def drop(self) -> None:
        if self.texture:
            self._sdl.SDL_DestroyTexture(self.texture)
        self.texture = self._kind = None


class TextTexture:
    """The overlay's box; it is drawn and copied anew only when its text or the window's size changes."""

    def __init__(self, sdl: Any, renderer: Any) -> None:
        self._sdl, self._renderer = sdl, renderer
        self._shown: tuple[tuple[str, ...], int, int] | None = None
        self.texture: Any = None
        self.width = self.height = 0

    def write(self, lines: Sequence[str], width: int, height: int) -> None:
        """Lay out at least one line for a window of `width` x `height` pixels. Raises OutputError where SDL cannot."""
        sdl = self._sdl
        if (tuple(lines), width, height) == self._shown:
            return
        box = text_box(lines, width, height)
        if box.shape != (self.height, self.width) or not self.texture:
            self.drop()
            self.height, self.width = box.shape
            access = sdl.SDL_TEXTUREACCESS_STATIC
            self.texture = sdl.SDL_CreateTexture(self._renderer, sdl.SDL_PIXELFORMAT_ARGB8888, access, self.width, self.height)
            if not self.texture or sdl.SDL_SetTextureBlendMode(self.texture, sdl.SDL_BLENDMODE_BLEND):
                raise OutputError(f"the overlay cannot be drawn: {sdl_error(sdl)}")
        if sdl.SDL_UpdateTexture(self.texture, None, box.ctypes.data, box.strides[0]):
            raise OutputError(f"the overlay cannot be drawn: {sdl_error(sdl)}")
        self._shown = tuple(lines), width, height

    def drop(self) -> None:
        if self.texture:
            self._sdl.SDL_DestroyTexture(self.texture)
        self.texture = self._shown = None


def sdl_error(sdl: Any) -> str:
    return str(sdl.SDL_GetError().decode(errors="replace"))


def _conversion(sdl: Any, colour: ColourTags) -> int:
    """SDL's way from planes to colours that is nearest to the tags (SDL_YUV_CONVERSION_MODE, SDL_surface.h).

    SDL 2 knows BT.601 and BT.709 in limited range and BT.601 in full range ("JPEG"). BT.709 in full range gets the latter:
    greys are right and a saturated green is 36 codes of 255 off, where BT.709's limited range would be 19 off in black and white.
    Everything else is taken for BT.709, as by `client.rgb`.
    """
    if colour.range == 2:
        return int(sdl.surface.SDL_YUV_CONVERSION_JPEG)
    return int(sdl.surface.SDL_YUV_CONVERSION_BT601 if colour.matrix in (5, 6) else sdl.surface.SDL_YUV_CONVERSION_BT709)
