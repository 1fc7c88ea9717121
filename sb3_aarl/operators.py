"""Operators: how far a prediction is from its target (paper, appendix A.1.3), with and without negatives."""

import torch as th
from torch import nn
from torch.nn import functional as F


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
        self.name = name
        self.negatives = negatives
        if name == "bilinear":
            self.weight = nn.Parameter(th.rand(dim, dim))

    def forward(self, prediction: th.Tensor, target: th.Tensor) -> th.Tensor:
        if self.name in ("n_mse", "cosine"):
            prediction, target = F.normalize(prediction, dim=1), F.normalize(target, dim=1)
        if self.name in ("mse", "n_mse"):
            loss = F.mse_loss(prediction, target)
            # Another row is the previous one: a batch is drawn independently, so any fixed permutation will do.
            return loss - F.mse_loss(prediction, target.roll(1, dims=0)) if self.negatives else loss
        if self.name == "bilinear":
            prediction = prediction @ self.weight
        # InfoNCE, equation 3 with the sign of a loss; without negatives the matrix keeps its diagonal, with zeros elsewhere.
        similarity = prediction @ target.T
        if not self.negatives:
            similarity = th.diag(th.diagonal(similarity))
        return F.cross_entropy(similarity, th.arange(len(similarity), device=similarity.device))
