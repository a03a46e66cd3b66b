"""The audio of one file copied into another, packet by packet."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
from av.audio.stream import AudioStream
from av.container import OutputContainer

from client.errors import OutputError
from client.video import open_local


@dataclass(frozen=True)
class _Span:
    """Of one packet, in seconds."""

    begin: Fraction
    end: Fraction


class AudioCopy:
    """Every audio stream of `path`, added to `output`, whose header it writes, and then copied along as its video advances.

    It reads the file a second time, by itself: whatever drives the video need not know that there is audio. A packet whose time
    does not go on from the one before follows it at once, as pictures do; `moved` counts them. Raises OutputError for audio that the
    container of `output` cannot hold.
    """

    def __init__(self, path: Path, output: OutputContainer) -> None:
        self.moved = 0
        self._container = open_local(path)
        self._output = output
        self._targets: dict[int, AudioStream] = {}
        self._last: dict[int, _Span] = {}  # where each stream's last packet lies
        try:
            for stream in self._container.streams.audio:
                self._targets[stream.index] = _added(output, stream)
            output.start_encoding()
        except ValueError as error:  # FFmpeg's "Invalid argument" is one too
            names = ", ".join(stream.name or "unknown" for stream in self._container.streams.audio)
            self._container.close()
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

    def _read(self) -> Iterator[av.Packet[AudioStream]]:
        if not self._targets:
            return
        packets = self._container.demux(self._container.streams.audio)
        while True:
            try:
                packet = next(packets)
            except (StopIteration, av.FFmpegError):  # a file that is cut short ends its audio where it ends its video
                return
            if packet.size and packet.dts is not None:
                self._retime(packet, packet.dts)
                yield packet

    def _retime(self, packet: av.Packet[AudioStream], dts: int) -> None:
        """Put it into the target's ticks, in which each packet has to begin later than the one before."""
        target, index = self._targets[packet.stream_index], packet.stream_index
        tick = target.time_base
        assert tick is not None  # the header has been written
        begin, last = dts * packet.time_base, self._last.get(index)
        if last is not None and round(begin / tick) <= round(last.begin / tick):
            begin = last.end
            self.moved += 1
        delay = None if packet.pts is None else (packet.pts - dts) * packet.time_base
        duration = (packet.duration or 0) * packet.time_base
        # Exact: Matroska's ticks are of a millisecond, and what is lost to them in each packet would add up.
        self._last[index] = _Span(begin, begin + max(tick, duration))
        packet.stream, packet.time_base = target, tick
        packet.dts, packet.duration = round(begin / tick), round(duration / tick)
        packet.pts = None if delay is None else round((begin + delay) / tick)


def _added(output: OutputContainer, stream: AudioStream) -> AudioStream:
    target = output.add_stream_from_template(stream)
    channels = stream.codec_context.channels
    if stream.codec_context.layout.name == f"{channels} channels":  # of .avi and .mkv, which do not say which is which
        target.codec_context.layout = f"{channels}c"  # FFmpeg's word for the usual ones
    return target


def _seconds(packet: av.Packet[AudioStream]) -> Fraction:
    return (packet.dts or 0) * packet.time_base
