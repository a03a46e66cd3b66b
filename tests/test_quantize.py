"""int8 artifacts: what is in 8 bits and what is not, how near they come, what they say of themselves, what is refused."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from onnx import numpy_helper

from client.errors import InputError, ModelError
from client.frames import Frame
from client.upscaler import OnnxUpscaler
from model import hard_cases
from model.calibration import even_channels, mean_difference, observed
from model.cli import train_main, verify_main
from model.export import export_baseline, export_network
from model.export_cli import main as export_main
from model.lean import Lean, LeanConfig
from model.network import GameSR, NetworkConfig
from model.planes import Network
from model.quantize import quantize, with_cells_apart
from model.quantize_cli import main
from model.trial import BOUNDS
from tests.moving import picture, write_footage

NETWORKS: dict[str, Callable[[], Network]] = {  # without a state, the cells in its layers or beside them; and with one, the base apart
    "carrying": lambda: Lean(LeanConfig(channels=14, expanded=8, blocks=2)),
    "apart": lambda: Lean(LeanConfig(channels=8, expanded=8, blocks=2, carried=False)),
    "recurrent": lambda: GameSR(NetworkConfig(channels=8, expanded=8, blocks=1, learned_base=True, skip=True)),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Each network as NAME.onnx and NAME-int8.onnx, and the clip that those were calibrated on."""
    folder = tmp_path_factory.mktemp("quantize")
    write_footage(folder)
    for name, make in NETWORKS.items():
        torch.manual_seed(0)
        network = make()
        with torch.no_grad():
            for parameter in network.parameters():
                parameter.add_(0.05 * torch.randn_like(parameter))
        export_network(network.eval(), folder / f"{name}.onnx", name=name, card={"steps": 0})
        quantize(folder / f"{name}.onnx", folder / f"{name}-int8.onnx", [folder / "clip.mkv"], name=f"{name}-int8", frames=6)
    return folder


def codes(model: Path, frames: list[Frame], provider: str = "cpu") -> np.ndarray:
    """All samples of all pictures in one row."""
    return np.concatenate([plane.ravel() for p in played(model, frames, provider) for plane in (p.y, p.u, p.v)]).astype(np.int16)


def planes(frame: Frame) -> dict[str, np.ndarray]:
    """What the graph of a network without a state takes."""
    return {name: getattr(frame, name)[None, None] for name in "yuv"}


def channel_min(tensor: np.ndarray) -> np.ndarray:
    return np.asarray(tensor.min((0, 2, 3)))


def channel_max(tensor: np.ndarray) -> np.ndarray:
    return np.asarray(tensor.max((0, 2, 3)))


def played(model: Path, frames: list[Frame], provider: str) -> Iterator[Frame]:
    upscaler = OnnxUpscaler(model, provider=provider, threads=1)
    state = upscaler.initial_state(frames[0].height, frames[0].width)
    for frame in frames:
        upscaled, state = upscaler.step(frame, state)
        yield upscaled


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize("provider", ["cpu", "openvino"])
def test_int8_comes_near_the_float32_artifact(folder: Path, name: str, provider: str) -> None:
    frames = [picture(t, 96, 144) for t in range(20)]
    bicubic = folder / "bicubic.onnx"
    export_baseline("bicubic", 2, bicubic, name="bicubic")
    for plane in "yuv":
        rounded, exact, nothing = (
            np.stack([getattr(p, plane) for p in played(model, frames, by)]).astype(float)
            for model, by in ((folder / f"{name}-int8.onnx", provider), (folder / f"{name}.onnx", "cpu"), (bicubic, "cpu"))
        )
        assert 0 < np.square(rounded - exact).mean() < 0.01 * np.square(exact - nothing).mean(), plane


@pytest.mark.parametrize("name", ["carrying", "apart"])
def test_codes_keep_their_numbers_and_what_is_added_to_the_interpolation_stays_float(folder: Path, name: str) -> None:
    exact, residuals = with_cells_apart(folder / f"{name}.onnx")
    codes = next(node for node in exact.graph.node if node.op_type == "Conv").input[0]
    graph = onnx.load(folder / f"{name}-int8.onnx").graph
    tensors = {t.name: numpy_helper.to_array(t) for t in graph.initializer}
    (codes_down,) = (node for node in graph.node if node.op_type == "QuantizeLinear" and node.input[0] == codes)
    assert (tensors[codes_down.input[1]], tensors[codes_down.input[2]]) == (1, 128)
    assert [[node.op_type for node in graph.node if residual in node.input] for residual in residuals] == [["Add"]] * 2
    source = {node.output[0]: node.op_type for node in graph.node}
    assert {source[node.input[0]] for node in graph.node if node.op_type == "LeakyRelu"} == {"Conv"}
    assert not {name for name in tensors if name.endswith(("_scale", "_zero_point"))} - {name for n in graph.node for name in n.input}


