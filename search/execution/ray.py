"""Workers on a Ray cluster: Ray places them on its nodes, those that die are started again, nodes that join get some."""

import contextlib
import logging
import math
import multiprocessing.spawn
import os
import signal
import socket
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import joblib  # type: ignore[import-untyped]

from search.execution.local import (
    INTERRUPT_SECONDS,
    Unfit,
    WorkerError,
    _interrupt_again,
    _interrupt_once,
    count_death,
    message,
)
from search.execution.passwords import storage_name, without_password
from search.execution.storage import is_local

try:
    import ray
    from ray.exceptions import RayError, RayTaskError, TaskCancelledError
except ModuleNotFoundError:
    ray = None  # type: ignore[assignment]

logger = logging.getLogger(__name__)

# Bytes of a node's memory for Ray's objects, of which a search has next to none. Ray takes 30 % unless told otherwise.
OBJECT_STORE_BYTES = 80_000_000
# Seconds that a cluster's port has to answer.
ANSWER_SECONDS = 5.0
# Ray counts resources in ten thousandths.
DIGITS = 4


def _work(
    target: Callable[..., None], arguments: tuple[Any, ...], threads: int, main: dict[str, str], cwd: str
) -> Iterator[Any]:
    """
    What a worker runs, as a task of Ray: it says where it runs, then what stopped it.

    :param target: Function to run
    :param arguments: Its arguments
    :param threads: Threads of PyTorch
    :param main: Where the program is, which may register environments
    :param cwd: Folder of the program, from which relative paths count; passed over where there is none
    :return: Node id and process number; then the message of an error, the error itself of a process that cannot go on, None
        without one
    """
    import torch as th

    yield ray.get_runtime_context().get_node_id(), os.getpid()
    try:
        with contextlib.suppress(OSError):
            os.chdir(cwd)
        if os.path.exists(main.get("init_main_from_path", "/")):
            multiprocessing.spawn.prepare(main)
        th.set_num_threads(threads)
        # Ray interrupts as a terminal does, but once. The process ends with the task: nothing has to be put back.
        signal.signal(signal.SIGINT, _interrupt_once)
        sys.unraisablehook = _interrupt_again
        target(*arguments)
    except Unfit as error:
        yield error
    except Exception as error:
        yield message(error)
    else:
        yield None


@dataclass(eq=False)
class RayWorker:
    """
    :param task: What it runs
    :param deaths: How many before it died in its place, without a trial finished in between
    :param started: When it got to work, or in line for it, by the monotonic clock
    :param node: Id of the node that it runs on, None while Ray has no room for it
    :param pid: Its process number there
    """

    task: "ray.ObjectRefGenerator"
    deaths: int = 0
    started: float = field(default_factory=time.monotonic)
    node: str | None = None
    pid: int | None = None


