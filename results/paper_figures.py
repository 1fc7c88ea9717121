"""
Figures 4, 6, 7, 10 and 11 of the paper from the folders of searches: python results/paper_figures.py KIND FOLDER ...

evolution: scores by generation, beside the baselines (4 and 6); histogram: the distribution of the scores of up to three
searches (7); rankings: learning curves of the best candidates under three metrics (10), whose rank correlations are printed;
patterns: scores with and without each pattern of table 5 (11). Figure 9 is drawn by aarl table FOLDER --curves FILE.
"""

import argparse
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from sb3_aarl.search.execution.storage import load_study, open_storage
from sb3_aarl.search.results import analysis
from sb3_aarl.search.results.plots import (
    BLUE,
    ORANGE,
    SCORE,
    add_legend,
    count_candidates,
    evolution_plot,
    learning_curves_plot,
    make_panels,
)
from sb3_aarl.search.results.report import stored_baselines

# Histograms lie on top of each other: the first is filled, the others are hatched and outlined.
HISTOGRAMS: tuple[dict[str, Any], ...] = (
    {"facecolor": "#d0d0d0", "edgecolor": "#7f7f7f", "linewidth": 1.0},
    {"facecolor": "none", "edgecolor": BLUE, "linewidth": 1.4, "hatch": "///"},
    {"facecolor": "none", "edgecolor": ORANGE, "linewidth": 1.4, "hatch": "...", "linestyle": "--"},
)


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
    parser.add_argument("kind", choices=["evolution", "histogram", "rankings", "patterns"])
    parser.add_argument("folders", type=Path, nargs="+", help="folders of searches; of rankings and patterns one")
    parser.add_argument("--out", type=Path, help="default: KIND.png in the first folder")
    arguments = parser.parse_args()
    studies = [load_study(open_storage(folder, create=False)) for folder in arguments.folders]
    tables = {study.study_name: analysis.trial_table(study.get_trials(deepcopy=False)) for study in studies}
    table = next(iter(tables.values()))
    if arguments.kind == "evolution":
        lines = {study.study_name: stored_baselines(path) for study, path in zip(studies, arguments.folders, strict=True)}
        figure = evolution_plot(tables, lines)
    elif arguments.kind == "histogram":
        figure = histogram_plot(tables)
    elif arguments.kind == "patterns":
        figure = patterns_plot(table)
    else:
        ranking = rankings(table)
        print(ranking[ranking.columns[2:]].corr("spearman").to_string())
        figure = rankings_plot(ranking)
    out = arguments.out or arguments.folders[0] / f"{arguments.kind}.png"
    figure.savefig(out)
    print(f"Figure: {out}")


if __name__ == "__main__":
    main()
