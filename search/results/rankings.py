"""Do other metrics of learning curves prefer other losses (paper, B.2, figure 10)?"""

import warnings
from itertools import combinations

import numpy as np
import pandas as pd
from scipy.stats import kendalltau, spearmanr

METRICS = ("aulc", "first", "last")


def rankings(table: pd.DataFrame) -> pd.DataFrame:
    """
    Trials under three metrics of their learning curves.

    :param table: Trials that can be compared, as returned by ``analysis.analysed``
    :return: One row a trial that has a curve, in the order of AULC: ``number``, ``loss``, ``curve``, ``aulc`` (mean return
        over all checkpoints), ``first`` and ``last`` (mean return at the first and the last checkpoint), ``rank_aulc``,
        ``rank_first``, ``rank_last`` (1 is the highest return, equals share the better rank)
    :raises ValueError: when the curves have different checkpoints
    """
    trials = table[table["curve"].map(len) > 0]
    checkpoints = [", ".join(str(point[0]) for point in curve) for curve in trials["curve"]]
    for number, steps in zip(trials["number"], checkpoints, strict=True):
        if steps != checkpoints[0]:
            raise ValueError(
                f"trial {number} was evaluated at {steps} environment steps, trial {trials['number'].iloc[0]} at "
                f"{checkpoints[0]}: their learning curves cannot be compared"
            )
    result = trials[["number", "loss", "curve"]].copy()
    returns = trials["curve"].map(lambda curve: [mean for _, mean, _ in curve])
    result["aulc"] = returns.map(np.mean).astype(float)
    result["first"], result["last"] = returns.str[0].astype(float), returns.str[-1].astype(float)
    for name in METRICS:
        result[f"rank_{name}"] = result[name].rank(ascending=False, method="min").astype(int)
    return result.sort_values(["rank_aulc", "number"]).reset_index(drop=True)


def rank_agreement(ranking: pd.DataFrame, top: int = 10) -> pd.DataFrame:
    """
    How far the three metrics agree on which losses are good.

    :param ranking: As returned by :func:`rankings`
    :param top: Size of the leading groups that are compared
    :return: One row a pair of metrics: ``spearman``, ``spearman_p``, ``kendall``, ``kendall_p`` (scipy's, over all trials),
        and ``shared``: how many trials are among the best ``top`` under both
    """
    rows = {}
    leaders = {metric: set(leading(ranking, metric, top)["number"]) for metric in METRICS}
    for first, second in combinations(METRICS, 2):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # too few trials, or all alike: NaN says so
            spearman, kendall = (test(ranking[first], ranking[second]) for test in (spearmanr, kendalltau))
        rows[first, second] = {
            "spearman": spearman.statistic,
            "spearman_p": spearman.pvalue,
            "kendall": kendall.statistic,
            "kendall_p": kendall.pvalue,
            "shared": len(leaders[first] & leaders[second]),
        }
    return pd.DataFrame.from_dict(rows, orient="index")


def leading(ranking: pd.DataFrame, metric: str, top: int = 10) -> pd.DataFrame:
    """
    The best trials under one metric; of equals the ones with lower numbers.

    :param ranking: As returned by :func:`rankings`
    :param metric: ``aulc``, ``first`` or ``last``
    :param top: How many
    """
    return ranking.sort_values([f"rank_{metric}", "number"]).head(top)
