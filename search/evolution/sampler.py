"""AuxLossSampler: the paper's evolution of auxiliary losses (section 2.2, A.3) as a sampler of Optuna."""

import bisect
import contextlib
import inspect
import logging
import math
import threading
import time
import zlib
from collections import defaultdict
from collections.abc import Callable, Container, Iterable, Sequence
from itertools import islice
from types import FrameType
from typing import Any, NamedTuple

import numpy as np
from optuna.distributions import BaseDistribution
from optuna.exceptions import UpdateFinishedTrialError
from optuna.samplers import RandomSampler
from optuna.samplers._ga import BaseGASampler
from optuna.storages._heartbeat import is_heartbeat_enabled
from optuna.study import Study, StudyDirection
from optuna.study._optimize import _run_trial
from optuna.trial import FrozenTrial, TrialState

from sb3_aarl.aux_loss import AuxLoss
from search.evolution import mutations, space
from search.evolution.space import MAX_HORIZON, check_operators
from search.evolution.surrogate import TokenModel
from search.execution import workers
from search.results.trials import loss_of

logger = logging.getLogger(__name__)

# System attributes of a trial. The place is written in one piece, and is what gives the trial its candidate.
PLACE_KEY = "AuxLossSampler:place"
# The candidate itself was at fault: it failed in a live worker, or was no valid loss (enqueued by the user).
REJECTED_KEY = "AuxLossSampler:rejected"
# A trial without a place shows with this user attribute that its worker still waits for one.
WAITING_KEY = "waiting"
SETTINGS_KEY = "AuxLossSampler:settings"
# Optuna's: what study.enqueue_trial was given.
FIXED_KEY = "fixed_params"

# Draws for one place before a duplicate is accepted: only very small spaces run out of new losses.
MAX_DRAWS = 300
# A study that was begun before this could be chosen has it.
RETRIES = 10
# Seconds without a sign of life after which a trial that never got a place is given up.
ORPHAN_SECONDS = 60.0

OPEN = (TrialState.RUNNING, TrialState.WAITING)
FILLED = (TrialState.COMPLETE, TrialState.PRUNED)


class SearchComplete(RuntimeError):
    """All places of the last stage are filled."""


class Candidate(NamedTuple):
    """
    A loss for one place of a stage.

    :param loss: The loss
    :param operation: ``random``, ``prior``, ``replacement``, ``crossover`` or ``horizon_change``
    :param parents: Numbers of the trials that it stems from
    """

    loss: AuxLoss
    operation: str
    parents: tuple[int, ...] = ()


class StageProgress(NamedTuple):
    """
    :param stage: Number of the stage, from 1
    :param places: How many candidates it has
    :param filled: Places whose trial is complete or pruned
    :param running: Places whose trial runs
    :param failed: Failed trials so far
    :param died: Those of them whose worker died, or the process of an environment
    """

    stage: int
    places: int
    filled: int
    running: int
    failed: int
    died: int = 0


