"""What FFmpeg opens: what of a URL is followed and shown, when it falls silent, breaks off, or comes faster than it is taken."""

from __future__ import annotations

import itertools
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from client import play_source, play_url
from client.errors import InputError
from client.play_source import Arrived, open_source, shown_url
from client.video import VideoSource, read_frames
from tests.answering import QuietHandler, answering
from tests.playing import Told
from tests.streaming import planes

MakeClip = Callable[..., Path]
LONG_S = 60.0


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(play_url, "_READ_S", 0.5)
    monkeypatch.setattr(play_url, "_RETRY_S", 0.05)


@contextmanager
def server(content: bytes, *, silent: int, most: int = 99) -> Iterator[str]:
    """Sends its content to whoever connects; the first `silent` connections then stay open without a word, `most` are taken."""
    done = threading.Event()

    def run(listener: socket.socket) -> None:
        open_ones = []
        for number in range(most):
            with suppress(OSError):
                connection, _ = listener.accept()
                with suppress(OSError):
                    connection.sendall(content)
                if number < silent:
                    open_ones.append(connection)
                else:
                    connection.close()
            if done.is_set():
                break
        for connection in open_ones:
            connection.close()

    with socket.create_server(("127.0.0.1", 0)) as listener:
        address = listener.getsockname()
        thread = threading.Thread(target=run, args=(listener,), daemon=True)
        thread.start()
        yield f"tcp://127.0.0.1:{address[1]}"
        done.set()
        with suppress(OSError), socket.create_connection(address, 1):
            pass
        thread.join(LONG_S)


def waiting_at_most() -> Callable[[], None]:
    end = time.monotonic() + LONG_S

    def idle() -> None:
        assert time.monotonic() < end

    return idle


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize("name", ["clip.ts", "clip.mkv"])
def test_silence_is_given_up_and_it_is_opened_again(make_clip: MakeClip, name: str) -> None:
    """FFmpeg holds the last picture of a transport stream until it gives up, and raises at once where it holds none."""
    clip, told, items, again = make_clip(name), Told(), list[Arrived](), list[Arrived]()
    want = [planes(frame) for frame in read_frames(clip)]
    with server(clip.read_bytes(), silent=1) as url, open_source(url, until_bye=False, tell=told) as source:
        for item in source.frames(waiting_at_most()):
            (again if told.kinds() else items).append(item)
            if len(again) == len(want):
                break
    assert [planes(item.frame) for item in again] == want and told.kinds() == ["silence", "sender"] and not source.decode_errors
    assert len(items) >= len(want) - 1 and [planes(item.frame) for item in items] == want[: len(items)]
    assert all(item.last_ns <= item.packet_ns and item.sent_ns is None for item in items) and source.reception is None


def test_the_end_is_the_end_when_told_so(make_clip: MakeClip) -> None:
    clip = make_clip("clip.ts")
    with server(clip.read_bytes(), silent=0) as url, open_source(url, until_bye=True, tell=Told()) as source:
        assert len(list(source.frames(waiting_at_most()))) == len(list(read_frames(clip)))