@pytest.mark.parametrize("name", NETWORKS)
def test_weights_are_symmetric_per_channel_and_what_must_stay_float_does(folder: Path, name: str) -> None:
    graph = onnx.load(folder / f"{name}-int8.onnx").graph
    tensors = {t.name: numpy_helper.to_array(t) for t in graph.initializer}
    source = {node.output[0]: node for node in graph.node}
    float_weights, int8_weights = set(), set()
    for conv in (node for node in graph.node if node.op_type == "Conv"):
        if conv.input[1] in tensors:
            float_weights.add(conv.input[1].removeprefix("network.").removesuffix(".weight"))
            continue
        weight, scales, zeros = (tensors[tensor] for tensor in source[conv.input[1]].input)
        assert weight.dtype == np.int8 and not zeros.any() and scales.shape == weight.shape[:1]
        assert source[source[conv.input[0]].input[0]].op_type == "QuantizeLinear"
        assert tensors[source[conv.input[0]].input[2]].dtype == np.uint8
        int8_weights.add(source[conv.input[1]].input[0].removeprefix("network.").removesuffix(".weight_quantized"))
    if name == "recurrent":
        assert int8_weights == {"stem", "blocks.0.conv"}
        assert float_weights == {"lstm.gates", "head", "luma_base", "chroma_base"}
    else:
        assert int8_weights == {"stem", "blocks.0", "blocks.1", "head.features", "chroma_head.features"}
        assert float_weights == {"head.cells", "chroma_head.cells"}


def test_nothing_in_8_bits_depends_on_the_state(folder: Path) -> None:
    """It is calibrated with a state of zeros."""
    graph = onnx.load(folder / "recurrent-int8.onnx").graph
    source = {output: node for node in graph.node for output in node.output}
    behind = {node.input[0] for node in graph.node if node.op_type == "QuantizeLinear"}
    unseen = set(behind)
    while unseen:
        unseen = {name for tensor in unseen if tensor in source for name in source[tensor].input} - behind
        behind |= unseen
    assert {entry.name for entry in graph.input} & behind == {"y", "u", "v"}


@pytest.mark.parametrize("name", NETWORKS)
def test_it_is_the_same_model_to_the_client_but_for_its_precision(folder: Path, name: str) -> None:
    ours, theirs = (OnnxUpscaler(folder / f"{stem}.onnx", threads=1).spec for stem in (f"{name}-int8", name))
    assert (ours.name, ours.precision, theirs.precision) == (f"{name}-int8", "int8", "float32")
    assert (ours.scale, ours.size_multiple, ours.state, ours.reach) == (theirs.scale, theirs.size_multiple, theirs.state, theirs.reach)
    made = [f"made {what} (16 frames)" for what in ("lines, 160x96", "text, 160x96", "noise, 160x96", "noise, 160x2", "noise, 2x96")]
    counts = {key: ours.card[key] for key in ("parameters", "macs_540p") if key in ours.card}
    assert ours.card == {**theirs.card, **counts, "quantized_from": theirs.sha256, "calibration": ["clip.mkv (6 frames)", *made]}
    graph = onnx.load(folder / f"{name}-int8.onnx").graph
    weights = [t for t in graph.initializer if re.search(r"network\..*(weight|bias)(_quantized)?$", t.name)]
    assert "parameters" not in counts or counts["parameters"] == sum(np.prod(t.dims, dtype=int) for t in weights)


def test_without_the_cells_in_its_layers_it_is_the_same_network(folder: Path, tmp_path: Path) -> None:
    model, _ = with_cells_apart(folder / "carrying.onnx")
    features = [node for node in model.graph.node if node.op_type == "LeakyRelu"]
    sizes = [seen[node.output[0]].shape[1] for node in features for seen in observed(model, [node.output[0]], [planes(picture(0, 48, 64))])]
    assert sizes == [8, 8, 8]
    onnx.save(model, tmp_path / "apart.onnx")
    frames = list(hard_cases.noise(48, 32, 4))
    error = codes(tmp_path / "apart.onnx", frames) - codes(folder / "carrying.onnx", frames)
    assert np.abs(error).max() <= 1 and np.count_nonzero(error) < 1e-3 * error.size


