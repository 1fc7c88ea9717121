"""Studies that train a given list of runs instead of searching: variants x environments x seeds, each once."""

import itertools
import json
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import optuna
import pandas as pd
from optuna.pruners import NopPruner
from optuna.samplers import RandomSampler
from optuna.trial import FrozenTrial, TrialState

from sb3_aarl.aux_loss import AuxLoss
from search.execution import workers
from search.execution.local import Unfit, WorkerPool, uninterrupted
from search.execution.storage import PATIENCE, open_storage, study_id
from search.results.dashboard import annotate_ended, annotate_study, annotate_trial, artifacts
from search.studies.objective import CandidateFailed, DiskError, Objective, disk_problem
from search.training.config import SearchConfig
from search.training.provenance import provenance
from search.training.run import DeviceError, check_actions

# How often a run is tried that fails, and one whose worker dies: it goes on from its checkpoint.
MAX_TRIES = 3
MAX_DEATHS = 10
POLL_SECONDS = 1.0
# User attribute of a study: what decides the scores, by what is trained.
TRAINING_KEY = "training"
# Settings that change no score.
SCORELESS = ("n_timesteps", "device")


@dataclass(frozen=True)
class Variant:
    """
    What is trained.

    :param aux_loss: The auxiliary loss, None for none
    :param overrides: Merged over the hyper-parameters
    """

    aux_loss: AuxLoss | None
    overrides: Mapping[str, Any] = field(default_factory=dict)


class _Default:
    """In the place of a setting that is not there: null may be another one."""

    def __repr__(self) -> str:
        return "default"


class Cell(NamedTuple):
    """
    One training run.

    :param variant: Name of what is trained
    :param environment: Id of the environment
    :param seed: Seed of the training
    """

    variant: str
    environment: str
    seed: int


def all_cells(variants: Iterable[str], environments: Iterable[str], seeds: Iterable[int]) -> list[Cell]:
    """
    All runs of a comparison, seed by seed, so that a first one is there early.

    :param variants: Names of what is trained
    :param environments: Ids of the environments
    :param seeds: Seeds of the trainings on each
    """
    return [
        Cell(variant, environment, seed) for seed, environment, variant in itertools.product(seeds, environments, variants)
    ]


class Runs(Protocol):
    """A list of runs, as a study; picklable, because worker processes get it."""

    @property
    def name(self) -> str:
        """Name of the study."""
        ...

    @property
    def cells(self) -> list[Cell]:
        """All runs, in the order in which they are begun."""
        ...

    @property
    def trainings(self) -> dict[str, dict[str, Any]]:
        """What decides the scores, as :func:`check_training` takes it."""
        ...

    def train(self, trial: optuna.Trial, cell: Cell, folder: Path) -> float:
        """
        Train one run, or go on with it; the trial gets its learning curve as the user attribute ``curve``.

        :param trial: The run's trial
        :param cell: The run
        :param folder: Folder for checkpoints and curves
        :return: AULC
        :raises CandidateFailed: when the training fails; the trial has a user attribute ``reason`` then
        """
        ...


@dataclass(frozen=True)
class Grid:
    """
    Variants x environments x seeds, as a study in the storage of a search.

    :param name: Name of the study
    :param config: Settings of the trainings
    :param variants: What is trained, by name
    :param environments: Ids of the environments
    :param seeds: Seeds of the trainings on each
    """

    name: str
    config: SearchConfig
    variants: Mapping[str, Variant]
    environments: Sequence[str]
    seeds: Sequence[int]

    @property
    def cells(self) -> list[Cell]:
        return all_cells(self.variants, self.environments, self.seeds)

    @property
    def trainings(self) -> dict[str, dict[str, Any]]:
        """What decides the scores, as :func:`check_training` takes it: that of each environment and each variant."""
        trainings = {environment: training(self.config, environment) for environment in self.environments}
        for name, variant in self.variants.items():
            loss = None if variant.aux_loss is None else str(variant.aux_loss.canonical())
            trainings[name] = {**variant.overrides, "aux_loss": loss}
        return trainings

    def train(self, trial: optuna.Trial, cell: Cell, folder: Path) -> float:
        """Train one run, see :class:`Runs`."""
        variant = self.variants[cell.variant]
        train = Objective(self.config, folder / self.name).train
        return train(trial, variant.aux_loss, cell.environment, [cell.seed], variant.overrides, cell.variant)


def training(config: SearchConfig, environment: str) -> dict[str, Any]:
    """
    What decides the score of a loss and a seed on an environment.

    :param config: The search
    :param environment: Id of the environment
    """
    evaluation = {"checkpoints": config.checkpoints_for(environment), "evaluation_episodes": config.evaluation_episodes}
    return evaluation | config.hyperparameters_for(environment)


