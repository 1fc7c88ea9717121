"""Runs at executors: processes that end with their executor, failures that are retried, mean curves."""

import time
from pathlib import Path
from typing import Any

import psutil
import pytest
from sb3_aarl.search.execution.driver import mean_curve
from sb3_aarl.search.execution.executors import LocalExecutor
from sb3_aarl.search.execution.queue import Queue
from sb3_aarl.search.training.folder import is_finished
from tiny import tiny_run

from sb3_aarl.callbacks import Evaluation

pytestmark = pytest.mark.slow


def children() -> list[int]:
    """Processes of runs that this one has started."""
    return [process.pid for process in psutil.Process().children() if "sb3_aarl.search.training.run" in process.cmdline()]


def wait(queue: Queue) -> None:
    while queue.jobs:
        queue.update()
        time.sleep(0.05)


def test_leaving_the_executor_ends_its_processes(tmp_path: Path) -> None:
    with LocalExecutor(1) as executor:
        queue = Queue(executor)
        queue.add(tmp_path, tiny_run(checkpoints=(50_000, 100_000)))
        queue.update()
        while not children():
            time.sleep(0.05)
    assert not children()
    assert not is_finished(tmp_path)


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
    queue = Queue(executor, retries=2)
    job = queue.add(tmp_path, tiny_run())
    wait(queue)
    assert executor.calls == 3 and job.failure == "ConnectionError: the node is gone"


def test_mean_curve_is_over_all_seeds() -> None:
    curves = [[Evaluation(10, 1.0, 2.0, 5, 0.0), Evaluation(20, 5.0, 2.0, 5, 0.0)], [Evaluation(10, 3.0, 0.0, 5, 0.0)]]
    assert mean_curve(curves) == [[10, 2.0]]
