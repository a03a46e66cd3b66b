"""The rate of a clip: a whole number of pictures a second, all along."""

from __future__ import annotations

from typing import TYPE_CHECKING

from client.errors import InputError

if TYPE_CHECKING:
    from client.video import OpenVideo

_WHOLE = 0.002  # 59.94 is 60, 23.976 is 24
_CONSTANT = 0.02  # a picture or two may be missing


def whole_rate(source: OpenVideo) -> tuple[int, int]:
    """Frames a second, and how many there are; reads the packets of `source` to the end, so it cannot be decoded after that.

    Raises InputError where the rate is not whole, or the pictures' times are not those of that rate: bits a second would be wrong.
    """
    rate = float(source.frame_rate)
    fps = round(rate)
    if not fps or abs(rate / fps - 1) > _WHOLE:
        raise InputError(f"{source.name} has {rate:.4g} frames a second, which is not a whole number: convert it first")
    frames, times = 0, []
    for packet in source.packets():
        if packet.size:
            frames += 1
            if packet.pts is not None:
                times.append(packet.pts)
    if len(times) > 1 and (span_s := float((max(times) - min(times)) * source.time_base)) > 0:
        kept = (len(times) - 1) / span_s
        if abs(kept / rate - 1) > _CONSTANT:
            raise InputError(
                f"{source.name} names {rate:.4g} frames a second and has {kept:.4g}: its rate varies; "
                f"make it constant first, with ffmpeg -i INPUT -vf fps={fps} OUTPUT"
            )
    return fps, frames
