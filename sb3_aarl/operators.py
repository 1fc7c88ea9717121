"""Operators: how far a prediction is from its target (paper, appendix A.1.3), with and without negatives."""

import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_aarl.aux_loss import OPERATORS


def squared_error(prediction: th.Tensor, target: th.Tensor, negatives: bool) -> th.Tensor:
    """
    Mean squared error; with negatives, minus the same error against another row of the batch.

    The other row is the previous one: a batch is drawn independently, so any fixed permutation without a fixed point
    is as good as a random one. For a batch of one row it is zero.

    :param prediction: (batch, d) floats
    :param target: (batch, d) floats
    :param negatives: Whether to push predictions away from other rows' targets
    """
    loss = F.mse_loss(prediction, target)
    if negatives:
        loss = loss - F.mse_loss(prediction, target.roll(1, dims=0))
    return loss


def cross_entropy(similarity: th.Tensor, negatives: bool) -> th.Tensor:
    """
    InfoNCE: cross entropy of row i of the similarity matrix against column i (equation 3 with the sign of a loss).

    Without negatives the matrix keeps its diagonal only, with zeros elsewhere.

    :param similarity: (batch, batch), the similarity of prediction i and target j
    :param negatives: Whether the elements off the diagonal count
    """
    if not negatives:
        similarity = th.diag(th.diagonal(similarity))
    return F.cross_entropy(similarity, th.arange(len(similarity), device=similarity.device))


class Operator(nn.Module):
    """
    One of the paper's ten operators, from predictions and targets of shape (batch, d) to a scalar.

    ``mse`` and ``n_mse`` are squared errors, of the rows as they are or of L2-normalised rows; ``inner``, ``bilinear``
    (y^T W y with a learnable W) and ``cosine`` are similarities in a cross entropy.

    :param name: One of ``inner``, ``bilinear``, ``cosine``, ``mse``, ``n_mse``
    :param negatives: Whether other rows of the batch are pushed away
    :param dim: Width d of predictions and targets; W of ``bilinear`` is (d, d), uniform in [0, 1) at first as in CURL
    """

    def __init__(self, name: str, negatives: bool, dim: int):
        super().__init__()
        if name not in OPERATORS:
            raise ValueError(f"unknown operator {name!r}, expected one of {', '.join(OPERATORS)}")
        self.name = name
        self.negatives = negatives
        if name == "bilinear":
            self.weight = nn.Parameter(th.rand(dim, dim))

    def forward(self, prediction: th.Tensor, target: th.Tensor) -> th.Tensor:
        if self.name in ("n_mse", "cosine"):
            prediction, target = F.normalize(prediction, dim=1), F.normalize(target, dim=1)
        if self.name in ("mse", "n_mse"):
            return squared_error(prediction, target, self.negatives)
        if self.name == "bilinear":
            prediction = prediction @ self.weight
        return cross_entropy(prediction @ target.T, self.negatives)
