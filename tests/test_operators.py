"""Each of the ten operators against the paper's formulas (appendix A.1.3), written with loops."""

import math

import numpy as np
import pytest
import torch as th

from sb3_aarl.aux_loss import OPERATORS
from sb3_aarl.operators import Operator

TEN = [(name, negatives) for name in OPERATORS for negatives in (False, True)]


def naive(name: str, negatives: bool, prediction: np.ndarray, target: np.ndarray, weight: np.ndarray | None) -> float:
    batch, dim = prediction.shape

    def unit(row: np.ndarray) -> np.ndarray:
        return row / math.sqrt(sum(float(x) ** 2 for x in row))

    def error(i: int, j: int) -> float:
        one, other = prediction[i], target[j]
        if name == "n_mse":
            one, other = unit(one), unit(other)
        return sum((one[d] - other[d]) ** 2 for d in range(dim)) / dim

    def similarity(i: int, j: int) -> float:
        one, other = prediction[i], target[j]
        if name == "cosine":
            one, other = unit(one), unit(other)
        if weight is None:
            return sum(one[d] * other[d] for d in range(dim))
        return sum(one[d] * weight[d, e] * other[e] for d in range(dim) for e in range(dim))

    total = 0.0
    for i in range(batch):
        if name in ("mse", "n_mse"):
            total += error(i, i) - (error(i, (i - 1) % batch) if negatives else 0.0)
        else:
            logits = [similarity(i, j) if negatives or i == j else 0.0 for j in range(batch)]
            total += -logits[i] + math.log(sum(math.exp(logit) for logit in logits))
    return total / batch


def example(name: str, negatives: bool, batch: int = 6, dim: int = 4) -> tuple[Operator, th.Tensor, th.Tensor]:
    generator = th.Generator().manual_seed(batch * 10 + dim)
    operator = Operator(name, negatives, dim).double()
    for parameter in operator.parameters():
        parameter.data = th.randn(dim, dim, generator=generator, dtype=th.float64)
    prediction, target = th.randn(2, batch, dim, generator=generator, dtype=th.float64)
    return operator, prediction, target


def as_numpy(operator: Operator) -> np.ndarray | None:
    return next((weight.detach().numpy() for weight in operator.parameters()), None)


@pytest.mark.parametrize("batch, dim", [(6, 4), (2, 1), (1, 3), (5, 9)])
@pytest.mark.parametrize("name, negatives", TEN)
def test_value(name: str, negatives: bool, batch: int, dim: int) -> None:
    operator, prediction, target = example(name, negatives, batch, dim)
    value = operator(prediction, target)
    assert value.shape == ()
    assert value.item() == pytest.approx(
        naive(name, negatives, prediction.numpy(), target.numpy(), as_numpy(operator)), abs=1e-12
    )


@pytest.mark.parametrize("name, negatives", TEN)
def test_descent_brings_the_prediction_to_its_target(name: str, negatives: bool) -> None:
    """The sign is that of a loss: one step down its gradient raises agreement with the own target over the others'."""
    operator, prediction, target = example(name, negatives, batch=8, dim=5)
    if name == "bilinear":
        th.nn.init.eye_(operator.weight)
    prediction.requires_grad_()
    operator(prediction, target).backward()

    def margin(rows: th.Tensor) -> float:
        agreement = th.nn.functional.normalize(rows, dim=1) @ target.T
        return (agreement.diagonal().mean() - agreement.mean()).item()

    after = (prediction - 0.1 * prediction.grad).detach()
    assert margin(after) > margin(prediction.detach())


def test_the_weight_of_bilinear_starts_as_in_curl() -> None:
    weight = Operator("bilinear", True, 200).weight
    assert weight.shape == (200, 200) and weight.min() >= 0 and weight.max() < 1
    assert weight.mean().item() == pytest.approx(0.5, abs=0.01)
