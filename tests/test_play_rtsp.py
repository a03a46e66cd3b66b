"""RTSP as FFmpeg speaks it, against a server of sockets: both transports, restarts, silence, refusals, passwords, certificates."""

from __future__ import annotations

import datetime
import ipaddress
import ssl
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

from client import play_url
from client.errors import InputError
from client.play_source import open_source
from client.video import read_frames
from tests.rtsp_serving import HOST, RtspServer
from tests.streaming import planes
from tests.test_player import Told

MakeClip = Callable[..., Path]
FRAMES = 40  # with a second of them FFmpeg has enough to open the stream
LONG_S = 60.0


@pytest.fixture
def clip(make_clip: MakeClip) -> Path:
    return make_clip(frames=FRAMES)


@pytest.fixture
def want(clip: Path) -> list[bytes]:
    return [planes(frame) for frame in read_frames(clip)]


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(play_url, "_RETRY_S", 0.05)


def played(url: str) -> list[bytes]:
    """The pictures of a stream to its end, none of them damaged."""
    end, told = time.monotonic() + LONG_S, Told()

    def idle() -> None:
        assert time.monotonic() < end

    with open_source(url, until_bye=True, tell=told) as source:
        items = list(source.frames(idle))
    assert told.kinds() == [] and not source.decode_errors and not any(item.frame.damaged for item in items)
    return [planes(item.frame) for item in items]


@pytest.mark.parametrize("goodbye", [True, False], ids=["goodbye", "cut"])
def test_every_picture_comes_through_the_connection(clip: Path, want: list[bytes], goodbye: bool) -> None:
    with RtspServer(clip, goodbye=goodbye) as server:
        assert played(server.url) == want
    assert [request.split()[0] for request in server.asked[:4]] == ["OPTIONS", "DESCRIBE", "SETUP", "PLAY"]


def test_a_server_that_has_datagrams_only(clip: Path, want: list[bytes]) -> None:
    with RtspServer(clip, udp=True, goodbye=True, period_s=0.01) as server:
        assert played(server.url) == want
    assert ["TCP" in request for request in server.asked if request.startswith("SETUP")] == [True, False]


def test_a_server_that_is_killed_and_comes_back(clip: Path, want: list[bytes]) -> None:
    told, again, pictures, end = Told(), list[RtspServer](), list[bytes](), time.monotonic() + LONG_S
    first = RtspServer(clip, period_s=0.05)

    def idle() -> None:
        assert time.monotonic() < end
        if "unreachable" in told.kinds() and not again:
            again.append(RtspServer(clip, port=first.port).__enter__())

    with first, open_source(first.url, until_bye=False, tell=told) as source:
        for item in source.frames(idle):
            if not pictures and not again:
                first.__exit__()
            if again:
                pictures.append(planes(item.frame))
            if len(pictures) == FRAMES:
                break
    again[0].__exit__()
    assert pictures == want and not source.decode_errors
    assert list(dict.fromkeys(told.kinds())) == ["goodbye", "unreachable", "sender"] and told.kinds()[-1] == "sender"
    assert len(first.sent) < FRAMES


def test_silence_is_waited_for_once(clip: Path, want: list[bytes], monkeypatch: pytest.MonkeyPatch) -> None:
    """The picture that FFmpeg's parser holds comes out when the wait is over: it is not a sign of life."""
    monkeypatch.setattr(play_url, "_READ_S", 1.0)
    told, pictures, end = Told(), list[bytes](), time.monotonic() + LONG_S

    def idle() -> None:
        assert time.monotonic() < end

    with RtspServer(clip, silent=True) as server, open_source(server.url, until_bye=False, tell=told) as source:
        for item in source.frames(idle):
            pictures.append(planes(item.frame))
            if len(pictures) == 2 * FRAMES:
                break
    assert pictures == 2 * want and told.kinds() == ["silence", "sender"] and not source.decode_errors
    assert 1 <= server.began[1] - server.sent[FRAMES - 1] < 2


@pytest.mark.parametrize(
    ("options", "login", "path", "reason"),
    [
        ({}, "me:secret@", "/nothing", "404 Not Found"),
        ({"login": "me:secret"}, "", "/game", "401 Unauthorized"),
        ({"login": "me:secret"}, "me:secretive@", "/game", "401 Unauthorized"),
        ({"mute": True}, "me:secret@", "/game", "nothing came for 0.5 s"),
    ],
    ids=["path", "no-password", "wrong-password", "mute"],
)
def test_refusals_are_said_without_the_password(
    clip: Path, monkeypatch: pytest.MonkeyPatch, options: dict[str, object], login: str, path: str, reason: str
) -> None:
    monkeypatch.setattr(play_url, "_OPEN_S", 0.5 if "mute" in options else LONG_S)
    with RtspServer(clip, **options) as server, pytest.raises(InputError) as refused:  # type: ignore[arg-type]
        played(f"rtsp://{login}{HOST}:{server.port}{path}")
    assert str(refused.value).startswith(f"rtsp://{HOST}:{server.port}{path} cannot be opened: ") and reason in str(refused.value)
    assert "secret" not in str(refused.value)


def test_a_password_may_hold_what_a_url_has_to_quote(clip: Path, want: list[bytes]) -> None:
    with RtspServer(clip, login="me:sec/r@t") as server:
        assert played(f"rtsp://me:sec%2Fr%40t@{HOST}:{server.port}/game") == want


@pytest.mark.parametrize("host", [HOST, "192.0.2.7"], ids=["its-own", "another's"])
@pytest.mark.parametrize("trusted", [True, False], ids=["trusted", "unknown"])
def test_a_certificate_is_believed_if_it_is_trusted_and_the_hosts(
    clip: Path, want: list[bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, host: str, trusted: bool
) -> None:
    file = certificate(tmp_path / "certificate.pem", host)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(file)
    monkeypatch.setenv("SSL_CERT_FILE", str(file if trusted else certificate(tmp_path / "other.pem", host)))
    with RtspServer(clip, goodbye=True, tls=context, login="me:secret") as server:
        url = server.url.replace("//", "//me:secret@")
        if trusted and host == HOST:
            assert played(url) == want
            return
        with pytest.raises(InputError, match="no TLS connection"):
            played(url)
    assert server.asked == []  # no name, no password


def certificate(file: Path, host: str) -> Path:
    """A certificate that signs itself, with its key, of a host named by its address."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "games")])
    now = datetime.datetime.now(datetime.UTC)
    made = (
        x509.CertificateBuilder(name, name, key.public_key(), x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(hours=1))
        .not_valid_after(now + datetime.timedelta(hours=1))
        .add_extension(x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address(host))]), critical=False)
        .sign(key, hashes.SHA256())
    )
    private = key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    file.write_bytes(private + made.public_bytes(serialization.Encoding.PEM))
    return file
