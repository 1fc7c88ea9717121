"""
Figures 4, 6, 7, 9, 10 and 11 of the paper: python results/paper_figures.py KIND FOLDER ...

From folders of searches, evolution: scores by generation, beside the baselines (4 and 6); histogram: the distribution of the
scores of up to three searches (7); rankings: learning curves of the best candidates under three metrics (10), whose rank
correlations are printed; patterns: scores with and without each pattern of table 5 (11). From the folder of a benchmark,
curves: learning curves (9).
"""

import argparse
import math
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator
from sb3_aarl.search.execution.matrix import task_name
from sb3_aarl.search.execution.storage import load_study, open_storage
from sb3_aarl.search.results import analysis
from sb3_aarl.search.results.plots import (
    BLUE,
    COLOURS,
    LINES,
    ORANGE,
    SCORE,
    add_legend,
    count_candidates,
    evolution_plot,
    make_panels,
)
from sb3_aarl.search.results.report import stored_baselines
from sb3_aarl.search.studies.benchmark import read_abouts
from sb3_aarl.search.training.folder import partial_curve

SYMBOLS = ("o", "s", "D", "^", "P", "X", "v")
# Histograms lie on top of each other: the first is filled, the others are hatched and outlined.
HISTOGRAMS: tuple[dict[str, Any], ...] = (
    {"facecolor": "#d0d0d0", "edgecolor": "#7f7f7f", "linewidth": 1.0},
    {"facecolor": "none", "edgecolor": BLUE, "linewidth": 1.4, "hatch": "///"},
    {"facecolor": "none", "edgecolor": ORANGE, "linewidth": 1.4, "hatch": "...", "linestyle": "--"},
)


def read_curves(folder: Path) -> pd.DataFrame:
    """
    The learning curves of a benchmark's runs: one row an evaluation with ``variant``, ``env`` (short form), ``seed``,
    ``environment_steps``, ``mean`` and ``std`` (of the episodes' returns). Runs without an evaluation are skipped.
    """
    rows = [
        (about["variant"], task_name(about["environment"]), about["seed"], point.environment_steps, point.mean, point.std)
        for path, about in read_abouts(folder).items()
        for point in partial_curve(path)
    ]
    if not rows:
        raise ValueError(f"{folder} has no learning curves of a benchmark")
    return pd.DataFrame(rows, columns=["variant", "env", "seed", "environment_steps", "mean", "std"])


