"""Runs on a Ray cluster, whose nodes share the folder of the search (extra ``ray``)."""

import socket
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import ray


def check_address(address: str) -> None:
    """Raise an error if nothing listens at ``host:port``, to which Ray would try to connect without end."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdigit():
        raise ValueError(f"--ray-address is auto or host:port, such as 192.0.2.2:6379, not {address}")
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=10).close()
    except OSError as error:
        raise ConnectionError(f"no Ray cluster answers at {address}: is it started with `ray start --head`?") from error


class RayExecutor(AbstractContextManager["RayExecutor"]):
    """
    Runs as tasks of Ray. It queues what does not fit yet, so that autoscalers see the demand.

    Leaving the ``with`` block cancels the tasks, whose processes end their runs.

    :param address: Address of a running cluster (``auto``, ``host:port``), None for a Ray of its own on this machine
    :param cpus: Cores of each run
    :param gpus: GPUs of each run, such as 0.25
    :raises ValueError: for an address of another form
    :raises ConnectionError: when no cluster answers
    """

    def __init__(self, address: str | None = None, cpus: float = 1, gpus: float = 0):
        if address and address != "auto" and "://" not in address:
            check_address(address)
        # A user's own modules are found on all nodes, whose Ray was started in another folder.
        environment = {"env_vars": {"PYTHONPATH": f"{Path.cwd()}:${{PYTHONPATH}}"}}
        dashboard = False if address is None else None
        try:
            # "local" starts a new Ray also where RAY_ADDRESS names another one.
            ray.init(address or "local", runtime_env=environment, log_to_driver=False, include_dashboard=dashboard)
        except ConnectionError as error:  # Ray's advice names options that are not ours
            raise ConnectionError(f"--ray-address {address}: {str(error).partition('. ')[0]}") from error
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
