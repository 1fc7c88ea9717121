"""The evolution (paper, sections 2.2 and 3): a study that worker processes of one machine or many fill stage by stage."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import optuna
from optuna.trial import FrozenTrial, TrialState

from search import workers
from search.config import SearchConfig
from search.dashboard import annotate_study, annotate_trial, update_plots
from search.objective import CandidateFailed, Objective
from search.pool import WorkerPool
from search.provenance import provenance
from search.sampler import AuxLossSampler, SearchComplete, StageProgress
from search.storage import open_storage

# Candidates that may fail one after the other in one worker: then it is not the losses that are at fault.
MAX_FAILURES = 10
# Seconds between two looks at the storage, by a worker without a place and by the live table.
POLL_SECONDS = 1.0


class Progress(NamedTuple):
    """
    :param stages: How far each stage is
    :param best: Best score so far, None before the first
    :param best_loss: Notation of its loss
    :param seconds_to_go: Estimate, None before the first candidate is done
    """

    stages: list[StageProgress]
    best: float | None
    best_loss: str | None
    seconds_to_go: float | None


def make_sampler(config: SearchConfig, stages: int | None = None, worker: str | None = None) -> AuxLossSampler:
    """
    The sampler of a search.

    :param config: Settings of the search
    :param stages: Number of stages instead of the config's
    :param worker: As in AuxLossSampler
    """
    return AuxLossSampler(
        population_size=config.population_size,
        n_random=config.n_random,
        n_prior=config.n_prior,
        parents=config.parents,
        replacement=config.replacement,
        crossover=config.crossover,
        horizon_change=config.horizon_change,
        random=config.random,
        max_horizon=config.max_horizon,
        operators=config.operators,
        allow_duplicates=config.allow_duplicates,
        seed=config.seed,
        screening=config.screening,
        n_stages=config.stages if stages is None else stages,
        worker=worker,
    )


def make_pruner(name: str, config: SearchConfig) -> optuna.pruners.BasePruner:
    """
    :param name: ``none``, ``median`` or ``hyperband``
    :param config: Settings of the search; pruners need its checkpoints
    """
    if name == "median":
        return optuna.pruners.MedianPruner(n_startup_trials=config.n_random + config.n_prior)
    if name == "hyperband":
        return optuna.pruners.HyperbandPruner(min_resource=config.checkpoints[0], max_resource=config.checkpoints[-1])
    return optuna.pruners.NopPruner()


def run_worker(config: SearchConfig, folder: Path, where: str, stages: int | None, pruner: str | None) -> None:
    """
    Train candidates until the search is complete; any number of processes may do so.

    :param config: Settings of the search
    :param folder: Folder of the search, for checkpoints and curves
    :param where: Its storage, as for ``open_storage``
    :param stages: Number of stages instead of the config's
    :param pruner: Pruner instead of the config's
    """
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    sampler = make_sampler(config, stages, workers.identity())
    study = optuna.load_study(
        study_name=config.name,
        storage=open_storage(where),
        sampler=sampler,
        pruner=make_pruner(pruner or config.pruner, config),
    )
    objective = Objective(config, folder)
    failures = 0

    def finished(study: optuna.Study, trial: FrozenTrial) -> None:
        nonlocal failures
        annotate_trial(study, trial, objective.artifacts)
        failures = failures + 1 if trial.state == TrialState.FAIL else 0
        if failures == MAX_FAILURES:
            reason = trial.user_attrs.get("reason")
            raise ValueError(f"{failures} candidates failed one after the other, the last one: {reason}")

    while True:
        workers.fail_dead(study, study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)))
        try:
            # Without this look a worker too many would leave a trial behind that never got a place.
            if sampler.has_place(study):
                study.optimize(objective, n_trials=1, catch=(CandidateFailed,), callbacks=[finished])
            else:
                time.sleep(POLL_SECONDS)
        except SearchComplete:
            return


def search(
    config: SearchConfig, folder: Path, where: str, n_workers: int = 1, stages: int | None = None, pruner: str | None = None
) -> Iterator[Progress]:
    """
    Run a search, or go on with it: the state is in the storage.

    Yields about once a second; stopping the iteration (or Ctrl-C) interrupts the workers.

    :param config: Settings of the search
    :param folder: Folder of the search
    :param where: Its storage, as for ``open_storage``
    :param n_workers: Number of processes on this machine
    :param stages: Number of stages instead of the config's
    :param pruner: Pruner instead of the config's
    """
    sampler = make_sampler(config, stages)
    study = optuna.create_study(
        study_name=config.name, storage=open_storage(where), sampler=sampler, direction="maximize", load_if_exists=True
    )
    progress = look(study, sampler, n_workers)  # refuses a study that was begun with other settings
    annotate_study(study, config.settings(), provenance())
    yield progress
    with WorkerPool(run_worker, (config, folder, where, stages, pruner), n_workers) as pool:
        finished = -1
        while True:
            now = sum(stage.filled + stage.failed for stage in progress.stages)
            if now != finished:
                update_plots(study, config.baselines)
            busy = pool.check(progressed=now != finished)
            finished = now
            if not busy:
                break
            time.sleep(POLL_SECONDS)
            progress = look(study, sampler, n_workers)
            yield progress
    update_plots(study, config.baselines)
    yield look(study, sampler, n_workers)


def look(study: optuna.Study, sampler: AuxLossSampler, n_workers: int) -> Progress:
    """
    How far a search is.

    :param study: The study
    :param sampler: Its sampler
    :param n_workers: Workers that share what is left
    """
    stages = sampler.progress(study)
    complete = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    best = max(complete, key=lambda trial: trial.value or 0.0, default=None)
    durations = [trial.duration.total_seconds() for trial in complete if trial.duration is not None]
    left = sum(stage.places - stage.filled for stage in stages)
    return Progress(
        stages,
        None if best is None else best.value,
        None if best is None else best.user_attrs.get("loss"),
        sum(durations) / len(durations) * left / n_workers if durations else None,
    )
