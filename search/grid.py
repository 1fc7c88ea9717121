"""Studies that train a given list of runs instead of searching: losses x environments x seeds, each once."""

from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple

import optuna
from optuna.samplers import RandomSampler
from optuna.trial import FrozenTrial, TrialState

from sb3_aarl.aux_loss import AuxLoss
from search import workers

# A run whose workers died, or that failed, is tried this often.
MAX_TRIES = 3
ENQUEUED_KEY = "enqueued"


class Cell(NamedTuple):
    """
    One training run.

    :param loss: Notation of the auxiliary loss, ``"none"`` for none
    :param environment: Id of the environment
    :param seed: Seed of the training
    """

    loss: str
    environment: str
    seed: int

    @property
    def aux_loss(self) -> AuxLoss | None:
        """The loss as a value."""
        return None if self.loss == "none" else AuxLoss.parse(self.loss)


def enqueue(study: optuna.Study, cells: Sequence[Cell]) -> int:
    """
    Enqueue the runs that the study does not have yet, and those whose worker died or that failed too seldom.

    :param study: The study
    :param cells: All runs
    :return: How many runs are finished already
    """
    trials = study.get_trials(deepcopy=False)
    if workers.fail_dead(study, trials):
        trials = study.get_trials(deepcopy=False)
    there = {cell_of(trial) for trial in trials if trial.state != TrialState.FAIL}
    failures = Counter(cell_of(trial) for trial in trials if trial.state == TrialState.FAIL and "reason" in trial.user_attrs)
    for cell in cells:
        if cell not in there and failures[cell] < MAX_TRIES:
            study.enqueue_trial(cell._asdict(), user_attrs={ENQUEUED_KEY: True})
    return len({cell_of(trial) for trial in trials if trial.state == TrialState.COMPLETE} & set(cells))


def cell_of(trial: FrozenTrial) -> Cell | None:
    """
    The run of a trial, None for one that has none.

    :param trial: A trial, waiting, running or finished
    """
    params = trial.params or trial.system_attrs.get("fixed_params", {})
    return Cell(**params) if set(params) == set(Cell._fields) else None


def suggest_cell(trial: optuna.Trial, cells: Sequence[Cell]) -> Cell:
    """
    The run that a trial was enqueued for.

    :param trial: The trial
    :param cells: All runs of the study
    :raises optuna.TrialPruned: when another worker took the last run meanwhile
    """
    if ENQUEUED_KEY not in trial.user_attrs:
        raise optuna.TrialPruned("no run is left")
    choices: dict[str, list[Any]] = {name: sorted({getattr(cell, name) for cell in cells}) for name in Cell._fields}
    return Cell(**{name: trial.suggest_categorical(name, values) for name, values in choices.items()})


def make_study(storage: optuna.storages.BaseStorage, name: str) -> optuna.Study:
    """
    The study of a list of runs, made if it is not there.

    :param storage: The storage
    :param name: Name of the study
    """
    sampler = RandomSampler(seed=0)  # draws nothing: all parameters are enqueued
    return optuna.create_study(study_name=name, storage=storage, sampler=sampler, direction="maximize", load_if_exists=True)


def waiting(study: optuna.Study) -> bool:
    """
    Whether runs are left that no worker has begun.

    :param study: The study
    """
    return bool(study.get_trials(deepcopy=False, states=(TrialState.WAITING,)))
