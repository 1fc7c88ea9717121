"""The objective of a search: train one candidate, report its learning curve, return the area under it (AULC)."""

import contextlib
import errno
import hashlib
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import torch as th
from optuna.pruners import BasePruner, HyperbandPruner, MedianPruner, NopPruner
from optuna.study import StudyDirection
from optuna.trial import TrialState
from stable_baselines3.common.utils import get_device

from sb3_aarl.aux_loss import AuxLoss
from sb3_aarl.callbacks import Evaluation
from search.evolution.space import distributions, suggest_aux_loss
from search.execution.storage import study_id
from search.execution.workers import DIED_KEY
from search.training.checkpoint import is_disk_error
from search.training.config import SearchConfig
from search.training.provenance import commit, cpu, versions
from search.training.run import (
    DeviceError,
    EnvironmentLost,
    TrainingError,
    causes,
    device_problem,
    memory_problem,
    train_candidate,
)

# The words of SQLite and PostgreSQL for a disk that cannot be written.
DISK_MESSAGES = (
    "database or disk is full",
    "disk I/O error",
    "attempt to write a readonly database",
    os.strerror(errno.ENOSPC),
)


class CandidateFailed(RuntimeError):
    """A candidate could not be trained; the trial fails with the user attribute ``reason``, the study goes on."""


class DiskError(OSError):
    """The disk is full, or cannot be written; the message says where, and what to do."""


class Objective:
    """
    Trains the candidate that a trial proposes, and returns the mean AULC over the training seeds: to be maximized.

    Each evaluation is reported at its environment steps, and the trial is pruned if its pruner says so. With several
    seeds it is the curve of the first one that is reported: trials are compared like with like, and a pruned one is
    spared its other seeds.

    User attributes of a trial: ``loss`` (notation), ``canonical``, ``environment``, ``commit``, ``versions``, ``device`` (name
    of the GPU or the processor), ``threads``; ``curve`` (a list of [environment steps, mean, standard deviation] over the
    episodes of all seeds) and ``seconds`` of training when it ends; ``seeds_trained`` from the second seed on; ``reason`` when
    it fails, and ``died`` where the process of an environment or a GPU did; ``interrupted`` when Ctrl-C or a full disk
    stopped it.

    ``study.optimize(objective, catch=CandidateFailed)`` goes on after a candidate that failed.

    :param config: The search
    :param folder: Where every candidate has a folder of its own, with its learning curves. Those of another study that
        are there are passed over
    :param on_begin: Called with a trial as soon as it has its loss
    """

    def __init__(
        self, config: SearchConfig, folder: str | Path, on_begin: Callable[[optuna.Trial], None] = lambda trial: None
    ):
        self.config = config
        self.on_begin = on_begin
        self.folder = Path(folder)
        self.commit = commit()
        self._checked: tuple[Any, int] | None = None

    def __call__(self, trial: optuna.Trial) -> float:
        """
        :param trial: Proposes the candidate
        :return: Mean AULC over the seeds
        :raises optuna.TrialPruned: for an invalid candidate, before anything is trained, and for a pruned one
        :raises CandidateFailed: when the training diverges, runs out of memory or its environment breaks
        :raises DeviceError: when this process cannot train any more; another trial goes on from the last checkpoint
        :raises DiskError: when the disk is full; the trial's candidate goes on from its last checkpoint in another trial
        :raises ValueError: when the study is another one, see :func:`check_study`
        """
        study = trial.study
        if self._checked != (study._storage, study._study_id):
            check_study(study, self.config)
            self._checked = (study._storage, study._study_id)
        with end_noted(trial, self.folder):
            loss = suggest_aux_loss(trial, self.config.max_horizon, self.config.operators)
            self.on_begin(trial)
            return self._train(trial, loss, self.config.environment, self.config.seeds, {}, None)

    def train(
        self,
        trial: optuna.Trial,
        aux_loss: AuxLoss | None,
        environment: str,
        seeds: Sequence[int],
        overrides: Mapping[str, Any] | None = None,
        name: str | None = None,
    ) -> float:
        """
        Train a given loss for a trial, for procedures that do not search.

        :param trial: Gets the reports and the user attributes
        :param aux_loss: The loss, None for none
        :param environment: Id of the environment
        :param seeds: Training seeds
        :param overrides: Merged over the hyper-parameters of the configuration
        :param name: Another trial of this name, loss, environment and seeds goes on where a killed one stopped; one at a
            time. None for the trial's place, or its number
        :return: Mean AULC over the seeds
        :raises optuna.TrialPruned: when the pruner says so
        :raises CandidateFailed: as above
        """
        with end_noted(trial, self.folder):
            return self._train(trial, aux_loss, environment, seeds, overrides or {}, name)

    def _train(
        self,
        trial: optuna.Trial,
        aux_loss: AuxLoss | None,
        environment: str,
        seeds: Sequence[int],
        overrides: Mapping[str, Any],
        name: str | None,
    ) -> float:
        config = self.config
        hyperparameters = config.hyperparameters_for(environment, overrides)
        checkpoints = config.checkpoints_for(environment)
        folder = self.folder / _folder_name(trial.study, name or _name(trial), aux_loss, environment, seeds)
        attributes = {
            "loss": "none" if aux_loss is None else str(aux_loss),
            "canonical": "none" if aux_loss is None else str(aux_loss.canonical()),
            "environment": environment,
            "commit": self.commit,
            "versions": versions(),
            "device": device_name(hyperparameters.get("device", "auto")),
            "threads": th.get_num_threads(),
        }
        for key, value in attributes.items():
            trial.set_user_attr(key, value)

        curves: list[list[Evaluation]] = []
        pruned = False

        def report(evaluation: Evaluation) -> bool:
            nonlocal pruned
            try:
                if curves:  # if another worker took this one for dead and failed the trial, the storage says so
                    trial.set_user_attr("seeds_trained", len(curves))
                else:
                    trial.report(evaluation.mean, evaluation.environment_steps)
                    # After the last evaluation nothing is left to spare.
                    pruned = evaluation.environment_steps != checkpoints[-1] and trial.should_prune()
            except Exception:  # of the storage: not the candidate's fault
                _note_interruption(trial)
                raise
            return not pruned

        scores = []
        for seed in seeds:
            run = train_candidate(
                environment,
                aux_loss,
                hyperparameters,
                seed,
                checkpoints,
                config.evaluation_episodes,
                folder / f"seed-{seed}",
                on_evaluation=report,
            )
            curves.append(run.curve)
            scores.append(run.aulc)
            if pruned:
                break
        trial.set_user_attr("curve", mean_curve(curves))
        trial.set_user_attr("seconds", round(sum(curve[-1].seconds for curve in curves), 1))
        if pruned:
            raise optuna.TrialPruned(f"pruned after {curves[0][-1].environment_steps} environment steps")
        return float(np.mean(scores))


