"""Figures of a study, as pure functions of its trials: plotly for the dashboard and the report, matplotlib for files."""

import math
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from html import escape
from itertools import cycle
from typing import Any

import numpy as np
import pandas as pd
import plotly.graph_objects as go
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import EngFormatter, MaxNLocator
from optuna.study import StudyDirection
from sb3_aarl.search.results import analysis

from sb3_aarl.aux_loss import AuxLoss

# Lines differ by dash, not by colour alone: they have to be told apart in grey.
DASHES = ("dash", "dot", "dashdot", "longdash", "longdashdot")
BLUE, ORANGE, GREY = "#1f4e79", "#c55a11", "#444444"
COLOURS = (BLUE, ORANGE, "#000000", "#7f7f7f", "#6aa7d6")
# The same in matplotlib's names.
LINES: tuple[Any, ...] = ("-", "--", ":", "-.", (0, (6, 1, 1, 1, 1, 1)))
SYMBOLS = ("o", "s", "D", "^", "P", "X", "v")
# Histograms lie on top of each other: the first is filled, the others are hatched and outlined.
HISTOGRAMS: tuple[dict[str, Any], ...] = (
    {"facecolor": "#d0d0d0", "edgecolor": "#7f7f7f", "linewidth": 1.0},
    {"facecolor": "none", "edgecolor": BLUE, "linewidth": 1.4, "hatch": "///"},
    {"facecolor": "none", "edgecolor": ORANGE, "linewidth": 1.4, "hatch": "...", "linestyle": "--"},
)
SCORE = "Score (AULC, mean return)"


def evolution_figure(
    table: pd.DataFrame,
    baselines: Iterable[tuple[str, float]] = (),
    direction: StudyDirection = StudyDirection.MAXIMIZE,
) -> go.Figure:
    """The score of every completed candidate by generation (the paper's figures 4 and 6), with their mean and best."""
    scored = table[table["score"].notna()]
    notations = ["<br>".join(textwrap.wrap(escape(str(loss)), 80)) if loss else "no loss" for loss in scored["loss"]]
    # Plain lists, not arrays: plotly.py writes arrays in a form that the dashboard's older plotly.js cannot read.
    figure = go.Figure()
    figure.add_scatter(
        x=_spread(scored).tolist(),
        y=scored["score"].tolist(),
        customdata=list(zip(scored["number"].tolist(), notations, map(escape, scored["operation"]), strict=True)),
        name="candidate",
        mode="markers",
        marker={"size": 7, "color": "white", "line": {"color": GREY, "width": 1}},
        hovertemplate="trial %{customdata[0]}: <b>%{y:.1f}</b><br>%{customdata[1]}<br>%{customdata[2]}<extra></extra>",
    )
    for name, scores, colour, symbol, _ in _generation_lines(scored, direction):
        figure.add_scatter(
            x=scores.index.tolist(),
            y=scores.tolist(),
            name=name,
            mode="lines+markers",
            line={"color": colour, "width": 2},
            marker={"size": 9, "symbol": symbol},
            hovertemplate=f"{name} %{{x}}: %{{y:.1f}}<extra></extra>",
        )
    generations = sorted(scored["generation"].unique().tolist())
    ends = [generations[0] - 0.5, generations[-1] + 0.5] if generations else [0.5, 1.5]
    for position, (name, score) in enumerate(baselines):
        figure.add_scatter(
            x=ends,
            y=[score, score],
            name=escape(name),
            mode="lines",
            line={"dash": DASHES[position % len(DASHES)], "color": COLOURS[2 + position % 3], "width": 1.5},
            hovertemplate=f"{escape(name)}: %{{y:.1f}}<extra></extra>",
        )
    title = {"text": "Evolution of auxiliary losses"}
    figure.update_layout(template="simple_white", title=title, legend={"orientation": "h", "yanchor": "top", "y": -0.18})
    figure.update_xaxes(title={"text": "Generation"}, range=ends, tickvals=generations)
    figure.update_yaxes(title={"text": SCORE})
    return figure


def _spread(trials: pd.DataFrame) -> pd.Series:
    """Where trials stand in their generation: spread by the golden ratio, even, and the same in every figure of a study."""
    return (trials["generation"] + 0.56 * (trials["number"] * 0.6180339887 % 1 - 0.5)).round(3)


def _generation_lines(trials: pd.DataFrame, direction: StudyDirection) -> Iterator[tuple[str, pd.Series, str, str, str]]:
    """Best and mean of the generations: name, scores, colour, and the symbol in plotly and in matplotlib."""
    groups = trials.groupby("generation")["score"]
    best = groups.max() if direction == StudyDirection.MAXIMIZE else groups.min()
    yield "best of the generation", best, ORANGE, "triangle-up", "^"
    yield "mean of the generation", groups.mean(), BLUE, "square", "s"


