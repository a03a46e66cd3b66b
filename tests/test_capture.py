"""Filmed scenes: what is kept, and whether a folder still holds what was filmed. No game is needed."""

from __future__ import annotations

import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from client.errors import GamesrError, InputError
from client.frames import Frame
from client.video import read_frames
from model.capture.checking import EMPTY, MARGIN_DB, alignment, liveliness
from model.capture.cli import main
from model.capture.filming import Shot, film
from model.capture.games import SceneSpec, load_games
from model.capture.library import Library, film_to_file
from model.capture.rendering import shots_of
from model.footage import Degradation, FootageCache, load_pairs, load_scenes
from tests.capturing import EXCERPT, excerpt, write_clip, write_game

WORLD = (0.0, 0.0, 1.0, 1.0)
HEIGHTS = (216, 108, 72)


# ---- the checks, on a real excerpt ----


@pytest.mark.parametrize("height", [108, 72])
def test_sizes_of_one_scene_are_the_same_frames(height: int) -> None:
    found = alignment(excerpt(216), excerpt(height), WORLD)
    assert found.objection() is None
    assert found.won == 1 and found.margin_db > 2 * MARGIN_DB
    assert found.psnr_db[2] == max(found.psnr_db)


@pytest.mark.parametrize("lag", [-2, -1, 1, 2])
def test_a_size_that_is_some_frames_off_is_found_out(tmp_path: Path, lag: int) -> None:
    high, low = ([frame.y.copy() for frame in read_frames(excerpt(height))] for height in (216, 108))
    early, late = (high, low) if lag > 0 else (low, high)
    early, late = early[: -abs(lag)], late[abs(lag) :]
    high, low = (early, late) if lag > 0 else (late, early)
    found = alignment(write_clip(tmp_path / "h.mkv", high), write_clip(tmp_path / "l.mkv", low), WORLD)
    assert found.won == 0 and "same index wins in only 0%" in str(found.objection())
    assert found.psnr_db[2 - lag] == max(found.psnr_db)


def test_clips_of_other_lengths_or_shapes_are_refused(tmp_path: Path) -> None:
    high = [frame.y.copy() for frame in read_frames(excerpt(216))]
    with pytest.raises(InputError, match="ends at frame 39"):
        alignment(write_clip(tmp_path / "short.mkv", high[:-1]), excerpt(108), WORLD)
    with pytest.raises(InputError, match="no multiple"):
        alignment(write_clip(tmp_path / "cut.mkv", [luma[:200] for luma in high]), excerpt(108), WORLD)


def test_a_still_clip_says_nothing_of_alignment_and_is_not_kept(tmp_path: Path) -> None:
    high, low = (next(iter(read_frames(excerpt(height)))).y.copy() for height in (216, 108))
    still = write_clip(tmp_path / "still.mkv", [high] * 40)
    assert "stands still" in str(liveliness(still, 60).objection())
    assert "no frame of it moves" in str(alignment(still, write_clip(tmp_path / "low.mkv", [low] * 40), WORLD).objection())


def test_a_scene_that_moves_is_kept_an_empty_one_is_not(tmp_path: Path) -> None:
    found = liveliness(excerpt(216), 60)
    assert found.objection() is None and len(found.changes) == 1
    empty = write_clip(tmp_path / "empty.mkv", [np.full((216, 384), level, np.uint8) for level in range(16, 56)])
    assert liveliness(empty, 60).detail < EMPTY
    assert "next to nothing" in str(liveliness(empty, 60).objection())


def test_a_scene_that_stops_half_way_is_thrown_away(tmp_path: Path) -> None:
    lumas = [frame.y.copy() for frame in read_frames(excerpt(216))]
    clip = write_clip(tmp_path / "menu.mkv", [*lumas[:32], *[lumas[32]] * 48])
    assert "only" in str(liveliness(clip, 32).objection())


# ---- the folder; a program that plays the excerpt stands for the game ----

PLAYER = """
import os, sys
from pathlib import Path
from client.video import read_frames
height, count = int(os.environ["GAMESR_HEIGHT"]), int(os.environ["GAMESR_COUNT"])
with os.fdopen(int(os.environ["GAMESR_FD"]), "wb") as pipe:
    for index, frame in enumerate(read_frames(Path(sys.argv[1]) / f"oa_dm5_{height}p.mkv")):
        if index == min(count, int(sys.argv[2])):
            break
        for plane in (frame.y, frame.u, frame.v):
            pipe.write(plane.tobytes())
print("last words", flush=True)
"""


@pytest.fixture
def scene(tmp_path: Path) -> SceneSpec:
    return player(tmp_path, 40)


