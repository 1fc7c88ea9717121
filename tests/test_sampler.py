"""AuxLossSampler: generations, parents, slots, and that no order in which trials finish changes a loss."""

import contextlib
import copy
import pickle
from collections import Counter
from collections.abc import Callable
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Literal

import numpy as np
import optuna
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from optuna.storages import RDBStorage, RetryHeartbeatStaleTrialCallback
from optuna.trial import FrozenTrial, TrialState
from sb3_aarl.search.evolution import mutations
from sb3_aarl.search.evolution.sampler import SETTINGS_KEY, AuxLossSampler, GenerationProgress
from sb3_aarl.search.evolution.space import PRIORS, loss_of, loss_to_params, params_to_loss, random_loss, suggest_aux_loss
from sb3_aarl.search.evolution.surrogate import TokenModel

from sb3_aarl.aux_loss import AuxLoss

SMALL: dict[str, Any] = {"population_size": 12, "n_random": 8, "n_prior": 4, "max_horizon": 2, "n_generations": 3, "seed": 0}
WANTED = AuxLoss.parse("{s_t, a_t} -> {s_t+1}")
Key = tuple[int, int, int]  # generation, slot, attempt


@pytest.fixture(autouse=True)
def _quiet() -> None:
    optuna.logging.set_verbosity(optuna.logging.ERROR)


def make_study(direction: Literal["maximize", "minimize"] = "maximize", storage: Any = None, **settings: Any) -> optuna.Study:
    sampler = AuxLossSampler(**{**SMALL, **settings})
    return optuna.create_study(storage=storage, study_name="study", sampler=sampler, direction=direction, load_if_exists=True)


def sampler_of(study: optuna.Study) -> AuxLossSampler:
    assert isinstance(study.sampler, AuxLossSampler)
    return study.sampler


def score(loss: AuxLoss) -> float:
    """Many losses have one score."""
    return float(2 * sum(loss.target[::3]) - sum(loss.source) + sum(loss.source[1::3]))


def lot(loss: AuxLoss, n: int) -> int:
    """The same number below ``n`` for a loss in every process."""
    return sum(bit << index for index, bit in enumerate(loss.source + loss.target)) * 7919 % 10007 % n


def run(study: optuna.Study, objective: Callable[[AuxLoss], float] = score) -> optuna.Study:
    """The rest of the search, one trial after the other."""
    sampler = sampler_of(study)
    while sampler.free_slots(study):
        trial = study.ask()
        study.tell(trial, objective(suggest_aux_loss(trial, sampler.max_horizon, sampler.operators)))
    return study


def key_of(trial: FrozenTrial | optuna.Trial) -> Key:
    return trial.user_attrs["generation"], trial.user_attrs["slot"], trial.user_attrs["attempt"]


def losses_of(study: optuna.Study) -> dict[Key, AuxLoss | None]:
    return {key_of(trial): loss_of(trial) for trial in study.trials}


def params_of(study: optuna.Study) -> dict[Key, dict[str, Any]]:
    """All parameters, and which seed is trained."""
    return {key_of(trial): trial.params | {"seed": AuxLossSampler.seed_index(trial)} for trial in study.trials}


def filled_slots(study: optuna.Study) -> list[tuple[int, int]]:
    return sorted(key_of(trial)[:2] for trial in study.trials if trial.state in (TrialState.COMPLETE, TrialState.PRUNED))


def all_slots(first: int, later: int, n_generations: int) -> list[tuple[int, int]]:
    return [(number, slot) for number in range(1, n_generations + 1) for slot in range(first if number == 1 else later)]


def test_the_paper_s_shares_and_sizes() -> None:
    sampler = AuxLossSampler()
    assert Counter(sampler.operations(1)) == {"random": 100, "prior": 25}
    shares = {"random": 20, "replacement": 50, "crossover": 20, "horizon_change": 10}
    assert Counter(sampler.operations(2)) == Counter(sampler.operations(7)) == shares


@pytest.mark.parametrize("population_size", [1, 4, 7, 8, 10, 33, 100])
def test_shares_are_as_exact_as_whole_numbers_can_be(population_size: int) -> None:
    operations = AuxLossSampler(population_size=population_size).operations(2)
    assert len(operations) == population_size
    for name, share in {"random": 0.2, "replacement": 0.5, "crossover": 0.2, "horizon_change": 0.1}.items():
        assert abs(operations.count(name) - share * population_size) < 1
    assert operations == sorted(operations, key=lambda name: name != "random")  # what needs no parents comes first


Row = tuple[AuxLoss, str, list[tuple[int, int]]]  # loss, operation, generations and slots of the parents
Ranked = tuple[float, int, AuxLoss]  # score, slot, loss


