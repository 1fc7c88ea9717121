"""The driver: the same losses and scores however many runs are in flight, however they end, and after interruptions."""

import math
import random
import sqlite3
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import optuna
import pytest
import sqlalchemy
from optuna.exceptions import StorageInternalError
from optuna.pruners import ThresholdPruner
from optuna.storages import BaseStorage, InMemoryStorage
from optuna.trial import TrialState
from sb3_aarl.search.cli.main import explain
from sb3_aarl.search.evolution.sampler import AuxLossSampler
from sb3_aarl.search.evolution.space import loss_of, loss_to_params, suggest_aux_loss
from sb3_aarl.search.execution import driver
from sb3_aarl.search.execution.driver import Driver, RunFailed
from sb3_aarl.search.execution.queue import Queue
from sb3_aarl.search.execution.storage import open_storage
from sb3_aarl.search.training.run import Run

from sb3_aarl import AuxLoss
from sb3_aarl.callbacks import Evaluation, write_curve

CHECKPOINTS = (100, 200, 300)
SETTINGS: dict[str, Any] = {"population_size": 6, "n_random": 5, "n_prior": 2, "max_horizon": 3, "n_generations": 3, "seed": 7}
AGAIN = {"again": 0.35, "parent_selection": "posterior"}


def returns(run: Run) -> list[float]:
    """What a run of these tests reaches: a function of its loss and seed."""
    rng = random.Random(f"{AuxLoss.parse(str(run.aux_loss)).canonical()} {run.environment} {run.seed}")
    return [rng.uniform(0, 100) for _ in run.checkpoints]


# Environments, and their returns that count as 0 and 1.
TASKS = {"Pendulum-v1": (-50.0, 150.0), "MountainCarContinuous-v0": (40.0, 80.0)}


def make_runs(loss: AuxLoss, environments: Any = ("Pendulum-v1",), seeds: tuple[int, ...] = (0, 1)) -> list[Run]:
    values: dict[str, Any] = {"aux_loss": str(loss), "hyperparameters": {}, "checkpoints": CHECKPOINTS}
    return [Run(environment=environment, seed=seed, **values) for environment in environments for seed in seeds]


def runs_of(trial: Any, environments: Any) -> list[Run]:
    first = 2 * AuxLossSampler.seed_index(trial)
    return make_runs(suggest_aux_loss(trial), environments, (first, first + 1))


class Executor:
    """Runs that a test ends when it likes, in any order."""

    def __init__(self) -> None:
        self.pending: list[tuple[Future[Any], Path]] = []

    def submit(self, fn: Any, folder: str) -> Future[Any]:
        future: Future[Any] = Future()
        self.pending.append((future, Path(folder)))
        return future

    def end(self, rng: random.Random, failure: str | None = None, retry: bool = False) -> None:
        """End one run: with a complete curve, one that was stopped, or a failure."""
        future, folder = self.pending.pop(rng.randrange(len(self.pending)))
        run = Run.model_validate_json((folder / "run.json").read_text())
        n = 1 if (folder / "stop").exists() else len(run.checkpoints)
        curve = [Evaluation(*point, 0.0, 1, 1.0) for point in zip(run.checkpoints[:n], returns(run)[:n], strict=True)]
        write_curve(folder / "curve.csv", curve)
        future.set_result({"curve": [list(point) for point in curve], "failure": failure, "retry": retry})

    def evaluate(self) -> None:
        """All runs have their first evaluation."""
        for _, folder in self.pending:
            run = Run.model_validate_json((folder / "run.json").read_text())
            write_curve(folder / "curve.csv", [Evaluation(run.checkpoints[0], returns(run)[0], 0.0, 1, 1.0)])


@pytest.fixture(autouse=True)
def no_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(driver, "POLL_SECONDS", 0)


STORAGES: dict[Path, BaseStorage] = {}


