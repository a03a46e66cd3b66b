"""The films of a footage list are held against it and each other before they are used, and their takes are whole."""

from __future__ import annotations

import hashlib
import json
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import av
import numpy as np
import pytest

from client.errors import InputError
from model.films import Film
from model.footage import CACHE_VERSION, Degradation, FootageCache, Scene, Take, check_films, load_pairs, load_scenes
from tests.moving import scene, write_clip

MakeClip = Callable[..., Path]
NATIVE, AREA = Degradation("native"), Degradation("area")


@pytest.fixture
def scene_of(make_clip: MakeClip) -> Callable[..., Scene]:
    """A scene of 128x96 with a native render made with these arguments, 64x48 unless they say otherwise."""

    def make(*, tags: tuple[int, int, int, int] = (1, 1, 1, 1), **render: object) -> Scene:
        film = make_clip("film.mkv", width=128, height=96, tags=tags)
        return Scene("s", "g", "test", 30, film, {48: make_clip("render.mkv", **render)})

    return make


def test_a_render_of_the_same_frames_is_taken(scene_of: Callable[..., Scene], tmp_path: Path) -> None:
    ((pair,),) = load_pairs([scene_of()], FootageCache(tmp_path / "cache"), 2, [NATIVE])
    assert len(pair) == len(pair.high) == 12 and (pair.low.height, pair.high.height) == (48, 96)


@pytest.mark.parametrize("looked_at", [None, 3])
@pytest.mark.parametrize("frames", [11, 13])
def test_a_render_of_another_number_of_frames_is_refused(
    scene_of: Callable[..., Scene], tmp_path: Path, frames: int, looked_at: int | None
) -> None:
    """However few are looked at: the one that is missing may be the first."""
    cache = FootageCache(tmp_path / "cache", looked_at)
    with pytest.raises(InputError, match=rf"render.mkv has {frames} frames and .*film.mkv 12: one of them is cut short"):
        load_pairs([scene_of(frames=frames)], cache, 2, [NATIVE])
    assert not list(cache.folder.iterdir())


@pytest.mark.parametrize(("width", "height"), [(64, 32), (62, 48)])
def test_a_render_of_another_size_is_refused(scene_of: Callable[..., Scene], tmp_path: Path, width: int, height: int) -> None:
    cache = FootageCache(tmp_path / "cache")
    with pytest.raises(InputError, match=rf"render.mkv is {width}x{height}, which is not 1/2 of .*film.mkv with its 128x96"):
        load_pairs([scene_of(width=width, height=height)], cache, 2, [NATIVE])
    assert not list(cache.folder.iterdir())


@pytest.mark.parametrize("tags", [(2, 1, 1, 1), (1, 1, 1, 5)])
def test_a_render_of_another_colour_coding_is_refused(
    scene_of: Callable[..., Scene], make_clip: MakeClip, tmp_path: Path, tags: tuple[int, int, int, int]
) -> None:
    there = scene_of(tags=tags)
    with pytest.raises(InputError, match=rf"render.mkv \(range 1, matrix 1\) is not of one colour coding with .*range {tags[0]}"):
        load_pairs([there], FootageCache(tmp_path / "cache"), 2, [NATIVE])
    make_clip("render.mkv", tags=tags)  # the same for both, or not said of one, may be right
    load_pairs([there], FootageCache(tmp_path / "cache"), 2, [NATIVE])
    make_clip("render.mkv", tags=(0, 2, 2, 2))
    load_pairs([there], FootageCache(tmp_path / "cache"), 2, [NATIVE])


def test_a_size_that_cannot_be_reduced_is_said_before_anything_is_decoded(make_clip: MakeClip, tmp_path: Path) -> None:
    """1280x720 by 3 would be 426.67 wide."""
    good, bad = (Scene(name, "g", "test", 30, make_clip(f"{name}.mkv", width=width, frames=2)) for name, width in (("a", 72), ("b", 64)))
    cache = FootageCache(tmp_path / "cache")
    check_films([good, bad], cache, [2], [AREA])
    for call in (lambda: check_films([good, bad], cache, [2, 3], [AREA]), lambda: load_pairs([good, bad], cache, 3, [AREA])):
        with pytest.raises(InputError, match=r"b.mkv is 64x48, which cannot be reduced by 3 to even sides: leave that scale out, or crop"):
            call()
    assert not list(cache.folder.iterdir())


@pytest.mark.parametrize(("width", "height"), [(63, 48), (64, 47)])
def test_an_odd_film_is_refused(make_clip: MakeClip, tmp_path: Path, width: int, height: int) -> None:
    odd = Scene("s", "g", "test", 30, make_clip("odd.mkv", width=width, height=height, codec="ffv1", options={}))
    with pytest.raises(InputError, match=f"odd.mkv is {width}x{height}, and H.264 needs even sides"):
        FootageCache(tmp_path / "cache").reference(odd)