class _Register:
    """
    What the storage says of the places; each refresh reads trials that are new or were not finished before.

    :param operations: What the places of a stage are for; a trial of another study may have one that there is not
    """

    def __init__(self, operations: Callable[[int], Sequence[str]]) -> None:
        self.operations = operations
        self.trials: Sequence[FrozenTrial] = ()
        self.open: set[int] = set()  # numbers of trials that are not finished
        self.places: dict[int, tuple[int, int]] = {}  # stage and place of each trial that has one
        self.holders: defaultdict[tuple[int, int], list[int]] = defaultdict(list)  # and the other way, in order
        # Of each stage: places that somebody has, and those of them that are filled.
        self.taken: defaultdict[int, set[int]] = defaultdict(set)
        self.filled: defaultdict[int, set[int]] = defaultdict(set)
        # Trials with parameters but no place: once seen, and seen again. A database reads the parameters of a trial a
        # little later than its place, so that a trial of this sampler may look like that once.
        self._suspects: set[int] = set()
        self._strangers: set[int] = set()

    def refresh(self, trials: Sequence[FrozenTrial]) -> None:
        changed = [*self.open, *range(len(self.trials), len(trials))]
        self.trials = trials
        for number in changed:
            claim = trials[number].system_attrs.get(PLACE_KEY)
            there_is = claim is not None and claim["place"] < len(self.operations(claim["stage"]))
            place = (claim["stage"], claim["place"]) if there_is else None
            before = self.places.get(number)
            if place != before:
                if before is not None:
                    self.holders[self.places.pop(number)].remove(number)
                    self._count(*before)
                if place is not None:
                    self.places[number] = place
                    bisect.insort(self.holders[place], number)
            if place is not None:
                self._count(*place)
            if place is None and trials[number].params:
                (self._strangers if number in self._suspects else self._suspects).add(number)
            (self.open.discard if trials[number].state.is_finished() else self.open.add)(number)

    def _count(self, stage: int, place: int) -> None:
        holders = self.held_by(stage, place)
        (self.taken[stage].add if holders else self.taken[stage].discard)(place)
        is_filled = bool(holders) and holders[0].state in FILLED
        (self.filled[stage].add if is_filled else self.filled[stage].discard)(place)

    def held_by(self, stage: int, place: int) -> list[FrozenTrial]:
        """The trials that have the place, waiting, running or finished: one at most once all have chosen."""
        holders = [self.trials[number] for number in self.holders.get((stage, place), ())]
        return [trial for trial in holders if trial.state in FILLED + OPEN and not _is_invalid(trial)]

    def is_shared(self, number: int) -> bool:
        """Whether another trial has the place of this one."""
        return any(holder.number != number for holder in self.held_by(*self.places[number]))

    def is_given_up(self, number: int, retries: int) -> bool:
        """Whether the candidate of a copy failed since its trial died. One that has its parameters can get no other."""
        claim, params = self.trials[number].system_attrs[PLACE_KEY], self.trials[number].params
        return claim["loss"] is not None and not params and claim["attempt"] < self.attempt(*self.places[number], retries)

    def attempt(self, stage: int, place: int, retries: int) -> int:
        """How many candidates of the place were given up because they failed, or their workers died too often."""
        attempt = deaths = 0
        for number in self.holders.get((stage, place), ()):
            trial = self.trials[number]
            if trial.system_attrs[PLACE_KEY]["loss"] is None:
                continue  # enqueued
            rejected = REJECTED_KEY in trial.system_attrs and trial.state in (TrialState.FAIL, TrialState.PRUNED)
            # Without the mark of a live worker it was the worker that died: the same candidate has another try.
            deaths += trial.state == TrialState.FAIL and not trial.user_attrs.get("interrupted")
            if rejected or deaths > retries:
                attempt, deaths = attempt + 1, 0
        return attempt

    def enqueued(self, stage: int, place: int, retries: int) -> dict[str, Any] | None:
        """What a user enqueued and the place's last trial had, if its worker was interrupted or died: it has another try."""
        given, deaths = None, 0
        for number in self.holders.get((stage, place), ()):
            trial = self.trials[number]
            was_enqueued = trial.system_attrs[PLACE_KEY]["loss"] is None
            if not was_enqueued or trial.state != TrialState.FAIL or REJECTED_KEY in trial.system_attrs:
                given, deaths = None, 0
                continue
            given = trial.system_attrs.get(FIXED_KEY, given)
            deaths += not trial.user_attrs.get("interrupted")
        return given if deaths <= retries else None

    def unplaced(self, before: int | None = None) -> list[FrozenTrial]:
        """Trials, before this one, that run and may still ask for a place."""
        return [
            self.trials[other]
            for other in sorted(self.open)
            if (before is None or other < before)
            and other not in self.places
            and self.trials[other].state == TrialState.RUNNING
            and other not in self._strangers
        ]


