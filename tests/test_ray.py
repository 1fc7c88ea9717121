"""Workers on Ray: placed on nodes, replaced when they or their node die, stopped together."""

import logging
import os
import signal
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import joblib  # type: ignore[import-untyped]
import optuna
import psutil
import pytest
import torch as th
from optuna.trial import TrialState

from search.evolution.sampler import AuxLossSampler, SearchComplete
from search.evolution.space import suggest_aux_loss
from search.execution import local as pool_module
from search.execution import ray as ray_launcher
from search.execution import workers
from search.execution.local import Unfit, WorkerError
from search.execution.ray import RayPool, RayWorker, check_storage
from search.execution.storage import open_storage

ray = pytest.importorskip("ray")
cluster_utils = pytest.importorskip("ray.cluster_utils")

SETTINGS: dict[str, Any] = {"population_size": 4, "n_random": 3, "n_prior": 1, "max_horizon": 2, "n_stages": 2}
SMALL = {"object_store_memory": 80_000_000, "include_dashboard": False}


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """A node with two cores and what Ray takes for a GPU. Tests leave no other node behind."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(Path(__file__).parent))  # nodes have the modules of the workers' functions
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        cluster = cluster_utils.Cluster(initialize_head=True, head_node_args={"num_cpus": 2, "num_gpus": 1, **SMALL})
        yield cluster
        cluster.shutdown()


def check_until(pool: RayPool, condition: Callable[[], bool]) -> None:
    """Look after the workers until something has happened."""
    deadline = time.monotonic() + 90
    while not condition():
        assert pool.check(progressed=False), "no worker is left"
        assert time.monotonic() < deadline
        time.sleep(0.05)


def placed(pool: RayPool) -> list[RayWorker]:
    return [worker for worker in pool.workers if worker.pid is not None]


def fill_places(folder: Path) -> None:
    """Fill the places of the folder's study. Trainings last until there is a file ``go``."""
    optuna.logging.set_verbosity(optuna.logging.ERROR)

    def objective(trial: optuna.Trial) -> float:
        loss = suggest_aux_loss(trial, SETTINGS["max_horizon"])
        while not (folder / "go").exists():
            time.sleep(0.02)
        return float(sum(loss.target) - sum(loss.source))

    sampler = AuxLossSampler(**SETTINGS, seed=0)
    study = optuna.load_study(study_name="study", storage=open_storage(folder), sampler=sampler)
    workers.fail_dead(study, study.trials)
    try:
        study.optimize(objective)
    except SearchComplete:
        return


def test_a_search_outlives_a_node_and_a_worker_and_takes_a_node_that_joins(cluster: Any, tmp_path: Path) -> None:
    storage = open_storage(tmp_path)
    study = optuna.create_study(study_name="study", storage=storage, direction="maximize")

    def training() -> set[int]:
        """Process numbers of the workers that hold a trial."""
        trials = study.get_trials(deepcopy=False, states=(TrialState.RUNNING,))
        return {int(trial.user_attrs["worker"].split()[-2]) for trial in trials if "place" in trial.user_attrs}

    def all_train(n_workers: int) -> bool:
        return {worker.pid for worker in placed(pool)} <= training() and len(placed(pool)) == n_workers

    first = cluster.add_node(num_cpus=2, **SMALL)
    second = None
    try:
        with RayPool(fill_places, (tmp_path,), cpus_per_trial=2, address=cluster.address, storage=str(tmp_path)) as pool:
            check_until(pool, lambda: all_train(2))
            assert len({worker.node for worker in pool.workers}) == 2
            head = next(worker for worker in pool.workers if worker.node == cluster.head_node.node_id)
            lost = next(worker for worker in pool.workers if worker is not head)

            second = cluster.add_node(num_cpus=2, **SMALL)
            check_until(pool, lambda: all_train(3))
            joined = next(worker for worker in pool.workers if worker not in (head, lost))
            assert joined.node == second.node_id

            cluster.remove_node(first, allow_graceful=False)
            first = None
            check_until(pool, lambda: lost not in pool.workers)
            assert len(pool.workers) == 3 and len(placed(pool)) == 2  # there is no room for the one that replaces it

            assert head.pid is not None
            os.kill(head.pid, signal.SIGKILL)
            check_until(pool, lambda: head not in pool.workers and all_train(2))
            replacement = next(worker for worker in placed(pool) if worker is not joined)
            assert replacement.node == head.node and replacement.pid != head.pid

            (tmp_path / "go").touch()
            while pool.check(progressed=True):
                time.sleep(0.05)
    finally:
        for node in (first, second):
            if node is not None:
                cluster.remove_node(node)
    trials = study.get_trials(deepcopy=False)
    complete = [trial for trial in trials if trial.state == TrialState.COMPLETE]
    places = sorted((trial.user_attrs["stage"], trial.user_attrs["place"]) for trial in complete)
    assert places == [(stage, place) for stage in (1, 2) for place in range(4)]
    # Others failed without a place, when the search was complete.
    failed = [trial for trial in trials if trial.state == TrialState.FAIL and "place" in trial.user_attrs]
    assert {int(trial.user_attrs["worker"].split()[-2]) for trial in failed} == {head.pid, lost.pid}
    assert {trial.user_attrs["reason"] for trial in failed} == {"its worker died"}


