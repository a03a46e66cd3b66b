"""What FFmpeg opens by itself, such as RTSP: a thread that reads packets, so that silence stops nobody. It tells of no losses."""

from __future__ import annotations

import errno
import itertools
import ssl
import threading
import time
from collections import deque
from collections.abc import Iterator
from types import TracebackType
from typing import Self

import av
from av.video.stream import VideoStream

from client.errors import InputError
from client.play_source import IDLE_S, Arrived, Idle, Paced, Tell, shown_url
from client.video import CONTAINERS, OpenVideo

PROTOCOLS = ("rtsp", "rtsps", "udp", "tcp", "http", "https")
_RECORDED = ("http", "https")  # a file lies there: it comes as fast as it can, and its end is the end
_BENEATH = "rtp,udp,tcp,tls,http,https,rtsp,rtsps"  # never file, pipe or concat, whatever an answer says
_TLS = ("https", "rtsps")
_OPTIONS = {
    "protocol_whitelist": _BENEATH,
    "format_whitelist": f"{CONTAINERS},rtsp",  # no playlists: they name other addresses
    "analyzeduration": "1000000",  # what was read for it comes in a burst, of which the deadline rule shows the newest
    "fpsprobesize": "0",  # the frame rate follows from the timestamps: measuring it first takes most of a second more
    "rtsp_flags": "prefer_tcp",  # nothing tells of a packet that UDP lost, and firewalls let nothing of it through
    "tls_verify": "1",
}
_OPEN_S, _READ_S = 5.0, 5.0
_RETRY_S = 1.0
_PACKETS_QUEUED = 64


class UrlSource:
    """A stream that FFmpeg opens, of any codec that it decodes; opened again, every second, when it ended or was silent for 5 s.

    With `until_bye` the end is the end, and over HTTP, where a file is played in real time and nothing of it is lost. RTSP carries its RTP
    in the same connection where the server can, else by UDP. Certificates are held against those that Python's ssl trusts (the file
    in SSL_CERT_FILE). Raises InputError where it cannot be opened the first time.
    """

    reception = None

    def __init__(self, url: str, *, until_bye: bool, tell: Tell) -> None:
        self._url, self._tell = url, tell
        self.name = shown_url(url)
        self.size: tuple[int, int] | None = None
        self._recorded = url.partition("://")[0].lower() in _RECORDED
        self._ends = until_bye or self._recorded
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
        return 0 if self._reader is None else self._reader.waiting()

    def frames(self, idle: Idle) -> Iterator[Arrived]:
        begun = gone = False
        while True:
            self._reader = reader = _Reader(self._url, self.name, recorded=self._recorded)
            reader.start()
            for frame in reader.frames(idle, self._tell):
                if gone:
                    gone = False
                    self._tell("sender", "the stream is there again")
                yield frame
            if reader.error is not None and not begun:
                raise reader.error
            begun |= reader.opened
            reader.close()
            self._errors, self._reader = self.decode_errors, None
            if self._ends:
                return
            gone = True
            if reader.error is not None:
                self._tell("unreachable", f"{reader.error}; trying again every second")
            elif reader.silent:
                self._tell("silence", f"nothing has come for {_READ_S:g} s: opening it again")
            else:
                self._tell("goodbye", "the stream ended or broke off: opening it again")
            again = time.monotonic() + _RETRY_S
            while time.monotonic() < again:
                idle()
                time.sleep(IDLE_S)


