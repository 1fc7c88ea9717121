"""The paper's mutations of a loss (section 2.2, figure 3, A.3). A ValueError means: draw again."""

from collections.abc import Sequence

import numpy as np
from sb3_aarl.search.evolution.space import MAX_HORIZON, random_operator

from sb3_aarl.aux_loss import AuxLoss


def replacement(loss: AuxLoss, rng: np.random.Generator, operators: Sequence[str] | None = None) -> AuxLoss:
    """
    Flip each bit of both masks with probability 1 / (2 (3k + 1)), k being the horizon. Where operators are searched too (the
    paper does not say how), the operator is redrawn and negatives are switched with the same probability.
    """
    flip_rate = 1 / (2 * (3 * loss.horizon + 1))
    flips = rng.random((2, 3 * loss.horizon + 1)) < flip_rate
    source, target = (np.array((loss.source, loss.target)) ^ flips).tolist()
    operator, negatives = loss.operator, loss.negatives
    if operators is not None:
        operator = random_operator(rng, operators)[0] if rng.random() < flip_rate else operator
        negatives ^= bool(rng.random() < flip_rate)
    return AuxLoss(loss.horizon, source, target, operator, negatives)


def crossover(loss: AuxLoss, other: AuxLoss, rng: np.random.Generator) -> AuxLoss:
    """Take each bit of both masks, and the operator, from one of two parents of one horizon at random."""
    from_other = rng.random((2, 3 * loss.horizon + 1)) < 0.5
    source, target = np.where(from_other, (other.source, other.target), (loss.source, loss.target)).tolist()
    operator = loss if rng.random() < 0.5 else other
    return AuxLoss(loss.horizon, source, target, operator.operator, operator.negatives)


def horizon_change(loss: AuxLoss, rng: np.random.Generator, max_horizon: int = MAX_HORIZON) -> AuxLoss:
    """
    Drop the last step (action, reward, state) of both masks, or append three random bits to each. Both ways are equally
    probable; at the ends of 1..max_horizon only one is left.
    """
    ways = [change for change in (-1, 1) if 1 <= loss.horizon + change <= max_horizon]
    if not ways:
        raise ValueError(f"the horizon of {loss} cannot change between 1 and {max_horizon}")
    change = ways[rng.integers(len(ways))]
    if change < 0:
        source, target = loss.source[:-3], loss.target[:-3]
    else:
        added = (rng.random((2, 3)) < 0.5).tolist()
        source, target = loss.source + tuple(added[0]), loss.target + tuple(added[1])
    return AuxLoss(loss.horizon + change, source, target, loss.operator, loss.negatives)
