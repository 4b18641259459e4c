"""The work of a campaign: what a worker needs, how it drives a chunk, and who drives the chunks.

A chunk of runs is a pure function of the job and its number, so it does not matter who drives it, nor how often.
Workers are processes of this machine, or those of a Dask cluster.
"""

from __future__ import annotations

import functools
import hashlib
import os
import pickle
import signal
import threading
from collections.abc import Iterator
from itertools import islice
from multiprocessing import connection, get_context, parent_process
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from firmware_py.core.conditions import INTERNAL_ERROR
from sim.data_files import Scenario
from sim.errors import UserError
from tools.campaign.draws import DRAWN_FROM_BOX, draw
from tools.campaign.results import Rows, row_of
from tools.campaign.single import MODULES, Runner, Shared, failed_outcome

if TYPE_CHECKING:
    from concurrent.futures import Future

CHUNK_RUNS = 25
"""Runs of a chunk: about a quarter of a second, so that a kill loses little and appending costs nothing."""

LEAST_CHUNKS = 16
"""Small campaigns are cut finer than that."""

WAITING_A_WORKER = 3
"""Chunks that lie ready for each worker."""

CLUSTER_TIMEOUT_S = 10.0


class Job(NamedTuple):
    """All that is needed to drive any run of a campaign."""

    shared: Shared
    scenario: Scenario
    first_seed: int
    runs: int
    chunk_runs: int
    code: str

    @property
    def chunks(self) -> int:
        """How many chunks the runs make."""
        return -(-self.runs // self.chunk_runs)


def chunk_runs_of(runs: int) -> int:
    """Return how many runs make a chunk; it does not depend on who drives them."""
    return max(1, min(CHUNK_RUNS, runs // LEAST_CHUNKS))


def code_digest() -> str:
    """Return a hash of the source of all that a run goes through."""
    import importlib  # noqa: PLC0415
    from pathlib import Path  # noqa: PLC0415

    names = (*MODULES, "tools.campaign.draws", "tools.campaign.results", "tools.campaign.single", "tools.compiled")
    digest = hashlib.sha256()
    for name in names:
        digest.update(Path(str(importlib.import_module(name).__file__)).read_bytes())
    return digest.hexdigest()[:24]


def drive_chunk(job: Job, runner: Runner, chunk: int) -> Rows:
    """Drive the runs of a chunk and return their rows."""
    first = chunk * job.chunk_runs
    vehicle = job.shared.vehicle
    nominal = {name: getattr(vehicle, name) for name in DRAWN_FROM_BOX}
    rows = []
    for run in range(first, min(first + job.chunk_runs, job.runs)):
        drawn = draw(vehicle, job.scenario, job.first_seed + run)
        try:
            outcome = runner.run(drawn.scenario, drawn.side, drawn.seed)
        except (ArithmeticError, ValueError):  # what stops the car in the live loop must not stop the campaign
            outcome = failed_outcome(float(INTERNAL_ERROR))
        rows.append(row_of(run, drawn, outcome, nominal))
    return np.array(rows, dtype=np.float64)


# -- processes of this machine ----------------------------------------------------------------------------------------

_here: tuple[Job, Runner, str] | None = None


def _begin_worker(job: Job) -> None:
    global _here  # noqa: PLW0603 -- what a worker process is made for
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the campaign's own process ends them in good order
    parent = parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()
    _here = (job, Runner(job.shared), code_digest())


def _end_with(sentinel: int) -> None:
    """End this process when its parent has gone, however it went: a worker waits for work for ever."""
    connection.wait([sentinel])
    os._exit(1)


def _drive_here(chunk: int) -> tuple[str, int, Rows]:
    assert _here is not None
    job, runner, code = _here
    return code, chunk, drive_chunk(job, runner, chunk)


def drive_on_this_machine(job: Job, chunks: list[int], workers: int) -> Iterator[tuple[int, Rows]]:
    """Yield (chunk, rows) as they are done, by so many processes."""
    from concurrent.futures import ProcessPoolExecutor  # noqa: PLC0415
    from concurrent.futures.process import BrokenProcessPool  # noqa: PLC0415

    pool = ProcessPoolExecutor(
        min(workers, max(len(chunks), 1)), get_context("spawn"), initializer=_begin_worker, initargs=(job,)
    )
    try:
        waiting = iter(chunks)
        running = {pool.submit(_drive_here, chunk) for chunk in islice(waiting, workers * WAITING_A_WORKER)}
        while running:
            done, running = _wait(running)
            for future in done:
                running |= {pool.submit(_drive_here, chunk) for chunk in islice(waiting, 1)}
                code, chunk, rows = future.result()
                if code != job.code:
                    raise UserError("parkctl's own files have changed since the campaign was begun; begin it anew")
                yield chunk, rows
    except BrokenProcessPool:
        raise UserError(
            "a worker process has ended before its time (out of memory?); what was finished is kept, --resume goes on"
        ) from None
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _wait(running: set[Future[tuple[str, int, Rows]]]) -> tuple[set[Any], set[Any]]:
    from concurrent.futures import FIRST_COMPLETED, wait  # noqa: PLC0415

    done, rest = wait(running, return_when=FIRST_COMPLETED)
    return set(done), set(rest)


# -- a Dask cluster ---------------------------------------------------------------------------------------------------

_driving = threading.Lock()
"""A worker of the cluster may have several threads; numba compiles in one at a time."""


@functools.lru_cache(maxsize=2)
def _runner_of(_digest: str, packed: bytes) -> tuple[Job, Runner]:
    job: Job = pickle.loads(packed)
    return job, Runner(job.shared)


def _unchanged(packed: bytes) -> bytes:
    """Bring the job into the cluster's memory; being a task, it is made again where a worker took it along."""
    return packed


def _drive_there(packed: bytes, digest: str, chunk: int) -> tuple[str, int, Rows]:
    with _driving:
        job, runner = _runner_of(digest, packed)
        return code_digest(), chunk, drive_chunk(job, runner, chunk)


def drive_on_cluster(job: Job, chunks: list[int], address: str) -> Iterator[tuple[int, Rows]]:
    """Yield (chunk, rows) as they are done, by the workers of the Dask cluster with its scheduler at the address.

    A worker that is lost is no matter: Dask gives its chunks to the others.
    """
    try:
        import distributed  # noqa: PLC0415
    except ImportError:
        raise UserError(
            "--scheduler needs dask.distributed: install parkctl with its extra, parkctl[cluster]"
        ) from None
    dask: Any = distributed
    try:
        client = dask.Client(address, timeout=CLUSTER_TIMEOUT_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError, ImportError, TypeError) as error:
        text = " ".join(str(error).split())[:160] or type(error).__name__
        raise UserError(f"--scheduler {address}: no Dask scheduler answers there ({text})") from None
    try:
        packed = pickle.dumps(job)
        digest = hashlib.sha256(packed).hexdigest()
        there = client.submit(_unchanged, packed, key=f"parkctl-job-{digest[:16]}")
        waiting = iter(chunks)

        def submit(chunk: int) -> Any:
            return client.submit(_drive_there, there, digest, chunk, key=f"parkctl-{digest[:16]}-{chunk}")

        width = max(8, WAITING_A_WORKER * sum(client.nthreads().values()))
        running = dask.as_completed([submit(chunk) for chunk in islice(waiting, width)], loop=client.loop)
        for future in running:
            code, chunk, rows = _result(future, address)
            if code != job.code:
                raise UserError(f"--scheduler {address}: its workers have another version of parkctl than this machine")
            for following in islice(waiting, 1):
                running.add(submit(following))
            yield chunk, rows
    finally:
        client.close(timeout=CLUSTER_TIMEOUT_S)


def _result(future: Any, address: str) -> tuple[str, int, Rows]:
    try:
        result: tuple[str, int, Rows] = future.result()
    except Exception as error:  # whatever goes wrong at a worker comes out here
        text = " ".join(str(error).split())[:200] or type(error).__name__
        raise UserError(f"--scheduler {address}: a worker failed: {text}") from None
    return result
