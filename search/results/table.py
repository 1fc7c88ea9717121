"""A benchmark's runs as tables: means and deviations on each task, and rliable's statistics over tasks."""

import json
import math
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
from rich.markup import escape
from rich.table import Table
from sb3_aarl.search.execution.matrix import task_name
from sb3_aarl.search.results.statistics import SUITE, improvements, interquartile_means
from sb3_aarl.search.studies.benchmark import read_abouts
from sb3_aarl.search.training.folder import FAILED, partial_curve

from sb3_aarl.envs import PREFIX

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
        raise ValueError(f"{folder} has no runs of a benchmark")
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


def terminal_tables(tables: Tables) -> list[Table]:
    """The scores, then the statistics over tasks, for each checkpoint."""
    return [*_score_tables(tables.comparison), *_statistics_tables(tables.iqm, tables.better)]


def _score_tables(comparison: pd.DataFrame) -> list[Table]:
    """For each checkpoint tasks and variants, the fewer as columns."""
    tables = []
    for checkpoint, part in comparison.groupby("checkpoint"):
        part = part.assign(cell=[_score(row) for row in part.to_dict("records")], task=part["environment"].map(task_name))
        rows, columns = "task", "variant"
        if part["variant"].nunique() > max(MANY, part["task"].nunique()):
            rows, columns = columns, rows
        matrix = part.pivot(index=rows, columns=columns, values="cell").fillna("")
        matrix = matrix.loc[part[rows].unique(), part[columns].unique()]
        table = Table("", title=f"{_steps(checkpoint)} steps scores")
        for column in matrix:
            table.add_column(escape(str(column)), justify="right")
        for name, row in matrix.iterrows():
            table.add_row(escape(str(name)), *row)
        tables.append(table)
    return tables


def _statistics_tables(iqm: pd.DataFrame, better: pd.DataFrame) -> list[Table]:
    tables = []
    for checkpoint, part in iqm.groupby("checkpoint"):
        table = Table("", "variant", "IQM", "95 % interval", "runs", title=f"Interquartile means at {_steps(checkpoint)}")
        for row in part.to_dict("records"):
            scale = f"{SUITE}, {row['n_tasks']} tasks" if row["n_tasks"] > 1 else row["tasks"]
            mean = f"{row['iqm']:.1f}" if row["runs"] else "-"
            interval = _range(row["low"], row["high"], ".1f")
            table.add_row(scale, escape(row["variant"]), mean, interval, f"{row['runs']}/{row['planned']}")
        tables.append(table)
    for checkpoint, part in _few(better).groupby("checkpoint"):
        title = f"Probability that a run of the row is better than one of the column, at {_steps(checkpoint)}"
        cells = [
            f"{row['probability']:.2f} {_range(row['low'], row['high'], '.2f')}"
            + ("" if math.isnan(row["p"]) else f" p {row['p']:.2g}")
            for row in part.to_dict("records")
        ]
        matrix = part.assign(cell=cells).pivot(index="variant", columns="over", values="cell").fillna("")
        variants = list(part["variant"].unique())
        columns = [variant for variant in variants if variant in matrix] or list(matrix)
        table = Table("", *map(escape, columns), title=title)
        for variant in variants:
            table.add_row(escape(variant), *matrix.loc[variant, columns])
        tables.append(table)
    return tables


def _few(better: pd.DataFrame) -> pd.DataFrame:
    """The pairs that fit a page: of checkpoints with many variants those with the one that is best on average."""
    n_variants = better.groupby("checkpoint")["variant"].transform("nunique")
    losses = better.groupby(["checkpoint", "over"])["probability"].transform("mean")
    return better[(n_variants <= MANY) | (losses == losses.groupby(better["checkpoint"]).transform("min"))]


def footnotes(tables: Tables) -> list[str]:
    """How to read :func:`terminal_tables`, as far as something in them has to be explained."""
    _, _, iqm, every = tables
    better = _few(every)
    lines = []
    if (iqm["runs"] < 4).any():
        lines.append(
            "The interquartile mean of fewer than four runs is their mean, and its interval goes from the smallest to the "
            "largest."
        )
    if iqm["left_out"].any():
        lines.append("Interquartile means leave out the seeds that a variant has on some of the tasks only.")
    for (checkpoint, tasks), _ in iqm[iqm["skipped"] != ""].groupby(["checkpoint", "skipped"]):
        lines.append(f"At {_steps(checkpoint)} not every variant has runs on {tasks}: interquartile means leave that out.")
    if len(better) < len(every):
        lines.append(f"Of more than {MANY} variants the probabilities over the best one are shown, all by --json.")
    if better.groupby("checkpoint")["n_tasks"].nunique().gt(1).any():
        lines.append("Each probability is over the tasks that both variants have runs on, which are not the same for all.")
    if better["p"].notna().any():
        lines.append("p: Mann and Whitney's, two-sided.")
    return lines


def as_data(tables: Tables) -> dict[str, Any]:
    """All that is shown, in plain values for JSON."""
    runs, comparison, iqm, better = tables
    frames = {"scores": comparison, "interquartile_means": iqm, "improvements": better, "runs": runs}
    records = {name: json.loads(frame.to_json(orient="records", double_precision=15)) for name, frame in frames.items()}
    return {**records, "missing": missing(runs)}


def _steps(checkpoint: Any) -> str:
    return f"{checkpoint // 1000}K" if checkpoint % 1000 == 0 else f"{checkpoint:,}"


def _score(row: dict[Any, Any]) -> str:
    """Mean and deviation: integers on DeepMind Control; with the number of runs where some are missing."""
    number = "" if row["runs"] == row["planned"] else f" ({row['runs']}/{row['planned']})"
    if row["runs"] == 0:
        return f"-{number}"
    spread = row["std"] if row["runs"] > 1 else 0.0
    digits = 0 if row["environment"].startswith(PREFIX) else 3 if max(abs(row["mean"]), spread) < 10 else 1
    deviation = f" ± {spread:.{digits}f}" if row["runs"] > 1 else ""
    return f"{row['mean']:.{digits}f}{deviation}{number}"


def _range(low: float, high: float, digits: str) -> str:
    # A backslash: rich would take brackets for markup.
    return "-" if math.isnan(low) else rf"\[{low:{digits}}, {high:{digits}}]"