def evolution_plot(
    tables: Mapping[str, pd.DataFrame],
    baselines: Mapping[str, Iterable[tuple[str, float]]] | None = None,
    direction: StudyDirection = StudyDirection.MAXIMIZE,
) -> Figure:
    """The score of every candidate by generation, beside baselines: the paper's figures 4 and 6, one panel a study."""
    baselines = {title: list(lines) for title, lines in (baselines or {}).items()}
    names = list(dict.fromkeys(name for lines in baselines.values() for name, _ in lines))
    figure, panels = _panels(list(tables), SCORE, columns=3, width=4.4, height=3.6)
    for axes, (title, table) in zip(panels, tables.items(), strict=True):
        trials = analysis.analysed(table)
        axes.plot(_spread(trials), trials["score"], "o", mfc="white", mec="#888888", ms=4, mew=0.7, label="candidate")
        for label, scores, colour, _, symbol in _generation_lines(trials, direction):
            axes.plot(scores.index, scores, "-", marker=symbol, ms=6, color=colour, lw=1.5, label=label)
        for name, score in baselines.get(title, ()):
            position = names.index(name)
            axes.axhline(score, label=name, ls=LINES[1:][position % 4], color=COLOURS[2:][position % 3], lw=1.6)
        generations = trials["generation"] if len(trials) else pd.Series([1])
        axes.set_xlim(generations.min() - 0.5, generations.max() + 0.5)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.set_xlabel("Generation")
        axes.set_title(f"{title}\n{textwrap.fill(_counts(table), 60)}", fontsize=9)
    _legend(figure, panels)
    return figure


def histogram_plot(tables: Mapping[str, pd.DataFrame]) -> Figure:
    """
    How the scores of up to three studies are distributed: the paper's figure 7, evolution with and without pruning of the
    search space.
    """
    if len(tables) > len(HISTOGRAMS):
        raise ValueError(f"a histogram shows at most {len(HISTOGRAMS)} studies, not {len(tables)}: {', '.join(tables)}")
    figure, (axes,) = _panels([""], "Share of the candidates (%)", columns=1, width=6.4, height=3.8)
    _histograms(axes, {name: analysis.analysed(table)["score"] for name, table in tables.items()}, 25)
    axes.set_title(_counts_each(tables), fontsize=9)
    axes.set_xlabel(SCORE)
    _legend(figure, [axes])
    return figure


def patterns_plot(
    tables: Mapping[str, pd.DataFrame],
    patterns: Mapping[str, str | AuxLoss] = analysis.PATTERNS,
) -> Figure:
    """
    Scores of the candidates with and without each pattern of table 5: the paper's figure 11. One column of panels a study;
    a single study's patterns stand beside each other. Each class is a population of its own: its bars sum to 100 %.
    """
    names = [*patterns, *analysis.COUNTS]
    single = len(tables) == 1
    titles = names if single else [f"{name}\n{title}" for name in names for title in tables]
    figure_columns = 4 if single else len(tables)
    figure, panels = _panels(titles, "Share of the class (%)", figure_columns, width=3.1, height=2.3)
    for column, table in enumerate(tables.values()):
        scores = analysis.analysed(table)["score"]
        classes = analysis.table5_classes(table, patterns)
        edges = np.histogram_bin_edges(scores, 15).tolist()
        for row, name in enumerate(names):
            axes = panels[row * len(tables) + column]
            groups = {"without": scores[~classes[name].fillna(True)], "with": scores[classes[name].fillna(False)]}
            _histograms(axes, groups, edges)
            counts = f"n = {len(groups['with'])} with, {len(groups['without'])} without"
            axes.set_title(f"{titles[row * len(tables) + column]}\n{counts}", fontsize=8)
    for axes in panels[-figure_columns:]:
        axes.set_xlabel(SCORE, fontsize=9)
    figure.suptitle(_counts_each(tables), fontsize=10)
    _legend(figure, panels)
    return figure


def rankings_plot(table: pd.DataFrame, top: int = 10) -> Figure:
    """Learning curves of the best candidates under three metrics (AULC, first and last checkpoint): the paper's figure 10."""
    ranking = analysis.rankings(analysis.analysed(table))
    agreement = analysis.rank_agreement(ranking, top)
    steps = [point[0] for point in ranking["curve"].iloc[0]]
    first, last = (EngFormatter(sep="")(step) for step in (steps[0], steps[-1]))
    names = {"aulc": "AULC", "first": f"the return at {first} steps", "last": f"the return at {last} steps"}
    figure, panels = _panels(list(names.values()), "Mean return", columns=3, width=4.2, height=3.6)
    by_aulc = set(ranking.nlargest(top, "aulc")["number"])
    looks = {True: ("-", "#8c8c8c", f"in the top {top} by AULC"), False: (":", "black", "not in it")}
    for axes in panels[1:]:
        axes.sharey(panels[0])
    for axes, (metric, name) in zip(panels, names.items(), strict=True):
        best = ranking.nlargest(top, metric)
        means = np.array([[point[1] for point in curve] for curve in best["curve"]])
        for number, curve in zip(best["number"], means, strict=True):
            line, colour, label = looks[number in by_aulc]
            axes.plot(steps, curve, line, color=colour, lw=1.1, label=label)
        axes.plot(steps, means.mean(axis=0), "o-", color=BLUE, lw=2.4, ms=6, label="mean of the panel")
        title = f"Top {len(best)} by {name}"
        if metric != "aulc":
            spearman = agreement["spearman"]["aulc", metric]
            title += f"\nrank correlation with AULC {spearman:.2f} (Spearman)"
        axes.set_title(title, fontsize=9)
        _step_axis(axes)
    figure.suptitle(_counts(table), fontsize=10)
    _legend(figure, panels)
    return figure


