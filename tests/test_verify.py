"""Holding an artifact against its reference: no error is lost on the way to its bound, and what is no artifact of ours is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from client.frames import Frame
from model.trial import BOUNDS, broken_by
from model.verify import StepError, parity_row, step_error

SOUND = StepError("cpu", 1, 0, 0, 0.0, None, 1e-7, 1e-8, 1.0, 1000)
BOUND = BOUNDS["float32"]


@pytest.mark.parametrize("place", [0, 100, 199])
@pytest.mark.parametrize("figure", ["max_state_error", "largest_state"])
def test_an_error_that_is_no_number_breaks_a_bound_in_any_frame(figure: str, place: int) -> None:
    errors = [SOUND] * 200
    assert not broken_by(errors, BOUND)
    errors[place] = replace(SOUND, **{figure: np.nan})
    assert broken_by(errors, BOUND) == ["nan of state error, at most 3e-05 allowed"]


@pytest.mark.parametrize("place", [0, 1, 2])
@pytest.mark.parametrize("figure", ["max_state_error", "rms_state_error"])
def test_an_error_that_is_no_number_is_shown_in_whatever_frame(figure: str, place: int) -> None:
    errors = [SOUND] * 3
    assert "nan" not in parity_row("any", errors)
    errors[place] = replace(SOUND, **{figure: np.nan})
    assert parity_row("any", errors).count("| nan |") == 1


@pytest.mark.parametrize("place", [0, 1])
def test_a_state_that_is_no_number_is_one_in_its_figures(place: int) -> None:
    planes = [np.zeros(shape, np.uint8) for shape in ((4, 6), (2, 3), (2, 3))]
    state = [np.ones((1, 2, 2, 3)), np.ones((1, 2, 2, 3))]
    error = step_error("cpu", 1, Frame(*planes), [part.copy() for part in state], planes, state)
    assert (error.samples, error.largest_state, error.max_state_error) == (36, 1, 0)
    poisoned = [part.copy() for part in state]
    poisoned[place][0, 0, 0, 0] = np.nan
    error = step_error("cpu", 1, Frame(*planes), poisoned, planes, state)
    assert np.isnan([error.largest_state, error.max_state_error, error.rms_state_error]).all()


def test_the_share_that_differs_is_one_of_samples_and_not_of_frames() -> None:
    small, large = (replace(SOUND, differing_pixels=share, samples=count) for share, count in ((0.5, 6), (0.0, 10_000)))
    assert not broken_by([small, large], BOUND)
    (broken,) = broken_by([replace(small, samples=10_000), replace(large, samples=6)], BOUND)
    assert broken == "0.5 of the samples differ, at most 0.001 allowed"
