"""gamesr-stream: the cloud's end of a game stream, to play against."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path

from client.cloud import NetworkSettings
from client.command import command_parser, run_command, whole_number
from client.errors import OutputError, how_to_install
from client.video import VideoSource
from client.whole_file import write_whole

PROGRAM = "gamesr-stream"
EXAMPLES = """\
examples:
  gamesr-stream match_1080p.mp4 --to 127.0.0.1:5004 --height 540 --bitrate 8M --loop
      encodes as a game server does and sends over and over, until Ctrl-C
  gamesr-stream match_540p.mp4 --to 127.0.0.1:5004 --copy
      sends a file's H.264 as it is: no encoder takes the cores of a player that is measured on the same machine
  gamesr-stream match_1080p.mp4 --to 192.0.2.7:5004 --height 540 --bitrate 8M --intra-refresh --sdp stream.sdp
      also writes the description that ffplay, ffmpeg and GStreamer read

The stream is RTP (RFC 3550, RFC 6184) and says goodbye at its end. A key frame that the receiver asks for (RTCP PLI) comes
with the next picture; --copy has only those of the file. Exit status: 0 done, 1 refused or failed, 2 wrong usage, 130
interrupted.
"""


def parser() -> argparse.ArgumentParser:
    parser = command_parser(PROGRAM, "Stream a clip over RTP in real time, encoded as a cloud-gaming server encodes.", EXAMPLES)
    parser.add_argument("clip", metavar="CLIP", type=Path, help="the video that stands for the game")
    parser.add_argument("--to", metavar="HOST:PORT", type=_address, required=True, help="who receives it")
    parser.add_argument(
        "--height", metavar="N", type=whole_number(most=8192), help="reduce the picture to this height, a whole part of the clip's"
    )
    parser.add_argument("--bitrate", metavar="RATE", type=kbps, help="such as 8M or 4500k (default: 8M)")
    parser.add_argument("--fps", metavar="N", type=whole_number(most=8192), help="pictures a second (default: the clip's)")
    parser.add_argument("--intra-refresh", action="store_true", help="a wandering column of intra blocks instead of IDRs")
    parser.add_argument("--copy", action="store_true", help="send the clip's own H.264, not encoded again")
    parser.add_argument("--loop", action="store_true", help="begin again at the end")
    parser.add_argument("--sdp", metavar="FILE", type=Path, help="write the session description for other receivers")
    parser.add_argument("--force", action="store_true", help="replace the description if it exists")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    arguments = parser().parse_args(argv)
    if arguments.copy and (arguments.height or arguments.bitrate or arguments.intra_refresh):
        parser().error("--copy sends what is there: --height, --bitrate and --intra-refresh are for encoding")
    return run_command(PROGRAM, lambda: send(arguments), debug=arguments.debug, interrupted="interrupted before anything was sent")


def send(arguments: argparse.Namespace) -> int:
    """Everything between the arguments and the summary. Raises GamesrError."""
    try:
        from client.sdp import write_sdp  # not above: without its packages the sentence below has to come
        from client.sender import RtpSender, UnitSource, stream
        from client.stream_source import EncodedFile, EncodedLive
    except ModuleNotFoundError as error:
        raise OutputError(f"streaming needs {error.name}: {how_to_install('play')}") from error
    if arguments.sdp and os.path.lexists(arguments.sdp) and not arguments.force:
        raise OutputError(f"{arguments.sdp} exists: name another file with --sdp, or replace it with --force")
    with VideoSource(arguments.clip) as clip:
        fps = arguments.fps or max(1, round(clip.frame_rate))
        height = arguments.height or clip.height
    source: UnitSource
    if arguments.copy:
        source = EncodedFile(arguments.clip, arguments.fps, loop=arguments.loop)
    else:
        settings = NetworkSettings(arguments.bitrate or 8000, fps, intra_refresh=arguments.intra_refresh)
        source = EncodedLive(arguments.clip, height, settings, loop=arguments.loop)
    host, port = arguments.to
    period_ms = 1000 / fps
    pictures = packets = octets = late = status = 0
    with RtpSender(host, port) as sender:
        if arguments.sdp:
            write_whole(arguments.sdp, write_sdp(*sender.target, source.parameter_sets(), fps))
        try:
            for done in stream(source, sender):
                pictures, packets, octets = pictures + 1, packets + done.packets, octets + done.bytes
                late += done.late_ns / 1e6 > period_ms
        except KeyboardInterrupt:
            status = 130
    rate_kbps = octets * 8 / 1000 / max(1, pictures) * fps
    print(
        f"{pictures} pictures in {packets} packets, {rate_kbps:.0f} kbit/s on the wire; "
        f"{late} late by more than {period_ms:.1f} ms; {sender.requests} key frame requests"
        f"{'' if source.answers_requests or not sender.requests else ', not answered: --copy has only those of the file'}",
        flush=True,
    )
    return status


def _address(text: str) -> tuple[str, int]:
    host, colon, port = text.rpartition(":")
    if not colon or not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise argparse.ArgumentTypeError(f"{text} is not HOST:PORT")
    return host.strip("[]"), int(port)


def kbps(text: str) -> int:
    """A bitrate as people write it, 8M or 4500k, in kbit/s; raises ArgumentTypeError."""
    number, unit = text[:-1], text[-1:].lower()
    try:
        rate = round(float(number) * {"k": 1, "m": 1000}[unit])
    except (KeyError, ValueError, OverflowError) as error:
        raise argparse.ArgumentTypeError(f"{text} is not a bitrate such as 8M or 4500k") from error
    if not 1 <= rate <= 1_000_000:
        raise argparse.ArgumentTypeError(f"{text} is not between 1k and 1000M")
    return rate