def check_training(study: optuna.Study, trainings: Mapping[str, Mapping[str, Any]]) -> None:
    """
    Refuse to go on with a study whose runs were trained in another way: scores could not be compared.

    :param study: The study
    :param trainings: What decides the scores, by the name of what is trained; the study may have others, and get more
    :raises ValueError: naming the first setting that differs
    """
    study_id(study)  # now, before several workers do
    trainings, default = json.loads(json.dumps(trainings)), _Default()
    begun = study.user_attrs.get(TRAINING_KEY, {})
    if not isinstance(begun, dict) or not all(isinstance(settings, dict) for settings in begun.values()):
        raise ValueError(f"study {study.study_name!r} is not of this program: choose another name, or another storage")
    for name, settings in trainings.items():
        before = begun.setdefault(name, settings)
        for key in settings | before:
            old, new = before.get(key, default), settings.get(key, default)
            if old != new and key not in SCORELESS:
                trials = study.get_trials(deepcopy=False)
                is_empty = all(trial.state in (TrialState.FAIL, TrialState.WAITING) for trial in trials)
                raise ValueError(
                    f"study {study.study_name!r} was begun with {key}={old!r}, not {new!r} ({name}): another search needs "
                    "a file of another name, another benchmark a folder of its own"
                    + (". This one has no score yet: delete it if nothing of it is to be kept" if is_empty else "")
                )
    if begun != study.user_attrs.get(TRAINING_KEY):
        study.set_user_attr(TRAINING_KEY, begun)


def run(grid: Runs, folder: Path, where: str, n_workers: int = 1, threads: int | None = None) -> Iterator[tuple[int, int]]:
    """
    Train what the study does not have yet. Yields finished and failed runs about once a second. Runs that keep failing
    are given up, see :func:`given_up`.

    :param grid: The runs
    :param folder: Folder of the search, for checkpoints and curves
    :param where: Storage of the search, as for ``open_storage``
    :param n_workers: Number of processes
    :param threads: Threads of each, None for its share of the cores
    """
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    for environment in dict.fromkeys(cell.environment for cell in grid.cells):
        check_actions(environment)
    storage = open_storage(where)
    study = optuna.create_study(study_name=grid.name, storage=storage, direction="maximize", load_if_exists=True)
    check_training(study, grid.trainings)
    settings = {f"{name}s": ", ".join(dict.fromkeys(str(getattr(cell, name)) for cell in grid.cells)) for name in Cell._fields}
    annotate_study(study, settings | grid.trainings, provenance(), is_search=False)
    _enqueue(study, grid.cells)
    finished, failed = _count(study.get_trials(deepcopy=False), grid.cells)
    yield finished, failed
    while finished < len(grid.cells):
        with WorkerPool(_run_worker, (grid, folder, where), n_workers, threads) as pool:
            busy, ended, before = True, _ended(study.get_trials(deepcopy=False)), -1
            while busy:
                time.sleep(POLL_SECONDS)
                busy = pool.check(progressed=ended > before)
                trials = study.get_trials(deepcopy=False)
                before, ended = ended, _ended(trials)
                finished, failed = _count(trials, grid.cells)
                yield finished, failed
        while not _enqueue(study, grid.cells):
            annotate_ended(study, artifacts(folder))
            running = study.get_trials(deepcopy=False, states=(TrialState.RUNNING, TrialState.WAITING))
            # After that: none of these is overlooked.
            finished, failed = _count(study.get_trials(deepcopy=False), grid.cells)
            yield finished, failed
            if finished == len(grid.cells) or not running:
                return
            time.sleep(POLL_SECONDS)  # the same command runs elsewhere too, and has the last runs


def scores(study: optuna.Study, cells: Sequence[Cell]) -> pd.DataFrame:
    """
    What a grid's study has finished: one row a run with ``variant``, ``environment``, ``seed``, ``score`` (AULC) and
    ``last`` (mean return at the last checkpoint).

    :param study: The study
    :param cells: Runs of the grid; the study may have others, of an earlier version of the configuration
    """
    rows = []
    for trial in study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)):
        cell = _cell_of(trial)
        if cell is not None and cell in cells:
            rows.append({**cell._asdict(), "score": trial.value, "last": trial.user_attrs["curve"][-1][1]})
    columns = [*Cell._fields, "score", "last"]
    return pd.DataFrame(rows, columns=columns).drop_duplicates(list(Cell._fields))