def player(folder: Path, frames: int) -> SceneSpec:
    (folder / "player.py").write_text(PLAYER)
    (scene, _) = load_games(write_game(folder / "games"))
    command = (sys.executable, str(folder / "player.py"), str(EXCERPT), str(frames))
    environment = {"PYTHONPATH": str(Path(__file__).parents[1])}
    return replace(scene, game=replace(scene.game, play=replace(scene.game.play, command=command, environment=environment)))


def film_all(scene: SceneSpec, folder: Path, heights: tuple[int, ...] = HEIGHTS) -> Library:
    library = Library(folder)
    for shot in library.missing(scene, shots_of(scene, heights)):
        *frames, filmed = film_to_file(scene, shot, folder, clock=Path(), display=":none", timeout_s=60)
        assert len(frames) == scene.frames and not isinstance(filmed, Frame)
        library.put(scene, shot, filmed)
    return library


SERVER = """
import os, socket, sys
server = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
server.bind(("127.0.0.1", int(sys.argv[1])))
area = int(os.environ["GAMESR_WIDTH"]) * int(os.environ["GAMESR_HEIGHT"])
with os.fdopen(int(os.environ["GAMESR_FD"]), "wb") as pipe:
    for _ in range(int(os.environ["GAMESR_COUNT"])):
        pipe.write(bytes(area * 3 // 2))
        pipe.flush()
"""


def test_games_with_servers_of_their_own_play_at_the_same_time(tmp_path: Path) -> None:
    (tmp_path / "server.py").write_text(SERVER)
    (scene, _) = load_games(write_game(tmp_path / "games"))
    run = replace(scene.game.play, command=(sys.executable, str(tmp_path / "server.py"), "$port"))
    scene = replace(scene, frames=200, game=replace(scene.game, play=run))  # more than a pipe holds: the first still runs beside the second
    one, other = (film(scene, Shot(72), clock=Path(), display=":none", timeout_s=60) for _ in range(2))
    assert next(one).height == next(other).height == 72
    assert [1 + sum(1 for _ in frames) for frames in (one, other)] == [200, 200]


def test_what_is_filmed_is_kept_described_and_not_filmed_again(scene: SceneSpec, tmp_path: Path) -> None:
    library = film_all(scene, tmp_path / "out")
    assert library.is_unmeasured(scene) and not library.kept(scene)  # as it is when stopped in between
    entry = library.judge(scene)
    assert not library.is_unmeasured(scene) and library.kept(scene)
    assert entry.objection() is None and entry.kept_files() == ["216p", "108p", "72p"]
    assert "108p aligned by" in entry.verdict()
    again = Library(tmp_path / "out")
    assert again.entry(scene) == entry
    assert again.missing(scene, shots_of(scene, HEIGHTS)) == []
    (tmp_path / "out" / entry.files["108p"].path).unlink()
    assert again.missing(scene, shots_of(scene, HEIGHTS)) == [Shot(108)]
    assert "oa_dm5" not in str(entry) and again.damage(scene) == "one_108p.mkv is missing"
    changed = replace(scene, skip=1)
    assert again.entry(changed) is None and len(again.missing(changed, shots_of(changed, HEIGHTS))) == 3


def test_two_renders_of_the_same_frames_have_the_same_hashes(scene: SceneSpec, tmp_path: Path) -> None:
    one, two = (film_all(scene, tmp_path / name, (216, 72)).require(scene).files for name in ("a", "b"))
    for name in ("216p", "72p"):
        assert (one[name].frames_sha256, one[name].sha256) == (two[name].frames_sha256, two[name].sha256)
    assert one["216p"].frames_sha256 != one["72p"].frames_sha256


def test_the_list_is_one_that_training_reads(scene: SceneSpec, tmp_path: Path) -> None:
    library = film_all(scene, tmp_path / "out")
    library.judge(scene)
    path = library.write_footage_list([scene])
    (read,) = load_scenes(path, split="train")
    assert (read.title, read.fps, set(read.native)) == ("test/one", 60, {108, 72})
    ((pair,),) = load_pairs([read], FootageCache(tmp_path / "cache"), 3, [Degradation("native")])
    assert (pair.low.height, pair.high.height, len(pair)) == (72, 216, 40)


def test_a_scene_that_is_thrown_away_leaves_no_file_and_is_not_filmed_again(scene: SceneSpec, tmp_path: Path) -> None:
    library = film_all(scene, tmp_path / "out", (216, 108))
    files = library.require(scene).files
    for name in files:  # as if it had stood still
        path = tmp_path / "out" / files[name].path
        write_clip(path, [next(iter(read_frames(excerpt(int(name[:-1]))))).y.copy()] * 40)
    assert "stands still" in library.judge(scene).verdict()
    assert not list((tmp_path / "out").rglob("*.mkv"))
    assert library.missing(scene, shots_of(scene, (216, 108))) == [] and not library.kept(scene)
    with pytest.raises(InputError, match="holds none of these scenes"):
        library.write_footage_list([scene])


