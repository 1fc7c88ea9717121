"""A benchmark's runs in the layout of tables 2, 3, 4 and 6 of the paper, beside its numbers, with rliable's statistics."""

import json
import math
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import yaml
from rich.markup import escape
from rich.table import Table
from sb3_aarl.search.execution.matrix import comparable, task_name
from sb3_aarl.search.results.statistics import SUITE, improvements, interquartile_means
from sb3_aarl.search.studies.benchmark import read_abouts
from sb3_aarl.search.training.folder import FAILED, partial_curve

from sb3_aarl.envs import PREFIX

# A difference is marked from so many standard errors on.
STANDARD_ERRORS = 2.0
MARKS = {"higher": "▲", "lower": "▼", "": ""}
# The row of tables 2 and 6, which have no environments.
NORMALIZED = "normalized"
# With more variants than that they go down the rows, and of their pairs those with the best one are shown.
MANY = 6
# Suffix of a variant whose networks compute in bfloat16: the paper's all the same.
BF16 = "_bf16"
RUN_COLUMNS = ["variant", "environment", "seed", "checkpoint", "mean", "reason", "commit", "versions", "program", "episodes"]
PAPER_COLUMNS = ["checkpoint", "environment", "column", "variant", "mean", "std", "runs"]


@cache
def _paper() -> dict[int, dict[str, Any]]:
    return yaml.safe_load(Path(__file__).with_name("paper_tables.yml").read_text(encoding="utf-8"))


def paper_scores(number: int | None) -> pd.DataFrame:
    """A table of the paper, empty for None; ``variant`` is a name in ``zoo_configs``, None for methods that are not here."""
    rows = []
    for table in [] if number is None else [_paper()[number]]:
        for checkpoint, tasks in table["scores"].items():
            for task, scores in tasks.items():
                environment = task if task == NORMALIZED else f"{PREFIX}{task}-v0"
                for (column, variant), score in zip(table["columns"].items(), scores, strict=True):
                    if score is not None:
                        rows.append((checkpoint, environment, column, variant, *map(float, score), table["runs"]))
    return pd.DataFrame(rows, columns=PAPER_COLUMNS)


def closest_table(variants: Iterable[str]) -> int | None:
    """The paper's table with the most of some variants, None if none has any."""
    names = {variant.removesuffix(BF16) for variant in variants}
    matches = {number: len(names & set(table["columns"].values())) for number, table in _paper().items()}
    best = max(matches, key=lambda number: matches[number])
    return best if matches[best] else None


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


def in_order(runs: pd.DataFrame, number: int | None) -> pd.DataFrame:
    """The runs in the order of a table of the paper, its tasks and variants before others; None for alphabetical order."""
    positions = {}
    for key in ("environment", "variant"):
        paper = [name + suffix for name in paper_scores(number)[key].dropna() for suffix in ("", BF16)]
        positions[key] = {name: position for position, name in enumerate(dict.fromkeys([*paper, *sorted(runs[key])]))}
    keys = ["checkpoint", "environment", "variant", "seed"]
    return runs.sort_values(
        keys, key=lambda column: column.map(positions[column.name]) if column.name in positions else column, ignore_index=True
    )


def compare(runs: pd.DataFrame, number: int | None = None) -> pd.DataFrame:
    """
    Means and deviations over seeds, beside the paper's.

    ``std`` is the sample deviation (n - 1). A difference is marked when it exceeds two standard errors of a difference of two
    means, 2 sqrt(s^2 / n + S^2 / N), with s and n of the runs here, S and N of the paper's table; the paper does not say
    which deviation it prints. With one run here there is no s, and no mark.

    For tables 2 and 6 the returns are normalized, see :func:`normalized`, over the variants that are complete: if these are
    not the paper's, its numbers are left out. N is 5 seeds x 3 or 6 environments there, so both deviations contain the
    difference of the environments: the test is a cautious one.
    """
    keys = ["checkpoint", "environment", "variant"]
    numbers = ["paper_mean", "paper_std", "paper_runs"]
    if number in (2, 6):
        result = _normalized(runs)
    else:
        by_task = runs.groupby(keys, sort=False)["mean"]
        result = by_task.agg(planned="size", runs="count", mean="mean", std="std").reset_index()
    paper = paper_scores(number)
    headings = dict(zip(paper["variant"], paper["column"], strict=True))
    paper = paper.rename(columns={"variant": "paper_variant", "mean": numbers[0], "std": numbers[1], "runs": numbers[2]})
    paper = paper.drop(columns="column").astype(dict.fromkeys(numbers, float))
    result["paper_variant"] = result["variant"].str.removesuffix(BF16)
    names = zip(result["paper_variant"], result["variant"], strict=True)
    result["column"] = [headings.get(name, variant) for name, variant in names]
    result = result.merge(paper, on=[*keys[:2], "paper_variant"], how="left")
    for _, part in result.groupby("checkpoint"):
        if not _is_comparable(part, number):
            result.loc[part.index, numbers] = math.nan
    result["difference"] = result["mean"] - result["paper_mean"]
    variance = result["std"] ** 2 / result["runs"] + result["paper_std"] ** 2 / result["paper_runs"]
    result["standard_error"] = np.sqrt(variance)
    far = result["difference"].abs() > STANDARD_ERRORS * result["standard_error"]
    result["mark"] = np.where(far, np.where(result["difference"] > 0, "higher", "lower"), "")
    return result[[*keys, "planned", "runs", "mean", "std", "column", *numbers, "difference", "standard_error", "mark"]]


def _is_comparable(comparison: pd.DataFrame, number: int | None) -> bool:
    """Whether the scores of a checkpoint can be compared with the paper's: not if they are normalized by other variants."""
    is_normalized = (comparison["environment"] == NORMALIZED).any()
    variants = sorted(comparison.dropna(subset="mean")["variant"].str.removesuffix(BF16))
    return not is_normalized or variants == sorted(_paper()[number or 6]["columns"].values())