@pytest.mark.parametrize("content", [b"", b"not a video\n" * 1000, b"\x47" * 5000], ids=["nothing", "text", "sync-bytes"])
def test_what_is_no_video_is_refused(content: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(play_url, "_OPEN_S", 1.0)
    refused = pytest.raises(InputError, match=r"^tcp://127\.0\.0\.1:\d+ ")
    with server(content, silent=0) as url, open_source(url, until_bye=False, tell=Told()) as source, refused:
        list(source.frames(waiting_at_most()))


@pytest.mark.usefixtures("impatient")
def test_silence_from_the_beginning_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(play_url, "_OPEN_S", 0.3)
    refused = pytest.raises(InputError, match="nothing came")
    with server(b"", silent=1) as url, open_source(url, until_bye=False, tell=Told()) as source, refused:
        list(source.frames(waiting_at_most()))


def test_who_takes_too_slowly_loses_and_knows_it(make_clip: MakeClip, monkeypatch: pytest.MonkeyPatch) -> None:
    """Memory is bounded, and what follows is damaged until a key frame."""
    monkeypatch.setattr(play_url, "_PACKETS_QUEUED", 8)
    told = Told()
    reader = play_url._Reader("", "", recorded=False)
    with VideoSource(make_clip(frames=40, options={"g": "60", "bf": "0"})) as reader._video:
        packets = list(reader._video.packets())
        reader._put(packets[0])
        frames = reader.frames(waiting_at_most(), told)
        assert not next(frames).frame.damaged
        for packet in packets[1:-1]:
            reader._put(packet)
            assert len(reader.packets) <= 8
        reader._ended = True
        rest = list(frames)
    assert told.kinds() == ["overflow"] and 0 < len(rest) <= 8 and all(item.frame.damaged for item in rest)


@contextmanager
def served(folder: Path, pause_s: float = 0) -> Iterator[str]:
    """The URL of a folder over HTTP; it pauses in the middle of a file."""

    class Serve(QuietHandler):
        def do_GET(self) -> None:
            content = (folder / self.path.strip("/")).read_bytes()
            self.send_response(200)
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            with suppress(OSError):  # whoever has enough of it
                self.wfile.write(content[: len(content) // 2])
                time.sleep(pause_s)
                self.wfile.write(content[len(content) // 2 :])

    with answering(Serve) as address:
        yield address


def test_a_file_over_http_is_played_in_real_time_and_loses_nothing(make_clip: MakeClip, monkeypatch: pytest.MonkeyPatch) -> None:
    """However fast it comes; what is not due waits at the server, but for a few packets."""
    monkeypatch.setattr(play_url, "_PACKETS_QUEUED", 4)
    monkeypatch.setattr(play_source, "_BEHIND_NS", int(LONG_S * 1e9))
    clip, told, items, waited = make_clip(frames=40), Told(), list[Arrived](), []
    with served(clip.parent) as address, open_source(f"{address}/{clip.name}", until_bye=False, tell=told) as source:
        for item in source.frames(waiting_at_most()):
            items.append(item)
            assert source._reader is not None and len(source._reader.packets) <= 4
            if len(items) == 20:
                time.sleep(0.4)
            waited.append(source.waiting())
    assert [planes(item.frame) for item in items] == [planes(frame) for frame in read_frames(clip)] and len(items) == 40
    assert not any(item.frame.damaged for item in items) and not told.said
    gaps_ns = sorted(after.last_ns - before.last_ns for before, after in itertools.pairwise(items))
    # A busy machine may keep the reader from its packets for a while, and then the clock stands: never faster, and seldom slower.
    assert gaps_ns[0] > 1e9 / 31 and gaps_ns[len(gaps_ns) // 2] < 1e9 / 29
    assert all(item.last_ns <= item.packet_ns for item in items) and 1 <= waited[19] <= 5 and waited[-1] == 0


def test_a_pause_over_http_makes_nothing_late(make_clip: MakeClip) -> None:
    """What is not there is not due: the clock stands meanwhile."""
    clip, told = make_clip("clip.ts", frames=40), Told()
    with served(clip.parent, pause_s=1.5) as address, open_source(f"{address}/{clip.name}", until_bye=False, tell=told) as source:
        items = list(source.frames(waiting_at_most()))
    assert len(items) == 40 and not told.said and not any(item.frame.damaged for item in items)
    gaps = [after.last_ns - before.last_ns for before, after in itertools.pairwise(items)]
    assert max(gaps) > 400_000_000
    assert sorted(item.packet_ns - item.last_ns for item in items)[30] < 100_000_000


def test_a_file_over_http_is_left_in_the_middle(make_clip: MakeClip, monkeypatch: pytest.MonkeyPatch) -> None:
    """The thread that waits to go on reading ends."""
    monkeypatch.setattr(play_url, "_PACKETS_QUEUED", 4)
    clip = make_clip(frames=40)
    with served(clip.parent) as address, open_source(f"{address}/{clip.name}", until_bye=False, tell=Told()) as source:
        assert next(source.frames(waiting_at_most())).frame.pts == 0
        reader = source._reader
        assert reader is not None
        end = time.monotonic() + LONG_S
        while len(reader.packets) < 4 and time.monotonic() < end:
            time.sleep(0.005)
    reader.join(LONG_S)
    assert not reader.is_alive()


def test_a_flood_of_which_nothing_is_shown_keeps_nobody_waiting(make_clip: MakeClip) -> None:
    """Whoever waits for pictures is asked with every packet, or he could not end."""
    reader, left = play_url._Reader("", "", recorded=False), list[int]()
    with VideoSource(make_clip()) as reader._video, pytest.MonkeyPatch.context() as patch:
        patch.setattr(reader._video, "decode", lambda packet: iter(()))
        for packet in list(reader._video.packets())[:5]:
            reader._put(packet)
        reader._ended = True
        assert list(reader.frames(lambda: left.append(len(reader.packets)), Told())) == []
    assert left == [4, 3, 2, 1, 0]


def test_a_playlist_behind_a_url_names_no_file(make_clip: MakeClip, tmp_path: Path) -> None:
    """Served over HTTP: what it names is not opened; a video is."""
    clip = make_clip()
    (tmp_path / "list.m3u8").write_text(f"#EXTM3U\n#EXTINF:1,\nfile://{clip}\n#EXT-X-ENDLIST\n")

    with served(tmp_path) as address:
        with (
            open_source(f"{address}/list.m3u8", until_bye=True, tell=lambda *_: None) as source,
            pytest.raises(InputError, match="cannot be"),
        ):
            list(source.frames(lambda: None))
        with open_source(f"{address}/{clip.name}", until_bye=False, tell=lambda *_: None) as source:
            frames = [item.frame for item in source.frames(lambda: None)]
    assert [planes(frame) for frame in frames] == [planes(frame) for frame in read_frames(clip)] and source.reception is None


def test_urls_are_shown_without_secrets() -> None:
    assert shown_url("rtsp://me:secret@example.org:8554/game?token=x#y") == "rtsp://example.org:8554/game"
    for password in ("sec/ret", "sec?ret", "sec#ret"):  # each has to be quoted, and is often not
        assert "sec" not in shown_url(f"rtsp://me:{password}@example.org/game") and "ret" not in shown_url(
            f"rtsp://me:{password}@example.org"
        )
