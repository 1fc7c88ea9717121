"""A benchmark's runs in the layout of the paper's tables 3, 4 and 6, beside the paper's numbers, with rliable's statistics."""

import json
import math
from collections.abc import Iterable, Sequence
from functools import cache, partial
from itertools import chain, permutations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import yaml
from rich.markup import escape
from rich.table import Table
from scipy import stats

from sb3_aarl.callbacks import read_curve
from sb3_aarl.envs import PREFIX
from search.execution.matrix import comparable
from search.studies import operator_selection
from search.studies.benchmark import read_abouts, task_name
from search.training.provenance import ABOUT

# Resamples of the bootstrap.
RESAMPLES = 9999
CONFIDENCE = 0.95
# A difference is marked from so many standard errors on.
STANDARD_ERRORS = 2.0
MARKS = {"higher": "▲", "lower": "▼", "": ""}
# The row of table 6, which has no environments.
NORMALIZED = "normalized"
# Of the name of a variant whose networks compute in bfloat16.
BF16 = "_bf16"
# Tasks whose returns are on one scale, 0 to 1000.
SUITE = "DeepMind Control"


@cache
def _paper() -> dict[int, dict[str, Any]]:
    return yaml.safe_load(Path(__file__).with_name("paper_tables.yml").read_text(encoding="utf-8"))


def paper_scores(number: int) -> pd.DataFrame:
    """
    A table of the paper: one row a score with ``checkpoint`` (environment steps), ``environment`` (its id), ``column`` (the
    paper's heading), ``variant`` (the name in ``zoo_configs``, None for methods that are not here), ``mean``, ``std`` and
    ``runs``.

    :param number: 3, 4 or 6
    :raises ValueError: for another one
    """
    if number not in _paper():
        raise ValueError(f"scores are in the paper's tables {', '.join(map(str, _paper()))}, not {number}")
    table = _paper()[number]
    rows = []
    for checkpoint, tasks in table["scores"].items():
        for task, scores in tasks.items():
            environment = task if task == NORMALIZED else f"{PREFIX}{task}-v0"
            for (column, variant), score in zip(table["columns"].items(), scores, strict=True):
                if score is not None:
                    rows.append((checkpoint, environment, column, variant, *map(float, score), table["runs"]))
    return pd.DataFrame(rows, columns=["checkpoint", "environment", "column", "variant", "mean", "std", "runs"])


def paper_variant(variant: str) -> str:
    """
    Which of the paper's variants one is: computed in bfloat16 it is the same one.

    :param variant: Its name
    """
    return variant.removesuffix(BF16)


def closest_table(variants: Iterable[str]) -> int | None:
    """
    The paper's table with the most of some variants, None if none has any.

    :param variants: Names of variants
    """
    names = set(map(paper_variant, variants))
    matches = {number: len(names & set(table["columns"].values())) for number, table in _paper().items()}
    best = max(matches, key=lambda number: matches[number])
    return best if matches[best] else None


def read_runs(folder: Path) -> pd.DataFrame:
    """
    What a benchmark's folder has: one row for each checkpoint of each run that was asked for, with ``variant``,
    ``environment``, ``seed``, ``checkpoint`` (environment steps), ``mean`` (return; NaN if it is missing), ``reason`` (why it
    is missing, else empty), ``commit`` and ``versions`` (of all sessions that trained it), the ``program`` if it was not
    ``aarl benchmark``, and ``episodes`` (of an evaluation; 0 if that is not known).

    :param folder: Folder of a benchmark; runs that were copied there from another machine count too
    :raises ValueError: when there are none, when one cannot be read, and as :func:`search.studies.benchmark.read_abouts` does
    """
    rows: list[tuple[Any, ...]] = []
    abouts, unreadable = read_abouts(folder)
    for path, about in abouts.items():
        try:
            rows += _points(path, about)
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path} is not what a benchmark leaves: {type(error).__name__}: {error}") from None
    of_task = {path.parent.name: about for path, about in abouts.items()}
    for path in unreadable:
        # What its folder says, and the other runs on its task: it is not passed over in silence.
        task, seed = path.parent.name, path.name.removeprefix("seed-")
        if task not in of_task or not seed.isdecimal():
            raise ValueError(f"{path} is not what a benchmark leaves: {ABOUT} cannot be read")
        run = (path.parent.parent.name, of_task[task]["environment"], int(seed))
        reason = f"its {ABOUT} cannot be read"
        rows += [(*run, checkpoint, math.nan, reason, "", "", "", 0) for checkpoint in of_task[task]["checkpoints"]]
    if not rows:
        raise ValueError(f"{folder} has no runs of a benchmark")
    columns = ["variant", "environment", "seed", "checkpoint", "mean", "reason", "commit", "versions", "program", "episodes"]
    return pd.DataFrame(rows, columns=columns)


