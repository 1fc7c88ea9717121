"""Searches for real: the program aarl, processes that train, SIGKILL, PostgreSQL that restarts, Ray nodes that go."""

import contextlib
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import optuna
import psutil
import pytest
from executors import InProcess
from filelock import FileLock
from optuna.trial import TrialState
from postgres import Postgres
from sb3_aarl.search.cli.main import app
from sb3_aarl.search.evolution.space import loss_of
from sb3_aarl.search.execution.driver import SearchProgress
from sb3_aarl.search.execution.executors import LocalExecutor
from sb3_aarl.search.execution.queue import Queue
from sb3_aarl.search.execution.storage import open_storage
from sb3_aarl.search.studies.search import Search
from sb3_aarl.search.training.folder import LOCK, is_finished
from tiny import SEARCH, tiny_run, write_search
from typer.testing import CliRunner

pytestmark = pytest.mark.slow
# On two environments: a random loss and a prior, then one of them once more and an offspring.
TASKS = """\
environments:
- {environment: Pendulum-v1, returns: [-1600, 0]}
- {environment: MountainCarContinuous-v0, returns: [-10, 100], checkpoints: [50, 100]}
"""
SHORT = SEARCH.replace("environment: Pendulum-v1\n", TASKS).replace("[200, 400]", "[60, 120]")
SHORT = SHORT.replace("n_random: 2", "n_random: 1").replace("population_size: 3", "population_size: 2\nagain: 0.5")
# Its first generation, on the first of them.
FIRST = re.sub("- {environment: Mountain.*\n", "", SHORT).replace("generations: 2", "generations: 1")
Slots = dict[tuple[int, int], tuple[str, dict[str, float | None]]]


def slots(folder: Path | None, url: str | None = None) -> Slots:
    """Loss and scores of each slot; a slot has one finished trial."""
    storage = open_storage(None if folder is None else folder / "runs/small", url, create=False)
    trials = optuna.load_study(study_name="small", storage=storage).get_trials(states=(TrialState.COMPLETE,))
    keys = [(trial.user_attrs["generation"], trial.user_attrs["slot"]) for trial in trials]
    assert len(set(keys)) == len(keys)
    scores = [trial.user_attrs.get("scores", {"Pendulum-v1": trial.value}) for trial in trials]
    return dict(zip(keys, zip([str(loss_of(trial)) for trial in trials], scores, strict=True), strict=True))


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Slots:
    """Without processes, one run after the other."""
    folder = tmp_path_factory.mktemp("undisturbed")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sb3_aarl.search.execution.driver.POLL_SECONDS", 0)
        Search.from_file(write_search(folder, SHORT), folder / "runs/small").run(InProcess())
    found = slots(folder)
    assert len(found) == 4 and all(len(scores) == 2 for _, scores in found.values())
    return found


def first_on_pendulum(slots: Slots) -> Slots:
    return {key: (loss, {"Pendulum-v1": scores["Pendulum-v1"]}) for key, (loss, scores) in slots.items() if key[0] == 1}


def runs_of_driver(pid: int) -> list[int]:
    """Processes that train for a driver."""
    found = []
    for process in psutil.Process(pid).children():
        with contextlib.suppress(psutil.NoSuchProcess):  # it has just ended
            if "sb3_aarl.search.training.run" in process.cmdline():
                found.append(process.pid)
    return found


def is_alive(pid: int) -> bool:
    return psutil.pid_exists(pid) and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE


def test_leaving_the_executor_ends_its_processes(tmp_path: Path) -> None:
    with LocalExecutor(1) as executor:
        queue = Queue(executor)
        queue.add(tmp_path, tiny_run(checkpoints=(50_000, 100_000)))
        queue.update()
        wait_until(lambda: bool(runs_of_driver(os.getpid())), None)
    assert not runs_of_driver(os.getpid()) and not is_finished(tmp_path)


def start(*arguments: object, folder: Path) -> subprocess.Popen[str]:
    """The program, in a process group of its own."""
    return subprocess.Popen(
        [sys.executable, "-m", "sb3_aarl.search.cli.main", *map(str, arguments)],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parent.parent), "COLUMNS": "200"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
        # Tests in the background (nohup, CI) may ignore Ctrl-C, and children inherit that.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


def refused(*arguments: object) -> str:
    """The error of the program, in this process."""
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == 2
    return result.stderr


def search_in_process(monkeypatch: pytest.MonkeyPatch, executor: InProcess, *arguments: object) -> str:
    """What ``aarl search`` prints, with another executor than this machine's processes."""
    monkeypatch.setattr("sb3_aarl.search.execution.executors.LocalExecutor", lambda workers: executor)
    monkeypatch.setattr("sb3_aarl.search.execution.driver.POLL_SECONDS", 0)
    result = CliRunner().invoke(app, ["search", *map(str, arguments)])
    assert result.exit_code == 0, result.output
    return result.output