class AuxLossSampler(BaseGASampler):
    """
    Evolution of auxiliary losses with the paper's mutations, for ``suggest_aux_loss``.

    The first stage draws ``n_random`` losses at random and ``n_prior`` from two priors. Each later stage takes the
    best ``parents`` of the one before and fills its ``population_size`` places in fixed shares: ``replacement``,
    ``crossover``, ``horizon_change``, ``random``. A stage has places, and each is filled by one completed (or pruned)
    trial, however many workers there are; a failed trial frees its place. The random places of the next stage need no
    parents and are given out while the last trials of this stage run. A worker that finds no place waits for one.

    The candidate of a place depends on the seed, the stage, the place and the stages before only, whichever worker
    asks. Workers agree on places through the storage alone: a trial leaves as many free places to those before it as have
    none yet, and looks back after it has taken its own.

    :param population_size: Places of every stage but the first (paper: 100)
    :param n_random: Random losses of the first stage (paper: 100)
    :param n_prior: Losses of the first stage from the priors, both in turn (paper: 25)
    :param parents: Share of a stage that the next one stems from (paper: 0.25)
    :param replacement: Share of flipped masks (paper: 0.5)
    :param crossover: Share of crossovers (paper: 0.2), of two parents of one horizon. Where no two parents have one, the
        second is any candidate of the stage; where there is none either, as in small stages, the place gets a replacement
    :param horizon_change: Share of changed horizons (paper: 0.1)
    :param random: Share of random losses (paper: 0.2)
    :param max_horizon: Longest horizon (paper: 10)
    :param operators: Operators to search too, as in ``suggest_aux_loss``; None for mean squared error (paper, 2.2)
    :param allow_duplicates: Whether a loss may be trained again, as in the paper; else a candidate whose canonical
        form the search had already is drawn again. Candidates in place of failed ones may still, rarely, repeat each other,
        and what is planned may repeat a loss that the user enqueued in the same stage
    :param seed: Seed of the evolution, not negative. None for a random one, kept in the study; a study keeps its first seed
    :param screening: Offspring that are drawn for each place, of which the one is kept that a Bayesian linear model of
        the tokens, fitted to the stages that are complete, rates highest under one posterior draw; 1 for the paper's
        evolution. The first stage has no model yet, and what replaces a failed random loss is not screened
    :param retries: How often a candidate is given out again after its worker died, before it is taken for the cause
    :param n_stages: Number of stages, after which ``ask`` raises :class:`SearchComplete`; None for no end
    :param worker: Identity that each trial shows as its worker's; ``"auto"`` for that of the process that asks
        (``workers.identity()``). Places of a worker of this machine that has died are given out again. None where trials are
        told by another process than the one that asked, which may be gone by then
    :raises ValueError: naming the argument that does not fit
    :raises TypeError: naming the argument that is no int

    A candidate that fails makes room for another one. One whose program ended is given out again: at Ctrl-C, and when
    ``study.optimize`` does not ``catch`` its exception, in which case it is one of the ``retries``. The same holds for a trial
    that has the user attribute ``interrupted``, which ``search.studies.objective.end_noted`` sets.
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
        retries: int = RETRIES,
        n_stages: int | None = None,
        worker: str | None = "auto",
    ):
        whole: dict[str, int | None] = {"population_size": population_size, "n_random": n_random, "n_prior": n_prior}
        whole |= {"max_horizon": max_horizon, "screening": screening, "retries": retries, "n_stages": n_stages, "seed": seed}
        for name, number in whole.items():
            # Of Python, not of numpy: they are stored as JSON.
            if number is not None and (isinstance(number, bool) or not isinstance(number, int)):
                raise TypeError(f"{name} must be an int, not {number!r}")
        super().__init__(population_size)
        positive = {"population_size": population_size, "max_horizon": max_horizon, "screening": screening}
        positive |= {"n_random + n_prior": n_random + n_prior, "n_stages": 1 if n_stages is None else n_stages}
        for name, value in positive.items():
            if value < 1:
                raise ValueError(f"{name} must be at least 1, not {value}")
        shares = {"random": random, "replacement": replacement, "crossover": crossover, "horizon_change": horizon_change}
        counts = {"n_random": n_random, "n_prior": n_prior, "retries": retries, "seed": seed or 0}
        for name, share in {**shares, **counts}.items():
            if not 0 <= share < math.inf:
                raise ValueError(f"{name} must not be negative, not {share}")
        if abs(sum(shares.values()) - 1) > 1e-9:
            raise ValueError(f"the shares {', '.join(shares)} must sum to 1, not {sum(shares.values())}")
        if not 0 < parents <= 1:
            raise ValueError(f"parents must be a share in (0, 1], not {parents}")
        check_operators(operators)
        self.n_random = n_random
        self.n_prior = n_prior
        self.parents = parents
        self.shares = shares
        self.max_horizon = max_horizon
        self.operators = None if operators is None else tuple(operators)
        self.allow_duplicates = allow_duplicates
        self.seed = seed
        self.screening = screening
        self.retries = retries
        self.n_stages = n_stages
        self.worker = worker
        # Operations place by place: what needs no parents comes first, so that it can be given out early.
        prior = ["prior"] * n_prior
        self._first_operations = ["random"] * n_random + prior
        places = _apportion(shares, population_size)
        self._operations = [name for name in shares for _ in range(places[name])]
        self._reset()

    def _reset(self) -> None:
        self._lock = threading.Lock()
        self._study: tuple[Any, int] | None = None
        self._register = _Register(self.operations)
        self._evolution: _Evolution | None = None

    def __getstate__(self) -> dict[str, Any]:
        derived = ("_lock", "_study", "_register", "_evolution")
        return {key: value for key, value in self.__dict__.items() if key not in derived}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._reset()

    def operations(self, stage: int) -> list[str]:
        """
        The operation of every place of a stage.

        :param stage: Number of the stage, from 1
        """
        return self._first_operations if stage == 1 else self._operations

    def progress(self, study: Study) -> list[StageProgress]:
        """
        How far each stage is that has begun, or all of them where ``n_stages`` is known.

        :param study: The study
        """
        with self._lock:
            self._refresh(study)
            register = self._register
            last = self.n_stages or max((stage for stage, _ in register.holders), default=1)
            progress = []
            for stage in range(1, last + 1):
                places = len(self.operations(stage))
                states = [holder.state for place in range(places) for holder in register.held_by(stage, place)[:1]]
                filled = sum(state in FILLED for state in states)
                tried = [number for place in range(places) for number in register.holders.get((stage, place), ())]
                failed = [trial for number in tried if (trial := register.trials[number]).state == TrialState.FAIL]
                died = sum(bool(trial.user_attrs.get(workers.DIED_KEY)) for trial in failed)
                progress.append(StageProgress(stage, places, filled, len(states) - filled, len(failed), died))
            return progress

    def has_place(self, study: Study) -> bool:
        """
        Whether a trial that is asked for now would get a place without waiting.

        :param study: The study
        :raises SearchComplete: when all places of the last stage are filled
        """
        with self._lock:
            self._refresh(study)
            register = self._register
            first = min((n for n in register.open if register.trials[n].state == TrialState.WAITING), default=None)
            if first in register.places and not register.is_shared(first):
                return True  # a copy of a trial whose worker died is next, and nobody has taken its place
            # Before the first trial chose, the seed of the study may still be open.
            return not register.places or self._nth_free(study, len(register.unplaced())) is not None

    # Optuna's interface.

    def before_trial(self, study: Study, trial: FrozenTrial) -> None:
        """Give the trial a place. Waits for one where there is none, and for trials before it that still choose."""
        self._raise_error_if_multi_objective(study)
        try:
            # Signs of life from the beginning on, where study.optimize will go on with them, and before the name: a trial
            # with a name but without any sign would be alive for ever on another machine.
            wait = _Wait(study, trial, _in_optimize(study, None) is not None)
            worker = workers.identity() if self.worker == "auto" else self.worker
            if worker != trial.user_attrs.get(workers.WORKER_KEY):  # a heartbeat's copy has the name of the dead
                _show(study, trial, workers.WORKER_KEY, worker)
            self._find_place(study, trial, wait)
        except BaseException:
            # Interrupted while it waited, or nothing is left to do.
            with contextlib.suppress(UpdateFinishedTrialError):
                study._storage.set_trial_state_values(trial._trial_id, TrialState.FAIL)
            raise

    def infer_relative_search_space(self, study: Study, trial: FrozenTrial) -> dict[str, BaseDistribution]:
        return space.distributions(self.max_horizon, self.max_horizon, self.operators)

    def sample_relative(self, study: Study, trial: FrozenTrial, search_space: dict[str, BaseDistribution]) -> dict[str, Any]:
        trial = study._storage.get_trial(trial._trial_id)
        claim = trial.system_attrs[PLACE_KEY]
        if claim["loss"] is not None:
            params = space.loss_to_params(AuxLoss.parse(claim["loss"]), self.operators)
            if taken := sorted(params.keys() - search_space.keys()):
                raise ValueError(f"AuxLossSampler draws whole losses, another sampler must not fix {', '.join(taken)}")
            return params
        # Enqueued: what the user left open is drawn at random, so that a valid loss comes out if there is one.
        given = {**trial.params, **trial.system_attrs.get(FIXED_KEY, {})}
        rng = np.random.default_rng([claim["seed"], claim["stage"], claim["place"], claim["attempt"]])
        for _ in range(MAX_DRAWS):
            params = {
                **space.loss_to_params(space.random_loss(rng, self.max_horizon, self.operators), self.operators),
                **given,
            }
            with contextlib.suppress(KeyError, TypeError, ValueError):
                return space.loss_to_params(space.params_to_loss(params), self.operators)
        return {}

    def sample_independent(
        self, study: Study, trial: FrozenTrial, param_name: str, param_distribution: BaseDistribution
    ) -> Any:
        """What the user searches beside the loss is drawn at random, as a function of the place like the loss itself."""
        claim = study._storage.get_trial(trial._trial_id).system_attrs[PLACE_KEY]
        key = [claim["seed"], claim["stage"], claim["place"], claim["attempt"], zlib.crc32(param_name.encode())]
        sampler = RandomSampler(int(np.random.SeedSequence(key).generate_state(1)[0]))
        return sampler.sample_independent(study, trial, param_name, param_distribution)

    def after_trial(self, study: Study, trial: FrozenTrial, state: TrialState, values: Sequence[float] | None) -> None:
        """Mark a candidate that failed in a live worker, or was pruned as invalid: its place gets another one."""
        frame = _in_optimize(study, trial)
        error = None if frame is None else frame.f_locals["func_err"]
        if isinstance(error, KeyboardInterrupt):
            study._storage.set_trial_user_attr(trial._trial_id, "interrupted", True)
            return
        # What study.optimize does not catch ends the program: it is started again as after any other death.
        ends = frame is not None and error is not None and not isinstance(error, frame.f_locals["catch"])
        innocent = ends or trial.user_attrs.get("interrupted") or trial.user_attrs.get(workers.DIED_KEY)
        failed = state == TrialState.FAIL and not innocent
        if failed or (state == TrialState.PRUNED and loss_of(trial) is None):
            study._storage.set_trial_system_attr(trial._trial_id, REJECTED_KEY, True)

    def get_trial_generation(self, study: Study, trial: FrozenTrial) -> int:
        """The trial's stage, counted from 0 as in Optuna; -1 for a trial without a place."""
        place = study._storage.get_trial(trial._trial_id).system_attrs.get(PLACE_KEY)
        return -1 if place is None else place["stage"] - 1

    def get_population(self, study: Study, generation: int) -> list[FrozenTrial]:
        """Finished trials of a stage (from 0), in the order of places."""
        with self._lock:
            self._refresh(study)
            return self._population(generation + 1)

    def get_parent_population(self, study: Study, generation: int) -> list[FrozenTrial]:
        """
        As :meth:`select_parent`, none for generation 0. Optuna would keep its first answer, even of a stage that is not
        complete yet.
        """
        return self.select_parent(study, generation) if generation > 0 else []

    def select_parent(self, study: Study, generation: int) -> list[FrozenTrial]:
        """The parents of a stage (from 0): the best of the one before, the best first."""
        return self._best(self.get_population(study, generation - 1), self._sign(study))

    # Places.

    def _refresh(self, study: Study) -> None:
        storage, study_id = study._storage, study._study_id
        # Not study.get_trials: a pruner may have wrapped the study so that it shows some of the trials only.
        trials = storage.get_all_trials(study_id, deepcopy=False)
        is_known = self._study is not None and self._study[0] is storage and self._study[1] == study_id
        # SQLite gives the number of a deleted study to the next one.
        if not is_known or _is_another(trials, self._register.trials):
            self._check_settings(study)
            self._study = (storage, study_id)
            self._register = _Register(self.operations)
            self._evolution = None
        self._register.refresh(trials)

    def _check_settings(self, study: Study) -> None:
        """Refuse to go on with a study that was begun with other settings: its places mean something else."""
        settings = {
            "population_size": self.population_size,
            "n_random": self.n_random,
            "n_prior": self.n_prior,
            "parents": self.parents,
            **self.shares,
            "max_horizon": self.max_horizon,
            "operators": None if self.operators is None else list(self.operators),
            "allow_duplicates": self.allow_duplicates,
            "screening": self.screening,
            "retries": self.retries,
        }
        begun = study._storage.get_study_system_attrs(study._study_id).get(SETTINGS_KEY)
        if begun is None:
            study._storage.set_study_system_attr(study._study_id, SETTINGS_KEY, settings)
            return
        begun = {"retries": RETRIES, **begun}
        for name, value in settings.items():
            if begun.get(name) != value:
                raise ValueError(f"this study was begun with {name}={begun.get(name)!r}, not {value!r}: use another study")

    def _find_place(self, study: Study, trial: FrozenTrial, wait: "_Wait") -> None:
        while True:
            with self._lock:
                self._refresh(study)
                register = self._register
                # A copy of a trial whose worker died brings its place.
                is_copy = trial.number in register.places
                ahead = [] if is_copy else register.unplaced(before=trial.number)
                free = None
                if is_copy:
                    if not (register.is_shared(trial.number) or register.is_given_up(trial.number, self.retries)):
                        return wait.end()
                    self._give_back(study, trial)
                elif not ahead or register.places:  # who chooses first may bring the study's seed
                    is_given = bool(trial.params) or FIXED_KEY in trial.system_attrs
                    free = self._nth_free(study, len(ahead), is_given)
                    if free is not None and self._take(study, trial, *free, is_given):
                        return wait.end()
                running = [register.trials[number] for number in register.open if number != trial.number]
            if free is not None:  # two chose the same one, and both gave way
                time.sleep(np.random.default_rng().uniform(0.0, 0.1))  # SB3 seeds the generators of the process
                continue
            wait.beat()
            workers.fail_dead(study, running, but=trial)
            wait.pause(ahead, running)

    def _nth_free(self, study: Study, n: int, enqueued: bool = False) -> tuple[int, int] | None:
        """
        The next place to give out but ``n``, None if there is none now.

        A loss that the user enqueued takes a random place if there is one: no offspring is lost.
        """
        evolution = self._get_evolution(study)
        stage = evolution.complete_stages() + 1
        if self.n_stages is not None and stage > self.n_stages:
            raise SearchComplete(f"all {self.n_stages} stages of the search are complete")
        free = [(stage, place) for place in self._free(stage)]
        if len(free) <= n and (self.n_stages is None or stage < self.n_stages):
            random = range(n_random(self.operations(stage + 1)))
            free += [(stage + 1, place) for place in self._free(stage + 1) if place in random]
        if enqueued:
            free.sort(key=lambda at: self.operations(at[0])[at[1]] != "random")
        return free[n] if n < len(free) else None

    def _free(self, stage: int) -> list[int]:
        taken = self._register.taken[stage]
        return [place for place in range(len(self.operations(stage))) if place not in taken]

    def _take(self, study: Study, trial: FrozenTrial, stage: int, place: int, is_given: bool) -> bool:
        """Take a place for a trial; False if another one has it too."""
        evolution = self._get_evolution(study)
        before = list(self._register.holders[stage, place])
        attempt = self._register.attempt(stage, place, self.retries)
        operation, loss = "enqueued", None
        parents: list[int] = []
        left_over = None if is_given else self._register.enqueued(stage, place, self.retries)
        if not is_given and left_over is None:
            candidate = evolution.candidate(stage, place, attempt)
            operation, parents, loss = candidate.operation, list(candidate.parents), str(candidate.loss)
        storage, trial_id = study._storage, trial._trial_id
        drawn = {"loss": loss, "operation": operation, "parents": parents}
        claim = {"stage": stage, "place": place, "attempt": attempt, "seed": evolution.seed, **drawn}
        storage.set_trial_system_attr(trial_id, PLACE_KEY, claim)
        # Others may have seen other trials without a place, and choose the same one at this moment. So everybody looks back,
        # and gives way if he is not alone: one of two, at least, sees the other. Also if the other one has failed since: what
        # was drawn here may be what failed.
        self._refresh(study)
        if self._register.holders[stage, place] != sorted([*before, trial.number]):
            self._give_back(study, trial)
            return False
        if left_over is not None:
            storage.set_trial_system_attr(trial_id, FIXED_KEY, left_over)
            trial.system_attrs[FIXED_KEY] = left_over
        # For people: what a lineage in the dashboard is made of.
        shown: dict[str, Any] = {"stage": stage, "place": place, "operation": operation, "parents": parents}
        if attempt:
            replaced = max(number for number in self._register.holders[stage, place] if number != trial.number)
            reason = self._register.trials[replaced].user_attrs.get("reason", "it failed")
            logger.warning("Trial %d is given up for another candidate: %s", replaced, reason)
            shown["replaces"] = replaced
        for key, value in shown.items():
            _show(study, trial, key, value)
        return True

    def _give_back(self, study: Study, trial: FrozenTrial) -> None:
        study._storage.set_trial_system_attr(trial._trial_id, PLACE_KEY, None)
        self._refresh(study)
        if self._evolution is not None and self._register.places and self._evolution.seed != self._study_seed():
            self._evolution = None  # at the very beginning

    # Evolution.

    def _get_evolution(self, study: Study) -> "_Evolution":
        if self._evolution is None:
            self._evolution = _Evolution(self, self._register, self._study_seed(), self._sign(study))
        return self._evolution

    def _study_seed(self) -> int:
        """The seed of the first trial that got a place, so that all workers use one."""
        first = min((number for numbers in self._register.holders.values() for number in numbers), default=None)
        if first is None:
            return int(np.random.SeedSequence().generate_state(1)[0]) if self.seed is None else self.seed
        seed = self._register.trials[first].system_attrs[PLACE_KEY]["seed"]
        if self.seed not in (None, seed):
            logger.warning("The study goes on with its own seed %d, not with %d", seed, self.seed)
        return seed

    @staticmethod
    def _sign(study: Study) -> float:
        return 1.0 if study.direction == StudyDirection.MAXIMIZE else -1.0

    def _population(self, stage: int) -> list[FrozenTrial]:
        holders = (holder for place in range(len(self.operations(stage))) for holder in self._register.held_by(stage, place))
        return [holder for holder in holders if holder.state in FILLED]

    def _best(self, population: list[FrozenTrial], sign: float) -> list[FrozenTrial]:
        """
        The best share of a stage; equal scores in the order of places, those that were pruned or have no finite score behind
        all others.
        """

        def rank(trial: FrozenTrial) -> tuple[bool, float]:
            if trial.state == TrialState.PRUNED or trial.value is None or not math.isfinite(trial.value):
                return True, 0.0
            return False, -sign * trial.value

        return sorted(population, key=rank)[: max(1, round(self.parents * len(population)))]