def _points(path: Path, about: dict[str, Any]) -> list[tuple[Any, ...]]:
    """The rows of one run."""
    curve = path / "curve.csv"
    points = {point.environment_steps: point.mean for point in read_curve(curve)} if curve.exists() else {}
    commits = ", ".join(dict.fromkeys(session["commit"] for session in about["sessions"]))
    packages = [session["versions"].split(", ") for session in about["sessions"] if "versions" in session]
    versions = ", ".join(dict.fromkeys(chain.from_iterable(packages)))
    rows = []
    for checkpoint in about["checkpoints"]:
        mean = points.get(checkpoint, math.nan)
        if math.isfinite(mean):
            reason = ""
        elif checkpoint in points:
            reason = f"its return is {mean}"
        else:
            begun = f"unfinished, evaluated up to {max(points, default=0):,}" if about["sessions"] else "not begun"
            reason = about.get("failed", begun)
        run = (about["variant"], about["environment"], about["seed"])
        how = (commits, versions, about.get("program", ""), about.get("evaluation_episodes", 0))
        rows.append((*run, checkpoint, math.nan if reason else mean, reason, *how))
    return rows


def in_order(runs: pd.DataFrame, number: int | None) -> pd.DataFrame:
    """
    The runs in the order of a table of the paper, its tasks and variants before others.

    :param runs: As :func:`read_runs` gives them
    :param number: 3, 4 or 6, None for the alphabet's order
    """
    places = {}
    for key in ("environment", "variant"):
        of_paper = paper_scores(number)[key].dropna().tolist() if number is not None else []
        of_paper = [name + suffix for name in of_paper for suffix in ("", BF16)]
        names = dict.fromkeys(of_paper + sorted(runs[key]))
        places[key] = {name: place for place, name in enumerate(names)}
    keys = ["checkpoint", "environment", "variant", "seed"]
    by_place = runs.sort_values(keys, key=lambda column: column.map(places.get(str(column.name), lambda value: value)))
    return by_place.reset_index(drop=True)


def compare(runs: pd.DataFrame, number: int | None = None) -> pd.DataFrame:
    """
    Means and deviations over seeds, beside the paper's.

    ``std`` is the sample deviation (n - 1). A difference is marked when it exceeds two standard errors of a difference of two
    means, 2 sqrt(s^2 / n + S^2 / N), with s and n of the runs here, S and N of the paper's table; the paper does not say
    which deviation it prints. With one run here there is no s, and no mark.

    For table 6 the returns are normalized as for table 2, see :func:`search.studies.operator_selection.table`: the paper
    says for neither how. N is 5 seeds x 6 environments there. Both deviations then have the difference of the environments
    in them, which makes the test a cautious one. What the returns are normalized by are the variants that are complete: if
    these are not the paper's four, no number of the paper stands beside them.

    :param runs: As :func:`read_runs` gives them
    :param number: 3, 4 or 6, None for no table of the paper
    :return: One row for each ``checkpoint``, ``environment`` and ``variant``, in their order: ``asked`` and ``runs`` (how
        many were asked for, and are there), ``mean``, ``std``, ``column`` (the paper's heading), ``paper_mean``,
        ``paper_std``, ``paper_runs``, ``difference``, ``standard_error`` and ``mark`` (``higher``, ``lower`` or empty)
    """
    keys = ["checkpoint", "environment", "variant"]
    result = _normalized(runs) if number == 6 else _by_task(runs)
    columns = [*keys, "column", "paper_mean", "paper_std", "paper_runs"]
    if number is None:
        paper = pd.DataFrame(columns=columns)
        names = {}
    else:
        paper = paper_scores(number).rename(columns={name: f"paper_{name}" for name in ("mean", "std", "runs")})
        names = dict(zip(paper["variant"], paper["column"], strict=True))
    numbers = dict.fromkeys(columns[-3:], float)
    result["paper_variant"] = result["variant"].map(paper_variant)
    paper = paper.drop(columns="column").astype(numbers).rename(columns={"variant": "paper_variant"})
    result = result.merge(paper, on=[*keys[:2], "paper_variant"], how="left")
    for _, part in result.groupby("checkpoint"):
        if not _is_comparable(part):
            result.loc[part.index, list(numbers)] = math.nan
    same = zip(result["paper_variant"], result["variant"], strict=True)
    result["column"] = [names.get(of_paper, variant) for of_paper, variant in same]
    result["difference"] = result["mean"] - result["paper_mean"]
    variance = result["std"] ** 2 / result["runs"] + result["paper_std"] ** 2 / result["paper_runs"]
    result["standard_error"] = np.sqrt(variance)
    far = result["difference"].abs() > STANDARD_ERRORS * result["standard_error"]
    result["mark"] = np.where(far, np.where(result["difference"] > 0, "higher", "lower"), "")
    return result[[*keys, "asked", "runs", "mean", "std", *columns[3:], "difference", "standard_error", "mark"]]


