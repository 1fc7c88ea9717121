"""Do other metrics of learning curves prefer other losses (paper, B.2, figure 10)?"""

import warnings
from itertools import combinations

import numpy as np
import pandas as pd

METRICS = ("aulc", "first", "last")


def rankings(table: pd.DataFrame) -> pd.DataFrame:
    """
    The trials of ``analysis.analysed`` that have a curve, in the order of AULC, with their ranks by AULC and by their mean
    returns at the first and the last checkpoint.
    """
    trials = table[table["curve"].map(len) > 0]
    if trials.empty:
        raise ValueError("no complete trial has a learning curve")
    if trials["curve"].map(lambda curve: tuple(point[0] for point in curve)).nunique() > 1:
        raise ValueError("trials were evaluated at different environment steps: their learning curves cannot be compared")
    result = trials[["number", "loss", "curve"]].copy()
    returns = trials["curve"].map(lambda curve: [mean for _, mean, _ in curve])
    result["aulc"] = returns.map(np.mean).astype(float)
    result["first"], result["last"] = returns.str[0].astype(float), returns.str[-1].astype(float)
    for name in METRICS:
        result[f"rank_{name}"] = result[name].rank(ascending=False, method="min").astype(int)
    return result.sort_values(["rank_aulc", "number"]).reset_index(drop=True)


def rank_agreement(ranking: pd.DataFrame, top: int = 10) -> pd.DataFrame:
    """
    How far the three metrics agree on which losses are good: one row a pair of metrics with ``spearman`` and ``kendall`` (rank
    correlations over all trials), and ``shared``: how many trials are among the best ``top`` under both.
    """
    rows = {}
    for pair in combinations(METRICS, 2):
        first, second = (ranking[metric] for metric in pair)
        leaders = [set(leading(ranking, metric, top)["number"]) for metric in pair]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # too few trials, or all alike: NaN
            correlations = {method: first.corr(second, method=method) for method in ("spearman", "kendall")}
        rows[pair] = {**correlations, "shared": len(leaders[0] & leaders[1])}
    return pd.DataFrame.from_dict(rows, orient="index")


def leading(ranking: pd.DataFrame, metric: str, top: int = 10) -> pd.DataFrame:
    """The best trials under a metric (``aulc``, ``first`` or ``last``); of equals the ones with lower numbers."""
    return ranking.sort_values([f"rank_{metric}", "number"]).head(top)