def reference(settings: dict[str, Any], sign: float) -> list[list[Row]]:
    """The evolution as the design has it, one slot after the other."""
    seen: set[AuxLoss] = set()
    population: list[Ranked] = []
    generations: list[list[Row]] = []
    for number in range(1, settings["n_generations"] + 1):
        parents = sorted(population, key=lambda row: (-row[0], row[1]))[: round(0.25 * len(population))]
        generation: list[Row] = []
        for slot, operation in enumerate(AuxLossSampler(**settings).operations(number)):
            rng = np.random.default_rng([settings["seed"], number, slot, 0])
            # A random slot is drawn before the results of the last generation are known.
            known = generations[: number - 1 - (operation == "random")]
            drawn: list[tuple[AuxLoss, list[int]]] = []
            while len(drawn) < (settings["screening"] if known else 1):
                with contextlib.suppress(ValueError):
                    candidate = offspring(rng, operation, slot, parents, settings["max_horizon"])
                    drawn += [candidate] * (candidate[0].canonical() not in seen)
            loss, mothers = drawn[0]
            if known and settings["screening"] > 1:
                model = fitted(known, settings["max_horizon"], sign)
                loss, mothers = drawn[int(np.argmax(model.draw([loss for loss, _ in drawn], rng, own=False)))]
                optimism = abs(rng.standard_normal())
                for _ in range(settings["climbing"]):
                    loss = next((other for other in model.higher(loss, optimism) if other not in seen), loss)
            seen.add(loss.canonical())
            generation.append((loss, operation, [(number - 1, mother) for mother in mothers]))
        population = [(sign * score(loss), slot, loss) for slot, (loss, _, _) in enumerate(generation)]
        generations.append(generation)
    return generations


def offspring(
    rng: np.random.Generator, operation: str, slot: int, parents: list[Ranked], max_horizon: int
) -> tuple[AuxLoss, list[int]]:
    if operation == "random":
        return random_loss(rng, max_horizon), []
    if operation == "prior":
        return PRIORS[slot % 2](rng, max_horizon), []
    _, mother, loss = parents[rng.integers(len(parents))]
    if operation == "replacement":
        return mutations.replacement(loss, rng), [mother]
    if operation == "horizon_change":
        return mutations.horizon_change(loss, rng, max_horizon), [mother]
    partners = [(at, other) for _, at, other in parents if at != mother and other.horizon == loss.horizon]
    if not partners:
        raise ValueError
    father, other = partners[rng.integers(len(partners))]
    return mutations.crossover(loss, other, rng), [mother, father]


def fitted(known: list[list[Row]], max_horizon: int, sign: float) -> TokenModel:
    losses = [loss for generation in known for loss, _, _ in generation]
    model = TokenModel(max_horizon)
    model.add(losses, [sign * score(loss) for loss in losses])
    return model


@pytest.mark.parametrize(("screening", "climbing"), [(1, 0), (4, 0), (4, 3)])
@pytest.mark.parametrize("direction", ["maximize", "minimize"])
def test_a_search_is_the_evolution_of_the_design(
    direction: Literal["maximize", "minimize"], screening: int, climbing: int
) -> None:
    settings = {"population_size": 20, "n_random": 40, "n_prior": 9, "max_horizon": 6, "n_generations": 3, "seed": 5}
    settings |= {"screening": screening, "climbing": climbing}
    study = run(make_study(direction, **settings))
    expected = reference(settings, 1.0 if direction == "maximize" else -1.0)
    assert filled_slots(study) == all_slots(49, 20, 3)
    slot_of = {trial.number: key_of(trial)[:2] for trial in study.trials}
    for trial in study.trials:
        generation, slot, attempt = key_of(trial)
        lineage = [slot_of[number] for number in trial.user_attrs["parents"]]
        assert (loss_of(trial), trial.user_attrs["operation"], lineage) == expected[generation - 1][slot]
        assert attempt == 0 and trial.params["horizon"] <= 6
    forms = [loss.canonical() for loss in losses_of(study).values() if loss is not None]
    assert len(set(forms)) == len(study.trials)


def test_equal_scores_go_by_slot_and_pruned_or_infinite_ones_come_last() -> None:
    def parents(share: float) -> set[int]:
        study = make_study(
            population_size=40, n_random=8, n_prior=0, parents=share, replacement=1.0, crossover=0, horizon_change=0, random=0
        )
        trials = [study.ask() for _ in range(8)]
        for trial in trials:
            suggest_aux_loss(trial, 2)
        # Told backwards; the pruned one has the best score by far, two are equal.
        for slot, value in {7: np.inf, 6: 3.0, 5: 3.0, 4: 0.0, 3: 9.0, 2: -1.0, 1: 4.0, 0: 2.0}.items():
            trials[slot].report(value, 1)
            is_pruned = slot == 3
            study.tell(trials[slot], None if is_pruned else value, TrialState.PRUNED if is_pruned else None)
        return {number for _ in range(40) for number in study.ask().user_attrs["parents"]}

    assert parents(0.25) == {1, 5}
    assert parents(0.75) == {1, 5, 6, 0, 4, 2}


def test_after_a_generation_without_scores_the_parents_are_those_of_before() -> None:
    study = make_study(n_generations=3)
    while not sampler_of(study).is_complete(study):
        trial = study.ask()
        loss = suggest_aux_loss(trial, 2)
        is_pruned = trial.user_attrs["generation"] == 2
        study.tell(trial, None if is_pruned else score(loss), TrialState.PRUNED if is_pruned else None)
    parents = [
        {number for trial in study.trials if trial.user_attrs["generation"] == i for number in trial.user_attrs["parents"]}
        for i in (2, 3)
    ]
    assert parents[0] >= parents[1] != set()