def _is_comparable(comparison: pd.DataFrame) -> bool:
    """Whether the scores of a checkpoint can be compared with the paper's: not if they are normalized by other variants."""
    of_paper = _paper()[6]["columns"].values()
    is_normalized = (comparison["environment"] == NORMALIZED).any()
    return not is_normalized or sorted(map(paper_variant, comparison.dropna(subset="mean")["variant"])) == sorted(of_paper)


def _by_task(runs: pd.DataFrame) -> pd.DataFrame:
    grouped = runs.groupby(["checkpoint", "environment", "variant"], sort=False)["mean"]
    summary = {"asked": grouped.size(), "runs": grouped.count(), "mean": grouped.mean(), "std": grouped.std()}
    return pd.DataFrame(summary).reset_index()


def _normalized(runs: pd.DataFrame) -> pd.DataFrame:
    """Each variant's mean over all environments; only variants that have all runs can be normalized together."""
    parts = []
    for checkpoint, all_of in runs.groupby("checkpoint"):
        there = all_of.groupby("variant", sort=False)["mean"].count()
        complete = comparable(all_of.dropna(subset="mean")).rename(columns={"mean": "last"})
        n_asked = len(all_of[["environment", "seed"]].drop_duplicates())
        table = operator_selection.table(complete).reindex(there.index)
        table = table.assign(runs=there, asked=n_asked, checkpoint=checkpoint)
        parts.append(table.reset_index().assign(environment=NORMALIZED))
    return pd.concat(parts, ignore_index=True)


def interquartile_means(runs: pd.DataFrame, n_resamples: int = RESAMPLES) -> pd.DataFrame:
    """
    Interquartile mean (IQM) of the returns with a 95 % interval by stratified bootstrap (Agarwal et al. 2021, rliable):
    percentiles over resamples of the seeds within each task.

    The IQM is over returns as they are, so only over tasks of one scale: those of DeepMind Control (0 to 1000) together,
    each other environment for itself. Only tasks count that all variants of the checkpoint have runs on, and of each variant
    the seeds that it has on all of them, so that every task weighs the same; variants without any run are left out.

    :param runs: As :func:`read_runs` gives them
    :param n_resamples: Resamples of the bootstrap
    :return: One row for each ``checkpoint``, ``tasks`` (of which scale; a single task's name) and ``variant``: ``n_tasks``,
        ``asked``, ``runs`` that count, ``iqm`` (NaN without any), ``low`` and ``high`` (NaN where a task has one run only),
        and the runs ``left_out``
    """
    rows = []
    for (checkpoint, tasks), of_scale in runs.groupby(["checkpoint", _scale(runs)], sort=False):
        common, scores = _scores(of_scale)
        tasks = task_name(common[0]) if len(common) == 1 else tasks
        of_common = of_scale[of_scale["environment"].isin(common)]
        for variant in scores:
            asked = of_common[of_common["variant"] == variant]
            matrix = asked.pivot(index="environment", columns="seed", values="mean").dropna(axis="columns")
            samples = list(matrix.to_numpy())
            interval = _interval(samples, _iqm, n_resamples)
            iqm = _iqm(*samples) if matrix.size else math.nan
            left_out = asked["mean"].count() - matrix.size
            rows.append((checkpoint, tasks, variant, len(common), len(asked), matrix.size, iqm, *interval, left_out))
    columns = ["checkpoint", "tasks", "variant", "n_tasks", "asked", "runs", "iqm", "low", "high", "left_out"]
    return pd.DataFrame(rows, columns=columns).sort_values("checkpoint", kind="stable", ignore_index=True)


