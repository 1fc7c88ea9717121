"""AuxLossSampler: the paper's evolution of auxiliary losses (section 2.2, A.3) as a sampler of Optuna."""

import json
import logging
import math
import threading
import zlib
from collections import Counter, defaultdict
from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np
from optuna.distributions import BaseDistribution
from optuna.samplers import BaseSampler, RandomSampler
from optuna.study import Study, StudyDirection
from optuna.trial import FrozenTrial, Trial, TrialState
from sb3_aarl.search.evolution import space
from sb3_aarl.search.evolution.candidates import Candidates, Result, Settings
from sb3_aarl.search.evolution.space import SEED_INDEX_KEY, SLOT_KEY

from sb3_aarl.aux_loss import AuxLoss

logger = logging.getLogger(__name__)

# System attribute of a study: the settings of its sampler.
SETTINGS_KEY = "AuxLossSampler:settings"
# Optuna's: what study.enqueue_trial was given.
FIXED_KEY = "fixed_params"
# Threads of study.optimize share a sampler.
LOCK = threading.Lock()


class GenerationProgress(NamedTuple):
    """How many slots of a generation there are, are filled, or have a running trial, and how many trials have failed."""

    generation: int
    slots: int
    filled: int
    running: int
    failed: int


@dataclass(eq=False, repr=False, kw_only=True)
class AuxLossSampler(Settings, BaseSampler):
    """
    Evolution of auxiliary losses with the paper's mutations, for ``suggest_aux_loss``.

    The first generation (the paper's "stage") has the losses of ``initial``, ``n_random`` random ones and ``n_prior`` from two
    priors. Each later one takes the best ``parents`` of the one before and fills its ``population_size`` slots in fixed
    shares. It is over when it has as many complete or pruned trials as slots; the random slots of the next one come before.

    A trial gets its slot when it is asked for, and shows it in its user attributes ``generation``, ``slot``, ``attempt``,
    ``operation`` and ``parents``. Its loss depends on the seed, the slot and earlier generations, and as long as no more
    trials are asked for than ``free_slots`` says, not on how many run at once. A failed trial, or one that is pruned before it
    has a loss, frees its slot for another candidate; for the same one if it has the user attribute ``interrupted``. Enqueued
    parameters of a loss take a random slot if there is one.

    Trials that are pruned, have no finite score or violate a constraint (``trial.set_constraint``) are parents only if there
    are no others. What is searched beside the loss is inherited from a parent or, every other time, drawn at random. Other
    samplers may hold this one (``PartialFixedSampler``, ``independent_sampler``): the loss of a trial is the one of its
    parameters.

    Asking never waits. A trial that finds no free slot gets an extra one, as the next generation would have it, so that
    no generation waits for trials that a killed process left RUNNING. Two processes that ask at the same moment may train one
    slot's loss twice; the trial that finishes first counts. ``Study.add_trial`` fills no slot: pass ``initial`` instead.

    :param population_size: Slots of every generation but the first (paper: 100)
    :param n_random: Random losses of the first generation (paper: 100)
    :param n_prior: Losses of the first generation from the priors, both in turn (paper: 25)
    :param parents: Share of a generation that the next one stems from (paper: 0.25)
    :param replacement: Share of flipped masks (paper: 0.5)
    :param crossover: Share of crossovers (paper: 0.2), of two parents of one horizon; without such a pair, of replacements
    :param horizon_change: Share of changed horizons (paper: 0.1)
    :param random: Share of random losses (paper: 0.2)
    :param max_horizon: Longest horizon (paper: 10)
    :param operators: Operators to search too, as in ``suggest_aux_loss``; None for mean squared error (paper, 2.2)
    :param allow_duplicates: Whether a loss may be trained again, as in the paper; else a candidate whose canonical form is
        already there is redrawn
    :param seed: Seed of the evolution, not negative; None for a random one. A study keeps its first seed; processes that start
        one at the same moment need the same
    :param screening: Offspring that are drawn for each slot, of which the one is kept that the Gaussian process, fitted to the
        generations before, rates highest under one posterior draw; 1 for the paper's evolution
    :param n_generations: Number of generations, for ``free_slots`` and ``stop_when_complete``; None for no end
    :param initial: Losses for the first slots of the first generation: AuxLoss, names or notations
    :param parent_selection: ``best`` takes the best scores of the last generation, as the paper does; ``posterior`` the losses
        of all generations whose posterior mean, which a Gaussian process of the tokens has of them, is highest
    :param again: Share of the slots of later generations, 0 for the paper's evolution, that train a known loss with another
        seed (:meth:`seed_index`): by Thompson sampling, one that could be the best. The other shares divide the rest
    :param climbing: At most so many tokens are added to the offspring of a slot or removed, 0 for the paper's evolution: each
        time the one that most raises the model's mean and a multiple, drawn for each slot, of its deviation
    :param independent_sampler: For parameters beside those of the loss, instead of inheritance, such as ``TPESampler``. One
        that draws all parameters together, such as ``GPSampler``, draws at random here
    :raises ValueError: naming the argument that does not fit
    """

    independent_sampler: BaseSampler | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self._space = space.distributions(self.max_horizon, self.max_horizon, self.operators)
        self._cached: tuple[Any, int, _Slots] | None = None  # storage, study and what is known of its slots

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_cached": None}

    def free_slots(self, study: Study) -> int:
        """How many trials that are asked for now would get a slot; 0 when the last generation is over."""
        with LOCK:
            return len(self._refresh(study).free())

    def is_complete(self, study: Study) -> bool:
        """Whether the last of ``n_generations`` is over."""
        with LOCK:
            slots = self._refresh(study)
            return slots.candidates.generation > slots.last

    def stop_when_complete(self, study: Study, trial: FrozenTrial) -> None:
        """A callback for ``study.optimize`` that ends it after the last generation."""
        if self.is_complete(study):
            study.stop()

    def progress(self, study: Study) -> list[GenerationProgress]:
        """How far each generation is that has started, or all of them where ``n_generations`` is known."""
        with LOCK:
            slots = self._refresh(study)
            return [slots.progress(number) for number in range(1, 1 + (self.n_generations or slots.last_started))]

    @staticmethod
    def seed_index(trial: Trial | FrozenTrial) -> int:
        """
        Which seed a trial trains: k if ``again`` repeats its loss for the k-th time, else 0. Train other seeds for each, and
        prune no repeat: only the lucky ones would count. It is the user attribute ``seed_index``.
        """
        return trial.user_attrs.get(SEED_INDEX_KEY, 0)

    @staticmethod
    def stored_settings(study: Study) -> dict[str, Any]:
        """The arguments of the sampler that a study was started with, as plain values; none if it had another sampler."""
        return study._storage.get_study_system_attrs(study._study_id).get(SETTINGS_KEY, {})

    # Optuna's interface.

    def before_trial(self, study: Study, trial: FrozenTrial) -> None:
        if self.independent_sampler is not None:
            self.independent_sampler.before_trial(study, trial)
        self._assign(study, trial, {**trial.params, **trial.system_attrs.get(FIXED_KEY, {})})

    def _assign(self, study: Study, trial: FrozenTrial, fixed: Collection[str] = ()) -> dict[str, Any]:
        """The slot of a trial, which gets one if it has none."""
        if SLOT_KEY not in trial.system_attrs:  # Optuna's copy of a trial whose heartbeat stopped has
            with LOCK:
                assigned = self._refresh(study).assign(trial.number, fixed)
                for key, value in assigned.items():
                    study._storage.set_trial_system_attr(trial._trial_id, key, value)
            trial.system_attrs.update(assigned)
            for key in ("generation", "slot", "attempt", "operation", "parents", SEED_INDEX_KEY):
                study._storage.set_trial_user_attr(trial._trial_id, key, assigned[SLOT_KEY][key])
                trial.user_attrs[key] = assigned[SLOT_KEY][key]
        return trial.system_attrs[SLOT_KEY]

    def after_trial(self, study: Study, trial: FrozenTrial, state: TrialState, values: Sequence[float] | None) -> None:
        if self.independent_sampler is not None:
            self.independent_sampler.after_trial(study, trial, state, values)

    def reseed_rng(self) -> None:
        if self.independent_sampler is not None:  # the evolution draws from its stored seed
            self.independent_sampler.reseed_rng()

    def infer_relative_search_space(self, study: Study, trial: FrozenTrial) -> dict[str, BaseDistribution]:
        return dict(self._space)

    def sample_relative(self, study: Study, trial: FrozenTrial, search_space: dict[str, BaseDistribution]) -> dict[str, Any]:
        planned = self._planned(self._assign(study, trial))
        return {name: value for name, value in planned.items() if name in search_space}

    def sample_independent(
        self, study: Study, trial: FrozenTrial, param_name: str, param_distribution: BaseDistribution
    ) -> Any:
        """
        A parameter that is searched beside the loss. Those of the loss come here where another sampler holds this one as its
        ``independent_sampler``.
        """
        assigned = self._assign(study, trial)
        planned = self._planned(assigned)
        if param_name in planned and planned[param_name] in space.values(param_distribution):
            return planned[param_name]
        key = [assigned.get(name, 0) for name in ("seed", "generation", "slot", "attempt", "enqueued")]
        rng = np.random.default_rng([*key, zlib.crc32(param_name.encode())])
        trials = study._storage.get_all_trials(study._study_id, deepcopy=False)
        parents = [trials[number] for number in assigned["parents"]]
        inherited = [p.params[param_name] for p in parents if p.distributions.get(param_name) == param_distribution]
        if inherited and assigned["operation"] == "again":
            return inherited[0]
        if self.independent_sampler is not None:
            return self.independent_sampler.sample_independent(study, trial, param_name, param_distribution)
        if inherited and rng.random() < 0.5:
            return inherited[rng.integers(len(inherited))]
        return RandomSampler(int(rng.integers(2**32))).sample_independent(study, trial, param_name, param_distribution)

    def _planned(self, assigned: dict[str, Any]) -> dict[str, Any]:
        """The parameters of the loss that is planned for a slot; none where a user enqueued some of them."""
        loss = assigned["loss"]
        return {} if loss is None else space.loss_to_params(AuxLoss.parse(loss), self.operators)

    def _refresh(self, study: Study) -> "_Slots":
        storage, study_id = study._storage, study._study_id
        # Not study.get_trials: under a HyperbandPruner the study shows one bracket only.
        trials = storage.get_all_trials(study_id, deepcopy=False)
        if self._cached is None or self._cached[:2] != (storage, study_id) or len(trials) < self._cached[2].n_trials:
            sign = 1.0 if study.direction == StudyDirection.MAXIMIZE else -1.0
            self._cached = storage, study_id, _Slots(self, self._study_seed(study), sign)
        self._cached[2].refresh(trials)
        return self._cached[2]

    def _study_seed(self, study: Study) -> int:
        """The seed of a study. One that was started with other settings is refused: its slots mean something else."""
        # Without n_generations: a search may be continued.
        free = ("seed", "n_generations", "independent_sampler")
        of_fields = {field.name: field for field in fields(self) if field.name not in free}
        settings = json.loads(json.dumps({name: getattr(self, name) for name in of_fields}, default=str))
        stored = self.stored_settings(study)
        if not stored:
            seed = int(np.random.SeedSequence().generate_state(1)[0]) if self.seed is None else self.seed
            stored = {**settings, "seed": seed}
            study._storage.set_study_system_attr(study._study_id, SETTINGS_KEY, stored)
        for name, value in settings.items():
            if (old := stored.get(name, of_fields[name].default)) != value:  # an older version has fewer settings
                raise ValueError(f"this study was started with {name}={old!r}, not {value!r}: use another study")
        if self.seed not in (None, stored["seed"]):
            logger.warning("The study keeps its own seed %d, not %d", stored["seed"], self.seed)
        return stored["seed"]