def test_initial_losses_are_the_first_slots() -> None:
    losses = [WANTED, AuxLoss.parse("{s_t} -> {r_t}"), AuxLoss.parse("{s_t+1} -> {r_t+1}")]  # the last is the second again
    study = make_study(initial=losses, n_random=2, n_prior=1)
    assert sampler_of(study).operations(1) == ["given", "given", "random", "random", "prior"]
    trials = [study.ask() for _ in range(5)]
    drawn = [suggest_aux_loss(trial, 2) for trial in trials]
    assert [loss.canonical() for loss in drawn[:2]] == losses[:2]
    assert [trial.user_attrs["operation"] for trial in trials] == sampler_of(study).operations(1)
    study.tell(trials[0], state=TrialState.FAIL)  # a random one takes its slot
    again = study.ask()
    assert suggest_aux_loss(again, 2) not in drawn
    assert (key_of(again), again.user_attrs["operation"]) == ((1, 0, 1), "random")
    assert sampler_of(make_study(initial=losses, allow_duplicates=True)).operations(1).count("given") == 3
    named = make_study(initial=["forward-dynamics", *losses[1:]], n_random=0, n_prior=0)
    assert filled_slots(run(named)) == all_slots(2, 12, 3)


def test_processes_that_ask_at_the_same_moment_get_different_slots() -> None:
    study = make_study()
    for _ in range(2):  # two others have their trials, and no slots yet
        study._storage.create_new_trial(study._study_id)
    last, others = study.ask(), study.get_trials()[:2]
    for trial in others:
        AuxLossSampler(**SMALL).before_trial(study, trial)
    assert [key_of(trial) for trial in (*others, last)] == [(1, 0, 0), (1, 1, 0), (1, 2, 0)]


@pytest.mark.parametrize("screening", [1, 4])
def test_a_tiny_space_ends_with_duplicates_rather_than_not_at_all(screening: int) -> None:
    study = run(make_study(population_size=4, n_random=170, n_prior=10, max_horizon=1, n_generations=2, screening=screening))
    assert filled_slots(study) == all_slots(180, 4, 2)
    masks = list(np.ndindex(2, 2, 2, 2))
    valid = {AuxLoss(1, s, t).canonical() for s in masks for t in masks if (s[0] or s[3]) and any(t)}
    forms = {loss.canonical() for loss in losses_of(study).values() if loss is not None}
    assert forms <= valid and len(forms) > 0.9 * len(valid)


def test_without_two_parents_of_one_horizon_a_crossover_becomes_a_replacement() -> None:
    study = make_study(n_random=1, n_prior=0, population_size=4, crossover=1.0, replacement=0, horizon_change=0, random=0)
    run(study)
    operations = [trial.user_attrs["operation"] for trial in study.trials if trial.user_attrs["generation"] == 2]
    assert operations == ["replacement"] * 4


def simulate(seed: int, n_running: int, **settings: Any) -> optuna.Study:
    """
    A search with trials that finish in any order. Some losses always fail, others are pruned; trials are interrupted, and the
    program is restarted, now and then.
    """
    rng = np.random.default_rng(seed)
    study = make_study(**settings)
    running: list[optuna.Trial] = []
    while not sampler_of(study).is_complete(study):
        if len(running) < n_running and sampler_of(study).free_slots(study) and (not running or rng.random() < 0.6):
            running.append(study.ask())
            suggest_aux_loss(running[-1], 2)
            running[-1].suggest_float("rate", 0, 1)
            continue
        trial = running.pop(rng.integers(len(running)))
        loss = params_to_loss(trial.params)
        outcome = (lot(loss, 5) + AuxLossSampler.seed_index(trial)) % 5
        if n_running > 1 and rng.random() < 0.1:
            trial.set_user_attr("interrupted", True)
            study.tell(trial, state=TrialState.FAIL)
        elif outcome == 0:
            study.tell(trial, state=TrialState.FAIL)
        elif outcome == 1:
            trial.report(score(loss), 1)
            study.tell(trial, state=TrialState.PRUNED)
        else:
            study.tell(trial, score(loss))
        if n_running > 1 and rng.random() < 0.05:
            study.sampler = AuxLossSampler(**{**SMALL, **settings, "seed": None})
    assert sampler_of(study).free_slots(study) == 0
    return study


SIMULATED: list[dict[str, Any]] = [
    {},
    {"screening": 3},
    {"again": 0.3, "parent_selection": "posterior", "screening": 2, "climbing": 3},
]


@cache
def simulate_alone(at: int) -> optuna.Study:
    return simulate(0, 1, **SIMULATED[at])


@pytest.mark.slow
@hypothesis_settings(max_examples=20, deadline=None)
@given(st.integers(0, 10**6), st.integers(2, 9), st.sampled_from(range(3)))
def test_no_order_in_which_trials_finish_changes_a_trial(seed: int, n_running: int, at: int) -> None:
    study, alone = simulate(seed, n_running, **SIMULATED[at]), simulate_alone(at)
    assert params_of(study) == params_of(alone)
    by_key = {key_of(trial): trial for trial in study.trials}.values()
    runs = [(params_to_loss(trial.params).canonical(), AuxLossSampler.seed_index(trial)) for trial in by_key]
    assert len(set(runs)) == len(runs)  # nor does a candidate that replaces a failed one repeat another
    # An interrupted trial comes again with its loss, and no slot is filled twice.
    assert filled_slots(study) == filled_slots(alone) == all_slots(12, 12, 3)
    interrupted = [trial for trial in study.trials if "interrupted" in trial.user_attrs]
    assert len(study.trials) == len(alone.trials) + len(interrupted)
    for trial in interrupted:
        again = [other for other in study.trials if key_of(other) == key_of(trial)]
        assert len({str(sorted(other.params.items())) for other in again}) == 1
        assert len({other.user_attrs["operation"] for other in again}) == 1