def test_runs_and_driver_are_killed_and_interrupted(
    tmp_path: Path, undisturbed: Slots, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same command ends with the same losses and scores."""
    monkeypatch.chdir(tmp_path)
    config, candidates = write_search(tmp_path, SHORT), tmp_path / "runs/small/candidates"
    process = start("search", config, "--workers", 2, folder=tmp_path)
    wait_until(lambda: len(runs_of_driver(process.pid)) == 2, process)
    for pid in runs_of_driver(process.pid):
        os.kill(pid, signal.SIGKILL)
    wait_until(lambda: any(candidates.glob("generation-1/slot-001/*/*/*/curve.csv")), process)
    process.send_signal(signal.SIGTERM)  # as clusters send it; Ctrl-C is the same
    output, _ = process.communicate(timeout=60)
    last = "Interrupted. The same command resumes it, each run from its last evaluation.\n"
    assert process.returncode == 130 and output.endswith(last), output
    trials = load(tmp_path).trials
    assert TrialState.RUNNING not in [trial.state for trial in trials] and any("interrupted" in t.user_attrs for t in trials)

    process = start("search", config, "--workers", 2, folder=tmp_path)
    wait_until(lambda: bool(runs_of_driver(process.pid)), process)
    assert "another program" in refused("search", config)
    wait_until(lambda: bool(runs_of_driver(process.pid)), process)
    left = runs_of_driver(process.pid)
    process.kill()
    process.communicate()
    # They outlive their driver for as long as a run that has just started has imports to make.
    wait_until(lambda: not any(map(is_alive, left)), None, 60)

    search_in_process(monkeypatch, InProcess(), config, "--workers", 4)
    assert slots(tmp_path) == undisturbed
    write_search(tmp_path, SHORT.replace("population_size: 2", "population_size: 5"))
    assert "population_size" in refused("search", config)


def test_postgresql_restarts_in_the_middle(
    tmp_path: Path, undisturbed: Slots, postgres: Postgres, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Restarting(InProcess):
        runs = 0

        def submit(self, fn: Any, path: str) -> Any:
            self.runs += 1
            future = super().submit(fn, path)
            if self.runs == 2:
                postgres.crash()
                threading.Timer(0.5, postgres.start).start()
            return future

    monkeypatch.chdir(tmp_path)
    url = postgres.create("restarted")
    output = search_in_process(monkeypatch, Restarting(), write_search(tmp_path, SHORT), "--storage", url)
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


def test_a_ray_node_is_removed(tmp_path: Path, undisturbed: Slots, cluster: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """A user's module is in the driver's folder; nodes were started in another."""
    from sb3_aarl.search.execution.ray import RayExecutor

    monkeypatch.chdir(tmp_path)
    Path("of_the_driver.py").touch()
    config = write_search(tmp_path, FIRST + "imports: [of_the_driver]\n")
    search, removed = Search.from_file(config, tmp_path / "runs/small"), False

    def remove(progress: SearchProgress) -> None:
        nonlocal removed
        if not removed and len(list(tmp_path.rglob("output.log"))) == 2:  # each node has one
            cluster.remove_node(next(iter(cluster.worker_nodes)), allow_graceful=False)
            removed = True

    with RayExecutor(cluster.address) as executor:
        search.run(executor, workers=2, on_progress=remove)
    assert removed
    assert slots(tmp_path) == first_on_pendulum(undisturbed)


def test_jobs_of_submitit(tmp_path: Path, undisturbed: Slots) -> None:
    """As processes of this machine instead of Slurm."""
    from sb3_aarl.search.execution.slurm import SlurmExecutor

    for parameters in ({"bogus": 3}, {"timeout_min": "long"}, {"cluster": "slurm"}):  # which is not installed
        with pytest.raises(ValueError, match="submitit: "):
            SlurmExecutor(tmp_path / "slurm", **{"cluster": "local", **parameters})
    search = Search.from_file(write_search(tmp_path, FIRST), tmp_path / "runs/small")
    with SlurmExecutor(tmp_path / "slurm", cluster="local") as executor:
        search.run(executor, workers=2)
        assert slots(tmp_path) == first_on_pendulum(undisturbed)
        queue = Queue(executor)
        queue.add(tmp_path / "long", tiny_run(checkpoints=(50_000, 100_000)))
        queue.update()
        wait_until(lambda: (tmp_path / "long/provenance.json").exists(), None)
    with FileLock(tmp_path / "long" / LOCK, timeout=30):
        assert not is_finished(tmp_path / "long")


def load(folder: Path) -> optuna.Study:
    return optuna.load_study(study_name="small", storage=open_storage(folder / "runs/small", create=False))


def wait_until(condition: Callable[[], bool], process: subprocess.Popen[str] | None, seconds: float = 300) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert process is None or process.poll() is None, process and process.communicate()[0]
        assert time.monotonic() < deadline
        time.sleep(0.1)
