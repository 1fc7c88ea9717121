"""A race between losses, in which new seeds go to those that could still be the best, and its standings."""

from typing import NamedTuple

import numpy as np

# Draws from the posterior; the error of a probability of 5 % is 0.5 percentage points.
N_DRAWS = 2_000
# A loss whose probability to be the best is below this share of the leader's gets no new seed.
LEAST_SHARE = 0.1
# Variance of the true values in units of that of one run: what a study can meet.
RATIOS = np.logspace(-2, 2, 41)


class Standings(NamedTuple):
    """
    What is known of the true value of each loss, its mean over all seeds: the posterior mean, its interval from ``low`` to
    ``high``, and the probability that it is the best of these losses. NaN, and probability 0, for one without any run.
    """

    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray
    p_best: np.ndarray


def standings(scores: np.ndarray, level: float = 0.95) -> Standings:
    """The standings of losses (rows) with these scores of seeds (columns), NaN where there is none."""
    scores = np.asarray(scores, dtype=float)
    has_runs = ~np.isnan(scores).all(axis=1)
    mean, low, high = np.full((3, len(scores)), np.nan)
    p_best = np.zeros(len(scores))
    if np.isfinite(scores).sum() == 1:  # nothing says how far the true value is
        mean[has_runs], low[has_runs], high[has_runs], p_best[has_runs] = scores[np.isfinite(scores)], -np.inf, np.inf, 1.0
    elif has_runs.any():
        mean[has_runs], draws = _posterior(scores[has_runs])
        low[has_runs], high[has_runs] = np.quantile(draws, [(1 - level) / 2, (1 + level) / 2], axis=0)
        p_best[has_runs] = np.bincount(draws.argmax(axis=1), minlength=draws.shape[1]) / len(draws)
    return Standings(mean, low, high, p_best)


def next_runs(scores: np.ndarray, budget: int, start: int = 2) -> list[tuple[int, int]]:
    """
    The runs to train next: losses and seeds, as rows and columns of the scores.

    In the first round each loss gets ``start`` seeds; in each later one those that could still be the best, at least two, get
    their next seed. All is read from the scores: no order in which runs finish changes it. Call it again whenever a run has
    finished, until it returns no runs.

    :param scores: Scores so far, NaN where there is none yet; each loss has at most as many seeds as there are columns
    :param budget: Number of runs of the whole race
    :param start: Seeds that each loss gets first
    """
    scores = np.asarray(scores, dtype=float)
    n_losses, n_seeds = scores.shape
    runs = [(row, column) for column in range(min(start, n_seeds)) for row in range(n_losses)][:budget]
    n_runs = 0
    known = np.full_like(scores, np.nan)
    while runs:
        if missing := [run for run in runs if np.isnan(scores[run])]:
            return missing
        for run in runs:
            known[run] = scores[run]
        n_runs += len(runs)
        counts = (~np.isnan(known)).sum(axis=1)
        p_best = standings(known).p_best
        order = [row for row in np.argsort(-p_best, kind="stable") if counts[row] < n_seeds]
        contenders = [row for rank, row in enumerate(order) if rank < 2 or p_best[row] >= LEAST_SHARE * p_best.max()]
        runs = [(int(row), int(counts[row])) for row in contenders][: budget - n_runs]
    return []


def _posterior(scores: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    The means of the true values (n_losses), and draws of them (n_draws, n_losses). They are normal around a common mean, and
    scores around them. All means, noises (by its logarithm) and deviations of the true values are equally probable before
    (Gelman, 2006).
    """
    counts = (~np.isnan(scores)).sum(axis=1)
    means = np.nanmean(scores, axis=1)
    # In units of the variance of one run: variance of each mean, around which all of them are.
    variances = 1 / counts + RATIOS[:, None]
    weights = (1 / variances).sum(axis=1)
    centres = (means / variances).sum(axis=1) / weights
    squares = ((means - centres[:, None]) ** 2 / variances).sum(axis=1) + np.nansum((scores - means[:, None]) ** 2)
    squares = np.maximum(squares, 1e-24 * max(1.0, np.abs(means).max()) ** 2)  # of equal scores
    freedom = max(1, counts.sum() - 2)  # the last prior takes one
    log_p = -0.5 * (np.log(variances).sum(axis=1) + np.log(weights) + freedom * np.log(squares) - np.log(RATIOS))
    p = np.exp(log_p - log_p.max())
    p /= p.sum()
    # Not that of the draws: from three scores or less they have none.
    mean = p @ (centres[:, None] + RATIOS[:, None] / variances * (means - centres[:, None]))
    rng = np.random.default_rng(0)
    at = rng.choice(len(RATIOS), N_DRAWS, p=p)
    deviation = np.sqrt(squares[at] / rng.chisquare(freedom, N_DRAWS))[:, None]
    centre = centres[at, None] + deviation * rng.standard_normal((N_DRAWS, 1)) / np.sqrt(weights[at, None])
    kept = RATIOS[at, None] / variances[at]
    spread = np.sqrt(kept / counts)
    return mean, centre + kept * (means - centre) + deviation * spread * rng.standard_normal((N_DRAWS, len(means)))
