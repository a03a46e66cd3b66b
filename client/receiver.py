"""A UDP socket and a thread that empties it: access units in a bounded queue, key frame requests back."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections import deque
from dataclasses import replace
from types import TracebackType
from typing import Self

from client.access_unit import AccessUnit
from client.errors import InputError
from client.reception import Address, Reception, ReceptionCounts
from client.rtp import MAX_DATAGRAM
from client.sdp import Session

UNITS_QUEUED = 64  # a second at 60 fps: who is that far behind has lost the game
_SOCKET_BYTES = 4 << 20  # an IDR comes as one burst; the kernel gives what it may
_TICK_S = 0.05  # how soon a closed receiver ends


class RtpReceiver:
    """Listens where it was told, to one sender; a context manager.

    `next_unit` hands over access units as soon as they are whole, in order. Whoever takes them too slowly loses them: a
    queue of 64 that is full is thrown away, counted, and treated as a loss. `sender_address` is None until the receiver has
    locked to somebody (see `Reception`). Raises InputError where the address cannot be listened on.
    """

    def __init__(self, session: Session) -> None:
        self._reception = Reception(
            wall_offset_ns=time.time_ns() - time.perf_counter_ns(),
            payload_type=session.payload_type,
            send_time_id=session.send_time_id,
            parameters_known=bool(session.parameter_sets),
        )
        self._units: deque[AccessUnit] = deque()
        self._changed = threading.Condition()
        self._socket = _bind(session.address)
        self.address: Address = self._socket.getsockname()[:2]
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="rtp-receiver", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Stop listening; units that are queued stay."""
        self._closed = True
        self._thread.join()
        self._socket.close()

    def next_unit(self, timeout_s: float) -> AccessUnit | None:
        """The next access unit, or None where none came in time."""
        with self._changed:
            self._changed.wait_for(lambda: self._units or self._closed, timeout_s)
            return self._units.popleft() if self._units else None

    @property
    def waiting(self) -> int:
        """How many access units are there to be taken."""
        return len(self._units)

    def request_keyframe(self) -> None:
        """Ask the sender for an IDR: the decoder cannot go on by itself. At most ten a second are sent."""
        with self._changed:
            self._reception.want_keyframe()

    @property
    def ended(self) -> bool:
        """The sender said goodbye, or the receiver was closed, and every unit has been taken."""
        with self._changed:
            return (self._closed or self._reception.ended) and not self._units

    @property
    def silent_ns(self) -> int | None:
        """How long nothing has come from the sender; None before there is one."""
        with self._changed:
            return None if self._reception.sender is None else time.perf_counter_ns() - self._reception.heard_ns

    @property
    def sender_address(self) -> Address | None:
        with self._changed:
            return self._reception.sender

    @property
    def counts(self) -> ReceptionCounts:
        with self._changed:
            return self._reception.counts

    def _run(self) -> None:
        while not self._closed:
            due_ns = self._reception.release_due_ns()
            wait_s = _TICK_S if due_ns is None else min(max(0.0, (due_ns - time.perf_counter_ns()) / 1e9), _TICK_S)
            self._socket.settimeout(wait_s or 1e-4)  # a timeout of 0 would mean another mode
            try:
                datagram, address = self._socket.recvfrom(MAX_DATAGRAM)
            except TimeoutError:
                datagram, address = b"", None
            except OSError:
                continue  # an error that somebody's ICMP left on the socket
            self._take(datagram, address, time.perf_counter_ns())
        with self._changed:
            self._changed.notify_all()

    def _take(self, datagram: bytes, address: Address | None, now_ns: int) -> None:
        with self._changed:
            reception = self._reception
            units = [] if address is None else reception.take(datagram, address[:2], now_ns)
            units += reception.release(now_ns)
            if len(self._units) + len(units) > UNITS_QUEUED:
                reception.lose(len(self._units) + len(units))  # the new ones too: they were judged before this loss
                self._units.clear()
            else:
                ready_ns = time.perf_counter_ns()
                self._units += [replace(unit, ready_ns=ready_ns) for unit in units]
            if units:
                self._changed.notify_all()
            feedback, sender = reception.feedback(now_ns), reception.sender
        if feedback is not None and sender is not None:
            with contextlib.suppress(OSError):  # a request that cannot be sent is one that was lost: the next one follows
                self._socket.sendto(feedback, sender)


def _bind(address: Address) -> socket.socket:
    host, port = address
    try:
        family, kind, protocol, _, resolved = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        listening = socket.socket(family, kind, protocol)
    except (OSError, UnicodeError) as error:
        raise InputError(f"{host} is no address to listen on: {getattr(error, 'strerror', 'it is no name of a host')}") from error
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _SOCKET_BYTES)
        listening.bind(resolved)
    except OSError as error:
        listening.close()
        raise InputError(f"cannot listen on {host} port {port}: {error.strerror}") from error
    return listening