def test_what_the_encoder_refuses_is_a_sentence(make_clip: MakeClip, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refusing(*_: object) -> None:
        raise av.FFmpegError(22, "Invalid argument")

    monkeypatch.setattr("model.footage.through_codec", refusing)
    film = Scene("s", "g", "test", 30, make_clip("film.mkv"))
    with pytest.raises(InputError, match="g/s cannot be encoded as area@100 by 2: Invalid argument"):
        FootageCache(tmp_path / "cache").degraded(film, 2, Degradation("area", 100))


@pytest.mark.parametrize(("fps", "refused"), [(30, False), (60, True), (29, True)])
def test_the_lists_frame_rate_is_that_of_the_film(make_clip: MakeClip, tmp_path: Path, fps: int, refused: bool) -> None:
    cache, path = FootageCache(tmp_path / "cache"), make_clip("film.mkv")
    if refused:
        with pytest.raises(InputError, match=f"film.mkv has 30 frames a second, where its list says fps = {fps}"):
            cache.reference(Scene("s", "g", "test", fps, path))
    else:
        cache.reference(Scene("s", "g", "test", fps, path))
    cache.reference(Scene("s", "g", "test", fps, make_clip("film.h264")))  # which tells no times


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (scene("a", "g", "train", "x.mkv"), scene("b", "g", "test", "folder/../x.mkv")),
        (scene("a", "g", "train", "x.mkv"), scene("b", "g", "test", "y.mkv") + 'antialiased = "x.mkv"\n'),
        (scene("a", "g", "train", "x.mkv") + 'native = { 48 = "z.mkv" }\n', scene("b", "g", "test", "z.mkv")),
    ],
)
def test_a_film_belongs_to_one_split_under_whatever_names(tmp_path: Path, one: str, other: str) -> None:
    (tmp_path / "footage.toml").write_text(one + other)
    with pytest.raises(InputError, match=r"/[xz].mkv is in two splits"):
        load_scenes(tmp_path / "footage.toml", split="train")
    (tmp_path / "footage.toml").write_text(one + other.replace('"test"', '"train"'))
    assert len(load_scenes(tmp_path / "footage.toml", split="train")) == 2


@pytest.mark.parametrize("kept_bytes", [0, 50, 20_000])
@pytest.mark.parametrize("how", ["", "area", "area@300"])
def test_a_take_that_was_cut_off_is_made_again(make_clip: MakeClip, tmp_path: Path, kept_bytes: int, how: str) -> None:
    film, cache = Scene("s", "g", "test", 30, make_clip("film.mkv", width=128, height=96)), FootageCache(tmp_path / "cache")

    def take() -> Take:
        return cache.degraded(film, 2, Degradation.parse(how)) if how else cache.reference(film)

    whole = np.array(take().data)
    path = cache.folder / f"{take().digest}.npy"
    with path.open("r+b") as file:
        file.truncate(kept_bytes)
    assert np.array_equal(take().data, whole) and np.array_equal(np.load(path), whole)


def test_takes_are_those_that_earlier_versions_made(make_clip: MakeClip, tmp_path: Path) -> None:
    """Uncompressed ones have the same names and bytes; compressed ones are of a version of the encoder."""
    film, cache = Scene("s", "g", "test", 30, make_clip("film.mkv")), FootageCache(tmp_path / "cache")
    take = cache.reference(film)
    np.save(tmp_path / "saved.npy", np.array(take.data))
    assert (cache.folder / f"{take.digest}.npy").read_bytes() == (tmp_path / "saved.npy").read_bytes()
    key = {"file": Film.of(film.reference, 30).digest}
    for expected, found in (
        (key, take),
        ({**key, "scale": 2, "source": "area"}, cache.degraded(film, 2, AREA)),
        ({**key, "frames": 5}, FootageCache(cache.folder, 5).reference(film)),
    ):
        text = json.dumps([CACHE_VERSION, expected], sort_keys=True)
        assert found.digest == hashlib.sha256(text.encode()).hexdigest()[:24]


def test_another_encoder_makes_another_take(make_clip: MakeClip, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    film, cache = Scene("s", "g", "test", 30, make_clip("film.mkv")), FootageCache(tmp_path / "cache")
    digests = [[cache.degraded(film, 2, Degradation("area", kbps)).digest for kbps in (None, 300)]]
    monkeypatch.setattr(av, "__version__", "0")
    digests += [[cache.degraded(film, 2, Degradation("area", kbps)).digest for kbps in (None, 300)]]
    assert digests[0][0] == digests[1][0] and digests[0][1] != digests[1][1]


@pytest.mark.parametrize("how", ["area", "area@300", "native", "native@300"])
def test_the_first_frames_are_the_same_however_many_are_asked_for(scene_of: Callable[..., Scene], tmp_path: Path, how: str) -> None:
    """No encoder looks at what comes."""
    film = scene_of()
    few, all_ = (FootageCache(tmp_path / "cache", frames).degraded(film, 2, Degradation.parse(how)) for frames in (5, None))
    assert len(few) == 5 and len(all_) == 12 and np.array_equal(few.data, all_.data[:5])


def test_a_film_is_never_in_memory_as_a_whole(tmp_path: Path) -> None:
    write_clip(tmp_path / "film.mkv", 192, 320, frames=64)
    film, cache = Scene("s", "g", "test", 30, tmp_path / "film.mkv"), FootageCache(tmp_path / "cache")
    tracemalloc.start()
    take = cache.degraded(film, 2, Degradation("area", 300))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(take) == 64 and peak < cache.reference(film).data.nbytes / 4
