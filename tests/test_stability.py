"""The hard cases: artifacts that pass, and broken ones that must not."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch

from client.frames import Frame
from client.models import find_model
from client.quality import psnr_db
from client.upscaler import OnnxUpscaler
from model import hard_cases as pictures
from model.artifact_weights import network_of_artifact
from model.cli import verify_main
from model.export import export_network
from model.network import GameSR, NetworkConfig
from model.stability import CASES, HEADER, Case, run_cases, table_row
from model.trial import BOUNDS, Outcome, Subject, bounds_of, tally
from model.verify import Played, Reference, StepError, step_error
from tests.moving import write_footage

SIZE = (32, 24)
NOT_TIMED = [case.name for case in CASES if case.name != "denormals"]  # the one case that is decided by a clock


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny network with every weight away from zero as tiny.onnx, and a clip of 12 frames, 144x96, as clip.mkv."""
    folder = tmp_path_factory.mktemp("stability")
    torch.manual_seed(0)
    network = GameSR(NetworkConfig(channels=8, expanded=8, blocks=1, learned_base=True, skip=True))
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    export_network(network.eval(), folder / "tiny.onnx", name="tiny", card={"steps": 0})
    write_footage(folder)
    return folder


def subject(model: Path) -> Subject:
    upscaler = OnnxUpscaler(model, threads=1)
    network = network_of_artifact(model) if "network" in upscaler.spec.card else None
    return Subject(model, upscaler, network, [], *SIZE, full=False)


def outcomes(model: Path, *names: str) -> dict[str, Outcome]:
    return {case.name: outcome for case, outcome in run_cases(subject(model), [case for case in CASES if case.name in names])}


def changed(model: Path, path: Path, change: Callable[[onnx.GraphProto], None]) -> Path:
    proto = onnx.load(model)
    change(proto.graph)
    onnx.save(proto, path)
    return path


def with_gate_bias(values: Callable[[np.ndarray], np.ndarray]) -> Callable[[onnx.GraphProto], None]:
    def change(graph: onnx.GraphProto) -> None:
        tensor = next(t for t in graph.initializer if t.name == "network.lstm.gates.bias")
        bias = values(onnx.numpy_helper.to_array(tensor).copy())
        tensor.CopyFrom(onnx.numpy_helper.from_array(bias.astype(np.float32), tensor.name))

    return change


