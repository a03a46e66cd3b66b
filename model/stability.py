"""The hard cases by name: what is played, for how long, and what else must hold than the bounds of every case."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from client.cloud import area_downscale
from client.errors import InputError, ModelError
from client.frames import Frame
from client.quality import psnr_db, squared_error
from client.synthetic import synthetic_frames
from model import hard_cases as pictures
from model import probes
from model.probes import LeftOut
from model.trial import SETTLED_AFTER, Outcome, Subject, trial
from model.verify import Played, crop

Run = Callable[[Subject, int], Outcome]
CLIP_FRAMES = {True: 60, False: 12}  # in full and in short: what of the clip is played forwards and backwards
BITS_PER_PIXEL = 500_000 / (960 * 540 * 60)  # 500 kbps at 540p and 60 frames/s
PSNR_DRIFT_DB = 0.01
STATE_AT_REST = 1e-2  # RMS change of the state from frame to frame at the end of a still


@dataclass(frozen=True)
class Case:
    """A hard case: `short` steps take a continuous integration seconds, `full` ones are what is reported."""

    name: str
    what: str
    run: Run
    short: int
    full: int


def run_cases(subject: Subject, cases: Iterable[Case]) -> Iterator[tuple[Case, Outcome]]:
    """Each case and what came of it; an artifact that fails altogether fails the case, not the run, and pictures too large leave it out."""
    for case in cases:
        try:
            outcome = case.run(subject, case.full if subject.full else case.short)
        except (LeftOut, InputError) as reason:
            outcome = Outcome(subject.width, subject.height, 0, left_out=str(reason))
        except ModelError as error:
            outcome = Outcome(subject.width, subject.height, 0, failures=(str(error),))
        yield case, outcome


HEADER = (
    "| case | size | steps | codes | differing | state error | RMS | drift/1,000 | largest state | NaN | p50 ms | result |\n"
    "|---|---|---|---|---|---|---|---|---|---|---|---|"
)


def table_row(case: Case, outcome: Outcome) -> str:
    """One line of Markdown under `HEADER`; a dash is what the artifact does not have or the run was too short for."""
    if outcome.left_out:
        result = f"left out: {outcome.left_out}"
    else:
        result = "; ".join(filter(None, ("pass" if outcome.passed else "**FAIL**", *outcome.failures, outcome.remark)))
    cells = (
        case.name,
        f"{outcome.width}x{outcome.height}",
        f"{outcome.steps:,}",
        "-" if outcome.max_code_error is None else str(outcome.max_code_error),
        *(
            "-" if value is None else f"{value:.1e}"
            for value in (outcome.differing_share, outcome.state_error_share, outcome.rms_state_error, outcome.drift_per_1000_frames)
        ),
        "-" if outcome.largest_state is None else f"{outcome.largest_state:.3g}",
        str(outcome.nan_frames),
        "-" if outcome.latency_us is None else f"{outcome.latency_us.p50 / 1000:.1f}",
        result,
    )
    return f"| {' | '.join(cells)} |"


def _made(make: Callable[[int, int, int], Iterator[Frame]]) -> Run:
    return lambda subject, steps: trial(subject, make(subject.width, subject.height, steps), steps)


def _footage(subject: Subject, steps: int) -> Outcome:
    frames = [crop(frame, subject.width, subject.height) for frame in _clip(subject)]
    return trial(subject, pictures.there_and_back(frames, steps), steps)


def _full_size(subject: Subject, steps: int) -> Outcome:
    return trial(subject, pictures.there_and_back(_clip(subject), steps), steps)


def _blocking(subject: Subject, steps: int) -> Outcome:
    whole = [crop(frame, frame.width // 2 * 2, frame.height // 2 * 2) for frame in _clip(subject)]  # x264 takes no odd 4:2:0
    frames = [crop(frame, subject.width, subject.height) for frame in pictures.blocking(whole, BITS_PER_PIXEL)]
    return trial(subject, pictures.there_and_back(frames, steps), steps)


def _clip(subject: Subject) -> list[Frame]:
    if not subject.clip:
        raise LeftOut("no clip was given")
    return list(subject.clip[: CLIP_FRAMES[subject.full]])


def _still(subject: Subject, steps: int) -> Outcome:
    """One picture held: neither PSNR nor state may drift once the state has settled, and no sample may flicker."""
    scale = subject.upscaler.spec.scale
    width, height = subject.width * scale, subject.height * scale
    whole = subject.clip[0] if subject.clip else next(synthetic_frames(width, height, 1))
    if whole.width < width or whole.height < height:
        raise LeftOut(f"the clip is smaller than {width}x{height}")
    truth = crop(whole, width, height)
    watch = _Stillness(truth, min(SETTLED_AFTER, steps // 2))
    outcome = trial(subject, [area_downscale(truth, scale)] * steps, steps, watch)
    return outcome.noting(
        f"PSNR-Y {watch.settled_db:.3f} dB at frame {watch.settled_after}, {watch.psnr_change_db:+.4f} at the end; "
        f"{watch.flickering:.1e} of the samples flicker",
        (abs(watch.psnr_change_db) <= PSNR_DRIFT_DB, f"PSNR drifts by {watch.psnr_change_db:+.4f} dB"),
        (watch.largest_change <= 1, f"samples of a still change by {watch.largest_change} codes"),
        (watch.flickering <= subject.bounds.flickering, f"{watch.flickering:.1e} of the samples flicker"),
        (watch.state_change <= STATE_AT_REST, f"the state still moves by {watch.state_change:.1e} a frame (RMS)"),
    )


class _Stillness:
    """Sees the pictures of a still go by, and says what changed after the first `settled_after` of them.

    `flickering` is the share of the samples of all planes that went one way and back; a sample that creeps over a rounding
    limit once does not flicker. `state_change` is the RMS change of the state in the last frame.
    """

    def __init__(self, truth: Frame, settled_after: int) -> None:
        self.settled_after = settled_after
        self.settled_db = self.last_db = math.inf
        self.largest_change = 0
        self.state_change = 0.0
        self._truth = truth.y
        self._last: tuple[NDArray[np.int16], list[NDArray[np.floating]]] | None = None
        self._direction = np.zeros_like(probes.samples_of(truth))
        self._flickered = np.zeros(self._direction.shape, np.bool_)

    def __call__(self, step: int, played: Played) -> None:
        luma, samples = played.picture.y, probes.samples_of(played.picture)
        squared = squared_error(self._truth, luma)
        self.last_db = psnr_db(squared / luma.size) if squared else math.inf
        if step == self.settled_after:
            self.settled_db = self.last_db
        if self._last is not None and step > self.settled_after:
            last_samples, last_state = self._last
            change = samples - last_samples
            self._flickered |= np.sign(change) * self._direction < 0
            self._direction = np.where(change, np.sign(change), self._direction)
            self.largest_change = max(self.largest_change, int(np.abs(change).max()))
            self.state_change = _rms_change(last_state, played.state)
        self._last = samples, played.state

    @property
    def psnr_change_db(self) -> float:
        return 0.0 if self.last_db == self.settled_db else self.last_db - self.settled_db

    @property
    def flickering(self) -> float:
        return float(self._flickered.mean())


def _rms_change(before: list[NDArray[np.floating]], after: list[NDArray[np.floating]]) -> float:
    squares = [np.square(a - b, dtype=np.float64).ravel() for a, b in zip(after, before, strict=True)]
    return float(np.sqrt(np.concatenate(squares).mean())) if squares else 0.0


CASES = (
    Case("footage", "the clip's frames, cropped, played forwards and backwards", _footage, 40, 10_000),
    Case("full-size", "the same, the whole picture", _full_size, 2, 300),
    Case("still", "one picture held: no drift, no flicker, a state at rest", _still, 140, 5_000),
    Case("black", "nothing but black", _made(pictures.black), 16, 1_000),
    Case("white", "nothing but white", _made(pictures.white), 16, 1_000),
    Case("saturated", "moving bars of the most saturated colours and of codes beyond them", _made(pictures.saturated), 16, 1_000),
    Case("checkerboard", "black and white from pixel to pixel and frame to frame", _made(pictures.checkerboard), 16, 1_000),
    Case("lines", "moving lines one pixel wide: upright, level, oblique", _made(pictures.lines), 16, 1_000),
    Case("text", "scrolling small letters", _made(pictures.text), 16, 1_000),
    Case("noise", "white noise over all codes of all planes", _made(pictures.noise), 16, 1_000),
    Case("grain", "a still picture under new film grain in every frame", _made(pictures.grain), 16, 1_000),
    Case("flashes", "black and white in turn, frame by frame", _made(pictures.flashes), 16, 1_000),
    Case("fade", "a slow fade to black over the whole run", _made(pictures.fade), 32, 1_000),
    Case("cuts", "another scene every 8 frames", _made(pictures.cuts), 24, 1_000),
    Case("hud", "a still panel and letters over a moving wall", _made(pictures.hud), 16, 1_000),
    Case("blocking", "the clip through x264 at the bits per pixel of 500 kbps at 540p", _blocking, 16, 1_000),
    Case("limited-range", "moving ramps over the codes of limited range", _made(pictures.limited_range), 16, 1_000),
    Case("full-range", "moving ramps over all codes, 0 and 255 included", _made(pictures.full_range), 16, 1_000),
    Case("sizes", "sizes from 1x1 on, odd ones too; in full up to an output of 4K", probes.sizes, 2, 2),
    Case("lost-state", "NaN and Inf put into the state: caught, and reset to a first frame", probes.lost_state, 3, 10),
    Case("denormals", "a state of denormal numbers: gone after a frame, and no frame after it is slower", probes.denormals, 5, 50),
    Case("threads", "1, 2, 3 and 4 threads: the same to the bit", probes.threads, 4, 100),
    Case("providers", "every provider of the installed runtime agrees", probes.providers, 4, 100),
)
