"""The paper's benchmark: variants (files of hyper-parameters) x tasks x seeds, every run in a folder of its own."""

import itertools
import re
import reprlib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import optuna
import pandas as pd
import torch as th

from sb3_aarl import catalog
from sb3_aarl.callbacks import read_curve
from sb3_aarl.envs import PREFIX
from search.execution.matrix import SCORELESS, Cell, all_cells, check_training
from search.execution.storage import open_storage
from search.studies.objective import end_noted, mean_curve
from search.training.config import ConfigError, action_repeat, load_hyperparameters, named_environments, resolve_env_id
from search.training.provenance import ABOUT, provenance, read_about, write_about
from search.training.run import check_actions, train_candidate

# Environment steps at which the paper compares (tables 3, 4 and 6).
CHECKPOINTS = (100_000, 500_000, 1_000_000)
UNITS = {"": 1, "k": 1_000, "m": 1_000_000}


@dataclass(frozen=True)
class Benchmark:
    """
    Variants x environments x seeds, as ``grid.run`` trains them.

    :param files: Files of hyper-parameters by variant
    :param hyperparameters: What they say, by variant and environment; each has an ``aux_loss``
    :param checkpoints: Environment steps by environment, ascending: what is compared; the last one ends the training
    :param seeds: Seeds of the trainings
    :param every: Environment steps after which it is also evaluated, None for at the checkpoints only
    :param evaluation_episodes: Episodes of each evaluation
    :param name: Of the study that the runs are shared out in
    """

    files: Mapping[str, str]
    hyperparameters: Mapping[str, Mapping[str, Mapping[str, Any]]]
    checkpoints: Mapping[str, Sequence[int]]
    seeds: Sequence[int]
    every: int | None = None
    evaluation_episodes: int = 10
    name: str = "benchmark"

    @property
    def cells(self) -> list[Cell]:
        return all_cells(self.files, self.checkpoints, self.seeds)

    @property
    def trainings(self) -> dict[str, dict[str, Any]]:
        """What decides the scores, as ``grid.check_training`` takes it."""
        return {
            f"{variant} on {environment}": {
                "evaluations": self.evaluations(environment),
                "evaluation_episodes": self.evaluation_episodes,
                **self.hyperparameters[variant][environment],
            }
            for variant, environment in itertools.product(self.files, self.checkpoints)
        }

    def evaluations(self, environment: str) -> list[int]:
        """
        The environment steps of all evaluations.

        :param environment: Id of the environment
        """
        checkpoints = self.checkpoints[environment]
        between = range(self.every, checkpoints[-1], self.every) if self.every else ()
        return sorted({*checkpoints, *between})

    def about(self, cell: Cell) -> dict[str, Any]:
        """
        What is needed to repeat a run, in plain values; where and when it was trained comes with the training.

        :param cell: The run
        """
        settings = self.hyperparameters[cell.variant][cell.environment]
        return {
            **cell._asdict(),
            "checkpoints": list(self.checkpoints[cell.environment]),
            "evaluations": self.evaluations(cell.environment),
            "evaluation_episodes": self.evaluation_episodes,
            "file": self.files[cell.variant],
            "hyperparameters": dict(settings),
            "sessions": [],
        }

    def train(self, trial: optuna.Trial, cell: Cell, folder: Path) -> float:
        """
        Train one run, or go on with it: ``curve.csv`` and ``provenance.json`` in its folder.

        :param trial: Gets the learning curve as the user attribute ``curve``, or the ``reason`` why it failed
        :param cell: The run
        :param folder: Folder of the benchmark
        :return: AULC
        :raises CandidateFailed: when the training diverges, runs out of memory or its environment breaks
        """
        settings = dict(self.hyperparameters[cell.variant][cell.environment])
        loss = settings.pop("aux_loss")
        path = run_folder(folder, cell)
        about = self.about(cell)
        # A run that was killed and goes on has several.
        session = {**provenance(), "threads": th.get_num_threads()}
        about["sessions"] = [*read_about(path).get("sessions", ()), session]
        write_about(path, about)
        with end_noted(trial, path):
            run = train_candidate(
                cell.environment,
                loss if loss in (None, "auto") else catalog.resolve(loss),
                settings,
                cell.seed,
                about["evaluations"],
                self.evaluation_episodes,
                path,
            )
        trial.set_user_attr("curve", mean_curve([run.curve]))
        session["aux_loss"] = run.aux_loss
        write_about(path, {**about, "seconds": run.curve[-1].seconds})
        return run.aulc

    def prepare(self, folder: Path) -> None:
        """
        Leave in each run's folder what is asked for: a table can say what is missing. Runs that are there and were evaluated
        at the same steps get the checkpoints of now.

        :param folder: Folder of the benchmark
        :raises ValueError: when runs that are there were trained in another way
        """
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        study = optuna.create_study(
            study_name=self.name, storage=open_storage(folder), direction="maximize", load_if_exists=True
        )
        check_training(study, self.trainings)
        for cell in self.cells:
            path = run_folder(folder, cell)
            if not (path / ABOUT).exists():
                write_about(path, self.about(cell))
        for path, about in read_abouts(folder)[0].items():
            environment = about["environment"]
            of_now = list(self.checkpoints.get(environment, ()))
            # Written only where it differs: a worker of another program may be adding to it.
            if of_now not in ([], about.get("checkpoints")) and about.get("evaluations") == self.evaluations(environment):
                write_about(path, {**read_about(path), "checkpoints": of_now})


