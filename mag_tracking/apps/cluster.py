"""A Dask cluster, of this machine or any other, that runs tasks and says what came of each."""

import asyncio
import logging
import queue
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager, suppress
from functools import cache
from multiprocessing import resource_tracker
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, TypeVar

from mag_tracking.errors import ClusterError, MagTrackingError, MissingDependencyError

if TYPE_CHECKING:
    from distributed import Client, Future
    from tornado.ioloop import IOLoop

PATIENCE_S = 15.0
"""[s] A scheduler that has not answered by then, or has no worker, does not."""
BEGIN_S = 60.0
"""[s] Longest time for a thread to start."""
ALONE_S = 60.0
"""[s] A scheduler whose workers are all gone gets others by then, or never."""
LOOK_S = 0.3
"""[s] Time for which a task is waited for before the caller is asked whether to stop."""

_Key = TypeVar('_Key')
# Two classes before Python 3.11.
_TIME_OUT = (TimeoutError, asyncio.TimeoutError)


class LostWorkersError(MagTrackingError):
    """A task took several workers with it."""


class _Task(NamedTuple):
    """A task, and whether nothing else runs beside it."""

    key: Any
    priority: int
    call: Callable[..., Any]
    arguments: tuple[Any, ...]
    is_alone: bool


class Cluster(Generic[_Key]):
    """Runs tasks; a context manager, which ends what is still running."""

    def __init__(self, workers: int, scheduler: str | None) -> None:
        """
        Parameters
        ----------
        workers : int
            Processes on this machine.
        scheduler : str or None
            Address of a Dask scheduler, in place of `workers`.

        Raises
        ------
        MissingDependencyError
        ClusterError
        """
        try:
            import distributed
        except ImportError as error:
            raise MissingDependencyError(
                'archives need pyarrow and Dask: pip install "mag_tracking[archive]"') from error
        # It would fill pages for each worker that is lost.
        logging.getLogger('distributed').setLevel(logging.CRITICAL)
        self._stack = ExitStack()
        self._running: dict[Future[Any], _Task] = {}
        # Dask blames all tasks that a lost worker had, also those that waited there. So each is
        # tried once more, when it is the only one that runs.
        self._suspects: deque[_Task] = deque()
        self._seen: set[str] = set()
        self.n_lost = 0
        self._worked = time.monotonic()
        try:
            self._client = self._stack.enter_context(
                _local(distributed, self._stack, workers) if scheduler is None
                else _remote(distributed, scheduler))
        except BaseException:
            self._stack.close()
            raise
        self._count_lost()

    def __enter__(self) -> 'Cluster[_Key]':
        return self

    def __exit__(self, *_: object) -> None:
        self._client.cancel(list(self._running), force=True)
        self._stack.close()

    @property
    def n_running(self) -> int:
        """Number of tasks that are not finished."""
        return len(self._running) + len(self._suspects)

    @property
    def n_workers(self) -> int:
        """Number of workers, at least one."""
        return max(1, len(self._seen))

    def keys(self) -> list[_Key]:
        """The keys of the tasks that are running."""
        return [task.key for task in self._running.values()]

    def submit(self, key: _Key, priority: int, task: Callable[..., Any], *arguments: Any) -> None:
        """Run `task(*arguments)`; those of a higher priority come first."""
        self._run(_Task(key, priority, task, arguments, False))

    def _run(self, task: _Task) -> None:
        """Have the scheduler run a task."""
        future = self._client.submit(task.call, *task.arguments, pure=False,
                                     priority=task.priority)
        self._running[future] = task

    def finished(self) -> Iterator[tuple[_Key, Any]]:
        """The tasks that have finished since, with what they returned or raised; waits a moment.

        Raises ClusterError where the scheduler is gone.
        """
        from distributed import wait

        if not self._running and self._suspects:
            self._run(self._suspects.popleft()._replace(is_alone=True))
        with suppress(*_TIME_OUT), self._scheduler_named():
            wait(list(self._running), timeout=LOOK_S, return_when='FIRST_COMPLETED')
        self._count_lost()
        for future in [f for f in self._running if f.done()]:
            task, result = self._running.pop(future), self._result_of(future)
            if isinstance(result, LostWorkersError) and not task.is_alone:
                self._suspects.append(task)
            else:
                yield task.key, result

    def _result_of(self, future: 'Future[Any]') -> Any:
        """What a task returned, or its error."""
        from distributed import KilledWorker

        if future.status == 'finished':
            return future.result()
        error = future.exception() if future.status == 'error' else None
        if isinstance(error, KilledWorker):
            return LostWorkersError('its worker was lost several times (killed, or out of memory)')
        return error or ClusterError('the scheduler gave up a task, or is gone; run it again')

    def _count_lost(self) -> None:
        """Count the workers that were there and are no more; ClusterError where none has come."""
        with self._scheduler_named():
            there = set(self._client.nthreads())
        self.n_lost += len(self._seen - there)
        self._seen = there
        now = time.monotonic()
        if there:
            self._worked = now
        elif now - self._worked > ALONE_S:
            raise ClusterError('all workers of the scheduler are gone, and no other has come; run '
                               'it again')

    @contextmanager
    def _scheduler_named(self) -> Iterator[None]:
        """Errors of a connection that is gone are those of the scheduler."""
        try:
            yield
        except _TIME_OUT:
            raise
        except (OSError, CancelledError, asyncio.CancelledError) as error:
            raise ClusterError(f'the scheduler is gone ({error}); run it again') from error


