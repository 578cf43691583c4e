"""Execution of tasks on a Dask cluster, local or remote."""

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

CONNECT_TIMEOUT_S = 15.0
"""Maximum time for a scheduler to respond and to have a worker [s]."""
THREAD_START_TIMEOUT_S = 60.0
"""Maximum time for a thread to start [s]."""
NO_WORKERS_TIMEOUT_S = 60.0
"""Maximum time for which a scheduler may have no workers after losing all of them [s]."""
POLL_S = 0.3
"""Maximum time to wait for a task before returning to the caller [s]."""

_Key = TypeVar('_Key')
# These are two classes before Python 3.11.
_TIME_OUT = (TimeoutError, asyncio.TimeoutError)


class LostWorkersError(MagTrackingError):
    """Several workers were lost while running a task."""


class _Task(NamedTuple):
    """A task, and whether it runs without other tasks."""

    key: Any
    priority: int
    call: Callable[..., Any]
    arguments: tuple[Any, ...]
    runs_alone: bool


class Cluster(Generic[_Key]):
    """Runs tasks; a context manager that cancels running tasks at its end.

    Parameters
    ----------
    workers : int
        Number of processes on this machine.
    scheduler : str or None
        Address of a Dask scheduler, used instead of `workers`.

    Attributes
    ----------
    n_lost : int
        Number of workers lost.

    Raises
    ------
    MissingDependencyError
        If Dask is not installed.
    ClusterError
        If the scheduler does not respond or has no workers.
    """

    def __init__(self, workers: int, scheduler: str | None) -> None:
        try:
            import distributed
        except ImportError as error:
            raise MissingDependencyError(
                'archives need pyarrow and Dask: pip install "mag_tracking[archive]"') from error
        # Dask logs many lines for each lost worker.
        logging.getLogger('distributed').setLevel(logging.CRITICAL)
        self._stack = ExitStack()
        self._running: dict[Future[Any], _Task] = {}
        # Dask reports all tasks of a lost worker as failed, including queued ones. Each of them is
        # therefore repeated while no other task is running.
        self._suspects: deque[_Task] = deque()
        self._workers: set[str] = set()
        self.n_lost = 0
        self._last_worker_time = time.monotonic()
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
        return max(1, len(self._workers))

    def keys(self) -> list[_Key]:
        """Keys of the tasks that are running.

        Returns
        -------
        list
        """
        return [task.key for task in self._running.values()]

    def submit(self, key: _Key, priority: int, task: Callable[..., Any], *arguments: Any) -> None:
        """Run `task(*arguments)` on a worker.

        Parameters
        ----------
        key : hashable
            Returned with the result.
        priority : int
            Tasks with a higher priority are started first.
        task : function
        *arguments : picklable
        """
        self._run(_Task(key, priority, task, arguments, False))

    def _run(self, task: _Task) -> None:
        """Submit a task to the scheduler."""
        future = self._client.submit(task.call, *task.arguments, pure=False,
                                     priority=task.priority)
        self._running[future] = task

    def finished(self) -> Iterator[tuple[_Key, Any]]:
        """Wait up to `POLL_S` for tasks to finish.

        Yields
        ------
        key : hashable
        result : object
            Return value of the task, or the exception raised.

        Raises
        ------
        ClusterError
            If the connection to the scheduler is lost.
        """
        from distributed import wait

        if not self._running and self._suspects:
            self._run(self._suspects.popleft()._replace(runs_alone=True))
        with suppress(*_TIME_OUT), self._scheduler_errors():
            wait(list(self._running), timeout=POLL_S, return_when='FIRST_COMPLETED')
        self._count_lost()
        for future in [f for f in self._running if f.done()]:
            task, result = self._running.pop(future), self._result_of(future)
            if isinstance(result, LostWorkersError) and not task.runs_alone:
                self._suspects.append(task)
            else:
                yield task.key, result

    def _result_of(self, future: 'Future[Any]') -> Any:
        """Return value of a task, or its error."""
        from distributed import KilledWorker

        if future.status == 'finished':
            return future.result()
        error = future.exception() if future.status == 'error' else None
        if isinstance(error, KilledWorker):
            return LostWorkersError('its worker was lost several times (killed or out of memory)')
        return error or ClusterError('the scheduler abandoned a task or has ended; run the command '
                                     'again')

    def _count_lost(self) -> None:
        """Count lost workers; raises ClusterError if all are lost and none has been replaced."""
        with self._scheduler_errors():
            workers = set(self._client.nthreads())
        self.n_lost += len(self._workers - workers)
        self._workers = workers
        now = time.monotonic()
        if workers:
            self._last_worker_time = now
        elif now - self._last_worker_time > NO_WORKERS_TIMEOUT_S:
            raise ClusterError('the scheduler has lost all workers; run the command again')

    @contextmanager
    def _scheduler_errors(self) -> Iterator[None]:
        """Turn connection errors into ClusterError."""
        try:
            yield
        except _TIME_OUT:
            raise
        except (OSError, CancelledError, asyncio.CancelledError) as error:
            raise ClusterError(f'lost the connection to the scheduler ({error}); run the command '
                               'again') from error


