"""
The real search on Cheetah-Run (results/search/cheetah_run_simba) as a landscape: the true value of any loss, in a moment.

A value is a sum: effects of single tokens, of the shares of each kind and the horizon, and of pairs of tokens, and a part of
each loss alone. The variances maximise the marginal likelihood of the study's 153 scores, given the noise of one run
(results/search/fidelity). A landscape is one draw from the posterior: each of them could be the real one.
"""

import hashlib
import shutil
import tempfile
from functools import cache
from pathlib import Path

import numpy as np
import optuna
from sb3_aarl.search.evolution.space import MAX_HORIZON, loss_of
from sb3_aarl.search.execution.storage import load_study, open_storage

from sb3_aarl.aux_loss import AuxLoss

STUDY = Path(__file__).parent.parent / "results" / "search" / "cheetah_run_simba" / "study.db"
NOISE = 40.0
# Shares of the variance of the scores: tokens, kinds of tokens, pairs of tokens, a loss alone.
TOKENS, KINDS, PAIRS, ALONE = 0.07, 0.16, 0.14, 0.31
N_TOKENS = 3 * MAX_HORIZON + 1
ROWS, COLUMNS = np.triu_indices(2 * N_TOKENS)


@cache
def real_search() -> tuple[list[AuxLoss], np.ndarray, list[AuxLoss]]:
    """The losses of the study in canonical form, their scores, and the losses that it was given."""
    with tempfile.TemporaryDirectory() as folder:  # the study's file stays as it is
        shutil.copy(STUDY, folder)
        study = load_study(open_storage(Path(folder), create=False))
        trials = study.get_trials(deepcopy=False, states=(optuna.trial.TrialState.COMPLETE,))
    losses = [loss.canonical() for trial in trials if (loss := loss_of(trial)) is not None]
    given = [loss for loss, trial in zip(losses, trials, strict=True) if trial.user_attrs["operation"] == "given"]
    return losses, np.array([trial.value for trial in trials]), given


def _masks(losses: list[AuxLoss]) -> np.ndarray:
    masks = np.zeros((len(losses), 2, N_TOKENS))
    for mask, loss in zip(masks, losses, strict=True):
        mask[:, : len(loss.source)] = loss.source, loss.target
    return masks


def _kinds(losses: list[AuxLoss]) -> np.ndarray:
    masks, horizons = _masks(losses), np.array([[loss.horizon] for loss in losses])
    counts = np.hstack([masks[:, :, kind::3].sum(axis=2) for kind in range(3)])
    return np.hstack([counts / horizons, horizons / MAX_HORIZON])


class Emulator:
    """One landscape. ``given`` are the losses that the real search was given, ``best_given`` is the true value of the best."""

    def __init__(self, seed: int) -> None:
        losses, scores, self.given = real_search()
        self.seed, self.centre, variance = seed, scores.mean(), scores.var()
        self._token_means = _masks(losses).reshape(len(losses), -1).mean(axis=0)
        self._kind_means = _kinds(losses).mean(axis=0)
        parts = self._features(losses)
        rows = np.hstack(parts)
        shares = (TOKENS, KINDS, PAIRS)
        # Each part explains its share of the variance.
        prior = np.concatenate(
            [
                np.full(part.shape[1], s * variance / (part**2).sum(axis=1).mean())
                for part, s in zip(parts, shares, strict=True)
            ]
        )
        # A draw from the prior, corrected by what it does not explain (Matheron's rule).
        rng = np.random.default_rng(seed)
        weights = rng.normal(size=len(prior)) * np.sqrt(prior)
        alone = rng.normal(size=len(losses)) * np.sqrt(ALONE * variance)
        missing = scores - self.centre - rows @ weights - alone - NOISE * rng.normal(size=len(losses))
        correction = np.linalg.solve((rows * prior) @ rows.T + (ALONE * variance + NOISE**2) * np.eye(len(losses)), missing)
        self.weights = weights + prior * (rows.T @ correction)
        self.deviation = np.sqrt(ALONE * variance)
        self.alone = dict(zip(losses, alone + ALONE * variance * correction, strict=True))
        self.best_given = max(self(loss) for loss in self.given)

    def _features(self, losses: list[AuxLoss]) -> list[np.ndarray]:
        tokens = _masks(losses).reshape(len(losses), -1) - self._token_means
        decay = np.tile(0.8 ** (np.arange(N_TOKENS) // 3), 2)
        pairs = tokens[:, ROWS] * tokens[:, COLUMNS] * np.where(ROWS == COLUMNS, 1, np.sqrt(2))
        return [tokens * decay, _kinds(losses) - self._kind_means, pairs]

    def __call__(self, loss: AuxLoss) -> float:
        """The true value of a loss, the same in every process."""
        loss = loss.canonical()
        if loss not in self.alone:
            key = hashlib.sha256(f"{self.seed} {loss}".encode()).digest()[:8]
            self.alone[loss] = self.deviation * np.random.default_rng(int.from_bytes(key, "little")).normal()
        return float(self.centre + np.hstack(self._features([loss]))[0] @ self.weights + self.alone[loss])
