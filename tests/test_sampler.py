"""AuxLossSampler: stages, selection, lineage, places, and that all workers agree on them."""

import contextlib
import copy
import pickle
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import pytest
from optuna.pruners import HyperbandPruner, MedianPruner
from optuna.samplers import PartialFixedSampler, RandomSampler
from optuna.storages import RDBStorage, RetryHeartbeatStaleTrialCallback, fail_stale_trials
from optuna.trial import FrozenTrial, TrialState
from search_worker import SETTINGS, DivergedError, diverges, open_storage, score, work

import search.execution.storage
from sb3_aarl.aux_loss import OPERATORS, AuxLoss
from search.evolution import sampler as module
from search.evolution.sampler import PLACE_KEY, AuxLossSampler, SearchComplete, StageProgress
from search.evolution.space import loss_to_params, params_to_loss, suggest_aux_loss
from search.execution import workers

# Started from one process that has imported what workers need.
processes = get_context("forkserver")
processes.set_forkserver_preload(["search.evolution.sampler"])


@pytest.fixture(autouse=True)
def _quiet() -> None:
    optuna.logging.set_verbosity(optuna.logging.ERROR)


def make_study(direction: str = "maximize", storage: Any = None, **settings: Any) -> optuna.Study:
    sampler = AuxLossSampler(**{"seed": 0, **SETTINGS, **settings})
    return optuna.create_study(storage=storage, study_name="study", sampler=sampler, direction=direction, load_if_exists=True)


def run(study: optuna.Study, objective: Callable[[AuxLoss], float] = score) -> optuna.Study:
    """The whole search, one trial after the other."""
    max_horizon = study.sampler.max_horizon
    with pytest.raises(SearchComplete):
        study.optimize(lambda trial: objective(suggest_aux_loss(trial, max_horizon)), catch=(DivergedError,))
    return study


def failing(loss: AuxLoss) -> float:
    if diverges(loss):
        raise DivergedError
    return score(loss)


def placed(study: optuna.Study) -> list[FrozenTrial]:
    return [trial for trial in study.get_trials() if trial.system_attrs.get(PLACE_KEY) is not None]


def place_of(trial: FrozenTrial | optuna.Trial) -> tuple[int, int]:
    return trial.user_attrs["stage"], trial.user_attrs["place"]


def ask_for_place(study: optuna.Study) -> tuple[int, int]:
    return place_of(study.ask())


def issued(study: optuna.Study) -> dict[tuple[int, int, int], tuple[str, str, list[tuple[int, int]]]]:
    """Of every stage, place and attempt: loss, operation and the places of the parents. Without what was enqueued."""
    trials = {trial.number: trial for trial in placed(study)}
    found = {}
    for trial in trials.values():
        claim = trial.system_attrs[PLACE_KEY]
        parents = [place_of(trials[number]) for number in trial.user_attrs.get("parents", ())]
        key = (claim["stage"], claim["place"], claim["attempt"])
        row = (claim["loss"], trial.user_attrs.get("operation", ""), parents)
        # A worker that was killed just after it took a place shows no lineage.
        if row[1] not in ("", "enqueued"):
            assert found.setdefault(key, row) == row
    return found


def filled_places(study: optuna.Study) -> list[tuple[int, int]]:
    return sorted(place_of(trial) for trial in placed(study) if trial.state in (TrialState.COMPLETE, TrialState.PRUNED))


def all_places(first: int, later: int, n_stages: int) -> list[tuple[int, int]]:
    return [(stage, place) for stage in range(1, n_stages + 1) for place in range(first if stage == 1 else later)]


# Stages, shares, parents and lineage.


def test_the_paper_s_shares_and_sizes() -> None:
    sampler = AuxLossSampler()
    assert Counter(sampler.operations(1)) == {"random": 100, "prior": 25}
    shares = {"random": 20, "replacement": 50, "crossover": 20, "horizon_change": 10}
    assert Counter(sampler.operations(2)) == Counter(sampler.operations(7)) == shares


@pytest.mark.parametrize("population_size", [1, 4, 7, 8, 10, 33, 100])
def test_shares_are_as_exact_as_whole_numbers_can_be(population_size: int) -> None:
    sampler = AuxLossSampler(population_size=population_size)
    operations = sampler.operations(2)
    assert len(operations) == population_size
    for name, share in {"random": 0.2, "replacement": 0.5, "crossover": 0.2, "horizon_change": 0.1}.items():
        assert abs(operations.count(name) - share * population_size) < 1
    assert operations == sorted(operations, key=lambda name: name != "random")  # what needs no parents comes first


@pytest.mark.parametrize("screening", [1, 4])
@pytest.mark.parametrize("direction", ["maximize", "minimize"])
def test_every_stage_is_filled_once_by_offspring_of_the_best_quarter(direction: str, screening: int) -> None:
    settings = {"population_size": 20, "n_random": 20, "n_prior": 9, "max_horizon": 3, "n_stages": 4, "screening": screening}
    study = run(make_study(direction, **settings))
    sampler, trials = study.sampler, placed(study)
    assert [trial.state for trial in trials] == [TrialState.COMPLETE] * len(trials)
    assert filled_places(study) == all_places(29, 20, 4)
    by_number = {trial.number: trial for trial in trials}
    losses = {trial.number: params_to_loss(trial.params) for trial in trials}
    for stage in range(1, 5):
        of_stage = [trial for trial in trials if trial.user_attrs["stage"] == stage]
        # Duplicates are drawn again, over all stages.
        assert len({losses[trial.number].canonical() for trial in trials}) == len(trials)
        operations = Counter(trial.user_attrs["operation"] for trial in of_stage)
        if stage == 1:
            assert operations == {"random": 20, "prior": 9}
            assert not any(trial.user_attrs["parents"] for trial in of_stage)
            continue
        assert operations == {"random": 4, "replacement": 10, "crossover": 4, "horizon_change": 2}
        before = [trial for trial in trials if trial.user_attrs["stage"] == stage - 1]
        sign = 1 if direction == "maximize" else -1
        best = sorted(before, key=lambda trial: (-sign * trial.value, trial.user_attrs["place"]))[
            : {29: 7, 20: 5}[len(before)]
        ]
        parents = {trial.number for trial in best}
        assert [trial.number for trial in sampler.select_parent(study, stage - 1)] == [trial.number for trial in best]
        assert {sampler.get_trial_generation(study, trial) for trial in of_stage} == {stage - 1}
        assert sampler.get_population(study, stage - 1) == sorted(of_stage, key=place_of)
        for trial in of_stage:
            loss, lineage = losses[trial.number], trial.user_attrs["parents"]
            operation = trial.user_attrs["operation"]
            assert len(lineage) == {"random": 0, "crossover": 2}.get(operation, 1)
            if not lineage:
                continue
            assert lineage[0] in parents
            mother = losses[lineage[0]]
            if operation == "replacement":
                assert loss.horizon == mother.horizon
            elif operation == "horizon_change":
                assert abs(loss.horizon - mother.horizon) == 1
                kept = 3 * min(loss.horizon, mother.horizon) + 1
                assert (loss.source[:kept], loss.target[:kept]) == (mother.source[:kept], mother.target[:kept])
            else:
                father = losses[lineage[1]]
                assert lineage[1] != lineage[0]
                assert loss.horizon == father.horizon == mother.horizon
                for bit, of_mother, of_father in zip(
                    loss.source + loss.target, mother.source + mother.target, father.source + father.target, strict=True
                ):
                    assert bit in (of_mother, of_father)
                if lineage[1] not in parents:
                    # Any of the stage is taken only where no two parents have one horizon.
                    assert by_number[lineage[1]].user_attrs["stage"] == stage - 1
                    assert len({losses[number].horizon for number in parents}) == len(parents)


