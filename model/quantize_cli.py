"""gamesr-quantize: an int8 artifact of a float32 one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from client.command import command_parser, run_command, whole_number
from client.models import WEIGHTS, find_model
from client.upscaler import OnnxUpscaler
from model.artifact_files import new_artifacts
from model.calibration import MADE_FRAMES
from model.cards import card_page
from model.quantize import CALIBRATION_FRAMES, quantize

EPILOG = """\
example:
  gamesr-quantize client/weights/live_x2.onnx mine-int8 match_540p.mp4 race_540p.mp4

The clips are what the artifact will be given: low resolution, compressed, of several scenes, none of them a test scene.
fast-int8, live-int8 and balanced-int8 ship, made like this, the last two of model/originals. How much is lost and gained, and
where: docs/stability.md. To see it for a model of your own:

  gamesr-verify client/weights/mine-int8_x2.onnx test_540p.mp4 --provider cpu openvino
  gamesr-evaluate FOOTAGE.toml --models live mine-int8 --scales 2
  gamesr-bench --model live --model mine-int8 --provider openvino
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    parser = command_parser(
        "gamesr-quantize", "Write an int8 artifact of a float32 one, its ranges calibrated on footage, its model card beside it.", EPILOG
    )
    parser.add_argument("model", metavar="NAME|FILE", help="a shipped float32 model, or the .onnx artifact of a trained GameSR network")
    parser.add_argument("name", help="the new model's name; its files are NAME_xSCALE.onnx and .md")
    parser.add_argument("clips", type=Path, nargs="+", metavar="clip", help="low-resolution videos of several scenes")
    parser.add_argument(
        "--frames", type=whole_number(), default=CALIBRATION_FRAMES, help="of each clip, from its start (default: %(default)s)"
    )
    parser.add_argument(
        "--made-frames",
        type=whole_number(),
        default=MADE_FRAMES,
        help="of each kind of made picture (letters, lines, noise): with more, noise comes out nearer and a flat sky not as near "
        "(default: %(default)s)",
    )
    parser.add_argument("--folder", type=Path, default=WEIGHTS, help="where to (default: %(default)s)")
    parser.add_argument("--force", action="store_true", help="replace files that exist")
    arguments = parser.parse_args(argv)

    def work() -> None:
        model = find_model(arguments.model, 2)
        scale = OnnxUpscaler(model, threads=1).spec.scale
        (path,) = new_artifacts(arguments.name, [scale], arguments.folder, source=model, force=arguments.force)
        quantize(
            model,
            path,
            arguments.clips,
            name=arguments.name,
            frames=arguments.frames,
            made_frames=arguments.made_frames,
            page=card_page,
        )
        print(path)

    return run_command(parser.prog, work, debug=arguments.debug, interrupted="stopped")
