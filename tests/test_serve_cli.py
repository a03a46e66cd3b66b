"""gamesr-serve as a user meets it: the sample sweep, the lines of its documentation, and what it refuses to begin."""

from __future__ import annotations

import re
import shutil
import signal
import socket
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from server import serve
from server.guards import is_loopback
from tests.serving import KEY, ROOT, Command, serving, settings

DOCUMENT = (ROOT / "docs/serve.md").read_text()


def refusal(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """The one sentence of a command that does not begin."""
    assert serve.main([str(argument) for argument in arguments]) == 1
    said = capsys.readouterr()
    assert said.out == "" and said.err.count("\n") == 1 and said.err.startswith("gamesr-serve: ")
    return said.err


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.2", "example.org"])
def test_it_listens_to_others_only_with_a_key(host: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    for key in ("", None):
        monkeypatch.delenv(serve.KEY_VARIABLE, raising=False) if key is None else monkeypatch.setenv(serve.KEY_VARIABLE, key)
        assert "set GAMESR_API_KEY" in refusal(capsys, "--host", host)
    monkeypatch.setenv(serve.KEY_VARIABLE, "short")
    assert "16 printable characters" in refusal(capsys, "--host", host)
    of = serve.settings_of(serve.parser().parse_args(["--host", host]), KEY)
    assert not of.loopback and KEY not in repr(of)


@pytest.mark.parametrize("host", ["127.0.0.1", "127.1.2.3", "::1", "localhost"])
def test_loopback_needs_none(host: str) -> None:
    assert serve.settings_of(serve.parser().parse_args(["--host", host]), None).loopback
    assert is_loopback(host)  # what it prints is let in


@pytest.mark.parametrize("host", ["", "0.0.0.0", "192.168.1.2", "127.0.0.1.example.org", "localhost.example.org", "::2"])
def test_what_is_no_loopback(host: str) -> None:
    assert not is_loopback(host)


def test_what_it_cannot_use_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = tmp_path / "text"
    text.write_text("no database " * 1000)
    folders = ("--data", tmp_path / "data")
    assert "cannot be read" in refusal(capsys, "--store", text, *folders)
    assert "cannot write into" in refusal(capsys, "--data", text)
    assert "is not a folder" in refusal(capsys, "--clips", text, *folders)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        sentence = refusal(capsys, "--port", taken.getsockname()[1], *folders, "--store", tmp_path / "store")
        assert "cannot listen on 127.0.0.1" in sentence
    (tmp_path / "data/service.sqlite").write_bytes((ROOT / "server/demo/sweep.sqlite").read_bytes())
    assert "not of this version of gamesr-serve" in refusal(capsys, *folders, "--store", tmp_path / "store")


def test_a_public_name_needs_a_key_and_is_a_name(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(serve.KEY_VARIABLE, raising=False)
    assert "set GAMESR_API_KEY" in refusal(capsys, "--public-name", "gamesr.example.com")
    for name in ("https://gamesr.example.com", "gamesr.example.com/sr", "me@gamesr.example.com", "a b", "", "[", "gamesr.example.com?x"):
        monkeypatch.setenv(serve.KEY_VARIABLE, KEY)  # which the command takes out of its environment
        assert "is not the name of a host" in refusal(capsys, "--public-name", name)
    for name in ("gamesr.example.com", "Gamesr.Example.com:8443", "[2001:db8::1]:8443"):
        of = serve.settings_of(serve.parser().parse_args(["--public-name", name]), KEY)
        assert of.public_name == name.lower() and of.loopback


@pytest.mark.parametrize("option", ["store", "data", "clips"])
def test_the_demo_takes_no_others_files(tmp_path: Path, capsys: pytest.CaptureFixture[str], option: str) -> None:
    assert f"leave out --{option}, or --demo" in refusal(capsys, "--demo", f"--{option}", tmp_path / "mine")


@pytest.mark.parametrize("port", ["abc", "65536", "-1"])
def test_what_is_no_port_is_said(port: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit_:
        serve.main([f"--port={port}"])
    assert exit_.value.code == 2 and f"{port} is not a whole number from 0 to 65535" in capsys.readouterr().err


def test_every_figure_for_prometheus_is_in_the_documentation(tmp_path: Path) -> None:
    with serving(settings(tmp_path)) as client:
        client.get("/health")
        names = re.findall(r"^# TYPE (\w+)", client.get("/metrics").text, re.MULTILINE)
    missing = [name for name in names if f"`{name}`" not in DOCUMENT and not name.endswith("_created")]
    assert len(names) >= 10 and missing == []


def test_an_address_that_cannot_be_printed_is_one_sentence() -> None:
    command = [sys.executable, "-c", "from server.serve import main; raise SystemExit(main())", "--demo", "--no-runner", "--port", "0"]
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, cwd=ROOT, check=False)
    assert done.returncode == 1 and done.stderr == "gamesr-serve: [Errno 28] No space left on device\n"


def test_every_line_of_the_documentation_works_and_there_is_one_for_every_address(tmp_path: Path) -> None:
    (lines,) = re.findall(r"```bash\n(.*?)```", DOCUMENT, re.DOTALL)
    (tmp_path / "tests").symlink_to(ROOT / "tests")
    with Command("--demo", GAMESR_API_KEY=KEY) as command:
        script = lines.replace("http://127.0.0.1:8060", command.url)
        bash = shutil.which("bash")
        assert bash is not None
        done = subprocess.run(
            [bash, "-euxo", "pipefail", "-c", script],
            cwd=tmp_path,
            env={"GAMESR_API_KEY": KEY, "PATH": "/usr/local/bin:/usr/bin:/bin"},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr[-3000:]
        for process in (own := psutil.Process(command.pid)).children(recursive=True):
            assert KEY not in process.environ().values() and KEY in own.environ().values()
        assert '"state":"done"' in done.stdout and (tmp_path / "frame.png").read_bytes().startswith(b"\x89PNG")
        metrics = command.client.get("/metrics").text
        for path, operations in command.client.get("/api/v1/openapi.json").json()["paths"].items():
            for method in operations:
                route = path.removeprefix("/api/v1")
                found = re.findall(rf'method="{method.upper()}",route="{re.escape(route)}",status="(\d+)"', metrics)
                assert found and all(status.startswith("2") for status in found), (method, path, found)
        assert command.end(signal.SIGTERM) == 0


def test_the_demo_leaves_nothing_behind_and_changes_nothing_that_ships(tmp_path: Path) -> None:
    before = {path: path.read_bytes() for path in serve.DEMO.iterdir()}
    with Command("--demo", "--no-runner", TMPDIR=str(tmp_path)) as command:
        assert list(tmp_path.glob("gamesr-serve-*"))
        (sweep,) = command.client.get("/api/v1/sweeps").json()["sweeps"]
        assert sweep["progress"]["state"] == "done" and sweep["clips"][0]["source"] == "oa_koth1.mp4"
        assert f"DEMO={sweep['id']} " in DOCUMENT
        assert [clip["name"] for clip in command.client.get("/api/v1/clips").json()["clips"]] == ["oa_koth1.mp4"]
        assert command.end(signal.SIGINT) == 0
    assert not list(tmp_path.glob("gamesr-*")) and {path: path.read_bytes() for path in serve.DEMO.iterdir()} == before