def test_the_same_artifact_comes_of_the_same_input(folder: Path, tmp_path: Path) -> None:
    again = tmp_path / "again.onnx"
    quantize(folder / "carrying.onnx", again, [folder / "clip.mkv"], name="carrying-int8", frames=6)
    assert again.read_bytes() == (folder / "carrying-int8.onnx").read_bytes()


@pytest.mark.parametrize("name", ["apart", "recurrent"])
def test_a_network_that_carries_no_cells_stays_as_it_is(folder: Path, name: str) -> None:
    model, residuals = with_cells_apart(folder / f"{name}.onnx")
    assert model == onnx.load(folder / f"{name}.onnx")
    assert len(residuals) == {"apart": 2, "recurrent": 0}[name]


@pytest.mark.parametrize("network", ["carrying", "apart"])
def test_channels_made_even_leave_the_network_as_it_is_and_reach_as_far_as_each_other(folder: Path, tmp_path: Path, network: str) -> None:
    before, residuals = with_cells_apart(folder / f"{network}.onnx")
    even = onnx.load_from_string(before.SerializeToString())
    feeds = [planes(frame) for frame in hard_cases.noise(48, 32, 3)]
    even_channels(even, feeds)
    features = [node.output[0] for node in even.graph.node if node.op_type == "LeakyRelu"]
    assert len(features) == 3
    for name in features:
        low, high = (np.stack([f(seen[name]) for seen in observed(even, [name], feeds)]) for f in (channel_min, channel_max))
        low, high = low.min(0), high.max(0)
        np.testing.assert_allclose(np.maximum(high, low * high.max() / low.min()), high.max(), rtol=1e-5)
        spread = np.stack([channel_max(seen[name]) for seen in observed(before, [name], feeds)]).max(0)
        assert spread.max() > 1.2 * spread.min()  # they were not so before
    for residual in residuals:
        np.testing.assert_allclose(mean_difference(even, before, residual, feeds), 0, atol=1e-4)
    onnx.save(even, tmp_path / "even.onnx")
    frames = list(hard_cases.noise(48, 32, 4))
    error = codes(tmp_path / "even.onnx", frames) - codes(folder / f"{network}.onnx", frames)
    assert np.abs(error).max() <= 1 and np.count_nonzero(error) < 1e-3 * error.size


def test_channels_that_something_else_reads_are_left_and_dead_ones_stay_finite(folder: Path) -> None:
    model, _ = with_cells_apart(folder / "carrying.onnx")
    tensors = {t.name: t for t in model.graph.initializer}
    for name in ("network.blocks.0.weight", "network.blocks.0.bias"):
        tensors[name].CopyFrom(numpy_helper.from_array(0 * numpy_helper.to_array(tensors[name]), name))
    relus = [node for node in model.graph.node if node.op_type == "LeakyRelu"]
    model.graph.node.append(onnx.helper.make_node("Identity", [relus[2].output[0]], ["another"]))
    before = {name: numpy_helper.to_array(tensor) for name, tensor in tensors.items()}
    even_channels(model, [planes(frame) for frame in hard_cases.noise(48, 32, 1)])
    after = {tensor.name: numpy_helper.to_array(tensor) for tensor in model.graph.initializer}
    assert np.array_equal(after["network.head.features.weight"], before["network.head.features.weight"])
    assert not np.array_equal(after["network.stem.weight"], before["network.stem.weight"])
    assert not after["network.blocks.0.weight"].any() and all(np.isfinite(t).all() for t in after.values() if t.dtype == np.float32)


def test_the_mean_difference_is_that_of_each_channel(folder: Path) -> None:
    model, _ = with_cells_apart(folder / "carrying.onnx")
    other = onnx.load_from_string(model.SerializeToString())
    bias = next(t for t in other.graph.initializer if t.name == "network.head.cells.bias")
    shift = np.arange(16, dtype=np.float32)
    bias.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(bias) - shift, bias.name))
    cells = next(node for node in model.graph.node if node.op_type == "Conv" and bias.name in node.input)
    feeds = [planes(frame) for size in (48, 64) for frame in hard_cases.noise(size, 32, 2)]
    np.testing.assert_allclose(mean_difference(model, other, cells.output[0], feeds), shift, atol=1e-3)


@pytest.mark.parametrize("case", ["lines", "text", "noise"])
def test_lines_and_letters_that_no_clip_had_keep_the_bound_of_int8(folder: Path, case: str) -> None:
    frames = list(getattr(hard_cases, case)(64, 48, 14))
    error = codes(folder / "carrying-int8.onnx", frames) - codes(folder / "carrying.onnx", frames)
    assert 0 < np.abs(error).max() <= BOUNDS["int8"].codes


