"""Worker processes of one machine: started, replaced when they die, stopped together."""

import contextlib
import logging
import multiprocessing
import os
import signal
import sys
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from typing import Any, Protocol

import joblib  # type: ignore[import-untyped]
import torch as th
from optuna.exceptions import StorageInternalError

from search.execution.passwords import without_password
from search.execution.storage import root_cause

logger = logging.getLogger(__name__)

# Deaths of workers in one place, without a trial finished in between, after which the pool gives up.
MAX_DEATHS = 5
# Seconds after which the death of a worker is the first of its place again: clusters take machines away now and then.
LONG_LIFE = 600.0
# Characters of an error that reach the user: longer ones fill the pipe, and the worker waits until somebody looks.
MESSAGE_LENGTH = 8000
# Seconds after which a worker that still runs is interrupted again: an exception that falls into a destructor is lost.
INTERRUPT_SECONDS = 8.0


class WorkerError(RuntimeError):
    """A worker stopped with an error, or workers keep dying; the message says why."""


class Unfit(Exception):
    """
    Raised by what a worker runs where its process cannot go on, such as after an error of its GPU, but another one can. The
    message says why.
    """


class Pool(Protocol):
    """Workers that run one function until it returns; leaving the ``with`` block interrupts those that still run."""

    def __enter__(self) -> "Pool": ...

    def __exit__(self, *exception: Any) -> None: ...

    def check(self, progressed: bool) -> bool:
        """
        Start workers again that died.

        :param progressed: Whether a trial has ended since the last call, other than by a death
        :return: Whether any worker still runs
        :raises WorkerError: when a worker stopped with an error, or they keep dying
        """
        ...


def count_death(deaths: int, seconds: float, cause: str) -> int:
    """
    Count the death of a worker. Each place has its own count: what kills all at once says nothing about them.

    :param deaths: How many there were in its place before, without a trial ended in between
    :param seconds: For how long it lived
    :param cause: What is known of it
    :return: How many there are now
    :raises WorkerError: when they are too many
    """
    deaths = deaths + 1 if seconds < LONG_LIFE else 1
    if deaths > MAX_DEATHS:
        raise WorkerError(f"{deaths} workers died one after the other ({cause})")
    return deaths


def _work(target: Callable[..., None], arguments: tuple[Any, ...], errors: Any, threads: int, parent: int) -> None:
    """What a worker process runs."""
    # Clusters announce the end of a job with SIGTERM: there is time to put away what is there.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _interrupt_once)
    sys.unraisablehook = _interrupt_again
    th.set_num_threads(threads)
    threading.Thread(target=_stop_with_parent, args=(parent,), daemon=True).start()
    try:
        target(*arguments)
    except KeyboardInterrupt:
        os._exit(128 + _interrupted.get("signal", signal.SIGINT))
    except Exception as error:
        errors.put((os.getpid(), isinstance(error, Unfit), message(error)))
        os._exit(1)


def message(error: BaseException) -> str:
    """
    What a user is told of an error that stopped a worker: one line where he can mend it, else the traceback. The middle of
    what is very long is left out.

    :param error: The error
    """
    if isinstance(error, StorageInternalError):  # what the database said stands in the cause
        text = root_cause(error)
    elif isinstance(error, (ValueError, OSError, Unfit)):
        text = without_password(" ".join(str(error).split()))
    else:
        text = without_password("".join(traceback.format_exception(error)))
    half = MESSAGE_LENGTH // 2
    return text if len(text) <= MESSAGE_LENGTH else f"{text[:half]} ... {text[-half:]}"


_interrupted: dict[str, Any] = {}  # by which signal first, and when last


def _interrupt_once(signum: int, frame: Any) -> None:
    """A terminal's Ctrl-C reaches a worker twice, from the pool too: the second must not disturb its putting away."""
    now = time.monotonic()
    if now - _interrupted.get("at", -INTERRUPT_SECONDS) < INTERRUPT_SECONDS / 2:
        return
    _interrupted["at"] = now
    _interrupted.setdefault("signal", signum)
    if not _shielded:
        raise KeyboardInterrupt
    _shielded[-1] = True


def _interrupt_again(unraisable: Any) -> None:
    """An interruption that fell into a destructor or a weak reference's callback, where exceptions are lost, is repeated."""
    if not issubclass(unraisable.exc_type, KeyboardInterrupt):
        sys.__unraisablehook__(unraisable)
        return
    _interrupted.pop("at", None)
    threading.Timer(0.05, os.kill, (os.getpid(), signal.SIGINT)).start()


_shielded: list[bool] = []


@contextlib.contextmanager
def uninterrupted() -> Any:
    """Inside, a worker's interruption waits for the end: in destructors, which matplotlib runs, it would be lost."""
    _shielded.append(False)
    try:
        yield
    finally:
        was_interrupted = _shielded.pop()
    if was_interrupted:
        raise KeyboardInterrupt


def _stop_with_parent(parent: int) -> None:
    """Workers must not outlive the program: the same command, started again, would have twice as many."""
    while os.getppid() == parent:
        time.sleep(1)
    os._exit(1)


