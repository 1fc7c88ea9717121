"""The candidates of all slots, as a function of seed, settings and the results of earlier generations."""

import contextlib
import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from sb3_aarl.search.evolution import mutations, space
from sb3_aarl.search.evolution.surrogate import TokenModel

from sb3_aarl import catalog
from sb3_aarl.aux_loss import AuxLoss

# Draws for one slot before a duplicate is accepted: only very small spaces run out of new losses.
MAX_DRAWS = 300

ParentSelection = Literal["best", "posterior"]
IsKnown = Callable[[AuxLoss], bool]  # whether the search has a canonical form already


@dataclass(eq=False, repr=False, kw_only=True)
class Settings:
    """What decides the candidates of a search; the arguments of ``AuxLossSampler``, where they are explained."""

    population_size: int = 100
    n_random: int = 100
    n_prior: int = 25
    parents: float = 0.25
    replacement: float = 0.5
    crossover: float = 0.2
    horizon_change: float = 0.1
    random: float = 0.2
    max_horizon: int = space.MAX_HORIZON
    operators: Sequence[str] | None = None
    allow_duplicates: bool = False
    seed: int | None = None
    screening: int = 1
    n_generations: int | None = None
    initial: Sequence[Any] = ()
    parent_selection: ParentSelection = "best"
    again: float = 0.0
    climbing: int = 0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if isinstance(value, np.generic):  # which no storage takes
                setattr(self, name, value.item())
        self.operators = None if self.operators is None else tuple(self.operators)
        losses = [catalog.resolve(loss) for loss in self.initial]
        self.initial = tuple(losses if self.allow_duplicates else {loss.canonical(): loss for loss in losses}.values())
        shares = {name: getattr(self, name) for name in ("random", "replacement", "crossover", "horizon_change")}
        self._check_arguments(shares)
        # Operations of all slots. Random ones come first in later generations: they need no parents.
        self._first = ["given"] * len(self.initial) + ["random"] * self.n_random + ["prior"] * self.n_prior
        n_again = round(self.again * self.population_size)
        counts = {**_apportion(shares, self.population_size - n_again), "again": n_again}
        self._later = [name for name, count in counts.items() for _ in range(count)]

    def _check_arguments(self, shares: dict[str, float]) -> None:
        least = dict.fromkeys(("population_size", "max_horizon", "screening", "n_generations"), 1)
        least |= dict.fromkeys((*shares, "climbing", "n_random", "n_prior", "seed", "again"), 0)
        for name, low in least.items():
            if (number := getattr(self, name)) is not None and not number >= low:
                raise ValueError(f"{name} must be at least {low}, not {number}")
            if name not in (*shares, "again") and not isinstance(number, int | None):
                raise ValueError(f"{name} must be a whole number, not {number}")
        if not (self.n_random or self.n_prior or self.initial):
            raise ValueError("n_random, n_prior and initial must not all be empty")
        if abs(sum(shares.values()) - 1) > 1e-9:
            raise ValueError(f"the shares {', '.join(shares)} must sum to 1, not {sum(shares.values())}")
        if not 0 < self.parents <= 1 or self.again > 1:
            raise ValueError(f"parents and again must be shares up to 1, not {self.parents} and {self.again}")
        if self.parent_selection not in get_args(ParentSelection):
            raise ValueError(f"parent_selection must be best or posterior, not {self.parent_selection!r}")
        space.check_operators(self.operators)
        for loss in self.initial:
            space.loss_to_params(loss, self.operators)
            if loss.horizon > self.max_horizon:
                raise ValueError(f"initial has {loss}, whose horizon is longer than {self.max_horizon}")

    def operations(self, generation: int) -> list[str]:
        """The operation of every slot of a generation."""
        return self._first if generation == 1 else self._later


class Candidate(NamedTuple):
    """A loss for one slot, how it was made, the numbers of the trials that it stems from, and which seed it trains."""

    loss: AuxLoss
    operation: str
    parents: tuple[int, ...] = ()
    seed_index: int = 0


class Result(NamedTuple):
    """The finished trial of a slot."""

    number: int
    loss: AuxLoss
    score: float  # higher is better; NaN where the trial was pruned or infeasible, or its score is not finite