def load_benchmark(
    files: Sequence[Path],
    environments: Sequence[str] = (),
    seeds: Sequence[int] = range(10),
    checkpoints: Sequence[int] = (),
    every: int | None = None,
    evaluation_episodes: int = 10,
) -> Benchmark:
    """
    Read the variants of a benchmark, and check all that can be checked without training.

    :param files: Files of hyper-parameters, as ``load_hyperparameters`` reads them; the variants have their names
    :param environments: Ids or short forms; none for those that all files name
    :param seeds: Seeds of the trainings on each
    :param checkpoints: Environment steps of the comparison, ascending; none for those of 100k, 500k and 1000k that lie in
        every file's ``n_timesteps``
    :param every: Environment steps after which it is also evaluated
    :param evaluation_episodes: Episodes of each evaluation
    :raises ValueError: naming what is wrong
    """
    for stem, count in Counter(path.stem for path in files).items():
        if count > 1:
            raise ConfigError(f"two files are called {stem}: a variant has the name of its file")
    if not seeds or len(set(seeds)) < len(seeds) or min(seeds) < 0 or max(seeds) >= 2**32:
        raise ConfigError(f"seeds must be different numbers from 0 to 2**32 - 1, not {reprlib.repr(list(seeds))}")
    if evaluation_episodes < 1:
        raise ConfigError(f"episodes must be at least 1, not {evaluation_episodes}")
    if every is not None and every < 1:
        raise ConfigError(f"every must be at least 1, not {every}")
    ids = [resolve_env_id(name) for name in environments] or _common_environments(files)
    ids = list(dict.fromkeys(ids))
    for name in ids:
        check_actions(name)
    # SACAux's default, written out: a file that says nothing is not one that says none.
    hyperparameters = {
        path.stem: {name: {"aux_loss": "auto", **load_hyperparameters(path, name)} for name in ids} for path in files
    }
    of_environment = {name: _checkpoints(name, hyperparameters, checkpoints) for name in ids}
    paths = {path.stem: str(path) for path in files}
    benchmark = Benchmark(paths, hyperparameters, of_environment, seeds, every, evaluation_episodes)
    for (variant, settings), name in itertools.product(hyperparameters.items(), ids):
        repeat = action_repeat(settings[name])
        between = [step for step in benchmark.evaluations(name) if step % repeat]
        if between:
            raise ConfigError(
                f"{variant}: evaluations on {name} must be at multiples of its action repeat {repeat}, not {between[0]}"
            )
    return benchmark


def run_folder(folder: Path, cell: Cell) -> Path:
    """
    Where a run keeps what it makes: ``FOLDER/VARIANT/TASK/seed-N``.

    :param folder: Folder of the benchmark
    :param cell: The run
    """
    return folder / cell.variant / task_name(cell.environment).replace("/", "_") / f"seed-{cell.seed}"


def task_name(environment: str) -> str:
    """
    The short form of a DeepMind Control task's id; other ids as they are.

    :param environment: Id of the environment
    """
    return environment.removeprefix(PREFIX).removesuffix("-v0") if environment.startswith(PREFIX) else environment


def read_abouts(folder: Path) -> tuple[dict[Path, dict[str, Any]], list[Path]]:
    """
    What stands beside the curves of a benchmark's runs.

    :param folder: Folder of a benchmark; runs that were copied there from another machine count too
    :return: What does, by the runs' folders, and the folders where it cannot be read
    :raises ValueError: naming two folders that have the same run, or runs of a variant on an environment that were trained
        in different ways
    """
    abouts: dict[Path, dict[str, Any]] = {}
    unreadable: list[Path] = []
    of_cell: dict[Cell, Path] = {}
    trained: dict[tuple[str, str], Path] = {}
    for path in sorted(file.parent for file in folder.glob(f"*/*/*/{ABOUT}")):
        about = read_about(path)
        if not {*Cell._fields, "checkpoints", "sessions"} <= about.keys():
            unreadable.append(path)
            continue
        abouts[path] = about
        cell = Cell(*(about[name] for name in Cell._fields))
        other = of_cell.setdefault(cell, path)
        if other != path:
            raise ValueError(f"{other} and {path} have the same run: {cell.variant} on {cell.environment}, seed {cell.seed}")
        other = trained.setdefault((cell.variant, cell.environment), path)
        old, new = _training(abouts[other]), _training(about)
        for key in old | new:
            if old.get(key) != new.get(key):
                raise ValueError(f"{other} and {path} cannot be compared: {key}={old.get(key)!r} and {new.get(key)!r}")
    return abouts, unreadable


