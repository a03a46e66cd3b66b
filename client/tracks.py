"""What a file holds beside its picture, copied into another: sound, subtitles, chapters and what it says of itself."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, TypeVar

import av
from av.audio.stream import AudioStream
from av.container import OutputContainer
from av.stream import Stream

from client.errors import OutputError
from client.video import open_local

_OF_THE_CONTAINER = ("major_brand", "minor_version", "compatible_brands", "encoder")  # true of the old file alone
_OF_A_TRACK = ("language", "title")
Track = TypeVar("Track", bound=Stream)


@dataclass(frozen=True)
class _Span:
    """Of one packet, in seconds."""

    begin: Fraction
    end: Fraction


class TrackCopy:
    """Every audio and subtitle stream of `path`, added to `output`, whose header it writes, and then copied along as its video advances.

    It reads the file a second time, by itself: whatever drives the video need not know that there is more. Chapters, title, languages and
    which track is the default are kept. A packet of sound whose time does not go on from the one before follows it at once, as pictures do;
    what FFmpeg does not know, or has not found by then, and subtitles that the container of `output` cannot hold are left out; `notes`
    says so. Raises OutputError for audio that it cannot hold.
    """

    def __init__(self, path: Path, output: OutputContainer) -> None:
        self._path, self._container = path, open_local(path)
        self._output = output
        self._targets: dict[int, Stream] = {}
        self._last: dict[int, _Span] = {}  # where each stream's last packet lies
        self._moved = 0
        self._left_out: list[str] = []
        try:
            self._add_all()
            output.start_encoding()
        except ValueError as error:  # FFmpeg's "Invalid argument" is one too
            tried = (stream for stream in self._container.streams.audio if stream.codec_context is not None)
            names = ", ".join(stream.name or "unknown" for stream in tried)
            self._container.close()
            if not names:
                raise
            matroska = output.format.name == "matroska"
            advice = f"leave it out with ffmpeg -i {path} -c copy -an, and upscale that" if matroska else "write to .mkv instead"
            raise OutputError(f"{output.format.name} cannot hold the audio of {path} ({names}): {advice}") from error
        self._packets = self._read()
        self._waiting = next(self._packets, None)

    def copy_until(self, time: Fraction | None) -> None:
        """Copy the packets that begin before `time` in seconds, or all that are left."""
        while self._waiting is not None and (time is None or _seconds(self._waiting) < time):
            self._output.mux_one(self._waiting)
            self._waiting = next(self._packets, None)

    def close(self) -> None:
        self._container.close()

    def notes(self) -> list[str]:
        notes = list(self._left_out)
        if self._moved:
            notes.append(f"{self._moved} packets of sound had a timestamp that went back: each follows the one before")
        return notes

    def _add_all(self) -> None:
        """Raises ValueError for audio that cannot be held."""
        said = self._container.metadata
        self._output.metadata.update({name: text for name, text in said.items() if name.lower() not in _OF_THE_CONTAINER})
        self._output.set_chapters(self._container.chapters())
        for number, stream in enumerate(self._container.streams.audio, 1):
            if not self._known(stream, f"audio track {number}"):
                continue
            if not stream.codec_context.sample_rate or not stream.codec_context.channels:
                longer = f"ffmpeg -probesize 1G -analyzeduration 1G -i {self._path} -c copy FILE.mkv"
                self._left_out.append(
                    f"audio track {number} ({stream.name}) is left out: none was found; if it begins late, upscale what {longer} makes"
                )
                continue
            self._targets[stream.index] = target = _described(self._output.add_stream_from_template(stream), stream)
            channels = stream.codec_context.channels
            if stream.codec_context.layout.name == f"{channels} channels":  # of .avi and .mkv, which do not say which is which
                target.codec_context.layout = f"{channels}c"  # FFmpeg's word for the usual ones
        for number, subtitles in enumerate(self._container.streams.subtitles, 1):
            if not self._known(subtitles, f"subtitle track {number}"):
                continue
            try:
                self._targets[subtitles.index] = _described(self._output.add_stream_from_template(subtitles), subtitles)
            except ValueError:
                container = self._output.format.name
                self._left_out.append(f"subtitle track {number} ({subtitles.name or 'unknown'}) is left out: {container} cannot hold it")

    def _known(self, stream: Stream, what: str) -> bool:
        if stream.codec_context is None:
            self._left_out.append(f"{what} is left out: its codec is not known here")
        return stream.codec_context is not None

    def _read(self) -> Iterator[av.Packet[Any]]:
        if not self._targets:
            return
        packets = self._container.demux([self._container.streams[index] for index in self._targets])
        while True:
            try:
                packet = next(packets)
            except (StopIteration, av.FFmpegError):  # a file that is cut short ends its audio where it ends its video
                return
            if packet.size and packet.dts is not None:
                self._retime(packet, packet.dts)
                yield packet

    def _retime(self, packet: av.Packet[Any], dts: int) -> None:
        """Put it into the target's ticks, in which each packet of sound has to begin later than the one before."""
        target, index = self._targets[packet.stream_index], packet.stream_index
        tick = target.time_base
        assert tick is not None  # the header has been written
        begin, last = dts * packet.time_base, self._last.get(index)
        if isinstance(target, AudioStream) and last is not None and round(begin / tick) <= round(last.begin / tick):
            begin = last.end
            self._moved += 1
        delay = None if packet.pts is None else (packet.pts - dts) * packet.time_base
        duration = (packet.duration or 0) * packet.time_base
        # Exact: Matroska's ticks are of a millisecond, and what is lost to them in each packet would add up.
        self._last[index] = _Span(begin, begin + max(tick, duration))
        packet.stream, packet.time_base = target, tick
        packet.dts, packet.duration = round(begin / tick), round(duration / tick)
        packet.pts = None if delay is None else round((begin + delay) / tick)


def _described(target: Track, stream: Track) -> Track:
    target.metadata.update({name: text for name, text in stream.metadata.items() if name in _OF_A_TRACK})
    target.disposition = stream.disposition
    return target


def _seconds(packet: av.Packet[Any]) -> Fraction:
    return (packet.dts or 0) * packet.time_base