@cache
def _event_loop() -> 'IOLoop':
    """Event loop of all clusters, in a thread that ends with the process; raises ClusterError.

    Dask starts its own loop while holding a lock that a failed client also acquires when it is
    garbage-collected. Collection in the starting thread would block the start for ten seconds.
    """
    from tornado.ioloop import IOLoop

    started: queue.SimpleQueue[IOLoop] = queue.SimpleQueue()

    async def run() -> None:
        started.put(IOLoop.current())
        await asyncio.Event().wait()

    def begin() -> None:
        # A terminal sends Ctrl-C to all processes. Only this process handles it and ends the
        # others; they inherit the signals blocked here.
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        asyncio.run(run())

    threading.Thread(target=begin, name='cluster', daemon=True).start()
    try:
        return started.get(timeout=THREAD_START_TIMEOUT_S)
    except queue.Empty as error:
        raise ClusterError('the thread of the Dask client did not start within '
                           f'{THREAD_START_TIMEOUT_S:.0f} s') from error


def _local(distributed: Any, stack: ExitStack, workers: int) -> 'Client':
    """Client of processes on this machine."""
    # Starting Python's resource tracker unblocks SIGINT in the calling thread, which must not be
    # the thread of the event loop.
    resource_tracker.ensure_running()
    cluster = stack.enter_context(distributed.LocalCluster(
        loop=_event_loop(), n_workers=workers, threads_per_worker=1, processes=True,
        dashboard_address=':0',
        # Exceptions of a task are returned as its result; they need no log.
        silence_logs=logging.CRITICAL,
        # Each worker uses one core.
        env={'OPENBLAS_NUM_THREADS': '1', 'OMP_NUM_THREADS': '1'}))
    client: Client = distributed.Client(cluster)
    return client


async def _reach(address: str) -> None:
    """Connect to a scheduler once; raises OSError or ValueError if it does not respond."""
    from distributed.comm.core import connect

    await (await connect(address, timeout=CONNECT_TIMEOUT_S)).close()


def _remote(distributed: Any, address: str) -> 'Client':
    """Client of a running scheduler; raises ClusterError."""
    loop = _event_loop()
    try:
        # A client that cannot connect remains incomplete and reports errors when it is collected.
        distributed.utils.sync(loop, _reach, address)
        client: Client = distributed.Client(address, timeout=CONNECT_TIMEOUT_S, loop=loop)
    except (OSError, ValueError) as error:
        raise ClusterError(f'{address}: no response from a Dask scheduler ({error})') from error
    try:
        client.wait_for_workers(1, timeout=CONNECT_TIMEOUT_S)
    except _TIME_OUT as error:
        client.close()
        raise ClusterError(f'{address}: the scheduler has no workers') from error
    return client
