"""A benchmark's runs as tables: means and deviations on each task, rliable's statistics over tasks (Agarwal et al. 2021)."""

import json
import math
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from sb3_aarl.search.execution.matrix import task_name
from sb3_aarl.search.studies.benchmark import read_abouts
from sb3_aarl.search.training.folder import FAILED, partial_curve
from scipy import stats

from sb3_aarl.envs import PREFIX

# Resamples of the bootstrap.
RESAMPLES = 9999
CONFIDENCE = 0.95
# Tasks whose returns are on one scale, 0 to 1000.
SUITE = "DeepMind Control"
# With more variants than that they go down the rows, and of their pairs those with the best one are shown.
MANY = 6
RUN_COLUMNS = ["variant", "environment", "seed", "checkpoint", "mean", "reason", "commit", "versions", "program", "episodes"]


def read_runs(folder: Path) -> pd.DataFrame:
    """
    The runs of a benchmark: one row for each checkpoint of each planned run, ``reason`` being why its mean is missing, and
    ``commit`` and ``versions`` those of all sessions that trained it; empty or 0 where something is not known.
    """
    rows: list[tuple[Any, ...]] = []
    for path, about in read_abouts(folder).items():
        returns = {point.environment_steps: point.mean for point in partial_curve(path)}
        commits, versions = (
            ", ".join(dict.fromkeys(session.get(key, "") for session in about["sessions"])) for key in ("commit", "versions")
        )
        settings = (commits, versions, about.get("program", "aarl benchmark"), about.get("evaluation_episodes", 0))
        for checkpoint in about["checkpoints"]:
            mean = returns.get(checkpoint, math.nan)
            reason = "" if math.isfinite(mean) else _why_missing(path, about, checkpoint, returns)
            cell = (about["variant"], about["environment"], about["seed"])
            rows.append((*cell, checkpoint, math.nan if reason else mean, reason, *settings))
    if not rows:
        raise ValueError(f"{folder} has no runs of a benchmark. aarl benchmark trains them")
    return pd.DataFrame(rows, columns=RUN_COLUMNS)


def _why_missing(path: Path, about: dict[str, Any], checkpoint: int, returns: dict[int, float]) -> str:
    if checkpoint in returns:
        return f"the return is {returns[checkpoint]}"
    if (path / FAILED).exists():
        return json.loads((path / FAILED).read_text(encoding="utf-8"))["reason"]
    return f"unfinished, evaluated up to {max(returns, default=0):,}" if about["sessions"] else "not started"


def compare(runs: pd.DataFrame) -> pd.DataFrame:
    """Mean and sample deviation over seeds of each variant on each environment, with its planned and finished runs."""
    returns = runs.groupby(["checkpoint", "environment", "variant"], sort=False)["mean"]
    return returns.agg(planned="size", runs="count", mean="mean", std="std").reset_index()


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
        tasks = task_name(common[0]) if len(common) == 1 else tasks
        for variant in present["variant"].unique() if common else ():
            planned = scale[scale["environment"].isin(common) & (scale["variant"] == variant)]
            matrix = planned.pivot(index="environment", columns="seed", values="mean").dropna(axis="columns")
            samples = list(matrix.to_numpy())
            iqm = _iqm(*samples) if matrix.size else math.nan
            interval = _interval(samples, _iqm)
            rows.append((checkpoint, tasks, variant, len(common), len(planned), matrix.size, iqm, *interval))
    columns = ["checkpoint", "tasks", "variant", "n_tasks", "planned", "runs", "iqm", "low", "high"]
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


def missing(runs: pd.DataFrame) -> list[str]:
    """What is planned and not there, one line for each reason."""
    lines = []
    keys = ["checkpoint", "variant", "environment", "reason"]
    ordered = runs[runs["reason"] != ""].sort_values([*keys[:3], "seed"])
    for (checkpoint, variant, environment, reason), group in ordered.groupby(keys, sort=False):
        seeds = ", ".join(map(str, group["seed"]))
        noun = "seed" if len(group) == 1 else "seeds"
        lines.append(f"Missing at {checkpoint:,}: {variant} on {task_name(str(environment))}, {noun} {seeds}: {reason}")
    return lines


def mixed(runs: pd.DataFrame) -> list[str]:
    """A line for each setting in which runs differ that should not be compared then, with the number of runs."""
    names = {"commit": "commits", "versions": "versions", "program": "programs", "episodes": "numbers of episodes"}
    runs = runs.drop_duplicates(["variant", "environment", "seed"])
    lines = []
    for key, name in names.items():
        counts = runs.loc[~runs[key].isin(["", 0]), key].value_counts()
        if len(counts) > 1:
            text = "; ".join(f"{value} ({count})" for value, count in counts.items())
            lines.append(f"Runs with different {name}: {text}")
    return lines


