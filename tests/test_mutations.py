"""The paper's mutations: laws of what may come out, and the exact distribution of what does."""

from collections import Counter
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sb3_aarl.search.evolution.mutations import crossover, horizon_change, replacement
from sb3_aarl.search.evolution.space import random_loss
from scipy.stats import binomtest, chisquare
from test_space import losses

from sb3_aarl.aux_loss import OPERATORS, AuxLoss

PARENT = AuxLoss.parse("{s_t, a_t} -> {s_t+1}")
seeds = st.integers(0, 2**32)


def as_array(loss: AuxLoss) -> np.ndarray:
    return np.array([loss.source, loss.target])


def test_replacement_flips_each_bit_independently_with_half_a_flip_in_each_mask() -> None:
    rate = 1 / (2 * 4)
    outcomes = {}
    for bits in product([False, True], repeat=8):
        if any(bits[:4:3]) and any(bits[4:]):
            flips = np.sum(np.array(bits).reshape(2, 4) != as_array(PARENT))
            outcomes[bits] = rate**flips * (1 - rate) ** (8 - flips)
    chance_of_valid = sum(outcomes.values())
    rng = np.random.default_rng(0)
    counts: Counter[tuple[bool, ...]] = Counter()
    n_rejected = 0
    for _ in range(20_000):
        try:
            loss = replacement(PARENT, rng)
            counts[loss.source + loss.target] += 1
        except ValueError:
            n_rejected += 1
    assert binomtest(20_000 - n_rejected, 20_000, chance_of_valid).pvalue > 0.001
    # Outcomes of many flips are rare: together.
    expected = np.array(list(outcomes.values())) / chance_of_valid * (20_000 - n_rejected)
    observed = np.array([counts.pop(bits, 0) for bits in outcomes])
    assert not counts
    common = expected >= 5
    assert chisquare([*observed[common], observed[~common].sum()], [*expected[common], expected[~common].sum()]).pvalue > 0.001


@pytest.mark.parametrize("horizon", [3, 10])
def test_replacement_of_long_losses(horizon: int) -> None:
    # So many bits are set that rejection plays no part.
    parent = AuxLoss(horizon, (True,) * (3 * horizon + 1), (True, False) * (3 * horizon // 2) + (True,) * (1 + horizon % 2))
    n_bits, rng = 2 * (3 * horizon + 1), np.random.default_rng(1)
    flips = np.array([as_array(replacement(parent, rng)) != as_array(parent) for _ in range(4000)])
    for bit in flips.reshape(4000, n_bits).T:
        assert binomtest(int(bit.sum()), 4000, 1 / n_bits).pvalue > 0.001 / n_bits


@given(losses(), losses(), seeds)
def test_crossover_takes_every_bit_from_one_of_both(loss: AuxLoss, other: AuxLoss, seed: int) -> None:
    rng = np.random.default_rng(seed)
    if loss.horizon != other.horizon:
        with pytest.raises(ValueError):
            crossover(loss, other, rng)
        return
    try:
        child = crossover(loss, other, rng)
    except ValueError:
        # What both have, the child has: with a state and a target in common it cannot be invalid.
        assert not np.logical_and(loss.source, other.source)[::3].any() or not np.logical_and(loss.target, other.target).any()
        return
    assert np.all((as_array(child) == as_array(loss)) | (as_array(child) == as_array(other)))
    assert (child.operator, child.negatives) in {(loss.operator, loss.negatives), (other.operator, other.negatives)}
    assert crossover(loss, other, np.random.default_rng(seed)) == child


def test_crossover_takes_each_bit_from_each_with_the_same_chance() -> None:
    # Three bits of each mask differ: 64 outcomes, all valid, all as likely.
    loss = AuxLoss.parse("{s_t, a_t} -> {s_t+1, a_t}")
    other = AuxLoss.parse("{s_t, r_t, s_t+1} -> {s_t+1, r_t, s_t}", "inner")
    rng = np.random.default_rng(2)
    counts = Counter(crossover(loss, other, rng) for _ in range(12_800))
    assert len(counts) == 128  # times two operators
    assert chisquare(list(counts.values())).pvalue > 0.001


@given(losses(), st.integers(4, 6), seeds)
def test_horizon_change_is_alike_in_both_masks(loss: AuxLoss, max_horizon: int, seed: int) -> None:
    try:
        child = horizon_change(loss, np.random.default_rng(seed), max_horizon)
    except ValueError:
        # Only what was cut off can have been what made it valid.
        assert not any(loss.source[:-3:3]) or not any(loss.target[:-3])
        return
    assert abs(child.horizon - loss.horizon) == 1
    assert 1 <= child.horizon <= max_horizon
    kept = 3 * min(child.horizon, loss.horizon) + 1
    assert child.source[:kept] == loss.source[:kept]
    assert child.target[:kept] == loss.target[:kept]
    assert (child.operator, child.negatives) == (loss.operator, loss.negatives)


def test_horizon_changes_go_both_ways_alike_and_append_fair_bits() -> None:
    parent, rng = random_loss(np.random.default_rng(0), 1), np.random.default_rng(3)
    assert parent.horizon == 1
    appended = Counter((loss.source[4:], loss.target[4:]) for loss in (horizon_change(parent, rng, 2) for _ in range(6400)))
    assert len(appended) == 64
    assert chisquare(list(appended.values())).pvalue > 0.001
    middle = AuxLoss.parse("{s_t} -> {s_t, a_t+1}")
    horizons = Counter(horizon_change(middle, rng, 3).horizon for _ in range(2000))
    assert set(horizons) == {1, 3}
    assert binomtest(horizons[1], 2000).pvalue > 0.001
    assert {horizon_change(middle, rng, 2).horizon for _ in range(50)} == {1}
    with pytest.raises(ValueError, match="cannot change"):
        horizon_change(PARENT, rng, 1)


def test_a_searched_operator_changes_as_often_as_a_bit() -> None:
    parent, rng = AuxLoss(6, (True,) * 19, (True,) * 19), np.random.default_rng(4)
    children = [replacement(parent, rng, OPERATORS) for _ in range(20_000)]
    # Redrawn with probability 1/38: one time in five it is the same again.
    assert binomtest(sum(child.operator != "mse" for child in children), 20_000, 1 / 38 * 4 / 5).pvalue > 0.001
    assert binomtest(sum(child.negatives for child in children), 20_000, 1 / 38).pvalue > 0.001
    others = Counter(child.operator for child in children if child.operator != "mse")
    assert len(others) == 4
    assert chisquare(list(others.values())).pvalue > 0.001
