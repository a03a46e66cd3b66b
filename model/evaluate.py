"""The table of test scenes: every artifact on every degraded clip, measured against the reference, one row at a time."""

from __future__ import annotations

import functools
import hashlib
import json
import os
import time
from collections.abc import Iterable, Iterator, Sequence
from importlib.metadata import version
from pathlib import Path
from statistics import fmean
from typing import Any

import av
import onnxruntime

from client.cores import machine_name
from client.errors import InputError, ModelError
from client.models import WEIGHTS, find_model
from client.pipeline import upscale_stream
from client.quality import QualityMeter
from client.runtime import OPENVINO, openvino
from client.sink import NullSink
from client.upscaler import OnnxUpscaler
from client.video import Decoded
from client.vmaf import why_unavailable
from model.footage import Degradation, FootageCache, Pair, Scene, check_films, load_pairs

Row = dict[str, Any]
_KEY = ("clip", "footage", "scale", "model", "sha256", "frames", "provider", "versions")
_BEGINNING = b'{"clip": '  # of every row


def evaluate(
    scenes: Sequence[Scene],
    cache: FootageCache,
    *,
    models: Sequence[str],
    scales: Sequence[int],
    degradations: Sequence[Degradation],
    provider: str = "cpu",
    threads: int | None,
    store: Path,
) -> Iterator[Row]:
    """Every combination as a row of figures; rows already in `store` (JSON lines) are read from it, new ones appended.

    Rows are told apart by the model's name, so two artifacts of one name are refused, and an artifact named twice has one row.

    Speed is not measured here but by gamesr-bench, so rows may be made while something else runs. A row is known by clip,
    its footage's digest, scale, number of frames, provider, the artifact's digest and the versions of what computes and measures;
    what its card says of parameters and multiply-accumulates stands in the row too. A last row that was not written to its end,
    by a run that was killed, is cut off. Raises what reading footage and models raises, most of it before any measuring.
    """
    known = _read_rows(store)
    upscalers = {scale: _upscalers(models, scale, provider, threads) for scale in scales}
    check_films(scenes, cache, scales, degradations)
    for scale in scales:
        for takes in load_pairs(scenes, cache, scale, degradations):
            for pair in takes:
                for upscaler in upscalers[scale]:
                    spec = upscaler.spec
                    values = pair.title, pair.low.digest, scale, spec.name, spec.sha256, len(pair), provider
                    key = dict(zip(_KEY, (*values, _versions(pair, provider)), strict=True))
                    row = known.get(json.dumps(key))
                    if row is None:
                        row = {**key, **_measure(pair, upscaler)}
                        with store.open("a") as file:
                            file.write(json.dumps(row) + "\n")
                    yield {**row, "parameters": spec.card.get("parameters"), "macs_540p": spec.card.get("macs_540p")}


def left_out(rows: Iterable[Row], scenes: Sequence[Scene], degradations: Sequence[Degradation], frames: int) -> Iterator[str]:
    """What of all that was asked for the rows do not have, in sentences."""
    for title, count in {row["clip"].split()[0]: row["frames"] for row in rows if row["frames"] < frames}.items():
        yield f"{title} has {count} frames only, of the {frames} that were asked for"
    for degradation in dict.fromkeys(degradations):
        titles = [scene.title for scene in scenes if not degradation.fits(scene)]
        if titles:
            yield f"{', '.join(titles)} was left out of {degradation}, for which it was not rendered"


def _upscalers(models: Sequence[str], scale: int, provider: str, threads: int | None) -> list[OnnxUpscaler]:
    """Each artifact once; raises ModelError for one of another scale and for two of one name."""
    by_name: dict[str, tuple[Path, OnnxUpscaler]] = {}
    for path in (find_model(model, scale) for model in models):
        upscaler = OnnxUpscaler(path, provider=provider, threads=threads)
        name, sha256 = upscaler.spec.name, upscaler.spec.sha256
        if upscaler.spec.scale != scale:
            raise ModelError(f"{path} upscales by {upscaler.spec.scale} and not by {scale}: measure it at its own scale alone")
        other, known = by_name.setdefault(name, (path, upscaler))
        if known.spec.sha256 != sha256:
            raise ModelError(f"{other} and {path} are different models of one name, {name!r}: export one of them under another")
    return [upscaler for _, upscaler in by_name.values()]


