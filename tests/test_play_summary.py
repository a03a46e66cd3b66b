"""What a player says of itself: a summary that is printed, and times of one model, at one size, that are posted to a service."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from client import play_cli
from client.errors import OutputError
from client.pipeline import FrameDone
from client.play_source import Arrived, Idle
from client.play_summary import PlaySummary
from client.player import Player
from client.sink import NullSink
from client.tiers import TieredUpscaler
from client.timing import deadline_misses, stage_latencies
from server.requests import ClientLatencyRequest
from tests.test_player import Script, moving, player

AGE_NS = 1_000_000_000  # what every frame waited before it was decoded


class Switching(Script):
    """Eight pictures by the best tier, then another size: two by the best, seven by the middle one, one by the last."""

    def __init__(self, tiers: TieredUpscaler) -> None:
        super().__init__(moving(8) + moving(10, 64, 96), age_ns=AGE_NS)
        self._tiers = tiers

    def frames(self, idle: Idle) -> Iterator[Arrived]:
        for item in super().frames(idle):
            if item.frame.pts == 8:
                self._tiers.prepare(64, 96)
            self._tiers.tier = {10: 1, 17: 2}.get(item.frame.pts or 0, self._tiers.tier)
            yield item


def played(tiers: TieredUpscaler, monkeypatch: pytest.MonkeyPatch) -> tuple[PlaySummary, list[FrameDone]]:
    done: list[FrameDone] = []
    account = Player._account

    def keeping(self: Player, frame: FrameDone) -> None:
        done.append(frame)
        account(self, frame)

    monkeypatch.setattr(Player, "_account", keeping)
    playing, _ = player(Switching(tiers), tiers, NullSink())
    return playing.summary(playing.play(), {}), done


def test_one_models_times_are_posted(tiers: TieredUpscaler, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of the tier that showed most of the last size, and by the service's own measure: without what waited before the decoder."""
    summary, done = played(tiers, monkeypatch)
    assert [frame.decoded.width for frame in done] == [48] * 8 + [96] * 10
    posted = summary.posted()
    request = ClientLatencyRequest.model_validate(posted)
    assert request.model_sha256 == tiers.specs[1].sha256 and (request.low_width, request.low_height) == (96, 64)
    stamps = [frame.stamps for frame in done[10:17]]
    assert posted["latency_us"] == {stage: latency.record() for stage, latency in stage_latencies(stamps).items()}
    totals_ns = [passed.written_ns - passed.packet_ns for passed in stamps]
    assert posted["deadline_misses"] == {str(fps): deadline_misses(totals_ns, fps) for fps in (30, 60, 120)}
    assert summary.tally.latencies(network=False)["total"].p50 >= AGE_NS / 1000 > request.latency_us.total.max


def test_nothing_of_another_size_is_posted(tiers: TieredUpscaler, monkeypatch: pytest.MonkeyPatch) -> None:
    summary, _ = played(tiers, monkeypatch)
    summary.tally.resize((32, 32))
    with pytest.raises(OutputError, match="no picture of the last size"):
        summary.posted()


@pytest.mark.parametrize("output", [["--json"], []])
def test_a_summary_that_cannot_be_printed_is_one_sentence(
    make_clip: Callable[..., Path],
    model_file: Callable[..., Path],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    output: list[str],
) -> None:
    with Path("/dev/full").open("w") as full:
        monkeypatch.setattr("sys.stdout", full)
        command = [str(make_clip()), "--model", str(model_file()), "--sink", "null", "--provider", "cpu", "--deadline-ms", "100000"]
        assert play_cli.main([*command, "--threads", "1", *output]) == 1
    said = capsys.readouterr().err
    assert said.endswith("\ngamesr-play: [Errno 28] No space left on device\n") and "Traceback" not in said