class WorkerPool:
    """
    Some processes that run one function until it returns.

    A worker that is killed, politely or not, is started again; one that raises stops the pool, and one that gets Ctrl-C,
    which reaches all. Leaving the ``with`` block interrupts those that still run, as Ctrl-C does, so that they can put away
    what they have.

    :param target: Function that each worker runs; it returns when nothing is left to do
    :param arguments: Its arguments, which must be picklable
    :param n_workers: Number of processes
    :param threads: Threads of PyTorch and BLAS in each, None for its share of the cores. GPUs are shared out: with more
        than one, a worker sees the one that failed least, and of these the one that has the fewest others
    """

    def __init__(self, target: Callable[..., None], arguments: tuple[Any, ...], n_workers: int, threads: int | None = None):
        if n_workers < 1:
            raise ValueError(f"workers must be at least 1, not {n_workers}")
        # Not fork: PyTorch's threads and open storages do not survive it.
        self._context = multiprocessing.get_context("spawn")
        self._errors = self._context.SimpleQueue()
        # Those that a container may use, too, where it has fewer than the machine.
        self._start = (target, arguments, self._errors, threads or max(1, joblib.cpu_count() // n_workers))
        self.processes: list[BaseProcess] = []
        self._deaths: dict[BaseProcess, int] = {}  # of those before it in its place
        self._started: dict[BaseProcess, float] = {}
        self._gpus = visible_gpus()
        self._gpu_of: dict[BaseProcess, str] = {}
        self._failures: Counter[str] = Counter()  # of GPUs
        self._unfit: dict[int | None, str] = {}  # why, by process
        self._n_workers = n_workers

    def __enter__(self) -> "WorkerPool":
        for _ in range(self._n_workers):
            self._add()
        return self

    def _add(self, deaths: int = 0) -> None:
        # Two threads of BLAS or OpenMP for each of two workers on two cores are four: slower than one each.
        variables = {"OMP_NUM_THREADS": str(self._start[-1]), "MKL_NUM_THREADS": str(self._start[-1])}
        if len(self._gpus) > 1:
            taken = Counter(self._gpu_of[process] for process in self.processes)
            variables["CUDA_VISIBLE_DEVICES"] = min(self._gpus, key=lambda gpu: (self._failures[gpu], taken[gpu]))
        with _environment(**variables):
            process = self._context.Process(target=_work, args=(*self._start, os.getpid()))
            process.start()
        self.processes.append(process)
        self._deaths[process] = deaths
        self._started[process] = time.monotonic()
        self._gpu_of[process] = variables.get("CUDA_VISIBLE_DEVICES", "")

    def check(self, progressed: bool) -> bool:
        """
        Start workers again that were killed.

        :param progressed: Whether a trial has ended since the last call, other than by a death
        :return: Whether any worker still runs
        :raises WorkerError: when a worker stopped with an error, or they keep dying
        """
        if progressed:
            self._deaths = dict.fromkeys(self._deaths, 0)
        ended = [process for process in self.processes if process.exitcode is not None]
        while not self._errors.empty():  # what they said before they ended
            pid, is_unfit, text = self._errors.get()
            if not is_unfit:
                raise WorkerError(text)
            self._unfit[pid] = text
        for process in ended:
            self.processes.remove(process)
            gpu = self._gpu_of.pop(process)
            deaths, lived = self._deaths.pop(process), time.monotonic() - self._started.pop(process)
            if process.exitcode == 128 + signal.SIGINT:
                raise KeyboardInterrupt
            if process.exitcode != 0:
                cause = self._unfit.pop(process.pid, None)
                if cause is not None:
                    logger.error("A worker ended, another one goes on: %s", cause)
                    self._failures[gpu] += 1
                killed = ": killed, as systems do whose memory runs out" if process.exitcode == -signal.SIGKILL else ""
                self._add(count_death(deaths, lived, cause or f"exit code {process.exitcode}{killed}"))
        return bool(self.processes)

    def __exit__(self, *exception: Any) -> None:
        for _ in range(6):
            for process in self.processes:
                if process.pid is not None and process.exitcode is None:
                    with contextlib.suppress(ProcessLookupError):
                        os.kill(process.pid, signal.SIGINT)
            deadline = time.monotonic() + INTERRUPT_SECONDS
            for process in self.processes:
                process.join(timeout=max(0.0, deadline - time.monotonic()))
            if all(process.exitcode is not None for process in self.processes):
                return
        for process in self.processes:
            process.kill()


def visible_gpus() -> list[str]:
    """The GPUs that this process may use, as ``CUDA_VISIBLE_DEVICES`` names them."""
    named = os.environ.get("CUDA_VISIBLE_DEVICES")
    return (
        [name for name in named.split(",") if name] if named is not None else [str(i) for i in range(th.cuda.device_count())]
    )


@contextlib.contextmanager
def _environment(**variables: str) -> Any:
    """Environment variables for the processes that are started inside."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
