"""gamesr-play as a command: whatever it is given, one clear sentence or a picture; how it ends, what it writes and posts."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import av
import pytest

from client import play_cli
from client.choice import chosen_provider, chosen_tiers
from client.errors import OutputError
from client.frames import Frame
from client.play_post import KEY_VARIABLE, PATH, post_summary
from client.upscaler import OnnxUpscaler
from client.video import read_frames
from client.window import Action, Window
from server.requests import ClientLatencyRequest
from tests.answering import QuietHandler, answering
from tests.conftest import FRAMES, HEIGHT, WIDTH
from tests.streaming import planes

MakeClip = Callable[..., Path]
Play = Callable[..., tuple[int, str, str]]
LONG_S = 60.0


@pytest.fixture
def play(model_file: Callable[..., Path], capsys: pytest.CaptureFixture[str]) -> Play:
    """Runs the command with a tiny model, its deadline far away, into nothing unless told otherwise."""

    def run(*arguments: object) -> tuple[int, str, str]:
        given = list(map(str, arguments))
        defaults = {"--sink": "null", "--deadline-ms": "100000", "--provider": "cpu"} | (
            {} if "--tiers" in given else {"--model": str(model_file())}
        )
        for option, value in defaults.items():
            given += [] if option in given else [option, value]
        status = play_cli.main([*given, "--threads", "1"])
        said = capsys.readouterr()
        return status, said.out, said.err

    return run


def test_a_file_into_y4m(play: Play, make_clip: MakeClip, model_file: Callable[..., Path], tmp_path: Path) -> None:
    clip, out = make_clip(), tmp_path / "out.y4m"
    status, said, errors = play(clip, "--sink", out, "--json")
    record = json.loads(said)
    assert status == 0 and "Traceback" not in errors
    assert record["frames"] == {"shown": FRAMES, "late": 0, "left_out": 0, "unready": 0, "damaged": 0, "repeated": 0}
    assert record["sizes"] == [[WIDTH, HEIGHT]] and record["reception"] is None and record["deadlines_kept"] == 1.0
    upscaler = OnnxUpscaler(model_file())
    state = upscaler.initial_state(HEIGHT, WIDTH)
    for frame, kept in zip(read_frames(clip), read_frames(out), strict=True):
        want, state = upscaler.step(frame, state)
        assert planes(want) == planes(kept)
    with av.open(str(out)) as container:
        assert container.streams.video[0].average_rate == 30
    assert not list(tmp_path.glob(".*.part"))
    status, _, errors = play(clip, "--sink", out)
    assert status == 1 and "--force" in errors
    assert play(clip, "--sink", out, "--force", "--frames", 3)[0] == 0 and len(list(read_frames(out))) == 3


def test_where_nobody_chose_the_summary_says_what_ran(make_clip: MakeClip, capsys: pytest.CaptureFixture[str]) -> None:
    clip = make_clip()
    assert play_cli.main([str(clip), "--sink", "null", "--deadline-ms", "100000", "--frames", "2", "--json", "--threads", "1"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["provider"] == chosen_provider()
    assert [tier["name"] for tier in record["tiers"]] == chosen_tiers(chosen_provider())


def test_a_display_that_is_neither_twice_nor_three_times_as_large(play: Play, make_clip: MakeClip, tmp_path: Path) -> None:
    out = tmp_path / "out.y4m"
    assert play(make_clip(), "--sink", out, "--display", "160x120", "--frames", 2)[0] == 0
    assert {(frame.width, frame.height) for frame in read_frames(out)} == {(160, 120)}


@pytest.mark.parametrize(
    ("source", "sentence"),
    [
        ("none.mp4", "does not exist"),
        ("127.0.0.1:0", "no address to listen on"),
        (":99999", "no address to listen on"),
        ("rtp://127.0.0.1", "no address to listen on"),
        ("rtp://127.0.0.1:5004/path", "no address to listen on"),
        ("999.1.1.1:5004", "no address to listen on"),
        ("file:///etc/passwd", "file:// is not played"),
        ("concat:/etc/passwd|/etc/hosts", "does not exist"),
        ("pipe://0", "pipe:// is not played"),
        ("subfile,,start,0,end,9,,:/etc/passwd", "does not exist"),
        ("crypto+http://127.0.0.1/x", "is not played"),
        ("http://[", "is no URL"),
        ("rtsp://me:secret@[::1/x", "is no URL"),
        ("rtsp://me:sec/ret@127.0.0.1/x", "rtsp://... cannot be opened"),
        ("http://127.0.0.1:1/x.mp4", "cannot be opened: Connection refused"),
        ("rtsp://me:secret@127.0.0.1:1/x", "rtsp://127.0.0.1:1/x cannot be opened"),
        ("none.sdp", "cannot be read"),
        ("", "is not a file"),
    ],
)
def test_sources_that_are_none(play: Play, source: str, sentence: str) -> None:
    status, out, errors = play(source)
    assert status == 1 and out == "" and "secret" not in errors
    assert errors.startswith("gamesr-play: ") and sentence in errors and len(errors.splitlines()) == 1


@pytest.mark.parametrize(
    ("name", "content", "sentence"),
    [
        ("x.sdp", b"", "SDP"),
        ("x.sdp", b"\0" * 1000, "SDP"),
        ("x.sdp", b"v=0\r\nm=video 0 RTP/AVP 96\r\na=rtpmap:96 H264/90000\r\n", "no port"),
        ("x.sdp", b"v=0\r\nm=audio 5004 RTP/AVP 96\r\n", "no H.264 video"),
        ("x.sdp", b"v=0\r\n" * 20000, "larger than 64 KiB"),
        ("x.txt", b"not a video\n" * 100, "is not a video file"),
        ("x.mp4", b"", "is empty"),
        ("x.m3u8", b"#EXTM3U\n#EXTINF:1,\nfile:///etc/passwd\n", "is not a video file"),
        ("x.ffconcat", b"ffconcat version 1.0\nfile /etc/passwd\n", "is not a video file"),
    ],
)
def test_files_that_are_none(play: Play, tmp_path: Path, name: str, content: bytes, sentence: str) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    status, out, errors = play(path)
    assert status == 1 and out == "" and sentence in errors and len(errors.splitlines()) == 1


@pytest.mark.parametrize(
    "arguments",
    [
        ["--sink", "out.mp4"],
        ["--display", "1920"],
        ["--display", "1921x1080"],
        ["--display", "99999x2"],
        ["--tiers", "gamesr,,live"],
        ["--tiers", "gamesr,gamesr"],
        ["--tiers", "gamesr", "--model", "gamesr"],
        ["--deadline-ms", "nan"],
        ["--deadline-ms", "-1"],
        ["--seconds", "inf"],
        ["--frames", "0"],
        ["--provider", "tpu"],
        ["--fullscreen", "--sink", "null"],
    ],
)
def test_wrong_usage(arguments: list[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        play_cli.main(["127.0.0.1:5004", *arguments])


def test_tiers_that_do_not_ship_are_an_error(play: Play, make_clip: MakeClip) -> None:
    status, _, errors = play(make_clip(), "--tiers", "bicubic,warp")
    assert status == 1 and "no model named 'warp' ships for scale 2" in errors and len(errors.splitlines()) == 1


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_with_the_summary(make_clip: MakeClip, model_file: Callable[..., Path], tmp_path: Path, signum: int) -> None:
    """Also the file is whole: all that was shown is in it."""
    out = tmp_path / "out.y4m"
    arguments = [str(make_clip(frames=900)), "--model", str(model_file()), "--sink", str(out), "--json", "--threads", "1"]
    ours = "import signal, sys; signal.signal(signal.SIGHUP, signal.SIG_DFL); from client.play_cli import main; sys.exit(main())"
    program = [sys.executable, "-c", ours, *arguments]
    environment = os.environ | {"PYTHONPATH": str(Path.cwd())}
    with subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment) as process:
        try:
            assert process.stderr is not None and "with" in process.stderr.readline()  # it has begun
            while not (parts := list(tmp_path.glob(".*.part"))) or parts[0].stat().st_size < 50_000:
                assert process.poll() is None
            process.send_signal(signum)
            said, errors = process.communicate(timeout=LONG_S)
        finally:
            process.kill()
    assert process.returncode == 128 + signum and "Traceback" not in errors
    record = json.loads(said)
    assert record["ended"] in ("interrupted", "told to end") and len(list(read_frames(out))) == record["frames"]["shown"] > 0


class Collects(QuietHandler):
    """A service that takes summaries at PATH, redirects from /moved and refuses elsewhere."""

    taken: list[tuple[str, dict[str, str], bytes]]

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        type(self).taken.append((self.path, dict(self.headers), body))
        status = {PATH: 201, f"/moved{PATH}": 307}.get(self.path, 422)
        answer = b"{}" if status == 201 else json.dumps({"detail": "no such\nthing"}).encode()
        self.send_response(status)
        self.send_header("Content-Length", str(len(answer)))
        self.send_header("Location", PATH)
        self.end_headers()
        self.wfile.write(answer)


def test_a_summary_is_posted_as_the_service_takes_it(play: Play, make_clip: MakeClip, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GAMESR_API_KEY", "a key of many letters")
    Collects.taken = []
    with answering(Collects) as address:
        status, out, errors = play(make_clip(), "--post", address)
        assert status == 0, errors
        ((path, headers, body),) = Collects.taken
        assert path == PATH and headers["X-Api-Key"] == "a key of many letters"
        posted = ClientLatencyRequest.model_validate_json(body)
        assert posted.latency_us.total.count == FRAMES and posted.model == "tiny" and (posted.low_width, posted.scale) == (WIDTH, 2)
        # A refusal loses nothing: the summary was said before. No other address gets the key.
        for where, sentence in (("/elsewhere", "422 no suchthing"), ("/moved", "307")):
            status, out, errors = play(make_clip(), "--post", address + where, "--json")
            assert status == 1 and json.loads(out)["frames"]["shown"] == FRAMES and sentence in errors.splitlines()[-1]
        assert len(Collects.taken) == 3
    for url in (address, "ftp://127.0.0.1/", "http://", "nonsense", "http://127.0.0.1:99999", "http://a b/", "http://[::1"):
        with pytest.raises(OutputError):
            post_summary(url, {})


@pytest.mark.usefixtures("no_screen")
def test_a_window_is_a_sink_like_another(play: Play, make_clip: MakeClip, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keys: the overlay, the wipe with bicubic, and the end."""
    pressed = [[], [Action.OVERLAY], [], [Action.WIPE], [], [], [Action.WIPE], [], [Action.QUIT]]
    seen: list[tuple[tuple[int, int], bool, int]] = []

    def present(self: Window, shown: Frame, *, left: Frame | None = None, overlay: Sequence[str] = ()) -> None:
        assert left is None or left.y.shape == shown.y.shape
        seen.append((shown.y.shape, left is not None, len(overlay)))

    monkeypatch.setattr(Window, "present", present)
    monkeypatch.setattr(Window, "actions", lambda self: pressed.pop(0) if pressed and len(seen) > 9 - len(pressed) else [])
    status, out, errors = play(make_clip(frames=40), "--sink", "window", "--json")
    assert status == 0, errors
    assert json.loads(out)["ended"] == "the window was closed"
    assert {size for size, _, _ in seen} == {(2 * HEIGHT, 2 * WIDTH)}
    assert {wiped for _, wiped, _ in seen} == {False, True} and not seen[-1][1] and seen[0][2] == 0 and seen[-1][2] >= 6