def test_a_game_that_hangs_is_ended_and_that_is_said(scene: SceneSpec, tmp_path: Path) -> None:
    hanging = replace(scene, game=replace(scene.game, play=replace(scene.game.play, command=("sleep", "60"))))
    with pytest.raises(GamesrError, match=r"frame 0 of 40: it took longer than 0.2 s \(--timeout\)"):
        list(film_to_file(hanging, Shot(72), tmp_path / "out", clock=Path(), display=":none", timeout_s=0.2))


def test_a_size_that_does_not_match_goes_and_the_others_stay(scene: SceneSpec, tmp_path: Path) -> None:
    library = film_all(scene, tmp_path / "out")
    low = [frame.y.copy() for frame in read_frames(excerpt(108))]
    write_clip(tmp_path / "out" / library.require(scene).files["108p"].path, [low[0], *low[:-1]])
    entry = library.judge(scene)
    assert entry.kept_files() == ["216p", "72p"] and "108p thrown away" in entry.verdict()
    assert {path.name for path in (tmp_path / "out").rglob("*.mkv")} == {"one_216p.mkv", "one_72p.mkv"}
    again = Library(tmp_path / "out")
    assert again.missing(scene, shots_of(scene, HEIGHTS)) == [] and again.judge(scene) == entry


def test_two_that_film_into_one_folder_keep_what_the_other_filmed(scene: SceneSpec, tmp_path: Path) -> None:
    other = replace(scene, name="other")
    one, two = Library(tmp_path / "out"), Library(tmp_path / "out")
    for library, filming in ((one, scene), (two, other)):
        *_, filmed = film_to_file(filming, Shot(72), tmp_path / "out", clock=Path(), display=":none", timeout_s=60)
        assert not isinstance(filmed, Frame)
        library.put(filming, Shot(72), filmed)
    both = Library(tmp_path / "out")
    assert both.entry(scene) is not None and both.entry(other) is not None


def test_a_file_that_was_changed_is_found(scene: SceneSpec, tmp_path: Path) -> None:
    library = film_all(scene, tmp_path / "out", (216, 72))
    assert library.damage(scene) is None
    shutil.copy(excerpt(72), tmp_path / "out" / library.require(scene).files["72p"].path)
    assert library.damage(scene) == "one_72p.mkv is not the file that was filmed"


def test_a_game_that_ends_early_leaves_nothing_behind(tmp_path: Path) -> None:
    scene = player(tmp_path, 7)
    with pytest.raises(GamesrError, match=r"test/one 72p: the game ended at frame 7 of 40: last words"):
        film_all(scene, tmp_path / "out", (72,))
    assert not [path for path in (tmp_path / "out").rglob("*") if path.is_file()]


def test_a_game_that_is_not_installed_is_named(scene: SceneSpec, tmp_path: Path) -> None:
    play = replace(scene.game.play, command=("/nowhere/game",))
    scene = replace(scene, game=replace(scene.game, play=play, packages=("thegame",)))
    with pytest.raises(GamesrError, match=r"does not start .* apt-get install thegame"):
        film_all(scene, tmp_path / "out")


def test_a_broken_manifest_is_refused(tmp_path: Path) -> None:
    (tmp_path / "manifest.json").write_text("{")
    with pytest.raises(InputError, match="not a manifest"):
        Library(tmp_path)


# ---- the command line ----


def test_list_names_every_scene(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list", "--json"]) == 0
    assert capsys.readouterr().out.count('"scene"') == len(load_games())
    assert main(["list", "openarena/oa_koth1"]) == 0
    assert "openarena/oa_koth1" in capsys.readouterr().out


def test_no_game_at_a_time_is_wrong_usage(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["render", "out", "--jobs", "0"])
    assert ended.value.code == 2 and "--jobs: 0 is not a whole number from 1" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["list", "quake"], "there is no game, scene or split 'quake'"),
        (["render", "out", "--heights", "1080", "500"], "do not fit"),
        (["check", "out"], "holds none of these scenes"),
        (["split", "out"], "holds none of these scenes"),
        (["--games", "out", "list"], "has no game file"),
    ],
)
def test_what_cannot_be_done_is_said_in_a_sentence(
    words: list[str], sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(words) == 1
    said = capsys.readouterr().err
    assert sentence in said and said.startswith("gamesr-footage: ") and said.count("\n") == 1


def test_without_an_x_server_rendering_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr("model.capture.rendering.CLOCKS", tmp_path)
    assert main(["render", str(tmp_path / "out"), "openarena/oa_koth1"]) == 1
    assert "apt-get install" in capsys.readouterr().err
