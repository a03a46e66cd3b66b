"""The audio of one file copied into another, packet by packet."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import av
from av.audio.stream import AudioStream
from av.container import OutputContainer

from client.errors import OutputError
from client.video import open_local


class AudioCopy:
    """Every audio stream of `path`, added to `output` and then copied along as its video advances.

    It reads the file a second time, by itself: whatever drives the video need not know that there is audio. Raises
    OutputError for a codec that the container of `output` cannot hold.
    """

    def __init__(self, path: Path, output: OutputContainer) -> None:
        self._container = open_local(path)
        self._output = output
        self._targets: dict[int, AudioStream] = {}
        for stream in self._container.streams.audio:
            try:
                self._targets[stream.index] = output.add_stream_from_template(stream)
            except ValueError as error:
                self._container.close()
                raise OutputError(f"{output.format.name} cannot hold the audio of {path} ({stream.name}): write to .mkv instead") from error
        self._packets = self._read()
        self._waiting = next(self._packets, None)

    def copy_until(self, time: Fraction | None) -> None:
        """Copy the packets that begin before `time` in seconds, or all that are left."""
        while self._waiting is not None and (time is None or _seconds(self._waiting) < time):
            self._waiting.stream = self._targets[self._waiting.stream_index]
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
                yield packet


def _seconds(packet: av.Packet[AudioStream]) -> Fraction:
    return (packet.dts or 0) * packet.time_base