def test_equal_scores_go_by_place_and_pruned_trials_come_last() -> None:
    study = make_study(n_stages=2, population_size=8, n_random=8, n_prior=0)
    trials = [study.ask() for _ in range(8)]
    for trial in trials:
        suggest_aux_loss(trial, 2)
    # Told backwards; the pruned one has the best score by far, two are equal.
    scores: dict[int, float] = {7: 1.0, 6: 3.0, 5: 3.0, 4: 0.0, 3: 9.0, 2: -1.0, 1: 3.0, 0: 2.0}
    for number, value in scores.items():
        if number == 3:
            trials[number].report(value, 1)
            study.tell(trials[number], state=TrialState.PRUNED)
        else:
            study.tell(trials[number], value)
    assert study.trials[3].value == 9.0
    assert [trial.number for trial in study.sampler.select_parent(study, 1)] == [1, 5]
    sampler = make_study(parents=1.0, n_stages=2, population_size=8, n_random=8, n_prior=0).sampler
    assert [trial.number for trial in sampler._best(study.trials, 1.0)] == [1, 5, 6, 0, 7, 4, 2, 3]


def test_replacements_of_a_whole_search_flip_at_the_paper_s_rate() -> None:
    # With duplicates allowed nothing but validity has a say, which losses with many tokens hardly ever lack.
    study = make_study(
        n_stages=3, population_size=150, n_random=200, n_prior=0, max_horizon=8, allow_duplicates=True, replacement=1.0,
        crossover=0, horizon_change=0, random=0,
    )  # fmt: skip
    run(study, lambda loss: float(sum(loss.source) + sum(loss.target)))
    losses = {trial.number: params_to_loss(trial.params) for trial in placed(study)}
    flips = []
    for trial in placed(study):
        for parent in trial.user_attrs["parents"]:
            both = [np.array([losses[number].source, losses[number].target]) for number in (trial.number, parent)]
            flips.append((both[0] != both[1]).sum())
    assert len(flips) == 300
    assert abs(np.mean(flips) - 1) < 4 / np.sqrt(300)  # one bit on average, with a variance of about one
    assert min(flips) == 0


@pytest.mark.parametrize("operators", [("mse", "inner"), OPERATORS])
def test_operators_are_searched_too(operators: tuple[str, ...]) -> None:
    study = make_study(operators=operators, n_stages=3)
    with pytest.raises(SearchComplete):
        study.optimize(lambda trial: score(suggest_aux_loss(trial, 2, operators)))
    losses = [params_to_loss(trial.params) for trial in placed(study)]
    assert filled_places(study) == all_places(12, 12, 3)
    assert {loss.operator for loss in losses} <= set(operators)
    assert len({(loss.operator, loss.negatives) for loss in losses}) > 3
    assert [str(loss) for loss in losses] == [trial.system_attrs[PLACE_KEY]["loss"] for trial in placed(study)]


def test_screening_keeps_the_offspring_that_the_model_rates_highest() -> None:
    def first_replacements(screening: int) -> list[float]:
        study = make_study(
            screening=screening, population_size=40, n_random=60, n_prior=0, max_horizon=6, n_stages=2, parents=1.0, seed=3
        )
        run(study, lambda loss: float(sum(loss.target)))
        return [trial.value for trial in placed(study) if trial.user_attrs["operation"] == "replacement"]

    # The score is a linear function of what the model sees, without noise.
    assert np.mean(first_replacements(32)) > np.mean(first_replacements(1)) + 1


# Determinism.


@pytest.fixture(scope="module")
def alone() -> dict[Any, Any]:
    """What one worker issues, without and with failures, each once for all tests."""
    optuna.logging.set_verbosity(optuna.logging.ERROR)

    def failing(loss: AuxLoss) -> float:
        if diverges(loss):
            raise DivergedError
        return score(loss)

    return {False: issued(run(make_study())), True: issued(run(make_study(), failing))}


def work_in_processes(n_workers: int, *arguments: Any) -> list[int | None]:
    """Let several processes work on a study, all at once. How they exited."""
    start = processes.Barrier(n_workers)
    crew = [processes.Process(target=work, args=(start, *arguments)) for _ in range(n_workers)]
    for process in crew:
        process.start()
    for process in crew:
        process.join(120)
    return [process.exitcode for process in crew]


@pytest.mark.parametrize(("kind", "n_workers", "may_fail"), [("journal", 4, False), ("journal", 8, True), ("sqlite", 4, True)])
def test_several_workers_fill_each_place_once_with_what_one_worker_issues(
    kind: str, n_workers: int, may_fail: bool, tmp_path: Path, alone: dict[Any, Any]
) -> None:
    study = make_study(storage=open_storage(kind, tmp_path))
    assert work_in_processes(n_workers, kind, tmp_path, SETTINGS, 0, may_fail) == [0] * n_workers
    assert filled_places(study) == all_places(12, 12, 3)
    assert issued(study) == alone[may_fail]
    failed = [trial for trial in placed(study) if trial.state == TrialState.FAIL]
    assert bool(failed) == may_fail


@pytest.mark.parametrize(
    "kill", [("training", 0), ("placed", 5), ("asking", 12), ("training", 20), ("asking", 0), ("placed", 30)]
)
def test_a_search_that_is_killed_and_resumed_goes_on_as_if_it_had_not_been(
    kill: tuple[str, int], tmp_path: Path, alone: dict[Any, Any]
) -> None:
    study = make_study(storage=open_storage("journal", tmp_path))
    assert work_in_processes(1, "journal", tmp_path, SETTINGS, 0, False, kill) == [-9]
    assert work_in_processes(1, "journal", tmp_path, SETTINGS, 0) == [0]
    assert filled_places(study) == all_places(12, 12, 3)
    assert issued(study) == alone[False]
    assert study.trials[kill[1]].state == TrialState.FAIL