class _Slots:
    """The trials of a study by their slots, as far as the storage shows them; ``sign`` is -1 where scores are minimized."""

    def __init__(self, sampler: AuxLossSampler, seed: int, sign: float):
        self.sampler = sampler
        self.candidates = Candidates(sampler, seed)
        self.last = sampler.n_generations or math.inf
        self.sign = sign
        self.n_trials = 0
        self.unfinished: list[int] = []  # numbers of trials
        self.asking: list[int] = []  # numbers of trials that have no slot yet
        self.last_started = 1
        self.running: set[tuple[int, int]] = set()  # generation and slot
        self.results: defaultdict[int, dict[int, Result | None]] = defaultdict(dict)  # None where a trial has no loss
        self.late: list[Result] = []  # of generations that were over, since the last one was
        self.failed: Counter[tuple[int, int]] = Counter()
        self.interrupted: dict[tuple[int, int], FrozenTrial] = {}  # the last trial of a slot, if it was interrupted

    def refresh(self, trials: Sequence[FrozenTrial]) -> None:
        """Look at the trials that are new or were not finished before, in the order in which they finished."""
        changed = [trials[number] for number in (*self.unfinished, *range(self.n_trials, len(trials)))]
        self.n_trials = len(trials)
        self.unfinished = [trial.number for trial in changed if not trial.state.is_finished()]
        self.running.clear()
        self.asking.clear()
        finished = []
        for trial in changed:
            key = trial.system_attrs.get(SLOT_KEY)
            if key is not None and key["seed"] == self.candidates.seed:  # not added from another study
                at = key["generation"], key["slot"]
                self.last_started = max(self.last_started, at[0])
                if trial.state.is_finished():
                    finished.append((trial.datetime_complete, trial.number, at))
                elif trial.state == TrialState.RUNNING:
                    self.running.add(at)
            elif key is None and trial.state == TrialState.RUNNING and not trial.params:
                self.asking.append(trial.number)
        for _, number, at in sorted(finished):
            self._finish(trials[number], *at)

    def _finish(self, trial: FrozenTrial, generation: int, slot: int) -> None:
        self.interrupted.pop((generation, slot), None)
        loss, drawn = space.loss_of(trial), trial.system_attrs[SLOT_KEY]["loss"]
        # Pruned before it was asked for its loss: another candidate, with which other parameters are drawn again.
        if trial.state == TrialState.FAIL or (trial.state == TrialState.PRUNED and loss is None and drawn is not None):
            if trial.user_attrs.get("interrupted"):
                self.interrupted[generation, slot] = trial
            else:
                self.failed[generation, slot] += 1
        elif trial.state == TrialState.COMPLETE or loss is not None:  # what was pruned as invalid fills no slot
            result = None if loss is None else Result(trial.number, loss, self.sign * space.score_of(trial))
            if generation >= self.candidates.generation:
                self.results[generation].setdefault(slot, result)
            elif result is not None:
                self.late.append(result)
            while len(filled := self.results[self.candidates.generation]) >= self._size(self.candidates.generation):
                of_generation = sorted(filled.items())
                self.candidates.end_generation([result for _, result in of_generation if result is not None], self.late)
                self.late = []

    def _size(self, generation: int) -> int:
        return len(self.sampler.operations(generation))

    def _open(self, generation: int) -> list[int]:
        """Slots without a result."""
        return [slot for slot in range(self._size(generation)) if slot not in self.results[generation]]

    def free(self) -> list[tuple[int, int]]:
        """Slots of this generation without a trial, and random ones of the next."""
        now = self.candidates.generation
        early = [slot for slot in self._open(now + 1) if self.sampler.operations(now + 1)[slot] == "random"]
        slots = [(now, slot) for slot in self._open(now)] + [(now + 1, slot) for slot in early]
        return [at for at in slots if at[0] <= self.last and at not in self.running]

    def progress(self, generation: int) -> GenerationProgress:
        running = sum((generation, slot) in self.running for slot in self._open(generation))
        failed = sum(number for (of, _), number in self.failed.items() if of == generation)
        return GenerationProgress(generation, self._size(generation), len(self.results[generation]), running, failed)

    def assign(self, number: int, fixed: Collection[str]) -> dict[str, Any]:
        """The system attributes of the trial of this number, which is asked for and has these parameters already."""
        free, is_enqueued = self.free(), not self.sampler._space.keys().isdisjoint(fixed)
        # Other processes ask too, and will take the slots before.
        n_before = sum(other < number for other in self.asking)
        free = free[min(n_before, max(0, len(free) - 1)) :]
        if fixed:  # an interrupted slot keeps its parameters
            free = [at for at in free if at not in self.interrupted]
        if is_enqueued:  # no offspring is lost, if that can be
            free.sort(key=lambda at: self.sampler.operations(at[0])[at[1]] != "random")
        if not free:
            generation = int(min(self.candidates.generation, self.last))
            free = [(generation, self._size(generation) + number)]
            logger.warning("Trial %d gets an extra slot of generation %d, which has no free one", number, generation)
        (generation, slot), attempt = free[0], self.failed[free[0]]
        key: dict[str, Any] = {"seed": self.candidates.seed, "generation": generation, "slot": slot, "attempt": attempt}
        key |= {"max_horizon": self.sampler.max_horizon, "operators": self.sampler.operators}
        if is_enqueued:  # an invalid one costs no attempt: the next one in the slot is drawn by its own number
            key |= {"enqueued": number + 1, "operation": "enqueued", "parents": [], "loss": None, SEED_INDEX_KEY: 0}
            return {SLOT_KEY: key}
        if again := self.interrupted.get(free[0]):  # its runs are there already: with all its parameters
            # The slot last: what has one is whole, also if the database is away in between.
            return {FIXED_KEY: again.system_attrs.get(FIXED_KEY, {}) | again.params, SLOT_KEY: again.system_attrs[SLOT_KEY]}
        loss, operation, parents, seed_index = self.candidates.of_slot(generation, slot, attempt)
        key |= {"operation": operation, "parents": list(parents), "loss": str(loss), SEED_INDEX_KEY: seed_index}
        return {SLOT_KEY: key}