def learning_curves_plot(curves: pd.DataFrame) -> Figure:
    """
    Learning curves with their deviation over seeds, one panel a task: the paper's figure 9.

    A point is drawn where all seeds of its variant and task have one. The shade is the standard deviation over the seeds;
    where there is one seed only, over its episodes.
    """
    tasks, variants = list(curves["env"].unique()), list(curves["variant"].unique())
    figure, panels = _panels(tasks, "Return (mean ± std)", columns=4, width=3.3, height=2.7)
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
        axes.set_title(f"{task}\n{_seeds(curves[curves['env'] == task])}", fontsize=9)
        _step_axis(axes)
    _legend(figure, panels)
    return figure


def _panels(titles: Sequence[str], label: str, columns: int, width: float, height: float) -> tuple[Figure, list[Axes]]:
    """A figure with a panel for each title, their vertical axis labelled once a row; width and height of a panel in inches."""
    columns = max(1, min(columns, len(titles)))
    rows = max(1, -(-len(titles) // columns))
    # Without pyplot, whose figures are global.
    figure = Figure(figsize=(width * columns, height * rows + 0.6), dpi=120, layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False).ravel().tolist()
    for axes in grid[len(titles) :]:
        axes.remove()
    panels = grid[: len(titles)]
    for axes, title in zip(panels, titles, strict=True):
        axes.set_title(title, fontsize=9)
        axes.grid(color="#e5e5e5", lw=0.6)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=8)
    for axes in panels[::columns]:
        axes.set_ylabel(label, fontsize=9)
    return figure, panels


def _legend(figure: Figure, panels: Iterable[Axes]) -> None:
    """One legend for all panels, each label once; what comes last."""
    entries: dict[str, Any] = {}
    for axes in panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    # As many beside each other as fit the width, in inches.
    columns = max(1, int(figure.get_figwidth() / (0.7 + 0.08 * max(map(len, entries), default=0))))
    figure.set_figheight(figure.get_figheight() + 0.22 * (math.ceil(len(entries) / columns) - 1))
    handles = list(entries.values())
    figure.legend(handles, list(entries), loc="outside lower center", ncols=columns, frameon=False, fontsize=9)
    # A $ in the name of a study or a file is no formula.
    for text in figure.findobj(Text):
        text.set_parse_math(False)


def _histograms(axes: Axes, scores: Mapping[str, pd.Series], bins: int | Sequence[float]) -> None:
    """Histograms in percent of each group, with a line at its mean."""
    edges = np.histogram_bin_edges(np.concatenate([np.zeros(0), *scores.values()]), bins).tolist()
    for (label, values), look in zip(scores.items(), cycle(HISTOGRAMS)):
        shares = np.full(len(values), 100 / max(1, len(values)))
        axes.hist(values, edges, weights=shares, histtype="stepfilled", label=label, **look)
    for (label, values), look, line in zip(scores.items(), cycle(HISTOGRAMS), cycle(("-", "--", ":"))):
        if len(values):
            axes.axvline(values.mean(), color=look["edgecolor"], ls=line, lw=2, label=f"{label}, mean")


def _counts(table: pd.DataFrame) -> str:
    """How many trials a figure shows, and which it leaves out."""
    counts = analysis.population(table)
    words = {"fail": "failed", "unusable": "without score or loss"}
    states = counts.drop(["trials", "analysed"])
    left_out = [f"{count} {words.get(str(state), state)}" for state, count in states[states > 0].items()]
    return f"{counts['analysed']} candidates" + (f" (left out: {', '.join(left_out)})" if left_out else "")


def _counts_each(tables: Mapping[str, pd.DataFrame]) -> str:
    return "\n".join(f"{name}: {_counts(table)}" for name, table in tables.items())


def _seeds(curves: pd.DataFrame) -> str:
    counts = curves.groupby("variant")["seed"].nunique()
    low, high = counts.min(), counts.max()
    text = f"{low} to {high} seeds" if low < high else f"{low} seed" if low == 1 else f"{low} seeds"
    return text + (" (shade of one: its episodes)" if low == 1 else "")


def _step_axis(axes: Axes) -> None:
    axes.set_xlabel("Environment steps", fontsize=9)
    axes.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
