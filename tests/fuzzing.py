"""What schemathesis is told of this service: a clip that is there, how a real one looks, and that percentiles rise."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import schemathesis
from hypothesis import strategies as st

from server.requests import NAME

CLIP = os.environ["GAMESR_FUZZ_CLIP"]
PERCENTILES = ("p50", "p95", "p99", "max")


@schemathesis.hook
def map_body(context: Any, body: Any) -> Any:
    """One clip is the one that is there; half of the percentiles rise."""
    if isinstance(body, dict) and isinstance(body.get("clips"), list):
        match body["clips"]:
            case [str(name)] if re.fullmatch(NAME, name):
                return body | {"clips": [Path(CLIP).name]}
    if isinstance(body, dict) and isinstance(body.get("latency_us"), dict) and len(body) % 2 == 0:
        for stage in body["latency_us"].values():
            if isinstance(stage, dict) and all(isinstance(stage.get(name), int | float) for name in PERCENTILES):
                stage |= dict(zip(PERCENTILES, sorted(stage[name] for name in PERCENTILES), strict=True))
    return body


def beginning(end: int) -> bytes:
    return REAL[:end]


REAL = Path(CLIP).read_bytes()
for kind in ("video/mp4", "application/octet-stream"):
    cut = st.integers(0, len(REAL)).map(beginning)
    schemathesis.openapi.media_type(kind, st.one_of(st.binary(max_size=200), cut, st.just(REAL)))
