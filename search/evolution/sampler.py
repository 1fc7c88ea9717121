"""AuxLossSampler: the paper's evolution of auxiliary losses (section 2.2, A.3) as a sampler of Optuna."""

import contextlib
import logging
import math
import threading
import zlib
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from optuna.distributions import BaseDistribution
from optuna.samplers import BaseSampler, RandomSampler
from optuna.study import Study, StudyDirection
from optuna.trial import FrozenTrial, TrialState

from sb3_aarl.aux_loss import AuxLoss
from search.evolution import mutations, space
from search.evolution.space import MAX_HORIZON, check_operators, loss_of
from search.evolution.surrogate import TokenModel

logger = logging.getLogger(__name__)

# System attributes: of a trial, its slot and its loss, written in one piece; of a study, the sampler's settings and seed.
SLOT_KEY = "AuxLossSampler:slot"
SETTINGS_KEY = "AuxLossSampler:settings"
# Optuna's: what study.enqueue_trial was given.
FIXED_KEY = "fixed_params"
# Draws for one slot before a duplicate is accepted: only very small spaces run out of new losses.
MAX_DRAWS = 300

Slot = tuple[int, int]  # generation and slot


class Candidate(NamedTuple):
    """
    A loss for one slot.

    :param loss: The loss
    :param operation: ``given``, ``random``, ``prior``, ``replacement``, ``crossover`` or ``horizon_change``
    :param parents: Numbers of the trials that it stems from
    """

    loss: AuxLoss
    operation: str
    parents: tuple[int, ...] = ()


class GenerationProgress(NamedTuple):
    """
    :param generation: Number of the generation, from 1
    :param slots: How many slots it has
    :param filled: Slots with a complete or pruned trial
    :param running: Slots that are not filled and have a trial that runs
    :param failed: Failed trials so far, without the interrupted ones
    """

    generation: int
    slots: int
    filled: int
    running: int
    failed: int


