"""The candidates of all slots, as a function of seed, settings and the results of earlier generations."""

import contextlib
import logging
import math
from collections import deque
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from sb3_aarl.search.evolution import mutations, space
from sb3_aarl.search.evolution.surrogate import TokenModel

from sb3_aarl.aux_loss import AuxLoss

if TYPE_CHECKING:
    from sb3_aarl.search.evolution.sampler import AuxLossSampler

logger = logging.getLogger(__name__)

# Draws for one slot before a duplicate is accepted: only very small spaces run out of new losses.
MAX_DRAWS = 300

IsKnown = Callable[[AuxLoss], bool]  # whether the search has a canonical form already


class Candidate(NamedTuple):
    """A loss for one slot, how it was made, and the numbers of the trials that it stems from."""

    loss: AuxLoss
    operation: str
    parents: tuple[int, ...] = ()


class Result(NamedTuple):
    """The finished trial of a slot."""

    number: int
    loss: AuxLoss
    score: float  # higher is better; NaN where the trial was pruned or infeasible, or its score is not finite


class Candidates:
    """
    The candidates of one study.

    They are planned in rounds. Round g starts when generation g - 1 is over. It has the slots of generation g that need
    parents (in the first one all), and then the random ones of generation g + 1. It knows nothing of its own results, so
    that the plan does not depend on the order in which trials finish.
    """

    def __init__(self, sampler: "AuxLossSampler", seed: int):
        self.sampler = sampler
        self.seed = seed
        self.generation = 1  # the first one that is not over
        self.parents: list[Result] = []
        self.model = TokenModel(sampler.max_horizon)
        self.plan: dict[tuple[int, int], Candidate] = {}
        self.to_plan = deque(self._round())
        # Canonical forms in the order in which they came, and how many there were at the end of each round.
        self.seen: dict[AuxLoss, int] = {}
        self.n_seen: dict[int, int] = {}

    def of_slot(self, generation: int, slot: int, attempt: int) -> Candidate:
        """The candidate of a slot of a generation (from 1), of which ``attempt`` candidates have failed."""
        if slot >= len(self.sampler.operations(generation)):
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

    def end_generation(self, results: Sequence[Result]) -> None:
        """Choose the parents of the next generation; results are in the order of slots, which is the order of equal ones."""
        while self.to_plan:
            self._plan_next()
        for result in results:
            self.seen.setdefault(result.loss.canonical(), len(self.seen))
        scored = [result for result in results if not math.isnan(result.score)]
        if self.sampler.screening > 1:
            self.model.add([result.loss for result in scored], [result.score for result in scored])
        n_parents = max(1, round(self.sampler.parents * len(results)))
        self.parents = sorted(scored, key=lambda result: -result.score)[:n_parents] or list(results)
        self.generation += 1
        self.to_plan.extend(self._round())

    def _round_of(self, generation: int, slot: int) -> int:
        is_early = generation > 1 and self.sampler.operations(generation)[slot] == "random"
        return generation - is_early

    def _round(self) -> list[tuple[int, int]]:
        generations = (self.generation, self.generation + 1)
        slots = [(number, slot) for number in generations for slot in range(len(self.sampler.operations(number)))]
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
        operations = self.sampler.operations(generation)
        operation = operations[slot % len(operations)]
        if operation == "given" and slot < len(operations) and attempt == 0:
            return Candidate(self.sampler.initial[slot], operation)
        # What replaces a failed random loss must not depend on whether the model knows another generation by then.
        is_early = attempt > 0 and operation == "random"
        if self.sampler.screening == 1 or not self.model.losses or is_early:
            return self._draw_new(rng, operation, slot, is_known)
        offspring = [self._draw_new(rng, operation, slot, is_known) for _ in range(self.sampler.screening)]
        return offspring[self.model.best([candidate.loss for candidate in offspring], self.model.draw(rng))]

    def _draw_new(self, rng: np.random.Generator, operation: str, slot: int, is_known: IsKnown) -> Candidate:
        """One offspring, redrawn while it is invalid or known."""
        candidate = None
        for _ in range(MAX_DRAWS):
            with contextlib.suppress(ValueError):
                candidate = self._offspring(rng, operation, slot)
                if self.sampler.allow_duplicates or not is_known(candidate.loss.canonical()):
                    return candidate
        if operation in ("crossover", "horizon_change"):
            # No two parents of one horizon, two that are almost equal, a space of one horizon.
            return self._draw_new(rng, "replacement", slot, is_known)
        if candidate is None:
            raise RuntimeError(f"no valid loss in {MAX_DRAWS} draws by {operation}")
        logger.info("No new loss in %d draws by %s: %s is a duplicate", MAX_DRAWS, operation, candidate.loss)
        return candidate

    def _offspring(self, rng: np.random.Generator, operation: str, slot: int) -> Candidate:
        max_horizon, operators = self.sampler.max_horizon, self.sampler.operators
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
