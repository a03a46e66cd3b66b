"""What FFmpeg opens by itself, such as RTSP: a thread that reads packets, so that silence stops nobody. It tells of no losses."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterator
from types import TracebackType
from typing import Self

import av
from av.video.stream import VideoStream

from client.errors import InputError
from client.play_source import IDLE_S, Arrived, Idle, Tell, shown_url
from client.video import CONTAINERS, OpenVideo

PROTOCOLS = ("rtsp", "rtsps", "udp", "tcp", "http", "https")
_ENDING = ("http", "https")  # a file lies there: its end is the end
_BENEATH = "rtp,udp,tcp,tls,http,https,rtsp,rtsps"  # never file, pipe or concat, whatever an answer says
_OPTIONS = {
    "protocol_whitelist": _BENEATH,
    "format_whitelist": f"{CONTAINERS},rtsp",  # no playlists: they name other addresses
    "analyzeduration": "1000000",  # what was read for it comes in a burst, of which the deadline rule shows the newest
}
_OPEN_S, _READ_S = 5.0, 5.0
_RETRY_S = 1.0
_PACKETS_QUEUED = 64


class UrlSource:
    """A stream that FFmpeg opens, of any codec that it decodes; opened again, every second, when it ended or was silent for 5 s.

    With `until_bye`, and over HTTP, the end is the end. Raises InputError where it cannot be opened the first time.
    """

    reception = None

    def __init__(self, url: str, *, until_bye: bool, tell: Tell) -> None:
        self._url, self._tell = url, tell
        self.name = shown_url(url)
        self.size: tuple[int, int] | None = None
        self._ends = until_bye or url.partition("://")[0].lower() in _ENDING
        self._reader: _Reader | None = None
        self._errors = 0  # of readers before

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._reader is not None:
            self._reader.close()

    @property
    def decode_errors(self) -> int:
        return self._errors + (0 if self._reader is None else self._reader.decode_errors)

    def waiting(self) -> int:
        return 0 if self._reader is None else len(self._reader.packets)

    def frames(self, idle: Idle) -> Iterator[Arrived]:
        begun = False
        while True:
            self._reader = reader = _Reader(self._url, self.name)
            reader.start()
            yield from reader.frames(idle, self._tell)
            if reader.error is not None and not begun:
                raise reader.error
            begun |= reader.opened
            reader.close()
            self._errors, self._reader = self.decode_errors, None
            if self._ends:
                return
            self._tell("goodbye", "the stream ended or was silent too long: opening it again")
            again = time.monotonic() + _RETRY_S
            while time.monotonic() < again:
                idle()
                time.sleep(IDLE_S)


class _Reader(threading.Thread):
    """Opens the URL and reads it to its end. Who takes packets too slowly loses them."""

    def __init__(self, url: str, name: str) -> None:
        super().__init__(name="url-reader", daemon=True)
        self.packets: deque[tuple[int, av.Packet[VideoStream]]] = deque()
        self.error: InputError | None = None
        self.opened = False
        self._url, self._name = url, name
        self._video: OpenVideo | None = None
        self._changed = threading.Condition()
        self._overflowed = self._closed = self._ended = False

    @property
    def decode_errors(self) -> int:
        return 0 if self._video is None else self._video.decode_errors

    def close(self) -> None:
        """It ends with the next packet, or when none comes in time; nobody waits for that."""
        with self._changed:
            self._closed = True
            if self._ended and self._video is not None:
                self._video.__exit__(None, None, None)

    def frames(self, idle: Idle, tell: Tell) -> Iterator[Arrived]:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self.packets or self._ended, IDLE_S)
                ended, overflowed, self._overflowed = self._ended, self._overflowed, False
                taken = self.packets.popleft() if self.packets else None
            if overflowed and self._video is not None:
                self._video.distrust()
                tell("overflow", "packets waited too long and were thrown away")
            if taken is None:
                if ended:
                    return
                idle()
                continue
            arrived_ns, packet = taken
            assert self._video is not None
            for frame in self._video.decode(packet):
                yield Arrived(frame.frame, frame.packet_ns, frame.decoded_ns, arrived_ns, arrived_ns, arrived_ns, None)

    def run(self) -> None:
        try:
            container = av.open(self._url, "r", options=dict(_OPTIONS), timeout=(_OPEN_S, _READ_S))
            self._video = OpenVideo(self._name, container)
            self.opened = True
            for packet in self._video.packets():
                self._put(packet)
                if self._closed:
                    break
        except (av.FFmpegError, OSError, ValueError) as error:
            reason = "nothing came" if isinstance(error, av.error.ExitError) else getattr(error, "strerror", None) or "it is no URL"
            self.error = InputError(f"{self._name} cannot be opened: {reason}")
        except InputError as error:
            self.error = error
        finally:
            with self._changed:
                self._ended = True
                if self._closed and self._video is not None:  # whoever comes last: what is queued can be decoded until then
                    self._video.__exit__(None, None, None)
                self._changed.notify_all()

    def _put(self, packet: av.Packet[VideoStream]) -> None:
        with self._changed:
            if len(self.packets) >= _PACKETS_QUEUED:
                self.packets.clear()
                self._overflowed = True
            self.packets.append((time.perf_counter_ns(), packet))
            self._changed.notify_all()
