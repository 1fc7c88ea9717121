"""A matrix of runs: variants x environments x seeds, each in its own folder. A run with a complete curve is finished."""

import hashlib
import json
import math
import re
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
from sb3_aarl.search.execution.executors import Executor
from sb3_aarl.search.execution.queue import Queue, seconds_to_go
from sb3_aarl.search.training.folder import FAILED, Run, is_finished, partial_curve, prepare_run, read_outcome
from sb3_aarl.search.training.provenance import ABOUT, read_about, write_about
from sb3_aarl.search.training.setup import check_run

from sb3_aarl.callbacks import aulc
from sb3_aarl.envs import PREFIX
from sb3_aarl.files import replace_text

POLL_SECONDS = 0.5


class Cell(NamedTuple):
    """One run of a matrix: the name of what is trained, the id of its environment, and its seed."""

    variant: str
    environment: str
    seed: int


@dataclass(frozen=True)
class Matrix:
    """
    Runs by variant, environment and seed, in the order in which they are started; ``abouts`` is what ``provenance.json`` says
    of a run beside its own values.
    """

    name: str
    folder: Path
    runs: Mapping[Cell, Run]
    abouts: Mapping[Cell, Mapping[str, Any]] = field(default_factory=dict)


class MatrixProgress(NamedTuple):
    """How many runs there are, are finished, were given up; estimated seconds until all are over, None while not known."""

    total: int
    finished: int
    failed: int
    seconds_to_go: float | None


def task_name(environment: str) -> str:
    """The short form of a DeepMind Control task's id; other ids as they are."""
    return environment.removeprefix(PREFIX).removesuffix("-v0") if environment.startswith(PREFIX) else environment


def task_folder(environment: str) -> str:
    """The name of an environment's folder."""
    return task_name(environment).replace("/", "_")


def scaled(score: float, returns: Sequence[float] | None) -> float:
    """A return or AULC on the scale on which the first of two returns is 0 and the second one 1; without them as it is."""
    return score if returns is None else (score - returns[0]) / (returns[1] - returns[0])


def cell_folder(folder: Path, cell: Cell) -> Path:
    """Where a run is: ``FOLDER/VARIANT/TASK/seed-N``."""
    variant = cell.variant
    if not re.fullmatch(r"\w[\w.-]{,79}", variant):  # such as a loss's notation
        slug = re.sub(r"[^a-z0-9]+", "-", variant.lower()).strip("-")[:60]
        variant = f"{slug}-{hashlib.sha256(variant.encode()).hexdigest()[:8]}"
    return folder / variant / task_folder(cell.environment) / f"seed-{cell.seed}"


def check_matrix(matrix: Matrix, source: str = "") -> None:
    """
    Try out one of the runs that have the same hyper-parameters and checkpoints, unless it is finished: on each environment
    that may be of the user's own, and on one task of DeepMind Control.

    :param source: The file of their settings, for runs whose ``abouts`` name none
    :raises ConfigError: when a run cannot be trained
    """
    checked = set()
    for cell, run in matrix.runs.items():
        environment = PREFIX if run.environment.startswith(PREFIX) else run.environment
        settings = {**run.hyperparameters, "n_timesteps": None}
        kind = environment, run.checkpoints, run.aux_loss is None, json.dumps(settings)
        if kind not in checked and not is_finished(cell_folder(matrix.folder, cell)):
            check_run(run, matrix.abouts.get(cell, {}).get("file", source))
            checked.add(kind)


def run_matrix(matrix: Matrix, executor: Executor, workers: int = 1, retries: int = 3) -> Iterator[MatrixProgress]:
    """
    Train the runs that are not finished, ``workers`` at the same time.

    :raises ValueError: before anything is trained, when a folder has a run with other settings
    """
    folders = {cell: cell_folder(matrix.folder, cell) for cell in matrix.runs}
    for cell, path in folders.items():
        prepare_run(path, matrix.runs[cell])
        about = {**cell._asdict(), **matrix.abouts.get(cell, {})}
        if (before := read_about(path)) != before | about:
            write_about(path, before | about)
    queue = Queue(executor, workers, retries)
    jobs = {cell: queue.add(path, matrix.runs[cell]) for cell, path in folders.items() if not is_finished(path)}
    seconds = [partial_curve(path)[-1].seconds for cell, path in folders.items() if cell not in jobs]
    failed: set[Cell] = set()
    while True:
        running = [cell for cell, job in jobs.items() if job.future is not None]
        queue.update()
        for cell in running:
            job = jobs[cell]
            if job.is_over and is_finished(job.folder):
                seconds.append(partial_curve(job.folder)[-1].seconds)
            elif job.failure is not None:
                failed.add(cell)
                if not (job.folder / FAILED).exists():  # its process was killed
                    replace_text(job.folder / FAILED, json.dumps({"reason": job.failure, "retry": True}) + "\n")
        n_finished = len(matrix.runs) - len(queue.jobs) - len(failed)
        to_go = seconds_to_go(seconds, len(queue.jobs), min(workers, len(queue.jobs)))
        yield MatrixProgress(len(matrix.runs), n_finished, len(failed), to_go)
        if not queue.jobs:
            return
        time.sleep(POLL_SECONDS)


def scores(matrix: Matrix) -> pd.DataFrame:
    """
    The runs that are over: one row each with ``variant``, ``environment``, ``seed``, ``score``: the AULC, on the scale of
    ``returns`` where ``provenance.json`` has them; NaN where a run failed.
    """
    return _scores((cell, cell_folder(matrix.folder, cell)) for cell in matrix.runs)


def stored_scores(folder: Path) -> pd.DataFrame:
    """The same of all runs in the folder of a matrix, read without its configuration; none if the folder is not there."""
    abouts = {file.parent: read_about(file.parent) for file in sorted(folder.glob(f"*/*/*/{ABOUT}"))}
    return _scores((Cell(*(about[name] for name in Cell._fields)), path) for path, about in abouts.items())


def _scores(runs: Iterable[tuple[Cell, Path]]) -> pd.DataFrame:
    rows: list[tuple[Any, ...]] = []
    for cell, path in runs:
        outcome = read_outcome(path) if path.exists() else None
        if outcome is not None and outcome.failure is None:
            rows.append((*cell, scaled(aulc(outcome.curve), read_about(path).get("returns"))))
        elif outcome is not None:
            rows.append((*cell, math.nan))
    return pd.DataFrame(rows, columns=[*Cell._fields, "score"])
