"""A Gaussian process over losses: what is known of a loss from its own runs, and from those of losses with similar tokens."""

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.spatial.distance import cdist
from threadpoolctl import ThreadpoolController

from sb3_aarl.aux_loss import OPERATORS, AuxLoss

# Of a score: such as -sys.float_info.max, which stands for a failure.
LARGEST = 1e100
# What is fitted is one of these: the distance over which losses are alike, and the parts of the variance of scores that come
# from tokens, from a loss alone, and from one run.
LENGTHS = (4.0, 8.0, 16.0)
SHARES = tuple((i / 8, j / 8, 1 - (i + j) / 8) for i in range(1, 7) for j in range(1, 8 - i))
# The matrices are too small for threads: where runs have the cores, a fit with several takes a second, with one 16 ms.
one_thread = ThreadpoolController().wrap(limits=1, user_api="blas")


def features(losses: Sequence[AuxLoss], max_horizon: int) -> np.ndarray:
    """
    Points whose squared distance is the number of tokens in which the canonical forms of two losses differ, where each step
    into the future counts 0.8 times the one before, plus 1 for other operators, and 1 for negatives: (n_losses, n_features).
    """
    losses = [loss.canonical() for loss in losses]
    masks = np.zeros((len(losses), 2, 3 * max_horizon + 1))
    for mask, loss in zip(masks, losses, strict=True):
        mask[:, : 3 * loss.horizon + 1] = loss.source, loss.target
    masks *= _decay(max_horizon)
    operators = [[*(np.sqrt(0.5) * (loss.operator == name) for name in OPERATORS), loss.negatives] for loss in losses]
    return np.hstack([masks.reshape(len(losses), -1), np.array(operators, dtype=float)])


def _decay(max_horizon: int) -> np.ndarray:
    return 0.8 ** (np.arange(3 * max_horizon + 1) // 3 / 2)


class TokenModel:
    """
    The true value of a loss, its mean score over all seeds, is a sum: a part that losses with similar tokens share, and one of
    its own. A score is the true value and the noise of one run.
    """

    def __init__(self, max_horizon: int):
        self.max_horizon = max_horizon
        self.scores: dict[AuxLoss, list[float]] = {}  # of each canonical form

    def add(self, losses: Sequence[AuxLoss], scores: Sequence[float]) -> None:
        """Add runs and fit again; scores (higher is better) that are not finite, or too large, are skipped."""
        for loss, score in zip(losses, scores, strict=True):
            if abs(score) < LARGEST:
                self.scores.setdefault(loss.canonical(), []).append(score)
        if self.scores:
            self._fit()

    @one_thread
    def _fit(self) -> None:
        """Choose the most probable variances; all of SHARES count alike but those near 0, of which there are many."""
        runs = list(self.scores.values())
        self._centre, scale = np.mean(np.concatenate(runs)), np.std(np.concatenate(runs)) or 1.0
        counts = np.array([len(scores) for scores in runs])
        means = (np.array([np.mean(scores) for scores in runs]) - self._centre) / scale
        within = sum(np.var(scores) * len(scores) for scores in runs) / scale**2
        n_runs, n_repeats = counts.sum(), (counts - 1).sum()
        self._points = features(list(self.scores), self.max_horizon)
        distances = cdist(self._points, self._points, "sqeuclidean")
        best = -np.inf
        for length in LENGTHS:
            alike = np.exp(-distances / length)
            for shares in SHARES:
                of_tokens, own, noise = shares
                factor = cho_factor(of_tokens * alike + np.diag(own + noise / counts), lower=True)
                weights = cho_solve(factor, means)
                squares = means @ weights + within / noise + 1e-12
                log_p = -np.log(np.diag(factor[0])).sum() - 0.5 * (n_runs * np.log(squares) + n_repeats * np.log(noise))
                if (log_p := log_p + np.log(shares).sum()) > best:
                    best, self.length, self.shares, self._factor = log_p, length, shares, factor
                    self._weights, self.variance = scale * weights, scale**2 * squares / n_runs

    @one_thread
    def posterior(self, losses: Sequence[AuxLoss], own: bool = True) -> tuple[np.ndarray, np.ndarray]:
        """
        Mean and covariance of the true values of losses; with ``own=False`` without the part of each loss alone, which says
        nothing about which new one to try.
        """
        points = features(losses, self.max_horizon)
        to_known = self._kernel(cdist(points, self._points, "sqeuclidean"), own)
        prior = self._kernel(cdist(points, points, "sqeuclidean"), own)
        covariance = self.variance * (prior - to_known @ cho_solve(self._factor, to_known.T))
        return self._centre + to_known @ self._weights, covariance

    def _kernel(self, distances: np.ndarray, own: bool = True) -> np.ndarray:
        of_tokens, alone, _ = self.shares
        return of_tokens * np.exp(-distances / self.length) + own * alone * (distances == 0)

    @one_thread
    def draw(self, losses: Sequence[AuxLoss], rng: np.random.Generator, own: bool = True) -> np.ndarray:
        """One draw of the true values of losses from the posterior."""
        mean, covariance = self.posterior(losses, own)
        covariance += 1e-6 * self.variance * np.eye(len(mean))  # losses may be almost alike
        return mean + np.linalg.cholesky(covariance) @ rng.standard_normal(len(mean))

    @one_thread
    def higher(self, loss: AuxLoss, optimism: float) -> Iterator[AuxLoss]:
        """
        The losses with one token more or less, and at least one in the first step, that are rated higher, the best first. A
        rating is the mean of the posterior and ``optimism`` times its deviation, without the part of each loss alone.
        """
        point = features([loss], self.max_horizon)
        tokens = point[0, : -len(OPERATORS) - 1] > 0
        masks = tokens ^ np.eye(len(tokens) + 1, len(tokens), -1, dtype=bool)  # the loss itself, and all flips of one token
        masks = masks.reshape(-1, 2, len(tokens) // 2)
        is_valid = masks[:, 0, ::3].any(axis=1) & masks[:, 1].any(axis=1) & masks[:, :, :3].any(axis=(1, 2))
        masks = masks[is_valid]
        points = np.repeat(point, len(masks), axis=0)
        points[:, : len(tokens)] = (masks * _decay(self.max_horizon)).reshape(len(masks), -1)
        to_known = self._kernel(cdist(points, self._points, "sqeuclidean"), own=False)
        known = solve_triangular(self._factor[0], to_known.T, lower=True)
        deviation = np.sqrt(self.variance * (self.shares[0] - (known**2).sum(axis=0)).clip(0))
        ratings = to_known @ self._weights + optimism * deviation
        order = np.argsort(-ratings, kind="stable")[: (ratings > ratings[0]).sum()]
        return (
            AuxLoss(self.max_horizon, source, target, loss.operator, loss.negatives).canonical()
            for source, target in masks[order].tolist()
        )

    def rating(self, loss: AuxLoss) -> float:
        """The mean of the posterior of a loss."""
        return float(self.posterior([loss])[0][0])
