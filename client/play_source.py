"""What gamesr-play plays: frames with their arrival, from a file in real time or from whatever SOURCE means."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Protocol, Self
from urllib.parse import urlsplit

import av
from av.video.stream import VideoStream

from client.errors import InputError
from client.pace import step_s
from client.video import Decoded, OpenVideo, VideoSource

if TYPE_CHECKING:
    from client.reception import ReceptionCounts

MAX_SDP_BYTES = 1 << 16
IDLE_S = 0.01
_BEHIND_NS = 1_000_000_000  # as much as a receiver's queue holds
_ADDRESS = re.compile(r"(?P<host>\[[^\]/]+\]|[^:/\[\]]*):(?P<port>\d{1,5})")

Idle = Callable[[], None]  # called while nothing comes, at most 10 ms apart; may raise to end the source
Tell = Callable[[str, str], None]  # a kind of event, and a sentence


@dataclass(frozen=True, slots=True)
class Arrived(Decoded):
    """A decoded frame with `time.perf_counter_ns()` of the arrival of its first and last packet and of when it was whole.

    `sent_ns` is when it was sent, on the same clock; None where the sender does not say.
    """

    first_ns: int
    last_ns: int
    ready_ns: int
    sent_ns: int | None


class PlaySource(Protocol):
    """A stream that is played; a context manager, iterated once.

    `name` says what it is without any password in it, `size` is (width, height) where that is known before the first frame.
    """

    name: str
    size: tuple[int, int] | None

    def __enter__(self) -> Self: ...

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None: ...

    def frames(self, idle: Idle) -> Iterator[Arrived]:
        """Every frame that could be decoded, as soon as it is."""

    def waiting(self) -> int:
        """How many newer pictures are there already."""

    @property
    def decode_errors(self) -> int: ...

    @property
    def reception(self) -> ReceptionCounts | None:
        """What the network did; None where nothing tells."""


def open_source(text: str, *, until_bye: bool, tell: Tell) -> PlaySource:
    """What `text` means: an address to listen on, a session description, a URL, or a file. Raises InputError."""
    from client.play_url import PROTOCOLS, UrlSource

    scheme, separator, rest = text.partition("://")
    if separator and not Path(text).exists():
        if scheme.lower() == "rtp":
            return _listen(rest, until_bye, tell)
        if scheme.lower() not in PROTOCOLS:
            raise InputError(f"{scheme}:// is not played: choose one of {', '.join(PROTOCOLS)}, rtp, or name a file by its path")
        try:
            urlsplit(text)
        except ValueError as error:
            raise InputError(f"{shown_url(text)} is no URL") from error
        return UrlSource(text, until_bye=until_bye, tell=tell)
    if _ADDRESS.fullmatch(text) and not Path(text).exists():
        return _listen(text, until_bye, tell)
    path = Path(text)
    if path.suffix.lower() == ".sdp":
        return _described(path, until_bye, tell)
    return FileSource(path, tell=tell)


def _listen(text: str, until_bye: bool, tell: Tell) -> PlaySource:
    from client.play_rtp import RtpSource  # needs the extra `play`
    from client.sdp import LOOPBACK, Session

    found = _ADDRESS.fullmatch(text)
    if not found or not 0 < int(found["port"]) < 65536:
        raise InputError(f"{text} is no address to listen on: write HOST:PORT, or :PORT for this machine alone")
    return RtpSource(Session((found["host"].strip("[]") or LOOPBACK, int(found["port"]))), until_bye=until_bye, tell=tell)


def _described(path: Path, until_bye: bool, tell: Tell) -> PlaySource:
    from client.play_rtp import RtpSource
    from client.sdp import read_sdp

    try:
        with path.open("rb") as file:
            content = file.read(MAX_SDP_BYTES + 1)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from error
    if len(content) > MAX_SDP_BYTES:
        raise InputError(f"{path} is larger than {MAX_SDP_BYTES // 1024} KiB: it is no session description")
    session = read_sdp(content.decode("utf-8", "replace"))
    if not 0 < session.address[1] < 65536:
        raise InputError(f"{path} names no port to listen on")
    return RtpSource(session, until_bye=until_bye, tell=tell)


def shown_url(url: str) -> str:
    """A URL without name, password and query, for people to read.

    Of what is none, or may have / ? or # in its password, nothing but the scheme.
    """
    scheme = url.partition("://")[0]
    try:
        parts = urlsplit(url)
    except ValueError:
        return f"{scheme}://..."
    if "@" in parts.path + parts.query + parts.fragment:
        return f"{scheme}://..."
    return f"{scheme}://{parts.netloc.rpartition('@')[2]}{parts.path}"


def shown_source(text: str) -> str:
    """What `open_source` is given, for people to read; ? for the bytes of a file's name that are no UTF-8."""
    return shown_url(text) if "://" in text else text.encode(errors="replace").decode()


