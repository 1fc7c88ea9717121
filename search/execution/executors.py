"""Where runs are executed: ``start_run``, which every executor gets, and an executor of processes on this machine."""

import os
import subprocess
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Protocol

from sb3_aarl.search.training.folder import Outcome, is_finished, partial_curve, read_outcome, read_run
from sb3_aarl.search.training.run import LOCKED

OUTPUT = "output.log"
_thread = threading.local()  # the executor of a thread, if it is a LocalExecutor's


class Executor(Protocol):
    """
    Anything that runs a function somewhere. ``submit`` returns what has ``done()`` and ``result()``: futures of
    ``concurrent.futures``, Ray and Dask, jobs of submitit.
    """

    def submit(self, fn: Callable[..., Any], /, *args: Any) -> Any: ...


def start_run(folder: str) -> dict[str, Any]:
    """
    Train the run of a folder (an absolute path, after ``prepare_run``) in a process of its own, which ends when this one does,
    and wait for it. It is the one function that executors get. A run that is finished is read, not trained again.

    :return: Plain values: ``curve`` (rows of ``Evaluation``), ``failure`` (None, or the reason in one line) and ``retry``
        (whether the failure was not the candidate's fault)
    """
    path, code = Path(folder), 0
    while not is_finished(path):
        code = _train(path)
        if code != LOCKED:  # else another process trains it: wait for its outcome
            break
    outcome = read_outcome(path)
    if outcome is None:  # it was killed, or told to stop
        how = f"signal {-code}" if code < 0 else f"exit code {code}"
        said = (path / OUTPUT).read_text(encoding="utf-8", errors="replace").strip().rpartition("\n")[2]
        said = said or "without a message, as when memory or disk are full"
        failure = f"the run's process ended with {how}: {said} (see {path / OUTPUT})" if code else None
        outcome = Outcome(partial_curve(path), failure, retry=bool(code))
    return {"curve": [list(row) for row in outcome.curve], "failure": outcome.failure, "retry": outcome.retry}


def _train(folder: Path) -> int:
    """Train a run in a process, whose exit code is returned."""
    threads = read_run(folder).threads
    command = [sys.executable, "-m", "sb3_aarl.search.training.run", str(folder), "--end-with-stdin"]
    environment = {**os.environ, "OMP_NUM_THREADS": str(threads)}
    # In a session of its own: Ctrl-C reaches only the driver, and the end of the driver closes the pipe.
    with (
        (folder / OUTPUT).open("ab") as output,
        subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=output, stderr=output, env=environment, start_new_session=True
        ) as process,
    ):
        executor = getattr(_thread, "executor", None)
        if executor is not None:
            executor.processes.append(process)
            if executor.is_closed:
                process.kill()
        return process.wait()


class LocalExecutor(ThreadPoolExecutor):
    """Processes of this machine: each thread starts one and waits for it. Leaving the ``with`` block ends those that run."""

    def __init__(self, workers: int = 1):
        super().__init__(workers, thread_name_prefix="run", initializer=setattr, initargs=(_thread, "executor", self))
        self.processes: list[subprocess.Popen[bytes]] = []
        self.is_closed = False

    def __exit__(self, *exception: Any) -> None:
        self.is_closed = True  # read by threads that are starting a process
        for process in self.processes:
            process.kill()
        self.shutdown(wait=True, cancel_futures=True)
