"""The queue of runs, for searches and matrices: it submits and resubmits them, and estimates the time to go."""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from sb3_aarl.search.execution.executors import Executor, start_run
from sb3_aarl.search.training.folder import STOP, Run, one_line, prepare_run
from sb3_aarl.search.training.provenance import provenance, read_about, write_about

from sb3_aarl.callbacks import Evaluation

logger = logging.getLogger(__name__)


class Job:
    """One run of a queue. When it is over, ``curve`` and ``failure`` (None, or the reason in one line) are there."""

    def __init__(self, folder: Path, run: Run, retries: int):
        self.folder = folder.absolute()
        self.run = run
        self.retries = retries
        self.curve: list[Evaluation] = []
        self.failure: str | None = None
        self.is_stopped = False
        self.is_over = False
        self.future: Any = None  # of the executor, while it is there

    def stop(self) -> None:
        """End the run; what it has trained since its last evaluation is lost."""
        self.is_stopped = True
        if self.future is None:
            self.is_over = True
        else:
            (self.folder / STOP).touch()


class Queue:
    """
    Runs that are submitted to an executor in the order in which they were added, ``workers`` at the same time. A run whose
    process is killed, or that fails for reasons outside of it, is resubmitted ``retries`` times at most.
    """

    def __init__(self, executor: Executor, workers: int = 1, retries: int = 3):
        self.executor = executor
        self.workers = workers
        self.retries = retries
        self.jobs: list[Job] = []

    def add(self, folder: Path, run: Run) -> Job:
        """Add a run to the end of the queue."""
        job = Job(folder, run, self.retries)
        self.jobs.append(job)
        return job

    def update(self) -> None:
        """Collect the outcomes of finished runs, and submit waiting ones."""
        for job in self.jobs:
            if job.future is not None and job.future.done():
                self._take(job)
        self.jobs = [job for job in self.jobs if not job.is_over]
        for job in self.jobs[: self.workers]:
            if job.future is None:
                prepare_run(job.folder, job.run)
                write_about(job.folder, {**read_about(job.folder), "command": provenance()["command"]})
                job.future = self.executor.submit(start_run, str(job.folder))

    def _take(self, job: Job) -> None:
        try:
            result = job.future.result()
        except Exception as error:  # of the executor: its worker or node is lost
            result = {"curve": [], "failure": one_line(error)[:500], "retry": True}
        job.future = None
        failure = result["failure"]
        if failure is not None and result["retry"] and job.retries > 0 and not job.is_stopped:
            job.retries -= 1
            logger.warning("%s is resubmitted: %s", job.folder, failure.partition(". ")[0])
            return
        job.curve = [Evaluation(*row) for row in result["curve"]]
        job.failure = None if job.is_stopped and result["retry"] else failure
        job.is_over = True


def seconds_to_go(seconds: Sequence[float], left: int, at_once: int) -> float | None:
    """
    Estimated seconds until all runs (or candidates) are over, None if unknown: from the seconds of finished ones, how many are
    left, and how many run at once.
    """
    if left == 0:
        return 0.0
    return float(np.mean(seconds)) * left / max(1, at_once) if seconds else None
