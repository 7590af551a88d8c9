"""Worker processes that end with the process that started them, however it ends."""

from __future__ import annotations

import contextlib
import itertools
import multiprocessing
import os
import signal
import threading
import traceback
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from typing import Any

from robo_manip_baselines.runs.errors import RequestError, WriteError
from robo_manip_baselines.runs.interrupt import ENDING

POLL = 0.2
"""Most s between two calls of ``on_poll``, see `answers`."""

_PATIENCE = 5.0
"""s for a worker to end by itself, when the run is over, before it is killed."""

Handler = Callable[[Any], Any]
"""Answers requests in a worker; its ``close`` is called at the end, if it has one."""


class WorkerDiedError(RuntimeError):
    """A worker process was killed, or crashed; the message has its exit code."""


class Worker:
    """Process that answers requests through a pipe, one after another.

    It never sees Ctrl-C, SIGTERM and SIGHUP, which may reach the whole process group: this process
    ends it. If this process is killed, the worker ends at once.

    Args:
        make_handler: called in the worker with ``args``; its result answers the requests. Sent by
            name: a function or class of a module.
        args: sent to the worker.
    """

    def __init__(self, make_handler: Callable[..., Handler], *args: Any) -> None:
        # Spawned, not forked: an OpenGL context does not survive a fork.
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        arguments = (theirs, make_handler, args)
        self.process: Any = context.Process(target=_work, args=arguments, daemon=True)
        try:
            with _signals_blocked():
                self.process.start()
        finally:
            theirs.close()  # so that the pipe ends when the worker does

    def submit(self, request: Any) -> None:
        """Send a request; the answer to the one before must have been received."""
        with contextlib.suppress(OSError):  # it has died; ``receive`` finds out why
            self.pipe.send(request)

    def receive(self) -> Any:
        """Return the answer, or raise the error of the worker.

        Raises:
            RequestError, WriteError: the worker raised it.
            RuntimeError: the worker raised something else; the message has its traceback.
            WorkerDiedError: the worker died.
        """
        try:
            answer, error = self.pipe.recv()
        except (EOFError, OSError) as ended:
            self.process.join(_PATIENCE)
            raise WorkerDiedError(f"exit code {self.process.exitcode}") from ended
        if error is not None:
            raise error
        return answer

    def close(self, *, at_once: bool = False) -> None:
        """End the process, after the request at hand or at once; may be called again."""
        self.pipe.close()  # a worker ends when it finds that its pipe has
        if self.process is not None and self.process.pid is not None:
            if at_once:
                self.process.kill()
            self.process.join(_PATIENCE)
            if self.process.is_alive():
                self.process.kill()
                self.process.join()
            self.process.close()
        self.process = None


def close_workers(workers: Sequence[Worker], *, at_once: bool = False) -> None:
    """End workers beside one another; see `Worker.close`."""
    for worker in workers:
        worker.pipe.close()
    for worker in workers:
        worker.close(at_once=at_once)


def wait_for(workers: Sequence[Worker], timeout: float | None = None) -> list[Worker]:
    """Wait until some workers have answered, at most ``timeout`` s, and return them."""
    ready = wait([worker.pipe for worker in workers], timeout)
    return [worker for worker in workers if worker.pipe in ready]


def answers(
    make_handler: Callable[..., Handler],
    args: Sequence[Any],
    requests: Iterable[Any],
    workers: int,
    on_poll: Callable[[], None] | None = None,
) -> Generator[Any]:
    """Yield the answers to requests as they come, from processes that are started and ended here.

    Closed before the last answer, or after an error, it ends the processes at once.

    Args:
        make_handler: see `Worker`.
        args: sent to each process.
        requests: each is taken when a process is free for it.
        workers: most processes; never more than requests.
        on_poll: called again and again, every `POLL` s at least, while answers are waited for.

    Raises:
        RequestError, WriteError, RuntimeError: see `Worker.receive`; also where a process died.
    """
    waiting, pool, is_done = iter(requests), list[Worker](), False
    try:
        for request in itertools.islice(waiting, workers):
            pool.append(Worker(make_handler, *args))
            pool[-1].submit(request)
        busy = list(pool)
        while busy:
            ready = wait_for(busy, POLL if on_poll else None)
            if on_poll:
                on_poll()
            for worker in ready:
                try:
                    answer = worker.receive()
                except WorkerDiedError as error:
                    raise RuntimeError(
                        f"a worker process died ({error}); if it was killed for lack of memory, "
                        "take fewer workers; the same command does what is missing"
                    ) from error
                busy.remove(worker)
                for request in itertools.islice(waiting, 1):
                    worker.submit(request)
                    busy.append(worker)
                yield answer
        is_done = True
    finally:
        close_workers(pool, at_once=not is_done)


def _work(pipe: Connection, make_handler: Callable[..., Handler], args: tuple[Any, ...]) -> None:
    """Answer requests until the pipe ends; errors are reported through it."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    handler: Any = None
    try:
        while True:
            try:
                request = pipe.recv()
            except (EOFError, OSError):  # the run is over
                return
            answer = error = None
            try:
                handler = handler or make_handler(*args)
                answer = handler(request)
            except (RequestError, WriteError) as raised:
                error = type(raised)(str(raised))
            except Exception:
                error = RuntimeError(f"a worker process failed:\n{traceback.format_exc()}")
            try:
                pipe.send((answer, error))
            except OSError:
                return
    finally:
        if hasattr(handler, "close"):
            handler.close()


def _end_with_parent() -> None:
    """End this process as soon as the one that started it has ended."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextlib.contextmanager
def _signals_blocked() -> Iterator[None]:
    """Let a process that starts here never see the signals that end a run.

    It would print a traceback of its own. Signals that come meanwhile are seen afterwards.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    # Python starts it with the first process, and lets SIGINT through again while doing so.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