def test_a_summary_goes_to_the_address_and_through_no_proxy(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the environment names: a proxy would read the key."""
    for name in ("no_proxy", "NO_PROXY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:1")
    Collects.taken = []
    with answering(Collects) as address:
        post_summary(address, {})
    assert [path for path, _, _ in Collects.taken] == [PATH]


def test_a_key_may_end_in_a_new_line_and_is_never_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(KEY_VARIABLE, "sixteen letters!\n")
    with answering(Collects) as address:
        post_summary(address, {})
    monkeypatch.setenv(KEY_VARIABLE, "s3cret\nHost: elsewhere")
    with pytest.raises(OutputError, match=KEY_VARIABLE) as error:
        post_summary("http://127.0.0.1:1", {})
    assert "s3cret" not in str(error.value)


@pytest.mark.parametrize("host", ["a..b", "x" * 64])
def test_what_is_no_name_of_a_host_is_one_sentence(play: Play, host: str) -> None:
    status, _, errors = play(f"{host}:5004")
    assert status == 1 and f"{host} is no address to listen on" in errors and errors.count("\n") == 1


def test_the_windows_title_holds_no_password(play: Play, monkeypatch: pytest.MonkeyPatch) -> None:
    titles = []

    def window(title: str, *, fullscreen: bool) -> None:
        titles.append(title)
        raise OutputError("no window")

    monkeypatch.setattr("client.window.Window", window)
    for source in ("rtsp://me:secret@127.0.0.1:1/x", "127.0.0.1:5004", "http://me:secret@["):
        play(source, "--sink", "window")
    assert titles == ["gamesr-play rtsp://127.0.0.1:1/x", "gamesr-play 127.0.0.1:5004", "gamesr-play http://..."]


@pytest.mark.skipif(sys.platform == "darwin", reason="its file names are UTF-8")
def test_a_name_that_is_no_utf_8_is_played(make_clip: MakeClip, model_file: Callable[..., Path], tmp_path: Path) -> None:
    """By a process: capsys would print anything."""
    clip = make_clip().rename(tmp_path / os.fsdecode(b"clip \xff.mp4"))
    program = [sys.executable, "-c", "import sys; from client.play_cli import main; sys.exit(main())", str(clip), "--sink", "null"]
    options = ["--model", str(model_file()), "--threads", "1", "--deadline-ms", "100000"]
    environment = os.environ | {"PYTHONPATH": str(Path.cwd()), "PYTHONUTF8": "1", "PYTHONIOENCODING": "utf-8"}
    done = subprocess.run([*program, *options], capture_output=True, text=True, env=environment, timeout=LONG_S)
    assert done.returncode == 0 and f"{tmp_path}/clip ?.mp4: the stream ended" in done.stdout, done.stderr


def test_the_lines_of_the_docs_are_ours() -> None:
    text = (Path(__file__).parent.parent / "docs/play.md").read_text()
    lines = [line.split("#")[0].split() for line in text.splitlines() if line.startswith("    gamesr-play ")]
    assert len(lines) >= 4
    for _, *arguments in lines:
        play_cli.parser().parse_args(arguments)


def test_what_goes_on_happening_is_said_ever_more_rarely(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    now = 1000.0
    monkeypatch.setattr("client.play_cli.time.monotonic", lambda: now)
    say = play_cli.Say()
    for _ in range(6000):
        say("overflow", "again")
        now += 0.1
    say("size", "another")
    lines = capsys.readouterr().err.splitlines()
    assert 8 <= lines.count("gamesr-play: again") <= 18 and lines[-1] == "gamesr-play: another" and say.counts["overflow"] == 6000
    now += 600
    for _ in range(2):
        say("overflow", "again")
        now += 1.1
    assert len(capsys.readouterr().err.splitlines()) == 2