def test_workers_without_a_seed_agree_on_one(tmp_path: Path) -> None:
    make_study(storage=open_storage("journal", tmp_path), seed=None)
    assert work_in_processes(4, "journal", tmp_path, SETTINGS, None) == [0] * 4
    study = make_study(storage=open_storage("journal", tmp_path), seed=None)
    seeds = {trial.system_attrs[PLACE_KEY]["seed"] for trial in placed(study)}
    assert len(seeds) == 1
    assert issued(study) == issued(run(make_study(seed=seeds.pop())))
    assert issued(run(make_study(seed=None))) != issued(study)


@pytest.mark.parametrize("order", range(4))
@pytest.mark.parametrize("screening", [1, 3])
def test_the_order_in_which_trials_finish_does_not_matter(order: int, screening: int) -> None:
    rng = np.random.default_rng(order)
    study = make_study(screening=screening)
    running: list[optuna.Trial] = []
    while True:
        try:
            can_start = study.sampler.has_place(study) and len(running) < 6
        except SearchComplete:
            break
        if can_start and (not running or rng.random() < 0.6):
            trial = study.ask()
            suggest_aux_loss(trial, 2)
            running.append(trial)
        else:
            trial = running.pop(rng.integers(len(running)))
            loss = params_to_loss(trial.params)
            # The first one of each place may fail, whenever that is.
            if diverges(loss):
                study.tell(trial, state=TrialState.FAIL)
            else:
                study.tell(trial, score(loss))
    assert filled_places(study) == all_places(12, 12, 3)
    assert issued(study) == issued(run(make_study(screening=screening), failing))


@pytest.mark.parametrize("screening", [1, 3])
def test_who_goes_on_takes_earlier_candidates_from_the_storage(screening: int, monkeypatch: pytest.MonkeyPatch) -> None:
    def go_on(study: optuna.Study, n_trials: int) -> optuna.Study:
        study.optimize(lambda trial: failing(suggest_aux_loss(trial, 2)), n_trials=n_trials, catch=(DivergedError,))
        return study

    drawn: list[tuple[int, int, int]] = []
    draw = module._Evolution._draw

    def recorded(self: Any, stage: int, place: int, attempt: int, seen: Any) -> module.Candidate:
        drawn.append((stage, place, attempt))
        return draw(self, stage, place, attempt, seen)

    study, undisturbed = (make_study(screening=screening) for _ in range(2))
    enqueued = loss_to_params(AuxLoss.parse("{s_t, a_t} -> {s_t+1}"))
    for each in (study, undisturbed):
        each.enqueue_trial(enqueued)
        go_on(each, 31)
    study.sampler = make_study(screening=screening, seed=None).sampler  # that of another process
    before = {key[:2] for key in issued(study) if key[2] == 0}
    monkeypatch.setattr(module._Evolution, "_draw", recorded)
    go_on(study, 1)
    # What is new, and what nobody had because a loss was enqueued.
    assert (1, 0, 0) in drawn
    assert not before & {(stage, place) for stage, place, attempt in drawn if attempt == 0}
    monkeypatch.undo()
    go_on(undisturbed, 1)
    assert issued(run(study, failing)) == issued(run(undisturbed, failing))


def test_what_objectives_write_on_trials_steers_nothing() -> None:
    def losses(study: optuna.Study) -> dict[tuple[int, int, int], str]:
        claims = [trial.system_attrs[PLACE_KEY] for trial in placed(study)]
        return {(claim["stage"], claim["place"], claim["attempt"]): claim["loss"] for claim in claims}

    def objective(trial: optuna.Trial) -> float:
        for key, value in {"operation": "mine", "parents": None, "stage": 7}.items():
            trial.set_user_attr(key, value)
        return failing(suggest_aux_loss(trial, 2))

    study = make_study()
    while study.sampler.progress(study) == [] or study.sampler.progress(study)[-1].stage < 3:
        study.sampler = make_study(seed=None).sampler  # as if each trial had a process of its own
        study.optimize(objective, n_trials=1, catch=(DivergedError,))
    assert losses(run(study, failing)) == losses(run(make_study(), failing))


@pytest.mark.parametrize("ends", ["interrupted", "killed", "fails"])
def test_an_enqueued_loss_has_another_try_unless_it_failed(ends: str) -> None:
    loss = AuxLoss.parse("{s_t, a_t} -> {r_t, s_t+1}")
    study = make_study(retries=1)

    def objective(trial: optuna.Trial) -> float:
        if suggest_aux_loss(trial, 2) != loss:
            return 1.0
        tries.append(trial.number)
        if ends == "fails":
            raise DivergedError
        if ends == "interrupted" and len(tries) < 4:
            raise KeyboardInterrupt
        return 9.0

    tries: list[int] = []
    study.enqueue_trial(loss_to_params(loss))
    if ends == "killed":
        for _ in range(2):  # of one try and one retry nothing is left
            trial = study.ask()
            assert params_to_loss(trial.relative_params) == loss and trial.user_attrs["operation"] == "enqueued"
            workers.fail(study, study.trials[trial.number], "its worker died")
            tries.append(trial.number)
            place = place_of(trial)
        assert study.ask().user_attrs["operation"] == study.sampler.operations(1)[place[1]]
        return
    for _ in range(4):
        with contextlib.suppress(KeyboardInterrupt):
            study.optimize(objective, n_trials=2, catch=(DivergedError,))
    assert len(tries) == (4 if ends == "interrupted" else 1)
    assert [trial.value for trial in study.trials if trial.value == 9.0] == ([9.0] if ends == "interrupted" else [])
    assert len({place_of(study.trials[number]) for number in tries}) == 1


def test_a_study_that_was_deleted_and_begun_anew_has_its_own_places(tmp_path: Path) -> None:
    sampler = make_study(n_random=3, n_prior=1).sampler
    for value in (1.0, 2.0):
        url = f"sqlite:///{tmp_path / 'study.db'}"
        study = optuna.create_study(storage=url, study_name="again", sampler=sampler, direction="maximize")
        for place in range(4):
            trial = study.ask()
            assert place_of(trial) == (1, place)
            suggest_aux_loss(trial, 2)
            study.tell(trial, value)
        optuna.delete_study(study_name="again", storage=url)


def test_trials_of_a_larger_search_have_no_places_in_a_smaller_one() -> None:
    larger = make_study(n_stages=1, n_random=6, n_prior=2)
    run(larger)
    study = make_study(n_random=2, n_prior=1)
    study.add_trials(larger.trials)
    run(study)
    assert {place for place in filled_places(study) if place[0] == 1} >= {(1, 0), (1, 1), (1, 2)}


