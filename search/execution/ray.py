"""Runs on a Ray cluster, whose nodes share the folder of the search (extra ``ray``)."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import ray


class RayExecutor(AbstractContextManager["RayExecutor"]):
    """
    Runs as tasks of Ray. It queues what does not fit yet, so that autoscalers see the demand.

    Leaving the ``with`` block cancels the tasks, whose processes end their runs.

    :param address: Address of a running cluster (``auto``, ``host:port``), None for a Ray of its own on this machine
    :param cpus: Cores of each run
    :param gpus: GPUs of each run, such as 0.25
    """

    def __init__(self, address: str | None = None, cpus: float = 1, gpus: float = 0):
        # "local" starts a new Ray also where RAY_ADDRESS names another one.
        ray.init(address=address or "local", log_to_driver=False, include_dashboard=False if address is None else None)
        # Ray would repeat a task on its own, and keep a worker's memory for the next one.
        self._options: dict[str, Any] = {"num_cpus": cpus, "num_gpus": gpus, "max_retries": 0, "max_calls": 1}
        self._references: list[Any] = []

    def submit(self, fn: Callable[..., Any], /, *args: Any) -> Any:
        """Submit a function, and return a future of ``concurrent.futures``."""
        reference = ray.remote(**self._options)(fn).remote(*args)
        self._references.append(reference)
        return reference.future()

    def __exit__(self, *exception: Any) -> None:
        for reference in self._references:
            ray.cancel(reference, force=True)  # one that is over stays as it is
        ray.shutdown()
