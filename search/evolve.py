"""The evolution (paper, sections 2.2 and 3): a study that worker processes of one machine or many fill stage by stage."""

import logging
import time
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any, NamedTuple

import optuna
from optuna.artifacts import FileSystemArtifactStore
from optuna.exceptions import UpdateFinishedTrialError
from optuna.trial import FrozenTrial, TrialState

from search import grid, workers
from search.config import SearchConfig
from search.dashboard import annotate_study, annotate_trial, update_plots
from search.objective import CandidateFailed, Objective, make_pruner
from search.pool import WorkerPool, uninterrupted
from search.provenance import provenance
from search.sampler import AuxLossSampler, SearchComplete, StageProgress
from search.storage import open_storage
from search.trials import loss_of, ranked

logger = logging.getLogger(__name__)

# Candidates that may fail one after the other in one worker: then it is not the losses that are at fault.
MAX_FAILURES = 10
# Seconds between two looks at the storage, by a worker without a place and by the live table.
POLL_SECONDS = 1.0
# Seconds between two drawings of the evolution: each stays in the storage, a hundred kilobytes for a whole search.
PLOT_SECONDS = 300.0
ARTIFACTS = "artifacts"  # folder of the pictures in notes


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


def settings(config: SearchConfig) -> dict[str, Any]:
    """What a note or a report says of the settings: the hyper-parameters written out, in plain values."""
    hidden = ("path", "overrides", "hyperparameters", "cross_validation", "operator_selection", "baselines")
    shown = {item.name: getattr(config, item.name) for item in fields(config) if item.name not in hidden}
    return {**shown, **config.hyperparameters_for(config.environment)}


def baselines(config: SearchConfig) -> grid.Grid:
    """
    The trainings that candidates are compared with, on the search's environment and seeds.

    :param config: The search
    """
    variants = {baseline.name: grid.Variant(baseline.aux_loss, baseline.overrides) for baseline in config.baselines}
    return grid.Grid(f"{config.name}-baselines", config, variants, [config.environment], config.seeds)


def baseline_scores(config: SearchConfig, storage: optuna.storages.BaseStorage) -> list[tuple[str, float]]:
    """
    Name and mean score of the baselines that are trained.

    :param config: The search
    :param storage: Its storage
    """
    name = baselines(config).name
    if name not in optuna.get_all_study_names(storage):
        return []
    scores = grid.scores(optuna.load_study(study_name=name, storage=storage), baselines(config).cells)
    return [(str(name), float(score)) for name, score in scores.groupby("variant")["score"].mean().items()]


def run_worker(config: SearchConfig, folder: Path, where: str) -> None:
    """
    Train candidates until the search is complete; any number of processes may do so.

    :param config: The search
    :param folder: Its folder, for checkpoints and curves
    :param where: Its storage, as for ``open_storage``
    """
    optuna.logging.set_verbosity(optuna.logging.ERROR)  # it shows a failed trial with all of its traceback
    sampler = AuxLossSampler(**config.sampler_settings(), worker=workers.identity())
    study = optuna.load_study(study_name=config.name, storage=open_storage(where), sampler=sampler, pruner=make_pruner(config))
    objective = Objective(config, folder / "candidates")
    artifacts = _artifacts(folder)
    failures = 0

    def finished(study: optuna.Study, trial: FrozenTrial) -> None:
        nonlocal failures
        with uninterrupted():
            annotate_trial(study, trial, artifacts)
        failures = failures + 1 if trial.state == TrialState.FAIL else 0
        reason = trial.user_attrs.get("reason")
        if failures:
            logger.warning("Trial %d failed: %s", trial.number, reason)
        if failures == MAX_FAILURES:
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
        except (UpdateFinishedTrialError, ValueError) as error:
            # A laptop that slept: others took this worker for dead and failed its trial, whose place they give out again.
            if not (isinstance(error, UpdateFinishedTrialError) or str(error).startswith("Cannot tell a FAIL trial")):
                raise
            logger.warning("A trial of this worker was failed by another one meanwhile: %s", error)


def search(
    config: SearchConfig, folder: Path, where: str, n_workers: int = 1, threads: int | None = None
) -> Iterator[Progress]:
    """
    Run a search, or go on with it: all that it knows is in the storage.

    Yields about once a second. Ctrl-C, or leaving the loop, interrupts the workers.

    :param config: The search
    :param folder: Its folder
    :param where: Its storage, as for ``open_storage``
    :param n_workers: Number of processes on this machine
    :param threads: Threads of each, None for its share of the cores
    """
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    storage = open_storage(where)
    sampler = AuxLossSampler(**config.sampler_settings())
    study = optuna.create_study(
        study_name=config.name, storage=storage, sampler=sampler, direction="maximize", load_if_exists=True
    )
    of_all = {"environment": config.environment, "seeds": config.seeds}
    grid.check_training(study, {"candidates": of_all | grid.training(config, config.environment)})
    progress = look(study, sampler, n_workers)  # refuses a study that was begun with other settings of the sampler
    annotate_study(study, settings(config), provenance())
    lines = baseline_scores(config, storage)
    yield progress
    with WorkerPool(run_worker, (config, folder, where), n_workers, threads) as pool:
        ended, drawn, busy = -1, 0.0, True
        while busy:
            now = sum(stage.filled + stage.failed for stage in progress.stages)
            if now != ended and time.monotonic() - drawn > PLOT_SECONDS:
                update_plots(study, lines)
                drawn = time.monotonic()
            busy = pool.check(progressed=now != ended)
            ended = now
            time.sleep(POLL_SECONDS)
            progress = look(study, sampler, n_workers)
            yield progress
    update_plots(study, lines)


def look(study: optuna.Study, sampler: AuxLossSampler, n_workers: int) -> Progress:
    """
    How far a search is.

    :param study: The study
    :param sampler: Its sampler
    :param n_workers: Workers that share what is left
    """
    stages = sampler.progress(study)
    complete = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    best = next(iter(ranked(complete, study.direction)), None)
    durations = [trial.duration.total_seconds() for trial in complete if trial.duration is not None]
    left = sum(stage.places - stage.filled for stage in stages)
    return Progress(
        stages,
        None if best is None else best.value,
        None if best is None else str(loss_of(best)),
        sum(durations) / len(durations) * left / n_workers if durations else None,
    )


def _artifacts(folder: Path) -> FileSystemArtifactStore:
    path = folder / ARTIFACTS
    path.mkdir(parents=True, exist_ok=True)
    return FileSystemArtifactStore(path)
