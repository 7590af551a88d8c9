"""Slots whose environments step in worker processes.

Observations, actions and images lie in memory that all processes share. It has no name: a file in
``/dev/shm`` (or in the temporary folder, where that is too small) that is deleted as soon as it is
open, and handed to the workers as it is. So nothing can be left behind, however a run ends. What
goes through the pipes is small: orders, and results of episodes.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
import traceback
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from types import TracebackType
from typing import Any

from robo_manip_baselines.errors import RequestError
from robo_manip_baselines.evaluation.slots import (
    Environments,
    Event,
    Order,
    SlotArrays,
    SlotEnvironments,
)
from robo_manip_baselines.evaluation.task import Task

_PATIENCE = 5.0
"""s for a worker to end by itself, when the run is over, before it is killed."""


@contextlib.contextmanager
def open_environments(task: Task, num_envs: int, workers: int) -> Iterator[Environments]:
    """Give slots, and free them at the end.

    Args:
        task: the environment of every slot.
        num_envs: slots, 1 or more.
        workers: processes that step them; 0 steps them in this one.

    Raises:
        RequestError: a number is too small.
    """
    if num_envs < 1:
        raise RequestError(f"num_envs {num_envs}: must be 1 or more")
    if workers < 0:
        raise RequestError(f"workers {workers}: must be 0 (no process of their own) or more")
    if workers:
        with WorkerEnvironments(task, num_envs, min(workers, num_envs)) as environments:
            yield environments
    else:
        with contextlib.closing(SlotEnvironments(task, SlotArrays(task, num_envs))) as here:
            yield here


@dataclass
class _Worker:
    """A process and the pipe to it.

    Attributes:
        orders: what it is working on.
    """

    process: Any
    pipe: Connection
    orders: Sequence[Order] = ()


class WorkerEnvironments:
    """Slots dealt out to worker processes. Use as a context manager.

    Args:
        task: the environment of every slot.
        num_envs: slots.
        workers: processes.
    """

    def __init__(self, task: Task, num_envs: int, workers: int) -> None:
        self.task = task
        # Spawned, not forked: an OpenGL context does not survive a fork.
        context = multiprocessing.get_context("spawn")
        buffer = context.RawArray("B", SlotArrays.size(task, num_envs))
        self.arrays = SlotArrays(task, num_envs, buffer)
        self._workers: list[_Worker] = []
        try:
            for _ in range(workers):
                ours, theirs = context.Pipe()
                process = context.Process(
                    target=_work, args=(theirs, task, num_envs, buffer), daemon=True
                )
                self._workers.append(_Worker(process, ours))
                with _without_interrupts():
                    process.start()
                theirs.close()  # so that the pipe ends when the worker does
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> WorkerEnvironments:
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def submit(self, orders: Sequence[Order]) -> None:
        """Give orders to slots that have none."""
        for number, worker in enumerate(self._workers):
            mine = [order for order in orders if order.slot % len(self._workers) == number]
            if mine:
                worker.orders = mine
                with contextlib.suppress(OSError):  # it has died; ``wait`` finds out why
                    worker.pipe.send(mine)

    def wait(self) -> list[Event]:
        """Wait until some slots are done, and say which.

        Raises:
            RequestError: what a worker could not do was asked for wrongly.
            RuntimeError: a worker failed or died.
        """
        busy = {worker.pipe: worker for worker in self._workers if worker.orders}
        events: list[Event] = []
        for pipe in wait(list(busy)):
            worker = busy[pipe]  # type: ignore[index]
            events += _receive(worker)
            worker.orders = ()
        return events

    def close(self) -> None:
        """End the workers."""
        for worker in self._workers:
            worker.pipe.close()  # a worker ends when it finds that its pipe has
        for worker in self._workers:
            if worker.process.pid is not None:
                worker.process.join(_PATIENCE)
                if worker.process.is_alive():
                    worker.process.kill()
                    worker.process.join()
                worker.process.close()
        self._workers.clear()


def _receive(worker: _Worker) -> list[Event]:
    """Return the events that a worker reports, or raise what it failed with."""
    try:
        answer = worker.pipe.recv()
    except (EOFError, OSError) as error:
        worker.process.join(_PATIENCE)
        slots = ", ".join(str(order.slot) for order in worker.orders)
        raise RuntimeError(
            f"the worker process of slots {slots} died (exit code {worker.process.exitcode}); "
            "if it was killed for lack of memory, take fewer --num_envs or --workers"
        ) from error
    if isinstance(answer, RequestError):
        raise answer
    if isinstance(answer, str):
        raise RuntimeError(f"a worker process failed:\n{answer}")
    return answer


def _work(pipe: Connection, task: Task, num_envs: int, buffer: Any) -> None:
    """Carry out orders until the pipe ends; what goes wrong is reported through it."""
    answer: list[Event] | RequestError | str
    with contextlib.closing(SlotEnvironments(task, SlotArrays(task, num_envs, buffer))) as here:
        while True:
            try:
                orders = pipe.recv()
            except (EOFError, OSError):  # the run is over
                return
            try:
                here.submit(orders)
                answer = here.wait()
            except RequestError as error:
                answer = RequestError(str(error))
            except Exception:
                answer = traceback.format_exc()
            try:
                pipe.send(answer)
            except OSError:
                return


@contextlib.contextmanager
def _without_interrupts() -> Iterator[None]:
    """Let a process that starts here never see Ctrl-C, which reaches the whole process group.

    It would print a traceback of its own; this process ends it. Signals that come meanwhile are
    seen afterwards.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    # Python starts it with the first process, and lets SIGINT through again while doing so.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