TINY: dict[str, Any] = {"population_size": 3, "n_random": 2, "n_prior": 1, "max_horizon": 1, "n_generations": 2}


def work(url: str, n_trials: int) -> None:
    """What a process does: a study from a file, with a sampler of its own."""
    study = make_study(storage=url, **TINY)
    stop = sampler_of(study).stop_when_complete
    study.optimize(lambda trial: score(suggest_aux_loss(trial, 1)), n_trials, callbacks=[stop])


@pytest.mark.slow
def test_two_processes_on_one_study_neither_wait_nor_break(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/study.db"
    study = make_study(storage=url, **TINY)
    processes = [get_context("spawn").Process(target=work, args=(url, 100)) for _ in range(2)]
    for process in processes:
        process.start()
    for process in processes:
        process.join(300)
    assert [process.exitcode for process in processes] == [0, 0]
    assert set(filled_slots(study)) >= set(all_slots(3, 3, 2)) and len(study.trials) < 50
    # Both may have drawn for one slot: then they drew one loss.
    first = [(key_of(trial), loss_of(trial)) for trial in study.trials if key_of(trial)[0] == 1 and key_of(trial)[1] < 3]
    alone = losses_of(run(make_study(**TINY)))
    assert all(alone[key] == loss for key, loss in first)


def test_without_a_seed_the_study_keeps_the_first_one() -> None:
    study = make_study(seed=None)
    for _ in range(30):
        trial = study.ask()
        study.tell(trial, score(suggest_aux_loss(trial, 2)))
        study.sampler = AuxLossSampler(**{**SMALL, "seed": None})
    undisturbed = make_study(storage=study._storage, seed=3)  # another seed is not taken
    assert losses_of(run(undisturbed)).items() >= losses_of(study).items()
    assert losses_of(run(make_study(seed=None))) != losses_of(study)


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda sampler: pickle.loads(pickle.dumps(sampler))])
def test_a_copied_sampler_resumes(duplicate: Callable[[AuxLossSampler], AuxLossSampler]) -> None:
    study = make_study()
    for _ in range(20):
        trial = study.ask()
        study.tell(trial, score(suggest_aux_loss(trial, 2)))
    study.sampler = duplicate(sampler_of(study))
    assert losses_of(run(study)) == losses_of(run(make_study()))


def test_threads_fill_every_slot_and_end() -> None:
    study = make_study()
    study.optimize(
        lambda trial: score(suggest_aux_loss(trial, 2)),
        n_trials=200,
        n_jobs=4,
        callbacks=[sampler_of(study).stop_when_complete],
    )
    assert sampler_of(study).is_complete(study) and len(study.trials) < 100
    assert set(filled_slots(study)) >= set(all_slots(12, 12, 3))
    assert len(losses_of(study)) == len(study.trials)  # no slot twice
    alone = losses_of(run(make_study()))
    assert all(loss == alone[key] for key, loss in losses_of(study).items() if key[0] == 1 and key[1] < 12)


def test_random_slots_of_the_next_generation_come_while_this_one_ends() -> None:
    study = make_study(n_generations=2, population_size=10, n_random=5, n_prior=1)
    sampler = sampler_of(study)
    assert sampler.free_slots(study) == 8
    trials = [study.ask() for _ in range(8)]
    assert [key_of(trial)[:2] for trial in trials] == [*all_slots(6, 0, 1), (2, 0), (2, 1)]
    assert sampler.free_slots(study) == 0 and not sampler.is_complete(study)
    assert sampler.progress(study) == [GenerationProgress(1, 6, 0, 6, 0), GenerationProgress(2, 10, 0, 2, 0)]
    for trial in trials[:6]:
        study.tell(trial, score(suggest_aux_loss(trial, 2)))
    assert sampler.free_slots(study) == 8
    study.tell(trials[6], state=TrialState.FAIL)
    trials[7].set_user_attr("interrupted", True)
    study.tell(trials[7], state=TrialState.FAIL)
    assert sampler.progress(study) == [GenerationProgress(1, 6, 6, 0, 0), GenerationProgress(2, 10, 0, 0, 1)]
    assert sampler.free_slots(study) == 10
    assert [key_of(study.ask()) for _ in range(2)] == [(2, 0, 1), (2, 1, 0)]
    run(study)
    assert sampler.free_slots(study) == 0 and not sampler.is_complete(study)  # the two still run
    for unfinished in study.get_trials(states=[TrialState.RUNNING]):
        study.tell(unfinished.number, 0.0)
    assert sampler.is_complete(study) and sampler.free_slots(study) == 0


