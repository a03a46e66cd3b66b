"""Uploads that mean harm, and callers that do: each gets its refusal, nothing of it stays, and the service goes on answering."""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import av
import httpx
import numpy as np
import pytest

import server.library
from client.errors import InputError
from server.database import Database
from server.library import Library
from server.probe import probe
from server.settings import Limits, Settings
from tests.serving import serving, settings, until

MP4 = {"Content-Type": "video/mp4"}
CLIPS = "/api/v1/clips"


@pytest.fixture
def small(tmp_path: Path) -> Settings:
    """Bounds that a test can reach."""
    return settings(tmp_path / "service", upload_bytes=400_000, clip_s=2.0, clip_pixels=640 * 480, decode_s=3, idle_s=1.0, uploads_kept=3)


@pytest.fixture
def client(small: Settings) -> Iterator[httpx.Client]:
    with serving(small) as client:
        yield client


def refused(client: httpx.Client, of: Settings, content: bytes, status: int = 422, **headers: str) -> str:
    """The sentence of the refusal; nothing stays and the service answers."""
    answer = client.post(CLIPS, content=content, headers={**MP4, **headers})
    assert answer.status_code == status, answer.text
    assert list(of.uploads.iterdir()) == [] and client.get("/health").status_code == 200
    sentence = str(answer.json()["detail"])
    assert "Traceback" not in sentence and str(of.data) not in sentence and "\n" not in sentence
    return sentence


