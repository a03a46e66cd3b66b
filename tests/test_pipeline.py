"""The one way from a stream to pictures and into a file: nothing lost, nothing moved, restarts explicit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from itertools import pairwise, product
from pathlib import Path

import av
import numpy as np
import pytest

from client.errors import OutputError
from client.pipeline import FrameDone, Restart, upscale_stream
from client.sink import FileSink, NullSink
from client.timing import LatencySummary, Stamps, stage_latencies
from client.upscaler import OnnxUpscaler
from client.video import Decoded, VideoSource, read_frames
from tests.conftest import FRAMES, HEIGHT, WIDTH
from tests.stepping import same

MakeClip = Callable[..., Path]
B_FRAMES = {"bf": "3", "b-adapt": "0", "g": "6"}


@pytest.fixture
def upscaler(model_file: Callable[..., Path]) -> OnnxUpscaler:
    return OnnxUpscaler(model_file())


def through(clip: Path, upscaler: OnnxUpscaler, output: Path | None = None) -> list[FrameDone]:
    with VideoSource(clip) as source:
        if output is None:
            return list(upscale_stream(source, upscaler, NullSink()))
        with FileSink(output, source) as sink:
            return list(upscale_stream(source, upscaler, sink))


def test_pipeline_equals_stepping_by_hand(make_clip: MakeClip, upscaler: OnnxUpscaler) -> None:
    clip = make_clip()
    state, pictures = upscaler.initial_state(HEIGHT, WIDTH), []
    for frame in read_frames(clip):
        picture, state = upscaler.step(frame, state)
        pictures.append(picture)
    done = through(clip, upscaler)
    assert [d.restart for d in done] == [None] * FRAMES
    assert all(same(d.picture, expected) for d, expected in zip(done, pictures, strict=True))


def test_no_future_frame_changes_a_past_picture(make_clip: MakeClip, upscaler: OnnxUpscaler) -> None:
    short, whole = through(make_clip("short.mp4", frames=6), upscaler), through(make_clip(), upscaler)
    assert len(short) == 6 and all(same(a.picture, b.picture) for a, b in zip(short, whole, strict=False))


def test_stamps_follow_the_frame(make_clip: MakeClip, upscaler: OnnxUpscaler) -> None:
    done = through(make_clip(options=B_FRAMES), upscaler)
    stamps = [(d.stamps.packet_ns, d.stamps.decoded_ns, d.stamps.upscaled_ns, d.stamps.written_ns) for d in done]
    assert [ns for frame in stamps for ns in frame] == sorted(ns for frame in stamps for ns in frame)


def test_the_same_clip_gives_the_same_file(make_clip: MakeClip, upscaler: OnnxUpscaler, tmp_path: Path) -> None:
    clip = make_clip(audio="aac")
    for name in ("a.mp4", "b.mp4"):
        through(clip, upscaler, tmp_path / name)
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()


@pytest.mark.parametrize("options", [{"bf": "0"}, B_FRAMES])
@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
@pytest.mark.parametrize("pts", [None, [7, 8, 9, 12, 13, 19, 20, 21, 22, 40, 41, 42]])
def test_every_frame_is_written_once_at_its_time(
    make_clip: MakeClip, upscaler: OnnxUpscaler, tmp_path: Path, options: dict[str, str], suffix: str, pts: list[int] | None
) -> None:
    clip, output = make_clip(pts=pts, options=options), tmp_path / f"out.{suffix}"
    done = through(clip, upscaler, output)
    written = list(read_frames(output))
    assert len(written) == len(done) == FRAMES
    tolerance = Fraction(1, 2000) if suffix == "mkv" else 0  # Matroska counts milliseconds
    for frame, source in zip(written, read_frames(clip), strict=True):
        assert abs(frame.pts * frame.time_base - source.pts * source.time_base) <= tolerance


def test_an_offset_finer_than_a_millisecond_is_kept(make_clip: MakeClip, upscaler: OnnxUpscaler, tmp_path: Path) -> None:
    clip = make_clip("clip.ts", pts=list(range(7, 7 + FRAMES)))
    through(clip, upscaler, tmp_path / "out.mp4")
    times = [[f.pts * f.time_base for f in read_frames(path)] for path in (clip, tmp_path / "out.mp4")]
    assert times[0] == times[1] and (1000 * times[0][0]).denominator > 1


def test_what_is_written_is_what_was_computed(make_clip: MakeClip, upscaler: OnnxUpscaler, tmp_path: Path) -> None:
    done = through(make_clip(), upscaler, tmp_path / "out.mp4")
    for frame, computed in zip(read_frames(tmp_path / "out.mp4"), done, strict=True):
        error = frame.y.astype(float) - computed.picture.y
        assert 10 * np.log10(255**2 / np.mean(error**2)) > 42


@pytest.mark.parametrize("tags", [(1, 1, 1, 1), (2, 1, 1, 1), (1, 5, 6, 5), (1, 6, 6, 6), (0, 2, 2, 2)])
def test_colour_tags_aspect_and_rotation_are_kept(
    make_clip: MakeClip, upscaler: OnnxUpscaler, tmp_path: Path, tags: tuple[int, int, int, int]
) -> None:
    clip, output = make_clip(tags=tags, sample_aspect_ratio=Fraction(4, 3), rotation=90), tmp_path / "out.mp4"
    through(clip, upscaler, output)
    with VideoSource(clip) as source, VideoSource(output) as result:
        first, written = next(iter(source)).frame, next(iter(result)).frame
        assert written.colour == first.colour
        assert result.sample_aspect_ratio == source.sample_aspect_ratio == Fraction(4, 3)
        assert result.display_matrix == source.display_matrix is not None


def audio_packets(path: Path) -> list[tuple[bytes, Fraction]]:
    with av.open(str(path)) as container:
        return [(bytes(packet), packet.pts * packet.time_base) for packet in container.demux(audio=0) if packet.size]


@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
def test_audio_is_copied_untouched(make_clip: MakeClip, upscaler: OnnxUpscaler, tmp_path: Path, suffix: str) -> None:
    clip, output = make_clip(audio="aac"), tmp_path / f"out.{suffix}"
    through(clip, upscaler, output)
    before, after = audio_packets(clip), audio_packets(output)
    assert len(before) > 10 and [data for data, _ in after] == [data for data, _ in before]
    # Matroska has no time before zero, where the encoder's priming lies: everything begins that much later.
    tolerance = Fraction(1, 1000)
    shift = after[0][1] - before[0][1]
    assert suffix == "mkv" or shift == 0
    assert all(abs(b - a - shift) <= tolerance for (_, a), (_, b) in zip(before, after, strict=True))


@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
def test_sound_follows_on_where_the_time_goes_back(make_clip: MakeClip, upscaler: OnnxUpscaler, tmp_path: Path, suffix: str) -> None:
    """Two recordings in one transport stream."""
    clip, output = make_clip("clip.ts", audio="aac"), tmp_path / f"out.{suffix}"
    once = audio_packets(clip)
    clip.write_bytes(2 * clip.read_bytes())
    with VideoSource(clip) as source, FileSink(output, source) as sink:
        assert len(list(upscale_stream(source, upscaler, sink))) == 2 * FRAMES
    after = audio_packets(output)
    assert len(after) == 2 * len(once) > 20 and all(b > a for (_, a), (_, b) in pairwise(after))
    assert abs(after[-1][1] - after[0][1] - (len(after) - 1) * Fraction(1024, 48000)) <= Fraction(2, 1000)
    assert f"{len(once)} packets of sound had a timestamp that went back: each follows the one before" in sink.notes


@pytest.mark.parametrize(("name", "suffix"), list(product(["clip.avi", "clip.mkv"], ["mp4", "mkv"])))
def test_pcm_without_a_channel_layout_is_copied(
    make_clip: MakeClip, upscaler: OnnxUpscaler, tmp_path: Path, name: str, suffix: str
) -> None:
    clip, output = make_clip(name, audio="pcm_s16le"), tmp_path / f"out.{suffix}"
    with av.open(str(clip)) as container:
        assert container.streams.audio[0].layout.name == "2 channels"
    through(clip, upscaler, output)
    assert b"".join(data for data, _ in audio_packets(output)) == b"".join(data for data, _ in audio_packets(clip))


def test_subtitles_chapters_and_names_are_kept_where_they_can_be(make_clip: MakeClip, upscaler: OnnxUpscaler, tmp_path: Path) -> None:
    clip, subtitles, rich = make_clip("plain.mkv", audio="aac"), tmp_path / "words.srt", tmp_path / "rich.mkv"
    subtitles.write_text("1\n00:00:00,100 --> 00:00:00,300\nHello\n")
    chapters = [{"id": 1, "start": 0, "end": 200, "time_base": Fraction(1, 1000), "metadata": {"title": "The first"}}]
    with av.open(str(clip)) as film, av.open(str(subtitles)) as words, av.open(str(rich), "w") as container:
        container.metadata["title"] = "A match"
        container.set_chapters(chapters)
        targets = {stream.type: container.add_stream_from_template(stream) for stream in (*film.streams, *words.streams)}
        targets["audio"].metadata["language"] = "ger"
        for packet in (*film.demux(), *words.demux()):
            if packet.size:
                packet.stream = targets[packet.stream.type]
                container.mux(packet)
    notes = {}
    for suffix in ("mkv", "mp4"):
        with VideoSource(rich) as source, FileSink(tmp_path / f"out.{suffix}", source) as sink:
            assert list(upscale_stream(source, upscaler, sink))
        notes[suffix] = sink.notes
        with av.open(str(sink.path)) as container:
            assert container.metadata["title"] == "A match" and container.streams.audio[0].metadata["language"] == "ger"
            assert [(c["metadata"]["title"], (c["end"] - c["start"]) * c["time_base"]) for c in container.chapters()] == [
                ("The first", Fraction(1, 5))
            ]
            texts = [bytes(packet) for packet in container.demux() if packet.size and packet.stream.type == "subtitle"]
        assert texts == ([b"Hello"] if suffix == "mkv" else [])
    assert notes == {"mkv": [], "mp4": ["subtitle track 1 (srt) is left out: mp4 cannot hold it"]}


def test_audio_is_not_blamed_for_what_else_cannot_be_encoded(
    make_clip: MakeClip, upscaler: OnnxUpscaler, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("client.sink.X264_OPTIONS", {"profile": "nonsense"})
    with pytest.raises(OutputError, match=r"^cannot write .*out\.mp4: ") as error:
        through(make_clip(), upscaler, tmp_path / "out.mp4")
    assert "cannot hold" not in str(error.value)


def test_a_title_that_is_not_utf8_keeps_nobody_from_its_video(make_clip: MakeClip, upscaler: OnnxUpscaler, tmp_path: Path) -> None:
    clip = make_clip("plain.mkv")
    with av.open(str(clip)) as film, av.open(str(tmp_path / "old.mkv"), "w") as container:
        container.metadata["title"] = "un cafe"
        target = container.add_stream_from_template(film.streams.video[0])
        for packet in film.demux():
            if packet.size:
                packet.stream = target
                container.mux(packet)
    old = tmp_path / "old.mkv"
    old.write_bytes(old.read_bytes().replace(b"un cafe", b"un caf\xe9"))
    assert len(through(old, upscaler, tmp_path / "out.mkv")) == FRAMES
    with av.open(str(tmp_path / "out.mkv")) as container:
        assert container.metadata["title"] == "un caf\ufffd"


@pytest.mark.parametrize(
    ("name", "codec", "suffix", "advice"),
    [
        ("clip.mkv", "wavpack", "mp4", "write to .mkv instead"),
        ("clip.avi", "adpcm_ms", "mkv", "leave it out with ffmpeg -i .*clip.avi -c copy -an"),
    ],
)
def test_audio_that_the_container_cannot_hold_is_refused(
    make_clip: MakeClip, upscaler: OnnxUpscaler, tmp_path: Path, name: str, codec: str, suffix: str, advice: str
) -> None:
    clip = make_clip(name, audio=codec)
    with pytest.raises(OutputError, match=rf"cannot hold the audio of .*{name} \({codec}\): {advice}"):
        through(clip, upscaler, tmp_path / f"out.{suffix}")
    assert not list(tmp_path.glob("*out*"))


def test_an_odd_result_is_padded_and_that_is_said(make_clip: MakeClip, model_file: Callable[..., Path], tmp_path: Path) -> None:
    clip = make_clip(width=33, height=21, pix_fmt="yuv444p")
    with VideoSource(clip) as source, FileSink(tmp_path / "out.mp4", source) as sink:
        done = list(upscale_stream(source, OnnxUpscaler(model_file(scale=3)), sink))
    assert done[0].picture.y.shape == (63, 99)
    assert next(read_frames(tmp_path / "out.mp4")).y.shape == (64, 100)
    assert sink.notes == ["the 99x63 picture is padded to 100x64: H.264 4:2:0 holds even sizes only"]


def test_frames_without_time_follow_from_the_frame_rate(make_clip: MakeClip, upscaler: OnnxUpscaler, tmp_path: Path) -> None:
    with VideoSource(make_clip("clip.h264")) as source, FileSink(tmp_path / "out.mp4", source) as sink:
        list(upscale_stream(source, upscaler, sink))
    assert [f.pts * f.time_base for f in read_frames(tmp_path / "out.mp4")] == [Fraction(i, 30) for i in range(FRAMES)]
    assert len(sink.notes) == 1 and "12 frames had no timestamp" in sink.notes[0]


def test_a_size_change_restarts_the_state(make_clip: MakeClip, upscaler: OnnxUpscaler, tmp_path: Path) -> None:
    small, large = make_clip("a.h264"), make_clip("b.h264", width=96, height=80)
    both = tmp_path / "both.h264"
    both.write_bytes(small.read_bytes() + large.read_bytes())
    done = through(both, upscaler)
    assert [index for index, d in enumerate(done) if d.restart] == [FRAMES]
    assert done[FRAMES].restart is Restart.SIZE
    alone = through(small, upscaler) + through(large, upscaler)
    assert all(same(a.picture, b.picture) for a, b in zip(done, alone, strict=True))


def test_a_file_refuses_a_second_size_and_leaves_nothing(make_clip: MakeClip, upscaler: OnnxUpscaler, tmp_path: Path) -> None:
    both = tmp_path / "both.h264"
    both.write_bytes(make_clip("a.h264").read_bytes() + make_clip("b.h264", width=96, height=80).read_bytes())
    with pytest.raises(OutputError, match="128x96 becomes 192x160 upscaled"):
        through(both, upscaler, tmp_path / "out.mp4")
    assert not list(tmp_path.glob("*out*"))


def test_the_state_is_carried_into_damage_and_restarts_where_it_ends(make_clip: MakeClip, upscaler: OnnxUpscaler) -> None:
    frames = list(read_frames(make_clip()))
    damaged = [Decoded(replace(frame, damaged=3 <= index < 6), 0, 0) for index, frame in enumerate(frames)]
    done = list(upscale_stream(damaged, upscaler, NullSink()))
    assert [d.restart for d in done] == [None] * 6 + [Restart.DAMAGE] + [None] * 5
    for begin, end in ((0, 6), (6, 12)):
        state = upscaler.initial_state(HEIGHT, WIDTH)
        for frame, d in zip(frames[begin:end], done[begin:end], strict=True):
            picture, state = upscaler.step(frame, state)
            assert same(d.picture, picture)
    assert not same(done[6].picture, upscaler.step(frames[6], state)[0])  # the state means something


def test_nothing_of_a_damaged_picture_reaches_a_clean_one(make_clip: MakeClip, upscaler: OnnxUpscaler) -> None:
    """Whatever the damage was: the clean pictures after it are the same."""
    frames = [replace(frame, damaged=3 <= index < 6) for index, frame in enumerate(read_frames(make_clip()))]
    others = [replace(frame, y=255 - frame.y) if frame.damaged else frame for frame in frames]
    one, other = (list(upscale_stream([Decoded(f, 0, 0) for f in way], upscaler, NullSink())) for way in (frames, others))
    assert [same(a.picture, b.picture) for a, b in zip(one, other, strict=True)] == [not frame.damaged for frame in frames]


def test_a_lost_state_is_said(make_clip: MakeClip, model_file: Callable[..., Path]) -> None:
    done = through(make_clip(frames=5), OnnxUpscaler(model_file(gain=1e30)))
    assert [d.restart for d in done] == [None, None, Restart.LOST, None, Restart.LOST]


def test_an_exception_leaves_no_file(make_clip: MakeClip, upscaler: OnnxUpscaler, tmp_path: Path) -> None:
    output = tmp_path / "out.mp4"
    with pytest.raises(KeyboardInterrupt), VideoSource(make_clip()) as source, FileSink(output, source) as sink:
        for index, _ in enumerate(upscale_stream(source, upscaler, sink)):
            assert list(tmp_path.glob(".out.mp4.*.part"))
            if index == 5:
                raise KeyboardInterrupt
    assert not list(tmp_path.glob("*out*"))


def test_a_file_that_appears_meanwhile_is_not_replaced(make_clip: MakeClip, upscaler: OnnxUpscaler, tmp_path: Path) -> None:
    output = tmp_path / "out.mp4"
    with pytest.raises(OutputError, match="has appeared"), VideoSource(make_clip()) as source, FileSink(output, source) as sink:
        for _ in upscale_stream(source, upscaler, sink):
            output.write_text("mine")
    assert output.read_text() == "mine" and not list(tmp_path.glob("*.part"))


def test_percentiles_are_times_that_occurred() -> None:
    summary = LatencySummary.of([1000 * value for value in range(100, 0, -1)])
    assert (summary.count, summary.p50, summary.p95, summary.p99, summary.max) == (100, 50, 95, 99, 100)
    with pytest.raises(ValueError, match="no durations"):
        LatencySummary.of([])


def test_stages_are_differences_of_stamps() -> None:
    stages = stage_latencies([Stamps(1000, 3000, 7000, 15000)])
    assert {name: latency.p50 for name, latency in stages.items()} == {"decode": 2, "upscale": 4, "write": 8, "total": 14}
