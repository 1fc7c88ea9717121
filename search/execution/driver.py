"""The driver: the one process of a search that knows Optuna. It asks, submits, reports and tells."""

import logging
import math
import time
import traceback
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import optuna
from optuna.storages import BaseStorage
from optuna.trial import TrialState
from sb3_aarl.search.evolution.sampler import FIXED_KEY, AuxLossSampler, GenerationProgress
from sb3_aarl.search.evolution.space import described, loss_of, other_params
from sb3_aarl.search.execution.executors import Executor
from sb3_aarl.search.execution.matrix import scaled, task_folder
from sb3_aarl.search.execution.queue import Job, Queue, seconds_to_go
from sb3_aarl.search.execution.storage import cause, driver_lock, is_temporary
from sb3_aarl.search.training.folder import Run, partial_curve
from sb3_aarl.search.training.provenance import commit, read_about, versions
from tenacity import RetryCallState, Retrying, retry_if_exception, stop_after_delay, wait_fixed

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
    """Progress of each generation, best score so far and its loss, and the estimated seconds to go, None if not known."""

    generations: list[GenerationProgress]
    best: float | None
    best_loss: str | None
    seconds_to_go: float | None


@dataclass
class RunningTrial:
    """A trial, its runs on later environments, its jobs on those that are done and on this one, and the number of reports."""

    trial: optuna.Trial
    waiting: list[list[Run]]
    done: list[list[Job]] = field(default_factory=list)
    jobs: list[Job] = field(default_factory=list)
    n_reported: int = 0

    def stop(self) -> None:
        """End its runs."""
        for job in self.jobs:
            job.stop()