class Tables(NamedTuple):
    """All that is shown of a benchmark, as returned by the functions above."""

    runs: pd.DataFrame
    comparison: pd.DataFrame
    iqm: pd.DataFrame
    better: pd.DataFrame


def read_tables(folder: Path) -> Tables:
    """All that is shown of a benchmark, in alphabetical order."""
    runs = read_runs(folder).sort_values(["checkpoint", "environment", "variant", "seed"], ignore_index=True)
    return Tables(runs, compare(runs), interquartile_means(runs), improvements(runs))


def text_tables(tables: Tables) -> dict[str, pd.DataFrame]:
    """Tables of texts by their titles: for each checkpoint the scores, then the statistics over tasks."""
    texts = {}
    for checkpoint, part in tables.comparison.groupby("checkpoint"):
        part = part.assign(cell=part.apply(_score, axis=1), task=part["environment"].map(task_name))
        rows, columns = "task", "variant"  # the fewer as columns
        if part["variant"].nunique() > max(MANY, part["task"].nunique()):
            rows, columns = columns, rows
        texts[f"{_steps(checkpoint)} steps scores"] = _matrix(part, rows, columns)
    for checkpoint, part in tables.iqm.groupby("checkpoint"):
        scales = part["tasks"].where(part["n_tasks"] < 2, SUITE + ", " + part["n_tasks"].astype(str) + " tasks")
        text = pd.DataFrame({"": scales, "variant": part["variant"], "IQM": part["iqm"].map("{:.1f}".format)})
        text["IQM"] = text["IQM"].where(part["runs"] > 0, "-")
        text["95 % interval"] = part.apply(_interval_text, axis=1, digits=".1f")
        text["runs"] = part["runs"].astype(str) + "/" + part["planned"].astype(str)
        texts[f"Interquartile means at {_steps(checkpoint)}"] = text
    for checkpoint, part in _few(tables.better).groupby("checkpoint"):
        p = part["p"].map(" p {:.2g}".format).where(part["p"].notna(), "")
        cells = part["probability"].map("{:.2f} ".format) + part.apply(_interval_text, axis=1, digits=".2f") + p
        title = f"Probability that a run of the row is better than one of the column, at {_steps(checkpoint)}"
        texts[title] = _matrix(part.assign(cell=cells), "variant", "over")
    return texts


def _matrix(part: pd.DataFrame, rows: str, columns: str) -> pd.DataFrame:
    """A table of cells, rows and columns in the order in which they are there first, those in both in that of the rows."""
    matrix = part.pivot(index=rows, columns=columns, values="cell").fillna("")
    heads = sorted(part[columns].unique(), key=[*part[rows].unique(), *part[columns].unique()].index)
    return matrix.loc[part[rows].unique(), heads].rename_axis("").reset_index()


def _few(better: pd.DataFrame) -> pd.DataFrame:
    """The pairs that fit a page: of checkpoints with many variants those with the one that is best on average."""
    n_variants = better.groupby("checkpoint")["variant"].transform("nunique")
    losses = better.groupby(["checkpoint", "over"])["probability"].transform("mean")
    return better[(n_variants <= MANY) | (losses == losses.groupby(better["checkpoint"]).transform("min"))]


def _steps(checkpoint: Any) -> str:
    return f"{checkpoint // 1000}K" if checkpoint % 1000 == 0 else f"{checkpoint:,}"


def _score(row: pd.Series) -> str:
    """Mean and deviation: integers on DeepMind Control; with the number of runs where some are missing."""
    number = "" if row["runs"] == row["planned"] else f" ({row['runs']}/{row['planned']})"
    if row["runs"] == 0:
        return f"-{number}"
    spread = row["std"] if row["runs"] > 1 else 0.0
    digits = 0 if row["environment"].startswith(PREFIX) else 3 if max(abs(row["mean"]), spread) < 10 else 1
    deviation = f" ± {spread:.{digits}f}" if row["runs"] > 1 else ""
    return f"{row['mean']:.{digits}f}{deviation}{number}"


def _interval_text(row: pd.Series, digits: str) -> str:
    return "-" if math.isnan(row["low"]) else f"[{row['low']:{digits}}, {row['high']:{digits}}]"
