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

# Maximum times [s] to wait for a response of a scheduler; for its first worker, which on a busy
# computer needs more than 15 s to start; for a thread to start; and for workers after all of them
# were lost, because a busy computer may need more than a minute to start one again.
CONNECT_TIMEOUT_S = 15.0
FIRST_WORKER_TIMEOUT_S = 60.0
THREAD_START_TIMEOUT_S = 60.0
NO_WORKERS_TIMEOUT_S = 180.0
LOCAL_ADDRESS = '127.0.0.1'
TLS_VARIABLES = ', '.join(f'DASK_DISTRIBUTED__COMM__TLS__{name}'
                          for name in ('CA_FILE', 'CLIENT__CERT', 'CLIENT__KEY'))
"""Environment variables of Dask with the files for a scheduler at tls://..."""
POLL_S = 0.3
"""Maximum time to wait for a task before returning to the caller [s]."""

_Key = TypeVar('_Key')


class _Task(NamedTuple):
    """Task for a worker. If `runs_alone`, no other task runs at the same time."""

    key: Any
    priority: int
    call: Callable[..., Any]
    arguments: tuple[Any, ...]
    runs_alone: bool


class Cluster(Generic[_Key]):
    """Runs tasks on `workers` processes of this machine, or on the Dask scheduler at an address;
    raises ClusterError if the workers do not start, or the scheduler does not respond or has none.
    """

    def __init__(self, workers: int, scheduler: str | None) -> None:
        try:
            import distributed
        except ImportError as error:
            raise MissingDependencyError(
                'archives need pyarrow and Dask: pip install "mag_tracking[archive]"') from error
        # Dask logs many lines for each lost worker.
        logging.getLogger('distributed').setLevel(logging.CRITICAL)
        self._running: dict[Future[Any], _Task] = {}
        # Dask reports all tasks of a lost worker as failed, including queued ones. Each such task
        # is therefore repeated while no other task is running.
        self._suspects: deque[_Task] = deque()
        self._workers: set[str] = set()
        self.n_lost = 0
        self._last_worker_time = time.monotonic()
        with ExitStack() as stack:
            self._client = stack.enter_context(
                _local_client(distributed, stack, workers) if scheduler is None
                else _remote_client(distributed, scheduler))
            self._stack = stack.pop_all()
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
        """Number of workers, or 1 if there are none."""
        return max(1, len(self._workers))

    def keys(self) -> list[_Key]:
        """Keys of the running tasks."""
        return [task.key for task in self._running.values()]

    def submit(self, key: _Key, priority: int, task: Callable[..., Any], *arguments: Any) -> None:
        """Submit the call `task(*arguments)`, picklable; a higher `priority` is started first."""
        self._run(_Task(key, priority, task, arguments, False))

    def _run(self, task: _Task) -> None:
        self._running[self._client.submit(task.call, *task.arguments, pure=False,
                                          priority=task.priority)] = task

    def finished(self) -> Iterator[tuple[_Key, Any]]:
        """Wait up to `POLL_S`; yield the keys and the results or exceptions of finished tasks.

        Raises ClusterError if the scheduler is lost, or there have been no workers for too long.
        """
        from distributed import KilledWorker, wait

        if not self._running and self._suspects:
            self._run(self._suspects.popleft()._replace(runs_alone=True))
        with suppress(TimeoutError), self._scheduler_errors():
            wait(list(self._running), timeout=POLL_S, return_when='FIRST_COMPLETED')
        self._count_lost()
        for future in [f for f in self._running if f.done()]:
            task = self._running.pop(future)
            if future.status == 'finished':
                yield task.key, future.result()
                continue
            error = future.exception() if future.status == 'error' else None
            if not isinstance(error, KilledWorker):
                yield task.key, error or ClusterError(
                    'the scheduler has stopped or has cancelled a task; run the command again')
            elif task.runs_alone:
                yield task.key, MagTrackingError(
                    'the worker of a task was lost several times (killed or out of memory)')
            else:
                self._suspects.append(task)

    def _count_lost(self) -> None:
        """Count lost workers; raises ClusterError if there have been no workers for too long."""
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
        """Convert connection errors to ClusterError."""
        try:
            yield
        except TimeoutError:
            raise
        except (OSError, CancelledError, asyncio.CancelledError) as error:
            raise ClusterError(f'lost the connection to the scheduler ({error}); run the command '
                               'again') from error