def start(folder: Path, executor: Executor, workers: int = 1, environments: Any = ("Pendulum-v1",), **kwargs: Any) -> Driver:
    """The driver of a folder's study, as the command line makes it: a new sampler each time."""
    storage = STORAGES.setdefault(folder, InMemoryStorage())
    study = optuna.create_study(
        study_name="search",
        storage=storage,
        sampler=AuxLossSampler(**SETTINGS | kwargs.pop("settings", {})),
        direction="maximize",
        load_if_exists=True,
        pruner=kwargs.pop("pruner", optuna.pruners.NopPruner()),
    )
    return Driver(study, storage, lambda trial: runs_of(trial, environments), executor, folder, workers, **kwargs)


def outcome(search: Driver) -> dict[tuple[int, int], tuple[str, float | None]]:
    """Loss and score of every slot."""
    return {
        (trial.user_attrs["generation"], trial.user_attrs["slot"]): (str(loss_of(trial)), trial.value)
        for trial in search.study.get_trials(states=(TrialState.COMPLETE, TrialState.PRUNED))
    }


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[int, int], tuple[str, float | None]]:
    """One candidate after the other, undisturbed, on several environments."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(driver, "POLL_SECONDS", 0)
        executor, rng = Executor(), random.Random(0)
        search = start(tmp_path_factory.mktemp("expected"), executor, 1, TASKS, returns=TASKS, settings=AGAIN)
        for _ in search:
            while executor.pending:
                executor.end(rng)
    found = outcome(search)
    assert len(found) == 7 + 6 + 6
    assert max(AuxLossSampler.seed_index(trial) for trial in search.study.trials) > 0
    for trial in search.study.trials:
        means = [sum(map(sum, map(returns, runs_of(trial, [name])))) / 6 for name in TASKS]
        assert trial.value == pytest.approx(((means[0] + 50) / 200 + (means[1] - 40) / 40) / 2)
    return found


@pytest.mark.parametrize("workers", [1, 3, 8])
def test_losses_and_scores_depend_on_nothing_but_the_seed(workers: int, tmp_path: Path, expected: Any) -> None:
    """Runs end in any order; their processes are killed, and drivers are killed and started again."""
    rng = random.Random(workers)
    while True:
        executor = Executor()  # processes end with their driver
        search = start(tmp_path, executor, workers, TASKS, returns=TASKS, retries=100, settings=AGAIN)
        for progress in search:  # noqa: B007
            assert len(executor.pending) <= workers
            if rng.random() < 0.05:
                break
            if executor.pending and rng.random() < 0.7:
                killed = rng.random() < 0.3
                executor.end(rng, "killed" if killed else None, retry=killed)
        else:
            break
    assert outcome(search) == expected
    assert progress.best == max(score for _, score in expected.values() if score is not None)
    assert [generation.filled for generation in progress.generations] == [7, 6, 6]


def test_a_trial_left_running_is_interrupted_and_its_slot_has_the_same_loss(tmp_path: Path) -> None:
    loss = suggest_aux_loss(start(tmp_path, Executor()).study.ask(), SETTINGS["max_horizon"])  # and then its driver was killed
    search = start(tmp_path, Executor())
    next(iter(search))
    first, again, *_ = search.study.trials
    assert (first.state, first.user_attrs["interrupted"]) == (TrialState.FAIL, True)
    assert loss_of(again) == loss
    assert [again.user_attrs[key] for key in ("generation", "slot", "attempt")] == [1, 0, 0]


def test_an_interrupted_query_does_not_lock_the_study(tmp_path: Path) -> None:
    def interrupt(trial: optuna.Trial) -> None:
        cursor = sqlite3.connect(tmp_path / "study.db").execute("SELECT * FROM trials")
        raise KeyboardInterrupt(cursor.description)

    STORAGES[tmp_path] = open_storage(tmp_path)
    search = start(tmp_path, Executor())
    search.make_runs = interrupt
    with pytest.raises(KeyboardInterrupt):
        list(search)
    assert [trial.state for trial in search.study.trials] == [TrialState.FAIL]


def test_a_full_disk_ends_the_search_at_once_with_its_cause(tmp_path: Path) -> None:
    storage = STORAGES[tmp_path] = open_storage(tmp_path)
    executor, rng = Executor(), random.Random(0)
    search = start(tmp_path, executor)

    @sqlalchemy.event.listens_for(storage.engine, "connect")
    def fill(connection: Any, record: Any) -> None:
        connection.execute("PRAGMA max_page_count = 1")  # SQLite takes the present size

    def run() -> None:
        for _ in search:
            while executor.pending:
                executor.end(rng)

    storage.engine.dispose()
    with pytest.raises(StorageInternalError) as error:
        run()
    assert explain(error.value) == "(sqlite3.OperationalError) database or disk is full"


def test_a_database_that_another_program_holds_is_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_aarl.search.execution.storage.SQLITE_TIMEOUT", 0)
    STORAGES[tmp_path] = open_storage(tmp_path)
    search = start(tmp_path, Executor())
    progresses = iter(search)
    next(progresses)
    other, tries = sqlite3.connect(tmp_path / "study.db", isolation_level=None), []
    other.execute("BEGIN EXCLUSIVE")
    search._patiently.sleep = lambda seconds: tries.append(seconds) or other.close()
    next(progresses)
    assert len(tries) == 1


def test_a_failed_candidate_makes_room_for_another_one(tmp_path: Path) -> None:
    executor, rng = Executor(), random.Random(0)
    search = start(tmp_path, executor)
    for i, _ in enumerate(search):
        while executor.pending:
            executor.end(rng, "the loss is nan" if i == 0 else None)
    failed, other, *_ = search.study.trials
    assert (failed.state, failed.user_attrs["reason"]) == (TrialState.FAIL, "the loss is nan")
    assert loss_of(other) != loss_of(failed)
    assert (other.user_attrs["slot"], other.user_attrs["attempt"]) == (failed.user_attrs["slot"], 1)


@pytest.mark.parametrize("value", [math.nan, math.inf])
@pytest.mark.parametrize("pruner", [optuna.pruners.NopPruner(), ThresholdPruner(lower=-1e9)])
def test_scores_that_are_not_finite_are_failures(
    value: float, pruner: optuna.pruners.BasePruner, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(globals(), "returns", lambda run: [1.0, value, 1.0])
    executor, rng = Executor(), random.Random(0)
    search = start(tmp_path, executor, pruner=pruner)

    def run() -> None:
        for _ in search:
            executor.evaluate()
            while executor.pending:
                executor.end(rng)

    with pytest.raises(RunFailed, match=f"10 candidates failed in a row, the last one: its mean return is {value}"):
        run()
    assert [trial.state for trial in search.study.trials] == [TrialState.FAIL] * 10


def test_reports_the_mean_over_the_seeds_and_prunes(tmp_path: Path) -> None:
    executor, rng = Executor(), random.Random(0)
    search = start(tmp_path, executor, workers=2, pruner=ThresholdPruner(lower=60))
    for _ in search:
        executor.evaluate()
        if rng.random() < 0.5 and executor.pending:
            executor.end(rng)
    pruned = complete = 0
    for trial in search.study.trials:
        loss = loss_of(trial)
        assert loss is not None
        means = [sum(point) / 2 for point in zip(*map(returns, make_runs(loss)), strict=True)]
        for step, value in trial.intermediate_values.items():
            assert value == pytest.approx(means[CHECKPOINTS.index(step)])
        if trial.state == TrialState.PRUNED:
            pruned += 1
            assert min(trial.intermediate_values.values()) < 60
        else:
            complete += 1
            assert trial.value == pytest.approx(sum(means) / 3)
            assert [point[1] for point in trial.user_attrs["curve"]] == pytest.approx(means)
    assert pruned and complete


def test_repeats_of_a_loss_are_not_pruned(tmp_path: Path) -> None:
    """Of repeats that a pruner lets pass, the mean would be that of the lucky ones."""
    executor, rng = Executor(), random.Random(0)
    pruner = ThresholdPruner(lower=60)
    search = start(tmp_path, executor, settings=AGAIN | {"n_generations": 8}, pruner=pruner)
    for _ in search:
        executor.evaluate()
        if rng.random() < 0.5 and executor.pending:
            executor.end(rng)
    repeats = [trial for trial in search.study.trials if trial.user_attrs["operation"] == "again"]
    assert {trial.state for trial in repeats} == {TrialState.COMPLETE}
    assert any(min(trial.intermediate_values.values()) < 60 for trial in repeats)


def test_pruners_act_between_environments(tmp_path: Path) -> None:
    executor, rng = Executor(), random.Random(0)
    search = start(tmp_path, executor, 2, TASKS, returns=TASKS, pruner=ThresholdPruner(lower=0.5))
    for _ in search:
        executor.evaluate()
        if executor.pending:
            executor.end(rng)
    states = {TrialState.PRUNED: 1, TrialState.COMPLETE: 2}
    assert {trial.state for trial in search.study.trials} == set(states)
    for trial in search.study.trials:
        reports = trial.intermediate_values
        assert list(reports) == list(range(1, states[trial.state] + 1)) and (reports[1] < 0.5) == (len(reports) == 1)
        tasks = [path.name for path in driver.candidate_folder(tmp_path, trial).iterdir()]
        assert (
            sorted(tasks) == sorted([*TASKS][: len(reports)]) and list(trial.user_attrs["scores"]) == [*TASKS][: len(reports)]
        )
        assert trial.state == TrialState.PRUNED or trial.value == reports[2]


def test_a_run_that_is_told_to_stop_is_not_submitted_again(tmp_path: Path) -> None:
    executor, rng = Executor(), random.Random(0)
    queue = Queue(executor, workers=1)
    running, waiting = (queue.add(tmp_path / str(run.seed), run) for run in make_runs(AuxLoss.parse("{s_t} -> {r_t}")))
    queue.update()
    for job in (running, waiting):
        job.stop()
    executor.end(rng, "it was killed", retry=True)
    queue.update()
    assert running.failure is None and running.is_over and waiting.is_over and waiting.curve == []
    assert not queue.jobs and not executor.pending and not (tmp_path / "1").exists()


def test_an_executor_that_fails_is_tried_again(tmp_path: Path) -> None:
    executor, n = Executor(), 0
    queue = Queue(executor, retries=2)
    job = queue.add(tmp_path, make_runs(AuxLoss.parse("{s_t} -> {r_t}"))[0])
    while queue.jobs:
        queue.update()
        while executor.pending:
            executor.pending.pop()[0].set_exception(ConnectionError("the node is gone"))
            n += 1
    assert (n, job.failure) == (3, "ConnectionError: the node is gone")


def test_enqueued_losses_are_trained_and_invalid_ones_cost_nothing(tmp_path: Path) -> None:
    executor, rng = Executor(), random.Random(0)
    search = start(tmp_path, executor)
    loss = AuxLoss.parse("{s_t, a_t} -> {s_t+1}")
    make_runs = search.make_runs
    search.make_runs = lambda trial: make_runs(trial) if trial.suggest_categorical("width", [8, 16]) else []
    search.study.enqueue_trial({"width": 32})
    search.study.enqueue_trial({**loss_to_params(loss), "source/s_t": False})
    search.study.enqueue_trial(loss_to_params(loss))
    for _ in search:
        while executor.pending:
            executor.end(rng)
    refused, invalid, enqueued, *_ = search.study.trials
    assert refused.state == TrialState.FAIL and "32" in refused.user_attrs["reason"]
    assert invalid.state == TrialState.PRUNED and "curve" not in invalid.user_attrs
    assert (loss_of(enqueued), enqueued.state) == (loss, TrialState.COMPLETE)
    assert len(outcome(search)) == 7 + 6 + 6


def test_another_error_of_make_runs_ends_the_search_and_costs_no_candidate(tmp_path: Path) -> None:
    search = start(tmp_path, Executor())
    search.make_runs = lambda trial: int("a bug")
    with pytest.raises(ValueError, match="a bug"):
        list(search)
    assert [trial.user_attrs.get("interrupted") for trial in search.study.trials] == [True]