def test_an_ask_beyond_the_free_slots_gets_one_more_offspring() -> None:
    study = make_study(population_size=5, n_random=3, n_prior=1, random=0.2, replacement=0.5)
    trials = [study.ask() for _ in range(8)]
    losses = [suggest_aux_loss(trial, 2) for trial in trials]
    assert [key_of(trial)[:2] for trial in trials] == [*all_slots(4, 0, 1), (2, 0), (1, 4 + 5), (1, 4 + 6), (1, 4 + 7)]
    assert [trial.user_attrs["parents"] for trial in trials] == [[]] * 8
    assert len({loss.canonical() for loss in losses[:5]}) == 5
    study.tell(trials[6], 100.0)  # the best, and before the generation is over
    for trial in trials[:4]:
        study.tell(trial, 0.0)
    study.tell(trials[7], 200.0)  # too late
    later = [study.ask() for _ in range(9)]
    assert {number for trial in later for number in trial.user_attrs["parents"]} == {6}
    assert [key_of(trial)[:2] for trial in later] == [(2, 1), (2, 2), (2, 3), (2, 4), (3, 0)] + [
        (2, 5 + n) for n in range(13, 17)
    ]
    assert [progress[1:] for progress in sampler_of(study).progress(study)] == [(4, 4, 0, 0), (5, 0, 5, 0), (5, 0, 1, 0)]
    # It is drawn by the number of its trial, and is not drawn again when it fails.
    study.tell(later[-1], state=TrialState.FAIL)
    assert key_of(study.ask()) == (2, 5 + 17, 0)


def test_a_trial_that_ends_after_its_generation_is_known_in_the_next_ones() -> None:
    study = make_study(population_size=4, n_random=4, n_prior=0, random=0, replacement=0.7, parent_selection="posterior")
    trials = [study.ask() for _ in range(5)]  # one more than there are slots
    losses = [suggest_aux_loss(trial, 2) for trial in trials]
    for trial in trials[1:]:
        study.tell(trial, 0.0)
    study.tell(trials[0], 100.0)  # its generation is over
    for _ in range(4):
        trial = study.ask()
        assert trial.user_attrs["generation"] == 2 and trial.user_attrs["parents"] != [0]
        suggest_aux_loss(trial, 2)
        study.tell(trial, 0.0)
    trial = study.ask()
    assert trial.user_attrs["generation"] == 3 and trial.user_attrs["parents"] == [0]
    assert suggest_aux_loss(trial, 2) not in losses


def test_what_a_user_fixes_is_kept_beside_an_interrupted_trial() -> None:
    study = make_study()
    trial = study.ask()
    drawn = suggest_aux_loss(trial), trial.suggest_float("rate", 0, 1)
    trial.set_user_attr("interrupted", True)
    study.tell(trial, state=TrialState.FAIL)
    study.enqueue_trial({"rate": 0.25})
    fixed, again = ((suggest_aux_loss(trial), trial.suggest_float("rate", 0, 1)) for trial in (study.ask(), study.ask()))
    assert fixed[1] == 0.25 and fixed[0] != drawn[0] and again == drawn


def test_a_trial_that_stays_running_holds_up_no_generation() -> None:
    study = make_study(population_size=np.int64(12), storage=RDBStorage("sqlite:///:memory:"))  # NumPy's numbers are numbers
    suggest_aux_loss(study.ask())
    study.optimize(lambda trial: score(suggest_aux_loss(trial)), 100, callbacks=[sampler_of(study).stop_when_complete])
    assert len(study.trials) == 1 + 3 * 12
    assert sampler_of(study).progress(study)[0] == GenerationProgress(1, 12, 12, 1, 0)
    assert make_study(storage=study._storage).ask().user_attrs["generation"] == 3


def test_after_the_last_generation_asking_still_works() -> None:
    study = run(make_study(n_generations=1))
    trial = study.ask()
    suggest_aux_loss(trial, 2)
    assert key_of(trial) == (1, 12 + 12, 0)
    longer = make_study(storage=study._storage, n_generations=2)
    assert sampler_of(longer).free_slots(longer) == 12
    run(longer)
    assert [row.filled for row in sampler_of(longer).progress(longer)] == [12, 12]


def test_the_first_finished_trial_of_a_slot_counts() -> None:
    """Two processes drew for one slot; the one that asked later was faster."""
    study = make_study(n_random=1, n_prior=0, population_size=4, random=0, replacement=0.7)
    suggest_aux_loss(study.ask(), 2)
    study.add_trial(study.trials[0])
    for number in (1, 0):
        study.tell(number, 1.0)
        assert study.ask().user_attrs["parents"] == [1]


def test_trials_of_other_samplers_and_studies_have_no_slots() -> None:
    study = make_study()
    study.add_trials(run(make_study(seed=1)).trials)
    other = optuna.load_study(study_name="study", storage=study._storage, sampler=optuna.samplers.RandomSampler(seed=0))
    other.ask().suggest_float("x", 0, 1)
    other.tell(other.ask(), 1.0)
    other.add_trial(optuna.create_trial(params={}, distributions={}, value=3.0))
    assert [key_of(study.ask())[:2] for _ in range(2)] == [(1, 0), (1, 1)]


def test_a_deleted_study_that_is_created_again_has_its_own_slots() -> None:
    storage = RDBStorage("sqlite:///:memory:")  # the second study has the number of the first
    sampler = sampler_of(make_study(n_random=3, n_prior=1))
    for _ in range(2):
        study = optuna.create_study(storage=storage, study_name="again", sampler=sampler, direction="maximize")
        assert [key_of(study.ask())[:2] for _ in range(4)] == all_slots(4, 0, 1)
        optuna.delete_study(study_name="again", storage=storage)