@dataclass(eq=False)
class Driver:
    """
    One search: iterate over it to run it. Leaving the loop marks the trials that run as interrupted.

    :param study: A study with an ``AuxLossSampler``, to be maximized or minimized
    :param storage: Its storage
    :param make_runs: The runs of a trial, of which it suggests the loss: on each environment, one for each seed
    :param executor: Where runs are executed
    :param folder: Folder of the search
    :param workers: Runs that are at the executor at the same time
    :param retries: How often a run is resubmitted
    :param returns: The returns that count as 0 and 1 on each environment, None where they count as they are
    """

    study: optuna.Study
    storage: BaseStorage
    make_runs: Callable[[optuna.Trial], Sequence[Run]]
    executor: Executor
    folder: Path
    workers: int = 1
    retries: int = 3
    returns: Mapping[str, tuple[float, float] | None] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not isinstance(self.study.sampler, AuxLossSampler):
            raise TypeError(f"a search needs an AuxLossSampler, not {type(self.study.sampler).__name__}")
        self.sampler = self.study.sampler
        self.queue = Queue(self.executor, self.workers, self.retries)
        self.running: dict[int, RunningTrial] = {}
        self.n_failures = 0
        # Any call may fail while the database is unreachable; all of them may be repeated.
        retry, stop = retry_if_exception(is_temporary), stop_after_delay(PATIENCE_SECONDS)
        self._patiently = Retrying(retry=retry, stop=stop, wait=wait_fixed(5), before_sleep=_warn, reraise=True)

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
                while len(self.queue.jobs) < self.workers and self._patiently(self.sampler.free_slots, self.study) > 0:
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
        """Submit a candidate's runs on its first environment."""
        try:
            runs = self._patiently(self.make_runs, trial)
        except optuna.TrialPruned as problem:  # enqueued by the user, and not valid
            logger.warning("Trial %d: %s", trial.number, problem)
            self._tell(trial, state=TrialState.PRUNED)
            return
        except ValueError as problem:
            if FIXED_KEY not in self.study.get_trials(deepcopy=False)[trial.number].system_attrs:
                raise
            # Enqueued too, beside the loss, and Optuna refuses it.
            self._fail(trial, str(problem))
            return
        about = {"loss": runs[0].aux_loss, "threads": runs[0].threads, "commit": commit(), "versions": versions()}
        self._note(trial, about)
        tasks = [list(task) for _, task in groupby(runs, lambda run: run.environment)]
        self.running[trial.number] = RunningTrial(trial, tasks)
        self._submit(self.running[trial.number])

    def _submit(self, running: RunningTrial) -> None:
        """Submit a candidate's runs on its next environment."""
        folder = candidate_folder(self.folder, running.trial)
        if len(running.waiting) + len(running.done) > 1:
            folder /= task_folder(running.waiting[0][0].environment)
        running.jobs = [self.queue.add(folder / f"seed-{run.seed}", run) for run in running.waiting.pop(0)]
        self.queue.update()

    def _check(self, running: RunningTrial) -> None:
        """Report the evaluations of a candidate, submit its runs on the next environment, and tell its result."""
        trial, jobs = running.trial, running.jobs
        is_over = all(job.is_over for job in jobs)
        curve = mean_curve(self._curves(jobs))
        if not running.waiting and not running.done:
            self._report(running, curve)
        failure = next((job.failure for job in jobs if job.failure is not None), None)
        if not is_over:
            if failure is not None:
                running.stop()
            return
        running.done.append(jobs)
        if failure is None:
            failure = next((f"its mean return is {mean}" for _, mean in curve if not math.isfinite(mean)), None)
        is_whole = failure is None and all(len(job.curve) == len(job.run.checkpoints) for job in jobs)
        if is_whole:
            of_tasks = [float(np.mean([aulc(curve) for curve in self._curves(task)])) for task in running.done]
            score = float(np.mean(of_tasks))
            if running.waiting or len(of_tasks) > 1:
                names = [task[0].run.environment for task in running.done]
                self._note(trial, {"scores": dict(zip(names, of_tasks, strict=True))})
                self._patiently(trial.report, score, len(of_tasks))
            if running.waiting and not self._is_pruned(trial):
                self._submit(running)
                return
            is_whole = not running.waiting
        self._note_runs(trial, [job for task in running.done for job in task])
        if failure is not None:
            self._fail(trial, failure)
            return
        self.n_failures = 0
        if is_whole:
            self._tell(trial, values=score)
        else:
            self._tell(trial, state=TrialState.PRUNED)

    def _curves(self, jobs: Sequence[Job]) -> list[list[Evaluation]]:
        """The curves of jobs so far, on the scale of their environments' returns."""
        curves = []
        for job in jobs:
            returns, curve = self.returns.get(job.run.environment), job.curve if job.is_over else partial_curve(job.folder)
            curves.append([point._replace(mean=scaled(point.mean, returns)) for point in curve])
        return curves

    def _note_runs(self, trial: optuna.Trial, jobs: Sequence[Job]) -> None:
        """Note the mean curve, if all environments have the same checkpoints, and how long the runs took on which machine."""
        session = read_about(jobs[0].folder).get("sessions", [{}])[-1]
        device = f"GPU: {session['gpu']}" if "cuda" in session.get("device", "") else f"CPU: {session.get('cpu')}"
        seconds = round(sum(job.curve[-1].seconds for job in jobs if job.curve), 1)
        is_alike = len({job.run.checkpoints for job in jobs}) == 1
        curve = mean_curve(self._curves(jobs)) if is_alike else []
        self._note(trial, {"curve": curve, "seconds": seconds, "device": device})

    def _report(self, running: RunningTrial, curve: list[list[float]]) -> None:
        """Report the mean over the seeds of each step that all of them have evaluated."""
        for steps, mean in curve[running.n_reported :]:
            self._patiently(running.trial.report, mean, int(steps))
            running.n_reported += 1
            if steps != running.jobs[0].run.checkpoints[-1] and self._is_pruned(running.trial):
                running.stop()

    def _is_pruned(self, trial: optuna.Trial) -> bool:
        """Whether the pruner ends a trial; never one of ``again``: of a loss's repeats only the lucky ones would count."""
        return not AuxLossSampler.seed_index(trial) and self._patiently(trial.should_prune)

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
        None if best is None else described(loss_of(best), other_params(best.params)),
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
