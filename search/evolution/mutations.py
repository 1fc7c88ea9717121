"""The paper's mutations of a loss (section 2.2, figure 3, A.3), and of other parameters. A ValueError means: draw again."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution
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


def other_parameter(value: Any, distribution: BaseDistribution, rng: np.random.Generator) -> Any:
    """
    Keep the parent's value of a parameter with probability 0.5. Else draw one of the categories, or a number near the
    parent's: normal, with a fifth of the range (of its logarithm, if the distribution is ``log``) as deviation.
    """
    if rng.random() < 0.5:
        return value
    if isinstance(distribution, CategoricalDistribution):
        return distribution.choices[rng.integers(len(distribution.choices))]
    assert isinstance(distribution, IntDistribution | FloatDistribution)
    half = 0.5 * (distribution.step or 0)  # as if every number of a grid stood for its surroundings
    scale, unscale = (np.log, np.exp) if distribution.log else (float, float)
    low, high = scale(distribution.low - half), scale(distribution.high + half)
    while True:
        number = float(unscale(rng.normal(scale(value), 0.2 * (high - low))))
        if distribution.step is not None:
            steps = round((number - distribution.low) / distribution.step)
            number = distribution.low + distribution.step * steps
            if steps == round((distribution.high - distribution.low) / distribution.step):
                number = distribution.high  # 0.3, where the sum is 0.30000000000000004
        if distribution.low <= number <= distribution.high:
            return int(number) if isinstance(distribution, IntDistribution) else number
