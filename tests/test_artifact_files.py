"""What gamesr-export and gamesr-quantize refuse to write, before they do any work; and that what they write is whole."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import onnx
import pytest

from client import models
from client.errors import OutputError
from client.upscaler import OnnxUpscaler
from model.artifact_files import new_artifacts, write_artifact
from model.export_cli import main as export_main
from model.quantize_cli import main as quantize_main
from tests.conftest import tiny_model

ModelFile = Callable[..., Path]


@pytest.mark.parametrize("name", ["mine", "mine 2.1-b", "x" * 64])
def test_a_model_of_a_name_that_is_taken_is_found_and_read(
    name: str, model_file: ModelFile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(models, "WEIGHTS", tmp_path)
    for scale, path in zip((2, 3), new_artifacts(name, (2, 3), tmp_path, source=Path("bicubic"), force=False), strict=True):
        model_file(path.name, metadata={"name": name}, scale=scale)
        found = models.find_model(name, scale)
        spec = OnnxUpscaler(found, threads=1).spec
        assert found == path and (spec.name, spec.scale) == (name, scale)


@pytest.mark.parametrize("name", ["", "x" * 65, "über", "two\nlines", "no/where", "folder/", "/", "no\\where", "mine.onnx"])
def test_any_other_name_is_refused(name: str, tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    with pytest.raises(OutputError, match="cannot be a model's name") as error:
        new_artifacts(name, [2], tmp_path, source=Path("bicubic"), force=True)
    assert "\n" not in str(error.value)


@pytest.fixture
def idle(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever work a command does fails the test."""

    def work(*_: object, **__: object) -> None:
        pytest.fail("the work has begun")

    monkeypatch.setattr("model.export_cli.export_baseline", work)
    monkeypatch.setattr("model.quantize_cli.quantize", work)


@pytest.fixture(params=["export", "quantize"])
def command(request: pytest.FixtureRequest, idle: None, model_file: ModelFile, tmp_path: Path) -> Callable[..., int]:
    """A command that is given a name and options, and writes into the folder `out`."""
    (tmp_path / "out").mkdir()
    into = ["--folder", str(tmp_path / "out")]
    if request.param == "export":
        return lambda name, *options: export_main(["lanczos", name, *into, *options])
    model = str(model_file(scale=3))
    return lambda name, *options: quantize_main([model, name, "clip.mkv", *into, *options])


@pytest.mark.parametrize("there", ["mine_x3.onnx", "mine_x3.md"])
def test_a_file_that_is_there_is_left_before_any_work(
    there: str, command: Callable[..., int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "out" / there
    file.write_text("somebody's")
    assert command("mine") == 1
    assert capsys.readouterr().err.endswith(f": {file} exists: choose another name, or replace it with --force\n")
    assert file.read_text() == "somebody's" and list(file.parent.iterdir()) == [file]
    for name, option in (("mine", "--force"), ("another", "--debug")):
        with pytest.raises(pytest.fail.Exception, match="the work has begun"):
            command(name, option)


def test_names_and_folders_are_looked_at_before_any_work(
    command: Callable[..., int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    for arguments, sentence in (
        (["über"], "'über' cannot be a model's name"),
        (["mine", "--folder", str(tmp_path / "nowhere")], "nowhere is not a folder"),
        (["mine", "--folder", str(tmp_path / "file")], "file is not a folder"),
    ):
        assert command(*arguments, "--force") == 1
        said = capsys.readouterr().err
        assert sentence in said and said.count("\n") == 1


@pytest.mark.parametrize("link", [False, True])
def test_a_model_is_never_written_over_itself(
    link: bool, idle: None, model_file: ModelFile, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = model_file("mine_x2.onnx")
    before = model.read_bytes()
    folder = tmp_path / "linked"
    if link:
        folder.symlink_to(tmp_path)
    for options in ([], ["--force"]):
        assert quantize_main([str(model), "mine", "clip.mkv", "--folder", str(folder if link else tmp_path), *options]) == 1
        assert capsys.readouterr().err.endswith("mine_x2.onnx: it is the input, so choose another name\n")
    assert model.read_bytes() == before


def test_what_ships_is_not_replaced_by_a_command_that_does_not_say_so(idle: None, capsys: pytest.CaptureFixture[str]) -> None:
    assert export_main(["bicubic", "bicubic"]) == 1
    assert quantize_main([str(models.find_model("live", 2)), "live-int8", "clip.mkv"]) == 1
    assert capsys.readouterr().err.count("exists: choose another name, or replace it with --force\n") == 2


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_an_artifact_takes_the_place_of_another_page_and_all(tmp_path: Path) -> None:
    for model, page in ((tiny_model(gain=0.5), "one"), (tiny_model(gain=0.9), "another")):
        write_artifact(model, tmp_path / "mine_x2.onnx", page)
        assert files(tmp_path) == {"mine_x2.onnx": model.SerializeToString(), "mine_x2.md": page.encode()}
    write_artifact(model, tmp_path / "mine_x2.onnx", None)
    assert files(tmp_path) == {"mine_x2.onnx": model.SerializeToString()}


@pytest.mark.parametrize("stopped_by", [OSError(28, "No space left on device"), KeyboardInterrupt()], ids=["full", "interrupted"])
@pytest.mark.parametrize("half", ["artifact", "page"])
def test_what_cannot_be_written_leaves_everything_as_it_was(
    half: str, stopped_by: BaseException, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_artifact(tiny_model(), tmp_path / "mine_x2.onnx", "mine")
    before = files(tmp_path)

    def save(model: onnx.ModelProto, path: str) -> None:
        Path(path).write_bytes(model.SerializeToString()[:100])
        raise stopped_by

    def write_text(path: Path, text: str) -> None:
        path.write_bytes(text.encode()[:2])
        raise stopped_by

    if half == "artifact":
        monkeypatch.setattr(onnx, "save", save)
    else:
        monkeypatch.setattr(Path, "write_text", write_text)
    for name in ("mine", "new"):
        with pytest.raises(type(stopped_by)):
            write_artifact(tiny_model(gain=0.9), tmp_path / f"{name}_x2.onnx", "another")
    assert files(tmp_path) == before


def test_what_is_no_file_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "mine_x2.onnx").mkdir()
    with pytest.raises(OutputError, match="is not a file"):
        new_artifacts("mine", [2], tmp_path, source=Path("bicubic"), force=True)
