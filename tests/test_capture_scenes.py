"""What a game's file says of its scenes, and the games that ship. No game is needed."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path

import pytest

from client.errors import InputError
from model.capture.games import GAMES, SPLITS, WORDS_OF_A_RUN, choose, load_games
from model.capture.rendering import shots_of
from tests.capturing import write_game

# ---- what ships ----


def test_the_games_that_ship_split_by_scene_into_enough_of_each() -> None:
    scenes = load_games()
    assert len({scene.title for scene in scenes}) == len(scenes) >= 30
    assert sum(scene.frames for scene in scenes) >= 5000
    for game in ("openarena", "supertuxkart"):
        assert {scene.split for scene in choose(scenes, [game])} == set(SPLITS)
    assert {scene.split for scene in scenes if scene.antialiased} == set(SPLITS)


def test_every_scene_that_plays_a_demo_has_one_and_all_of_them_are_small() -> None:
    demos = [scene.demo for scene in load_games() if scene.demo is not None]
    assert demos and all(demo.is_file() for demo in demos)
    assert sum(demo.stat().st_size for demo in demos) < 4 * 2**20


def test_every_word_of_every_scene_is_known() -> None:
    for scene in load_games():
        for run in (scene.game.play, scene.game.record):
            for text in (*run.command, *run.files, *run.files.values(), *run.environment.values()) if run else ():
                scene.fill(text, dict.fromkeys(WORDS_OF_A_RUN, 1))


def test_a_game_ships_whole() -> None:
    packages = tomllib.loads((GAMES.parents[2] / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]["model.capture"]
    shipped = {path for pattern in packages for path in GAMES.parent.glob(pattern)}
    assert {path for path in GAMES.parent.rglob("*") if path.is_file() and path.suffix not in (".py", ".pyc")} == shipped


# ---- a game's file ----


def test_a_scene_says_of_itself_what_its_game_does_not(tmp_path: Path) -> None:
    one, two = load_games(write_game(tmp_path))
    assert (one.title, one.split, one.fill("$colour", {})) == ("test/one", "train", "red")
    assert (two.title, two.split, two.fill("$colour", {})) == ("test/two", "test", "blue")
    assert [shot.name for shot in shots_of(one, [108, 216])] == ["216p", "108p"]
    assert [shot.name for shot in shots_of(two, [108, 216])] == ["216p", "108p", "216p_aa"]
    assert [shot.name for shot in shots_of(replace(two, native=False), [108, 216])] == ["216p", "216p_aa"]
    assert [shot.name for shot in shots_of(two, [216])] == ["216p"]  # nothing small to be held against the other


def test_what_is_filmed_decides_the_digest_and_nothing_else(tmp_path: Path) -> None:
    def digests(**changes: str) -> list[str]:
        return [scene.digest() for scene in load_games(write_game(tmp_path, **changes))]

    one, two = digests()
    assert one != two
    assert digests(title='"Other"', licence='"some"', packages='["x"]') == [one, two]
    assert digests(colour='"green"') == [digests(colour='"green"')[0], two] != [one, two]
    for change in ({"frames": "41"}, {"skip": "1"}, {"fps": "30"}):
        assert not {one, two} & set(digests(**change))


@pytest.mark.parametrize(
    "changes", [{"fps": '"many"'}, {"world": "[0, 0, 1]"}, {"world": "[0, 0.5, 1, 0.4]"}, {"frames": "[]"}, {"title": "unquoted"}]
)
def test_a_game_file_that_is_wrong_is_named(tmp_path: Path, changes: dict[str, str]) -> None:
    with pytest.raises(InputError, match=r"test\.toml is not a game file"):
        load_games(write_game(tmp_path, **changes))


@pytest.mark.parametrize("name", ["../climb", "a b", "", "/etc"])
def test_a_scene_has_a_plain_name(tmp_path: Path, name: str) -> None:
    text = (write_game(tmp_path) / "test.toml").read_text().replace('"one"', f'"{name}"')
    (tmp_path / "test.toml").write_text(text)
    with pytest.raises(InputError, match="not a plain name"):
        load_games(tmp_path)


def test_a_map_cannot_be_in_two_splits(tmp_path: Path) -> None:
    text = (write_game(tmp_path) / "test.toml").read_text().replace('"two"', '"one"')
    (tmp_path / "test.toml").write_text(text)
    with pytest.raises(InputError, match="names a scene twice"):
        load_games(tmp_path)


def test_scenes_are_chosen_by_game_name_and_split(tmp_path: Path) -> None:
    scenes = load_games(write_game(tmp_path))
    assert [s.name for s in choose(scenes, [])] == [s.name for s in choose(scenes, ["test/two", "train"])] == ["one", "two"]
    assert [s.name for s in choose(scenes, ["test/two"])] == ["two"]
    with pytest.raises(InputError, match="no game, scene or split 'one'"):
        choose(scenes, ["one"])