def test_who_asks_for_more_than_there_are_places_is_told(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def sleep(seconds: float) -> None:
        if "study.ask() waits for a place until one of the 2 trials that run is told" in caplog.text:
            raise TimeoutError

    study = make_study(n_random=1, n_prior=1, population_size=2, random=0, replacement=0.7)
    for _ in range(2):
        study.ask()
    monkeypatch.setattr(module.time, "sleep", sleep)
    with pytest.raises(TimeoutError):
        study.ask()


def test_random_numbers_of_anything_else_do_not_matter() -> None:
    study = make_study()
    np.random.seed(0)
    study.sampler.reseed_rng()
    assert issued(run(study)) == issued(run(make_study()))


# Places.


def test_random_places_of_the_next_stage_are_given_out_while_this_one_ends() -> None:
    study = make_study(n_stages=2, population_size=10, n_random=5, n_prior=1)
    first = [study.ask() for _ in range(6)]
    early = [study.ask() for _ in range(2)]
    assert [place_of(study.trials[trial.number]) for trial in first + early] == [*all_places(6, 0, 1), (2, 0), (2, 1)]
    assert [study.trials[trial.number].user_attrs["operation"] for trial in early] == ["random", "random"]
    assert not study.sampler.has_place(study)
    assert study.sampler.progress(study) == [StageProgress(1, 6, 0, 6, 0), StageProgress(2, 10, 0, 2, 0)]
    for trial in first:
        suggest_aux_loss(trial, 2)
        study.tell(trial, 1.0)
    assert study.sampler.has_place(study)
    study.tell(early[0], state=TrialState.FAIL)
    assert study.sampler.progress(study) == [StageProgress(1, 6, 6, 0, 0), StageProgress(2, 10, 0, 1, 1)]
    assert ask_for_place(study) == (2, 0)


@pytest.mark.parametrize("screening", [1, 8])
def test_an_early_random_place_that_fails_gets_the_same_candidate_before_and_after_the_stage_ends(screening: int) -> None:
    def second_candidate(stage_ends_first: bool) -> str:
        study = make_study(n_stages=3, population_size=10, n_random=6, n_prior=0, screening=screening)
        for _ in range(6):  # the first stage, so that there is a model
            trial = study.ask()
            study.tell(trial, score(suggest_aux_loss(trial, 2)))
        trials = [study.ask() for _ in range(11)]
        for trial in trials:
            suggest_aux_loss(trial, 2)
        assert place_of(study.trials[trials[-1].number]) == (3, 0)
        steps = [lambda: study.tell(trials[-1], state=TrialState.FAIL)]
        steps.insert(
            0 if stage_ends_first else 1, lambda: [study.tell(t, score(params_to_loss(t.params))) for t in trials[:-1]]
        )
        steps[0]()
        if not stage_ends_first:
            again = study.ask()
            steps[1]()
        else:
            steps[1]()
            again = study.ask()
        claim = study.trials[again.number].system_attrs[PLACE_KEY]
        assert (claim["stage"], claim["place"], claim["attempt"]) == (3, 0, 1)
        assert claim["loss"] != study.trials[trials[-1].number].system_attrs[PLACE_KEY]["loss"]
        return claim["loss"]

    assert second_candidate(True) == second_candidate(False)


def test_a_worker_without_a_place_waits_until_one_is_free(monkeypatch: pytest.MonkeyPatch) -> None:
    study = make_study(n_stages=1, n_random=3, n_prior=0)
    trials = [study.ask() for _ in range(3)]
    waits, asked = threading.Event(), []
    monkeypatch.setattr(module.time, "sleep", lambda seconds: (waits.set(), threading.Event().wait(0.001)))
    thread = threading.Thread(target=lambda: asked.append(study.ask()))
    thread.start()
    assert waits.wait(30)
    assert not asked
    study.tell(trials[1], state=TrialState.FAIL)
    thread.join(30)
    assert place_of(study.trials[asked[0].number]) == (1, 1)
    for trial in (*trials[::2], asked[0]):
        suggest_aux_loss(trial, 2)
        study.tell(trial, 0.0)
    for ask in (lambda: study.sampler.has_place(study), study.ask):
        with pytest.raises(SearchComplete):
            ask()


def test_threads_fill_each_place_once() -> None:
    study = make_study(n_stages=2)
    study.optimize(lambda trial: score(suggest_aux_loss(trial, 2)), n_trials=24, n_jobs=4)
    assert filled_places(study) == all_places(12, 12, 2)
    assert issued(study) == {key: row for key, row in issued(run(make_study())).items() if key[0] < 3}


def test_the_place_of_a_dead_worker_gets_the_same_candidate_and_that_of_a_failed_one_another(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    study = make_study(n_stages=1, n_random=1, n_prior=0)
    losses = []
    for how in ("dies", "interrupted", "fails", "dies"):
        trial = study.ask()
        losses.append(suggest_aux_loss(trial, 2))
        if how == "dies":
            assert workers.fail(study, study.trials[trial.number], "its worker died")
            continue
        if how == "interrupted":
            trial.set_user_attr("interrupted", True)
        study.tell(trial, state=TrialState.FAIL)
    assert losses[0] == losses[1] == losses[2] != losses[3]
    # A loss that kills every worker is given up at last.
    for _ in range(module.RETRIES):
        trial = study.ask()
        losses.append(suggest_aux_loss(trial, 2))
        workers.fail(study, study.trials[trial.number], "its worker died")
    assert set(losses[3:]) == {losses[3]}
    assert suggest_aux_loss(study.ask(), 2) != losses[3]


@pytest.mark.parametrize("error", [KeyboardInterrupt(), RuntimeError("a mistake in the program")], ids=repr)
def test_a_program_that_ends_in_its_objective_goes_on_with_the_same_candidate(error: BaseException) -> None:
    study = make_study()

    def ends(trial: optuna.Trial) -> float:
        loss = suggest_aux_loss(trial, 2)
        if trial.number in (0, 3, 4, 15, 30):
            raise error
        return score(loss)

    for _ in range(5):
        with pytest.raises(type(error)):
            study.optimize(ends, catch=(DivergedError,))
    assert [trial.state == TrialState.FAIL for trial in study.trials].count(True) == 5
    undisturbed = run(make_study())
    run(study)
    assert issued(study) == issued(undisturbed) and filled_places(study) == filled_places(undisturbed)


def test_the_objective_sees_stage_operation_and_parents() -> None:
    seen = {}

    def objective(trial: optuna.Trial) -> float:
        seen[trial.number] = trial.user_attrs
        return score(suggest_aux_loss(trial, 2))

    study = make_study(n_stages=2)
    with pytest.raises(SearchComplete):
        study.optimize(objective, catch=(DivergedError,))
    keys = {"stage", "place", "operation", "parents", "worker"}
    for number, attributes in seen.items():
        assert attributes == study.trials[number].user_attrs and attributes.keys() - {"replaces"} == keys
    assert any(attributes["parents"] for attributes in seen.values())


@pytest.mark.filterwarnings("ignore::optuna.exceptions.ExperimentalWarning")
def test_only_what_study_optimize_goes_on_with_has_a_heart(tmp_path: Path) -> None:
    storage = RDBStorage(f"sqlite:///{tmp_path}/study.db", heartbeat_interval=60)
    beaten: list[int] = []
    record = storage.record_heartbeat
    storage.record_heartbeat = lambda trial_id: (beaten.append(trial_id), record(trial_id))  # type: ignore[method-assign]
    study = make_study(storage=storage)
    study.ask()  # told by whoever asked
    assert beaten == []

    def objective(trial: optuna.Trial) -> float:
        assert set(beaten) == {trial._trial_id}
        other = study.ask()  # a batch
        assert study.trials[other.number].state == TrialState.RUNNING and set(beaten) == {trial._trial_id}
        study.tell(other, state=TrialState.FAIL)
        return score(suggest_aux_loss(trial, 2))

    study.optimize(objective, n_trials=1)
    asked_outside, mine, other = study.trials
    assert PLACE_KEY in other.system_attrs and module.REJECTED_KEY in other.system_attrs
    assert mine.state == TrialState.COMPLETE and asked_outside.state == TrialState.RUNNING


@pytest.mark.filterwarnings("ignore::optuna.exceptions.ExperimentalWarning")
def test_without_names_the_dead_are_known_by_their_hearts(tmp_path: Path) -> None:
    storage = RDBStorage(f"sqlite:///{tmp_path}/study.db", heartbeat_interval=1, grace_period=2)
    study = make_study(storage=storage, n_random=2, n_prior=0, n_stages=1, worker=None)
    trial = study.ask()
    storage.record_heartbeat(trial._trial_id)  # and never again
    run(study)
    assert "worker" not in trial.user_attrs and "no sign of life" in study.trials[0].user_attrs["reason"]
    assert [place_of(trial) for trial in study.trials[:3]] == [(1, 0), (1, 1), (1, 0)]
    assert study.trials[0].system_attrs[PLACE_KEY] == study.trials[2].system_attrs[PLACE_KEY]


def test_a_trial_that_never_chooses_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    study = make_study()
    monkeypatch.setattr(module, "ORPHAN_SECONDS", 0.01)
    orphan = study._storage.create_new_trial(study._study_id)
    trial = study.ask()
    assert place_of(study.trials[trial.number]) == (1, 0)
    assert study.trials[0]._trial_id == orphan
    assert study.trials[0].state == TrialState.FAIL
    assert "died" in study.trials[0].user_attrs["reason"]


def test_a_worker_shows_that_it_lives_before_it_shows_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Killed in between on another machine, its trial would have a name and no sign: nobody could say that it died."""
    done = []
    monkeypatch.setattr(workers, "beat", lambda *arguments: done.append("sign"))
    monkeypatch.setattr(module, "_show", lambda study, trial, key, value: done.append(key))
    study = make_study(storage=search.execution.storage.open_storage(tmp_path))
    study.optimize(lambda trial: score(suggest_aux_loss(trial, 2)), n_trials=1)
    assert done[:2] == ["sign", workers.WORKER_KEY]


def test_parents_of_a_stage_are_those_of_now() -> None:
    """Optuna's own get_parent_population would keep what it found while the stage was still open."""
    study = make_study()
    sampler = study.sampler
    assert isinstance(sampler, AuxLossSampler)
    for n_trials in (3, 9, 1):
        study.optimize(lambda trial: score(suggest_aux_loss(trial, 2)), n_trials=n_trials)
        assert sampler.get_parent_population(study, 0) == []
        parents = sampler.get_parent_population(study, 1)
        assert [trial.number for trial in parents] == [trial.number for trial in sampler.select_parent(study, 1)]
    of_stage = [trial for trial in placed(study) if trial.user_attrs["stage"] == 1]
    best = sorted(of_stage, key=lambda trial: (-trial.value, trial.user_attrs["place"]))
    assert [trial.number for trial in parents] == [trial.number for trial in best[: len(parents)]]
    assert sampler.get_parent_population(study, 7) == []


@pytest.mark.parametrize("seed", range(5))
def test_what_is_known_of_places_is_what_the_trials_say(seed: int) -> None:
    """However they end, and whatever is enqueued between them."""
    rng = np.random.default_rng(seed)
    study = make_study(n_stages=3, retries=1)
    sampler = study.sampler
    assert isinstance(sampler, AuxLossSampler)
    running: list[optuna.Trial] = []
    with pytest.raises(SearchComplete):
        while True:
            if rng.random() < 0.1:
                study.enqueue_trial(loss_to_params(AuxLoss.parse("{s_t} -> {s_t+1}")))
            if len(running) < 3 and sampler.has_place(study):
                running.append(study.ask())
                suggest_aux_loss(running[-1], 2)
            else:
                trial = running.pop(rng.integers(len(running)))
                how = rng.choice(["complete", "prune", "fail", "die"], p=[0.6, 0.1, 0.2, 0.1])
                if how == "die":
                    workers.fail(study, study.trials[trial.number], "its worker died")
                else:
                    state = {"complete": None, "prune": TrialState.PRUNED, "fail": TrialState.FAIL}[how]
                    study.tell(trial, rng.random() if how == "complete" else None, state=state)
            sampler.progress(study)
            register = sampler._register
            for stage in range(1, 4):
                holders = {place: register.held_by(stage, place) for place in range(len(sampler.operations(stage)))}
                assert register.taken[stage] == {place for place, trials in holders.items() if trials}
                filled = {place for place, trials in holders.items() if trials and trials[0].state in module.FILLED}
                assert register.filled[stage] == filled


def test_a_score_that_cannot_be_squared_does_not_stop_a_screened_search() -> None:
    def objective(trial: optuna.Trial) -> float:
        value = score(suggest_aux_loss(trial, 2))
        return -sys.float_info.max if trial.number % 5 == 0 else value

    study = make_study(screening=3, n_stages=3)
    with pytest.raises(SearchComplete):
        study.optimize(objective)
    assert filled_places(study) == all_places(12, 12, 3)


def test_trials_of_other_samplers_are_left_alone() -> None:
    study = make_study()
    other = optuna.load_study(study_name="study", storage=study._storage, sampler=RandomSampler(seed=0))
    trial = other.ask()
    trial.suggest_float("x", 0, 1)
    other.tell(other.ask(), 1.0)
    assert [ask_for_place(study) for _ in range(2)] == [(1, 0), (1, 1)]
    assert study.sampler.get_trial_generation(study, study.trials[0]) == -1


def test_a_trial_whose_place_is_read_later_than_its_parameters_goes_first(monkeypatch: pytest.MonkeyPatch) -> None:
    study = make_study()
    suggest_aux_loss(study.ask(), 2)
    storage, get_all_trials = study._storage, study._storage.get_all_trials
    n_read = 0

    def torn(study_id: int, deepcopy: bool = True, states: Any = None) -> list[FrozenTrial]:
        # As SQLite does it between the statements of another process.
        nonlocal n_read
        n_read += states is None
        trials = get_all_trials(study_id, deepcopy, states)
        if n_read == 1 and states is None:
            trials[0] = copy.copy(trials[0])
            trials[0]._system_attrs = {}
        return trials

    monkeypatch.setattr(storage, "get_all_trials", torn)
    # Not even for a moment does the second trial take the place of the first.
    monkeypatch.setattr(AuxLossSampler, "_give_back", lambda *arguments: pytest.fail("shared a place"))
    other = optuna.load_study(study_name="study", storage=storage, sampler=AuxLossSampler(**SETTINGS, seed=0))
    assert ask_for_place(other) == (1, 1)
    assert n_read > 2


def test_an_enqueued_trial_that_comes_out_of_turn_does_not_share_a_place(monkeypatch: pytest.MonkeyPatch) -> None:
    study = make_study()
    study.enqueue_trial({"horizon": 1})
    other = optuna.load_study(study_name="study", storage=study._storage, sampler=AuxLossSampler(**SETTINGS, seed=0))
    # Trial 1 was made by a worker that did not see trial 0 waiting yet, and is about to write down its place.
    monkeypatch.setattr(study, "_pop_waiting_trial_id", lambda: None)
    take = AuxLossSampler._take

    def take_late(sampler: AuxLossSampler, *arguments: Any) -> None:
        monkeypatch.setattr(AuxLossSampler, "_take", take)
        assert other.ask().number == 0
        take(sampler, *arguments)

    monkeypatch.setattr(AuxLossSampler, "_take", take_late)
    assert study.ask().number == 1
    assert list(map(place_of, study.trials)) == [(1, 0), (1, 1)]


@pytest.mark.parametrize("ends", ["fails", "dies", "fails, enqueued", "is interrupted, enqueued"])
def test_a_place_that_another_trial_had_for_a_moment_is_chosen_anew(ends: str, monkeypatch: pytest.MonkeyPatch) -> None:
    study, undisturbed = (make_study(storage=optuna.storages.InMemoryStorage()) for _ in range(2))
    other = optuna.load_study(study_name="study", storage=study._storage, sampler=AuxLossSampler(**SETTINGS, seed=0))

    def one_that_ends(study: optuna.Study) -> None:
        if "enqueued" in ends:
            study.enqueue_trial({"horizon": 1, "target_0_s": True}, skip_if_exists=False)
        trial = study.ask()
        suggest_aux_loss(trial, 2)
        if ends == "dies" or "interrupted" in ends:
            trial.set_user_attr(workers.DIED_KEY if ends == "dies" else "interrupted", True)
        study.tell(trial, state=TrialState.FAIL)

    take = AuxLossSampler._take

    def take_late(sampler: AuxLossSampler, *arguments: Any) -> bool:
        # A slow worker: while it draws its candidate, another one takes the place, and fails.
        monkeypatch.setattr(AuxLossSampler, "_take", take)
        candidate = module._Evolution.candidate

        def late(self: Any, *place: Any) -> module.Candidate:
            monkeypatch.setattr(module._Evolution, "candidate", candidate)
            with monkeypatch.context() as patch:  # it does not see the slow one yet
                patch.setattr(module._Register, "unplaced", lambda *arguments, **keywords: [])
                one_that_ends(other)
            return candidate(self, *place)

        monkeypatch.setattr(module._Evolution, "candidate", late)
        return take(sampler, *arguments)

    monkeypatch.setattr(AuxLossSampler, "_take", take_late)
    slow = study.ask()
    one_that_ends(undisturbed)
    expected = undisturbed.ask()
    for trial in (slow, expected):
        suggest_aux_loss(trial, 2)
    # The slow one has the lower number, as it asked before.
    assert slow.number == 0 and expected.number == 1
    assert slow.params == expected.params
    claims = [s.trials[n].system_attrs[PLACE_KEY] for s, n in ((study, 0), (undisturbed, 1))]
    assert claims[0] == claims[1]


# Enqueued trials, heartbeats, pruners.


def test_an_enqueued_loss_is_trained_in_a_random_place() -> None:
    study = make_study(n_stages=2, n_random=2, n_prior=2)
    wanted = AuxLoss.parse("{s_t, a_t} -> {s_t+1}")
    for _ in range(4):
        trial = study.ask()
        study.tell(trial, score(suggest_aux_loss(trial, 2)))
    study.enqueue_trial(loss_to_params(wanted))
    study.enqueue_trial({"horizon": 2, "source/s_t": False, "target/r_t+1": True})
    trials = [study.ask() for _ in range(2)]
    assert suggest_aux_loss(trials[0], 2) == wanted
    partly = suggest_aux_loss(trials[1], 2)
    assert (partly.horizon, partly.source[0], partly.target[5]) == (2, False, True)
    for trial in trials:
        shown = study.trials[trial.number].user_attrs
        assert (shown["stage"], shown["operation"], shown["parents"]) == (2, "enqueued", [])
        assert study.sampler.operations(2)[shown["place"]] == "random"
        study.tell(trial, 100.0)
    run(study)
    assert filled_places(study) == all_places(4, 12, 2)
    assert Counter(trial.user_attrs["operation"] for trial in placed(study))["replacement"] == 6


def test_an_enqueued_loss_that_is_invalid_or_fails_costs_no_place_and_no_candidate() -> None:
    study = make_study()
    study.enqueue_trial(loss_to_params(AuxLoss.parse("{s_t} -> {s_t}")) | {"source/s_t": False})
    study.enqueue_trial({"horizon": 2})
    for _ in range(2):
        trial = study.ask()
        if trial.number == 0:
            with pytest.raises(optuna.TrialPruned):
                suggest_aux_loss(trial, 2)
        study.tell(trial, state=TrialState.PRUNED if trial.number == 0 else TrialState.FAIL)
    assert study.sampler.progress(study)[0] == StageProgress(1, 12, 0, 0, 1)
    run(study)
    valid = [trial for trial in study.trials if trial.state == TrialState.COMPLETE]
    assert sorted(map(place_of, valid)) == all_places(12, 12, 3)
    assert issued(study) == issued(run(make_study()))


def heartbeat_study(monkeypatch: pytest.MonkeyPatch, **settings: Any) -> tuple[optuna.Study, Callable[[optuna.Trial], None]]:
    """A study with heartbeats, and how the heart of a trial stops."""
    with pytest.warns(optuna.exceptions.ExperimentalWarning):
        storage = RDBStorage(
            "sqlite:///:memory:",
            heartbeat_interval=60,
            grace_period=120,
            heartbeat_stale_trial_callback=RetryHeartbeatStaleTrialCallback(),
        )
    study = make_study(storage=storage, **{"n_random": 2, "n_prior": 0, "n_stages": 2, **settings})

    def stop(trial: optuna.Trial) -> None:
        monkeypatch.setattr(storage, "_get_stale_trial_ids", lambda study_id: [trial._trial_id])
        fail_stale_trials(study)

    return study, stop


@pytest.mark.filterwarnings("ignore::optuna.exceptions.ExperimentalWarning")
@pytest.mark.parametrize("has_params", [False, True])
def test_a_copy_of_a_trial_whose_heart_stopped_keeps_its_place(monkeypatch: pytest.MonkeyPatch, has_params: bool) -> None:
    study, stop = heartbeat_study(monkeypatch)
    trial = study.ask()
    loss = suggest_aux_loss(trial, 2) if has_params else None
    trial.set_user_attr("worker", workers.identity(1).rsplit(" ", 1)[0] + " 0")  # dead, and the copy inherits its name
    stop(trial)
    second = study.ask()
    assert second.number == 1
    assert place_of(study.trials[1]) == place_of(study.trials[0]) == (1, 0)
    assert study.trials[1].user_attrs["worker"] == workers.identity()
    assert str(suggest_aux_loss(second, 2)) == study.trials[0].system_attrs[PLACE_KEY]["loss"]
    assert loss in (None, params_to_loss(study.trials[1].params))
    third = study.ask()
    assert place_of(study.trials[third.number]) == (1, 1)
    assert study.trials[1].state == TrialState.RUNNING


@pytest.mark.filterwarnings("ignore::optuna.exceptions.ExperimentalWarning")
def test_a_copy_brings_a_place_where_there_is_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    study, stop = heartbeat_study(monkeypatch, n_random=1, random=0.0, replacement=0.7)
    trial = study.ask()
    assert isinstance(study.sampler, AuxLossSampler) and not study.sampler.has_place(study)
    stop(trial)
    assert study.sampler.has_place(study)
    assert ask_for_place(study) == (1, 0)
    assert not study.sampler.has_place(study)


@pytest.mark.filterwarnings("ignore::optuna.exceptions.ExperimentalWarning")
def test_a_copy_whose_place_is_taken_brings_none(monkeypatch: pytest.MonkeyPatch) -> None:
    study, _ = heartbeat_study(monkeypatch, n_random=1, random=0.0, replacement=0.7)
    trial = study.ask()
    study._storage.set_trial_state_values(trial._trial_id, TrialState.FAIL)
    assert ask_for_place(study) == (1, 0)
    RetryHeartbeatStaleTrialCallback()(study, study.trials[0])
    assert isinstance(study.sampler, AuxLossSampler) and not study.sampler.has_place(study)


@pytest.mark.filterwarnings("ignore::optuna.exceptions.ExperimentalWarning")
def test_a_copy_that_comes_too_late_takes_another_place(monkeypatch: pytest.MonkeyPatch) -> None:
    study, _ = heartbeat_study(monkeypatch)
    trial = study.ask()
    loss = suggest_aux_loss(trial, 2)
    study._storage.set_trial_state_values(trial._trial_id, TrialState.FAIL)
    faster = study.ask()  # between the failure of the trial and the making of its copy
    assert place_of(study.trials[faster.number]) == (1, 0)
    RetryHeartbeatStaleTrialCallback()(study, study.trials[0])
    late = study.ask()
    assert suggest_aux_loss(late, 2) == loss
    assert place_of(study.trials[late.number]) == (1, 1)


@pytest.mark.filterwarnings("ignore::optuna.exceptions.ExperimentalWarning")
@pytest.mark.parametrize("has_params", [False, True])
def test_a_copy_of_a_trial_whose_candidate_has_failed_since_gets_another(
    has_params: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    study, _ = heartbeat_study(monkeypatch, n_random=1, n_stages=1)
    dead = study.ask()
    if has_params:
        suggest_aux_loss(dead, 2)
    study._storage.set_trial_state_values(dead._trial_id, TrialState.FAIL)
    faster = study.ask()
    suggest_aux_loss(faster, 2)
    study.tell(faster, state=TrialState.FAIL)
    RetryHeartbeatStaleTrialCallback()(study, study.trials[0])
    assert isinstance(study.sampler, AuxLossSampler) and study.sampler.has_place(study)
    copied = study.ask()
    claims = [trial.system_attrs[PLACE_KEY] for trial in study.trials]
    loss = str(suggest_aux_loss(copied, 2))
    # Parameters that it was given already cannot be taken back.
    assert [(claim["stage"], claim["place"], claim["attempt"]) for claim in claims] == [
        (1, 0, 0),
        (1, 0, 0),
        (1, 0, not has_params),
    ]
    assert claims[2]["loss"] == loss and (loss == claims[1]["loss"]) == has_params


@pytest.mark.parametrize("n_trials", [0, 1])
def test_a_worker_that_is_interrupted_while_it_draws_decides_no_seed(n_trials: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """As long as nobody has a place, the first trial's worker chooses the seed of the study."""
    study = make_study(seed=None)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(module._Evolution, "candidate", lambda *arguments: (_ for _ in ()).throw(KeyboardInterrupt))
        study.ask()
    assert not study.sampler._register.places
    for _ in range(n_trials):
        study.ask()
    assert bool(study.sampler._register.places) == bool(n_trials)


@pytest.mark.parametrize("pruner", [MedianPruner(n_startup_trials=3), HyperbandPruner(min_resource=1, max_resource=9)])
def test_pruned_trials_fill_their_place_and_are_no_parents_of_the_next_stage(pruner: optuna.pruners.BasePruner) -> None:
    study = make_study()
    study.pruner = pruner

    def objective(trial: optuna.Trial) -> float:
        value = score(suggest_aux_loss(trial, 2))
        for step in range(9):
            trial.report(value, step)
            if trial.should_prune():
                raise optuna.TrialPruned
        return value

    with pytest.raises(SearchComplete):
        study.optimize(objective)
    assert filled_places(study) == all_places(12, 12, 3)
    pruned = {trial.number for trial in placed(study) if trial.state == TrialState.PRUNED}
    assert pruned
    for stage in (1, 2):
        complete = [t for t in study.sampler.get_population(study, stage - 1) if t.state == TrialState.COMPLETE]
        best = sorted(complete, key=lambda trial: (-trial.value, trial.user_attrs["place"]))[:3]
        parents = [trial.number for trial in study.sampler.select_parent(study, stage)]
        assert parents[: len(best)] == [trial.number for trial in best]
        assert set(parents[len(best) :]) <= pruned


# The sampler as an object.


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda sampler: pickle.loads(pickle.dumps(sampler))])
def test_a_copied_sampler_goes_on_with_the_study(duplicate: Callable[[AuxLossSampler], AuxLossSampler]) -> None:
    study = make_study()
    for _ in range(20):
        trial = study.ask()
        study.tell(trial, score(suggest_aux_loss(trial, 2)))
    study.sampler = duplicate(study.sampler)
    assert issued(run(study)) == issued(run(make_study()))


def test_one_sampler_serves_two_studies_in_turn() -> None:
    study = make_study()
    other = optuna.create_study(direction="maximize", sampler=study.sampler)
    for _ in range(20):
        for each in (study, other):
            trial = each.ask()
            each.tell(trial, score(suggest_aux_loss(trial, 2)))
    assert issued(run(study)) == issued(run(other)) == issued(run(make_study()))


def test_other_parameters_are_drawn_by_place() -> None:
    def rates(n_jobs: int) -> dict[tuple[int, int], float]:
        study = make_study()

        def objective(trial: optuna.Trial) -> float:
            trial.suggest_float("rate", 0, 1)
            return score(suggest_aux_loss(trial, 2))

        study.optimize(objective, n_trials=30, n_jobs=n_jobs)
        return {place_of(trial): trial.params["rate"] for trial in placed(study)}

    alone = rates(1)
    assert alone == rates(3)
    assert len(set(alone.values())) == 30


OTHER_SETTINGS = {
    "population_size": 13, "n_random": 9, "n_prior": 3, "parents": 0.5, "max_horizon": 3, "operators": ("mse", "inner"),
    "allow_duplicates": True, "screening": 2,
}  # fmt: skip


@pytest.mark.parametrize(("name", "value"), OTHER_SETTINGS.items())
def test_a_study_does_not_go_on_with_other_settings(name: str, value: Any) -> None:
    study = make_study()
    study.ask()
    other = make_study(storage=study._storage, **{name: value})
    with pytest.raises(ValueError, match=f"begun with {name}="):
        other.ask()
    shares = make_study(storage=study._storage, replacement=0.4, random=0.3)
    with pytest.raises(ValueError, match=r"begun with random=0\.2, not 0\.3"):
        shares.ask()
    assert [trial.state for trial in study.trials] == [TrialState.RUNNING, TrialState.FAIL, TrialState.FAIL]
    longer = make_study(storage=study._storage, n_stages=9, seed=5)
    trial = longer.ask()
    assert study.trials[trial.number].system_attrs[PLACE_KEY]["seed"] == 0  # a study keeps its first seed


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"population_size": 0}, "population_size must be at least 1, not 0"),
        ({"max_horizon": 0}, "max_horizon must be at least 1"),
        ({"screening": 0}, "screening must be at least 1"),
        ({"n_random": 0, "n_prior": 0}, r"n_random \+ n_prior must be at least 1"),
        ({"n_stages": 0}, "n_stages must be at least 1"),
        ({"n_random": -1, "n_prior": 5}, "n_random must not be negative"),
        ({"crossover": -0.2, "random": 0.6}, "crossover must not be negative"),
        ({"random": 0.3}, "must sum to 1, not 1.1"),
        ({"parents": 0.0}, "parents must be a share"),
        ({"parents": 1.5}, "parents must be a share"),
        ({"operators": ("l2",)}, "'l2' is not"),
        ({"seed": -1}, "seed must not be negative"),
        ({"random": float("nan")}, "random must not be negative"),
    ],
)
def test_settings_that_do_not_fit_are_named(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        AuxLossSampler(**settings)


@pytest.mark.parametrize(("name", "value"), [("seed", np.int64(3)), ("n_random", 10.0), ("screening", True)])
def test_settings_that_are_no_ints_are_named(name: str, value: Any) -> None:
    with pytest.raises(TypeError, match=f"{name} must be an int"):
        AuxLossSampler(**{name: value})


def test_a_score_that_is_not_finite_makes_no_parent() -> None:
    study = make_study(n_stages=2, population_size=4, n_random=4, n_prior=0)
    for value in (1.0, np.inf, 3.0, 2.0):
        trial = study.ask()
        suggest_aux_loss(trial, 2)
        study.tell(trial, value)
    assert [trial.value for trial in study.sampler.select_parent(study, 1)] == [3.0]


def test_another_sampler_must_not_fix_what_belongs_to_a_loss() -> None:
    study = make_study()
    study.sampler = PartialFixedSampler({"horizon": 1}, study.sampler)
    trial = study.ask()
    with pytest.raises(ValueError, match="must not fix horizon"):
        suggest_aux_loss(trial, 2)


def test_a_trial_that_waited_for_its_place_says_so_only_while_it_does(monkeypatch: pytest.MonkeyPatch) -> None:
    study = make_study(n_stages=2, population_size=4, n_random=1, n_prior=0, random=0.0, replacement=0.7)
    monkeypatch.setattr(module, "ORPHAN_SECONDS", 6.0)
    first = study.ask()
    loss = suggest_aux_loss(first, 2)
    with ThreadPoolExecutor() as pool:
        second = pool.submit(study.ask)
        deadline = time.monotonic() + 60
        while len(study.trials) < 2 or "waiting" not in study.trials[1].user_attrs:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        study.tell(first, score(loss))
        second.result()
    assert place_of(study.trials[1])[0] == 2
    assert study.trials[1].user_attrs["waiting"] is None


def test_several_objectives_are_refused() -> None:
    study = optuna.create_study(directions=["maximize", "minimize"], sampler=AuxLossSampler(seed=0))
    with pytest.raises(ValueError, match="multi-objective"):
        study.ask()


def test_a_study_whose_objective_has_no_loss_is_refused() -> None:
    study = make_study(n_random=1, n_prior=0)
    study.tell(study.ask(), 1.0)
    with pytest.raises(RuntimeError, match="suggest_aux_loss"):
        study.ask()


@pytest.mark.parametrize("screening", [1, 4])
def test_a_tiny_space_ends_with_duplicates_rather_than_not_at_all(screening: int) -> None:
    # Horizon 1 has 180 valid losses, fewer canonical ones.
    study = make_study(population_size=4, n_random=170, n_prior=10, max_horizon=1, n_stages=3, screening=screening)
    run(study)
    assert filled_places(study) == all_places(180, 4, 3)
    forms = [params_to_loss(trial.params).canonical() for trial in placed(study)]
    valid = {
        AuxLoss(1, source, target).canonical()
        for source in np.ndindex(2, 2, 2, 2)
        for target in np.ndindex(2, 2, 2, 2)
        if (source[0] or source[3]) and any(target)
    }
    assert len(set(forms)) > 0.9 * len(valid)
    assert set(forms) <= valid
