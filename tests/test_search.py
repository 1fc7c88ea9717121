"""Searches for real: the program aarl, processes that train, SIGKILL, PostgreSQL that restarts, Ray nodes that go."""

import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import optuna
import psutil
import pytest
from optuna.trial import TrialState
from postgres import Postgres
from program import aarl, start
from tiny import SEARCH, write_search

from search.evolution.space import loss_of
from search.execution.driver import Driver
from search.execution.storage import open_storage
from search.studies.config import load_config
from search.studies.search import open_search, runs_of

pytestmark = pytest.mark.slow
Slots = dict[tuple[int, int], tuple[str, float | None]]


def slots(folder: Path | None, url: str | None = None) -> Slots:
    """Loss and score of each slot; a slot has one finished trial."""
    storage = open_storage(None if folder is None else folder / "runs/small", url, create=False)
    trials = optuna.load_study(study_name="small", storage=storage).get_trials(states=(TrialState.COMPLETE,))
    keys = [(trial.user_attrs["generation"], trial.user_attrs["slot"]) for trial in trials]
    assert len(set(keys)) == len(keys)
    return dict(zip(keys, [(str(loss_of(trial)), trial.value) for trial in trials], strict=True))


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Slots:
    folder = tmp_path_factory.mktemp("undisturbed")
    output = aarl("search", write_search(folder), "--workers", 2, folder=folder)
    assert "8" in output
    found = slots(folder)
    assert len(found) == 8
    return found


def runs_of_driver(pid: int) -> list[int]:
    """Processes that train for a driver."""
    return [process.pid for process in psutil.Process(pid).children() if "search.training.run" in process.cmdline()]


def test_workers_and_driver_are_killed(tmp_path: Path, undisturbed: Slots) -> None:
    """Runs are killed, the driver twice; the same command ends with the same losses and scores."""
    config, candidates = write_search(tmp_path), tmp_path / "runs/small/candidates"
    for kill_driver_at in ("generation-1/slot-001/*/*/curve.csv", "generation-2/slot-001/*/*/run.json", None):
        process = start("search", config, "--workers", 2, folder=tmp_path)
        wait_until(lambda pid=process.pid: bool(runs_of_driver(pid)), process)  # type: ignore[misc]
        time.sleep(2)
        for pid in runs_of_driver(process.pid):
            os.kill(pid, signal.SIGKILL)
        if kill_driver_at is None:
            output, _ = process.communicate(timeout=300)
            assert process.returncode == 0, output
            continue
        wait_until(lambda pattern=kill_driver_at: any(candidates.glob(pattern)), process)  # type: ignore[misc]
        left = runs_of_driver(process.pid)
        process.kill()
        process.communicate()
        deadline = time.monotonic() + 60  # one that has just started has its imports to make first
        while any(psutil.pid_exists(pid) and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE for pid in left):
            assert time.monotonic() < deadline, "runs outlive their driver"
            time.sleep(0.1)
    assert slots(tmp_path) == undisturbed


def test_postgresql_restarts_in_the_middle(tmp_path: Path, undisturbed: Slots, postgres: Postgres) -> None:
    url = postgres.create("restarted")
    process = start("search", write_search(tmp_path), "--workers", 2, "--storage", url, folder=tmp_path)
    deadline = time.monotonic() + 120
    while not (tmp_path / "runs/small/candidates/generation-1/slot-001").exists():
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.2)
    postgres.restart(crash=True, seconds=3)
    output, _ = process.communicate(timeout=300)
    assert process.returncode == 0, output
    assert "s3cret" not in output
    assert slots(None, url) == undisturbed


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Two Ray nodes on this machine."""
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent.parent))
    node = {"num_cpus": 1, "object_store_memory": 80_000_000, "include_dashboard": False}
    cluster = Cluster(initialize_head=True, head_node_args=node)
    cluster.add_node(num_cpus=1, object_store_memory=80_000_000)
    yield cluster
    cluster.shutdown()


def test_a_ray_node_is_removed(tmp_path: Path, undisturbed: Slots, cluster: Any) -> None:
    from search.execution.ray import RayExecutor

    config, folder = load_config(write_search(tmp_path)), tmp_path / "runs/small"
    storage = open_storage(folder)
    study, _ = open_search(config, storage)
    removed = False
    with RayExecutor(cluster.address) as executor:
        for progress in Driver(study, storage, runs_of(config), executor, folder, workers=2, retries=config.retries):
            if not removed and progress.generations[0].filled >= 1:
                cluster.remove_node(next(iter(cluster.worker_nodes)), allow_graceful=False)
                removed = True
    assert removed
    assert slots(tmp_path) == undisturbed


def test_ctrl_c_and_the_same_command(tmp_path: Path, undisturbed: Slots) -> None:
    config = write_search(tmp_path)
    process = start("search", config, folder=tmp_path)
    wait_until(lambda: (tmp_path / "runs/small/candidates/generation-1/slot-001").exists(), process)
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 130 and "resumes" in output
    states = [trial.state for trial in optuna.load_study(study_name="small", storage=storage(tmp_path)).trials]
    assert TrialState.RUNNING not in states
    # Another program may not have the search of one that runs, and other settings are refused.
    process = start("search", config, folder=tmp_path)
    wait_until(lambda: (tmp_path / "runs/small/candidates/generation-1/slot-002").exists(), process)
    second = start("search", config, folder=tmp_path)
    assert second.wait(60) == 2 and "another program" in second.communicate()[0]
    assert process.wait(200) == 0
    assert slots(tmp_path) == undisturbed
    write_search(tmp_path, SEARCH.replace("population_size: 4", "population_size: 5"))
    other = start("search", config, folder=tmp_path)
    assert other.wait(60) == 2 and "population_size" in other.communicate()[0]


def storage(folder: Path) -> Any:
    return open_storage(folder / "runs/small", create=False)


def wait_until(condition: Callable[[], bool], process: subprocess.Popen[str], seconds: float = 120) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None, process.communicate()[0]
        assert time.monotonic() < deadline
        time.sleep(0.1)