def test_a_copy_of_a_trial_whose_heartbeat_stopped_keeps_its_slot() -> None:
    study = make_study()
    loss = suggest_aux_loss(study.ask(), 2)
    failed = study.tell(0, state=TrialState.FAIL)
    with pytest.warns(optuna.exceptions.ExperimentalWarning):
        RetryHeartbeatStaleTrialCallback()(study, failed)
    again = study.ask()
    assert (key_of(again), suggest_aux_loss(again, 2)) == ((1, 0, 0), loss)
    study.tell(again, 0.0)
    assert losses_of(run(study)).keys() >= losses_of(run(make_study())).keys()


def test_an_enqueued_loss_is_trained_in_a_random_slot() -> None:
    study = make_study(n_generations=2, n_random=2, n_prior=2)
    for _ in range(4):
        trial = study.ask()
        study.tell(trial, score(suggest_aux_loss(trial, 2)))
    study.enqueue_trial(loss_to_params(WANTED))
    study.enqueue_trial({"horizon": 2, "source/s_t": True, "target/r_t+1": True})
    trials = [study.ask() for _ in range(2)]
    assert suggest_aux_loss(trials[0], 2) == WANTED
    partly = suggest_aux_loss(trials[1], 2)
    assert (partly.horizon, partly.source[0], partly.target[5]) == (2, True, True)
    for trial in trials:
        assert key_of(trial)[0] == 2 and sampler_of(study).operations(2)[key_of(trial)[1]] == "random"
        assert (trial.user_attrs["operation"], trial.user_attrs["parents"]) == ("enqueued", [])
        study.tell(trial, 100.0)
    run(study)
    assert filled_slots(study) == all_slots(4, 12, 2)
    operations = [trial.user_attrs["operation"] for trial in study.trials if key_of(trial)[0] == 2]
    assert operations.count("random") == sampler_of(study).operations(2).count("random") - 2


@pytest.mark.parametrize(
    "given",
    [loss_to_params(WANTED), {"horizon": 2, "source/s_t": True, "target/r_t": True, "rate": 0.25}],
    ids=["whole", "partial"],
)
@pytest.mark.parametrize("suggests", [True, False])
def test_an_interrupted_enqueued_trial_comes_again(given: dict[str, Any], suggests: bool) -> None:
    study = make_study()
    study.enqueue_trial(given)
    trials, losses = [], []
    for ends in ("interrupted", "interrupted", "fails", ""):
        trials.append(trial := study.ask())
        if suggests or len(trials) > 1:
            losses.append((suggest_aux_loss(trial, 2), trial.suggest_float("rate", 0, 1)))
        trial.set_user_attr("interrupted" if ends == "interrupted" else "x", True)
        study.tell(trial, state=TrialState.FAIL)
    assert [key_of(trial) for trial in trials] == [(1, 0, 0), (1, 0, 0), (1, 0, 0), (1, 0, 1)]
    assert [trial.user_attrs["operation"] for trial in trials] == ["enqueued"] * 3 + ["random"]
    assert len(set(losses[:-1])) == 1 and losses[-1] not in losses[:-1]
    assert given.items() <= {**loss_to_params(losses[0][0]), "rate": losses[0][1] if "rate" in given else None}.items()


def test_an_interrupted_trial_keeps_what_another_sampler_drew() -> None:
    study = make_study(independent_sampler=optuna.samplers.RandomSampler())
    params = []
    for _ in range(3):
        trial = study.ask()
        suggest_aux_loss(trial)
        trial.suggest_float("rate", 0, 1)
        params.append(trial.params)
        trial.set_user_attr("interrupted", True)
        study.tell(trial, state=TrialState.FAIL)
    assert params == params[:1] * 3


def test_promising_losses_run_again_with_their_next_seeds() -> None:
    study = make_study(again=0.4, population_size=10, n_generations=6)
    seeds: dict[AuxLoss, list[int]] = {}
    while sampler_of(study).free_slots(study):
        trial = study.ask()
        loss = suggest_aux_loss(trial)
        study.tell(trial, score(loss) + trial.suggest_float("rate", 0, 1e-3))
        seeds.setdefault(loss.canonical(), []).append(AuxLossSampler.seed_index(trial))
        if trial.user_attrs["operation"] == "again":
            (number,) = trial.user_attrs["parents"]
            assert trial.params == study.trials[number].params
            assert study.trials[number].user_attrs["generation"] < trial.user_attrs["generation"]
    assert [sampler_of(study).operations(2).count(name) for name in ("again", "replacement", "random")] == [4, 3, 1]
    assert all(indices == list(range(len(indices))) for indices in seeds.values())
    assert sum(len(indices) - 1 for indices in seeds.values()) == 5 * 4
    repeated = [score(loss) for loss, indices in seeds.items() for _ in indices[1:]]
    assert np.mean(repeated) > np.quantile([score(loss) for loss in seeds], 0.8)


def test_scores_that_are_too_large_for_the_surrogate_choose_parents() -> None:
    settings: dict[str, Any] = {"again": 0.3, "parent_selection": "posterior", "screening": 2, "n_generations": 2}
    assert filled_slots(run(make_study(**settings), lambda loss: 1e200 * score(loss))) == all_slots(12, 12, 2)


