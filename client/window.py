"""A window for live pictures, by SDL 2: what the player sees, and the keys that are pressed in it. Needs the extra `play`."""

from __future__ import annotations

from collections.abc import Sequence
from ctypes import CFUNCTYPE, byref, c_char_p, c_int, c_uint
from enum import Enum
from types import TracebackType
from typing import Any, Self

from client.errors import OutputError
from client.frames import Frame
from client.textures import PictureTexture, TextTexture, load_sdl, sdl_error

ARROW_STEP = 0.02  # of the picture's width
GL_RENDERER = 0x1F01  # glGetString's name for what draws


class Action(Enum):
    """What a key asks for."""

    QUIT = "q, Escape, or the window is closed"
    FULLSCREEN = "f or F11; the window has done it already"
    OVERLAY = "F1"
    WIPE = "w"


class Window:
    """One window, which shows itself with the first picture, as large as that or as the screen allows; a context manager.

    All calls come from the thread that made it, and there is one at a time. Graphics hardware makes the colours and scales
    where there is any, else SDL's software; `SDL_RENDER_DRIVER` in the environment overrules that. `wipe_share` says how much
    of the picture, 0 to 1 from the left, shows the other one.

    Raises OutputError, in one sentence that says what to install, where there is no SDL or no display.
    """

    def __init__(self, title: str, *, fullscreen: bool = False) -> None:
        self._sdl = sdl = load_sdl()
        self._window: Any = None
        self._renderer: Any = None
        self._fullscreen, self._shown, self._wiping = fullscreen, False, False
        self.wipe_share = 0.5
        self._area = sdl.SDL_Rect(0, 0, 1, 1)  # where in the window the picture is
        self._keys = {
            sdl.SDLK_q: Action.QUIT,
            sdl.SDLK_ESCAPE: Action.QUIT,
            sdl.SDLK_f: Action.FULLSCREEN,
            sdl.SDLK_F11: Action.FULLSCREEN,
            sdl.SDLK_F1: Action.OVERLAY,
            sdl.SDLK_w: Action.WIPE,
        }
        sdl.SDL_SetHint(sdl.SDL_HINT_RENDER_SCALE_QUALITY, b"linear")
        sdl.SDL_SetHint(sdl.SDL_HINT_FRAMEBUFFER_ACCELERATION, b"0")  # else SDL's software shows its picture through OpenGL again
        sdl.SDL_SetHint(sdl.SDL_HINT_NO_SIGNAL_HANDLERS, b"1")  # SIGINT and SIGTERM are the program's
        try:
            self._open(title)
        except BaseException:
            self._close()
            raise
        self._picture = PictureTexture(sdl, self._renderer)
        self._text = TextTexture(sdl, self._renderer)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._close()

    def actions(self) -> list[Action]:
        """What was pressed since the last call, which also keeps the window alive; at once. Moves the wipe while there is one."""
        event = self._sdl.SDL_Event()
        actions = []
        while self._sdl.SDL_PollEvent(byref(event)):
            action = self._handle(event)
            if action is not None:
                actions.append(action)
        return actions

    def present(self, picture: Frame, *, left: Frame | None = None, overlay: Sequence[str] = ()) -> None:
        """Show `picture`, `left` instead of it to the left of the wipe, and lines of printable ASCII above; returns after SDL's present.

        Both have one size. They keep their ratio of width to height, with black beside them, and may be changed afterwards.
        Raises OutputError where SDL refuses, and where they differ in size.
        """
        if left is not None and left.y.shape != picture.y.shape:
            sizes = f"{left.width}x{left.height} and {picture.width}x{picture.height}"
            raise OutputError(f"the wipe cannot be shown between pictures of {sizes}: they must have one size")
        if not self._shown:
            self._show(picture)
        self._wiping = left is not None
        columns = self._wipe_columns(picture) if left is not None else 0
        self._picture.upload(picture, left, columns)
        sdl, renderer = self._sdl, self._renderer
        width, height = self._output_size()
        self._area = area = sdl.SDL_Rect(*_fitted(picture.width, picture.height, width, height))
        sdl.SDL_SetRenderDrawColor(renderer, 0, 0, 0, 255)
        sdl.SDL_RenderClear(renderer)
        sdl.SDL_RenderCopy(renderer, self._picture.texture, None, area)
        if 0 < columns < picture.width:
            thickness = max(1, height // 540)
            line = sdl.SDL_Rect(area.x + round(columns * area.w / picture.width) - thickness // 2, area.y, thickness, area.h)
            sdl.SDL_SetRenderDrawColor(renderer, 255, 255, 255, 255)
            sdl.SDL_RenderFillRect(renderer, line)
        if overlay:
            self._text.write(overlay, width, height)
            margin = height // 60
            sdl.SDL_RenderCopy(renderer, self._text.texture, None, sdl.SDL_Rect(margin, margin, self._text.width, self._text.height))
        sdl.SDL_RenderPresent(renderer)

    def _open(self, title: str) -> None:
        sdl = self._sdl
        failed = sdl.SDL_Init(sdl.SDL_INIT_VIDEO)
        # Without a display SDL takes a driver that draws where nobody sees it; who wants that asks for it.
        if failed or (sdl.SDL_GetCurrentVideoDriver() == b"offscreen" and not sdl.SDL_GetHint(b"SDL_VIDEODRIVER")):
            reason = f" ({sdl_error(sdl)})" if failed else ""
            hint = "set DISPLAY or WAYLAND_DISPLAY, and install libsdl2-2.0-0, which brings the system's libraries for them"
            raise OutputError(f"no window can be opened, as SDL finds no display{reason}: {hint}")
        # Hardware comes first in SDL's list of renderers, software last. And no SDL_RENDERER_PRESENTVSYNC: who waits for a
        # blank measures the screen, and misses deadlines that the picture has met; it may tear instead.
        self._create(title, 0)
        if self._is_opengl_on_the_processor():
            self._destroy()
            self._create(title, sdl.SDL_RENDERER_SOFTWARE)

    def _create(self, title: str, flags: int) -> None:
        sdl = self._sdl
        anywhere, kind = sdl.SDL_WINDOWPOS_UNDEFINED, sdl.SDL_WINDOW_HIDDEN | sdl.SDL_WINDOW_RESIZABLE
        self._window = sdl.SDL_CreateWindow(title.encode(errors="replace"), anywhere, anywhere, 640, 360, kind)
        self._renderer = self._window and sdl.SDL_CreateRenderer(self._window, -1, flags)
        if not self._renderer:
            raise OutputError(f"no window can be opened: {sdl_error(sdl)}")

    def _is_opengl_on_the_processor(self) -> bool:
        """Mesa's stand-in for hardware, which takes all cores and many times as long as SDL's software does."""
        if not self._sdl.SDL_GL_GetCurrentContext():
            return False
        get_string = CFUNCTYPE(c_char_p, c_uint)(self._sdl.SDL_GL_GetProcAddress(b"glGetString"))
        return any(name in (get_string(GL_RENDERER) or b"") for name in (b"llvmpipe", b"softpipe"))

    def _close(self) -> None:
        """Also what is half open, and again."""
        self._destroy()
        self._sdl.SDL_Quit()

    def _destroy(self) -> None:
        self._sdl.SDL_DestroyRenderer(self._renderer)  # and its textures
        self._sdl.SDL_DestroyWindow(self._window)
        self._window = self._renderer = None

    def _show(self, picture: Frame) -> None:
        sdl, bounds = self._sdl, self._sdl.SDL_Rect()
        width, height = picture.width, picture.height
        known = sdl.SDL_GetDisplayUsableBounds(sdl.SDL_GetWindowDisplayIndex(self._window), byref(bounds)) == 0
        if known and (width > bounds.w or height > bounds.h):
            width, height = _fitted(width, height, bounds.w, bounds.h)[2:]
        sdl.SDL_SetWindowSize(self._window, width, height)
        sdl.SDL_SetWindowPosition(self._window, sdl.SDL_WINDOWPOS_CENTERED, sdl.SDL_WINDOWPOS_CENTERED)
        sdl.SDL_ShowWindow(self._window)
        self._shown = True
        if self._fullscreen:
            self._set_fullscreen(True)

    def _set_fullscreen(self, fullscreen: bool) -> None:
        # A screen that refuses it leaves the window as it was, and the game goes on.
        self._sdl.SDL_SetWindowFullscreen(self._window, self._sdl.SDL_WINDOW_FULLSCREEN_DESKTOP if fullscreen else 0)
        self._fullscreen = fullscreen

    def _handle(self, event: Any) -> Action | None:
        sdl = self._sdl
        if event.type == sdl.SDL_QUIT:
            return Action.QUIT
        if event.type in (sdl.SDL_RENDER_TARGETS_RESET, sdl.SDL_RENDER_DEVICE_RESET):  # Direct3D's, after a lock screen
            for texture in (self._picture, self._text):
                texture.drop()
        elif event.type == sdl.SDL_MOUSEMOTION:
            self._move_wipe((event.motion.x - self._area.x) / self._area.w)
        elif event.type == sdl.SDL_KEYDOWN:
            key = event.key.keysym.sym
            if key in (sdl.SDLK_LEFT, sdl.SDLK_RIGHT):
                self._move_wipe(self.wipe_share + (ARROW_STEP if key == sdl.SDLK_RIGHT else -ARROW_STEP))
            elif not event.key.repeat:
                action = self._keys.get(key)
                if action is Action.FULLSCREEN:
                    self._set_fullscreen(not self._fullscreen)
                return action
        return None

    def _move_wipe(self, share: float) -> None:
        if self._wiping:
            self.wipe_share = min(1.0, max(0.0, share))

    def _wipe_columns(self, picture: Frame) -> int:
        """Where the wipe stands, in columns of the picture: an even one, or the last."""
        share = min(1.0, max(0.0, self.wipe_share))
        return picture.width if share == 1 else min(picture.width, 2 * round(share * picture.width / 2))

    def _output_size(self) -> tuple[int, int]:
        width, height = c_int(), c_int()
        if self._sdl.SDL_GetRendererOutputSize(self._renderer, byref(width), byref(height)):
            raise OutputError(f"the window cannot be drawn on: {sdl_error(self._sdl)}")
        return max(1, width.value), max(1, height.value)


def _fitted(width: int, height: int, outer_width: int, outer_height: int) -> tuple[int, int, int, int]:
    """Left, top, width and height of the largest picture of this ratio in the middle of an area."""
    scale = min(outer_width / width, outer_height / height)
    fitted = max(1, round(width * scale)), max(1, round(height * scale))
    return (outer_width - fitted[0]) // 2, (outer_height - fitted[1]) // 2, *fitted
