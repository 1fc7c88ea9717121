"""Which operator? Ten operators x environments x seeds with forward dynamics (paper, section 2.2, A.1.3, table 2)."""

from dataclasses import replace

import pandas as pd

from sb3_aarl import catalog
from sb3_aarl.aux_loss import OPERATORS
from search.execution.matrix import Grid, Variant
from search.training.config import ConfigError, SearchConfig

WITH, WITHOUT = "w/ negative samples", "w/o negative samples"


def make_grid(config: SearchConfig) -> Grid:
    """
    The runs: all operators, with and without negatives, on the loss inputs of forward dynamics.

    :param config: Settings of the trainings, with a section ``operator_selection``
    """
    section = config.operator_selection
    if section is None:
        raise ConfigError(f"{config.path}: operator_selection is missing: environments, seeds")
    loss = catalog.load("forward-dynamics")
    variants = {
        f"{operator}, {WITH if negatives else WITHOUT}": Variant(replace(loss, operator=operator, negatives=negatives))
        for operator in OPERATORS
        for negatives in (True, False)
    }
    return Grid(f"{config.name}-operators", config, variants, section.environments, section.seeds)


def table(runs: pd.DataFrame) -> pd.DataFrame:
    """
    The paper's table 2: mean and sample deviation of normalized returns over all environments and seeds.

    The paper does not say how returns are normalized. Here each is divided by the size of the mean of all operators on
    its environment, so that environments count alike and higher is better even if returns are negative, and then all by
    the best operator's mean, so that this is 1; unless it is negative.

    :param runs: As :func:`search.execution.matrix.scores` gives them; ``last`` is the return at the last checkpoint
    :return: One row an operator: ``mean``, ``std``, ``runs``, the best first
    """
    scale = runs.groupby("environment")["last"].transform("mean").abs()
    normalized = (runs["last"] / scale.where(scale != 0, 1.0)).groupby(runs["variant"])
    result = pd.DataFrame({"mean": normalized.mean(), "std": normalized.std(), "runs": normalized.count()})
    best = result["mean"].max()
    if best > 0:
        result[["mean", "std"]] /= best
    return result.sort_values("mean", ascending=False)