def _scale(runs: pd.DataFrame) -> pd.Series:
    """The tasks whose returns can be averaged: those of DeepMind Control together, each other one for itself."""
    return runs["environment"].map(lambda name: SUITE if name.startswith(PREFIX) else name).rename("tasks")


def improvements(runs: pd.DataFrame, n_resamples: int = RESAMPLES) -> pd.DataFrame:
    """
    Probability that a run of one variant is better than one of another on the same task, a tie being half, as the mean over
    all tasks that both have runs on (Agarwal et al. 2021, rliable), with a 95 % interval by stratified bootstrap.

    :param runs: As :func:`read_runs` gives them
    :param n_resamples: Resamples of the bootstrap
    :return: One row for each ``checkpoint``, ``variant`` and ``over``: ``n_tasks``, ``probability``, ``low`` and ``high``
    """
    rows = []
    for checkpoint, of_checkpoint in runs.groupby("checkpoint"):
        there = dict.fromkeys(of_checkpoint.dropna(subset="mean")["variant"])
        for variant, over in permutations(there, 2):
            common, scores = _scores(of_checkpoint[of_checkpoint["variant"].isin([variant, over])])
            if common:
                samples = [*scores[variant], *scores[over]]
                interval = _interval(samples, _improvement, n_resamples)
                rows.append((checkpoint, variant, over, len(common), _improvement(*samples), *interval))
    return pd.DataFrame(rows, columns=["checkpoint", "variant", "over", "n_tasks", "probability", "low", "high"])


def _are_common(there: pd.DataFrame) -> pd.Series:
    """Of each task, whether all variants that have any run have runs on it."""
    return there.groupby("environment")["variant"].nunique() == there["variant"].nunique()


def _scores(runs: pd.DataFrame) -> tuple[list[str], dict[str, list[np.ndarray]]]:
    """Tasks that all variants that have any run have runs on, and for each of these the scores on each of them."""
    there = runs.dropna(subset="mean")
    common = [str(name) for name, is_common in _are_common(there).items() if is_common]
    scores = {
        (variant, task): group.to_numpy() for (variant, task), group in there.groupby(["variant", "environment"])["mean"]
    }
    variants = [str(name) for name in dict.fromkeys(there["variant"])] if common else []
    return common, {variant: [scores[variant, task] for task in common] for variant in variants}


def _iqm(*samples: np.ndarray, axis: int = -1) -> Any:
    return stats.trim_mean(np.concatenate(samples, axis=axis), 0.25, axis=axis)


def _improvement(*samples: np.ndarray, axis: int = -1) -> Any:
    """Of the first half of the samples over the second."""
    n_tasks = len(samples) // 2
    per_task = []
    for ours, others in zip(samples[:n_tasks], samples[n_tasks:], strict=True):
        ours, others = ours[..., :, None], others[..., None, :]
        per_task.append(((ours > others) + 0.5 * (ours == others)).mean(axis=(-2, -1)))
    return np.mean(per_task, axis=0)


def _interval(samples: Sequence[np.ndarray], statistic: Any, n_resamples: int) -> tuple[float, float]:
    """rliable's own bootstrap needs an ``arch`` that pandas 3 breaks; scipy's, with a sample for each stratum, is the same."""
    if min(map(len, samples)) < 2:
        return math.nan, math.nan
    bootstrap = partial(stats.bootstrap, vectorized=True, method="percentile", confidence_level=CONFIDENCE, batch=1000)
    result = bootstrap(samples, statistic, n_resamples=n_resamples, rng=np.random.default_rng(0))
    return float(result.confidence_interval.low), float(result.confidence_interval.high)


def missing(runs: pd.DataFrame) -> list[str]:
    """
    What is asked for and not there, one line for each reason, run by run.

    :param runs: As :func:`read_runs` gives them
    """
    lines = []
    keys = ["checkpoint", "variant", "environment", "reason"]
    ordered = runs[runs["reason"] != ""].sort_values([*keys[:3], "seed"])
    for (checkpoint, variant, environment, reason), group in ordered.groupby(keys, sort=False):
        seeds = ", ".join(map(str, group["seed"]))
        noun = "seed" if len(group) == 1 else "seeds"
        lines.append(f"Missing at {checkpoint:,}: {variant} on {task_name(str(environment))}, {noun} {seeds}: {reason}")
    return lines


