"""Which operator? Ten operators x environments x seeds with forward dynamics (paper, section 2.2, A.1.3, table 2)."""

from dataclasses import replace
from itertools import product
from pathlib import Path

import pandas as pd
from sb3_aarl.search.execution.matrix import Cell, Matrix
from sb3_aarl.search.studies.config import SearchConfig
from sb3_aarl.search.studies.search import make_run
from sb3_aarl.search.training.config import ConfigError

from sb3_aarl import catalog
from sb3_aarl.aux_loss import OPERATORS

NEGATIVES = {True: "w/ negative samples", False: "w/o negative samples"}


def make_matrix(config: SearchConfig, folder: Path) -> Matrix:
    """The runs: all operators, with and without negatives, on the loss inputs of forward dynamics."""
    section = config.operator_selection
    if section is None:
        raise ConfigError(f"{config.path}: operator_selection is missing: environments, seeds")
    loss = catalog.load("forward-dynamics")
    runs = {}
    for seed, environment, operator, negatives in product(section.seeds, section.environments, OPERATORS, NEGATIVES):
        cell = Cell(f"{operator}, {NEGATIVES[negatives]}", environment, seed)
        runs[cell] = make_run(config, environment, replace(loss, operator=operator, negatives=negatives), seed)
    return Matrix(f"{config.name}-operators", folder / "operators", runs)


def table(runs: pd.DataFrame) -> pd.DataFrame:
    """
    The paper's table 2: mean and sample deviation of normalized returns over all environments and seeds.

    The paper does not say how returns are normalized. Here each is divided by the size of the mean of all operators on
    its environment, so that environments count alike and higher is better even if returns are negative, and then all by
    the best operator's mean, so that this is 1; unless it is negative.
    """
    scale = runs.groupby("environment")["last"].transform("mean").abs()
    normalized = (runs["last"] / scale.where(scale != 0, 1.0)).groupby(runs["variant"])
    result = pd.DataFrame({"mean": normalized.mean(), "std": normalized.std(), "runs": normalized.count()})
    best = result["mean"].max()
    if best > 0:
        result[["mean", "std"]] /= best
    return result.sort_values("mean", ascending=False)
