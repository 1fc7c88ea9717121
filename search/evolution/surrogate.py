"""A Bayesian linear model of what each token of a loss is worth, for screening offspring before they are trained."""

from collections.abc import Sequence

import numpy as np
from sklearn.linear_model import BayesianRidge
from threadpoolctl import ThreadpoolController

from sb3_aarl.aux_loss import OPERATORS, AuxLoss

# Of a score: such as -sys.float_info.max, which stands for a failure.
LARGEST = 1e100
# The matrices are too small for threads: where runs have the cores, a fit with several takes a second, with one 16 ms.
BLAS = ThreadpoolController()


def features(losses: Sequence[AuxLoss], max_horizon: int) -> np.ndarray:
    """
    The bits of both masks of the canonical forms, the number of states, actions and rewards of each mask (so that tokens of
    one kind share what they have in common), horizon, operator and negatives: (n_losses, n_features) floats.
    """
    losses = [loss.canonical() for loss in losses]
    masks = np.zeros((len(losses), 2, 3 * max_horizon + 1))
    for mask, loss in zip(masks, losses, strict=True):
        mask[:, : 3 * loss.horizon + 1] = loss.source, loss.target
    counts = [masks[:, :, kind::3].sum(axis=2) for kind in range(3)]
    others = [[loss.horizon, *(loss.operator == name for name in OPERATORS), loss.negatives] for loss in losses]
    return np.hstack([masks.reshape(len(losses), -1), *counts, np.array(others, dtype=float)])


class TokenModel:
    """
    scikit-learn's BayesianRidge on sums over all trials, so that a fit costs the same however many there were.

    A Bayesian ridge regression depends on its data only through their number and their centred second moments. It is fitted to
    a square root of these, as many rows as there are features; the missing rows come in through its prior, as ``alpha_1``
    enters the noise precision exactly like half a row. Scores are standardised first, so that their unit does not matter.
    """

    def __init__(self, max_horizon: int):
        self.max_horizon = max_horizon
        self.n_trials = 0
        n_features = 6 * max_horizon + 2 + 6 + 1 + len(OPERATORS) + 1
        # Of the features and the score, which comes last: means, and sums of products of deviations from them.
        self.means = np.zeros(n_features + 1)
        self.moments = np.zeros((n_features + 1, n_features + 1))
        # The posterior of the weights: its mean, and a square root of its covariance. Before there are data, nothing.
        self.mean = np.zeros(n_features)
        self.root = np.eye(n_features)

    def add(self, losses: Sequence[AuxLoss], values: Sequence[float]) -> None:
        """Add finished trials and fit again; values (higher is better) that are not finite, or too large, are skipped."""
        finite = np.abs(values) < LARGEST
        if not finite.any():
            return
        rows = np.column_stack([features(losses, self.max_horizon), values])[finite]
        with BLAS.limit(limits=1, user_api="blas"):
            shift = rows.mean(axis=0) - self.means
            deviations = rows - rows.mean(axis=0)
            weight = len(rows) / (self.n_trials + len(rows))
            self.moments += deviations.T @ deviations + self.n_trials * weight * np.outer(shift, shift)
            self.means += weight * shift
            self.n_trials += len(rows)
            self._fit()

    def _fit(self) -> None:
        deviation = np.sqrt(self.moments[-1, -1] / self.n_trials)
        if deviation <= 1e-12 * abs(self.means[-1]):
            return  # all scores alike: nothing to learn
        unit = np.ones(len(self.means))
        unit[-1] = deviation
        moments = self.moments / np.outer(unit, unit)
        eigenvalues, vectors = np.linalg.eigh(moments)
        kept = eigenvalues > 1e-12 * eigenvalues[-1]
        rows = np.sqrt(eigenvalues[kept])[:, None] * vectors[:, kept].T
        ridge = BayesianRidge(
            alpha_1=1e-6 + (self.n_trials - len(rows)) / 2, alpha_init=1.0, lambda_init=1.0, fit_intercept=False
        )
        ridge.fit(rows[:, :-1], rows[:, -1])
        precision = ridge.alpha_ * moments[:-1, :-1] + ridge.lambda_ * np.eye(len(unit) - 1)
        self.mean = ridge.coef_
        self.root = np.linalg.inv(np.linalg.cholesky(precision)).T

    def draw(self, rng: np.random.Generator) -> np.ndarray:
        """One draw of the weights from the posterior."""
        return self.mean + self.root @ rng.standard_normal(len(self.mean))

    def best(self, losses: Sequence[AuxLoss], weights: np.ndarray) -> int:
        """Index of the loss that the weights of :meth:`draw` rate highest."""
        return int(np.argmax(features(losses, self.max_horizon) @ weights))
