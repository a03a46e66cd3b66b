"""What an artifact says of itself, files that are none and are refused, and where models are found."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnxruntime as ort
import pytest
from onnx import TensorProto, helper

from client.artifact import MAX_FILE_BYTES
from client.cores import physical_cores
from client.errors import ModelError, ProviderError
from client.models import find_model, shipped_models
from client.upscaler import OnnxUpscaler
from tests.conftest import tiny_model
from tests.moving import picture
from tests.stepping import whole

ModelFile = Callable[..., Path]


def test_spec_is_what_the_file_says(model_file: ModelFile) -> None:
    path = model_file()
    spec = OnnxUpscaler(path).spec
    assert (spec.name, spec.scale, spec.size_multiple, spec.precision, spec.card) == ("tiny", 2, 2, "float32", {"footage": "none"})
    assert [(s.input, s.output, s.channels, s.divisor, s.dtype) for s in spec.state] == [("h_in", "h_out", 1, 2, "float32")]
    assert spec.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()


def state_entry(**changes: object) -> str:
    return json.dumps([{"input": "h_in", "output": "h_out", "channels": 1, "divisor": 2, "dtype": "float32", **changes}])


@pytest.mark.parametrize(
    ("metadata", "reason"),
    [
        ({"gamesr_format": None}, "does not say gamesr_format"),
        ({"gamesr_format": "2"}, "its format is '2'"),
        ({"scale": "two"}, "metadata is incomplete or wrong"),
        ({"scale": "4"}, "its scale is 4"),
        ({"name": None}, "metadata is incomplete or wrong"),
        ({"name": "\x1b[31m"}, "not a short word"),
        ({"size_multiple": "3"}, "its size multiple is 3"),
        ({"state": "[]"}, "its inputs are"),
        ({"state": "not json"}, "metadata is incomplete or wrong"),
        ({"state": '[{"input": "h_in"}]'}, "metadata is incomplete or wrong"),
        ({"state": state_entry(dtype="int8")}, "its state h_in is int8"),
        ({"state": state_entry(dtype="float16")}, "its inputs are"),
        ({"state": state_entry(channels=10**9)}, "has 1000000000 channels"),
        ({"state": state_entry(divisor=0)}, "at 1/0 of the size"),
        ({"state": state_entry(channels="1")}, "has 1 channels"),
        ({"state": state_entry(dtype=[])}, "not short words"),
        ({"state": state_entry(input="\x1b[31m")}, "not short words"),
        ({"card": "[1]"}, "metadata is incomplete or wrong"),
        ({"card": "[" * 100_000 + "]" * 100_000}, "metadata is incomplete or wrong"),
        ({"card": '{"parameters": "many"}'}, "its card's parameters is not a whole number"),
    ],
)
def test_metadata_that_is_not_understood_is_refused(model_file: ModelFile, metadata: dict[str, str | None], reason: str) -> None:
    with pytest.raises(ModelError, match="not a model that this client understands") as error:
        OnnxUpscaler(model_file(metadata=metadata))
    assert reason in str(error.value) and "\n" not in str(error.value)


def test_a_model_whose_state_has_another_shape_fails_in_one_sentence(model_file: ModelFile) -> None:
    upscaler = OnnxUpscaler(model_file(metadata={"state": state_entry(channels=3)}))
    with pytest.raises(ModelError, match="model tiny failed on a 14x10 frame") as error:
        whole(upscaler, picture(0, 10, 14))
    assert "\n" not in str(error.value)


def test_a_model_that_lies_about_its_scale_fails_in_one_sentence(model_file: ModelFile) -> None:
    with pytest.raises(ModelError, match="model tiny failed on a 14x10 frame"):
        whole(OnnxUpscaler(model_file(metadata={"scale": "3"})), picture(0, 10, 14))


@pytest.mark.parametrize("damage", ["cut", "empty", "text", "noise"])
def test_a_damaged_or_foreign_file_is_refused(model_file: ModelFile, tmp_path: Path, damage: str) -> None:
    sound = model_file().read_bytes()
    content = {
        "cut": sound[: len(sound) // 2],
        "empty": b"",
        "text": b"#!/bin/sh\necho a model\n",
        "noise": np.random.default_rng(0).bytes(2000),
    }[damage]
    path = tmp_path / "broken.onnx"
    path.write_bytes(content)
    with pytest.raises(ModelError, match=r"broken\.onnx is not a") as error:
        OnnxUpscaler(path)
    assert "\n" not in str(error.value)


def test_files_that_cannot_be_models_are_refused(tmp_path: Path) -> None:
    with (tmp_path / "huge.onnx").open("wb") as file:
        file.truncate(MAX_FILE_BYTES + 1)
    with pytest.raises(ModelError, match="larger than 64 MiB"):
        OnnxUpscaler(tmp_path / "huge.onnx")
    with pytest.raises(ModelError, match="cannot be read: No such file"):
        OnnxUpscaler(tmp_path / "missing.onnx")
    os.mkfifo(tmp_path / "pipe.onnx")
    for path in (tmp_path, tmp_path / "pipe.onnx", Path("/dev/zero")):
        with pytest.raises(ModelError, match="is not a file"):
            OnnxUpscaler(path)


def test_a_model_cannot_make_the_runtime_read_other_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    np.ones(4, np.float32).tofile("weights.bin")
    model = tiny_model()
    outside = TensorProto(name="outside", data_type=TensorProto.FLOAT, dims=[4], data_location=TensorProto.EXTERNAL)
    outside.external_data.add(key="location", value="weights.bin")
    model.graph.initializer.append(outside)
    model.graph.output.append(helper.make_tensor_value_info("leak", TensorProto.FLOAT, [4]))
    model.graph.node.append(helper.make_node("Identity", ["outside"], ["leak"]))
    Path("leaky.onnx").write_bytes(model.SerializeToString())
    with pytest.raises(ModelError, match="not a readable ONNX model"):
        OnnxUpscaler(Path("leaky.onnx"))


def test_a_missing_provider_names_what_to_install(model_file: ModelFile, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ort, "get_available_providers", lambda: ["CPUExecutionProvider"])
    with pytest.raises(ProviderError, match=r"pip uninstall onnxruntime .*pip install -c constraints.txt '\.\[cuda\]'"):
        OnnxUpscaler(model_file(), provider="cuda")
    with pytest.raises(ProviderError, match="no provider 'tpu': choose one of cpu, cuda, cuda-tf32, openvino, openvino-bfloat16"):
        OnnxUpscaler(model_file(), provider="tpu")


def test_threads_are_the_physical_cores_unless_said(model_file: ModelFile) -> None:
    path = model_file()
    assert OnnxUpscaler(path).threads == physical_cores() >= 1
    assert OnnxUpscaler(path, threads=1).threads == 1


def test_every_shipped_model_is_understood_and_named_after_itself() -> None:
    models = shipped_models()
    assert {"bicubic_x2", "bicubic_x3", "lanczos_x2", "lanczos_x3"} <= {path.stem for path in models}
    for path in models:
        spec = OnnxUpscaler(path, threads=1).spec
        assert path.stem == f"{spec.name}_x{spec.scale}"
        assert find_model(spec.name, spec.scale) == path


def test_models_are_found_by_name_or_path(model_file: ModelFile) -> None:
    path = model_file()
    assert find_model(str(path), 2) == path
    with pytest.raises(ModelError, match=r"no model named 'bicubik' ships for scale 2 \(there is .*, bicubic, .*\); a file is named by"):
        find_model("bicubik", 2)
    assert find_model("nowhere/bicubic", 2) == Path("nowhere/bicubic")