@contextlib.contextmanager
def end_noted(trial: optuna.Trial, folder: Path | None = None) -> Iterator[None]:
    """
    Note why a training ended before its time, as the user attribute ``interrupted`` or ``reason``.

    Ctrl-C and a full disk are not the candidate's fault, whenever they come: the sampler gives the same one out again.

    :param trial: The training's trial
    :param folder: Where the training writes
    :raises CandidateFailed: when the training diverges, runs out of memory or its environment breaks
    :raises DeviceError: when this process cannot train any more; another one takes the candidate up
    :raises DiskError: when the disk is full, or cannot be written
    :raises OSError: when something else is wrong with the folder
    """
    try:
        yield
    except KeyboardInterrupt:
        _note_interruption(trial)
        raise
    except Exception as error:
        problem = disk_problem(error, folder)
        if problem is not None:
            _note_interruption(trial)
            raise DiskError(problem) from error
        if not isinstance(error, TrainingError) and (problem := device_problem(error)):
            error = DeviceError(problem)
        told = str(error) if isinstance(error, TrainingError) else None
        reason = told if isinstance(error, DeviceError) else memory_problem(error) or told
        if reason is None:
            if isinstance(error, OSError):  # of the folder, such as one on another machine that went away
                _note_interruption(trial)
            raise
        trial.set_user_attr("reason", reason)
        if isinstance(error, EnvironmentLost | DeviceError):
            trial.set_user_attr(DIED_KEY, True)
        if isinstance(error, DeviceError):
            raise error
        raise CandidateFailed(reason) from error


def _note_interruption(trial: optuna.Trial) -> None:
    # The storage may lie on the same full disk: a trial that stays as it is counts as one of a worker that died.
    with contextlib.suppress(Exception):
        trial.set_user_attr("interrupted", True)