def _in_optimize(study: Study, trial: FrozenTrial | None) -> FrameType | None:
    """
    The frame in which ``study.optimize`` tells of a trial, or asks for one; None where somebody else does. Optuna does not
    tell a sampler who asks, nor why a trial failed.

    :param study: The study
    :param trial: The trial that it tells of, None if it asks
    """
    frame = inspect.currentframe()
    while frame is not None and frame.f_code is not _run_trial.__code__:
        frame = frame.f_back
    if frame is None:
        return None
    # An objective may ask for trials too, of this study or of another one.
    of, its = frame.f_locals["study"], frame.f_locals.get("trial")
    is_same = of._storage is study._storage and of._study_id == study._study_id
    return frame if is_same and (None if its is None else its._trial_id) == (trial and trial._trial_id) else None


def _is_another(trials: Sequence[FrozenTrial], before: Sequence[FrozenTrial]) -> bool:
    """Whether these are not the trials of before, and maybe more."""
    if len(trials) < len(before):
        return True
    started = before[0].datetime_start if before else None
    return started is not None and trials[0].datetime_start != started


def _show(study: Study, trial: FrozenTrial, key: str, value: Any) -> None:
    """Set a user attribute of a trial that is asked for; ``trial.user_attrs`` in the objective has it too."""
    study._storage.set_trial_user_attr(trial._trial_id, key, value)
    trial.user_attrs[key] = value


