"""The driver: the one process of a search that knows Optuna. It asks, submits, reports and tells."""

import logging
import math
import time
import traceback
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import optuna
from optuna.storages import BaseStorage
from optuna.trial import TrialState
from sb3_aarl.search.evolution.sampler import AuxLossSampler, GenerationProgress
from sb3_aarl.search.evolution.space import loss_of, suggest_aux_loss
from sb3_aarl.search.execution.executors import Executor
from sb3_aarl.search.execution.queue import Job, Queue, seconds_to_go
from sb3_aarl.search.execution.storage import cause, driver_lock, is_temporary
from sb3_aarl.search.training.folder import Run, partial_curve
from sb3_aarl.search.training.provenance import commit, read_about, versions
from tenacity import RetryCallState, Retrying, retry_if_exception, stop_after_delay, wait_random_exponential

from sb3_aarl.aux_loss import AuxLoss
from sb3_aarl.callbacks import Evaluation, aulc

logger = logging.getLogger(__name__)

POLL_SECONDS = 0.5
# So many failures in a row are no longer the candidates' fault.
MAX_FAILURES = 10
# Seconds for which an unreachable database is tried again.
PATIENCE_SECONDS = 600


class RunFailed(RuntimeError):
    """Too many candidates failed in a row; the message has the last reason."""


class SearchProgress(NamedTuple):
    """
    :param generations: Progress of each generation
    :param best: Best score so far
    :param best_loss: Its loss
    :param seconds_to_go: Estimated seconds until the search is complete, None while that is not known
    """

    generations: list[GenerationProgress]
    best: float | None
    best_loss: str | None
    seconds_to_go: float | None


@dataclass
class RunningTrial:
    """A trial, its runs in the queue (one for each seed), and the number of evaluations reported to Optuna."""

    trial: optuna.Trial
    jobs: list[Job]
    n_reported: int = 0

    def stop(self) -> None:
        """End its runs at their next evaluations."""
        for job in self.jobs:
            job.stop()