def test_other_parameters_are_inherited_or_left_to_another_sampler() -> None:
    def rates(**settings: Any) -> tuple[list[float], list[set[float]]]:
        """Of the offspring, and of the parents of each."""
        study = make_study(population_size=40, n_generations=2, random=0, replacement=0.7, **settings)
        while sampler_of(study).free_slots(study):
            trial = study.ask()
            trial.suggest_float("rate", 0, 1)
            trial.suggest_categorical("operator", ["adam", "sgd"])  # the user's own, not the loss's
            study.tell(trial, score(suggest_aux_loss(trial)))
        offspring = [trial for trial in study.trials if trial.user_attrs["parents"]]
        of_parents = [{study.trials[number].params["rate"] for number in trial.user_attrs["parents"]} for trial in offspring]
        return [trial.params["rate"] for trial in offspring], of_parents

    inherited, of_parents = rates()
    is_kept = [rate in parents for rate, parents in zip(inherited, of_parents, strict=True)]
    assert len(inherited) == 40 and 10 < sum(is_kept) < 30
    grid = {"rate": [i / 100 for i in range(100)], "operator": ["adam", "sgd"]}
    assert set(rates(independent_sampler=optuna.samplers.GridSampler(grid))[0]) <= {*grid["rate"]}


def test_trials_may_be_pruned_before_the_loss_and_its_parameters_fixed() -> None:
    study = make_study(n_generations=2)
    sampler, fixed = sampler_of(study), {"horizon": 2, "target/r_t": True}
    with pytest.warns(optuna.exceptions.ExperimentalWarning):
        study.sampler = optuna.samplers.PartialFixedSampler(fixed, sampler)

    def objective(trial: optuna.Trial) -> float:
        if trial.suggest_float("rate", 0, 1) < 0.5:
            raise optuna.TrialPruned
        return score(suggest_aux_loss(trial, 2))

    study.optimize(objective, n_trials=200, callbacks=[sampler.stop_when_complete])
    complete = study.get_trials(states=(TrialState.COMPLETE,))
    assert len(complete) == 24 < len(study.trials) < 200
    assert all(fixed.items() <= trial.params.items() for trial in complete)


class Holding(optuna.samplers.BaseSampler):
    """A sampler around another one. It passes on the three methods that a sampler must have, or one, as CmaEsSampler does."""

    def __init__(self, held: AuxLossSampler, passes_relative: bool) -> None:
        self.held, self.passes_relative = held, passes_relative

    def infer_relative_search_space(self, study: Any, trial: Any) -> Any:
        return self.held.infer_relative_search_space(study, trial) if self.passes_relative else {}

    def sample_relative(self, study: Any, trial: Any, search_space: Any) -> Any:
        return self.held.sample_relative(study, trial, search_space) if self.passes_relative else {}

    def sample_independent(self, *arguments: Any) -> Any:
        return self.held.sample_independent(*arguments)


WRAPPERS: dict[str, Callable[[AuxLossSampler], optuna.samplers.BaseSampler]] = {
    "partly fixed": lambda sampler: optuna.samplers.PartialFixedSampler({"rate": 0.5}, sampler),
    "holding": lambda sampler: Holding(sampler, True),
    "independent": lambda sampler: Holding(sampler, False),
}


@pytest.mark.filterwarnings("ignore::optuna.exceptions.ExperimentalWarning")
@pytest.mark.parametrize("max_horizon", [2, 12])
@pytest.mark.parametrize("wrapper", WRAPPERS)
def test_a_sampler_that_is_held_by_another_trains_what_is_recorded(wrapper: str, max_horizon: int) -> None:
    settings: dict[str, Any] = {
        "operators": ("cosine", "inner"),
        "max_horizon": max_horizon,
        "n_generations": 2,
        "again": 0.25,
    }
    study = make_study(**settings)
    sampler, trained = sampler_of(study), {}
    study.sampler = WRAPPERS[wrapper](sampler)

    def objective(trial: optuna.Trial) -> float:
        trial.suggest_float("rate", 0, 1)
        trained[trial.number] = suggest_aux_loss(trial)  # it is not told the space
        return score(trained[trial.number])

    study.optimize(objective, n_trials=100, callbacks=[sampler.stop_when_complete])
    assert set(filled_slots(study)) == set(all_slots(12, 12, 2))
    assert {number: loss_of(study.trials[number]) for number in trained} == trained
    assert {loss.operator for loss in trained.values()} == {"cosine", "inner"}
    if wrapper != "independent":  # which draws the horizon before it has a slot
        assert max(loss.horizon for loss in trained.values()) > max_horizon - 2
    if wrapper == "holding":
        assert losses_of(study) == losses_of(run(make_study(**settings)))


def test_a_fixed_horizon_that_is_too_long_is_pruned() -> None:
    study = make_study()
    with pytest.warns(optuna.exceptions.ExperimentalWarning):
        study.sampler = optuna.samplers.PartialFixedSampler({"horizon": 5}, study.sampler)
    with pytest.warns(UserWarning, match="out of range"), pytest.raises(optuna.TrialPruned, match="horizon is 5"):
        suggest_aux_loss(study.ask())


def test_trials_that_violate_a_constraint_are_no_parents_and_not_known_to_the_model() -> None:
    def search(shift: float) -> optuna.Study:
        study = make_study(screening=4, population_size=20)

        def objective(trial: optuna.Trial) -> float:
            loss = suggest_aux_loss(trial)
            is_feasible = lot(loss, 2) == 0
            trial.set_constraint("seconds", 0.0 if is_feasible else 1.0)
            return score(loss) + (0.0 if is_feasible else shift)

        study.optimize(objective, callbacks=[sampler_of(study).stop_when_complete])
        return study

    study = search(100.0)
    infeasible = {trial.number for trial in study.trials if any(value > 0 for value in trial.constraints.values())}
    parents = {number for trial in study.trials for number in trial.user_attrs["parents"]}
    assert len(infeasible) > 10 and parents and not parents & infeasible
    assert losses_of(study) == losses_of(search(-100.0))