class AuxLossSampler(BaseSampler):
    """
    Evolution of auxiliary losses with the paper's mutations, for ``suggest_aux_loss``.

    The first generation (the paper's "stage") has the losses of ``initial``, ``n_random`` random ones and ``n_prior`` from two
    priors. Each later one takes the best ``parents`` of the one before and fills its ``population_size`` slots in fixed shares:
    ``random``, ``replacement``, ``crossover``, ``horizon_change``. It is over when every slot has a complete or pruned trial. The
    random slots of the next one need no parents and come while the last trials of this one run.

    Each trial gets its slot when it is asked for, and shows it as user attributes: ``generation``, ``slot``, ``attempt``,
    ``operation``, ``parents``. Its loss depends on the seed, the slot and the generations before only, not on how many trials run
    at once. A failed trial frees its slot for another candidate; one with the user attribute ``interrupted`` for the same one.
    An enqueued trial takes a random slot if there is one.

    Asking never waits. Where no slot is free, a trial gets one more offspring of the last parents, in a slot behind all
    others, and counts in its generation if it finishes before that is over. Trials of a program that was killed stay RUNNING and
    hold their slots: report ``TrialState.FAIL`` for them.

    :param population_size: Slots of every generation but the first (paper: 100)
    :param n_random: Random losses of the first generation (paper: 100)
    :param n_prior: Losses of the first generation from the priors, both in turn (paper: 25)
    :param parents: Share of a generation that the next one stems from (paper: 0.25)
    :param replacement: Share of flipped masks (paper: 0.5)
    :param crossover: Share of crossovers (paper: 0.2), of two parents of one horizon. Where no two parents have one, the
        second is any candidate of the generation; where there is none either, the slot gets a replacement
    :param horizon_change: Share of changed horizons (paper: 0.1)
    :param random: Share of random losses (paper: 0.2)
    :param max_horizon: Longest horizon (paper: 10)
    :param operators: Operators to search too, as in ``suggest_aux_loss``; None for mean squared error (paper, 2.2)
    :param allow_duplicates: Whether a loss may be trained again, as in the paper; else a candidate whose canonical form is
        already there is redrawn
    :param seed: Seed of the evolution, not negative; None for a random one. A study keeps its first seed
    :param screening: Offspring that are drawn for each slot, of which the one is kept that a Bayesian linear model of the
        tokens, fitted to the generations before, rates highest under one posterior draw; 1 for the paper's evolution
    :param n_generations: Number of generations, for ``free_slots`` and ``stop_when_complete``; None for no end
    :param initial: Losses for the first slots of the first generation
    :raises ValueError: naming the argument that does not fit
    """

    def __init__(
        self,
        population_size: int = 100,
        n_random: int = 100,
        n_prior: int = 25,
        parents: float = 0.25,
        replacement: float = 0.5,
        crossover: float = 0.2,
        horizon_change: float = 0.1,
        random: float = 0.2,
        max_horizon: int = MAX_HORIZON,
        operators: Sequence[str] | None = None,
        allow_duplicates: bool = False,
        seed: int | None = None,
        screening: int = 1,
        n_generations: int | None = None,
        initial: Sequence[AuxLoss] = (),
    ):
        positive = {"population_size": population_size, "max_horizon": max_horizon, "screening": screening}
        positive |= {"n_random + n_prior + initial": n_random + n_prior + len(initial)}
        for name, count in {**positive, "n_generations": 1 if n_generations is None else n_generations}.items():
            if count < 1:
                raise ValueError(f"{name} must be at least 1, not {count}")
        # Random slots come first: they need no parents.
        shares = {"random": random, "replacement": replacement, "crossover": crossover, "horizon_change": horizon_change}
        for name, number in {**shares, "n_random": n_random, "n_prior": n_prior, "seed": seed or 0}.items():
            if not 0 <= number < math.inf:
                raise ValueError(f"{name} must not be negative, not {number}")
        if abs(sum(shares.values()) - 1) > 1e-9:
            raise ValueError(f"the shares {', '.join(shares)} must sum to 1, not {sum(shares.values())}")
        if not 0 < parents <= 1:
            raise ValueError(f"parents must be a share in (0, 1], not {parents}")
        check_operators(operators)
        self.max_horizon = max_horizon
        self.operators = None if operators is None else tuple(operators)
        for loss in initial:
            space.loss_to_params(loss, self.operators)
            if loss.horizon > max_horizon:
                raise ValueError(f"initial has {loss}, whose horizon is longer than {max_horizon}")
        self.parents = parents
        self.allow_duplicates = allow_duplicates
        self.seed = seed
        self.screening = screening
        self.n_generations = n_generations
        self.initial = tuple(initial if allow_duplicates else {loss.canonical(): loss for loss in initial}.values())
        self.settings: dict[str, Any] = {
            "population_size": population_size,
            "n_random": n_random,
            "n_prior": n_prior,
            "parents": parents,
            **shares,
            "max_horizon": max_horizon,
            "operators": None if operators is None else list(operators),
            "allow_duplicates": allow_duplicates,
            "screening": screening,
            "initial": [str(loss) for loss in self.initial],
        }
        self._first_operations = ["given"] * len(self.initial) + ["random"] * n_random + ["prior"] * n_prior
        slots = _apportion(shares, population_size)
        self._operations = [name for name in shares for _ in range(slots[name])]
        self._forget()

    def _forget(self) -> None:
        self._lock = threading.Lock()
        self._cached: tuple[Any, int, _Evolution] | None = None  # storage, study and what is known of it

    def __getstate__(self) -> dict[str, Any]:
        return {key: value for key, value in self.__dict__.items() if key not in ("_lock", "_cached")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._forget()

    def operations(self, generation: int) -> list[str]:
        """
        The operation of every slot of a generation.

        :param generation: Number of the generation, from 1
        """
        return self._first_operations if generation == 1 else self._operations

    def free_slots(self, study: Study) -> int:
        """
        How many trials that are asked for now would get a slot; 0 when the last generation is over.

        :param study: The study
        """
        with self._lock:
            return len(self._refresh(study).free_slots())

    def is_complete(self, study: Study) -> bool:
        """
        Whether the last of ``n_generations`` is over.

        :param study: The study
        """
        with self._lock:
            return self._refresh(study).generation > (self.n_generations or math.inf)

    def stop_when_complete(self, study: Study, trial: FrozenTrial) -> None:
        """A callback for ``study.optimize`` that ends it after the last generation."""
        if self.is_complete(study):
            study.stop()

    def progress(self, study: Study) -> list[GenerationProgress]:
        """
        How far each generation is that has started, or all of them where ``n_generations`` is known.

        :param study: The study
        """
        with self._lock:
            evolution = self._refresh(study)
            return [evolution.progress(number) for number in range(1, (self.n_generations or evolution.last_started) + 1)]

    # Optuna's interface.

    def before_trial(self, study: Study, trial: FrozenTrial) -> None:
        if SLOT_KEY in trial.system_attrs:
            return  # Optuna's copy of a trial whose heartbeat stopped keeps its slot.
        with self._lock:
            evolution = self._refresh(study)
            system = evolution.assign(trial.number, trial.system_attrs.get(FIXED_KEY, trial.params or None))
            for key, value in system.items():
                study._storage.set_trial_system_attr(trial._trial_id, key, value)
        trial.system_attrs.update(system)
        for name in ("generation", "slot", "attempt", "operation", "parents"):
            study._storage.set_trial_user_attr(trial._trial_id, name, system[SLOT_KEY][name])
            trial.user_attrs[name] = system[SLOT_KEY][name]

    def infer_relative_search_space(self, study: Study, trial: FrozenTrial) -> dict[str, BaseDistribution]:
        return space.distributions(self.max_horizon, self.max_horizon, self.operators)

    def sample_relative(self, study: Study, trial: FrozenTrial, search_space: dict[str, BaseDistribution]) -> dict[str, Any]:
        loss = trial.system_attrs[SLOT_KEY]["loss"]
        return {} if loss is None else space.loss_to_params(AuxLoss.parse(loss), self.operators)

    def sample_independent(
        self, study: Study, trial: FrozenTrial, param_name: str, param_distribution: BaseDistribution
    ) -> Any:
        """What the user searches beside the loss is drawn at random, as a function of the slot like the loss itself."""
        slot = trial.system_attrs[SLOT_KEY]
        key = [slot["seed"], slot["generation"], slot["slot"], slot["attempt"], zlib.crc32(param_name.encode())]
        sampler = RandomSampler(int(np.random.SeedSequence(key).generate_state(1)[0]))
        return sampler.sample_independent(study, trial, param_name, param_distribution)

    def _refresh(self, study: Study) -> "_Evolution":
        storage, study_id = study._storage, study._study_id
        # Not study.get_trials: under a HyperbandPruner the study shows one bracket only.
        trials = storage.get_all_trials(study_id, deepcopy=False)
        if self._cached is None or self._cached[:2] != (storage, study_id) or len(trials) < self._cached[2].n_trials:
            sign = 1.0 if study.direction == StudyDirection.MAXIMIZE else -1.0
            self._cached = (storage, study_id, _Evolution(self, self._check_settings(study), sign))
        self._cached[2].refresh(trials)
        return self._cached[2]

    def _check_settings(self, study: Study) -> int:
        """Refuse a study that was started with other settings: its slots mean something else. Returns its seed."""
        stored = study._storage.get_study_system_attrs(study._study_id).get(SETTINGS_KEY)
        if stored is None:
            seed = int(np.random.SeedSequence().generate_state(1)[0]) if self.seed is None else self.seed
            stored = {**self.settings, "seed": seed}
            study._storage.set_study_system_attr(study._study_id, SETTINGS_KEY, stored)
        for name, value in self.settings.items():
            if stored.get(name) != value:
                raise ValueError(f"this study was started with {name}={stored.get(name)!r}, not {value!r}: use another study")
        if self.seed not in (None, stored["seed"]):
            logger.warning("The study keeps its own seed %d, not %d", stored["seed"], self.seed)
        return stored["seed"]


class _Result(NamedTuple):
    """The finished trial of a slot."""

    number: int
    loss: AuxLoss
    score: float  # higher is better
    fitness: float  # the same, minus infinity where the trial was pruned or its score is not finite


class _Evolution:
    """
    What is known of one study: the trials that its slots have, and the candidates of the slots.

    Candidates are planned in rounds. Round g starts when generation g - 1 is over. It has the slots of generation g that need
    parents (in the first one all), and then the random ones of generation g + 1. It knows nothing of its own results, so that
    its plan does not depend on the order in which trials finish.

    :param sampler: Its settings
    :param seed: Seed of the study
    :param sign: -1 where scores are minimized
    """

    def __init__(self, sampler: AuxLossSampler, seed: int, sign: float):
        self.sampler = sampler
        self.seed = seed
        self.sign = sign
        self.n_trials = 0
        self.unfinished: list[int] = []  # numbers of trials
        self.running: set[Slot] = set()
        # Of each generation and slot, the first finished trial; None if it has no loss.
        self.results: defaultdict[int, dict[int, _Result | None]] = defaultdict(dict)
        self.failed: Counter[Slot] = Counter()
        self.interrupted: dict[Slot, FrozenTrial] = {}  # the last trial of a slot, if it was interrupted
        self.generation = 1  # the first one that is not over
        self.last_started = 1
        # First candidates of slots: those that the storage has already, and all that are known.
        self.stored: dict[Slot, dict[str, Any]] = {}
        self.plan: dict[Slot, Candidate] = {}
        self.to_plan = deque(self._round())
        # Canonical forms in the order in which they came, and how many there were at the end of each round.
        self.seen: dict[AuxLoss, int] = {}
        self.n_seen: dict[int, int] = {}
        self.model = TokenModel(sampler.max_horizon)
        # Of the last generation that is over: all results, those of them that are parents, and those that may be crossed.
        self.population: list[_Result] = []
        self.parents: list[_Result] = []
        self.crossed: list[_Result] = []

    # Slots.

    def refresh(self, trials: Sequence[FrozenTrial]) -> None:
        """Look at the trials that are new or were not finished before, in the order in which they finished."""
        numbers = (*self.unfinished, *range(self.n_trials, len(trials)))
        with_slot = [(trial, trial.system_attrs.get(SLOT_KEY)) for trial in (trials[number] for number in numbers)]
        self.n_trials = len(trials)
        self.unfinished = [trial.number for trial, _ in with_slot if not trial.state.is_finished()]
        self.running.clear()
        finished = []
        for trial, assigned in with_slot:
            if assigned is None:
                continue
            slot = assigned["generation"], assigned["slot"]
            self.last_started = max(self.last_started, assigned["generation"])
            if assigned["attempt"] == 0 and assigned["operation"] != "enqueued":
                self.stored.setdefault(slot, assigned)
            if trial.state.is_finished():
                finished.append((trial.datetime_complete, trial.number, slot))
            else:
                self.running.add(slot)
        for _, number, slot in sorted(finished):
            self._finish(*slot, trials[number])

    def _finish(self, generation: int, slot: int, trial: FrozenTrial) -> None:
        self.interrupted.pop((generation, slot), None)
        loss = loss_of(trial)
        if trial.state == TrialState.FAIL:
            if trial.user_attrs.get("interrupted"):
                self.interrupted[generation, slot] = trial
            else:
                self.failed[generation, slot] += 1
        elif trial.state == TrialState.COMPLETE or loss is not None:  # what was pruned as invalid fills no slot
            score = math.nan if trial.value is None else self.sign * trial.value
            is_fit = trial.state == TrialState.COMPLETE and math.isfinite(score)
            result = None if loss is None else _Result(trial.number, loss, score, score if is_fit else -math.inf)
            if generation >= self.generation:  # else its slot, and the choice of parents, is settled
                self.results[generation].setdefault(slot, result)
            while all(slot in self.results[self.generation] for slot in range(self._size(self.generation))):
                self._end_generation()

    def free_slots(self) -> list[Slot]:
        """Slots of this generation without a trial, and random ones of the next."""
        last = self.sampler.n_generations or self.generation + 1
        slots = [(self.generation, slot) for slot in range(self._size(self.generation))] + self._round()
        slots = [slot for slot in dict.fromkeys(slots) if slot[0] <= last]
        return [slot for slot in slots if slot not in self.running and slot[1] not in self.results[slot[0]]]

    def progress(self, generation: int) -> GenerationProgress:
        slots = {(generation, slot) for slot in range(self._size(generation))}
        filled = {(generation, slot) for slot in self.results.get(generation, ())} & slots
        failed = sum(number for slot, number in self.failed.items() if slot[0] == generation)
        return GenerationProgress(generation, len(slots), len(filled), len((slots & self.running) - filled), failed)

    def assign(self, number: int, given: Mapping[str, Any] | None) -> dict[str, Any]:
        """
        The system attributes of a trial that is asked for.

        :param number: Number of the trial
        :param given: Parameters that were enqueued, None if it was not
        """
        free = self.free_slots()
        if given is not None:  # no offspring is lost, if that can be
            free.sort(key=lambda slot: (slot in self.interrupted, self._operation(*slot) != "random"))
        if not free:
            generation = min(self.generation, self.sampler.n_generations or self.generation)
            free = [(generation, self._size(generation) + number)]
            logger.info("Trial %d is one more of generation %d: trials %s hold its slots", number, generation, self.unfinished)
        (generation, slot), attempt = free[0], self.failed[free[0]]
        key = {"seed": self.seed, "generation": generation, "slot": slot, "attempt": attempt}
        if given is not None:
            loss = self._complete(given, np.random.default_rng(list(key.values())))
            return {SLOT_KEY: {**key, "operation": "enqueued", "parents": [], "loss": loss and str(loss)}}
        if interrupted := self.interrupted.get((generation, slot)):
            return {name: interrupted.system_attrs[name] for name in (SLOT_KEY, FIXED_KEY) if name in interrupted.system_attrs}
        candidate = self._candidate(generation, slot, attempt)
        drawn = {"operation": candidate.operation, "parents": list(candidate.parents), "loss": str(candidate.loss)}
        return {SLOT_KEY: {**key, **drawn}}

    def _complete(self, given: Mapping[str, Any], rng: np.random.Generator) -> AuxLoss | None:
        """A loss with all given parameters, the others at random; None if there is no valid one."""
        operators = self.sampler.operators
        for _ in range(MAX_DRAWS):
            drawn = space.loss_to_params(space.random_loss(rng, self.sampler.max_horizon, operators), operators)
            with contextlib.suppress(KeyError, TypeError, ValueError):
                loss = space.params_to_loss({**drawn, **given})
                space.loss_to_params(loss, operators)
                return loss
        return None

    # Candidates.

    def _size(self, generation: int) -> int:
        return len(self.sampler.operations(generation))

    def _operation(self, generation: int, slot: int) -> str:
        operations = self.sampler.operations(generation)
        if slot < len(operations):
            return operations[slot]
        return "random" if generation == 1 else operations[slot % len(operations)]

    def _round_of(self, generation: int, slot: int) -> int:
        return generation - (generation > 1 and self._operation(generation, slot) == "random")

    def _round(self) -> list[Slot]:
        """Slots of this round, in the order in which they are planned."""
        slots = [(number, slot) for number in (self.generation, self.generation + 1) for slot in range(self._size(number))]
        return [slot for slot in slots if self._round_of(*slot) == self.generation]

    def _plan_next(self) -> None:
        slot = self.to_plan[0]
        if stored := self.stored.get(slot):
            candidate = Candidate(AuxLoss.parse(stored["loss"]), stored["operation"], tuple(stored["parents"]))
        else:
            candidate = self._draw(*slot, 0, lambda form: form in self.seen)
        self.plan[slot] = candidate
        self.seen.setdefault(candidate.loss.canonical(), len(self.seen))
        self.to_plan.popleft()
        if not self.to_plan:
            self.n_seen[self.generation] = len(self.seen)

    def _end_generation(self) -> None:
        """Choose parents, and start the next round."""
        while self.to_plan:
            self._plan_next()
        results = [result for _, result in sorted(self.results[self.generation].items()) if result is not None]
        for result in results:
            self.seen.setdefault(result.loss.canonical(), len(self.seen))
        if self.sampler.screening > 1:
            self.model.add([result.loss for result in results], [result.score for result in results])
        # Equal ones in the order of their slots.
        best = sorted(results, key=lambda result: -result.fitness)[: max(1, round(self.sampler.parents * len(results)))]
        self.population, self.parents = results, best
        self.crossed = [one for one in best if _partners(one, best)] or [one for one in best if _partners(one, results)]
        self.generation += 1
        self.to_plan.extend(self._round())

    def _candidate(self, generation: int, slot: int, attempt: int) -> Candidate:
        """
        The candidate of a slot.

        :param generation: Number of the generation, from 1
        :param slot: Number of the slot, from 0
        :param attempt: How many candidates of this slot failed
        """
        in_plan = slot < self._size(generation)
        if in_plan and attempt == 0:
            while (generation, slot) not in self.plan:
                self._plan_next()
            # And two of what comes next, so that the rest of a round need not be planned all at once at its end.
            for _ in range(min(2, len(self.to_plan))):
                self._plan_next()
            return self.plan[generation, slot]
        round_number = self._round_of(generation, slot)
        while in_plan and self.to_plan and round_number == self.generation:
            self._plan_next()
        # Known is what was planned until the end of the round: the same before and after a generation ends meanwhile.
        n_seen = self.n_seen[round_number] if in_plan else len(self.seen)
        before: set[AuxLoss] = set()  # attempts
        for number in range(min(1, attempt), attempt + 1):
            candidate = self._draw(
                generation, slot, number, lambda form: form in before or self.seen.get(form, n_seen) < n_seen
            )
            before.add(candidate.loss.canonical())
        return candidate

    def _draw(self, generation: int, slot: int, attempt: int, is_known: Callable[[AuxLoss], bool]) -> Candidate:
        rng = np.random.default_rng([self.seed, generation, slot, attempt])
        operation = self._operation(generation, slot)
        if operation == "given":
            if attempt == 0:
                return Candidate(self.sampler.initial[slot], operation)
            operation = "random"
        # What replaces a failed random loss has to be the same before and after the model learns of another generation.
        is_screened = self.sampler.screening > 1 and self.model.n_trials and not (attempt and operation == "random")
        offspring: dict[AuxLoss, Candidate] = {}  # of different canonical forms
        for _ in range(self.sampler.screening if is_screened else 1):
            candidate = self._draw_new(rng, operation, slot, is_known)
            offspring.setdefault(candidate.loss.canonical(), candidate)
        return list(offspring.values())[self.model.best(list(offspring), self.model.draw(rng)) if is_screened else 0]

    def _draw_new(self, rng: np.random.Generator, operation: str, slot: int, is_known: Callable[[AuxLoss], bool]) -> Candidate:
        """One offspring, redrawn while it is invalid or known."""
        candidate = None
        for _ in range(MAX_DRAWS):
            try:
                candidate = self._offspring(rng, operation, slot)
            except mutations.RejectedLoss:
                continue
            if self.sampler.allow_duplicates or not is_known(candidate.loss.canonical()):
                return candidate
        if operation in ("crossover", "horizon_change"):
            # No pair of one horizon, two parents that are almost equal, a space of one horizon.
            return self._draw_new(rng, "replacement", slot, is_known)
        if candidate is None:
            raise RuntimeError(f"no valid loss in {MAX_DRAWS} draws by {operation}")
        logger.info("No new loss in %d draws by %s: %s repeats one", MAX_DRAWS, operation, candidate.loss)
        return candidate

    def _offspring(self, rng: np.random.Generator, operation: str, slot: int) -> Candidate:
        sampler = self.sampler
        if operation == "random":
            return Candidate(space.random_loss(rng, sampler.max_horizon, sampler.operators), operation)
        if operation == "prior":
            prior = space.PRIORS[slot % len(space.PRIORS)]
            return Candidate(prior(rng, sampler.max_horizon, sampler.operators), operation)
        if not self.parents:
            raise RuntimeError("no trial of the last generation has a loss: the objective has to call suggest_aux_loss")
        mothers = self.crossed if operation == "crossover" else self.parents
        if not mothers:
            raise mutations.RejectedLoss("no parent has another candidate of its horizon")
        mother = mothers[rng.integers(len(mothers))]
        if operation == "replacement":
            return Candidate(mutations.replacement(mother.loss, rng, sampler.operators), operation, (mother.number,))
        if operation == "horizon_change":
            return Candidate(mutations.horizon_change(mother.loss, rng, sampler.max_horizon), operation, (mother.number,))
        partners = _partners(mother, self.parents) or _partners(mother, self.population)
        father = partners[rng.integers(len(partners))]
        return Candidate(mutations.crossover(mother.loss, father.loss, rng), operation, (mother.number, father.number))


def _partners(one: _Result, results: Iterable[_Result]) -> list[_Result]:
    return [other for other in results if other.number != one.number and other.loss.horizon == one.loss.horizon]


def _apportion(shares: dict[str, float], total: int) -> dict[str, int]:
    """Whole numbers that sum to ``total``, as near to the shares as can be (largest remainders)."""
    exact = {name: round(share * total, 9) for name, share in shares.items()}
    counts = {name: int(value) for name, value in exact.items()}
    by_remainder = sorted(exact, key=lambda name: counts[name] - exact[name])
    for name in by_remainder[: total - sum(counts.values())]:
        counts[name] += 1
    return counts