@cache
def _event_loop() -> 'IOLoop':
    """Return the event loop that all clusters share; raises ClusterError.

    It runs in a daemon thread. Dask would start its own loop while holding a lock that a failed
    client also acquires when it is garbage-collected; a collection in the starting thread would
    block it for ten seconds.
    """
    from tornado.ioloop import IOLoop

    loops: queue.SimpleQueue[IOLoop] = queue.SimpleQueue()

    async def serve() -> None:
        loops.put(IOLoop.current())
        await asyncio.Event().wait()

    def run_loop() -> None:
        # A terminal sends SIGINT to all processes. Only this process handles it and ends the
        # workers, which inherit the signal mask set here.
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        asyncio.run(serve())

    threading.Thread(target=run_loop, name='cluster', daemon=True).start()
    try:
        return loops.get(timeout=THREAD_START_TIMEOUT_S)
    except queue.Empty as error:
        raise ClusterError('the thread of the Dask client did not start within '
                           f'{THREAD_START_TIMEOUT_S:.0f} s') from error


def _local_client(distributed: Any, stack: ExitStack, workers: int) -> 'Client':
    """Start worker processes on this machine and return a client that submits tasks to them."""
    import dask

    # Starting Python's resource tracker unblocks SIGINT in the calling thread, which must not be
    # the thread of the event loop.
    resource_tracker.ensure_running()
    # Dask would never restart a worker that is still starting 15 s after an earlier loss.
    stack.enter_context(dask.config.set({'distributed.deploy.lost-worker-timeout': '365 days'}))
    try:
        cluster = stack.enter_context(distributed.LocalCluster(
            loop=_event_loop(), n_workers=workers, threads_per_worker=1, processes=True,
            # Scheduler and workers execute the code of whoever connects to them. Without an
            # address, the server of the dashboard has a fixed port.
            host=LOCAL_ADDRESS, dashboard_address=f'{LOCAL_ADDRESS}:0',
            # The exception of a task is returned as its result and need not be logged.
            silence_logs=logging.CRITICAL,
            # Each worker uses one core.
            env={'OPENBLAS_NUM_THREADS': '1', 'OMP_NUM_THREADS': '1'}))
    except (OSError, RuntimeError) as error:
        raise ClusterError('the worker processes did not start: one of them was killed or out of '
                           f'memory, or cannot listen on {LOCAL_ADDRESS} '
                           f'({error.__cause__ or error}); run the command again, if needed with '
                           f'fewer --workers than {workers}') from error
    client: Client = distributed.Client(cluster)
    return client


async def _check_response(address: str, connection: dict[str, Any]) -> None:
    """Check that a scheduler responds; raises OSError, TypeError or ValueError."""
    from distributed.comm.core import connect

    await (await connect(address, timeout=CONNECT_TIMEOUT_S, **connection)).close()


def _remote_client(distributed: Any, address: str) -> 'Client':
    """Connect a client to a running scheduler; raises ClusterError."""
    loop = _event_loop()
    try:
        security = distributed.Security()
        connection = security.get_connection_args('client')
        if address.startswith('tls:') and connection['ssl_context'] is None:
            raise ClusterError(f'{address}: TLS requires certificates; set {TLS_VARIABLES}')
        # A client that cannot connect reports errors when it is garbage-collected.
        distributed.utils.sync(loop, _check_response, address, connection)
        client: Client = distributed.Client(address, timeout=CONNECT_TIMEOUT_S, loop=loop,
                                            security=security)
    except (OSError, TypeError, ValueError) as error:
        raise ClusterError(f'{address}: no response from a Dask scheduler ({error})') from error
    try:
        client.wait_for_workers(1, timeout=FIRST_WORKER_TIMEOUT_S)
    except TimeoutError as error:
        client.close()
        raise ClusterError(f'{address}: the scheduler has no workers') from error
    return client