def learning_curves_plot(curves: pd.DataFrame, unit: str = "seed", columns: int = 4, width: float = 3.3) -> Figure:
    """
    Learning curves with their deviation over seeds, one panel a task: the paper's figure 9; ``unit`` is what a seed is,
    ``columns`` are panels beside each other, ``width`` that of one.

    A point is drawn where all seeds of its variant and task have one. The shade is the standard deviation over the seeds;
    where there is one seed only, over its episodes.
    """
    tasks, variants = list(curves["env"].unique()), list(curves["variant"].unique())
    figure, panels = make_panels(tasks, "Return (mean ± std)", columns, width, height=2.7)
    for axes, task in zip(panels, tasks, strict=True):
        for position, variant in enumerate(variants):
            runs = curves[(curves["env"] == task) & (curves["variant"] == variant)]
            n_seeds = runs["seed"].nunique()
            statistics = {"n": ("mean", "count"), "mean": ("mean", "mean"), "spread": ("mean", "std")}
            if n_seeds == 1:
                statistics["spread"] = ("std", "mean")
            points = runs.groupby("environment_steps").agg(**statistics).query("n == @n_seeds")
            if len(points):
                # Five lines and seven symbols: no two of 35 variants look alike.
                look = {"ls": LINES[position % len(LINES)], "marker": SYMBOLS[position % len(SYMBOLS)], "lw": 1.6, "ms": 4.5}
                colour, every = COLOURS[position % len(COLOURS)], max(1, len(points) // 8)
                axes.plot(points.index, points["mean"], color=colour, markevery=every, label=str(variant), **look)
                low, high = points["mean"] - points["spread"], points["mean"] + points["spread"]
                axes.fill_between(points.index, low, high, color=colour, alpha=0.18, linewidth=0)
        axes.set_title(f"{task}\n{_seeds(curves[curves['env'] == task], unit)}", fontsize=9)
        axes.set_xlabel("Environment steps", fontsize=9)
        axes.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    add_legend(figure, panels)
    return figure


def _seeds(curves: pd.DataFrame, unit: str) -> str:
    counts = curves.groupby("variant")["seed"].nunique()
    low, high = counts.min(), counts.max()
    text = f"{low} to {high} {unit}s" if low < high else f"{low} {unit}{'s' if low > 1 else ''}"
    return text + (" (shade of one: its episodes)" if low == 1 else "")


def histogram_plot(tables: Mapping[str, pd.DataFrame]) -> Figure:
    """The distributions of the scores of up to three studies: with and without pruning of the space."""
    title = "\n".join(f"{name}: {count_candidates(table)}" for name, table in tables.items())
    return _histograms({title: {name: analysis.analysed(table)["score"] for name, table in tables.items()}}, 6.4, 3.8)


def patterns_plot(table: pd.DataFrame) -> Figure:
    """The scores of the candidates with and without each pattern of table 5."""
    panels = {
        f"{name}\nn = {len(scores_with)} with, {len(scores_without)} without": {"without": scores_without, "with": scores_with}
        for name, (scores_with, scores_without) in analysis.pattern_scores(table).items()
    }
    figure = _histograms(panels, 3.1, 2.3)
    figure.suptitle(count_candidates(table), fontsize=10)
    return figure


def rankings(table: pd.DataFrame) -> pd.DataFrame:
    """The candidates that have a learning curve, with their scores under three metrics."""
    trials = analysis.analysed(table)
    trials = trials[trials["curve"].map(len) > 0]
    returns = np.array([[point[1] for point in curve] for curve in trials["curve"]])
    scores = {
        "by AULC": returns.mean(axis=1),
        "by the first evaluation": returns[:, 0],
        "by the last evaluation": returns[:, -1],
    }
    return trials[["number", "curve"]].assign(**scores)


def rankings_plot(ranking: pd.DataFrame, top: int = 10) -> Figure:
    """The mean learning curves of the best trials under each metric (paper, B.2)."""
    rows = []
    for metric in ranking.columns[2:]:
        best = ranking.nlargest(top, metric)
        for number, curve in zip(best["number"], best["curve"], strict=True):
            rows += [(metric, f"The best {top} candidates", number, *point[:2], math.nan) for point in curve]
    columns = ["variant", "env", "seed", "environment_steps", "mean", "std"]
    return learning_curves_plot(pd.DataFrame(rows, columns=columns), "candidate")


def _histograms(groups: Mapping[str, Mapping[str, pd.Series]], width: float, height: float) -> Figure:
    """A panel for each title, with histograms in percent of each group and lines at their means."""
    figure, panels = make_panels(list(groups), "Share of each group (%)", 4, width, height)
    every = [scores for panel in groups.values() for scores in panel.values()]
    edges = np.histogram_bin_edges(np.concatenate([np.zeros(0), *every]), 20).tolist()
    for axes, panel in zip(panels, groups.values(), strict=True):
        for (label, scores), look, line in zip(panel.items(), HISTOGRAMS, ("-", "--", ":"), strict=False):
            shares = np.full(len(scores), 100 / max(1, len(scores)))
            axes.hist(scores, edges, weights=shares, histtype="stepfilled", label=label, **look)
            if len(scores):
                axes.axvline(scores.mean(), color=look["edgecolor"], ls=line, lw=2, label=f"{label}, mean")
        axes.set_xlabel(SCORE, fontsize=9)
    add_legend(figure, panels)
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=["evolution", "histogram", "rankings", "patterns", "curves"])
    parser.add_argument("folders", type=Path, nargs="+", help="folders of searches; of rankings, patterns and curves one")
    parser.add_argument("--out", type=Path, help="default: KIND.png in the first folder")
    arguments = parser.parse_args()
    is_benchmark, folders = arguments.kind == "curves", arguments.folders
    try:
        found: Any = (
            read_curves(folders[0]) if is_benchmark else [load_study(open_storage(path, create=False)) for path in folders]
        )
    except ValueError as error:  # nothing is there
        sys.exit(str(error))
    figure = learning_curves_plot(found) if is_benchmark else of_searches(found, arguments)
    out = arguments.out or arguments.folders[0] / f"{arguments.kind}.png"
    figure.savefig(out)
    print(f"Figure: {out}")


def of_searches(studies: list[optuna.Study], arguments: argparse.Namespace) -> Figure:
    """A figure of the kinds that are drawn from folders of searches."""
    tables = {study.study_name: analysis.trial_table(study.get_trials(deepcopy=False)) for study in studies}
    table = next(iter(tables.values()))
    if arguments.kind == "evolution":
        lines = {study.study_name: stored_baselines(path) for study, path in zip(studies, arguments.folders, strict=True)}
        return evolution_plot(tables, lines)
    if arguments.kind == "histogram":
        return histogram_plot(tables)
    if arguments.kind == "patterns":
        return patterns_plot(table)
    ranking = rankings(table)
    print(ranking[ranking.columns[2:]].corr("spearman").to_string())
    return rankings_plot(ranking)


if __name__ == "__main__":
    main()