def commits(runs: pd.DataFrame) -> dict[str, int]:
    """
    How many runs were trained with which commits, and with which versions of packages of which there are several. A run
    that went on with another one counts for both.

    :param runs: As :func:`read_runs` gives them
    """
    of_runs = runs.drop_duplicates(["variant", "environment", "seed"])
    counts = of_runs["commit"].str.split(", ").explode().value_counts()
    versions = of_runs["versions"].str.split(", ").explode().value_counts()
    several = versions[versions.index.str.split(" ").str[0].duplicated(keep=False)]
    return {str(name): int(count) for name, count in pd.concat([counts, several]).items() if name}


def mixed(runs: pd.DataFrame) -> list[str]:
    """
    A line if runs were trained with several commits or versions, as :func:`commits` counts them, one for each program that
    is not ``aarl benchmark``, and one if evaluations are of different numbers of episodes.

    :param runs: As :func:`read_runs` gives them
    """
    counts = commits(runs)
    of_each = "; ".join(f"{commit} ({count})" for commit, count in counts.items())
    lines = [f"Runs of several commits or versions: {of_each}"] if len(counts) > 1 else []
    for program, of_program in runs[runs["program"] != ""].groupby("program"):
        lines.append(f"Trained by {program}: {', '.join(dict.fromkeys(of_program['variant']))}")
    episodes = runs[runs["episodes"] > 0].drop_duplicates(["variant", "episodes"])
    if episodes["episodes"].nunique() > 1:
        of_each = ", ".join(f"{row['variant']} {row['episodes']}" for row in episodes.to_dict("records"))
        lines.append(f"Evaluations are means of different numbers of episodes: {of_each}")
    return lines


class Tables(NamedTuple):
    """
    What there is to say of a benchmark: the table of the paper beside it, its runs in that table's order, and of these what
    :func:`compare`, :func:`interquartile_means` and :func:`improvements` say.
    """

    number: int | None
    runs: pd.DataFrame
    comparison: pd.DataFrame
    iqm: pd.DataFrame
    better: pd.DataFrame


def read_tables(folder: Path, number: int | None = None) -> Tables:
    """
    Everything that is shown of a benchmark.

    :param folder: Folder of a benchmark
    :param number: Table of the paper, None for the one with most of the variants
    :raises ValueError: as :func:`read_runs`
    """
    runs = read_runs(folder)
    number = closest_table(runs["variant"]) if number is None else number
    runs = in_order(runs, number)
    return Tables(number, runs, compare(runs, number), interquartile_means(runs), improvements(runs))


def score_tables(comparison: pd.DataFrame) -> list[Table]:
    """
    The layout of the paper: for each checkpoint tasks as rows, variants as columns, the paper's score beside each.

    :param comparison: As :func:`compare` gives it
    """
    tables = []
    for checkpoint, part in comparison.groupby("checkpoint"):
        others = "" if _is_comparable(part) else ", without the paper's: normalized by other variants than its four"
        table = Table("", title=f"{_steps(checkpoint)} steps scores{others}")
        headings = dict(zip(part["variant"], part["column"], strict=True))
        in_paper = set(part.dropna(subset="paper_mean")["variant"])
        for variant, heading in headings.items():
            table.add_column(escape(variant if heading == variant else f"{heading}\n{variant}"), justify="right")
            if variant in in_paper:
                table.add_column("paper", justify="right", style="dim")
        for environment, of_task in part.groupby("environment", sort=False):
            rows = {row["variant"]: row for row in of_task.to_dict("records")}
            cells = []
            for variant in headings:
                row = rows.get(variant)
                cells.append("" if row is None else _own_score(row))
                if variant in in_paper:
                    cells.append("" if row is None else _score(row["environment"], row["paper_mean"], row["paper_std"]))
            table.add_row(task_name(str(environment)), *cells)
        tables.append(table)
    return tables


def statistics_tables(iqm: pd.DataFrame, better: pd.DataFrame) -> list[Table]:
    """
    The statistics over tasks.

    :param iqm: As :func:`interquartile_means` gives them
    :param better: As :func:`improvements` gives them
    """
    tables = []
    for checkpoint, part in iqm.groupby("checkpoint"):
        table = Table("", "variant", "IQM", "95 % interval", "runs", title=f"Interquartile means at {_steps(checkpoint)}")
        for row in part.to_dict("records"):
            scale = f"{SUITE}, {row['n_tasks']} tasks" if row["n_tasks"] > 1 else row["tasks"]
            interval = _range(row["low"], row["high"], ".1f")
            iqm_there = f"{row['iqm']:.1f}" if row["runs"] else "-"
            table.add_row(scale, escape(row["variant"]), iqm_there, interval, f"{row['runs']}/{row['asked']}")
        tables.append(table)
    for checkpoint, part in better.groupby("checkpoint"):
        variants = [str(variant) for variant in dict.fromkeys(part["variant"])]
        title = f"Probability that a run of the row is better than one of the column, at {_steps(checkpoint)}"
        table = Table("", *map(escape, variants), title=title)
        cells = {
            (row["variant"], row["over"]): f"{row['probability']:.2f} {_range(row['low'], row['high'], '.2f')}"
            for row in part.to_dict("records")
        }
        for variant in variants:
            table.add_row(escape(variant), *(cells.get((variant, over), "") for over in variants))
        tables.append(table)
    return tables


