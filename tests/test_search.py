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
    aarl("search", write_search(folder), "--workers", 2, folder=folder)
    found = slots(folder)
    assert len(found) == 6
    return found


def runs_of_driver(pid: int) -> list[int]:
    """Processes that train for a driver."""
    return [process.pid for process in psutil.Process(pid).children() if "search.training.run" in process.cmdline()]


def test_runs_and_driver_are_killed_and_interrupted(tmp_path: Path, undisturbed: Slots) -> None:
    """The same command ends with the same losses and scores."""
    config, candidates = write_search(tmp_path), tmp_path / "runs/small/candidates"
    process = start("search", config, "--workers", 2, folder=tmp_path)
    wait_until(lambda: any(candidates.glob("generation-1/slot-001/*/*/provenance.json")), process)
    for pid in runs_of_driver(process.pid):
        os.kill(pid, signal.SIGKILL)
    wait_until(lambda: any(candidates.glob("generation-1/slot-001/*/*/curve.csv")), process)
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 130 and "resumes" in output
    assert TrialState.RUNNING not in [trial.state for trial in load(tmp_path).trials]

    process = start("search", config, "--workers", 1, folder=tmp_path)
    wait_until(lambda: any(candidates.glob("generation-2/slot-000/*/*/provenance.json")), process)
    second = start("search", config, folder=tmp_path)
    assert second.wait(60) == 2 and "another program" in second.communicate()[0]
    left = runs_of_driver(process.pid)
    process.kill()
    process.communicate()
    deadline = time.monotonic() + 60  # a run that has just started has its imports to make first
    while any(psutil.pid_exists(pid) and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE for pid in left):
        assert time.monotonic() < deadline, "runs outlive their driver"
        time.sleep(0.1)

    aarl("search", config, "--workers", 2, folder=tmp_path)
    assert slots(tmp_path) == undisturbed
    write_search(tmp_path, SEARCH.replace("population_size: 3", "population_size: 5"))
    other = start("search", config, folder=tmp_path)
    assert other.wait(60) == 2 and "population_size" in other.communicate()[0]


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


def load(folder: Path) -> optuna.Study:
    return optuna.load_study(study_name="small", storage=open_storage(folder / "runs/small", create=False))


def wait_until(condition: Callable[[], bool], process: subprocess.Popen[str], seconds: float = 120) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None, process.communicate()[0]
        assert time.monotonic() < deadline
        time.sleep(0.1)
