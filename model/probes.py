"""Hard cases that are no clip: odd sizes, poisoned and denormal states, other thread counts, other providers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from time import perf_counter_ns

import numpy as np
from numpy.typing import NDArray

from client.cuda import TF32
from client.errors import ProviderError
from client.frames import Frame
from client.runtime import BFLOAT16, FLOAT16, PROVIDERS, is_installed
from client.upscaler import OnnxUpscaler
from model.hard_cases import black, hud, noise
from model.trial import Outcome, Subject, bounds_of, count_subnormals, tally
from model.verify import Played, play

SMALL_SIZES = ((1, 1), (2, 2), (3, 5), (2, 64), (35, 2), (17, 31), (64, 50))
OUTPUT_4K = (3840, 2160)
THREADS = (1, 2, 3, 4)
SLOWER_AT_MOST = 2.0  # denormals cost tenfold and more where they cost; less than this is a machine's noise


class LeftOut(Exception):
    """A case that says nothing about this artifact or on this machine, and why."""


def sizes(subject: Subject, steps: int) -> Outcome:
    """Noise in every size from 1x1 on, odd ones included; in full up to an output of 4K."""
    wanted = list(SMALL_SIZES)
    if subject.full:
        width, height = (side // subject.upscaler.spec.scale for side in OUTPUT_4K)
        wanted += [(width // 4, height // 4), (width // 2 + 1, height // 2 + 1), (width, height)]
    played = (frame for size in wanted for frame in play(subject.upscaler, subject.network, noise(*size, steps)))
    scale = subject.upscaler.spec.scale
    expected = [(scale * width, scale * height) for width, height in wanted for _ in range(steps)]
    wrong: list[int] = []

    def watch(step: int, frame: Played) -> None:
        if (frame.picture.width, frame.picture.height) != expected[step - 1]:
            wrong.append(step)

    outcome = tally(subject, played, watch)
    return outcome.noting(
        f"{len(wanted)} sizes from 1x1 on", (not wrong, f"{len(wrong)} pictures have another size than scale times the frame's")
    )


def lost_state(subject: Subject, steps: int) -> Outcome:
    """NaN or Inf put into the state: the next frame must be a first frame again, to the bit, and so those that follow it.

    A lone Inf in a hidden state may saturate gates and be gone, since what a step takes in is what the step before gave
    out, and that is where the client looks; it must then leave nothing behind that is not finite.
    """
    _needs_state(subject)
    frames = list(hud(subject.width, subject.height, 2 * steps))
    before, after = frames[:steps], frames[steps:]
    fresh = [played.picture for played in play(subject.upscaler, None, after)]
    remembered = [played.state for played in play(subject.upscaler, None, before)][-1]
    caught = tried = 0
    unnoticed: list[str] = []
    for index, spec in enumerate(subject.upscaler.spec.state):
        for poison in (np.nan, np.inf, -np.inf):
            for everywhere in (False, True):
                tensors = [tensor.copy() for tensor in remembered]
                tensors[index][... if everywhere else (0, 0, 0, 0)] = poison
                state = subject.upscaler.state_of(subject.height, subject.width, tensors)
                pictures, restarts = [], []
                for frame in after:
                    picture, state = subject.upscaler.step(frame, state)
                    pictures.append(picture)
                    restarts.append(state.restarted)
                tried += 1
                reset = restarts == [True] + [False] * (steps - 1) and all(map(same_picture, pictures, fresh))
                caught += reset
                absorbed = not np.isnan(poison) and not everywhere and not any(restarts)
                if not reset and not (absorbed and all(np.isfinite(array).all() for array in state.arrays())):
                    unnoticed.append(f"{poison} in {'all' if everywhere else 'one'} of {spec.input}")
    outcome = Outcome(subject.width, subject.height, steps * tried)
    remark = f"{caught} of {tried} caught and reset"
    return outcome.noting(remark, (not unnoticed, f"not caught, or not reset to a first frame: {', '.join(unnoticed)}"))


def denormals(subject: Subject, steps: int) -> Outcome:
    """A state of denormals, then black frames: none may be left after the first frame, and none of those after it be slow."""
    _needs_state(subject)
    height, width = subject.height, subject.width
    frames = list(black(width, height, 4))
    zeros = subject.upscaler.initial_state(height, width).arrays()
    tiny = [np.full_like(tensor, np.finfo(tensor.dtype).smallest_normal / 512) for tensor in zeros]
    subject.upscaler.warm_up(height, width)
    usual_ns: list[list[int]] = []
    times_ns: list[list[int]] = []
    for _ in range(steps):  # in turn, so that what else the machine does hits both
        usual_ns.append(_times_ns(subject.upscaler, frames, zeros))
        times_ns.append(_times_ns(subject.upscaler, frames, tiny))
    # the fastest run of each: the one that nothing else on the machine held up
    first, later = (
        min(ns for run in times_ns for ns in run[part]) / min(ns for run in usual_ns for ns in run[part])
        for part in (slice(0, 1), slice(1, None))
    )
    _, state = subject.upscaler.step(frames[0], subject.upscaler.state_of(height, width, tiny))
    left = sum(count_subnormals(array) for array in state.arrays())
    outcome = replace(Outcome(width, height, 2 * steps * len(frames)), subnormals=left)
    return outcome.noting(
        f"the frame given them takes {first:.1f} times as long, those after it {later:.2f} times",
        (later <= SLOWER_AT_MOST, f"frames after a denormal state take {later:.1f} times as long"),
        (left == 0, f"{left} denormal values are left in the state after a frame"),
    )


def threads(subject: Subject, steps: int) -> Outcome:
    """The same frames with 1, 2, 3 and 4 threads: pictures and states must be the same to the bit."""
    outcome = _agreement(subject, [OnnxUpscaler(subject.path, provider=subject.upscaler.provider, threads=n) for n in THREADS], steps)
    same = not outcome.max_code_error and not outcome.max_state_error
    return outcome.noting(f"{', '.join(map(str, THREADS))} threads", (same, "thread counts differ"))


def providers(subject: Subject, steps: int) -> Outcome:
    """The same frames through every provider that starts here and computes in float32: pictures must agree as with the reference."""
    upscalers: list[OnnxUpscaler] = []
    refused: list[str] = []
    for name in PROVIDERS:
        if name not in (BFLOAT16, FLOAT16, TF32) and is_installed(name):
            try:
                upscalers.append(OnnxUpscaler(subject.path, provider=name))
            except ProviderError as error:  # a runtime for a GPU where there is none says nothing about the artifact
                refused.append(f"not {name}: {error}")
    there = [upscaler.provider for upscaler in upscalers]
    if len(there) < 2:
        raise LeftOut("; ".join((f"no other provider than {' '.join(there)} runs here", *refused)))
    outcome = _agreement(subject, upscalers, steps)
    bounds = bounds_of(subject.upscaler.spec, there[0])  # of what is compared, whatever the other cases run on
    close = (outcome.max_code_error or 0) <= bounds.codes and (outcome.differing_share or 0) <= bounds.differing
    return outcome.noting("; ".join((" and ".join(there), *refused)), (close, "providers differ"))


def same_picture(a: Frame, b: Frame) -> bool:
    return all(np.array_equal(p, q) for p, q in zip((a.y, a.u, a.v), (b.y, b.u, b.v), strict=True))


def samples_of(frame: Frame) -> NDArray[np.int16]:
    """All samples of the three planes in one row, with room for their differences."""
    return np.concatenate([plane.ravel() for plane in (frame.y, frame.u, frame.v)]).astype(np.int16)


def _needs_state(subject: Subject) -> None:
    if not subject.upscaler.spec.state:
        raise LeftOut("it has no state")


def _times_ns(upscaler: OnnxUpscaler, frames: Sequence[Frame], tensors: Sequence[NDArray[np.floating]]) -> list[int]:
    state = upscaler.state_of(frames[0].height, frames[0].width, tensors)
    stamps = [perf_counter_ns()]
    for frame in frames:
        _, state = upscaler.step(frame, state)
        stamps.append(perf_counter_ns())
    return [after - before for before, after in pairwise(stamps)]


def _agreement(subject: Subject, upscalers: Sequence[OnnxUpscaler], steps: int) -> Outcome:
    """How far the others are from the first, as errors of an outcome."""
    (pictures, state), *others = (_pictures_and_states(upscaler, subject, steps) for upscaler in upscalers)
    return Outcome(
        subject.width,
        subject.height,
        steps * len(upscalers),
        max_code_error=max(int(np.abs(other - pictures).max()) for other, _ in others),
        differing_share=max(float(np.mean(other != pictures)) for other, _ in others),
        max_state_error=float(np.max([np.abs(other - state).max() for _, other in others])) if state.size else None,
        largest_state=float(np.abs(state).max()) if state.size else None,
    )


def _pictures_and_states(upscaler: OnnxUpscaler, subject: Subject, steps: int) -> tuple[NDArray[np.int16], NDArray[np.float64]]:
    """All samples of all pictures, and the last state, each in one row."""
    played = list(play(upscaler, None, hud(subject.width, subject.height, steps)))
    state = [tensor.ravel().astype(np.float64) for tensor in played[-1].state]
    return np.concatenate([samples_of(p.picture) for p in played]), np.concatenate(state or [np.zeros(0)])
