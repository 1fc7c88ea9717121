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
    """scikit-learn's BayesianRidge on all finished trials. Scores are standardised, so that their unit does not matter."""

    def __init__(self, max_horizon: int):
        self.max_horizon = max_horizon
        self.losses: list[AuxLoss] = []
        self.values: list[float] = []
        n_features = 6 * max_horizon + 2 + 6 + 1 + len(OPERATORS) + 1
        # The posterior of the weights: its mean, and a square root of its covariance. Before there are data, nothing.
        self.mean = np.zeros(n_features)
        self.root = np.eye(n_features)

    def add(self, losses: Sequence[AuxLoss], values: Sequence[float]) -> None:
        """Add finished trials and fit again; values (higher is better) that are not finite, or too large, are skipped."""
        finite = [(loss, value) for loss, value in zip(losses, values, strict=True) if abs(value) < LARGEST]
        self.losses += [loss for loss, _ in finite]
        self.values += [value for _, value in finite]
        scores = np.array(self.values)
        if not finite or scores.std() <= 1e-12 * abs(scores.mean()):
            return  # no scores, or all alike: nothing to learn
        with BLAS.limit(limits=1, user_api="blas"):
            rows = features(self.losses, self.max_horizon)
            ridge = BayesianRidge().fit(rows, (scores - scores.mean()) / scores.std())
            deviations = rows - rows.mean(axis=0)
            precision = ridge.alpha_ * deviations.T @ deviations + ridge.lambda_ * np.eye(rows.shape[1])
            self.mean = ridge.coef_
            self.root = np.linalg.inv(np.linalg.cholesky(precision)).T

    def draw(self, rng: np.random.Generator) -> np.ndarray:
        """One draw of the weights from the posterior."""
        return self.mean + self.root @ rng.standard_normal(len(self.mean))

    def rating(self, loss: AuxLoss) -> float:
        """What a loss is worth by the mean of the posterior, in deviations of the scores, but for a constant."""
        return float((features([loss], self.max_horizon) @ self.mean)[0])

    def best(self, losses: Sequence[AuxLoss], weights: np.ndarray) -> int:
        """Index of the loss that the weights of :meth:`draw` rate highest."""
        return int(np.argmax(features(losses, self.max_horizon) @ weights))