def test_a_sound_network_passes_every_case(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = [str(folder / "tiny.onnx"), str(folder / "clip.mkv"), "--hard", "short", "--crop", "32x24", "--cases", *NOT_TIMED]
    assert verify_main([*command, "--json"]) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [row["case"] for row in rows] == NOT_TIMED
    for row in rows:
        if row["case"] == "providers":
            continue  # what there is to compare depends on the installed runtime
        assert row["passed"] is True and row["nan_frames"] == 0 and row["steps"] > 0, row
        if row["case"] != "lost-state":
            assert row["max_code_error"] <= 1 and row["max_state_error"] < 1e-4, row
    assert {row["model"] for row in rows} == {"tiny.onnx"}
    by_name = {row["case"]: row for row in rows}
    assert (by_name["full-size"]["width"], by_name["full-size"]["height"]) == (144, 96)
    assert [error["step"] for error in by_name["footage"]["errors_at"]] == [1, 10]
    assert by_name["lost-state"]["remark"] == "10 of 12 caught and reset"  # a lone Inf in h saturates the gates and is gone


def test_denormals_are_gone_after_a_frame(folder: Path) -> None:
    outcome = outcomes(folder / "tiny.onnx", "denormals")["denormals"]
    assert outcome.subnormals == 0 and "times as long" in outcome.remark


def test_a_shipped_model_passes_where_states_move_most() -> None:
    found = outcomes(find_model("gamesr", 2), "cuts", "flashes", "full-range", "lost-state")
    assert len(found) == 4 and all(outcome.passed for outcome in found.values()), found


@pytest.mark.parametrize("name", ["gamesr", "quality"])
@pytest.mark.parametrize("scale", [2, 3])
def test_nothing_inside_a_shipped_network_comes_near_the_end_of_float16(name: str, scale: int) -> None:
    """No input and no output of a layer is a tenth of it, nor is a cell; the largest are those of the base, in code values."""
    network = network_of_artifact(find_model(name, scale))
    largest: list[float] = []

    def look(_: torch.nn.Module, inputs: tuple[torch.Tensor, ...], output: torch.Tensor) -> None:
        largest.append(float(torch.cat([tensor.flatten() for tensor in (*inputs, output)]).abs().max()))

    for layer in network.modules():
        if not list(layer.children()):
            layer.register_forward_hook(look)
    for make in (pictures.noise, pictures.checkerboard, pictures.saturated, pictures.flashes):
        reference = Reference(network, SIZE[1], SIZE[0])
        for frame in make(*SIZE, 8):
            reference.step(frame)
        largest += [float(np.abs(part).max()) for part in reference.state()]
    assert 128 < np.max(largest) < np.finfo(np.float16).max / 10


def test_a_clip_whose_pictures_would_be_too_large_leaves_its_case_out_alone(folder: Path) -> None:
    whole = next(pictures.black(4098, 4096, 1))
    tested = replace(subject(folder / "tiny.onnx"), clip=[whole])
    found = dict(run_cases(tested, [case for case in CASES if case.name in ("full-size", "black")]))
    by_name = {case.name: outcome for case, outcome in found.items()}
    assert by_name["full-size"].left_out.startswith("4098x4096 upscaled by 2 is more than 64 megapixels")
    assert by_name["full-size"].passed is None and by_name["black"].passed


def test_a_clip_of_an_odd_size_goes_through_the_encoder(folder: Path) -> None:
    clip = list(pictures.noise(101, 75, 3))
    ((_, outcome),) = run_cases(replace(subject(folder / "tiny.onnx"), clip=clip), [case for case in CASES if case.name == "blocking"])
    assert outcome.passed and (outcome.width, outcome.height) == SIZE


def test_a_baseline_has_no_errors_to_report_but_must_hold_still(capsys: pytest.CaptureFixture[str]) -> None:
    command = [str(find_model("bicubic", 3)), "--hard", "short", "--crop", "32x24", "--cases"]
    assert verify_main([*command, "footage", "still", "sizes", "lost-state", "denormals", "threads"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "\n".join(lines[:2]) == HEADER
    assert all(line.count("|") == 13 for line in lines)
    results = {line.split(" | ")[0].removeprefix("| "): line.split(" | ")[-1].removesuffix(" |") for line in lines[2:]}
    assert results["footage"] == "left out: no clip was given"
    assert results["lost-state"] == results["denormals"] == "left out: it has no state"
    assert all(results[name].startswith("pass") for name in ("still", "sizes", "threads"))


def test_a_forget_gate_that_never_forgets_fails_the_still(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    open_gate = with_gate_bias(lambda bias: bias + 30 * (np.arange(32) // 8 == 1))
    broken = changed(folder / "tiny.onnx", tmp_path / "broken.onnx", open_gate)
    assert verify_main([str(broken), "--hard", "short", "--crop", "32x24", "--cases", "still", "threads"]) == 1
    said = capsys.readouterr()
    assert "the state still moves by" in said.out and "| **FAIL**; " in said.out
    assert said.err == f"gamesr-verify: {broken} fails 1 of the hard cases: still\n"


def test_a_graph_that_computes_something_else_than_its_weights_say_fails(folder: Path, tmp_path: Path) -> None:
    def other_epsilon(graph: onnx.GraphProto) -> None:
        norms = [node for node in graph.node if node.op_type == "LayerNormalization"]
        assert norms
        for node in norms:
            next(a for a in node.attribute if a.name == "epsilon").f = 0.05

    broken = changed(folder / "tiny.onnx", tmp_path / "broken.onnx", other_epsilon)
    found = outcomes(broken, "lines", "noise", "sizes", "hud")
    assert all(outcome.passed is False for outcome in found.values()), found


def test_weights_that_are_not_finite_fail_case_by_case(folder: Path, tmp_path: Path) -> None:
    broken = changed(folder / "tiny.onnx", tmp_path / "broken.onnx", with_gate_bias(lambda bias: bias * np.nan))
    found = outcomes(broken, "black", "lost-state")
    assert "not finite even in float64" in found["black"].failures[0]
    assert "loses its state even when it starts from zeros" in found["lost-state"].failures[0]


def test_growing_errors_and_lost_states_are_failures(folder: Path) -> None:
    tested = subject(folder / "tiny.onnx")
    picture = next(pictures.black(64, 48, 1))
    state = [np.ones((1, 8, 12, 16), np.float32)]

    def played(slope: float) -> Iterator[Played]:
        for step in range(1, 301):
            yield Played(picture, 1000, False, state, StepError("cpu", step, 0, 0, 0.0, None, 1e-7, 1e-7 + slope * step, 1.0, 4608))

    assert tally(tested, played(0.0)).passed
    drifting = tally(tested, played(1e-8))
    assert drifting.drift_per_1000_frames == pytest.approx(1e-5) and drifting.failures == (
        "1e-05 of drift per 1,000 frames, at most 1e-06 allowed",
    )
    lost = tally(tested, (replace(frame, restarted=index == 7) for index, frame in enumerate(played(0.0))))
    assert lost.nan_frames == 1 and lost.failures == ("the state was lost in 1 frames",)


@pytest.mark.parametrize("plane", ["y", "u", "v"])
@pytest.mark.parametrize(("codes", "fails"), [([100, 101] * 4, "flicker"), ([100, 103, 103, 103, 106, 109, 109, 109], "change by 3 codes")])
def test_a_still_that_flickers_or_drifts_in_any_plane_fails(
    folder: Path, monkeypatch: pytest.MonkeyPatch, codes: list[int], fails: str, plane: str
) -> None:
    def play_codes(*_: object) -> Iterator[Played]:
        grey = Frame(*(np.full(shape, 100, np.uint8) for shape in ((48, 64), (24, 32), (24, 32))))
        for code in codes:
            yield Played(replace(grey, **{plane: np.full_like(getattr(grey, plane), code)}), 1000, False, [], None)

    monkeypatch.setattr("model.trial.play", play_codes)
    still = next(case for case in CASES if case.name == "still")
    ((_, outcome),) = run_cases(subject(folder / "tiny.onnx"), [replace(still, short=len(codes))])
    assert any(fails in failure for failure in outcome.failures), outcome.failures


def test_an_error_is_that_of_its_samples() -> None:
    wanted, found = (np.zeros(shape, np.uint8) for shape in ((40, 50), (20, 25), (20, 25))), np.zeros((40, 50), np.uint8)
    found[:2, 0] = 3, 9  # two of 3,000 samples: three may lie above the percentile
    chroma = np.zeros((20, 25), np.uint8)
    error = step_error("cpu", 7, Frame(found, chroma, chroma), [np.float32([1, 2])], list(wanted), [np.array([1.0, 2.5])])
    assert (error.step, error.max_code_error, error.p999_code_error) == (7, 9, 0)
    assert error.differing_pixels == pytest.approx(2 / 3000) and error.psnr_y_db == pytest.approx(psnr_db(90 / 2000))
    assert (error.max_state_error, error.rms_state_error) == (0.5, pytest.approx(0.5 / np.sqrt(2)))
    found[2:4, 0] = 3, 2  # four do: the least of them is the percentile
    again = step_error("cpu", 8, Frame(found, chroma, chroma), [], [np.zeros_like(p) for p in (found, chroma, chroma)], [])
    assert again.p999_code_error == 2 and again.rms_state_error == 0


def test_bounds_are_those_of_what_computes() -> None:
    spec = OnnxUpscaler(find_model("gamesr", 2), threads=1).spec
    exact, rounded = bounds_of(spec, "openvino"), bounds_of(spec, "openvino-bfloat16")
    assert exact == bounds_of(spec, "cpu") == BOUNDS["float32"] and rounded == BOUNDS["bfloat16"] != exact
    assert bounds_of(replace(spec, precision="int8"), "openvino-bfloat16") == BOUNDS["int8"]


def test_a_precision_without_bounds_is_refused(folder: Path, tmp_path: Path) -> None:
    proto = onnx.load(folder / "tiny.onnx")
    next(p for p in proto.metadata_props if p.key == "precision").value = "float8"
    onnx.save(proto, tmp_path / "float8.onnx")
    assert verify_main([str(tmp_path / "float8.onnx"), "--hard", "short", "--cases", "black"]) == 1


@pytest.mark.parametrize("arguments", [[], ["--cases", "black"], ["clip.mkv", "--cases", "black"]])
def test_a_clip_may_be_missing_and_cases_be_named_with_hard_only(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        verify_main(["model.onnx", *arguments])
    assert "with --hard only" in capsys.readouterr().err


def test_hard_cases_take_one_provider(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        verify_main(["model.onnx", "--hard", "short", "--provider", "cpu", "openvino"])
    assert "one --provider" in capsys.readouterr().err


def test_a_row_says_what_it_does_not_know() -> None:
    case = Case("name", "", lambda *_: Outcome(2, 2, 0), 1, 1)
    assert table_row(case, Outcome(160, 96, 1000)) == "| name | 160x96 | 1,000 | - | - | - | - | - | - | 0 | - | pass |"


@pytest.mark.parametrize(("largest", "share"), [(8.0, "5.0e-06"), (0.5, "4.0e-05"), (np.nan, "nan")])
def test_a_row_has_the_state_error_that_is_held_against_the_bound(largest: float, share: str) -> None:
    outcome = Outcome(160, 96, 1000, max_state_error=4e-5, largest_state=largest)
    case = Case("name", "", lambda *_: outcome, 1, 1)
    assert table_row(case, outcome).split(" | ")[5] == share == f"{outcome.record()['state_error_share']:.1e}"
