"""The names of what is written: long ones, links, a text for a path. One rule for all that writes files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from client import cli
from client.compare import ComparisonWriter
from client.errors import OutputError
from client.play_sink import Y4mSink
from client.sink import FileSink
from client.video import VideoSource
from client.whole_file import write_whole
from tests.moving import picture

MakeClip = Callable[..., Path]
Write = Callable[[Path, bool], None]


@pytest.fixture(params=["film.mp4", "film.y4m", "wipe.png"])
def written(request: pytest.FixtureRequest, make_clip: MakeClip, tmp_path: Path) -> tuple[Path, Write]:
    """A path that is free, and what writes to such a path as one of the commands does: the path, and whether it is forced to."""
    clip = make_clip()

    def write(path: Path, force: bool) -> None:
        with VideoSource(clip) as source:
            if path.suffix == ".mp4":
                with FileSink(path, source, force=force) as film:
                    film.write(picture(0))
            elif path.suffix == ".y4m":
                with Y4mSink(path, force=force) as raw:
                    raw.write(picture(0))
            else:
                with ComparisonWriter(path, source, force=force) as comparison:
                    comparison.add(picture(0), picture(1))

    return tmp_path / request.param, write


def test_a_name_of_as_many_bytes_as_there_may_be(written: tuple[Path, Write]) -> None:
    path, write = written
    for letter in ("x", "\u00e9", "\N{GRINNING FACE}"):
        room = 255 - len(path.suffix)
        longest = path.with_name(letter * (room // len(letter.encode())) + path.suffix)
        write(longest, False)
        assert longest.is_file()
    assert not list(path.parent.glob(".*"))


@pytest.mark.parametrize("there", [True, False])
def test_a_link_is_replaced_by_nothing_and_followed_with_force(written: tuple[Path, Write], there: bool) -> None:
    link, write = written
    (link.parent / "elsewhere").mkdir()
    target = link.parent / "elsewhere" / f"target{link.suffix}"
    if there:
        target.write_text("mine")
    link.symlink_to(target)
    with pytest.raises(OutputError, match="exists"):
        write(link, False)
    assert link.is_symlink() and target.exists() == there
    write(link, True)
    assert link.is_symlink() and target.stat().st_size > 100 and list(target.parent.iterdir()) == [target]


def test_a_link_into_a_folder_that_is_missing(written: tuple[Path, Write]) -> None:
    link, write = written
    link.symlink_to(link.parent / "none" / link.name)
    with pytest.raises(OutputError, match=r"the folder .*none does not exist"):
        write(link, True)


def test_a_description_lands_where_its_link_points(tmp_path: Path) -> None:
    link, target = tmp_path / "link.sdp", tmp_path / "target.sdp"
    link.symlink_to(target)
    write_whole(link, "v=0")
    assert link.is_symlink() and target.read_text() == "v=0"


def test_a_link_to_itself_is_one_sentence(make_clip: MakeClip, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    loop = tmp_path / "loop.mp4"
    loop.symlink_to(loop)
    assert cli.main([str(make_clip()), "-o", str(loop)]) == 1
    assert capsys.readouterr().err == f"gamesr-upscale: {loop} exists: name another file, or replace it with --force\n"


def test_a_text_does_for_a_path(make_clip: MakeClip, tmp_path: Path) -> None:
    with VideoSource(make_clip()) as source, FileSink(str(tmp_path / "out.mp4"), source) as sink:  # type: ignore[arg-type]
        sink.write(picture(0))
    assert (tmp_path / "out.mp4").is_file()