def say_and_wait(folder: Path) -> None:
    """Say what the worker has, wait, put away what is there when interrupted."""
    variables = (os.environ.get(name) for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "CUDA_VISIBLE_DEVICES"))
    try:
        (folder / f"{os.getpid()}.said").write_text(f"{th.get_num_threads()} {' '.join(map(str, variables))} {os.getcwd()}")
        while True:
            time.sleep(0.01)
    except KeyboardInterrupt:
        time.sleep(0.5)
        (folder / f"{os.getpid()}.away").touch()
        raise


def test_two_workers_share_a_gpu_and_put_away_what_they_have(
    cluster: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with RayPool(say_and_wait, (tmp_path,), 3, cpus_per_trial=0.5, gpus_per_trial=0.5, address=cluster.address) as pool:
        check_until(pool, lambda: len(list(tmp_path.glob("*.said"))) == 2)
        time.sleep(1)
        assert pool.check(progressed=False)
        assert len(pool.workers) == 3 and len(placed(pool)) == 2
        assert {path.read_text() for path in tmp_path.glob("*.said")} == {f"1 1 1 0 {tmp_path}"}
        pids = {str(worker.pid) for worker in placed(pool)}
    assert {path.stem for path in tmp_path.glob("*.away")} == {path.stem for path in tmp_path.glob("*.said")} == pids


def refuse() -> None:
    raise ValueError("the learning rate\nis negative")


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def leave(folder: Path) -> None:
    (folder / str(os.getpid())).touch()
    raise Unfit("the GPU failed")


def test_a_worker_that_is_unfit_is_replaced_and_counted(cluster: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pool_module, "MAX_DEATHS", 1)
    with (
        pytest.raises(WorkerError, match=r"^2 workers died one after the other \(the GPU failed\)$"),
        RayPool(leave, (tmp_path,), 1, address=cluster.address) as pool,
    ):
        check_until(pool, lambda: False)
    assert len(list(tmp_path.iterdir())) == 2


def test_a_worker_that_raises_stops_the_pool_with_its_line(cluster: Any) -> None:
    with (
        pytest.raises(WorkerError, match=r"^the learning rate is negative$"),
        RayPool(refuse, (), 1, address=cluster.address) as pool,
    ):
        check_until(pool, lambda: False)


def test_workers_that_keep_dying_stop_the_pool(cluster: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pool_module, "MAX_DEATHS", 0)
    with (
        pytest.raises(WorkerError, match=r"^1 workers died one after the other \(WorkerCrashedError"),
        RayPool(die, (), 1, address=cluster.address) as pool,
    ):
        check_until(pool, lambda: False)


def test_a_worker_that_fits_no_node_is_told_once_and_waits(cluster: Any, caplog: pytest.LogCaptureFixture) -> None:
    with (
        caplog.at_level(logging.WARNING, "search.execution.ray"),
        RayPool(refuse, (), cpus_per_trial=1, gpus_per_trial=4, address=cluster.address) as pool,
    ):
        for _ in range(3):
            assert pool.check(progressed=False)
        assert len(pool.workers) == 1 and not placed(pool)
    (message,) = (record.getMessage() for record in caplog.records)
    assert "needs 1 CPUs, 4 GPUs" in message and "2 CPUs, 1 GPUs" in message


@pytest.mark.parametrize(
    ("where", "is_refused"),
    [
        ("runs/search", True),
        ("sqlite:///study.db", True),
        ("postgresql://u:p@db/x", False),
        ("grpc://db:13000", False),
        ("grpc://127.0.0.1:13000", True),
        ("postgresql:///x", True),
        ("postgresql://u@localhost/x", True),
        ("postgresql://u@/x?host=/var/run/postgresql", True),
        ("postgresql://u@/x?host=db", False),
        ("postgresql://u@/x?host=localhost", True),
    ],
)
def test_a_storage_of_this_machine_is_refused_when_nodes_are_on_others(
    where: str, is_refused: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = {"NodeID": "a", "Alive": True, "NodeManagerHostname": "here", "NodeManagerAddress": "10.0.0.1"}
    other = {"NodeID": "b", "Alive": True, "NodeManagerHostname": "there", "NodeManagerAddress": "10.0.0.2"}
    # A machine of its own for each node is not at hand.
    monkeypatch.setattr(ray, "get_runtime_context", lambda: type("Context", (), {"get_node_id": lambda self: "a"})())
    for nodes in ([here], [here, {**here, "NodeID": "c"}], [here, {**other, "Alive": False}]):
        monkeypatch.setattr(ray, "nodes", lambda nodes=nodes: nodes)
        check_storage(where)
    monkeypatch.setattr(ray, "nodes", lambda: [here, other])
    if not is_refused:
        check_storage(where)
        return
    with pytest.raises(ValueError, match=r"there 10\.0\.0\.2.*--storage postgresql://") as refusal:
        check_storage(where)
    assert where in str(refusal.value)


def test_the_cluster_is_not_told_a_password(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ray shows everybody the command line of who has joined."""
    told = []
    monkeypatch.setattr(
        psutil.Process, "cmdline", lambda process: ["aarl", "search", "--storage", "postgresql://me:secret@host/db"]
    )
    monkeypatch.setattr(ray, "init", lambda **arguments: told.append(ray._private.utils.get_entrypoint_name()))
    before = ray._private.utils.get_entrypoint_name
    ray_launcher._init(address="auto")
    assert told == ["aarl search --storage postgresql://me:***@host/db"]
    assert ray._private.utils.get_entrypoint_name is before


def say(folder: Path) -> None:
    (folder / "said").write_text(f"{th.get_num_threads()} {os.environ['OMP_NUM_THREADS']} {os.environ['MKL_NUM_THREADS']}")


def test_a_ray_of_its_own_ends_with_the_pool(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    handler = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(joblib, "cpu_count", lambda: 3)  # of a container
    cores = 3
    with RayPool(say, (tmp_path,), cpus_per_trial=cores) as pool:
        assert signal.getsignal(signal.SIGTERM) is handler
        assert len(pool.workers) == 1
        while pool.check(progressed=False):
            time.sleep(0.05)
        with pytest.raises(ValueError, match=f"needs 1 CPUs, 64 GPUs; the nodes of Ray have: {cores} CPUs"):
            RayPool(say, (tmp_path,), gpus_per_trial=64).__enter__()
        assert ray.is_initialized()  # it was not of the second pool
    assert (tmp_path / "said").read_text() == f"{cores} {cores} {cores}"
    assert not ray.is_initialized()


@pytest.mark.parametrize(
    ("cpus", "gpus", "room"),
    # A node of 8 cores and 2 GPUs. Three parts of 0.4 are not on one GPU.
    [
        (1, 0, 8),
        (3, 0, 2),
        (0.5, 0, 16),
        (0.1, 0, 80),
        (1, 0.5, 4),
        (1, 0.4, 4),
        (0.1, 0.2, 10),
        (0.1, 0.1, 20),
        (0.01, 0.01, 200),
        (0.1, 0.3333, 6),
        (0.5, 0.1, 16),
        (1, 1, 2),
        (1, 2, 1),
        (1, 3, 0),
    ],
)
def test_room_of_a_node(cpus: float, gpus: float, room: int) -> None:
    pool = RayPool(refuse, (), cpus_per_trial=cpus, gpus_per_trial=gpus)
    assert pool._room({"CPU": 8.0, "GPU": 2.0}) == room


@pytest.mark.parametrize(
    ("options", "culprit"),
    [
        ({"n_workers": 0}, "workers must be at least 1, not 0"),
        ({"cpus_per_trial": 0}, "cpus_per_trial must be above 0, not 0"),
        ({"cpus_per_trial": float("nan")}, "cpus_per_trial must be above 0, not nan"),
        ({"gpus_per_trial": -1}, "gpus_per_trial must be between 0 and 1, or a whole number, not -1"),
        ({"gpus_per_trial": 1.5}, "gpus_per_trial must be between 0 and 1, or a whole number, not 1.5"),
    ],
    ids=str,
)
def test_impossible_numbers_are_refused(options: dict[str, Any], culprit: str) -> None:
    with pytest.raises(ValueError, match=culprit):
        RayPool(refuse, (), **options)


def test_a_cluster_that_does_not_answer_is_refused_at_once() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # and does not listen
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(ValueError, match=f"no Ray at {address}: .*refused"):
            RayPool(refuse, (), address=address).__enter__()
    for address in ("ray://host:10001", "host", "host:port", ":6379"):
        with pytest.raises(ValueError, match=f"no Ray at {address}: an address is auto or host:port"):
            RayPool(refuse, (), address=address).__enter__()


def test_without_ray_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray_launcher, "ray", None)
    with pytest.raises(ValueError, match=r"pip install sb3-aarl\[ray\]"):
        RayPool(refuse, ())
