"""The same points on a Dask cluster: a real scheduler and two worker processes, of which one is killed in mid-sweep."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from distributed import Client, LocalCluster

from client.errors import GamesrError
from server.cluster import DaskWorkers
from server.events import PointDone, PointFailed
from server.store import Store
from server.sweep import run_sweep
from tests.sweeping import done, plan_of, results, sweep_here


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[LocalCluster]:
    with LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=":0", worker_dashboard_address=None, local_directory=str(tmp_path)
    ) as cluster:
        yield cluster


def kill_one_at_work(cluster: LocalCluster) -> bool:
    """False where none is: on a busy machine what was at work may be done before it is looked for."""
    with Client(cluster.scheduler_address) as client:
        busy = [address for address, tasks in client.processing().items() if tasks]
        if not busy:
            return False
        (pid,) = client.run(os.getpid, workers=busy[:1]).values()
    os.kill(pid, signal.SIGKILL)
    return True


def test_with_a_worker_killed_in_mid_sweep_every_point_comes_out_once_and_as_here(
    make_clip: Callable[..., Path], tmp_path: Path, cluster: LocalCluster
) -> None:
    short, long = (make_clip(f"{frames}.mkv", frames=frames, width=96, height=72) for frames in (6, 120))
    plan = plan_of(short, long, upscalers="none,bicubic,lanczos", bitrates=[200, 300])
    # One long job beside short ones: when the first point comes back, the long one is at work, or one that comes later.
    jobs = sorted(plan.jobs, key=lambda job: job.clip == long)
    plan = replace(plan, jobs=(jobs.pop(), *jobs))
    events, killed = [], False
    with Store(tmp_path / "cluster") as store, DaskWorkers(cluster.scheduler_address) as workers:
        assert workers.count == 2
        for event in run_sweep(plan, store, workers):
            if isinstance(event, PointDone) and not killed:
                killed = kill_one_at_work(cluster)
            events.append(event)
    assert killed
    here = results(sweep_here(plan, tmp_path / "here"))
    assert results(events) == here and len(here) == 20
    assert (done(events).done, done(events).reused, done(events).failed) == (20, 0, 0)


def test_what_goes_wrong_there_is_a_sentence_here(
    make_clip: Callable[..., Path], model_file: Callable[..., Path], tmp_path: Path, cluster: LocalCluster
) -> None:
    model = model_file("mine.onnx")
    plan = plan_of(make_clip("clip.mkv", width=96, height=72), upscalers=f"bicubic,{model}", heights=[36], bitrates=[200])
    model.unlink()
    with Store(tmp_path / "store") as store, DaskWorkers(cluster.scheduler_address) as workers:
        events = list(run_sweep(plan, store, workers))
    reasons = [event.reason for event in events if isinstance(event, PointFailed)]
    assert reasons == [f"model {model} cannot be read: No such file or directory"]
    assert len(results(events)) == 1


def test_a_cluster_without_workers_is_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("server.cluster._CONNECT_S", 1)
    with (
        LocalCluster(n_workers=0, dashboard_address=":0", local_directory=str(tmp_path)) as empty,
        pytest.raises(GamesrError, match="no worker"),
    ):
        DaskWorkers(empty.scheduler_address)
