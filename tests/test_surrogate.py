"""The model of screening, of parents and of losses that run again."""

import sys
from itertools import product

import numpy as np
import pytest
from sb3_aarl.search.evolution.space import random_loss
from sb3_aarl.search.evolution.surrogate import LENGTHS, SHARES, TokenModel
from scipy.stats import multivariate_normal

from sb3_aarl.aux_loss import OPERATORS, AuxLoss, Token


def runs(n: int, max_horizon: int = 10, noise: float = 30.0, seed: int = 0) -> tuple[list[AuxLoss], np.ndarray]:
    """Losses, every third of which is run again, and scores: tokens have effects, losses parts of their own."""
    rng = np.random.default_rng(seed)
    losses = [random_loss(rng, max_horizon, OPERATORS) for _ in range(n)]
    values = [400 + 20 * (sum(loss.source[::3]) - sum(loss.target)) + 30 * rng.normal() for loss in losses]
    return losses + losses[::3], np.array(values + values[::3]) + noise * rng.normal(size=n + len(losses[::3]))


def fitted(losses: list[AuxLoss], scores: np.ndarray, max_horizon: int = 10) -> TokenModel:
    model = TokenModel(max_horizon)
    model.add(losses, list(scores))
    return model


def distances(losses: list[AuxLoss], others: list[AuxLoss]) -> np.ndarray:
    """In how much the tokens and operators of losses differ, one by one."""

    def tokens(loss: AuxLoss) -> dict[tuple[str, int], float]:
        loss = loss.canonical()
        masks = {"source": loss.source, "target": loss.target}
        found = {(name, i): 0.8 ** Token.of(i).offset for name, mask in masks.items() for i, bit in enumerate(mask) if bit}
        return found | {(loss.operator, 0): 0.5} | ({("negatives", 0): 1.0} if loss.negatives else {})

    sides = [[tokens(loss) for loss in side] for side in (losses, others)]
    return np.array([[sum((a | b)[token] for token in a.keys() ^ b.keys()) for b in sides[1]] for a in sides[0]])


def test_the_posterior_is_that_of_all_runs_under_the_most_probable_variances() -> None:
    losses, scores = runs(36, max_horizon=4)
    model = TokenModel(4)
    for part in (slice(0, 1), slice(1, 20), slice(20, None)):
        model.add(losses[part], list(scores[part]))
    queries = [*losses[:6], *runs(5, max_horizon=4, seed=1)[0]]

    def prior(between: np.ndarray, length: float, of_tokens: float, own: float) -> np.ndarray:
        return of_tokens * np.exp(-between / length) + own * (between == 0)

    z, between = (scores - scores.mean()) / scores.std(), distances(losses, losses)
    found = {}
    for length in LENGTHS:
        for of_tokens, own, noise in SHARES:
            covariance = prior(between, length, of_tokens, own) + noise * np.eye(len(z))
            variance = z @ np.linalg.solve(covariance, z) / len(z)
            log_p = multivariate_normal(np.zeros(len(z)), variance * covariance).logpdf(z) + np.log(of_tokens * own * noise)
            found[log_p] = length, of_tokens, own, noise, variance, covariance
    length, of_tokens, own, _, variance, covariance = found[max(found)]
    cross = prior(distances(queries, losses), length, of_tokens, own)
    mean, found_covariance = model.posterior(queries)
    np.testing.assert_allclose(mean, scores.mean() + scores.std() * cross @ np.linalg.solve(covariance, z), rtol=1e-9)
    left = prior(distances(queries, queries), length, of_tokens, own) - cross @ np.linalg.solve(covariance, cross.T)
    np.testing.assert_allclose(found_covariance, scores.var() * variance * left, rtol=1e-6, atol=1e-6)
    assert [model.rating(loss) for loss in queries] == pytest.approx(list(mean))
    assert np.linalg.eigvalsh(model.posterior(queries, own=False)[1]).min() > -1e-6
    rng = np.random.default_rng(0)
    draws = np.array([model.draw(queries[:8], rng) for _ in range(10_000)])
    np.testing.assert_allclose(draws.mean(axis=0), mean[:8], atol=2)
    np.testing.assert_allclose(np.cov(draws.T), found_covariance[:8, :8], atol=50)


def test_higher_losses_are_all_with_one_token_more_or_less_whose_bound_is_higher_the_best_first() -> None:
    losses, scores = runs(40, max_horizon=4)
    model = fitted(losses, scores, max_horizon=4)

    def bound(loss: AuxLoss) -> float:
        mean, covariance = model.posterior([loss], own=False)
        return float(mean[0] + 1.5 * np.sqrt(covariance[0, 0]))

    for loss in {loss.canonical() for loss in losses}:
        near = []
        for flip in product(range(2), range(13)):
            masks = np.zeros((2, 13), dtype=bool)
            masks[:, : 3 * loss.horizon + 1] = loss.source, loss.target
            masks[flip] ^= True
            if masks[0, ::3].any() and masks[1].any() and masks[:, :3].any():
                near.append(AuxLoss(4, *masks.tolist(), loss.operator, loss.negatives).canonical())
        expected = [other for other in near if bound(other) > bound(loss)]
        assert list(model.higher(loss, 1.5)) == sorted(expected, key=bound, reverse=True)


@pytest.mark.parametrize("noise", [5.0, 80.0])
def test_the_noise_is_learnt_from_runs_of_one_loss(noise: float) -> None:
    model = fitted(*runs(150, noise=noise))
    deviation = np.sqrt(model.shares[2] * model.variance)
    assert (deviation < 30) == (noise < 30) and deviation == pytest.approx(noise, rel=0.3, abs=20)


@pytest.mark.parametrize(("factor", "offset"), [(1e-6, 0.0), (1e6, -1e7), (1.0, 1e6)])
def test_the_unit_of_the_scores_does_not_matter(factor: float, offset: float) -> None:
    losses, scores = runs(60)
    mean, covariance = fitted(losses, scores).posterior(losses)
    other_mean, other_covariance = fitted(losses, factor * scores + offset).posterior(losses)
    np.testing.assert_allclose(other_mean, factor * mean + offset, rtol=1e-6)
    np.testing.assert_allclose(other_covariance, factor**2 * covariance, rtol=1e-4, atol=1e-6 * factor**2)


def test_scores_that_are_not_finite_or_cannot_be_squared_are_skipped() -> None:
    losses, scores = runs(45)
    model = fitted(losses[:40], scores[:40])
    other = fitted(losses[:52], np.array([*scores[:40], *[np.nan, np.inf, -sys.float_info.max] * 4]))
    other.add(losses[:1], [np.inf])
    np.testing.assert_array_equal(model.posterior(losses)[0], other.posterior(losses)[0])


def test_equal_scores_say_nothing() -> None:
    losses, _ = runs(30)
    np.testing.assert_allclose(fitted(losses, np.full(40, 0.1)).posterior(losses)[0], 0.1)
