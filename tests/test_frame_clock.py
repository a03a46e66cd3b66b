"""The library that films a game: its clock and dice in a real process, its conversion against plain arithmetic. Needs a C compiler."""

from __future__ import annotations

import ctypes
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from model.capture.filming import SOURCE, build_frame_clock

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler on this machine: the frame clock cannot be built")


@pytest.fixture(scope="module")
def clock(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_frame_clock(tmp_path_factory.mktemp("clock"))


SCRIPT = """
import ctypes, json, sys, threading, time
libc = ctypes.CDLL(None)
before = time.monotonic()
time.sleep(1000)
libc.usleep(500_000)
slept = time.monotonic() - before
libc.srand(int(sys.argv[1]))
other = []
thread = threading.Thread(target=lambda: other.append(time.monotonic()))
thread.start(), thread.join()
print(json.dumps([slept, libc.rand(), libc.random(), time.monotonic(), time.time(), other[0]]))
"""


def run(clock: Path, process: str, seed: int) -> list[float]:
    environment = {**os.environ, "LD_PRELOAD": str(clock), "GAMESR_PROCESS": process}
    command = [str(Path(sys.executable).resolve()), "-I", "-c", SCRIPT, str(seed)]
    return json.loads(subprocess.run(command, env=environment, capture_output=True, check=True, timeout=30).stdout)


def test_sleep_moves_the_clock_and_time_and_dice_are_the_same_in_every_run(clock: Path) -> None:
    name = Path(sys.executable).resolve().name
    one, two = run(clock, name, 1), run(clock, name, 2)
    assert one[0] == pytest.approx(1000.5, abs=0.01)  # and the call above returned at once
    assert one[:5] == two[:5]
    assert one[3] == pytest.approx(2000.5, abs=0.1) and one[4] == pytest.approx(1.7e9 + 1000.5, abs=0.1)
    assert one[5] != two[5]  # other threads keep the machine's time


def test_a_process_of_another_name_is_left_alone(clock: Path) -> None:
    environment = {**os.environ, "LD_PRELOAD": str(clock), "GAMESR_PROCESS": "ioquake3"}
    code = "import time; a = time.monotonic(); time.sleep(0.01); assert time.monotonic() - a < 10; assert time.time() > 1.7e9 + 1e6"
    subprocess.run([sys.executable, "-c", code], env=environment, check=True, timeout=30)


def test_the_library_is_built_once(clock: Path) -> None:
    made = clock.stat().st_mtime_ns
    assert build_frame_clock(clock.parent) == clock and clock.stat().st_mtime_ns == made


@pytest.mark.parametrize("supersample", [1, 2, 3])
def test_pictures_become_left_sited_bt709_within_a_code_value(tmp_path: Path, supersample: int) -> None:
    width, height = 24, 16
    library = tmp_path / "open.so"
    (tmp_path / "open.c").write_text(
        f'#include "{SOURCE}"\n'
        "void open_reduce(const uint8_t *a, uint16_t *b, int w, int h, int s) { reduce(a, b, w, h, s); }\n"
        "void open_to_i420(const uint16_t *a, uint8_t *b, int w, int h, int n, int *l) { to_i420(a, b, w, h, n, l); }\n"
    )
    subprocess.run(["cc", "-O3", "-shared", "-fPIC", "-o", library, tmp_path / "open.c", "-ldl"], check=True)
    open_clock = ctypes.CDLL(str(library))
    rng = np.random.default_rng(5)
    bgra = rng.integers(0, 256, (height * supersample, width * supersample, 4), dtype=np.uint8)
    bgra[:4, :4] = 255
    bgra[-4:, :4] = 0
    sums, out = np.zeros((3, height, width), np.uint16), np.zeros(width * height * 3 // 2, np.uint8)
    lines = np.zeros((3, width), np.int32)
    pointers = [array.ctypes.data_as(ctypes.c_void_p) for array in (bgra, sums, out, lines)]
    open_clock.open_reduce(pointers[0], pointers[1], width * supersample, height * supersample, supersample)
    open_clock.open_to_i420(pointers[1], pointers[2], width, height, supersample**2, pointers[3])

    upright = bgra[::-1, :, 2::-1].astype(np.float64)  # R'G'B', top row first
    rgb = upright.reshape(height, supersample, width, supersample, 3).mean(axis=(1, 3)) / 255
    luma = 16 + 219 * (rgb @ [0.2126, 0.7152, 0.0722])
    left = np.concatenate([rgb[:, :1], rgb[:, 1:-1:2]], axis=1)
    cosited = (left + 2 * rgb[:, ::2] + rgb[:, 1::2]) / 4
    small = (cosited[::2] + cosited[1::2]) / 2
    grey = small @ [0.2126, 0.7152, 0.0722]
    planes = [luma, 128 + 224 * (small[..., 2] - grey) / 1.8556, 128 + 224 * (small[..., 0] - grey) / 1.5748]
    expected = np.concatenate([plane.ravel() for plane in planes])
    assert np.abs(out - expected).max() <= 0.51  # rounded once
