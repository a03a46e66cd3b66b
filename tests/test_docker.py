"""The images' files, as far as they can be checked without an engine: they lint, install what the gate does, start what is there."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.serving import KEY, ROOT

DOCKER = ROOT / "docker"
IMAGES = ("client", "server", "train", "footage")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
COMPOSE = yaml.safe_load((DOCKER / "compose.yaml").read_text())
SERVICES: dict[str, dict[str, Any]] = COMPOSE["services"]
LONG_RUNNING = [name for name in SERVICES if name != "sweep"]


def dockerfile(image: str) -> str:
    return (DOCKER / f"{image}.Dockerfile").read_text()


def extras(image: str) -> list[str]:
    """What the image installs the project with."""
    (found,) = re.findall(r"^RUN \S*pip install --no-cache-dir -c constraints\.txt '\.\[([\w,]+)\]'$", dockerfile(image), re.MULTILINE)
    return str(found).split(",")


def requirements(names: list[str]) -> set[str]:
    """The distributions behind extras, extras of extras included."""
    found = set(PROJECT["dependencies"])
    for name in names:
        for requirement in PROJECT["optional-dependencies"][name]:
            own = re.fullmatch(r"gamesr\[([\w,]+)\]", requirement)
            found |= requirements(own[1].split(",")) if own else {requirement}
    return {re.split(r"[<>=]", requirement)[0] for requirement in found}


def commands() -> list[list[str]]:
    """Everything that a container begins with."""
    lines = [line for image in IMAGES for line in dockerfile(image).splitlines() if re.match("CMD|ENTRYPOINT", line)]
    words = [re.findall(r'"([^"]+)"', line) for line in lines]
    words = [each for each in words if each[0] != "--help"]
    return words + [[*service.get("entrypoint", []), *service.get("command", [])] for service in SERVICES.values()]


@pytest.mark.parametrize("image", IMAGES)
def test_a_linter_has_nothing_to_say(image: str) -> None:
    linted = subprocess.run([program("hadolint"), DOCKER / f"{image}.Dockerfile"], capture_output=True, text=True)
    assert (linted.returncode, linted.stdout) == (0, "")


@pytest.mark.parametrize("image", IMAGES)
def test_images_install_what_the_gate_tests(image: str) -> None:
    """With the same constraints, and nothing but what the gate installs too."""
    assert "install --quiet -c constraints.txt -e '.[dev]'" in (ROOT / "tests/check").read_text()
    assert requirements(extras(image)) <= requirements(["dev"])
    copied = re.findall(r"^COPY (?!--from)(.+) \S+$", dockerfile(image), re.MULTILINE)
    assert all((ROOT / name).exists() for line in copied for name in line.split())
    python = PROJECT["requires-python"].removeprefix(">=")
    assert re.findall(r"^FROM (\S+)", dockerfile(image), re.MULTILINE) == [f"python:{python}-slim-bookworm"] * 2


def test_only_the_workshop_has_torch() -> None:
    assert [image for image in IMAGES if "torch" in requirements(extras(image))] == ["train"]
    assert requirements(extras("client")) == {"numpy", "av", "onnxruntime"}


@pytest.mark.parametrize("image", IMAGES)
def test_images_run_as_a_user_that_is_not_root(image: str) -> None:
    assert re.findall(r"^USER (\S+)$", dockerfile(image), re.MULTILINE) == ["10001"]


@pytest.mark.parametrize("command", commands(), ids=" ".join)
def test_what_containers_begin_with_is_installed_and_takes_these_options(command: list[str]) -> None:
    assert command[0] in {script.name for script in entry_points(group="console_scripts")}
    words = [word for word in command[1:2] if command[0] == "dask"]
    shown = subprocess.run([program(command[0]), *words, "--help"], capture_output=True, text=True, check=True).stdout
    for option in (word for word in command if word.startswith("--")):
        assert re.search(rf"{option}\b", shown), option


@pytest.mark.parametrize("name", SERVICES)
def test_containers_may_do_no_more_than_they_need(name: str) -> None:
    service = SERVICES[name]
    assert service["user"].split(":")[0] == "10001"
    assert service["read_only"] and service["tmpfs"].startswith("/tmp")
    assert service["cap_drop"] == ["ALL"] and service["security_opt"] == ["no-new-privileges:true"]
    writable = [volume for volume in service.get("volumes", []) if not volume.endswith(":ro")]
    assert writable in ([], ["store:/data"]) and "store" in COMPOSE["volumes"]
    assert all(port.startswith("127.0.0.1:") for port in service.get("ports", []))
    assert ("healthcheck" in service) == (name in LONG_RUNNING)


def test_a_scheduler_and_two_workers_are_optional() -> None:
    by_profile = {name: service.get("profiles", []) for name, service in SERVICES.items()}
    assert by_profile == {"server": [], "worker": [], "scheduler": ["dask"], "dask-worker": ["dask"], "sweep": ["sweep"]}
    assert SERVICES["dask-worker"]["scale"] == 2
    assert COMPOSE["networks"]["cluster"]["internal"]


def test_the_containers_commands_come_up_healthy(tmp_path: Path) -> None:
    """Server and worker, scheduler and Dask worker, begun here as compose.yaml begins them there, by its own health checks."""
    places = {
        "/data/": f"{tmp_path}/",
        "/clips": str(ROOT / "tests/footage"),
        "/tmp": str(tmp_path),
        "0.0.0.0": "127.0.0.1",
        "scheduler:8786": "127.0.0.1:28786",
    }
    ports = {port: str(int(port) + 20000) for port in ("8060", "8786", "8787", "8788")}

    mapping = places | ports

    def here(word: str) -> str:
        # In one go: what a place is replaced by may hold the name of another.
        return re.sub("|".join(map(re.escape, mapping)), lambda found: mapping[found[0]], word)

    with ExitStack() as stack:
        for name in LONG_RUNNING:
            service = SERVICES[name]
            command = [here(word) for word in service["command"]]
            if name == "server":
                command += ["--port", ports["8060"]]
            stack.enter_context(running([program(command[0]), *command[1:]]))
            kind, python, *check = service["healthcheck"]["test"]
            assert (kind, python) == ("CMD", "python")
            healthy([sys.executable, *map(here, check)])


@contextmanager
def running(command: list[str]) -> Iterator[None]:
    process = subprocess.Popen(command, env=os.environ | {"GAMESR_API_KEY": KEY}, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield
    finally:
        process.terminate()
        process.wait()


def healthy(check: list[str], wait_s: float = 60) -> None:
    end = time.monotonic() + wait_s
    while subprocess.run(check, capture_output=True, cwd=ROOT).returncode:
        assert time.monotonic() < end, check
        time.sleep(0.5)


def program(name: str) -> str:
    """The one beside this Python: the gate does not put its environment on the path."""
    found = shutil.which(name, path=str(Path(sys.executable).parent))
    assert found is not None, name
    return found
