"""The race between finalists: who gets the next seed, and what is known of each."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sb3_aarl.search.evolution.racing import next_runs, standings


def race(truth: np.ndarray, budget: int, seed: int, n_seeds: int = 30, n_done: int | None = None) -> np.ndarray:
    """Scores of a whole race; at each call only ``n_done`` of the runs, in any order, have finished."""
    rng = np.random.default_rng(seed)
    noise = np.random.default_rng(0).normal(size=(len(truth), n_seeds))
    scores = np.full((len(truth), n_seeds), np.nan)
    while runs := next_runs(scores, budget):
        for at in rng.permutation(len(runs))[:n_done]:
            assert np.isnan(scores[runs[at]])
            scores[runs[at]] = truth[runs[at][0]] + noise[runs[at]]
    return scores


@settings(deadline=None, max_examples=12)
@given(st.integers(1, 5), st.integers(1, 24), st.integers(0, 1000), st.integers(1, 4))
def test_a_race_spends_its_budget_whatever_finishes_first(n_losses: int, budget: int, seed: int, n_done: int) -> None:
    truth = np.random.default_rng(seed).normal(size=n_losses)
    scores = race(truth, budget, seed, n_seeds=6, n_done=n_done)
    np.testing.assert_array_equal(scores, race(truth, budget, 0, n_seeds=6))
    assert np.isfinite(scores).sum() == min(budget, 6 * n_losses)
    assert all(not np.isnan(row[: np.isfinite(row).sum()]).any() for row in scores)  # from left to right
    assert next_runs(scores, budget) == []


def test_new_seeds_go_to_those_that_could_be_the_best() -> None:
    counts = np.isfinite(race(np.array([0.0, 6.0, -1.0, 6.5, 0.5]), 40, 0)).sum(axis=1)
    assert list(counts[[0, 2, 4]]) == [2, 2, 2] and counts[[1, 3]].min() > 10


def test_the_probabilities_are_calibrated() -> None:
    """The intervals of many races hold the truth, and the most probable winners are the best, as often as they say."""
    rng = np.random.default_rng(0)
    inside, p_first, is_best = [], [], []
    for _ in range(250):
        truth = rng.normal(size=6)
        scores = truth[:, None] + rng.normal(size=(6, 5))
        scores[np.arange(5) >= rng.integers(1, 6, 6)[:, None]] = np.nan
        found = standings(scores, 0.8)
        inside.append((found.low < truth) & (truth < found.high))
        p_first.append(found.p_best.max())
        is_best.append(truth.argmax() == found.p_best.argmax())
        assert found.p_best.sum() == pytest.approx(1)
    assert np.mean(inside) == pytest.approx(0.8, abs=0.05)
    assert np.mean(is_best) == pytest.approx(np.mean(p_first), abs=0.06)


def test_the_posterior_is_that_of_the_priors() -> None:
    """Flat in the mean, the logarithm of the noise and the deviation of the true values: integrated on a grid."""
    scores = np.array([[10.0, 60.0], [-20.0, 10.0], [0.0, -60.0]])
    of_loss = np.repeat(np.eye(3), 2, axis=0)  # of each run, in the order of the scores
    noise, spread = (grid.ravel() for grid in np.meshgrid(np.logspace(0, 4, 100), np.logspace(-2, 5, 140)))
    prior = spread[:, None, None] ** 2 * np.eye(3) + 1e12  # the mean may be anything
    covariance = of_loss @ prior @ of_loss.T + noise[:, None, None] ** 2 * np.eye(6)
    gain = np.linalg.solve(covariance, of_loss @ prior)
    fits = -0.5 * (
        np.linalg.slogdet(covariance)[1] + scores.ravel() @ np.linalg.solve(covariance, scores.ravel()[:, None])[..., 0].T
    )
    p = spread * np.exp(fits - fits.max())
    at = np.random.default_rng(0).choice(len(p), 4000, p=p / p.sum())
    means = scores.ravel() @ gain[at]
    spreads = np.linalg.cholesky(prior[at] - np.swapaxes(of_loss @ prior[at], 1, 2) @ gain[at] + 1e-3 * np.eye(3))
    draws = means + (spreads @ np.random.default_rng(1).standard_normal((4000, 3, 1)))[..., 0]
    found = standings(scores)
    np.testing.assert_allclose(found.mean, draws.mean(axis=0), atol=4)
    np.testing.assert_allclose(found.p_best, np.bincount(draws.argmax(axis=1)) / 4000, atol=0.03)
    np.testing.assert_allclose(
        found.high - found.low, np.diff(np.quantile(draws, [0.025, 0.975], axis=0), axis=0)[0], rtol=0.1
    )


@given(st.lists(st.integers(-(10**6), 10**6), min_size=2, max_size=3, unique=True))
def test_means_of_few_scores_lie_between_them_in_their_order(few: list[int]) -> None:
    means = standings(np.array(few)[:, None]).mean
    assert (np.argsort(means, kind="stable") == np.argsort(few, kind="stable")).all()
    assert min(few) <= means.min() and means.max() <= max(few)


def test_with_many_seeds_the_posterior_is_that_of_the_means() -> None:
    truth, rng = np.array([100.0, 103.0, 110.0]), np.random.default_rng(1)
    scores = truth[:, None] + 5 * rng.normal(size=(3, 400))
    found = standings(1e3 * scores)
    np.testing.assert_allclose(found.mean, 1e3 * scores.mean(axis=1), atol=50)
    np.testing.assert_allclose(found.high - found.low, 1e3 * 2 * 1.96 * 5 / 20, rtol=0.1)
    assert found.p_best[2] > 0.999


def test_losses_without_runs_and_equal_scores() -> None:
    found = standings(np.array([[np.nan, np.nan], [3.0, np.nan]]))
    np.testing.assert_array_equal(
        [found.mean, found.low, found.high, found.p_best], [[np.nan, 3], [np.nan, -np.inf], [np.nan, np.inf], [0, 1]]
    )
    found = standings(np.full((2, 3), 5.0))
    np.testing.assert_allclose(found.mean, 5.0)
    assert next_runs(np.empty((0, 3)), 10) == []
