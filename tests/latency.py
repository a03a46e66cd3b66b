"""What a live frame takes, by stage: `python -m tests.latency MODEL... [--provider P] [--runs N] [--seconds S]` prints a table.

Every run is a player in a process of its own beside a sender in another, on loopback; nothing is shown. The models take turns, and the
figures are medians over the runs.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from statistics import median

from client.runtime import PROVIDERS
from tests.playing import ROOT, streamed

PLAY = "import sys; from client.play_cli import main; sys.exit(main())"
PERCENTILES = ("p50", "p95", "p99")


def played(model: str, provider: str, seconds: float, port: int) -> dict[str, dict[str, float]]:
    """Microseconds by stage and percentile."""
    address = f"127.0.0.1:{port}"
    options = ["--sink", "null", "--provider", provider, "--model", model, "--seconds", str(seconds), "--json"]
    with streamed(address):
        done = subprocess.run([sys.executable, "-c", PLAY, address, *options], cwd=ROOT, capture_output=True, text=True, check=True)
    record = json.loads(done.stdout)
    print(f"{model}: {record['frames']}", file=sys.stderr)
    latency: dict[str, dict[str, float]] = record["latency_us"]
    return latency


def main() -> None:
    parser = argparse.ArgumentParser(prog="tests.latency")
    parser.add_argument("models", nargs="+", metavar="MODEL")
    parser.add_argument("--provider", choices=PROVIDERS, default="cpu")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=12)
    arguments = parser.parse_args()
    runs: dict[str, list[dict[str, dict[str, float]]]] = {model: [] for model in arguments.models}
    for run in range(arguments.runs):
        for index, model in enumerate(arguments.models):
            port = 5200 + run * len(runs) + index  # each its own: nothing of the run before is on its way
            runs[model].append(played(model, arguments.provider, arguments.seconds, port))
    print("| stage, ms | " + " | ".join(f"{model} {name}" for model in runs for name in PERCENTILES) + " |")
    print("|---" * (1 + len(runs) * len(PERCENTILES)) + "|")
    for stage in next(iter(runs.values()))[0]:
        cells = [median(run[stage][name] for run in of_model) / 1000 for of_model in runs.values() for name in PERCENTILES]
        print(f"| {stage} | " + " | ".join(f"{cell:.2f}" for cell in cells) + " |")


if __name__ == "__main__":
    main()