def test_any_size_and_a_lost_state_go_through_it(folder: Path) -> None:
    for size in ((2, 2), (6, 34), (35, 17)):
        frames = list(hard_cases.noise(size[1], size[0], 2))
        assert all((p.height, p.width) == (2 * size[0], 2 * size[1]) for p in played(folder / "carrying-int8.onnx", frames, "cpu"))
    upscaler = OnnxUpscaler(folder / "recurrent-int8.onnx", threads=1)
    state = upscaler.initial_state(48, 64)
    state.tensors()[1][0, 3, 2, 1] = np.nan
    _, state = upscaler.step(picture(0, 48, 64), state)
    assert state.restarted


def test_what_cannot_be_quantized_is_refused(folder: Path, tmp_path: Path) -> None:
    export_baseline("bicubic", 2, tmp_path / "bicubic.onnx", name="bicubic")
    (tmp_path / "broken.h264").write_bytes(bytes(range(256)) * 40)
    for model, clip, error, sentence in (
        (tmp_path / "bicubic.onnx", folder / "clip.mkv", ModelError, "no layer that is quantized"),
        (folder / "carrying-int8.onnx", folder / "clip.mkv", ModelError, "is int8 already"),
        (folder / "carrying.onnx", tmp_path / "broken.h264", InputError, "broken.h264"),
    ):
        with pytest.raises(error, match=sentence):
            quantize(model, tmp_path / "out.onnx", [clip], name="out", frames=2)
    assert not (tmp_path / "out.onnx").exists() and not list(tmp_path.glob("*.partial"))


def test_a_card_that_has_no_page_is_one_sentence_and_no_file(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What `folder` has was exported without any history."""
    assert main([str(folder / "recurrent.onnx"), "new", str(folder / "clip.mkv"), "--frames", "1", "--folder", str(tmp_path)]) == 1
    said = capsys.readouterr().err
    assert said.startswith("gamesr-quantize: the model's card does not say 'before', which its page needs: ") and said.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_from_a_checkpoint_to_a_verified_int8_artifact(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    footage = write_footage(tmp_path)
    tiny = ["--steps", "2", "--batch", "1", "--patch", "16", "--frames", "2", "--window", "2", "--degradations", "area"]
    assert train_main([str(footage), str(tmp_path / "run"), "--cache", str(tmp_path / "cache"), "--preset", "live", *tiny]) == 0
    assert export_main([str(tmp_path / "run" / "checkpoint.pt"), "tiny", "--folder", str(tmp_path)]) == 0
    model, clip, into = str(tmp_path / "tiny_x2.onnx"), str(tmp_path / "clip.mkv"), ["--folder", str(tmp_path)]
    assert main([model, "tiny-int8", clip, clip, "--frames", "20", *into]) == 0
    page = (tmp_path / "tiny-int8_x2.md").read_text()
    sha256 = OnnxUpscaler(Path(model), threads=1).spec.sha256
    assert (
        f"- Quantized from the float32 artifact {sha256} (SHA-256) on clip.mkv (12 frames), clip.mkv (12 frames), made lines" in page
    )  # all there are
    assert "in training), int8; " in page and "PSNR-Y in dB, before it was quantized:" in page

    quantized = str(tmp_path / "tiny-int8_x2.onnx")
    check = [quantized, clip, "--steps", "4", "--crop", "48x32"]
    assert verify_main([*check, "--weights", model, "--provider", "cpu", "openvino"]) == 0
    assert verify_main([quantized, "--weights", model, "--hard", "short", "--crop", "32x24", "--cases", "noise", "sizes"]) == 0
    capsys.readouterr()
    assert verify_main(check) == 1
    assert "with --weights" in capsys.readouterr().err
    assert verify_main([*check, "--weights", quantized]) == 1
    assert "was not made from" in capsys.readouterr().err
    assert main([model, "wider-int8", clip, "--made-frames", "40", *into]) == 0
    assert "made noise, 2x96 (40 frames)" in (tmp_path / "wider-int8_x2.md").read_text()
    capsys.readouterr()
    for option in ("--frames", "--made-frames"):
        with pytest.raises(SystemExit) as ended:
            main([model, "tiny-int8", clip, option, "0", *into])
        assert ended.value.code == 2 and f"{option}: 0 is not a whole number from 1" in capsys.readouterr().err
    assert main([quantized, "twice", clip, *into]) == 1
    assert capsys.readouterr().err.endswith("is int8 already: quantize the float32 artifact\n")
