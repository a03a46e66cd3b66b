"""What a player saw of a stream over a network that loses, in figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import groupby

from client.quality import psnr_db
from client.timing import percentile


class View(Enum):
    """What was on the screen at a picture's time."""

    CLEAN = "the picture, as it was sent"
    DAMAGED = "the picture, marked as damaged"
    FROZEN = "one from before"


@dataclass(frozen=True)
class Viewing:
    """What was on the screen at the time of every picture that was sent, and how far from the original.

    `errors` are mean squared errors of luma by upscaler and picture. A run is a number of pictures.
    """

    fps: int
    packets: int
    lost: int
    keyframe_requests: int
    views: Sequence[View]
    errors: Mapping[str, Sequence[float]]

    def count(self, view: View) -> int:
        return sum(seen is view for seen in self.views)

    @property
    def freezes(self) -> list[int]:
        """The runs in which the picture stood still."""
        return self._runs({View.FROZEN})

    @property
    def recoveries(self) -> list[int]:
        """The runs from a loss to the next clean picture; one that the end cuts off counts as far as it came."""
        return self._runs({View.FROZEN, View.DAMAGED})

    def psnr_y_db(self, upscaler: str) -> float | None:
        """Of the mean squared error of all pictures; None where there is none."""
        errors = self.errors[upscaler]
        return _psnr(sum(errors) / len(errors))

    def psnr_y_p5_db(self, upscaler: str) -> float | None:
        """The 5th percentile of the pictures."""
        return _psnr(percentile(sorted(self.errors[upscaler], reverse=True), 5))  # the greatest error is the least PSNR

    def _runs(self, views: set[View]) -> list[int]:
        return [len(list(run)) for within, run in groupby(self.views, lambda view: view in views) if within]


def _psnr(error: float) -> float | None:
    return psnr_db(error) if error else None
