"""Runs as jobs of Slurm, whose nodes share the folder of the search (extra ``slurm``)."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import submitit

# submitit's default is five minutes. A run that reaches the limit is resubmitted, and resumes from its last evaluation.
TIMEOUT_MIN = 24 * 60


class SlurmExecutor(AbstractContextManager["SlurmExecutor"]):
    """
    Runs as jobs of Slurm, by submitit. Leaving the ``with`` block cancels those that are not over.

    :param folder: Folder for the files of the jobs, which all nodes share
    :param cpus: Cores of each run
    :param gpus: GPUs of each run
    :param cluster: ``local`` for processes of this machine instead of Slurm
    :param parameters: Further ones of submitit's ``AutoExecutor``, such as ``slurm_partition`` and ``timeout_min``
    :raises ValueError: when Slurm is not installed, or does not have a parameter
    """

    def __init__(self, folder: Path, cpus: int = 1, gpus: int = 0, cluster: str = "slurm", **parameters: Any):
        parameters = {"cpus_per_task": cpus, "gpus_per_node": gpus, "timeout_min": TIMEOUT_MIN, **parameters}
        try:
            self._executor = submitit.AutoExecutor(folder, cluster=cluster)
            self._executor.update_parameters(**parameters)
        except (RuntimeError, NameError, AssertionError) as error:  # no Slurm; a parameter that is unknown, or of another type
            raise ValueError(f"submitit: {error}") from error
        self._jobs: list[Any] = []

    def submit(self, fn: Callable[..., Any], /, *args: Any) -> Any:
        """Submit a function, and return submitit's job, which has ``done`` and ``result``."""
        self._jobs.append(self._executor.submit(fn, *args))
        return self._jobs[-1]

    def __exit__(self, *exception: Any) -> None:
        for job in self._jobs:
            if not job.done():
                job.cancel()