@cache
def _event_loop() -> 'IOLoop':
    """The event loop of all clusters, in a thread that ends with the process.

    Dask starts its own loop under a lock that a failed client takes as well when it is collected.
    Collected in the starting thread, it blocks the start for ten seconds. Raises ClusterError.
    """
    from tornado.ioloop import IOLoop

    begun: queue.SimpleQueue[IOLoop] = queue.SimpleQueue()

    async def run() -> None:
        begun.put(IOLoop.current())
        await asyncio.Event().wait()

    def begin() -> None:
        # A terminal sends Ctrl-C to all processes. Only this one is to hear it, and ends the
        # others, which inherit what is blocked here.
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        asyncio.run(run())

    threading.Thread(target=begin, name='cluster', daemon=True).start()
    try:
        return begun.get(timeout=BEGIN_S)
    except queue.Empty as error:
        raise ClusterError(f'no thread could begin in {BEGIN_S:.0f} s') from error


def _local(distributed: Any, stack: ExitStack, workers: int) -> 'Client':
    """The client of processes on this machine."""
    # Where Python's tracker of resources is started, SIGINT is not blocked any more after it.
    resource_tracker.ensure_running()
    cluster = stack.enter_context(distributed.LocalCluster(
        loop=_event_loop(), n_workers=workers, threads_per_worker=1, processes=True,
        dashboard_address=':0',
        # What a task raises comes back as its result.
        silence_logs=logging.CRITICAL,
        # Each has a core for itself.
        env={'OPENBLAS_NUM_THREADS': '1', 'OMP_NUM_THREADS': '1'}))
    client: Client = distributed.Client(cluster)
    return client


async def _reach(address: str) -> None:
    """Connect to a scheduler once; OSError or ValueError where it does not answer."""
    from distributed.comm.core import connect

    await (await connect(address, timeout=PATIENCE_S)).close()


def _remote(distributed: Any, address: str) -> 'Client':
    """The client of a scheduler that runs somewhere; raises ClusterError."""
    loop = _event_loop()
    try:
        # A client that can't connect is left half made, and complains when it is collected.
        distributed.utils.sync(loop, _reach, address)
        client: Client = distributed.Client(address, timeout=PATIENCE_S, loop=loop)
    except (OSError, ValueError) as error:
        raise ClusterError(f'{address}: no Dask scheduler answers ({error})') from error
    try:
        client.wait_for_workers(1, timeout=PATIENCE_S)
    except _TIME_OUT as error:
        client.close()
        raise ClusterError(f'{address}: the scheduler has no worker') from error
    return client
