"""Tiny artifacts, tiny clips and windows without a screen, made where they are needed."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import onnx
import pytest
from av.video.frame import VideoFrame
from onnx import TensorProto, helper

from client.frames import Frame
from client.tiers import TieredUpscaler
from client.video import to_av_frame
from client.window import Window

os.environ.setdefault("OMP_NUM_THREADS", "1")  # torch's threads cost more than they bring on pictures of this size

WIDTH, HEIGHT, FRAMES, FPS = 64, 48, 12, 30


def tiny_metadata(scale: int = 2, stateful: bool = True) -> dict[str, str]:
    state = [{"input": "h_in", "output": "h_out", "channels": 1, "divisor": 2, "dtype": "float32"}] if stateful else []
    return {
        "gamesr_format": "1",
        "name": "tiny",
        "scale": str(scale),
        "size_multiple": "2",
        "precision": "float32",
        "state": json.dumps(state),
        "card": json.dumps({"footage": "none"}),
    }


def tiny_model(scale: int = 2, stateful: bool = True, gain: float = 0.5) -> onnx.ModelProto:
    """Nearest neighbour, with an eighth of a state h_out = gain * h_in + (2x2 mean of y) mixed into the luma.

    With a gain of 1e30 the state overflows at the third frame.
    """
    planes = ("y", "u", "v")
    inputs = [helper.make_tensor_value_info(p, TensorProto.UINT8, [1, 1, f"h_{p}", f"w_{p}"]) for p in planes]
    outputs = [helper.make_tensor_value_info(f"{p}_up", TensorProto.UINT8, [1, 1, f"hh_{p}", f"ww_{p}"]) for p in planes]
    constants = {"up": [1, 1, scale, scale], "up_state": [1, 1, 2 * scale, 2 * scale], "gain": gain, "share": 0.125, "rest": 0.875}
    initializers = [helper.make_tensor(k, TensorProto.FLOAT, np.shape(v), np.ravel(v).tolist()) for k, v in constants.items()]
    initializers += [helper.make_tensor("low", TensorProto.FLOAT, [], [0.0]), helper.make_tensor("high", TensorProto.FLOAT, [], [255.0])]

    def resize(source: str, scales: str, target: str) -> onnx.NodeProto:
        return helper.make_node(
            "Resize",
            [source, "", scales],
            [target],
            mode="nearest",
            coordinate_transformation_mode="asymmetric",
            nearest_mode="floor",
        )

    nodes = [resize("u", "up", "u_up"), resize("v", "up", "v_up")]
    if stateful:
        state_shape = [1, 1, "hs", "ws"]
        inputs.append(helper.make_tensor_value_info("h_in", TensorProto.FLOAT, state_shape))
        outputs.append(helper.make_tensor_value_info("h_out", TensorProto.FLOAT, state_shape))
        outputs.append(helper.make_tensor_value_info("state_sum", TensorProto.FLOAT, []))
        nodes += [
            helper.make_node("Cast", ["y"], ["yf"], to=TensorProto.FLOAT),
            helper.make_node("AveragePool", ["yf"], ["mean"], kernel_shape=[2, 2], strides=[2, 2]),
            helper.make_node("Mul", ["h_in", "gain"], ["kept"]),
            helper.make_node("Add", ["kept", "mean"], ["h_out"]),
            helper.make_node("ReduceSum", ["h_out"], ["state_sum"], keepdims=0),
            resize("yf", "up", "base"),
            resize("h_out", "up_state", "memory"),
            helper.make_node("Mul", ["base", "rest"], ["part"]),
            helper.make_node("Mul", ["memory", "share"], ["remembered"]),
            helper.make_node("Add", ["part", "remembered"], ["mixed"]),
            helper.make_node("Clip", ["mixed", "low", "high"], ["clipped"]),
            helper.make_node("Cast", ["clipped"], ["y_up"], to=TensorProto.UINT8),
        ]
    else:
        nodes.append(resize("y", "up", "y_up"))
    graph = helper.make_graph(nodes, "tiny", inputs, outputs, initializers)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    helper.set_model_props(model, tiny_metadata(scale, stateful))
    return model


@pytest.fixture
def model_file(tmp_path: Path) -> Callable[..., Path]:
    """Saves a tiny artifact; the arguments are those of `tiny_model`, `metadata` replaces entries (None removes one)."""

    def save(name: str = "tiny.onnx", metadata: dict[str, str | None] | None = None, **build: object) -> Path:
        model = tiny_model(**build)
        entries = {prop.key: prop.value for prop in model.metadata_props} | (metadata or {})
        del model.metadata_props[:]
        helper.set_model_props(model, {key: value for key, value in entries.items() if value is not None})
        path = tmp_path / name
        onnx.save(model, str(path))
        return path

    return save


@pytest.fixture
def tiers(model_file: Callable[..., Path]) -> TieredUpscaler:
    """Two recurrent tiers with different pictures and one without a state."""
    files = [model_file("a.onnx", gain=0.9), model_file("b.onnx", gain=0.3), model_file("c.onnx", stateful=False)]
    made = TieredUpscaler([str(file) for file in files], display_height=None, provider="cpu", threads=1)
    made.prepare(32, 48)
    return made


def picture(index: int, width: int = WIDTH, height: int = HEIGHT, pix_fmt: str = "yuv420p") -> VideoFrame:
    """Frame `index` of a moving pattern with texture, 8 or more bits."""
    frame = av.VideoFrame(width, height, pix_fmt)
    for number, plane in enumerate(frame.planes):
        buffer = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)
        y, x = np.mgrid[: buffer.shape[0], : buffer.shape[1]]
        wave = 110 + 50 * np.sin((x + 3 * index) / 5 + number) + 40 * np.cos((y - 2 * index) / 4)
        buffer[:] = wave if "10" not in pix_fmt else np.where(x % 2, 1, wave)  # 10 bits lie in 16: keep the high byte small
    return frame


@pytest.fixture
def make_clip(tmp_path: Path) -> Callable[..., Path]:
    """Writes a tiny clip, by default 12 frames of 64x48 at 30 frames/s in H.264; the format follows from the name."""

    def write(
        name: str = "clip.mp4",
        *,
        frames: int = FRAMES,
        width: int = WIDTH,
        height: int = HEIGHT,
        codec: str = "libx264",
        pix_fmt: str = "yuv420p",
        options: dict[str, str] | None = None,
        pictures: list[Frame] | None = None,
        pts: list[int] | None = None,
        tags: tuple[int, int, int, int] = (1, 1, 1, 1),
        sample_aspect_ratio: Fraction | None = None,
        rotation: float | None = None,
        audio: str | None = None,
    ) -> Path:
        path = tmp_path / name
        with av.open(str(path), "w") as container:
            stream = container.add_stream(codec, rate=FPS, options=options or {"g": "6", "bf": "0", "preset": "ultrafast", "crf": "20"})
            context = stream.codec_context
            stream.width, stream.height, stream.pix_fmt = width, height, pix_fmt
            context.time_base = Fraction(1, FPS)
            context.color_range, context.color_primaries, context.color_trc, context.colorspace = tags
            if sample_aspect_ratio is not None:
                context.sample_aspect_ratio = sample_aspect_ratio
            if rotation is not None:
                stream.set_display_rotation(rotation)
            sound = container.add_stream(audio, rate=48000, format="s16" if "pcm" in audio else "fltp") if audio else None
            for index in range(frames):
                frame = to_av_frame(pictures[index]) if pictures else picture(index, width, height, pix_fmt)
                frame.pts, frame.time_base = (pts[index] if pts else index), Fraction(1, FPS)
                container.mux(stream.encode(frame))
            container.mux(stream.encode(None))
            if sound is not None:
                tone = np.sin(np.arange(48000 * frames // FPS) * 0.05, dtype=np.float32)
                block = av.AudioFrame.from_ndarray(np.stack([tone, tone]), format="fltp", layout="stereo")
                block.sample_rate, block.pts, block.time_base = 48000, 0, Fraction(1, 48000)
                container.mux(sound.encode(block))
                container.mux(sound.encode(None))
        return path

    return write


@pytest.fixture
def no_screen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows open by SDL's dummy driver."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


@pytest.fixture
def window(no_screen: None) -> Iterator[Window]:
    with Window("test") as window:
        yield window


@pytest.fixture(autouse=True)
def own_signal_handlers() -> Iterator[None]:
    """The command line takes over three signals, as a process of its own may."""
    handlers = {signum: signal.getsignal(signum) for signum in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    yield
    for signum, handler in handlers.items():
        signal.signal(signum, handler)
