"""Jobs on a Dask cluster (extra `dask`): the same ones, in the same code, on machines that see the same files."""

from __future__ import annotations

from collections.abc import Iterator
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from client.errors import GamesrError, how_to_install
from server.job import Failed, Job, Outcome, run_job

if TYPE_CHECKING:
    from distributed import Client

_CONNECT_S = 10
_RETRIES = 2


class DaskWorkers:
    """The workers of the scheduler at `address`, one job a thread of theirs; a context manager.

    Start them with `--nthreads 1` and as many as there are cores. A job whose worker is lost is run again elsewhere. Clips,
    and models given as files, must be there under the same paths on every machine, and are checked by their sha256.
    Raises GamesrError where the extra is missing, or no scheduler or worker answers.
    """

    def __init__(self, address: str) -> None:
        try:
            from distributed import Client
        except ImportError as error:
            raise GamesrError(f"--dask needs the extra `dask`: {how_to_install('dask')}") from error
        try:
            self._client: Client = Client(address, timeout=_CONNECT_S)
        except (OSError, ValueError) as error:
            raise GamesrError(f"no Dask scheduler answers at {address}") from error
        try:
            self._client.wait_for_workers(1, timeout=_CONNECT_S)
        except TimeoutError as error:
            self._client.close()
            raise GamesrError(
                f"the Dask scheduler at {address} has no worker: start some with dask worker {address} --nthreads 1"
            ) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._client.close()

    @property
    def count(self) -> int:
        return max(1, int(sum(self._client.nthreads().values())))

    def run(self, jobs: Iterator[Job]) -> Iterator[Outcome]:
        from distributed import as_completed

        running = as_completed()
        taken: dict[Any, Job] = {}
        try:
            while True:
                while len(taken) < self.count and (job := next(jobs, None)):
                    future = self._client.submit(_execute, job, pure=False, retries=_RETRIES)
                    taken[future] = job
                    running.add(future)
                if not taken:
                    return
                future = next(running)
                job = taken.pop(future)
                error = future.exception()
                if error is None:
                    yield from future.result()
                else:
                    yield from (Failed(ask.point, f"the cluster gave it up: {error}", repr(error)) for ask in job.asks)
        finally:
            self._client.cancel(list(taken))


def _execute(job: Job) -> list[Outcome]:
    return list(run_job(job))