def read_curves(folder: Path) -> pd.DataFrame:
    """
    The learning curves of a benchmark's runs, as ``plots.learning_curves_plot`` takes them: one row an evaluation with
    ``variant``, ``env`` (short form), ``seed``, ``environment_steps``, ``mean`` and ``std`` (of the episodes' returns). Runs
    that have no evaluation yet are passed over.

    :param folder: Folder of a benchmark
    :raises ValueError: when no run has a learning curve, or naming one that cannot be read
    """
    rows = []
    for path, about in read_abouts(folder)[0].items():
        curve = path / "curve.csv"
        if curve.exists():
            try:
                run = (about["variant"], task_name(about["environment"]), about["seed"])
                rows += [(*run, point.environment_steps, point.mean, point.std) for point in read_curve(curve)]
            except (ValueError, KeyError, TypeError) as error:
                raise ValueError(f"{path} is not what a benchmark leaves: {type(error).__name__}: {error}") from None
    if not rows:
        raise ValueError(f"{folder} has no learning curves of a benchmark")
    return pd.DataFrame(rows, columns=["variant", "env", "seed", "environment_steps", "mean", "std"])


def note_failures(folder: Path, failures: Mapping[Cell, str]) -> None:
    """
    Leave in the folders of runs that failed why they did.

    :param folder: Folder of the benchmark
    :param failures: As ``grid.given_up`` gives them
    """
    for cell, reason in failures.items():
        path = run_folder(folder, cell)
        write_about(path, {**read_about(path), "failed": reason})


def parse_steps(text: str) -> tuple[int, ...]:
    """
    Read environment steps.

    :param text: Such as ``100k,500k,1M`` or ``20000``
    :raises ValueError: naming what is no number of steps
    """
    steps = []
    for part in text.split(","):
        match = re.fullmatch(r"(\d+)([km]?)", part.strip().lower())
        if match is None:
            raise ValueError(f"environment steps are written like 100k, 1M or 20000, not {part.strip()!r}")
        steps.append(int(match[1]) * UNITS[match[2]])
    return tuple(steps)


def parse_seeds(text: str) -> tuple[int, ...]:
    """
    Read seeds.

    :param text: Such as ``0-9`` or ``0,3,5-7``
    :raises ValueError: naming what is neither a number nor a range
    """
    seeds: list[int] = []
    for part in text.split(","):
        match = re.fullmatch(r"(\d+)(?:-(\d+))?", part.strip())
        if match is None or int(match[2] or match[1]) < int(match[1]):
            raise ValueError(f"seeds are written like 0-9 or 0,3,5, not {part.strip()!r}")
        seeds += range(int(match[1]), int(match[2] or match[1]) + 1)
    return tuple(seeds)


def _common_environments(files: Iterable[Path]) -> list[str]:
    """The environments that all files name, in the order of the first."""
    first, *others = [named_environments(path) for path in files]
    common = [name for name in first if all(name in names for names in others)]
    if not common:
        raise ConfigError("the files have no entry of one environment in common: name environments")
    return [resolve_env_id(name) for name in common]


def _checkpoints(
    environment: str, hyperparameters: Mapping[str, Mapping[str, Mapping[str, Any]]], asked_for: Sequence[int]
) -> tuple[int, ...]:
    """What is compared on an environment."""
    if asked_for:
        if sorted(set(asked_for)) != list(asked_for) or asked_for[0] < 1:
            raise ConfigError(f"checkpoints must be positive environment steps in ascending order, not {list(asked_for)}")
        return tuple(asked_for)
    of_environment = [settings[environment] for settings in hyperparameters.values()]
    budgets = [s["n_timesteps"] * action_repeat(s) for s in of_environment if "n_timesteps" in s]
    budget = min(budgets, default=CHECKPOINTS[-1])
    if budget < CHECKPOINTS[0]:
        raise ConfigError(f"n_timesteps ends the training on {environment} at {budget} environment steps: name checkpoints")
    return tuple(step for step in CHECKPOINTS if step <= budget)


def _training(about: Mapping[str, Any]) -> dict[str, Any]:
    """What decides a run's scores."""
    settings = {name: about.get(name) for name in ("evaluation_episodes", "program")} | about.get("hyperparameters", {})
    return {key: value for key, value in settings.items() if key not in SCORELESS}