def _is_invalid(trial: FrozenTrial) -> bool:
    """Whether a trial was pruned because it was no loss: that costs nothing, and fills no place."""
    return trial.state == TrialState.PRUNED and REJECTED_KEY in trial.system_attrs


class _Wait:
    """Waiting for a place: cheap, visible in the log and as a user attribute, and not for the dead."""

    def __init__(self, study: Study, trial: FrozenTrial, in_optimize: bool):
        self.study = study
        self.trial = trial
        self.in_optimize = in_optimize
        storage: Any = study._storage
        # Twice in an interval, as long as this waits.
        self.beat_every = storage.get_heartbeat_interval() / 2 if in_optimize and is_heartbeat_enabled(storage) else math.inf
        self.beaten = -math.inf
        self.beat()
        self.delay = 0.001
        self.queue: list[int] = []
        self.shown = 0.0
        self.signs: dict[int, tuple[Any, float]] = {}

    def beat(self) -> None:
        """Give a sign of life, where it is time for one."""
        if self.beat_every < math.inf and time.monotonic() - self.beaten >= self.beat_every:
            self.beaten = time.monotonic()
            workers.beat(self.study._storage, self.trial._trial_id)

    def pause(self, ahead: list[FrozenTrial], running: list[FrozenTrial]) -> None:
        """
        :param ahead: Trials that have to choose a place before
        :param running: Trials whose places may become free, or whose stage may end
        """
        now = time.monotonic()
        queue = [other.number for other in ahead]
        if queue != self.queue:  # it moves: the turn of this trial may be near
            self.queue, self.delay = queue, 0.001
        for other in ahead:
            sign = other.user_attrs.get(WAITING_KEY)
            if self.signs.get(other.number, (None, 0.0))[0] != sign or other.number not in self.signs:
                self.signs[other.number] = (sign, now)
            elif now - self.signs[other.number][1] > ORPHAN_SECONDS:
                logger.warning("Trial %d never got a place, its worker seems to have died", other.number)
                workers.fail(self.study, other, "its worker died before it got a place")
        if now - self.shown > ORPHAN_SECONDS / 6 and self.delay > 0.1:
            if not (self.shown or self.in_optimize):
                logger.warning(
                    "study.ask() waits for a place until one of the %d trials that run is told. Whoever asks for several "
                    "before he tells has sampler.has_place(study) to know how many there are",
                    len(running),
                )
            self.shown = now
            logger.info("Trial %d waits for a place: %d trials run", self.trial.number, len(running))
            # Changes each time: a sign of life for the trials behind this one.
            storage = self.study._storage
            storage.set_trial_user_attr(
                self.trial._trial_id, WAITING_KEY, f"for a place, {len(running)} trials run ({now:.0f})"
            )
        time.sleep(self.delay)
        self.delay = min(1.0, 1.5 * self.delay)

    def end(self) -> None:
        """The trial has its place."""
        if self.shown:
            self.study._storage.set_trial_user_attr(self.trial._trial_id, WAITING_KEY, None)


