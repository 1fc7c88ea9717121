"""
A benchmark beside tables 2, 3, 4 and 6 of the paper: python results/paper_tables.py FOLDER.

The paper's numbers are in paper_tables.yml.
"""

import argparse
import sys
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml
from sb3_aarl.search.execution.matrix import task_name
from sb3_aarl.search.results.table import compare, read_runs

from sb3_aarl.envs import PREFIX

# A difference is marked from so many standard errors on.
STANDARD_ERRORS = 2.0
# The row of tables 2 and 6, which have no environments.
NORMALIZED = "normalized"
# Suffix of a variant whose networks compute in bfloat16: the paper's all the same.
BF16 = "_bf16"
NUMBERS = ["paper_mean", "paper_std", "paper_runs"]


@cache
def tables() -> dict[int, dict[str, Any]]:
    """The paper's tables by number."""
    return yaml.safe_load(Path(__file__).with_name("paper_tables.yml").read_text(encoding="utf-8"))


def paper_scores(number: int) -> pd.DataFrame:
    """A table of the paper; ``variant`` is a name in ``zoo_configs``, None for methods that are not here."""
    table = tables()[number]
    rows = []
    for checkpoint, tasks in table["scores"].items():
        for task, scores in tasks.items():
            environment = task if task == NORMALIZED else f"{PREFIX}{task}-v0"
            for (column, variant), score in zip(table["columns"].items(), scores, strict=True):
                if score is not None:
                    rows.append((checkpoint, environment, column, variant, *map(float, score), table["runs"]))
    return pd.DataFrame(rows, columns=["checkpoint", "environment", "column", "variant", *NUMBERS])


def closest_table(variants: Iterable[str]) -> int | None:
    """The paper's table with the most of some variants, None if none has any."""
    names = {variant.removesuffix(BF16) for variant in variants}
    matches = {number: len(names & set(table["columns"].values())) for number, table in tables().items()}
    best = max(matches, key=lambda number: matches[number])
    return best if matches[best] else None


def beside(runs: pd.DataFrame, number: int) -> pd.DataFrame:
    """
    Means and deviations of a benchmark's runs over seeds, beside those of the same variants in a table of the paper.

    ``std`` is the sample deviation (n - 1). A difference is marked when it exceeds two standard errors of a difference of two
    means, 2 sqrt(s^2 / n + S^2 / N), with s and n of the runs here, S and N of the paper's table; the paper does not say
    which deviation it prints. With one run here there is no s, and no mark.

    For tables 2 and 6 the returns are normalized, see :func:`normalized`; N is 5 seeds x 3 or 6 environments there, so both
    deviations contain the difference of the environments: the test is a cautious one.
    """
    ours = _normalized(runs, number) if number in (2, 6) else compare(runs)
    ours["name"] = ours["variant"].str.removesuffix(BF16)
    paper = paper_scores(number).rename(columns={"variant": "name"}).dropna(subset="name")
    result = paper.merge(ours, on=["checkpoint", "environment", "name"]).dropna(subset="mean").drop(columns="name")
    result["difference"] = result["mean"] - result["paper_mean"]
    result["standard_error"] = np.sqrt(result["std"] ** 2 / result["runs"] + result["paper_std"] ** 2 / result["paper_runs"])
    far = result["difference"].abs() > STANDARD_ERRORS * result["standard_error"]
    result["mark"] = np.where(far, np.where(result["difference"] > 0, "▲", "▼"), "")
    return result


def _normalized(runs: pd.DataFrame, number: int) -> pd.DataFrame:
    """Each variant's mean over all environments, if the variants that have all runs are those of the paper's table."""
    parts = []
    for checkpoint, part in runs.groupby("checkpoint"):
        n_planned = len(part[["environment", "seed"]].drop_duplicates())
        finished = part.dropna(subset="mean")
        whole = finished[finished.groupby("variant")["variant"].transform("size") == n_planned]
        if {*whole["variant"].str.removesuffix(BF16)} == {*tables()[number]["columns"].values()}:
            table = normalized(whole).assign(runs=n_planned, checkpoint=checkpoint, environment=NORMALIZED)
            parts.append(table.reset_index())
    return pd.concat(parts) if parts else compare(runs.head(0))


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


def readable(table: pd.DataFrame) -> pd.DataFrame:
    """The columns of :func:`beside` as texts."""
    rows = []
    for row in table.to_dict("records"):
        digits = 3 if row["environment"] == NORMALIZED else 0
        ours, paper = (f"{row[key + 'mean']:.{digits}f} ± {row[key + 'std']:.{digits}f}" for key in ("", "paper_"))
        where = (f"{row['checkpoint']:,}", task_name(row["environment"]), row["column"], row["variant"])
        rows.append((*where, f"{ours} ({row['runs']}) {row['mark']}".rstrip(), f"{paper} ({row['paper_runs']})"))
    return pd.DataFrame(rows, columns=["steps", "task", "in the paper", "variant", "here", "paper"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?", default=Path("runs/benchmark"), help="folder of a benchmark")
    parser.add_argument("--table", type=int, choices=list(tables()), help="default: the one with most of the variants")
    arguments = parser.parse_args()
    try:
        runs = read_runs(arguments.folder)
    except ValueError as error:
        sys.exit(str(error))
    number = arguments.table or closest_table(runs["variant"])
    if number is None:
        sys.exit(f"no table of the paper has a variant of {arguments.folder}")
    found = beside(runs, number)
    if found.empty:
        steps = ", ".join(f"{steps:,}" for steps in tables()[number]["scores"])
        sys.exit(f"{arguments.folder} has no finished run to compare with table {number}, which has returns at {steps} steps")
    print(f"Table {number} of the paper; ▲ ▼: more than two standard errors of the difference from it")
    print(readable(found).to_string(index=False))


if __name__ == "__main__":
    main()