def _normalized(runs: pd.DataFrame) -> pd.DataFrame:
    """Each variant's mean over all environments; only variants that have all runs can be normalized together."""
    parts = []
    for checkpoint, part in runs.groupby("checkpoint"):
        n_runs = part.groupby("variant", sort=False)["mean"].count()
        n_planned = len(part[["environment", "seed"]].drop_duplicates())
        table = normalized(comparable(part.dropna(subset="mean"))).reindex(n_runs.index)
        table = table.assign(runs=n_runs, planned=n_planned, checkpoint=checkpoint, environment=NORMALIZED)
        parts.append(table.reset_index())
    return pd.concat(parts, ignore_index=True)


def normalized(runs: pd.DataFrame) -> pd.DataFrame:
    """
    Mean and sample deviation of normalized returns over all environments and seeds, for each variant.

    The paper does not say how returns are normalized. Here each is divided by the size of the mean of all variants on
    its environment, so that environments count alike and higher is better even if returns are negative, and then all by
    the best variant's mean, so that this is 1; unless it is negative.
    """
    scale = runs.groupby("environment")["mean"].transform("mean").abs()
    result = (runs["mean"] / scale.where(scale != 0, 1.0)).groupby(runs["variant"]).agg(["mean", "std"])
    best = result["mean"].max()
    return result / best if best > 0 else result


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
    """All that is shown of a benchmark: as returned by the functions above, and the number of the paper's table."""

    number: int | None
    runs: pd.DataFrame
    comparison: pd.DataFrame
    iqm: pd.DataFrame
    better: pd.DataFrame


def read_tables(folder: Path, number: int | None = None) -> Tables:
    """All that is shown of a benchmark, beside a table of the paper: by default the one with most of the variants."""
    runs = read_runs(folder)
    number = closest_table(runs["variant"]) if number is None else number
    runs = in_order(runs, number)
    return Tables(number, runs, compare(runs, number), interquartile_means(runs), improvements(runs))


def terminal_tables(tables: Tables) -> list[Table]:
    """The scores in the layout of the paper, then the statistics over tasks, for each checkpoint."""
    return [*_score_tables(tables.comparison, tables.number), *_statistics_tables(tables.iqm, tables.better)]


def _score_tables(comparison: pd.DataFrame, number: int | None) -> list[Table]:
    """For each checkpoint tasks and variants, the fewer as columns, the paper's score beside each."""
    tables = []
    for checkpoint, part in comparison.groupby("checkpoint"):
        problem = "" if _is_comparable(part, number) else ", without the paper's: normalized by other variants than its own"
        table = Table("", title=f"{_steps(checkpoint)} steps scores{problem}")
        variant_names = [
            (variant, variant if heading == variant else f"{heading}\n{variant}")
            for variant, heading in dict(zip(part["variant"], part["column"], strict=True)).items()
        ]
        task_names = [(environment, task_name(str(environment))) for environment in part["environment"].unique()]
        key, rows, other, columns = "environment", task_names, "variant", variant_names
        if len(columns) > max(MANY, len(rows)):
            key, rows, other, columns = other, columns, key, rows
        in_paper = set(part.dropna(subset="paper_mean")[other])
        for name, heading in columns:
            table.add_column(escape(heading), justify="right")
            if name in in_paper:
                table.add_column("paper", justify="right", style="dim")
        scores = {(row[key], row[other]): row for row in part.to_dict("records")}
        for name, heading in rows:
            cells = []
            for column, _ in columns:
                row = scores.get((name, column))
                cells.append("" if row is None else _own_score(row))
                if column in in_paper:
                    cells.append("" if row is None else _score(row["environment"], row["paper_mean"], row["paper_std"]))
            table.add_row(escape(heading), *cells)
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
    number, _, comparison, iqm, every = tables
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
    if comparison["paper_mean"].notna().any():
        lines.append(
            f"Paper: table {number}. ▲ ▼: the difference from it is more than two standard errors of the difference, "
            "2 sqrt(s²/n + S²/N)."
        )
    return lines


def as_data(tables: Tables) -> dict[str, Any]:
    """All that is shown, in plain values for JSON."""
    number, runs, comparison, iqm, better = tables
    frames = {"scores": comparison, "interquartile_means": iqm, "improvements": better, "runs": runs}
    records = {name: json.loads(frame.to_json(orient="records", double_precision=15)) for name, frame in frames.items()}
    return {"table": number, **records, "missing": missing(runs)}


def _steps(checkpoint: Any) -> str:
    return f"{checkpoint // 1000}K" if checkpoint % 1000 == 0 else f"{checkpoint:,}"


def _score(environment: str, mean: float, std: float) -> str:
    """As the paper prints it: integers, but three digits of what is normalized."""
    if math.isnan(mean):
        return "-"
    digits = 0 if environment.startswith(PREFIX) else 3 if max(abs(mean), std) < 10 else 1
    return f"{mean:.{digits}f}" if math.isnan(std) else f"{mean:.{digits}f} ± {std:.{digits}f}"


def _own_score(row: dict[Any, Any]) -> str:
    """With the number of runs where not all that are planned are there, and the mark."""
    number = "" if row["runs"] == row["planned"] else f" ({row['runs']}/{row['planned']})"
    return f"{_score(row['environment'], row['mean'], row['std'])}{number} {MARKS[row['mark']]}".rstrip()


def _range(low: float, high: float, digits: str) -> str:
    # A backslash: rich would take brackets for markup.
    return "-" if math.isnan(low) else rf"\[{low:{digits}}, {high:{digits}}]"
