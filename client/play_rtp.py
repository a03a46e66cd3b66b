"""RTP as a source to play: it goes on over goodbyes, restarts and silence, and says what happened."""

from __future__ import annotations

import time
from collections.abc import Iterator
from types import TracebackType
from typing import Self

from client.live import LiveDecoder, live_frames
from client.play_source import IDLE_S, Arrived, Idle, Tell
from client.receiver import RtpReceiver
from client.reception import SILENCE_NS, ReceptionCounts
from client.sdp import Session

GONE_NS = 5_000_000_000  # a sender that is silent for so long has gone: its goodbye may have been lost


class RtpSource:
    """Listens to one sender after the other; with `until_bye` to one, until it says goodbye or was silent for 5 s.

    Raises InputError where the address cannot be listened on.
    """

    def __init__(self, session: Session, *, until_bye: bool, tell: Tell) -> None:
        self._receiver = RtpReceiver(session)
        self._decoder = LiveDecoder(session.parameter_sets)
        self._until_bye, self._tell = until_bye, tell
        host, port = self._receiver.address
        self.size: tuple[int, int] | None = None
        self.name = f"{host} port {port}"
        self._senders = self._overflowed = 0
        self._silent = self._without_start = False
        self._refusal: str | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._receiver.close()

    @property
    def decode_errors(self) -> int:
        return self._decoder.decode_errors

    @property
    def reception(self) -> ReceptionCounts:
        return self._receiver.counts

    def waiting(self) -> int:
        return self._receiver.waiting

    def frames(self, idle: Idle) -> Iterator[Arrived]:
        receiver = self._receiver

        def wait() -> None:
            self._watch()
            idle()
            if self._until_bye and (receiver.silent_ns or 0) > GONE_NS:
                receiver.close()

        while True:
            for received in live_frames(receiver, self._decoder, wait):
                unit = received.unit
                if unit.restarted or self._silent or received.frame.damaged:
                    self._watch()
                yield Arrived(
                    received.frame, received.packet_ns, received.decoded_ns, unit.first_ns, unit.last_ns, unit.ready_ns, unit.sent_ns
                )
            if self._until_bye:
                return
            self._tell("goodbye", "the sender said goodbye: waiting for another")
            while receiver.ended:
                idle()
                time.sleep(IDLE_S)

    def _watch(self) -> None:
        """Tell what has changed since the last time."""
        counts, address = self._receiver.counts, self._receiver.sender_address
        silent_ns = self._receiver.silent_ns or 0
        if address is not None and counts.senders > self._senders:
            again = "the sender was started again" if self._senders else "receiving"
            self._tell("sender", f"{again}, from {address[0]} port {address[1]}")
            self._senders = counts.senders
        elif self._silent != (silent_ns > SILENCE_NS):
            self._silent = not self._silent
            self._tell("silence", "nothing has come for a second: waiting" if self._silent else "the sender is heard again")
        without_start, self._without_start = self._without_start, self._decoder.without_start
        if self._without_start and not without_start:
            self._tell("no_key_frame", "the stream began without a key frame: waiting for one, which was asked for")
        if counts.overflowed_units > self._overflowed:
            self._tell("overflow", f"{counts.overflowed_units - self._overflowed} pictures waited too long and were thrown away")
            self._overflowed = counts.overflowed_units
        if self._decoder.refusal not in (None, self._refusal):
            self._refusal = self._decoder.refusal
            self._tell("refused", f"a picture cannot be decoded or shown: {self._refusal}")