def encoded(path: Path, width: int, height: int, frames: int, codec: str = "libx264", **options: str) -> bytes:
    """A clip of one grey picture, 30 a second."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=30, options=options)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        picture = av.VideoFrame.from_ndarray(np.full((height * 3 // 2, width), 90, np.uint8), format="yuv420p")
        for index in range(frames):
            picture.pts = index
            container.mux(stream.encode(picture))
        container.mux(stream.encode(None))
    return path.read_bytes()


def test_a_clip_is_taken_kept_swept_by_its_name_and_deleted(tmp_path: Path, make_clip: Callable[..., Path]) -> None:
    content = make_clip("clip.mkv", width=96, height=72).read_bytes()
    of = settings(tmp_path / "service")
    headers = {"Content-Type": "video/x-matroska"}
    with serving(of) as client:
        answer = client.post(CLIPS, params={"title": "../../\u00e9vil <b>.mkv"}, content=content, headers=headers)
        assert answer.status_code == 201, answer.text
        clip = answer.json()
        assert (clip["frames"], clip["width"], clip["height"], clip["title"]) == (12, 96, 72, "../../\u00e9vil <b>.mkv")
        assert [path.name for path in of.uploads.iterdir()] == [clip["name"]] and clip["name"].startswith("upload-")
        again = client.post(CLIPS, content=content, headers=headers)
        assert again.status_code == 201 and again.json() == clip
        assert client.get(f"{CLIPS}/{clip['name']}").json() == clip and client.get(CLIPS).json()["clips"] == [clip]
        asked = {"clips": [clip["name"]], "bitrates_kbps": [200], "upscalers": ["none"]}
        sweep = client.post("/api/v1/sweeps", json=asked).json()["id"]
        assert client.delete(f"{CLIPS}/{clip['name']}").status_code == 409
        client.post(f"/api/v1/sweeps/{sweep}/cancel")
        assert client.delete(f"{CLIPS}/{clip['name']}").status_code == 204
        assert client.delete(f"{CLIPS}/{clip['name']}").status_code == 404 and list(of.uploads.iterdir()) == []


def test_a_clip_that_is_in_the_folder_too_is_kept_once(tmp_path: Path, make_clip: Callable[..., Path]) -> None:
    (tmp_path / "clips").mkdir()
    clip = make_clip("clips/clip.mkv", width=96, height=72)
    with serving(settings(tmp_path / "service", clips=tmp_path / "clips")) as client:
        names = set()
        for _ in range(2):
            answer = client.post(CLIPS, content=clip.read_bytes(), headers={"Content-Type": "video/x-matroska"})
            names.add(answer.json()["name"])
            assert len(client.get(CLIPS).json()["clips"]) == 2  # which looks at the folder's
        assert len(names) == 1


def test_what_is_no_video(client: httpx.Client, small: Settings) -> None:
    assert "is not a video file that can be opened" in refused(client, small, b"\0")
    assert "is empty" in refused(client, small, b"")
    noise = np.random.default_rng(0).integers(0, 256, 50_000, np.uint8).tobytes()
    assert refused(client, small, noise)
    assert refused(client, small, b"\x1aE\xdf\xa3" + noise) and refused(client, small, b"\0\0\0\x18ftypmp42" + noise)


def test_a_wrong_content_type(client: httpx.Client, small: Settings) -> None:
    for kind in ("text/html", "multipart/form-data; boundary=x", "application/json", "application/x-mpegurl", ""):
        assert "a clip comes as one of" in refused(client, small, b"x", 415, **{"Content-Type": kind})


@pytest.mark.parametrize("target", ["/etc/passwd", "file:///etc/passwd", "http://127.0.0.1:9/x.ts", "concat:/etc/passwd|/etc/hosts"])
def test_playlists_that_name_files_and_addresses(client: httpx.Client, small: Settings, target: str) -> None:
    playlists = (
        f"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\n{target}\n#EXT-X-ENDLIST\n",
        f"ffconcat version 1.0\nfile '{target}'\n",
        f'<?xml version="1.0"?><MPD><Period><AdaptationSet><BaseURL>{target}</BaseURL></AdaptationSet></Period></MPD>',
        f"v=0\no=- 0 0 IN IP4 127.0.0.1\nc=IN IP4 127.0.0.1\nm=video 9 RTP/AVP 96\na=control:{target}\n",
    )
    for playlist in playlists:
        sentence = refused(client, small, playlist.encode())
        assert "is not a video file that can be opened" in sentence and "passwd" not in sentence


def test_more_bytes_than_may_come(client: httpx.Client, small: Settings) -> None:
    assert "400000 bytes" in refused(client, small, bytes(400_001), 413)

    def pieces() -> Iterator[bytes]:  # no length is announced
        for _ in range(10):
            yield bytes(100_000)

    answer = client.post(CLIPS, content=pieces(), headers=MP4)
    assert answer.status_code == 413 and list(small.uploads.iterdir()) == []


def sequence_header(width: int, height: int) -> bytes:
    """The sequence and picture parameter sets of an H.264 stream of that size, and the first bytes of a key frame."""
    sequence = "".join(f"{byte:08b}" for byte in (0x67, 66, 0, 52)) + "".join(map(golomb, (0, 0, 2, 1))) + "0"
    sequence += golomb(width // 16 - 1) + golomb(height // 16 - 1) + "11001"
    picture = f"{0x68:08b}" + golomb(0) * 2 + "00" + golomb(0) * 3 + "000" + golomb(0) * 3 + "1001"
    units = [int(bits.ljust(-(-len(bits) // 8) * 8, "0"), 2).to_bytes(-(-len(bits) // 8), "big") for bits in (sequence, picture)]
    return b"".join(b"\0\0\0\1" + unit for unit in (*units, b"\x65\xb8\x40\x0a\xbf" * 20))


def golomb(number: int) -> str:
    bits = f"{number + 1:b}"
    return "0" * (len(bits) - 1) + bits


def test_a_header_that_promises_30000_by_30000(client: httpx.Client, small: Settings, tmp_path: Path) -> None:
    ivf = b"DKIF" + struct.pack("<HHIHHIIII", 0, 32, int.from_bytes(b"VP80", "little"), 30000, 30000, 30, 1, 10, 0)
    assert refused(client, small, ivf + bytes(5000))
    y4m = b"YUV4MPEG2 W30000 H30000 F30:1 Ip A1:1 C420\nFRAME\n" + bytes(10_000)
    assert refused(client, small, y4m)
    assert refused(client, small, sequence_header(30000, 30000) * 5)
    avi = bytearray(encoded(tmp_path / "raw.avi", 64, 48, 5, codec="rawvideo"))
    size = avi.index(b"strf") + 12
    assert struct.unpack_from("<II", avi, size) == (64, 48)
    for side, sentence in ((30000, "holds no video frame"), (12000, "12000x12000: pictures larger than 8192x8192")):
        struct.pack_into("<II", avi, size, side, side)
        assert sentence in refused(client, small, bytes(avi))


def test_few_bytes_that_become_many_pixels(client: httpx.Client, small: Settings, tmp_path: Path) -> None:
    wide = encoded(tmp_path / "wide.mp4", 4096, 4096, 2)
    assert len(wide) < 40_000 and "a picture may have 307200 pixels" in refused(client, small, wide)
    long = encoded(tmp_path / "long.mp4", 64, 48, 3000, preset="ultrafast")
    assert "or more: at its rate it may have 60" in refused(client, small, long)
    unannounced = encoded(tmp_path / "long.h264", 64, 48, 300, preset="ultrafast")
    assert "has 300 frames or more" in refused(client, small, unannounced)


def test_a_bomb_is_stopped_by_the_clock_and_by_memory(tmp_path: Path) -> None:
    """Within every other bound: one grey picture of 8192x8192, over and over."""
    path = tmp_path / "bomb.h264"
    path.write_bytes(encoded(path, 8192, 8192, 1, preset="ultrafast") * 60)
    begin = time.monotonic()
    with pytest.raises(InputError, match="more than 1 s to decode"):
        probe(path, Limits(clip_pixels=8192 * 8192, decode_s=1), whole=True)
    assert time.monotonic() - begin < 20
    with pytest.raises(InputError, match="memory"):
        probe(path, Limits(clip_pixels=8192 * 8192, decode_bytes=600 * 2**20), whole=True)


def test_a_clip_that_changes_its_size_or_is_damaged(client: httpx.Client, small: Settings, tmp_path: Path) -> None:
    one, other = (encoded(tmp_path / f"{width}.h264", width, 48, 5) for width in (64, 96))
    assert "changes its size" in refused(client, small, one + other)
    broken = bytearray(encoded(tmp_path / "broken.mp4", 64, 48, 30, crf="1"))
    middle = broken.index(b"mdat") + 2000
    broken[middle : middle + 300] = bytes(300)
    answer = client.post(CLIPS, content=bytes(broken), headers=MP4)
    assert answer.status_code == 422, answer.text


def test_no_more_uploads_than_are_kept(client: httpx.Client, tmp_path: Path) -> None:
    for width in (64, 66, 68):
        assert client.post(CLIPS, content=encoded(tmp_path / f"{width}.mp4", width, 48, 5), headers=MP4).status_code == 201
    answer = client.post(CLIPS, content=b"x", headers=MP4)
    assert answer.status_code == 409 and "delete one first" in answer.json()["detail"]
    for clip in client.get(CLIPS).json()["clips"]:
        assert client.delete(f"{CLIPS}/{clip['name']}").status_code == 204


def address(client: httpx.Client) -> tuple[str, int]:
    assert client.base_url.port
    return client.base_url.host, client.base_url.port


def head(client: httpx.Client, method: str, path: str, length: int, kind: str) -> bytes:
    host, port = address(client)
    return f"{method} {path} HTTP/1.1\r\nHost: {host}:{port}\r\nContent-Type: {kind}\r\nContent-Length: {length}\r\n\r\n".encode()


@pytest.mark.parametrize(("path", "kind"), [(CLIPS, "video/mp4"), ("/api/v1/client-latencies", "application/json")])
def test_a_caller_that_hangs_in_mid_upload(client: httpx.Client, small: Settings, path: str, kind: str) -> None:
    with socket.create_connection(address(client), timeout=10) as connection:
        connection.sendall(head(client, "POST", path, 10_000, kind) + b"{" * 1000)
        assert client.get("/health").status_code == 200
        answer = b"".join(iter(lambda: connection.recv(4096), b""))  # until the connection is closed
        assert answer.startswith(b"HTTP/1.1 408 ") and b"nothing came for 1 s" in answer
    assert list(small.uploads.iterdir()) == []


def test_a_body_that_comes_byte_by_byte_has_to_end(tmp_path: Path) -> None:
    with serving(settings(tmp_path, body_s=1.0)) as client, socket.create_connection(address(client), timeout=0.2) as connection:
        connection.sendall(head(client, "POST", "/api/v1/client-latencies", 1000, "application/json"))
        answer = b""
        for _ in range(100):
            with contextlib.suppress(TimeoutError):
                if answer := connection.recv(4096):
                    break
            connection.sendall(b"{")
        assert answer.startswith(b"HTTP/1.1 408 ")
        connection.settimeout(10)
        answer += b"".join(iter(lambda: connection.recv(4096), b""))  # until the connection is closed
        assert b"it was not here after 1 s" in answer


def test_an_upload_that_cannot_be_kept_is_not_its_callers_fault(client: httpx.Client, small: Settings) -> None:
    small.uploads.rmdir()  # as little of it can be written as on a full disk
    answer = client.post(CLIPS, content=b"x", headers=MP4)
    assert answer.status_code == 503 and "see the service's log" in answer.json()["detail"]


def test_a_caller_that_leaves_is_no_error_of_the_service(client: httpx.Client, small: Settings) -> None:
    with socket.create_connection(address(client)) as connection:
        connection.sendall(head(client, "POST", CLIPS, 10_000, "video/mp4") + b"x")
        until(lambda: list(small.uploads.iterdir()))
    until(lambda: 'method="POST",route="/clips",status="408"' in client.get("/metrics").text)


def test_the_folder_is_read_once_for_all_of_its_clips(
    tmp_path: Path, make_clip: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "clips").mkdir()
    for number in range(3):
        make_clip(f"clips/{number}.mkv", width=96, height=72, frames=5 + number)
    of = settings(tmp_path, clips=tmp_path / "clips")
    of.data.mkdir()
    read: list[Path | None] = []
    entries = server.library._entries
    monkeypatch.setattr(server.library, "_entries", lambda folder: read.append(folder) or entries(folder))
    clips, refused = Library(Database(of.database), of).clips()
    assert [clip.name for clip in clips] == ["0.mkv", "1.mkv", "2.mkv"] and refused == {}
    assert read == [of.uploads, of.clips]


def test_a_caller_that_leaves_in_mid_upload_and_others_who_wait(client: httpx.Client, small: Settings) -> None:
    with socket.create_connection(address(client)) as one, socket.create_connection(address(client)) as two:
        for connection in (one, two):
            connection.sendall(head(client, "POST", CLIPS, 10_000, "video/mp4") + b"x")
        until(lambda: len(list(small.uploads.iterdir())) == 2)
        busy = client.post(CLIPS, content=b"x", headers=MP4)
        assert busy.status_code == 429 and busy.headers["retry-after"]
    until(lambda: not list(small.uploads.iterdir()))
    assert "is not a video file" in refused(client, small, b"x")


def test_fifty_callers_that_hang_do_not_keep_others_from_reading(client: httpx.Client) -> None:
    connections = [socket.create_connection(address(client)) for _ in range(50)]
    try:
        for connection in connections:
            connection.sendall(head(client, "POST", "/api/v1/client-latencies", 1000, "application/json") + b"{")
        begin = time.monotonic()
        assert client.get("/api/v1/sweeps").status_code == 200
        assert time.monotonic() - begin < 5
    finally:
        for connection in connections:
            connection.close()
    assert threading.active_count() < 100


@pytest.mark.parametrize("asked_before", [False, True])
def test_a_head_that_never_ends_is_not_waited_for(client: httpx.Client, asked_before: bool) -> None:
    """Though a byte of it comes five times a second."""
    host, port = address(client)
    with socket.create_connection((host, port), timeout=10) as connection:
        if asked_before:
            connection.sendall(f"GET /health HTTP/1.1\r\nHost: {host}:{port}\r\n\r\n".encode())
            assert connection.recv(65536).startswith(b"HTTP/1.1 200 ")
        connection.settimeout(0.2)
        begin = time.monotonic()
        with pytest.raises(ConnectionError):
            while time.monotonic() - begin < 10:
                connection.sendall(b"G")
                with contextlib.suppress(TimeoutError):
                    if not connection.recv(65536):
                        raise ConnectionError
        assert client.get("/health").status_code == 200


def test_no_more_connections_than_may_be_open(tmp_path: Path) -> None:
    with serving(settings(tmp_path, connections_at_once=8)) as client, contextlib.ExitStack() as stack:
        crowd = [stack.enter_context(socket.create_connection(address(client), timeout=10)) for _ in range(8)]
        with socket.create_connection(address(client), timeout=10) as one_more:
            assert one_more.recv(1) == b""
        crowd[0].close()
        until(lambda: client.get("/health").status_code == 200)
