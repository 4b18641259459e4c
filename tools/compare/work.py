"""The work of a comparison on so many processes: tunings and runs, each the same wherever it is done."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from itertools import islice
from multiprocessing import connection, get_context, parent_process
from typing import Any, NamedTuple

from sim.errors import UserError
from tools.compare.latency import borne_samples
from tools.compare.procedure import Tuned, cost_m, tune
from tools.compare.runs import CONTROLLERS, Driver, RunFigures, Setting


class Task(NamedTuple):
    """Runs of one controller with one kind of input in one scenario."""

    controller: str
    inputs: str
    scenario: str
    numbers: tuple[float, ...]
    seeds: tuple[int, ...]


_settings: dict[str, Setting] = {}
_drivers: dict[str, Driver] = {}


def use(settings: dict[str, Setting]) -> None:
    """Let this process work with these settings, by scenario."""
    _settings.clear()
    _settings.update(settings)
    _drivers.clear()


def _driver(scenario: str) -> Driver:
    if scenario not in _drivers:
        _drivers[scenario] = Driver(_settings[scenario])
    return _drivers[scenario]


def drive_task(task: Task) -> tuple[Task, list[RunFigures]]:
    """Drive the runs of a task."""
    law = CONTROLLERS[task.controller].law
    driver = _driver(task.scenario)
    return task, [driver.run(law, task.numbers, task.inputs, seed) for seed in task.seeds]


def bear_task(task: Task) -> tuple[Task, int | None]:
    """Measure how many added samples of command latency a law bears in the runs of a task, all together."""
    law = CONTROLLERS[task.controller].law
    return task, borne_samples(_settings[task.scenario], law, task.numbers, task.inputs, task.seeds)


def tune_one(which: tuple[str, str, int]) -> tuple[tuple[str, str], Tuned]:
    """Tune a controller for one kind of input with a budget."""
    name, inputs, budget = which
    law = CONTROLLERS[name].law

    def evaluate(numbers: tuple[float, ...], scenario: str, seed: int) -> float:
        return cost_m(_driver(scenario).run(law, numbers, inputs, seed))

    return (name, inputs), tune(name, evaluate, budget)


def _begin_worker(settings: dict[str, Setting]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the command's own process ends them in good order
    parent = parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()
    use(settings)


def _end_with(sentinel: int) -> None:
    """End this process when its parent has gone, however it went."""
    import os  # noqa: PLC0415

    connection.wait([sentinel])
    os._exit(1)


def spread(work: Callable[[Any], Any], parts: list[Any], settings: dict[str, Setting], jobs: int) -> Iterator[Any]:
    """Yield what `work` makes of each part, as they are done, by so many processes; here where it is one."""
    if jobs == 1:
        use(settings)
        yield from map(work, parts)
        return
    pool = ProcessPoolExecutor(jobs, get_context("spawn"), initializer=_begin_worker, initargs=(settings,))
    try:
        waiting = iter(parts)
        running: set[Future[Any]] = {pool.submit(work, part) for part in islice(waiting, 2 * jobs)}
        while running:
            done, running = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                running |= {pool.submit(work, part) for part in islice(waiting, 1)}
                yield future.result()
    except BrokenProcessPool:
        raise UserError("a worker process has ended before its time (out of memory?); try --jobs 1") from None
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
