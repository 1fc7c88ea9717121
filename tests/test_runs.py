"""Runs at executors: real processes, killed and resubmitted; a matrix; submitit's own executor."""

import os
import signal
import sys
import threading
import time
from pathlib import Path
from typing import Any

import psutil
import pytest
from tiny import tiny_run

from sb3_aarl.callbacks import read_curve
from search.execution.matrix import Cell, Matrix, cell_folder, comparable, run_matrix, scores
from search.execution.runs import LocalExecutor, Submission, mean_curve, start_run
from search.training.run import is_finished, prepare_run, read_outcome, train

pytestmark = pytest.mark.slow


def returns(folder: Path) -> list[tuple[int, float]]:
    return [(point.environment_steps, point.mean) for point in read_curve(folder / "curve.csv")]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[int, float]]:
    folder = tmp_path_factory.mktemp("undisturbed")
    prepare_run(folder, tiny_run())
    train(folder)
    return returns(folder)


def children() -> list[int]:
    """Processes of runs that this one has started."""
    return [process.pid for process in psutil.Process().children() if "search.training.run" in process.cmdline()]


def wait_done(submission: Submission) -> None:
    while not submission.done():
        time.sleep(0.05)


def test_a_killed_run_is_resubmitted_and_ends_alike(tmp_path: Path, undisturbed: list[Any]) -> None:
    with LocalExecutor(1) as executor:
        submission = Submission(executor, tmp_path, tiny_run(), retries=5)
        kills = 0
        while not submission.done():
            time.sleep(0.05)
            if kills < 2 and (pids := children()) and (kills == 0 or (tmp_path / "curve.csv").exists()):
                os.kill(pids[0], signal.SIGKILL)
                kills += 1
                time.sleep(0.5)
    assert submission.failure is None and kills == 2
    assert [(point.environment_steps, point.mean) for point in submission.curve] == undisturbed == returns(tmp_path)


@pytest.mark.skipif(sys.version_info < (3, 11), reason="Python has the working directory first in its path")
def test_a_search_py_in_the_working_directory_is_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("search.py").write_text("raise SystemExit('not this one')")
    prepare_run(tmp_path / "run", tiny_run())
    assert start_run(str(tmp_path / "run"))["failure"] is None


def test_leaving_the_executor_ends_its_processes(tmp_path: Path) -> None:
    with LocalExecutor(1) as executor:
        Submission(executor, tmp_path, tiny_run(checkpoints=(50_000, 100_000)), retries=0)
        while not children():
            time.sleep(0.05)
    assert not children()
    assert not is_finished(tmp_path)


def test_a_matrix_trains_what_is_missing_and_names_what_failed(tmp_path: Path, undisturbed: list[Any]) -> None:
    bad = "{s_t} -> {s_t+1}"
    runs = {
        Cell("forward-dynamics", "Pendulum-v1", 0): tiny_run(),
        Cell(bad, "Pendulum-v1", 0): tiny_run(aux_loss=bad, imports=("no_such_module",)),
        Cell("none", "Pendulum-v1", 0): tiny_run(aux_loss=None),
    }
    matrix = Matrix("comparison", tmp_path, runs)
    with LocalExecutor(2) as executor:
        progress = list(run_matrix(matrix, executor, workers=2, retries=0))[-1]
    assert progress[:3] == (3, 2, 1)
    outcomes = {cell: read_outcome(cell_folder(tmp_path, cell)) for cell in runs}
    assert [cell for cell, outcome in outcomes.items() if outcome and outcome.failure] == [Cell(bad, "Pendulum-v1", 0)]
    table = scores(matrix).set_index("variant")
    assert table.loc["forward-dynamics", "last"] == undisturbed[-1][1]
    assert table.loc["forward-dynamics", "score"] == pytest.approx(sum(mean for _, mean in undisturbed) / 2)
    assert set(comparable(scores(matrix))["variant"]) == {"forward-dynamics", "none"}
    # The same command again tries what failed, and repeats nothing else.
    before = (cell_folder(tmp_path, Cell("none", "Pendulum-v1", 0)) / "curve.csv").stat().st_mtime_ns
    mended = Matrix("comparison", tmp_path, {cell: run for cell, run in runs.items() if cell.variant != bad})
    with LocalExecutor(1) as executor:
        assert list(run_matrix(mended, executor))[-1][:3] == (2, 2, 0)
    assert (cell_folder(tmp_path, Cell("none", "Pendulum-v1", 0)) / "curve.csv").stat().st_mtime_ns == before


def test_submitit_is_an_executor(tmp_path: Path, undisturbed: list[Any]) -> None:
    submitit = pytest.importorskip("submitit")
    executor = submitit.LocalExecutor(folder=str(tmp_path / "submitit"))
    executor.update_parameters(timeout_min=5)
    submission = Submission(executor, tmp_path / "run", tiny_run(), retries=0)
    wait_done(submission)
    assert submission.failure is None
    assert returns(tmp_path / "run") == undisturbed


def test_executors_that_fail_are_retried(tmp_path: Path) -> None:
    class Lost:
        def done(self) -> bool:
            return True

        def result(self) -> Any:
            raise ConnectionError("the node is gone")

    class Executor:
        calls = 0

        def submit(self, fn: Any, *args: Any) -> Lost:
            self.calls += 1
            return Lost()

    executor = Executor()
    submission = Submission(executor, tmp_path, tiny_run(), retries=2)
    wait_done(submission)
    assert executor.calls == 3 and submission.failure == "ConnectionError: the node is gone"


def test_mean_curve_is_over_all_episodes() -> None:
    from sb3_aarl.callbacks import Evaluation

    curves = [[Evaluation(10, 1.0, 2.0, 5, 0.0)], [Evaluation(10, 3.0, 0.0, 5, 0.0)]]
    episodes = [-1.0, 3.0, 3.0, 3.0]  # two episodes of each have these means and deviations
    assert mean_curve(curves)[0] == [10, 2.0, pytest.approx((sum((x - 2) ** 2 for x in episodes) / 4) ** 0.5)]
    assert threading.active_count() >= 1