class _Reader(threading.Thread):
    """Opens the URL and reads it to its end. Who takes packets too slowly loses them, but a recording waits."""

    def __init__(self, url: str, name: str, *, recorded: bool) -> None:
        super().__init__(name="url-reader", daemon=True)
        self.packets: deque[tuple[int, av.Packet[VideoStream]]] = deque()
        self.error: InputError | None = None
        self.opened = self.silent = False
        self._url, self._name, self._recorded = url, name, recorded
        self._video: OpenVideo | None = None
        self._paced: Paced | None = None
        self._changed = threading.Condition()
        self._overflowed = self._closed = self._ended = False

    @property
    def decode_errors(self) -> int:
        return 0 if self._video is None else self._video.decode_errors - self._video.broke_off

    def close(self) -> None:
        """It ends with the next packet, or when none comes in time; nobody waits for that."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
            if self._ended and self._video is not None:
                self._video.__exit__(None, None, None)

    def waiting(self) -> int:
        return len(self.packets) if self._paced is None else min(self._paced.waiting(), 1 + len(self.packets))  # one it holds

    def frames(self, idle: Idle, tell: Tell) -> Iterator[Arrived]:
        arrivals = self._arrivals(idle, tell)
        first = next(arrivals, None)
        if first is None or self._video is None:
            return
        arrivals = itertools.chain([first], arrivals)
        if self._recorded:
            self._paced = Paced(self._video, (packet for _, packet in arrivals), tell=tell)
            yield from self._paced.frames(idle)
            return
        for arrived_ns, packet in arrivals:
            frame = None
            for frame in self._video.decode(packet):
                yield Arrived(frame.frame, frame.packet_ns, frame.decoded_ns, arrived_ns, arrived_ns, arrived_ns, None)
            if frame is None:
                idle()  # where much comes that cannot be decoded, nobody waits for long

    def _arrivals(self, idle: Idle, tell: Tell) -> Iterator[tuple[int, av.Packet[VideoStream]]]:
        """Packets with when they were there."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self.packets or self._ended, IDLE_S)
                ended, overflowed, self._overflowed = self._ended, self._overflowed, False
                taken = self.packets.popleft() if self.packets else None
                self._changed.notify_all()
            if overflowed and self._video is not None:
                self._video.distrust()
                tell("overflow", "packets waited too long and were thrown away")
            if taken is None:
                if ended:
                    return
                idle()
                continue
            yield taken

    def run(self) -> None:
        begin_s = time.monotonic()
        try:
            container = av.open(self._url, "r", options=_OPTIONS | _trusted(), timeout=(_OPEN_S, _READ_S))
            self._video = OpenVideo(self._name, container)
            self.opened = True
            self._read(self._video)
        except (av.FFmpegError, OSError, ValueError) as error:
            reason = _reason(self._url, error, time.monotonic() - begin_s)
            self.error = InputError(f"{self._name} cannot be opened: {reason}")
        except InputError as error:
            self.error = error
        finally:
            with self._changed:
                self._ended = True
                if self._closed and self._video is not None:  # whoever comes last: what is queued can be decoded until then
                    self._video.__exit__(None, None, None)
                self._changed.notify_all()

    def _read(self, video: OpenVideo) -> None:
        before_s = time.monotonic()
        for packet in video.packets():
            now_s = time.monotonic()
            # After silence FFmpeg gives out what it held, as if that had come, and for each piece would wait anew.
            self.silent = now_s - before_s >= _READ_S
            self._put(packet)
            before_s = time.monotonic()
            if self._closed or self.silent:
                break

    def _put(self, packet: av.Packet[VideoStream]) -> None:
        with self._changed:
            if self._recorded:
                self._changed.wait_for(lambda: len(self.packets) < _PACKETS_QUEUED or self._closed)
            elif len(self.packets) >= _PACKETS_QUEUED:
                self.packets.clear()
                self._overflowed = True
            self.packets.append((time.perf_counter_ns(), packet))
            self._changed.notify_all()


def _trusted() -> dict[str, str]:
    """The file of certificates to believe: FFmpeg inside PyAV's wheels does not know the system's."""
    file = ssl.get_default_verify_paths().cafile
    return {} if file is None else {"ca_file": file}


def _reason(url: str, error: Exception, after_s: float) -> str:
    """Why a URL could not be opened, given what was raised and after how long."""
    if isinstance(error, av.error.ExitError) or (isinstance(error, av.error.InvalidDataError) and after_s >= _OPEN_S):
        return f"nothing came for {_OPEN_S:g} s"  # RTSP makes invalid data of an answer that was given up
    if url.partition("://")[0].lower() in _TLS and isinstance(error, OSError) and error.errno == errno.EIO:
        return "there is no TLS connection, perhaps because its certificate is not trusted (SSL_CERT_FILE says which are) or another host's"
    return getattr(error, "strerror", None) or "it is no URL"