class Paced:
    """A recording in real time: of each of its packets, when its timestamp says, the frames; of the first at once. It loses nothing.

    While no packets come the clock stands, and where decoding falls behind by more than a second it is set back, so that it slows down.
    """

    def __init__(self, video: OpenVideo, packets: Iterator[av.Packet[VideoStream]], *, tell: Tell) -> None:
        self._video, self._packets, self._tell = video, packets, tell
        self._period_ns = max(1, int(1_000_000_000 / video.frame_rate))  # a header may claim any rate
        self._next_due_ns: int | None = None

    def waiting(self) -> int:
        """How many more are due by now."""
        late_ns = -1 if self._next_due_ns is None else time.perf_counter_ns() - self._next_due_ns
        return 0 if late_ns < 0 else 1 + late_ns // self._period_ns

    def frames(self, idle: Idle) -> Iterator[Arrived]:
        """Each arrives when it is due."""
        timed = self._timed()
        following = next(timed, None)
        begin_ns = time.perf_counter_ns()
        while following is not None:
            at_ns, packet = following
            asked_ns, due_ns = time.perf_counter_ns(), begin_ns + at_ns
            following = next(timed, None)
            starved_ns = max(0, time.perf_counter_ns() - max(asked_ns, due_ns))
            begin_ns += starved_ns
            due_ns += starved_ns
            while (left_ns := due_ns - time.perf_counter_ns()) > 0:
                idle()
                time.sleep(max(0.0, min((due_ns - time.perf_counter_ns()) / 1e9, IDLE_S)))
            if -left_ns > _BEHIND_NS:
                self._tell("slow", f"the file is {-left_ns / 1e9:.1f} s behind: it slows down")
                begin_ns -= left_ns
                due_ns -= left_ns
            # The last packet is empty: it has the decoder give up what it holds, and is no newer picture.
            self._next_due_ns = begin_ns + following[0] if following is not None and following[1].size else None
            for frame in self._video.decode(packet):
                yield Arrived(frame.frame, frame.packet_ns, frame.decoded_ns, due_ns, due_ns, due_ns, None)

    def _timed(self) -> Iterator[tuple[int, av.Packet[VideoStream]]]:
        """Each packet with its time from the first one's, which never goes back and never leaps."""
        period_s = Fraction(self._period_ns, 1_000_000_000)
        at_ns, last_dts = -self._period_ns, None
        for packet in self._packets:
            if packet.size:
                at_ns += int(step_s(last_dts, packet.dts, self._video.time_base, period_s) * 1_000_000_000)
            last_dts = packet.dts
            yield max(0, at_ns), packet


class FileSource:
    """A video file in real time. Raises InputError."""

    reception = None

    def __init__(self, path: Path, *, tell: Tell) -> None:
        self._video = VideoSource(path)
        self._paced = Paced(self._video, self._video.packets(), tell=tell)
        self.name = shown_source(str(path))
        self.size: tuple[int, int] | None = (self._video.width, self._video.height)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._video.__exit__(kind, error, trace)

    @property
    def decode_errors(self) -> int:
        return self._video.decode_errors

    def waiting(self) -> int:
        return self._paced.waiting()

    def frames(self, idle: Idle) -> Iterator[Arrived]:
        return self._paced.frames(idle)
