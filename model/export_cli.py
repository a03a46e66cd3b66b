"""gamesr-export: an artifact of a run's checkpoint, or of a baseline."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from client.artifact import load_session
from client.command import command_parser, run_command
from client.errors import InputError
from client.models import WEIGHTS
from model.artifact_files import new_artifacts
from model.averaging import averaged
from model.cards import card_page, training_card
from model.export import BASELINES, export_baseline, export_network
from model.train import load_checkpoint, network_of

EPILOG = """\
examples:
  gamesr-export runs/mine_x2/checkpoint.pt mine
      what the run has come to, fused, with its card beside it
  gamesr-export runs/mine_x2/checkpoint.pt mine --average client/weights/live_x2.onnx 0.2
      the same after a run that began with --initial-weights client/weights/live_x2.onnx, and a fifth of the weights from there:
      what the run forgot comes back, where its learning rate was low enough to stay near
  gamesr-export bicubic my-bicubic
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    parser = command_parser(
        "gamesr-export",
        "Write a trained network, with its model card beside it, or a baseline, as a self-describing ONNX artifact.",
        EPILOG,
    )
    parser.add_argument("weights", help=f"a run's checkpoint.pt; or {', '.join(BASELINES)}, for both scales")
    parser.add_argument("name", help="the model's name; its files are NAME_xSCALE.onnx and, of a trained network, .md")
    parser.add_argument("--folder", type=Path, default=WEIGHTS, help="where to (default: %(default)s)")
    parser.add_argument(
        "--average",
        nargs=2,
        metavar=("ARTIFACT", "SHARE"),
        help="take this share of the weights from the .onnx artifact that the run began from",
    )
    parser.add_argument("--force", action="store_true", help="replace files that exist")
    arguments = parser.parse_args(argv)

    def paths_of(*scales: int) -> list[Path]:
        return new_artifacts(arguments.name, scales, arguments.folder, source=Path(arguments.weights), force=arguments.force)

    def work() -> None:
        if arguments.weights in BASELINES:
            if arguments.average:
                raise InputError(f"{arguments.weights} has no weights to be averaged")
            for scale, path in zip((2, 3), paths_of(2, 3), strict=True):
                export_baseline(arguments.weights, scale, path, name=arguments.name)
                print(path)
            return
        checkpoint = load_checkpoint(Path(arguments.weights))
        network = network_of(checkpoint)
        (path,) = paths_of(network.scale)
        card = training_card(checkpoint)
        if arguments.average:
            other, share = Path(arguments.average[0]), _share(arguments.average[1])
            network = averaged(network, other, share)
            card["averaged"] = {"with": load_session(other, "cpu", 1)[1].sha256, "share": share}
        export_network(network, path, name=arguments.name, card=card, page=card_page)
        print(path)

    return run_command(parser.prog, work, debug=arguments.debug, interrupted="stopped")


def _share(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError(f"--average takes an artifact and a share from 0 to 1, not {text!r}") from None
