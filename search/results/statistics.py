"""rliable's statistics of a benchmark (Agarwal et al. 2021): interquartile means and probabilities of improvement."""

import math
from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np
import pandas as pd
from sb3_aarl.search.execution.matrix import task_name
from scipy import stats

from sb3_aarl.envs import PREFIX

# Resamples of the bootstrap.
RESAMPLES = 9999
CONFIDENCE = 0.95
# Tasks whose returns are on one scale, 0 to 1000.
SUITE = "DeepMind Control"


def interquartile_means(runs: pd.DataFrame) -> pd.DataFrame:
    """
    Interquartile mean (IQM) of the returns with a 95 % interval by stratified bootstrap (Agarwal et al. 2021, rliable):
    percentiles over resamples of the seeds within each task.

    It is over tasks of one scale: those of DeepMind Control together, each other environment by itself. Tasks count that all
    variants have runs on, and of each variant the seeds that it has on all of them.
    """
    rows = []
    scales = runs["environment"].map(lambda name: SUITE if name.startswith(PREFIX) else name).rename("tasks")
    for (checkpoint, tasks), scale in runs.groupby(["checkpoint", scales], sort=False):
        present = scale.dropna(subset="mean")
        is_common = present.groupby("environment")["variant"].nunique() == present["variant"].nunique()
        common = list(is_common.index[is_common])
        skipped = ", ".join(map(task_name, is_common.index[~is_common]))
        tasks = task_name(common[0]) if len(common) == 1 else tasks
        for variant in present["variant"].unique() if common else ():
            planned = scale[scale["environment"].isin(common) & (scale["variant"] == variant)]
            matrix = planned.pivot(index="environment", columns="seed", values="mean").dropna(axis="columns")
            samples = list(matrix.to_numpy())
            iqm = _iqm(*samples) if matrix.size else math.nan
            interval = _interval(samples, _iqm)
            left_out = planned["mean"].count() - matrix.size
            counts = (len(common), len(planned), matrix.size)
            rows.append((checkpoint, tasks, variant, *counts, iqm, *interval, left_out, skipped))
    columns = ["checkpoint", "tasks", "variant", "n_tasks", "planned", "runs", "iqm", "low", "high", "left_out", "skipped"]
    return pd.DataFrame(rows, columns=columns).sort_values("checkpoint", kind="stable", ignore_index=True)


def improvements(runs: pd.DataFrame) -> pd.DataFrame:
    """
    Probability that a run of one variant is better than one of another on the same task, a tie being half, as the mean over
    all tasks that both have runs on (Agarwal et al. 2021, rliable), with a 95 % interval by stratified bootstrap, and where
    that is one task the two-sided p of Mann and Whitney's test.
    """
    rows = []
    for checkpoint, part in runs.dropna(subset="mean").groupby("checkpoint"):
        returns = {key: group.to_numpy() for key, group in part.groupby(["variant", "environment"])["mean"]}
        tasks = {variant: set(group) for variant, group in part.groupby("variant")["environment"]}
        for variant, over in combinations(part["variant"].unique(), 2):
            if common := sorted(tasks[variant] & tasks[over]):
                samples = [returns[name, task] for name in (variant, over) for task in common]
                probability, (low, high) = _improvement(*samples), _interval(samples, _improvement)
                p = stats.mannwhitneyu(*samples).pvalue if len(common) == 1 else math.nan
                rows.append((checkpoint, variant, over, len(common), probability, low, high, p))
                rows.append((checkpoint, over, variant, len(common), 1 - probability, 1 - high, 1 - low, p))
    return pd.DataFrame(rows, columns=["checkpoint", "variant", "over", "n_tasks", "probability", "low", "high", "p"])


def _iqm(*samples: np.ndarray, axis: int = -1) -> Any:
    return stats.trim_mean(np.concatenate(samples, axis=axis), 0.25, axis=axis)


def _improvement(*samples: np.ndarray, axis: int = -1) -> Any:
    """Of the first half of the samples over the second: the share of all pairs that are better, averaged over the tasks."""
    half = len(samples) // 2
    pairs = zip(samples[:half], samples[half:], strict=True)
    signs = [np.sign(ours[..., :, None] - others[..., None, :]).mean(axis=(-2, -1)) for ours, others in pairs]
    return (1 + np.mean(signs, axis=0)) / 2


def _interval(samples: Sequence[np.ndarray], statistic: Any) -> tuple[float, float]:
    """rliable's own bootstrap needs an ``arch`` that pandas 3 breaks; scipy's, with a sample for each stratum, is the same."""
    if min(map(len, samples)) < 2:
        return math.nan, math.nan
    settings = {"vectorized": True, "method": "percentile", "confidence_level": CONFIDENCE, "batch": 1000}
    rng = np.random.default_rng(0)
    interval = stats.bootstrap(samples, statistic, n_resamples=RESAMPLES, rng=rng, **settings).confidence_interval
    return float(interval.low), float(interval.high)
