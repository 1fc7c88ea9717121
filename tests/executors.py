"""Executors that start no process: runs with the scores that a test wants, and runs that are trained in this one."""

from concurrent.futures import Future
from pathlib import Path
from typing import Any

from sb3_aarl.search.execution.executors import LocalExecutor
from sb3_aarl.search.training.folder import read_run
from sb3_aarl.search.training.run import Run, train

from sb3_aarl.callbacks import Evaluation, write_curve


class InProcess:
    """Trains in this process, one run after the other."""

    def __enter__(self) -> "InProcess":
        return self

    def __exit__(self, *exception: object) -> None:
        pass

    def submit(self, fn: Any, path: str) -> "Future[Any]":
        future: Future[Any] = Future()
        future.set_result(self.outcome(Path(path)))
        return future

    def outcome(self, folder: Path) -> dict[str, Any]:
        return {"curve": [list(point) for point in train(folder)], "failure": None, "retry": False}


class OneProcess(LocalExecutor):
    """Trains the first run in a process, as on this machine, and the others in this one."""

    n_runs = 0

    def submit(self, fn: Any, /, *args: Any) -> "Future[Any]":
        self.n_runs += 1
        return super().submit(fn, *args) if self.n_runs == 1 else InProcess().submit(fn, *args)


class Planted(InProcess):
    """Runs that end at once: with a score for each loss, or a failure."""

    def __init__(self) -> None:
        self.arguments: tuple[Any, ...] = ()
        self.scores: dict[str | None, float] = {}
        self.fails: Any = lambda run: False
        self.runs: list[Run] = []

    def __call__(self, *arguments: Any) -> "Planted":
        self.arguments = arguments
        return self

    def outcome(self, folder: Path) -> dict[str, Any]:
        run = read_run(folder)
        self.runs.append(run)
        if self.fails(run):
            return {"curve": [], "failure": "it burst", "retry": False}
        score = self.scores.get(run.aux_loss, 1.0) + run.seed
        curve = [
            Evaluation(steps, score + side, 0.5, 1, 1.0) for steps, side in zip(run.checkpoints, (-1.0, 1.0), strict=True)
        ]
        write_curve(folder / "curve.csv", curve)
        return {"curve": [list(point) for point in curve], "failure": None, "retry": False}