class Candidates:
    """
    The candidates of one study.

    They are planned in rounds. Round g starts when generation g - 1 is over. It has the slots of generation g that need
    parents (in the first one all), and then the random ones of generation g + 1. It knows none of its own results.
    """

    def __init__(self, settings: Settings, seed: int):
        self.settings = settings
        self.seed = seed
        self.generation = 1  # the first one that is not over
        self.parents: list[Result] = []
        self.model = TokenModel(settings.max_horizon)
        self.known: dict[AuxLoss, Result] = {}  # the first scored trial of each canonical form
        self.plan: dict[tuple[int, int], Candidate] = {}
        self.to_plan = deque(self._round())
        # Canonical forms in the order in which they came, and how many there were at the end of each round.
        self.seen: dict[AuxLoss, int] = {}
        self.n_seen: dict[int, int] = {}

    def of_slot(self, generation: int, slot: int, attempt: int) -> Candidate:
        """The candidate of a slot of a generation (from 1), of which ``attempt`` candidates have failed."""
        if slot >= len(self.settings.operations(generation)):
            while self.to_plan:
                self._plan_next()
            return self._draw(generation, slot, 0, self.seen.__contains__)
        if attempt == 0:
            while (generation, slot) not in self.plan:
                self._plan_next()
            return self.plan[generation, slot]
        number = self._round_of(generation, slot)
        while number == self.generation and self.to_plan:
            self._plan_next()
        # What the round knew at its end: a random slot may fail before and after the generation before it is over.
        n_seen, attempts = self.n_seen[number], set[AuxLoss]()
        for number in range(1, attempt + 1):
            candidate = self._draw(
                generation, slot, number, lambda form: form in attempts or self.seen.get(form, n_seen) < n_seen
            )
            attempts.add(candidate.loss.canonical())
        return candidate

    def end_generation(self, results: Sequence[Result], late: Sequence[Result] = ()) -> None:
        """
        Choose the parents of the next generation; results are in the order of slots, which is the order of equal ones.
        ``late`` are those of generations before that came since the last one was over: known, and no parents by their score.
        """
        while self.to_plan:
            self._plan_next()
        for result in (*results, *late):
            self.seen.setdefault(result.loss.canonical(), len(self.seen))
        scored, scored_late = ([result for result in some if not math.isnan(result.score)] for some in (results, late))
        for result in scored + scored_late:
            self.known.setdefault(result.loss.canonical(), result)
        settings, ratings, of_whom = self.settings, [result.score for result in scored], scored
        if settings.screening > 1 or settings.climbing or settings.again or settings.parent_selection == "posterior":
            every = scored + scored_late
            self.model.add([result.loss for result in every], [result.score for result in every])
        if settings.parent_selection == "posterior" and self.model.scores:
            of_whom = list(self.known.values())
            ratings = list(self.model.posterior([result.loss for result in of_whom])[0])
        n_parents = max(1, round(settings.parents * len(results)))
        order = sorted(range(len(of_whom)), key=lambda index: -ratings[index])
        self.parents = [of_whom[index] for index in order[:n_parents]] or self.parents or list(results)
        self.generation += 1
        self.to_plan.extend(self._round())

    def _round_of(self, generation: int, slot: int) -> int:
        is_early = generation > 1 and self.settings.operations(generation)[slot] == "random"
        return generation - is_early

    def _round(self) -> list[tuple[int, int]]:
        generations = (self.generation, self.generation + 1)
        slots = [(number, slot) for number in generations for slot in range(len(self.settings.operations(number)))]
        return [slot for slot in slots if self._round_of(*slot) == self.generation]

    def _plan_next(self) -> None:
        slot = self.to_plan[0]
        self.plan[slot] = self._draw(*slot, 0, self.seen.__contains__)
        self.seen.setdefault(self.plan[slot].loss.canonical(), len(self.seen))
        self.to_plan.popleft()
        if not self.to_plan:
            self.n_seen[self.generation] = len(self.seen)

    def _draw(self, generation: int, slot: int, attempt: int, is_known: IsKnown) -> Candidate:
        rng = np.random.default_rng([self.seed, generation, slot, attempt])
        operations = self.settings.operations(generation)
        operation = operations[slot % len(operations)]
        if operation == "given" and slot < len(operations) and attempt == 0:
            return Candidate(self.settings.initial[slot], operation)
        if operation == "again":
            if slot < len(operations) and attempt == 0 and self.model.scores:
                return self._again(rng)
            operation = "replacement"
        # What replaces a failed random loss must not depend on whether the model knows another generation by then.
        is_early = attempt > 0 and operation == "random"
        if not (self.settings.screening > 1 or self.settings.climbing) or not self.model.scores or is_early:
            return self._draw_new(rng, operation, slot, is_known)
        offspring: list[Candidate] = []
        for _ in range(self.settings.screening):
            offspring.append(self._draw_new(rng, operation, slot, is_known))
            operation = offspring[-1].operation  # that of a crossover that is not possible is another one
        ratings = self.model.draw([candidate.loss for candidate in offspring], rng, own=False)
        best = offspring[int(np.argmax(ratings))]
        return best._replace(loss=self._climb(best.loss, abs(rng.standard_normal()), is_known))

    def _climb(self, loss: AuxLoss, optimism: float, is_known: IsKnown) -> AuxLoss:
        """Step by step to the one with one token more or less, of those that are new, which the model rates highest."""
        for _ in range(self.settings.climbing):
            higher = self.model.higher(loss, optimism)
            better = next((other for other in higher if self.settings.allow_duplicates or not is_known(other)), None)
            if better is None:
                break
            loss = better
        return loss

    def _again(self, rng: np.random.Generator) -> Candidate:
        """Thompson sampling: the loss that one draw from the posterior of all losses rates highest, with its next seed."""
        results = list(self.known.values())
        best = results[int(np.argmax(self.model.draw([result.loss for result in results], rng)))]
        n_before = sum(planned.operation == "again" and planned.loss == best.loss for planned in self.plan.values())
        return Candidate(best.loss, "again", (best.number,), 1 + n_before)

    def _draw_new(self, rng: np.random.Generator, operation: str, slot: int, is_known: IsKnown) -> Candidate:
        """One offspring, redrawn while it is invalid or known."""
        candidate = None
        for _ in range(MAX_DRAWS):
            with contextlib.suppress(ValueError):
                candidate = self._offspring(rng, operation, slot)
                if self.settings.allow_duplicates or not is_known(candidate.loss.canonical()):
                    return candidate
        if operation in ("crossover", "horizon_change"):
            # No two parents of one horizon, two that are almost equal, a space of one horizon.
            return self._draw_new(rng, "replacement", slot, is_known)
        if candidate is None:
            raise RuntimeError(f"no valid loss in {MAX_DRAWS} draws by {operation}")
        return candidate

    def _offspring(self, rng: np.random.Generator, operation: str, slot: int) -> Candidate:
        max_horizon, operators = self.settings.max_horizon, self.settings.operators
        if operation == "prior":
            prior = space.PRIORS[slot % len(space.PRIORS)]
            return Candidate(prior(rng, max_horizon, operators), operation)
        if operation in ("random", "given"):
            return Candidate(space.random_loss(rng, max_horizon, operators), "random")
        if not self.parents:
            raise RuntimeError("no trial of the last generation has a loss: the objective has to call suggest_aux_loss")
        parent = self.parents[rng.integers(len(self.parents))]
        if operation == "replacement":
            return Candidate(mutations.replacement(parent.loss, rng, operators), operation, (parent.number,))
        if operation == "horizon_change":
            return Candidate(mutations.horizon_change(parent.loss, rng, max_horizon), operation, (parent.number,))
        partners = [other for other in self.parents if other is not parent and other.loss.horizon == parent.loss.horizon]
        if not partners:
            raise ValueError(f"no other parent has horizon {parent.loss.horizon}")
        other = partners[rng.integers(len(partners))]
        return Candidate(mutations.crossover(parent.loss, other.loss, rng), operation, (parent.number, other.number))


def _apportion(shares: dict[str, float], total: int) -> dict[str, int]:
    """Whole numbers that sum to ``total``, as near to the shares as can be (largest remainders)."""
    exact = {name: round(share * total, 9) for name, share in shares.items()}
    counts = {name: int(value) for name, value in exact.items()}
    by_remainder = sorted(exact, key=lambda name: counts[name] - exact[name])
    for name in by_remainder[: total - sum(counts.values())]:
        counts[name] += 1
    return counts