def test_the_last_report_of_a_pruned_trial_is_no_score() -> None:
    def search(last: float) -> optuna.Study:
        study = make_study(screening=4, n_generations=2)
        for _ in range(24):
            trial = study.ask()
            loss = suggest_aux_loss(trial)
            trial.report(last, 1)
            is_pruned = lot(loss, 3) == 0
            study.tell(trial, None if is_pruned else score(loss), TrialState.PRUNED if is_pruned else None)
        return study

    assert losses_of(search(1000.0)) == losses_of(search(0.0))


def test_trials_that_are_enqueued_with_a_part_of_their_parameters_differ() -> None:
    study = make_study(n_random=20, n_prior=0)
    for _ in range(12):
        study.enqueue_trial({"horizon": 1})
    study.optimize(lambda trial: score(suggest_aux_loss(trial)), n_trials=12)
    assert len({tuple(sorted(trial.params.items())) for trial in study.trials}) > 9  # of 256


def test_a_trial_that_is_enqueued_without_its_loss_has_that_of_its_slot() -> None:
    study = make_study()
    study.enqueue_trial({"rate": 0.25})
    trial = study.ask()
    assert trial.suggest_float("rate", 0, 1) == 0.25
    suggest_aux_loss(trial)
    study.tell(trial, 0.0)
    assert losses_of(study).items() <= losses_of(run(make_study())).items()


@pytest.mark.parametrize("pruner", [optuna.pruners.MedianPruner(3), optuna.pruners.HyperbandPruner(1, 9)])
def test_pruners_work(pruner: optuna.pruners.BasePruner) -> None:
    study = make_study()
    study.pruner = pruner

    def objective(trial: optuna.Trial) -> float:
        value = score(suggest_aux_loss(trial, 2))
        for step in range(9):
            trial.report(value, step)
            if trial.should_prune():
                raise optuna.TrialPruned
        return value

    study.optimize(objective, n_trials=100, callbacks=[sampler_of(study).stop_when_complete])
    assert filled_slots(study) == all_slots(12, 12, 3)
    assert any(trial.state == TrialState.PRUNED for trial in study.trials)


OTHER_SETTINGS = {
    "population_size": 13, "n_random": 9, "n_prior": 3, "parents": 0.5, "max_horizon": 3, "operators": ("mse", "inner"),
    "allow_duplicates": True, "screening": 2, "initial": [WANTED], "again": 0.5, "parent_selection": "posterior",
    "climbing": 1,
}  # fmt: skip


@pytest.mark.parametrize(("name", "value"), OTHER_SETTINGS.items())
def test_a_study_does_not_resume_with_other_settings(name: str, value: Any) -> None:
    study = make_study()
    study.ask()
    with pytest.raises(ValueError, match=f"started with {name}="):
        make_study(storage=study._storage, **{name: value}).ask()
    with pytest.raises(ValueError, match=r"started with replacement=0\.5, not 0\.4"):
        make_study(storage=study._storage, replacement=0.4, random=0.3).ask()
    # One of an older version, which had fewer settings.
    stored = {key: value for key, value in AuxLossSampler.stored_settings(study).items() if key != name}
    study._storage.set_study_system_attr(study._study_id, SETTINGS_KEY, stored)
    if name in ("again", "parent_selection", "climbing"):
        make_study(storage=study._storage).ask()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"population_size": 0}, "population_size must be at least 1, not 0"),
        ({"n_random": 0, "n_prior": 0}, "n_random, n_prior and initial must not all be empty"),
        ({"n_generations": 0}, "n_generations must be at least 1"),
        ({"n_random": -1, "n_prior": 5}, "n_random must be at least 0"),
        ({"crossover": -0.2, "random": 0.6}, "crossover must be at least 0"),
        ({"random": float("nan")}, "random must be at least 0"),
        ({"random": 0.3}, "must sum to 1, not 1.1"),
        ({"parents": 1.5}, "parents and again must be shares"),
        ({"again": 1.5}, "parents and again must be shares"),
        ({"parent_selection": "mean"}, "parent_selection must be best or posterior, not 'mean'"),
        ({"operators": ("l2",)}, "'l2' is not"),
        ({"seed": -1}, "seed must be at least 0"),
        ({"seed": 1.5}, "seed must be a whole number, not 1.5"),
        ({"initial": [WANTED], "operators": ["inner"]}, "not in the space"),
        ({"initial": [AuxLoss.parse("{s_t} -> {s_t+3}")], "max_horizon": 2}, "longer than 2"),
    ],
)
def test_settings_that_do_not_fit_are_named(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        AuxLossSampler(**settings)


def test_several_objectives_are_refused() -> None:
    study = optuna.create_study(directions=["maximize", "minimize"], sampler=AuxLossSampler(seed=0))
    with pytest.raises(RuntimeError, match="multi-objective"):
        study.ask()


def test_a_study_whose_objective_has_no_loss_is_refused() -> None:
    study = make_study(n_random=1, n_prior=0, random=0, replacement=0.7)
    study.tell(study.ask(), 1.0)
    with pytest.raises(RuntimeError, match="suggest_aux_loss"):
        study.ask()