def _measure(pair: Pair, upscaler: OnnxUpscaler) -> Row:
    with QualityMeter(pair.high.width, pair.high.height) as meter:
        for index, done in enumerate(upscale_stream(_decoded(pair), upscaler, NullSink())):
            meter.add(pair.high.frame(index), done.picture)
        return meter.result().record()


def _decoded(pair: Pair) -> Iterator[Decoded]:
    for index in range(len(pair)):
        now = time.perf_counter_ns()
        yield Decoded(pair.low.frame(index), now, now)


def _versions(pair: Pair, provider: str) -> dict[str, str]:
    """What decides a figure beside its inputs: a row of other versions, or of a time without VMAF, is measured again."""
    versions = {"gamesr": _code(), "av": av.__version__, "onnxruntime": onnxruntime.__version__}
    versions["machine"] = machine_name()  # what it can multiply decides how runtimes round, and whether sums in 8 bits are cut off
    if provider in OPENVINO:
        versions["openvino"] = openvino().__version__
    return versions | {"vmaf": why_unavailable(pair.high.width, pair.high.height) or f"imageio-ffmpeg {version('imageio-ffmpeg')}"}


@functools.cache
def _code() -> str:
    """A digest of the sources between an artifact and its figures: nobody has to remember to raise a version."""
    digest = hashlib.sha256()
    for path in (*sorted(WEIGHTS.parent.glob("*.py")), Path(__file__)):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _read_rows(store: Path) -> dict[str, Row]:
    """The rows of a file by their keys; cuts off a last one that has no end."""
    rows: dict[str, Row] = {}
    content = store.read_bytes() if store.exists() else b""
    whole = content[: content.rfind(b"\n") + 1]
    begun = content[len(whole) :]
    try:
        for line in whole.splitlines():
            row = json.loads(line)
            key = {name: row[name] for name in _KEY[:-1]} | {"versions": row.get("versions")}  # which older rows lack: they fit nothing
            rows[json.dumps(key)] = row
        if begun[: len(_BEGINNING)] != _BEGINNING[: len(begun)]:
            raise ValueError("it does not end as a row would")
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{store} is not a file of rows as this gamesr-evaluate makes them: {error}") from error
    if begun:
        os.truncate(store, len(whole))
    return rows


def table(rows: Iterable[Row]) -> str:
    """Markdown: a line for each game, scale, input and model, figures averaged over the game's scenes."""
    groups: dict[tuple[str, int, str, str], list[Row]] = {}
    for row in rows:
        title, degradation = row["clip"].split()
        groups.setdefault((title.split("/")[0], row["scale"], degradation, row["model"]), []).append(row)
    lines = [
        "| game | scale | input | model | PSNR-Y | PSNR-U | PSNR-V | SSIM-Y | VMAF | VMAF-NEG | temporal error | parameters | GMAC, 540p |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for (game, scale, degradation, model), group in groups.items():
        parameters, macs = group[0]["parameters"], group[0]["macs_540p"]
        cells = [_mean(group, name, digits) for name, digits in _COLUMNS]
        cells += ["" if parameters is None else f"{parameters:,}", "" if macs is None else f"{macs / 1e9:.1f}"]
        lines.append(f"| {game} | x{scale} | {degradation} | {model} | {' | '.join(cells)} |")
    return "\n".join(lines)


_COLUMNS = (
    ("psnr_y_db", 2),
    ("psnr_u_db", 2),
    ("psnr_v_db", 2),
    ("ssim_y", 4),
    ("vmaf", 1),
    ("vmaf_neg", 1),
    ("temporal_error", 2),
)


def _mean(rows: Sequence[Row], name: str, digits: int) -> str:
    values = [row[name] for row in rows]
    return "undefined" if None in values else f"{fmean(values):.{digits}f}"