def given_up(study: optuna.Study, cells: Sequence[Cell]) -> dict[Cell, str]:
    """
    The runs that failed and were not finished, with the last reason.

    :param study: The study
    :param cells: Runs of the grid
    """
    trials = study.get_trials(deepcopy=False)
    finished = {_cell_of(trial) for trial in trials if trial.state == TrialState.COMPLETE}
    reasons: dict[Cell, str] = {}
    for trial in trials:
        cell = _cell_of(trial)
        if cell in cells and cell not in finished and cell is not None and trial.state == TrialState.FAIL:
            # A database's heartbeat and an interruption give none.
            reasons[cell] = trial.user_attrs.get("reason") or reasons.get(cell, "its worker died")
    return reasons


def comparable(runs: pd.DataFrame) -> pd.DataFrame:
    """
    The runs of the variants that have each environment and seed which any variant has. The others can't be ranked: what
    they lack may be what is hard.

    :param runs: As :func:`scores` gives them
    """
    n_pairs = len(runs[["environment", "seed"]].drop_duplicates())
    return runs[runs.groupby("variant")["variant"].transform("size") == n_pairs]


def _enqueue(study: optuna.Study, cells: Sequence[Cell]) -> int:
    """Enqueue the runs that nobody has or had, and those that did not fail too often; how many."""
    workers.fail_dead(study, study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)), all_have_names=True)
    trials = study.get_trials(deepcopy=False)
    there = {_cell_of(trial) for trial in trials if trial.state not in (TrialState.FAIL, TrialState.PRUNED)}
    failed = [trial for trial in trials if trial.state == TrialState.FAIL and not trial.user_attrs.get("interrupted")]
    deaths = Counter(_cell_of(trial) for trial in failed if workers.DIED_KEY in trial.user_attrs)
    tries = Counter(_cell_of(trial) for trial in failed if workers.DIED_KEY not in trial.user_attrs)
    missing = [cell for cell in cells if cell not in there and tries[cell] < MAX_TRIES and deaths[cell] < MAX_DEATHS]
    for cell in missing:
        # As attributes: parameters of Optuna could not take a seed more when a grid grows.
        study.enqueue_trial({}, user_attrs=cell._asdict())
    return len(missing)


def _count(trials: Sequence[FrozenTrial], cells: Sequence[Cell]) -> tuple[int, int]:
    finished = {_cell_of(trial) for trial in trials if trial.state == TrialState.COMPLETE}
    return len(finished & set(cells)), sum(trial.state == TrialState.FAIL for trial in trials)


def _ended(trials: Sequence[FrozenTrial]) -> int:
    """How many have ended, other than by a death."""
    return sum(trial.state.is_finished() and not trial.user_attrs.get(workers.DIED_KEY) for trial in trials)


def _cell_of(trial: FrozenTrial | optuna.Trial) -> Cell | None:
    if not set(Cell._fields) <= set(trial.user_attrs):
        return None
    return Cell(*(trial.user_attrs[name] for name in Cell._fields))


def _run_worker(grid: Runs, folder: Path, where: str) -> None:
    """Train runs while any is left that no worker has begun."""
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    # Nothing is sampled, all runs are enqueued; and none is pruned, as Optuna's default would.
    study = optuna.load_study(
        study_name=grid.name, storage=open_storage(where, patience=PATIENCE), sampler=RandomSampler(seed=0), pruner=NopPruner()
    )

    def finished(study: optuna.Study, trial: FrozenTrial) -> None:
        if "curve" in trial.user_attrs or trial.state == TrialState.FAIL:
            with uninterrupted():
                annotate_trial(study, trial, pictures)

    pictures = artifacts(folder)

    def objective(trial: optuna.Trial) -> float:
        cell = _cell_of(trial)
        if cell is None:
            raise optuna.TrialPruned("another worker took the last run")
        if cell not in grid.cells:
            raise optuna.TrialPruned("enqueued by a grid that was interrupted, and not part of this one")
        trial.set_user_attr(workers.WORKER_KEY, workers.identity())
        begun = study.get_trials(deepcopy=False, states=(TrialState.RUNNING, TrialState.COMPLETE))
        if any(_cell_of(other) == cell and other.number < trial.number for other in begun):
            raise optuna.TrialPruned("two programs that began at the same moment enqueued this run; the other one has it")
        annotate_trial(study, trial.number, pictures)
        return grid.train(trial, cell, folder)

    while study.get_trials(deepcopy=False, states=(TrialState.WAITING,)):
        try:
            study.optimize(objective, n_trials=1, catch=(CandidateFailed,), callbacks=[finished], gc_after_trial=True)
        except Exception as error:
            if workers.was_failed(error):
                continue
            if isinstance(error, DeviceError):
                raise Unfit(str(error)) from None
            if problem := disk_problem(error, folder):
                raise DiskError(problem) from None
            raise
