"""Workers of a search on a cheap objective, as processes of their own. Imports little: every process pays for it."""

import os
import signal
import zlib
from pathlib import Path
from typing import Any

import optuna
from optuna.storages import BaseStorage, JournalStorage, RDBStorage
from optuna.storages.journal import JournalFileBackend

from sb3_aarl.aux_loss import AuxLoss
from search.evolution.sampler import AuxLossSampler, SearchComplete
from search.evolution.space import suggest_aux_loss

SETTINGS: dict[str, Any] = {"population_size": 12, "n_random": 8, "n_prior": 4, "max_horizon": 2, "n_stages": 3}


class DivergedError(RuntimeError):
    """A training that failed by itself."""


def open_storage(kind: str, folder: Path) -> BaseStorage:
    """A storage that several processes may use."""
    if kind == "journal":
        return JournalStorage(JournalFileBackend(str(folder / "journal.log")))
    # Without a longer timeout than SQLite's 5 s, eight writers do get "database is locked" now and then.
    return RDBStorage(f"sqlite:///{folder / 'study.db'}", engine_kwargs={"connect_args": {"timeout": 60}})


def score(loss: AuxLoss) -> float:
    """A fixed score, many tokens in the target being good, with ties."""
    return 2.0 * sum(loss.target) - sum(loss.source) + zlib.crc32(str(loss).encode()) % 4


def diverges(loss: AuxLoss) -> bool:
    """Whether training this loss fails: one in eight."""
    return zlib.crc32(str(loss).encode()) % 8 == 5


def work(
    start: Any,
    kind: str,
    folder: Path,
    settings: dict[str, Any],
    seed: int | None,
    may_fail: bool = False,
    kill: tuple[str, int] | None = None,
) -> None:
    """
    Work on the study of the folder until the search is complete.

    :param start: Barrier of all workers
    :param kill: Where this process kills itself, and the number of the trial then: ``asking`` (the trial has no place
        yet), ``placed`` (the place is taken, nothing else known) or ``training``
    """
    optuna.logging.set_verbosity(optuna.logging.ERROR)

    def die(where: str, trial: Any) -> None:
        if kill == (where, trial.number):
            os.kill(os.getpid(), signal.SIGKILL)

    class Sampler(AuxLossSampler):
        def _find_place(self, study: Any, trial: Any, wait: Any) -> None:
            die("asking", trial)
            super()._find_place(study, trial, wait)
            die("placed", trial)

    def objective(trial: optuna.Trial) -> float:
        loss = suggest_aux_loss(trial, settings["max_horizon"])
        die("training", trial)
        if may_fail and diverges(loss):
            raise DivergedError(str(loss))
        return score(loss)

    sampler = Sampler(**settings, seed=seed)
    study = optuna.load_study(study_name="study", storage=open_storage(kind, folder), sampler=sampler)
    start.wait()
    try:
        study.optimize(objective, catch=(DivergedError,))
    except SearchComplete:
        return
