"""Schemathesis drives everything that the OpenAPI describes: no 5xx, answers as described, whatever is sent and in whatever order."""

from __future__ import annotations

import json
import os
import random
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from tests.measured import latency_results, sweep_results
from tests.serving import KEY, ROOT, serving, settings
from tests.test_serve import filled

EXAMPLES = 100
# Where a caller's parts are each fine and do not fit together (a height that the clip has not got, percentiles that fall), a
# schema cannot say so: 422 is right for what the schema calls valid. Of what it saw in answers (names
# above all) schemathesis would send nothing else where it can, and run out of it after a few examples: that is what sequences do.
CONFIG = """\
[checks]
positive_data_acceptance.expected-statuses = ["2xx", "401", "403", "404", "409", "415", "422", "429"]

[phases.fuzzing.extra-data-sources]
responses = false
"""


def test_no_5xx_and_every_answer_as_described(make_clip: Callable[..., Path], tmp_path: Path) -> None:
    (tmp_path / "clips").mkdir()
    clip = make_clip("clips/clip.mkv", width=96, height=72)
    of = settings(tmp_path, clips=clip.parent, api_key=KEY, queued_sweeps=3, events_s=0.1, uploads_kept=2, decode_s=5)
    filled(of.store, sweep_results(("map",), (540,)), latency_results(("map",), (540,)))
    (tmp_path / "schemathesis.toml").write_text(CONFIG)
    seed = int(os.environ.get("GAMESR_FUZZ_SEED", random.randrange(2**32)))
    print(f"seed {seed}: GAMESR_FUZZ_SEED={seed} runs the same again")
    environment = os.environ | {"SCHEMATHESIS_HOOKS": "tests.fuzzing", "GAMESR_FUZZ_CLIP": str(clip), "PYTHONPATH": str(ROOT)}
    with serving(of) as client:
        description = f"{client.base_url}/api/v1/openapi.json".replace("//api", "/api")

        def fuzz(*more: str) -> Counter[str]:
            command = [
                *(str(Path(sys.executable).with_name("schemathesis")), "--config-file", str(tmp_path / "schemathesis.toml")),
                *("run", description, "--header", f"X-API-Key: {KEY}", "--max-examples", str(EXAMPLES), "--continue-on-failure"),
                *("--seed", str(seed), "--suppress-health-check", "all", "--no-color", "--request-timeout", "60"),
                *("--report", "ndjson", "--report-ndjson-path", str(tmp_path / "events.ndjson"), *more),
            ]
            done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
            print(f"{done.stdout}{done.stderr}")
            assert done.returncode == 0
            return examples(tmp_path / "events.ndjson")

        counts = fuzz("--phases", "fuzzing,stateful", "--workers", "2")
        wanted = {
            f"{method.upper()} {path}": EXAMPLES
            if operation.get("parameters") or operation.get("requestBody")
            else 1  # else one is all there is
            for path, operations in client.get("/api/v1/openapi.json").json()["paths"].items()
            for method, operation in operations.items()
        }
        for name in [name for name, number in wanted.items() if counts[name] < number]:
            counts += fuzz("--phases", "fuzzing", "--include-name", name)  # it gives some up early when it works at two at a time
        statuses = re.findall(r'^gamesr_http_requests_total\{.*status="(\d+)"', client.get("/metrics").text, re.MULTILINE)
    assert statuses and all(int(status) < 500 for status in statuses)
    assert not {name: counts[name] for name, number in wanted.items() if counts[name] < number}


def examples(events: Path) -> Counter[str]:
    """How many schemathesis tried of each operation alone, before it tried sequences."""
    counts = Counter[str]()
    for line in events.read_text().splitlines():
        event = json.loads(line).get("ScenarioFinished")
        if event and event["phase"] == "fuzzing":
            counts[event["recorder"]["label"]] += len(event["recorder"]["cases"])
    return counts
