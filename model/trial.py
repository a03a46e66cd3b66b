"""What one artifact is put through: frames played, errors tallied, and held against the bounds of its precision."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from client.artifact import ModelSpec
from client.cuda import TF32
from client.errors import ModelError
from client.frames import Frame
from client.runtime import BFLOAT16, FLOAT16
from client.timing import LatencySummary
from client.upscaler import OnnxUpscaler
from model.planes import Network
from model.verify import Played, StepError, play

SETTLED_AFTER = 100  # frames after which a state has forgotten that it began at zeros: drift is counted from here
SHOWN_STEPS = (1, 10, 100, 1_000, 10_000)


@dataclass(frozen=True)
class Bounds:
    """How far an artifact may be from its float64 reference.

    `codes` is the largest error of a picture in code values and `differing` the share of samples that may have one.
    `state` is the largest error of the state relative to the largest value in it (at least 1: cells that integrate for
    long are large, and a float's error is relative), `drift` how much its RMS may grow in 1,000 frames. `flickering` is the
    share of a still's samples that may go back and forth, by one code.
    """

    codes: int
    differing: float
    state: float
    drift: float
    flickering: float


# Rounding to codes turns an error of e into a differing sample for about 2 * e of the samples: float32 on values of a few
# hundred is off by 1e-5 to 1e-4. What was measured, and what the bounds leave above it: docs/stability.md.
BOUNDS = {
    "float32": Bounds(codes=1, differing=1e-3, state=3e-5, drift=1e-6, flickering=1e-4),
    "float16": Bounds(codes=1, differing=0.05, state=0.01, drift=1e-4, flickering=1e-4),
    "bfloat16": Bounds(codes=4, differing=0.4, state=0.1, drift=1e-3, flickering=1e-4),
    "int8": Bounds(codes=16, differing=0.5, state=0.2, drift=1e-2, flickering=1e-4),
}


def bounds_of(spec: ModelSpec, provider: str) -> Bounds:
    """Those of what it computes in: int8 is the coarsest wherever it runs. Raises ModelError for a precision that has none."""
    coarser = {BFLOAT16: "bfloat16", FLOAT16: "float16", TF32: "float16"}  # TF32 has float16's bits and float32's range
    precision = coarser.get(provider, spec.precision) if spec.precision == "float32" else spec.precision
    if precision not in BOUNDS:
        raise ModelError(f"no bounds are stated for the precision {precision} of {spec.name}")
    return BOUNDS[precision]


@dataclass(frozen=True)
class Subject:
    """An artifact under test: `network` is its float64 reference, None for a baseline.

    `clip` holds whole frames of real footage, none where none was given; cases that can be of any size are `width` x
    `height`. `full` chooses the long form of each case and `progress` shows a bar on stderr. Raises ModelError for an artifact
    of a precision that has no bounds.
    """

    path: Path
    upscaler: OnnxUpscaler
    network: Network | None
    clip: Sequence[Frame]
    width: int
    height: int
    full: bool
    progress: bool = False

    def __post_init__(self) -> None:
        bounds_of(self.upscaler.spec, self.upscaler.provider)

    @property
    def bounds(self) -> Bounds:
        return bounds_of(self.upscaler.spec, self.upscaler.provider)


@dataclass(frozen=True)
class Outcome:
    """What came of a case; None is what the artifact does not have (a reference, a state) or the run was too short for.

    Errors are the largest of any step, `differing_share` that of all steps' samples, in units of codes and of the state;
    the drift is the slope of the RMS state error over the frames after the first 100. `nan_frames` counts frames whose
    state came out not finite, `subnormals` values of the state, over all frames, too small for a normal float.
    `errors_at` are the steps 1, 10, 100 and so on. `failures` says which bounds were broken, `left_out` why nothing was run.
    """

    width: int
    height: int
    steps: int
    max_code_error: int | None = None
    differing_share: float | None = None
    max_state_error: float | None = None
    rms_state_error: float | None = None
    drift_per_1000_frames: float | None = None
    largest_state: float | None = None
    nan_frames: int = 0
    subnormals: int = 0
    latency_us: LatencySummary | None = None
    errors_at: tuple[StepError, ...] = ()
    remark: str = ""
    failures: tuple[str, ...] = ()
    left_out: str = ""

    @property
    def passed(self) -> bool | None:
        return None if self.left_out else not self.failures

    @property
    def state_error_share(self) -> float | None:
        """The state's largest error as a share of its largest value, of 1 where that is smaller: what is held against the bound."""
        if self.max_state_error is None:
            return None
        return self.max_state_error / float(np.max((1.0, self.largest_state or 0.0)))

    def record(self) -> dict[str, object]:
        """Every figure by name, ready for JSON."""
        return {**asdict(self), "state_error_share": self.state_error_share, "passed": self.passed}

    def noting(self, remark: str, *checks: tuple[bool, str]) -> Outcome:
        """The same with a remark, and failed where a check (whether it holds, what is wrong where not) does not hold."""
        wrong = tuple(sentence for holds, sentence in checks if not holds)
        return replace(self, remark=remark, failures=self.failures + wrong)


def trial(subject: Subject, frames: Iterable[Frame], steps: int, watch: Callable[[int, Played], None] | None = None) -> Outcome:
    """Play `steps` frames of one size through the artifact and its reference; `watch` is shown each of them, from step 1."""
    played = play(subject.upscaler, subject.network, frames)
    return tally(subject, tqdm(played, total=steps, unit="frame", leave=False, file=sys.stderr, disable=not subject.progress), watch)


def tally(subject: Subject, played: Iterable[Played], watch: Callable[[int, Played], None] | None = None) -> Outcome:
    """Sum up frames that are played one by one, and hold them against the bounds; the size is that of the last picture."""
    durations_ns: list[int] = []
    errors: list[StepError] = []
    width = height = nan_frames = subnormals = 0
    largest: float | None = None
    for step, frame in enumerate(played, 1):
        width, height = frame.picture.width, frame.picture.height
        durations_ns.append(frame.duration_ns)
        nan_frames += frame.restarted
        for tensor in frame.state:
            largest = float(np.max((largest or 0.0, np.abs(tensor).max())))  # Python's max would drop a NaN that does not come first
            subnormals += count_subnormals(tensor)
        if frame.error is not None:
            errors.append(frame.error)
        if watch is not None:
            watch(step, frame)
    scale = subject.upscaler.spec.scale
    outcome = Outcome(width // scale, height // scale, len(durations_ns), nan_frames=nan_frames, subnormals=subnormals)
    outcome = replace(outcome, largest_state=largest, latency_us=LatencySummary.of(durations_ns))
    if errors:
        outcome = _with_errors(outcome, errors)
    return replace(outcome, failures=tuple(_broken(outcome, subject.bounds)))


def broken_by(errors: Sequence[StepError], bounds: Bounds) -> list[str]:
    """What the errors of every step of one run of one provider break, each with what is allowed; none where they break nothing."""
    largest = float(np.max([error.largest_state for error in errors]))
    return list(_broken(_with_errors(Outcome(0, 0, len(errors), largest_state=largest), errors), bounds))


def _with_errors(outcome: Outcome, errors: Sequence[StepError]) -> Outcome:
    outcome = replace(
        outcome,
        max_code_error=max(error.max_code_error for error in errors),
        differing_share=float(np.average([error.differing_pixels for error in errors], weights=[error.samples for error in errors])),
        errors_at=tuple(error for error in errors if error.step in SHOWN_STEPS),
    )
    if outcome.largest_state is None:
        return outcome
    return replace(
        outcome,
        max_state_error=float(np.max([error.max_state_error for error in errors])),
        rms_state_error=float(np.max([error.rms_state_error for error in errors])),
        drift_per_1000_frames=_drift([error.rms_state_error for error in errors]),
    )


def count_subnormals(tensor: NDArray[np.floating]) -> int:
    return int(np.count_nonzero((tensor != 0) & (np.abs(tensor) < np.finfo(tensor.dtype).smallest_normal)))


def _drift(rms_errors: list[float]) -> float | None:
    settled = rms_errors[SETTLED_AFTER:]
    if len(settled) < SETTLED_AFTER:
        return None
    return float(1000 * np.polyfit(np.arange(len(settled)), settled, 1)[0])


def _broken(outcome: Outcome, bounds: Bounds) -> Iterable[str]:
    if outcome.nan_frames:
        yield f"the state was lost in {outcome.nan_frames} frames"
    for value, bound, what in (
        (outcome.max_code_error, bounds.codes, "codes of picture error"),
        (outcome.differing_share, bounds.differing, "of the samples differ"),
        (outcome.state_error_share, bounds.state, "of state error"),
        (outcome.drift_per_1000_frames, bounds.drift, "of drift per 1,000 frames"),
    ):
        if value is not None and not (math.isfinite(value) and value <= bound):
            yield f"{value:.3g} {what}, at most {bound:.3g} allowed"
