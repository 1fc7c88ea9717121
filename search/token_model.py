"""A Bayesian linear model of what each token of a loss is worth, for screening offspring before they are trained."""

from collections.abc import Sequence

import numpy as np
from sklearn.linear_model import BayesianRidge

from sb3_aarl.aux_loss import OPERATORS, AuxLoss


def features(loss: AuxLoss, max_horizon: int) -> np.ndarray:
    """
    What the model sees of a loss, of its canonical form: the bits of both masks, how many states, actions and rewards
    each has (so that tokens of one kind share what they have in common), the horizon, the operator and negatives.

    :param loss: The loss
    :param max_horizon: Longest horizon of the space
    :return: (n_features,) floats
    """
    loss = loss.canonical()
    masks = np.zeros((2, 3 * max_horizon + 1))
    masks[:, : 3 * loss.horizon + 1] = loss.source, loss.target
    counts = [masks[:, kind::3].sum(axis=1) for kind in range(3)]
    operator = [float(loss.operator == name) for name in OPERATORS]
    return np.concatenate([masks.ravel(), *counts, [loss.horizon, *operator, loss.negatives]])


class TokenModel:
    """
    scikit-learn's BayesianRidge on sums over all trials, so that a fit costs the same however many there were.

    A Bayesian ridge regression depends on its data only through their number and their centred second moments. It is
    fitted to a square root of these, as many rows as there are features, and told of the rows that are missing
    through its prior: ``alpha_1`` enters the noise precision exactly like half a row.

    :param max_horizon: Longest horizon of the space
    """

    def __init__(self, max_horizon: int):
        self.max_horizon = max_horizon
        n_columns = 6 * max_horizon + 2 + 6 + 1 + len(OPERATORS) + 1
        # Sums of products of all pairs out of (features, value, 1).
        self.moments = np.zeros((n_columns + 2, n_columns + 2))
        self._mean = np.zeros(n_columns)
        self._root = np.eye(n_columns)

    @property
    def n_trials(self) -> int:
        """Number of trials that were added."""
        return int(self.moments[-1, -1])

    def add(self, losses: Sequence[AuxLoss], values: Sequence[float]) -> None:
        """
        Add finished trials and fit again.

        :param losses: Their losses
        :param values: Their scores, higher is better; those that are not finite are passed over
        """
        finite = np.isfinite(values)
        if not finite.any():
            return
        rows = np.array([features(loss, self.max_horizon) for loss in losses])[finite]
        rows = np.column_stack([rows, np.asarray(values)[finite], np.ones(len(rows))])
        self.moments += rows.T @ rows
        self._fit()

    def _fit(self) -> None:
        n = self.n_trials
        means = self.moments[-1, :-1] / n
        centred = self.moments[:-1, :-1] - n * np.outer(means, means)
        eigenvalues, vectors = np.linalg.eigh(centred)
        kept = eigenvalues > 1e-9 * eigenvalues[-1]
        data = np.sqrt(eigenvalues[kept])[:, None] * vectors[:, kept].T
        variance = centred[-1, -1] / n
        if variance <= 0 or len(data) < 2:
            return  # all scores alike, or one trial: nothing to learn yet
        X, y = data[:, :-1], data[:, -1]
        ridge = BayesianRidge(
            alpha_1=1e-6 + (n - len(data)) / 2, alpha_init=1 / variance, lambda_init=1.0, fit_intercept=False
        )
        ridge.fit(X, y)
        precision = ridge.alpha_ * centred[:-1, :-1] + ridge.lambda_ * np.eye(X.shape[1])
        self._mean = ridge.coef_
        self._root = np.linalg.inv(np.linalg.cholesky(precision)).T

    def draw(self, rng: np.random.Generator) -> np.ndarray:
        """
        One draw of the weights from the posterior.

        :param rng: Source of randomness
        :return: (n_features,)
        """
        return self._mean + self._root @ rng.standard_normal(len(self._mean))

    def best(self, losses: Sequence[AuxLoss], weights: np.ndarray) -> int:
        """
        :param losses: Losses to choose from
        :param weights: A draw of :meth:`draw`
        :return: The place of the one that the weights rate highest
        """
        return int(np.argmax([features(loss, self.max_horizon) @ weights for loss in losses]))
