"""The model that screens offspring."""

import sys

import numpy as np
import pytest
from sb3_aarl.search.evolution.space import random_loss
from sb3_aarl.search.evolution.surrogate import TokenModel, features
from sklearn.linear_model import BayesianRidge

from sb3_aarl.aux_loss import OPERATORS, AuxLoss


def trials(n: int, max_horizon: int = 10, seed: int = 0) -> tuple[list[AuxLoss], np.ndarray]:
    """Losses, and scores that depend on their tokens."""
    rng = np.random.default_rng(seed)
    losses = [random_loss(rng, max_horizon, OPERATORS) for _ in range(n)]
    effects = rng.normal(size=features(losses, max_horizon).shape[1])
    return losses, 400 + 30 * features(losses, max_horizon) @ effects + 60 * rng.normal(size=n)


def test_features_are_those_of_the_canonical_form() -> None:
    loss = AuxLoss.parse("{s_t+1, a_t+1} -> {s_t+2, r_t+1}", "inner", True, horizon=4)
    assert loss.canonical() == AuxLoss.parse("{s_t, a_t} -> {s_t+1, r_t}", "inner", True)
    bits = np.zeros((2, 16))
    bits[0, [0, 1]] = bits[1, [2, 3]] = 1  # s_t, a_t; r_t, s_t+1
    # States, actions and rewards, each in source and target; horizon; operators in their order; negatives.
    expected = np.concatenate([bits.ravel(), [1, 1, 1, 0, 0, 1], [1], [1, 0, 0, 0, 0], [1]])
    np.testing.assert_array_equal(features([loss, loss.canonical()], 5), [expected, expected])


def test_the_posterior_is_that_of_all_trials_added_so_far() -> None:
    losses, scores = trials(325)
    model = TokenModel(10)
    for part in (slice(0, 1), slice(1, 125), slice(125, 325)):
        model.add(losses[part], list(scores[part]))
    reference = BayesianRidge().fit(features(losses, 10), (scores - scores.mean()) / scores.std())
    np.testing.assert_allclose(model.mean, reference.coef_, rtol=0, atol=1e-6)
    np.testing.assert_allclose(model.root @ model.root.T, reference.sigma_, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(("factor", "offset"), [(1e-6, 0.0), (1e6, -1e7), (1.0, 1e6)])
def test_the_unit_of_the_scores_does_not_matter(factor: float, offset: float) -> None:
    losses, scores = trials(100)
    model, other = TokenModel(10), TokenModel(10)
    model.add(losses, list(scores))
    other.add(losses, list(factor * scores + offset))
    np.testing.assert_allclose(model.mean, other.mean, rtol=0, atol=1e-6)
    np.testing.assert_allclose(model.root, other.root, rtol=0, atol=1e-6)


def test_scores_that_are_not_finite_or_cannot_be_squared_are_skipped() -> None:
    losses, scores = trials(50)
    model, other = TokenModel(10), TokenModel(10)
    model.add(losses[:40], list(scores[:40]))
    other.add(losses, [*scores[:40], *[np.nan, np.inf, -sys.float_info.max] * 3, np.nan])
    other.add(losses[:1], [np.inf])
    assert len(other.losses) == 40
    np.testing.assert_array_equal(model.mean, other.mean)


def test_from_equal_scores_nothing_is_learnt() -> None:
    losses, _ = trials(30)
    model = TokenModel(10)
    for score in (0.1, 0.1):
        model.add(losses, [score] * 30)
        assert not model.mean.any()
        np.testing.assert_array_equal(model.root, np.eye(len(model.mean)))


def test_draws_are_from_the_posterior_and_the_best_is_the_one_they_rate_highest() -> None:
    losses, scores = trials(200, max_horizon=2)
    model = TokenModel(2)
    model.add(losses, list(scores))
    rng = np.random.default_rng(0)
    draws = np.array([model.draw(rng) for _ in range(20_000)])
    covariance = model.root @ model.root.T
    deviation = np.sqrt(np.diag(covariance))
    assert np.max(np.abs(draws.mean(axis=0) - model.mean) / deviation) < 4 / np.sqrt(20_000)
    np.testing.assert_allclose(
        np.cov(draws.T) / np.outer(deviation, deviation), covariance / np.outer(deviation, deviation), atol=0.05
    )
    for weights in draws[:20]:
        ratings = [float(features([loss], 2)[0] @ weights) for loss in losses]
        assert model.best(losses, weights) == int(np.argmax(ratings))