class _Evolution:
    """
    The candidates of all places, as a function of seed, settings and finished stages.

    Stages are planned place by place in one order, because a candidate must not repeat those before it.

    :param sampler: Its settings
    :param register: Who has which place
    :param seed: Seed of the study
    :param sign: -1 where scores are minimized
    """

    def __init__(self, sampler: AuxLossSampler, register: _Register, seed: int, sign: float):
        self.sampler = sampler
        self.register = register
        self.seed = seed
        self.sign = sign
        self.plans: defaultdict[int, list[Candidate]] = defaultdict(list)
        self.seen: dict[AuxLoss, None] = {}  # canonical forms, in the order in which they came
        self.model = TokenModel(sampler.max_horizon)
        # Of each complete stage: all trials with their losses, those of them that are parents, and that may be crossed.
        self._losses: list[list[tuple[int, AuxLoss]]] = []
        self._parents: list[list[tuple[int, AuxLoss]]] = []
        self._crossed: list[list[tuple[int, AuxLoss]]] = []
        self._n_seen: dict[int, int] = {}  # how many there were when the random places of a stage were planned

    def complete_stages(self) -> int:
        """How many stages are complete; takes note of the trials of those that have become so."""
        register = self.register
        while True:
            stage = len(self._losses) + 1
            if len(register.filled[stage]) < self._size(stage):
                return stage - 1
            holders = [register.held_by(stage, place)[0] for place in range(self._size(stage))]
            self._plan_random(stage + 1)  # while the stage before is still the last one known
            losses = {holder.number: loss for holder in holders if (loss := loss_of(holder)) is not None}
            if not losses:
                raise RuntimeError(f"no trial of stage {stage} has a loss: the objective has to call suggest_aux_loss")
            population = [holder for holder in holders if holder.number in losses]
            self.seen |= dict.fromkeys(loss.canonical() for loss in losses.values())
            if self.sampler.screening > 1:
                # A pruned trial counts with the score that it was pruned for.
                scored = [(losses[trial.number], self.sign * trial.value) for trial in population if trial.value is not None]
                self.model.add([loss for loss, _ in scored], [score for _, score in scored])
            everybody = list(losses.items())
            parents = [(trial.number, losses[trial.number]) for trial in self.sampler._best(population, self.sign)]
            pairs = [parent for parent in parents if _partners(*parent, parents)]
            self._losses.append(everybody)
            self._parents.append(parents)
            self._crossed.append(pairs or [parent for parent in parents if _partners(*parent, everybody)])

    def candidate(self, stage: int, place: int, attempt: int) -> Candidate:
        """
        The candidate of a place.

        :param stage: Number of the stage, from 1
        :param place: Number of the place, from 0
        :param attempt: How many candidates of this place failed
        """
        if stage == len(self._losses) + 1:
            self._plan(stage, place + 1)
            # One more each time, so that what is planned for the next stage does not come all at once.
            if len(self.plans[stage]) < self._size(stage):
                self._plan(stage, len(self.plans[stage]) + 1)
            else:
                self._plan(stage + 1, min(len(self.plans[stage + 1]) + 1, n_random(self.sampler.operations(stage + 1))))
        else:
            self._plan_random(stage)
        candidate = self.plans[stage][place]
        if attempt:
            # Not to repeat what is planned, as far as it is known however early this is asked for.
            is_early = stage > 1 and self.sampler.operations(stage)[place] == "random"
            last = stage if is_early else stage + 1
            self._plan_random(last)
            seen = dict.fromkeys(islice(self.seen, self._n_seen[last]))
            for number in range(1, attempt + 1):
                candidate = self._draw(stage, place, number, seen)
                seen[candidate.loss.canonical()] = None
        return candidate

    def _size(self, stage: int) -> int:
        return len(self.sampler.operations(stage))

    def _plan_random(self, stage: int) -> None:
        """Plan the whole stage before this one, and of this one what needs no parents."""
        if stage not in self._n_seen:
            self._plan(stage - 1, self._size(stage - 1))
            self._plan(stage, n_random(self.sampler.operations(stage)))
            self._n_seen[stage] = len(self.seen)

    def _plan(self, stage: int, n_places: int) -> None:
        """Plan the first places of a stage, as many as asked for."""
        plan = self.plans[stage]
        while len(plan) < n_places:
            place = len(plan)
            plan.append(self._given_out(stage, place) or self._draw(stage, place, 0, self.seen))
            self.seen[plan[-1].loss.canonical()] = None

    def _given_out(self, stage: int, place: int) -> Candidate | None:
        """The first candidate of a place where the storage has it already: another worker, or an earlier run, has drawn it."""
        for number in self.register.holders.get((stage, place), ()):
            claim = self.register.trials[number].system_attrs[PLACE_KEY]
            # Claims of studies begun before say no parents, and are drawn again.
            if claim["attempt"] == 0 and claim["loss"] is not None and claim["seed"] == self.seed and "parents" in claim:
                return Candidate(AuxLoss.parse(claim["loss"]), claim["operation"], tuple(claim["parents"]))
        return None

    def _draw(self, stage: int, place: int, attempt: int, seen: Container[AuxLoss]) -> Candidate:
        rng = np.random.default_rng([self.seed, stage, place, attempt])
        operation = self.sampler.operations(stage)[place]
        # What replaces a failed random loss has to be the same before and after the model learns of another stage.
        if self.sampler.screening == 1 or not self.model.n_trials or (attempt and operation == "random"):
            return self._draw_new(rng, operation, stage, place, seen)
        offspring: dict[AuxLoss, Candidate] = {}  # of different canonical forms
        for _ in range(self.sampler.screening):
            candidate = self._draw_new(rng, operation, stage, place, seen)
            offspring.setdefault(candidate.loss.canonical(), candidate)
        return list(offspring.values())[self.model.best(list(offspring), self.model.draw(rng))]

    def _draw_new(
        self, rng: np.random.Generator, operation: str, stage: int, place: int, seen: Container[AuxLoss]
    ) -> Candidate:
        """One offspring, drawn again while it is invalid or was there before."""
        candidate = None
        for _ in range(MAX_DRAWS):
            try:
                candidate = self._offspring(rng, operation, stage, place)
            except mutations.RejectedLoss:
                continue
            if self.sampler.allow_duplicates or candidate.loss.canonical() not in seen:
                return candidate
        if operation in ("crossover", "horizon_change"):
            # No pair of one horizon, two parents that are almost equal, a space of one horizon.
            return self._draw_new(rng, "replacement", stage, place, seen)
        if candidate is None:
            raise RuntimeError(f"no valid loss in {MAX_DRAWS} draws by {operation}")
        logger.info("No new loss in %d draws by %s: place %d of stage %d repeats one", MAX_DRAWS, operation, place, stage)
        return candidate

    def _offspring(self, rng: np.random.Generator, operation: str, stage: int, place: int) -> Candidate:
        sampler = self.sampler
        if operation == "random":
            return Candidate(space.random_loss(rng, sampler.max_horizon, sampler.operators), operation)
        if operation == "prior":
            prior = space.PRIORS[place % len(space.PRIORS)]
            return Candidate(prior(rng, sampler.max_horizon, sampler.operators), operation)
        parents = self._parents[stage - 2]
        mothers = self._crossed[stage - 2] if operation == "crossover" else parents
        if not mothers:
            raise mutations.RejectedLoss(f"no parent has another candidate of its horizon in stage {stage - 1}")
        number, loss = mothers[rng.integers(len(mothers))]
        if operation == "replacement":
            return Candidate(mutations.replacement(loss, rng, sampler.operators), operation, (number,))
        if operation == "horizon_change":
            return Candidate(mutations.horizon_change(loss, rng, sampler.max_horizon), operation, (number,))
        partners = _partners(number, loss, parents) or _partners(number, loss, self._losses[stage - 2])
        other_number, other = partners[rng.integers(len(partners))]
        return Candidate(mutations.crossover(loss, other, rng), operation, (number, other_number))


def _partners(number: int, loss: AuxLoss, losses: Iterable[tuple[int, AuxLoss]]) -> list[tuple[int, AuxLoss]]:
    return [(other, partner) for other, partner in losses if other != number and partner.horizon == loss.horizon]


def n_random(operations: Sequence[str]) -> int:
    """How many places of a later stage are random; they come first."""
    return sum(operation == "random" for operation in operations)


def _apportion(shares: dict[str, float], total: int) -> dict[str, int]:
    """Whole numbers that sum to ``total``, as near to the shares as can be (largest remainders)."""
    exact = {name: round(share * total, 9) for name, share in shares.items()}
    counts = {name: int(value) for name, value in exact.items()}
    by_remainder = sorted(exact, key=lambda name: counts[name] - exact[name])
    for name in by_remainder[: total - sum(counts.values())]:
        counts[name] += 1
    return counts