def disk_problem(error: BaseException, folder: Path | None = None) -> str | None:
    """
    One line if a disk that is full or cannot be written is behind an error: where, and what to do. None for other errors.

    :param error: The error, of a training or a storage
    :param folder: Named where the error does not say what file it was
    """
    for cause in causes(error):
        if isinstance(cause, DiskError):
            return str(cause)
        what, file = None, None
        if isinstance(cause, OSError) and is_disk_error(cause):
            what, file = cause.strerror, cause.filename
        elif any(message in str(cause) for message in DISK_MESSAGES):
            what = " ".join(str(cause).split())[:200]
        if what is not None:
            where = file or f"{folder or 'the folder of the search'}, or the storage"
            return f"{where}: {what}. Free or mend the disk; the same command goes on where this one stopped"
    return None


def check_study(study: optuna.Study, config: SearchConfig) -> None:
    """
    Refuse a study that is not a search of the configuration's losses, such as one of the same name for other purposes.

    It reads only: what is refused stays as it is.

    :param study: The study
    :param config: The search
    :raises ValueError: naming what differs
    """
    problem = None
    if study.directions != [StudyDirection.MAXIMIZE]:
        problem = f"its directions are {[direction.name.lower() for direction in study.directions]}, not to maximize one score"
    expected = distributions(config.max_horizon, config.max_horizon, config.operators)
    for trial in study.get_trials(deepcopy=False) if problem is None else ():
        there = trial.distributions
        # What both have comes first: of a longer horizon, not the tokens that it brings.
        for name in sorted(there, key=lambda name: name not in expected):
            if there[name] != expected.get(name):
                wanted = f"here it is {expected[name]}" if name in expected else "there is none of this name here"
                problem = f"trial {trial.number} has the parameter {name!r}, {there[name]}; {wanted}"
                break
        else:
            missing = expected.keys() & {"horizon", "operator", "negatives"} - there.keys()
            if trial.state == TrialState.COMPLETE and missing:
                problem = f"trial {trial.number} has no parameter {min(missing)!r}"
        if problem is not None:
            break
    if problem is not None:
        raise ValueError(
            f"study {study.study_name!r} is not this search: {problem}. Another search needs a file of another name, or "
            "another storage"
        )


def device_name(device: str) -> str:
    """
    What trains: ``GPU: `` and its name, or ``CPU: ``, the processor's name and how many of its cores may be used.

    :param device: As SB3 takes it
    """
    trains_on = get_device(device)
    return f"GPU: {th.cuda.get_device_name(trains_on)}" if trains_on.type == "cuda" else f"CPU: {cpu()}"


def mean_curve(curves: Sequence[Sequence[Evaluation]]) -> list[list[float]]:
    """
    The learning curve over several seeds.

    :param curves: One for each seed, of equal length and with equally many episodes
    :return: [environment steps, mean, standard deviation] over the episodes of all seeds, for every evaluation
    """
    points = []
    for evaluations in zip(*curves, strict=True):
        means, deviations = np.array([(evaluation.mean, evaluation.std) for evaluation in evaluations]).T
        # The variance of all episodes: within the seeds, and between them.
        points.append(
            [evaluations[0].environment_steps, float(means.mean()), float(np.sqrt((deviations**2).mean() + means.var()))]
        )
    return points


def make_pruner(config: SearchConfig) -> BasePruner:
    """
    Optuna's pruner of a configuration.

    :param config: The search
    """
    if config.pruner == "median":
        return MedianPruner()
    if config.pruner == "hyperband":
        return HyperbandPruner(min_resource=config.checkpoints[0], max_resource=config.checkpoints[-1])
    return NopPruner()


def _name(trial: optuna.Trial) -> str:
    """The same for a trial that takes up what another one, killed, had begun."""
    if "stage" in trial.user_attrs:
        return f"stage-{trial.user_attrs['stage']}-place-{trial.user_attrs['place']}"
    # Other samplers may propose a loss twice at the same time. A heartbeat's copy knows whose copy it is.
    system_attrs = trial.study._storage.get_trial_system_attrs(trial._trial_id)
    return f"trial-{system_attrs.get('failed_trial', trial.number)}"


def _folder_name(study: optuna.Study, name: str, aux_loss: AuxLoss | None, environment: str, seeds: Sequence[int]) -> str:
    """Readable, and different wherever anything of it differs."""
    label = re.sub(r"[^a-z0-9]+", "-", name.lower())[:80].strip("-")
    digest = hashlib.sha256(f"{study_id(study)} {name} {aux_loss} {environment} {list(seeds)}".encode()).hexdigest()
    return f"{label}-{digest[:12]}"