class RayPool:
    """
    Some workers on a Ray cluster that run one function until it returns.

    A worker that dies, by itself or with its node, is started again wherever there is room; one that raises stops the pool.
    As soon as one returns nothing is left to do: none is started any more. Leaving the ``with`` block interrupts those that
    still run, as Ctrl-C does, so that they can put away what they have.

    This package has to be installed on all nodes, in the same versions; nothing is uploaded. Of the program's environment
    variables the workers have those that their node was started with; what they print is in Ray's logs. A cluster outlives
    the loss of any node but its head, and the one that this program runs on. Whoever reaches its ports can run programs
    on it.

    :param target: Function that each worker runs, of a module that the nodes have; it returns when nothing is left to do
    :param arguments: Its arguments, which must be picklable
    :param n_workers: At most so many workers; None for as many as the cluster has room for, and more when nodes join
    :param cpus_per_trial: Cores of each worker, and threads of its PyTorch and BLAS, at least one
    :param gpus_per_trial: GPUs of each worker: a part of one, or a whole number. With 0 it sees none
    :param address: A running cluster, ``host:port``, or ``auto`` for the one of this machine or ``RAY_ADDRESS``; None for a
        Ray of its own on this machine, which ends with the pool. If this process has joined one already, that is taken
    :param storage: Where the workers' storage is, to be refused if some of them cannot reach it: see
        :func:`check_storage`. None for workers without one
    :raises ValueError: when Ray is not installed, a number is impossible or no cluster answers
    """

    def __init__(
        self,
        target: Callable[..., None],
        arguments: tuple[Any, ...],
        n_workers: int | None = None,
        cpus_per_trial: float = 1,
        gpus_per_trial: float = 0,
        address: str | None = None,
        storage: str | None = None,
    ):
        if ray is None:
            raise ValueError("Ray is not installed: pip install sb3-aarl[ray]")
        if n_workers is not None and n_workers < 1:
            raise ValueError(f"workers must be at least 1, not {n_workers}")
        self.cpus_per_trial, self.gpus_per_trial = round(cpus_per_trial, DIGITS), round(gpus_per_trial, DIGITS)
        if not 0 < self.cpus_per_trial < math.inf:
            raise ValueError(f"cpus_per_trial must be above 0, not {cpus_per_trial}")
        if not 0 <= self.gpus_per_trial < math.inf or (self.gpus_per_trial > 1 and self.gpus_per_trial % 1):
            raise ValueError(f"gpus_per_trial must be between 0 and 1, or a whole number, not {gpus_per_trial}")
        self.workers: list[RayWorker] = []
        self._address = address
        self._storage = storage
        self._n_workers = n_workers
        self._nodes: set[str] = set()  # those that were looked at
        self._target_workers = 0
        self._finished = False
        self._warned = False
        threads = max(1, int(cpus_per_trial))
        main = multiprocessing.spawn.get_preparation_data("worker")
        main = {key: value for key, value in main.items() if key.startswith("init_main")}
        self._arguments = (target, arguments, threads, main, os.getcwd())
        # BLAS reads these when it is loaded, before the task begins.
        self._variables = {"OMP_NUM_THREADS": str(threads), "MKL_NUM_THREADS": str(threads)}

    def __enter__(self) -> "RayPool":
        with contextlib.ExitStack() as stack:
            stack.enter_context(_joined(self._address))
            self._task = ray.remote(
                num_cpus=self.cpus_per_trial,
                num_gpus=self.gpus_per_trial,
                num_returns="streaming",
                max_retries=0,  # check() starts them again, and counts
                max_calls=1,
                scheduling_strategy="SPREAD",
                runtime_env={"env_vars": self._variables},
            )(_work)
            self._fill()
            self._connection = stack.pop_all()
        return self

    def check(self, progressed: bool) -> bool:
        """
        Start workers again that died, and some on nodes that have joined.

        :param progressed: Whether a trial has ended since the last call, other than by a death
        :return: Whether any worker still runs
        :raises WorkerError: when a worker stopped with an error, or they keep dying
        :raises ValueError: when a node has joined that cannot reach the storage
        """
        for worker in list(self.workers):
            worker.deaths = 0 if progressed else worker.deaths
            try:
                ended = self._ended(worker)
            except TaskCancelledError:
                raise KeyboardInterrupt from None
            except RayTaskError as error:  # before the worker could begin, such as for a module that its node has not
                raise WorkerError(message(error)) from None
            except (RayError, Unfit) as error:
                self.workers.remove(worker)
                self._replace(worker, error)
            else:
                if ended:
                    self.workers.remove(worker)
                    self._finished = True
        if self._finished:
            # Others may use the cluster too: those that still wait for room might do so for days, for nothing.
            for worker in [worker for worker in self.workers if worker.node is None]:
                ray.cancel(worker.task)
                self.workers.remove(worker)
        else:
            self._fill()
        return bool(self.workers)

    def _ended(self, worker: RayWorker) -> bool:
        """Whether a worker has returned; raises what stopped it."""
        while ray.wait([worker.task], timeout=0)[0]:
            said = ray.get(next(worker.task))
            if worker.node is not None:
                if isinstance(said, Unfit):
                    raise said
                if said is not None:
                    raise WorkerError(said)
                return True
            worker.node, worker.pid = said
            worker.started = time.monotonic()
        return False

    def _replace(self, worker: RayWorker, error: RayError | Unfit) -> None:
        cause = str(error) if isinstance(error, Unfit) else f"{type(error).__name__}: {str(error).partition(chr(10))[0]}"
        if isinstance(error, Unfit):
            logger.error("A worker ended, another one goes on: %s", cause)
        deaths = count_death(worker.deaths, time.monotonic() - worker.started, cause)
        if not self._finished:
            self._add(deaths)

    def _fill(self) -> None:
        """Start as many workers as the cluster has room for; Ray places them."""
        nodes = {node["NodeID"]: node for node in ray.nodes() if node["Alive"]}
        if nodes.keys() != self._nodes:
            self._nodes = set(nodes)
            if self._storage is not None:
                check_storage(self._storage)
            room = sum(self._room(node["Resources"]) for node in nodes.values())
            if room == 0:
                self._complain([node["Resources"] for node in nodes.values()])
            # One waits where there is no room at all: autoscalers add nodes for those that wait.
            self._target_workers = self._n_workers or max(1, room)
        while len(self.workers) < self._target_workers:
            self._add()

    def _room(self, resources: dict[str, float]) -> int:
        """How many workers a node can hold."""
        room = math.floor(round(resources.get("CPU", 0) / self.cpus_per_trial, DIGITS))
        if self.gpus_per_trial == 0:
            return room
        gpus = resources.get("GPU", 0)
        # Those that share a GPU must fit on it.
        # Ray counts in such units, and 1 // 0.2 is 4 in floats.
        unit = 10**DIGITS
        one = round(self.gpus_per_trial * unit)
        of_gpus = gpus * unit // one if self.gpus_per_trial > 1 else gpus * (unit // one)
        return min(room, int(of_gpus))

    def _complain(self, nodes: list[dict[str, float]]) -> None:
        there = "; ".join(f"{node.get('CPU', 0):g} CPUs, {node.get('GPU', 0):g} GPUs" for node in nodes) or "no node"
        wanted = f"a worker needs {self.cpus_per_trial:g} CPUs, {self.gpus_per_trial:g} GPUs; the nodes of Ray have: {there}"
        if self._address is None:
            raise ValueError(wanted)
        if not self._warned:
            logger.warning("%s. Waiting for a node that has room.", wanted)
            self._warned = True

    def _add(self, deaths: int = 0) -> None:
        self.workers.append(RayWorker(self._task.remote(*self._arguments), deaths))

    def __exit__(self, *exception: Any) -> None:
        with self._connection:
            running = [worker.task for worker in self.workers]
            for force in (False,) * 6 + (True,):
                for task in running:
                    ray.cancel(task, force=force)
                ends = {task.completed(): task for task in running}
                left = ray.wait(list(ends), num_returns=len(ends), timeout=INTERRUPT_SECONDS)[1] if ends else []
                running = [ends[end] for end in left]


