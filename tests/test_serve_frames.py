"""The frame viewer's pictures: what a player would see of a frame, computed once, bounded, and never more than was asked."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from PIL import Image

import server.stills
from client.cloud import CloudSettings, area_downscale, through_codec
from client.models import find_model
from client.rgb import to_rgb
from client.upscaler import OnnxUpscaler
from client.video import read_frames
from server.settings import Settings
from server.still import Still
from server.stills import Stills, StillsBusyError
from tests.serving import serving, settings, until

FRAMES = "/api/v1/frames/clip.mkv"


@pytest.fixture
def of(make_clip: Callable[..., Path], tmp_path: Path) -> Settings:
    (tmp_path / "clips").mkdir()
    make_clip("clips/clip.mkv", width=96, height=72)
    return settings(tmp_path, clips=tmp_path / "clips")


@pytest.fixture
def client(of: Settings) -> Iterator[httpx.Client]:
    with serving(of) as client:
        yield client


def picture(client: httpx.Client, frame: int, **query: Any) -> np.ndarray:
    """Uint8 (H, W, 3), once it is there."""

    def asked() -> httpx.Response | None:
        answer = client.get(f"{FRAMES}/{frame}", params=query)
        assert answer.status_code in (200, 202), answer.text
        return answer if answer.status_code == 200 else None

    answer = until(asked)
    assert answer.headers["content-type"] == "image/png" and "max-age" in answer.headers["cache-control"] and answer.headers["etag"]
    with Image.open(io.BytesIO(answer.content)) as image:
        return np.asarray(image)


def test_a_clip_without_a_container_has_frames_to_look_at(client: httpx.Client, of: Settings, make_clip: Callable[..., Path]) -> None:
    make_clip("clips/raw.h264", width=96, height=72)
    clip = client.get("/api/v1/clips/raw.h264").json()
    assert (clip["frames"], clip["duration_s"]) == (12, 0.4)
    until(lambda: client.get("/api/v1/frames/raw.h264/11").status_code == 200)
    assert client.get("/api/v1/frames/raw.h264/12").status_code == 404


def test_a_picture_is_that_of_the_sweep(client: httpx.Client, of: Settings, tmp_path: Path) -> None:
    clip = list(read_frames(tmp_path / "clips/clip.mkv"))
    first = client.get(f"{FRAMES}/5")
    assert first.status_code == 202 and first.headers["retry-after"] == "1" and "is being computed" in first.json()["detail"]
    assert np.array_equal(picture(client, 5), to_rgb(clip[5]))

    encoder = CloudSettings(200, 30)
    assert np.array_equal(picture(client, 5, picture="none", bitrate_kbps=200), to_rgb(list(through_codec(clip, encoder))[5]))
    for name in ("bicubic", "gamesr"):
        upscaler = OnnxUpscaler(find_model(name, 2), threads=1)
        state = upscaler.initial_state(36, 48)
        for low in list(through_codec([area_downscale(frame, 2) for frame in clip], encoder))[:6]:
            upscaled, state = upscaler.step(low, state)
        shown = picture(client, 5, picture=name, low_height=36, bitrate_kbps=200)
        assert np.abs(shown.astype(int) - to_rgb(upscaled)).max() <= 2  # a code value in the planes: as many threads as there are
    kept = sorted(path.name for path in of.frames.iterdir())
    assert len(kept) == 4 and client.get(f"{FRAMES}/5").status_code == 200
    assert sorted(path.name for path in of.frames.iterdir()) == kept

    every_other = list(through_codec(clip[::2], CloudSettings(200, 15)))
    assert np.array_equal(picture(client, 3, picture="none", bitrate_kbps=200, fps=15), to_rgb(every_other[3]))


def test_a_picture_that_the_caller_has_is_not_sent_again(client: httpx.Client) -> None:
    picture(client, 5)
    first = client.get(f"{FRAMES}/5")
    for known in (first.headers["etag"], f'"another", W/{first.headers["etag"]}'):
        again = client.get(f"{FRAMES}/5", headers={"If-None-Match": known})
        assert (again.status_code, again.content) == (304, b"")
        assert [again.headers[name] for name in ("etag", "cache-control")] == [first.headers[name] for name in ("etag", "cache-control")]
    assert client.get(f"{FRAMES}/5", headers={"If-None-Match": '"another"'}).content == first.content
    assert client.head(f"{FRAMES}/5").headers["etag"] == first.headers["etag"]


@pytest.mark.parametrize(
    ("path", "query", "status", "sentence"),
    [
        ("none.mkv/0", {}, 404, "no clip none.mkv"),
        ("clip.mkv/12", {}, 404, "has no frame 12"),
        ("clip.mkv/6", {"fps": 15}, 404, "has no frame 6"),
        ("clip.mkv/600", {}, 422, "up to 599"),
        ("clip.mkv/-1", {}, 422, "greater than"),
        ("clip.mkv/0", {"picture": "none"}, 422, "needs bitrate_kbps"),
        ("clip.mkv/0", {"picture": "bicubic", "bitrate_kbps": 200}, 422, "one of 36, 24"),
        ("clip.mkv/0", {"picture": "bicubic", "bitrate_kbps": 200, "low_height": 72}, 422, "one of 36, 24"),
        ("clip.mkv/0", {"picture": "sharpest", "bitrate_kbps": 200, "low_height": 36}, 422, "no model sharpest"),
        ("clip.mkv/0", {"picture": "../x", "bitrate_kbps": 200, "low_height": 36}, 422, "pattern"),
        ("clip.mkv/0", {"fps": 7}, 422, "no whole part"),
        ("%2e%2e%2fstore.sqlite/0", {}, 404, "Not Found"),
    ],
)
def test_what_is_not_there_is_said(client: httpx.Client, path: str, query: dict[str, Any], status: int, sentence: str) -> None:
    answer = client.get(f"/api/v1/frames/{path}", params=query)
    assert answer.status_code == status and sentence in answer.json()["detail"], answer.text


def still(index: int, clip: Path = Path("clip.mkv")) -> Still:
    return Still(clip, "sha256", index, 1, 30, None, 1, None, 10)


def test_what_waits_and_what_is_kept_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    begun = []

    def rendered(function: object, asked: Still, what: str) -> bytes:
        begun.append(asked.index)
        until(lambda: goes_on)
        return bytes(100)

    goes_on: list[bool] = []
    monkeypatch.setattr(server.stills, "in_fresh_process", rendered)
    stills = Stills(tmp_path, most=2, kept_bytes=250)
    assert [stills.find(still(index)) for index in (0, 1, 0)] == [None] * 3
    with pytest.raises(StillsBusyError):
        stills.find(still(2))
    goes_on.append(True)
    for index in (0, 1, 2, 3):
        until(lambda index=index: stills.find(still(index)))
    until(lambda: stills.waiting() == 0)
    assert begun == [0, 1, 2, 3] and len(list(tmp_path.glob("*.png"))) == 2


def test_a_frame_that_fails_is_said_once_and_can_be_asked_again(tmp_path: Path, make_clip: Callable[..., Path]) -> None:
    clip = make_clip("clip.mkv", frames=3)
    with serving(settings(tmp_path, clips=tmp_path)) as client:
        assert client.get("/api/v1/clips/clip.mkv").json()["frames"] == 3
        content, status = clip.read_bytes(), clip.stat()
        clip.write_bytes(bytes(len(content)))
        server.stills.os.utime(clip, ns=(status.st_atime_ns, status.st_mtime_ns))
        assert client.get(f"{FRAMES}/1").status_code == 202
        answer = until(lambda: (found := client.get(f"{FRAMES}/1")).status_code != 202 and found)
        assert answer.status_code == 422 and "is not a video file" in answer.text and str(tmp_path) not in answer.text
        clip.write_bytes(content)
        assert picture(client, 1).shape == (48, 64, 3)
