"""Workers of Dask: those of this machine, or of a cluster whose scheduler has an address.

https://distributed.dask.org. A worker has one thread and one process in which it replays.
"""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import warnings
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager
from importlib.metadata import version
from typing import Any

from flowrec.archive.sweep.replay_process import Row, failed_row, replay_task
from flowrec.archive.sweep.tasks import Task
from flowrec.core import NUMERICS_VERSION, FlowrecError, UsageError, __version__, needs

with needs("a sweep", "cluster", "Dask"):
    import dask
    import distributed
    from distributed.comm import CommClosedError
    from distributed.utils import silence_logging_cmgr
    from distributed.versions import VersionMismatchWarning

_CONNECT_S = 10.0
_STARTS = 3  # tries, because a worker may be killed before it is ready
_QUEUED = 16  # tasks at least that the scheduler of a cluster knows, by which it may ask for more workers
_COMPARED = ("distributed", "dask")


@contextmanager
def workers_of(scheduler: str | None, workers: int | None) -> Iterator[Any]:
    """A client of Dask.

    Raises UsageError: the address can not be one; FlowrecError: no scheduler answers there, or it is of another
    version.

    Parameters
    ----------
    scheduler : address of a scheduler, such as tcp://10.0.0.1:8786; None: workers of this machine, on 127.0.0.1.
    workers : how many of this machine; None: one for each core.
    """
    with ExitStack() as stack:
        stack.enter_context(warnings.catch_warnings())
        warnings.simplefilter("ignore", VersionMismatchWarning)  # stated below, in one line
        # What it logs of workers and connections that end is in the rows, or in one line.
        stack.enter_context(silence_logging_cmgr(logging.CRITICAL))
        if scheduler is None:
            stack.enter_context(dask.config.set({"distributed.scheduler.http.routes": []}))  # no page of Dask
            cluster = stack.enter_context(_local_cluster(workers or os.cpu_count() or 1))
            client = stack.enter_context(distributed.Client(cluster))
            yield client
            return
        try:
            found = asyncio.run(asyncio.wait_for(_versions_of(scheduler), _CONNECT_S))
            _compare(scheduler, "the scheduler", found)
            client = stack.enter_context(distributed.Client(scheduler, timeout=_CONNECT_S))
        except ValueError as error:
            raise UsageError(f"--scheduler {scheduler}: {error}; as in tcp://10.0.0.1:8786") from error
        except (OSError, TypeError, AttributeError, KeyError) as error:  # what other versions and programs answer
            raise FlowrecError(
                f"--scheduler {scheduler}: no scheduler of Dask {distributed.__version__} answers there "
                f"({type(error).__name__}); start one with `dask scheduler`"
            ) from error
        _check_workers(client, scheduler)
        yield client


def _local_cluster(workers: int) -> Any:
    """A scheduler and workers on 127.0.0.1; FlowrecError if they do not start."""
    for attempt in range(1, _STARTS + 1):
        try:
            return distributed.LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                host="127.0.0.1",
                dashboard_address="127.0.0.1:0",
                scheduler_kwargs={"dashboard": False},
                security=True,  # no tasks of other users of this machine: the keys of TLS are only in memory
                silence_logs=logging.CRITICAL,
                plugins=(_LeavesInterrupts(),),  # sent with each worker: a call of all would fail with one that dies
            )
        except RuntimeError as error:  # a worker was killed before it was ready
            if attempt == _STARTS:
                raise FlowrecError(
                    f"the {workers} workers did not start in {_STARTS} tries ({error}); try fewer with --workers"
                ) from error
    raise AssertionError("the last try returns or raises")


async def _versions_of(scheduler: str) -> Any:
    """Versions of a scheduler's packages; a client would wait for ever for another program that listens there."""
    security = distributed.Security().get_connection_args("client")
    async with distributed.rpc(scheduler, connection_args=security) as remote:
        return (await remote.versions(packages=[]))["packages"]


class _LeavesInterrupts(distributed.WorkerPlugin):  # type: ignore[misc]
    """A worker of this machine gets the Ctrl-C of the terminal, too, which is for the sweep."""

    name = "leaves-interrupts"

    def setup(self, worker: Any) -> None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def _compare(scheduler: str, name: str, packages: Mapping[str, Any]) -> None:
    """Refuse other versions of Dask."""
    for package in _COMPARED:
        here, there = version(package), packages.get(package)
        if there != here:
            raise FlowrecError(
                f"--scheduler {scheduler}: {name} has {package} {there}, this is {here}; install the same version on "
                "both sides"
            )


def _check_workers(client: Any, scheduler: str) -> None:
    """Refuse workers with other versions of Dask or flowrec; those that come later are taken as they are."""
    for name, found in client.get_versions()["workers"].items():
        if found is not None:  # it has just ended
            _compare(scheduler, name, found["packages"])
    here = _own_versions()
    try:
        of_workers = client.run(_own_versions)
    except Exception as error:
        raise FlowrecError(
            f"--scheduler {scheduler}: its workers can not import flowrec ({error}); install flowrec {__version__} "
            "there"
        ) from error
    for name, there in of_workers.items():
        if there != here:
            raise FlowrecError(
                f"--scheduler {scheduler}: {name} has flowrec {there[0]} with numerics {there[1]}, this is {here[0]} "
                f"with numerics {here[1]}; install the same version on both sides"
            )


def _own_versions() -> tuple[str, int]:
    return __version__, NUMERICS_VERSION


def _replayed_by_worker(task: Task) -> Row:
    """Runs in a worker, whose own limit of memory holds for a task that states none."""
    return replay_task(task, distributed.get_worker().memory_manager.memory_limit)


def rows_of(client: Any, tasks: Iterable[Task], *, local: bool) -> Iterator[Row]:
    """The rows of tasks in the order in which they are done; few of them are in memory at a time.

    `local`: the workers are of this machine: none is given a task while it has one, so that a worker that dies fails no
    task but its own. Raises FlowrecError: the scheduler has ended.
    """
    waiting, running, done = iter(tasks), dict[str, Task](), distributed.as_completed()

    def submit() -> None:
        threads = sum(client.nthreads().values())
        wanted = max(threads, 1) if local else max(2 * threads, _QUEUED)
        while len(running) < wanted and (task := next(waiting, None)) is not None:
            # Not pure: the scheduler may remember the result of another sweep.
            future = client.submit(_replayed_by_worker, task, key=f"replay-{task.key}", pure=False)
            running[future.key] = task
            done.add(future)

    try:
        submit()
        for future in done:
            task = running.pop(future.key)
            error = future.exception()
            row = future.result() if error is None else failed_row(task, _error_text(error))
            future.release()
            submit()
            yield row
    except (CommClosedError, CancelledError, TimeoutError) as error:
        raise FlowrecError("the scheduler has ended; what is done is kept, and the same command goes on") from error


def _error_text(error: BaseException) -> str:
    if isinstance(error, distributed.KilledWorker):
        return f"{error.allowed_failures + 1} workers have died during it, and it is set aside"
    return f"{type(error).__name__}: {error}"
