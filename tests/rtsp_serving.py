"""An RTSP server (RFC 2326) of one clip, spoken by sockets: RTP in the same connection, or as datagrams where that is refused."""

from __future__ import annotations

import base64
import re
import socket
import ssl
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, Self

from client.sdp import write_sdp
from client.sender import RtpStream, Unit
from client.stream_source import EncodedFile

HOST = "127.0.0.1"
ELSEWHERE = "192.0.2.7"  # what a server behind an address translation calls itself: nobody is to go there


@dataclass
class RtspServer:
    """Serves `clip` to everyone who asks for /game, one after the other, until it is closed; a context manager.

    Pictures come `period_s` apart. After the last one the connection is cut, or with `goodbye` an RTCP BYE is sent, or with
    `silent` nothing comes any more. `login` is "user:password" (Basic); with `mute` no request is answered, with `udp` none for
    RTP in the connection.
    """

    clip: Path
    port: int = 0
    goodbye: bool = False
    silent: bool = False
    mute: bool = False
    udp: bool = False
    period_s: float = 0.0
    login: str | None = None
    tls: ssl.SSLContext | None = None
    began: list[float] = field(default_factory=list)  # time.monotonic() of each connection
    asked: list[str] = field(default_factory=list)  # whole requests
    sent: list[float] = field(default_factory=list)  # time.monotonic() after each picture

    def __enter__(self) -> Self:
        source = EncodedFile(self.clip)
        self._sets = source.parameter_sets()
        self._units = list[Unit]()
        while source.due_ns() is not None:
            self._units.append(source.take(idr=False))
        self._listener = socket.create_server((HOST, self.port))
        self.port = self._listener.getsockname()[1]
        self._connection: socket.socket | None = None
        self._closed = False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """As when it is killed: nobody is told."""
        self._closed = True
        for one in (self._listener, self._connection):
            if one is not None:
                with suppress(OSError):
                    one.shutdown(socket.SHUT_RDWR)
        self._thread.join(60)
        self._listener.close()
        assert not self._thread.is_alive()

    @property
    def url(self) -> str:
        return f"rtsp{'s' if self.tls else ''}://{HOST}:{self.port}/game"

    def _run(self) -> None:
        while not self._closed:
            with suppress(OSError):  # whoever asked has gone, or does not believe our certificate
                self._connection, _ = self._listener.accept()
                self.began.append(time.monotonic())
                if self.tls is not None:
                    self._connection = self.tls.wrap_socket(self._connection, server_side=True)
                with self._connection as connection, connection.makefile("rb") as reading:
                    self._serve(connection, reading)

    def _serve(self, connection: socket.socket, reading: BinaryIO) -> None:
        ports: tuple[int, int] | None = None
        for request in _requests(reading):
            self.asked.append(request)
            method, url = request.split()[:2]
            sequence = re.search(r"(?i)^cseq: *(\d+)", request, re.MULTILINE)
            assert sequence is not None
            status, headers, body = "200 OK", [f"CSeq: {sequence[1]}", "Session: 7"], ""
            wanted = re.search(r"RTP/AVP(?:/UDP)?;unicast;client_port=(\d+)-(\d+)", request)
            if self.mute:
                continue
            if method == "OPTIONS":
                headers.append("Public: OPTIONS, DESCRIBE, SETUP, PLAY, TEARDOWN")
            elif self.login is not None and f"Basic {base64.b64encode(self.login.encode()).decode()}\r\n" not in request:
                status, headers = "401 Unauthorized", [*headers, 'WWW-Authenticate: Basic realm="games"']
            elif "/game" not in url:
                status = "404 Not Found"
            elif method == "DESCRIBE":
                body = write_sdp(ELSEWHERE, 0, self._sets, 30) + "a=control:track1\r\n"
                headers += ["Content-Type: application/sdp", f"Content-Length: {len(body)}"]
            elif method == "SETUP" and self.udp == ("interleaved" in request):
                status = "461 Unsupported Transport"
            elif method == "SETUP" and wanted:
                ports = int(wanted[1]), int(wanted[2])
                headers.append(f"Transport: RTP/AVP;unicast;client_port={ports[0]}-{ports[1]};server_port=9-10")
            elif method == "SETUP":
                headers.append("Transport: RTP/AVP/TCP;unicast;interleaved=0-1")
            connection.sendall("\r\n".join([f"RTSP/1.0 {status}", *headers, "", body]).encode())
            if method == "PLAY":
                self._play(connection, ports)
                if not self.goodbye and not self.silent:
                    return
            elif method == "TEARDOWN":
                return

    def _play(self, connection: socket.socket, ports: tuple[int, int] | None) -> None:
        stream = RtpStream()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as datagrams:

            def send(packet: bytes, channel: int) -> None:
                if ports is None:
                    connection.sendall(struct.pack(">cBH", b"$", channel, len(packet)) + packet)
                else:
                    datagrams.sendto(packet, (HOST, ports[channel]))

            for unit in self._units:
                for packet in stream.datagrams(unit, time.time_ns):
                    send(packet, 0)
                self.sent.append(time.monotonic())
                time.sleep(self.period_s)
            if self.goodbye:
                send(stream.goodbye(), 1)


def _requests(reading: BinaryIO) -> Iterator[str]:
    """Whole requests; RTCP that comes between them is left out."""
    while first := reading.read(1):
        if first == b"$":
            _, length = struct.unpack(">BH", reading.read(3))
            reading.read(length)
            continue
        lines = [first + reading.readline()]
        while lines[-1] not in (b"\r\n", b""):
            lines.append(reading.readline())
        yield b"".join(lines).decode()
