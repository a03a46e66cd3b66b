"""The frames of a file that has to be whole: a figure taken against a damaged picture would look like any other."""

from __future__ import annotations

from collections.abc import Iterator

from client.errors import InputError
from client.frames import Frame
from client.video import VideoSource

DAMAGED = "is damaged: nothing can be measured against it"


def whole_frames(source: VideoSource, damaged: str = DAMAGED) -> Iterator[Frame]:
    """Every frame of a file; raises InputError at the first that is damaged or of another size, and where there is none.

    What `damaged` says of the file is the end of that sentence.
    """
    frame = None
    for decoded in source:
        frame = decoded.frame
        if source.decode_errors or frame.damaged:
            raise InputError(f"{source.name} {damaged}")
        check_size(source, frame)
        yield frame
    if source.decode_errors:
        raise InputError(f"{source.name} {damaged}")
    if frame is None:
        raise InputError(f"no frame of {source.name} could be decoded")


def check_size(source: VideoSource, frame: Frame) -> None:
    """Raises InputError for a frame of another size than the file announces."""
    if (frame.width, frame.height) != (source.width, source.height):
        raise InputError(
            f"{source.name} changes its size in mid-stream, from {source.width}x{source.height} to {frame.width}x{frame.height}: "
            "cut it into clips of one size"
        )