def footnotes(number: int | None, comparison: pd.DataFrame, iqm: pd.DataFrame, better: pd.DataFrame) -> list[str]:
    """
    How to read :func:`score_tables` and :func:`statistics_tables`, as far as something in them has to be explained.

    :param number: Table of the paper
    :param comparison: As :func:`compare` gives it
    :param iqm: As :func:`interquartile_means` gives them
    :param better: As :func:`improvements` gives them
    """
    lines = []
    if (iqm["runs"] < 4).any():
        lines.append(
            "The interquartile mean of fewer than four runs is their mean, and its interval goes from the smallest to the "
            "largest."
        )
    if iqm["left_out"].any():
        lines.append("Interquartile means leave out the seeds that a variant has on some of the tasks only.")
    there = comparison[(comparison["environment"] != NORMALIZED) & (comparison["runs"] > 0)]
    for (checkpoint, _), part in there.groupby(["checkpoint", _scale(there)]):
        some = [task_name(str(name)) for name, is_common in _are_common(part).items() if not is_common]
        if some:
            lines.append(
                f"At {_steps(checkpoint)} not every variant has runs on {', '.join(some)}: interquartile means leave that out."
            )
    if better.groupby("checkpoint")["n_tasks"].nunique().gt(1).any():
        lines.append("Each probability is over the tasks that both variants have runs on, which are not the same for all.")
    if (better["probability"].isin([0, 1]) & (better["low"] == better["high"])).any():
        lines.append(
            "An interval without width says only that no run of one variant is better than any of the other: resampled runs "
            "cannot show more. Two equal variants look like that with a probability of 1/3 (two runs each on one task), 1/10 "
            "(three) or 1/126 (five)."
        )
    if comparison["paper_mean"].notna().any():
        lines.append(
            f"Paper: table {number}. ▲ ▼: the difference from it is more than two standard errors of the difference, "
            "2 sqrt(s²/n + S²/N)."
        )
    return lines


def as_data(number: int | None, comparison: pd.DataFrame, iqm: pd.DataFrame, better: pd.DataFrame, runs: pd.DataFrame) -> dict:
    """
    Everything that is shown, in plain values for JSON.

    :param number: Table of the paper
    :param comparison: As :func:`compare` gives it
    :param iqm: As :func:`interquartile_means` gives them
    :param better: As :func:`improvements` gives them
    :param runs: As :func:`read_runs` gives them
    """
    frames = {"scores": comparison, "interquartile_means": iqm, "improvements": better, "runs": runs}
    records = {name: json.loads(frame.to_json(orient="records", double_precision=15)) for name, frame in frames.items()}
    return {"table": number, **records, "missing": missing(runs), "commits": commits(runs)}


def _steps(checkpoint: Any) -> str:
    return f"{checkpoint // 1000}K" if checkpoint % 1000 == 0 else f"{checkpoint:,}"


def _score(environment: str, mean: float, std: float) -> str:
    """As the paper prints it: integers, but three digits of what is normalized."""
    if math.isnan(mean):
        return "-"
    digits = 0 if environment.startswith(PREFIX) else 3 if max(abs(mean), std) < 10 else 1
    return f"{mean:.{digits}f}" if math.isnan(std) else f"{mean:.{digits}f} ± {std:.{digits}f}"


def _own_score(row: dict[Any, Any]) -> str:
    """With the number of runs where it is not what was asked for, and the mark."""
    number = "" if row["runs"] == row["asked"] else f" ({row['runs']}/{row['asked']})"
    return f"{_score(row['environment'], row['mean'], row['std'])}{number} {MARKS[row['mark']]}".rstrip()


def _range(low: float, high: float, digits: str) -> str:
    # A backslash: rich would take brackets for markup.
    return "-" if math.isnan(low) else rf"\[{low:{digits}}, {high:{digits}}]"