@contextlib.contextmanager
def _joined(address: str | None) -> Iterator[None]:
    """A connection to a cluster, None for one of its own on this machine."""
    if ray.is_initialized():
        yield
        return
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is reported anywhere
    quiet: dict[str, Any] = {"logging_level": logging.ERROR, "log_to_driver": False}
    # Ray takes SIGTERM, which may have a meaning already.
    handler = signal.getsignal(signal.SIGTERM)
    try:
        if address is None:
            cores = joblib.cpu_count()
            local: dict[str, Any] = {"num_cpus": cores, "include_dashboard": False, "object_store_memory": OBJECT_STORE_BYTES}
            try:
                _init(address="local", **local, **quiet)
            except (ValueError, OSError, RuntimeError, RayError) as error:
                # On a busy machine its server may not be up in the time that Ray gives it.
                if "Timed out" not in str(error):
                    raise
                ray.shutdown()
                _init(address="local", **local, **quiet)
        else:
            _check_address(address)
            _init(address=address, **quiet)
    except (ValueError, OSError, RuntimeError, RayError) as error:
        reason = str(error).partition("\n")[0]
        raise ValueError(f"no Ray at {address}: {reason}" if address else f"Ray did not start: {reason}") from None
    try:
        with contextlib.suppress(ValueError):  # not in the main thread
            signal.signal(signal.SIGTERM, handler)
        yield
    finally:
        ray.shutdown()


def _init(**arguments: Any) -> None:
    """Ray shows the whole cluster the command that joined it, which may have a storage's password."""
    utils = ray._private.utils
    original = utils.get_entrypoint_name
    utils.get_entrypoint_name = lambda: without_password(original())
    try:
        ray.init(**arguments)
    finally:
        utils.get_entrypoint_name = original


def _check_address(address: str) -> None:
    """Ray itself tries for a long time."""
    if address == "auto":
        return
    host, _, port = address.rpartition(":")
    if not host or not port.isdigit() or "/" in host:
        raise ValueError("an address is auto or host:port")
    socket.create_connection((host, int(port)), timeout=ANSWER_SECONDS).close()


def check_storage(where: str) -> None:
    """
    Refuse a storage that only this machine has, if the cluster that this process has joined has nodes on others.

    :param where: The storage, as for :func:`search.execution.storage.open_storage`
    :raises ValueError: naming the machines that cannot reach it
    """
    if not is_local(where):
        return
    nodes = [node for node in ray.nodes() if node["Alive"]]
    here = ray.get_runtime_context().get_node_id()
    machines = {node["NodeID"]: (node["NodeManagerHostname"], node["NodeManagerAddress"]) for node in nodes}
    others = sorted({" ".join(machine) for machine in machines.values() if machine != machines[here]})
    if others:
        raise ValueError(
            f"the storage {storage_name(where)} is on this machine, but Ray has nodes on others ({', '.join(others)}): "
            "take one that they reach, --storage postgresql://... or grpc://..."
        )