@dataclass(eq=False)
class Driver:
    """
    One search: iterate over it to run it. Leaving the loop marks the trials that run as interrupted.

    :param study: A study with an ``AuxLossSampler``, to be maximized or minimized
    :param storage: Its storage
    :param make_runs: The runs of a candidate, one for each seed
    :param executor: Where runs are executed
    :param folder: Folder of the search
    :param workers: Runs that are at the executor at the same time
    :param retries: How often a run is resubmitted
    :param on_change: Called with a trial when it starts, when it is reported, and before it is told
    """

    study: optuna.Study
    storage: BaseStorage
    make_runs: Callable[[AuxLoss], Sequence[Run]]
    executor: Executor
    folder: Path
    workers: int = 1
    retries: int = 3
    on_change: Callable[[optuna.Trial], None] = lambda trial: None

    def __post_init__(self) -> None:
        if not isinstance(self.study.sampler, AuxLossSampler):
            raise TypeError(f"a search needs an AuxLossSampler, not {type(self.study.sampler).__name__}")
        self.sampler = self.study.sampler
        self.queue = Queue(self.executor, self.workers, self.retries)
        self.running: dict[int, RunningTrial] = {}
        self.n_failures = 0
        # Any call may fail while the database is unreachable; all of them may be repeated.
        self._patiently = Retrying(
            retry=retry_if_exception(is_temporary),
            wait=wait_random_exponential(multiplier=0.5, max=30),
            stop=stop_after_delay(PATIENCE_SECONDS),
            before_sleep=_warn,
            reraise=True,
        )

    def __iter__(self) -> Generator[SearchProgress]:
        self.folder.mkdir(parents=True, exist_ok=True)
        with driver_lock(self.storage, self.study.study_name, self.folder):
            yield from self._run()

    def _run(self) -> Generator[SearchProgress]:
        try:
            self._patiently(self._interrupt_unknown)
            while True:
                self.queue.update()
                for running in list(self.running.values()):
                    self._check(running)
                while self.queue.has_room and self._patiently(self.sampler.free_slots, self.study) > 0:
                    self._start(self._patiently(self._ask))
                yield self._patiently(lambda: search_progress(self.study, self.sampler.progress(self.study)))
                if not self.running and self._patiently(self.sampler.is_complete, self.study):
                    return
                time.sleep(POLL_SECONDS)
        except KeyboardInterrupt as interrupt:
            traceback.clear_frames(interrupt.__traceback__)  # the cursor of an interrupted query would lock SQLite
            raise
        finally:
            self.running.clear()
            self._interrupt_unknown()  # running trials, and that of an interrupted ask

    def _ask(self) -> optuna.Trial:
        self._interrupt_unknown()  # the trial of an ask that failed half way
        return self.study.ask()

    def _interrupt_unknown(self) -> None:
        """Interrupt the trials of a driver that was killed. Their slots get the same losses again, and their runs resume."""
        for trial in self.study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
            if trial.number not in self.running:
                study_id = self.storage.get_study_id_from_name(self.study.study_name)
                trial_id = self.storage.get_trial_id_from_study_id_trial_number(study_id, trial.number)
                self.storage.set_trial_user_attr(trial_id, "interrupted", True)
                self.study.tell(trial.number, state=TrialState.FAIL)

    def _start(self, trial: optuna.Trial) -> None:
        """Submit a candidate's runs."""
        try:
            loss = self._patiently(suggest_aux_loss, trial)
        except optuna.TrialPruned as problem:  # enqueued by the user, and not valid
            logger.warning("Trial %d: %s", trial.number, problem)
            self._tell(trial, state=TrialState.PRUNED)
            return
        runs = self.make_runs(loss)
        attributes = {
            "loss": str(loss),
            "commit": commit(),
            "versions": versions(),
            "threads": runs[0].threads,
        }
        self._note(trial, attributes)
        folder = candidate_folder(self.folder, trial)
        jobs = [self.queue.add(folder / f"seed-{run.seed}", run) for run in runs]
        self.running[trial.number] = RunningTrial(trial, jobs)
        self.queue.update()
        self._patiently(self.on_change, trial)

    def _check(self, running: RunningTrial) -> None:
        """Report the evaluations of a candidate, and its result when all of its runs are over."""
        trial, jobs = running.trial, running.jobs
        is_over = all(job.is_over for job in jobs)
        curves = [job.curve if is_over else partial_curve(job.folder) for job in jobs]
        self._report(running, mean_curve(curves))
        failure = next((job.failure for job in jobs if job.failure is not None), None)
        if failure is not None and not is_over:
            running.stop()
        if not is_over:
            return
        session = read_about(jobs[0].folder).get("sessions", [{}])[-1]
        device = f"GPU: {session['gpu']}" if "cuda" in session.get("device", "") else f"CPU: {session.get('cpu')}"
        seconds = round(sum(curve[-1].seconds for curve in curves if curve), 1)
        self._note(trial, {"curve": mean_curve(curves), "seconds": seconds, "device": device})
        checkpoints = jobs[0].run.checkpoints
        if failure is None:
            failure = next((f"its mean return is {mean}" for _, mean in mean_curve(curves) if not math.isfinite(mean)), None)
        if failure is not None:
            self._fail(trial, failure)
        elif any(len(curve) < len(checkpoints) for curve in curves):
            self._tell(trial, state=TrialState.PRUNED)
        else:
            self.n_failures = 0
            self._tell(trial, values=float(np.mean([aulc(curve) for curve in curves])))

    def _report(self, running: RunningTrial, curve: list[list[float]]) -> None:
        """Report the mean over the seeds of each step that all of them have evaluated."""
        trial, news = running.trial, curve[running.n_reported :]
        for steps, mean in news:
            self._patiently(trial.report, mean, int(steps))
            running.n_reported += 1
            if steps != running.jobs[0].run.checkpoints[-1] and self._patiently(trial.should_prune):
                running.stop()
        if news:
            self._patiently(self.on_change, trial)

    def _fail(self, trial: optuna.Trial, reason: str) -> None:
        logger.warning("Trial %d failed: %s", trial.number, reason)
        self._note(trial, {"reason": reason})
        self._tell(trial, state=TrialState.FAIL)
        self.n_failures += 1
        if self.n_failures == MAX_FAILURES:
            where = candidate_folder(self.folder, trial)
            raise RunFailed(f"{MAX_FAILURES} candidates failed in a row, the last one: {reason} (see {where})")

    def _note(self, trial: optuna.Trial, attributes: dict[str, Any]) -> None:
        for name, value in attributes.items():
            self._patiently(trial.set_user_attr, name, value)

    def _tell(self, trial: optuna.Trial, values: float | None = None, state: TrialState | None = None) -> None:
        self._patiently(self.on_change, trial)
        self._patiently(self.study.tell, trial, values, state, skip_if_finished=True)
        self.running.pop(trial.number, None)


def _warn(attempt: RetryCallState) -> None:
    assert attempt.outcome is not None
    logger.warning("Retrying the database: %s", cause(attempt.outcome.exception()))


def search_progress(study: optuna.Study, generations: list[GenerationProgress]) -> SearchProgress:
    """The progress of a search with this progress of its generations."""
    complete = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    best = study.best_trial if complete else None
    seconds = [trial.duration.total_seconds() for trial in complete if trial.duration is not None]
    left = sum(generation.slots - generation.filled for generation in generations)
    return SearchProgress(
        generations,
        None if best is None else best.value,
        None if best is None else str(loss_of(best)),
        seconds_to_go(seconds, left, sum(generation.running for generation in generations)),
    )


def mean_curve(curves: Sequence[Sequence[Evaluation]]) -> list[list[float]]:
    """Environment steps and mean return over the seeds of each evaluation, as far as all seeds have it."""
    evaluations = zip(*curves, strict=False)
    return [[points[0].environment_steps, float(np.mean([point.mean for point in points]))] for points in evaluations]


def candidate_folder(folder: Path, trial: optuna.Trial) -> Path:
    """The folder of a candidate. It has no trial number, so that the next trial of an interrupted slot finds it."""
    at = trial.user_attrs
    return folder / "candidates" / f"generation-{at['generation']}" / f"slot-{at['slot']:03}" / f"attempt-{at['attempt']}"
