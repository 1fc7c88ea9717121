"""Pictures of a study, as pure functions of its trials: plotly for the dashboard and the report, matplotlib for files."""

import io
import math
import textwrap
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from itertools import cycle
from statistics import fmean
from typing import Any

import numpy as np
import pandas as pd
import plotly.graph_objects as go
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import EngFormatter, MaxNLocator
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial

from sb3_aarl.aux_loss import AuxLoss
from search.results import analysis
from search.results.trials import curve_of, loss_of, operation_of, score_of, stage_of

# Lines differ by dash and marker, not by colour alone: they have to be told apart in grey.
DASHES = ("dash", "dot", "dashdot", "longdash", "longdashdot")
MARKERS = ("circle", "square", "diamond", "triangle-up", "cross")
BLUE, ORANGE, GREY = "#1f4e79", "#c55a11", "#444444"
COLOURS = (BLUE, ORANGE, "#000000", "#7f7f7f", "#6aa7d6")
# The same in matplotlib's words.
LINES: tuple[Any, ...] = ("-", "--", ":", "-.", (0, (6, 1, 1, 1, 1, 1)))
SYMBOLS = ("o", "s", "D", "^", "P", "X", "v")
# Histograms lie on top of each other: the first is filled, the others are hatched and outlined.
HISTOGRAMS: tuple[dict[str, Any], ...] = (
    {"facecolor": "#d0d0d0", "edgecolor": "#7f7f7f", "linewidth": 1.0},
    {"facecolor": "none", "edgecolor": BLUE, "linewidth": 1.4, "hatch": "///"},
    {"facecolor": "none", "edgecolor": ORANGE, "linewidth": 1.4, "hatch": "...", "linestyle": "--"},
)
SCORE = "Score (AULC, mean return)"
AXIS = {"showline": True, "linecolor": GREY, "gridcolor": "#e5e5e5", "zeroline": False, "ticks": "outside"}


def evolution_figure(
    trials: Sequence[FrozenTrial],
    baselines: Iterable[tuple[str, float]] = (),
    direction: StudyDirection = StudyDirection.MAXIMIZE,
) -> go.Figure:
    """
    The score of every completed candidate by stage (the paper's figures 4 and 6), with mean and best of the stages.

    :param trials: Trials of a study; those without a score are passed over
    :param baselines: Names and scores of horizontal lines
    :param direction: The study's, for what is best
    """
    scores: defaultdict[int, list[float]] = defaultdict(list)
    points: dict[str, list] = {"x": [], "y": [], "customdata": []}
    for trial in trials:
        score = score_of(trial)
        if score is None:
            continue
        stage, loss = stage_of(trial), loss_of(trial)
        scores[stage].append(score)
        points["x"].append(_spread(stage, trial.number))
        points["y"].append(score)
        notation = "<br>".join(textwrap.wrap(escape(str(loss)), 80)) if loss else "no loss"
        points["customdata"].append([trial.number, notation, escape(operation_of(trial))])
    stages = sorted(scores)
    best = max if direction == StudyDirection.MAXIMIZE else min

    # Plain lists, not arrays: plotly.py writes arrays in a form that the dashboard's older plotly.js cannot read.
    figure = go.Figure()
    figure.add_scatter(
        **points,
        name="candidate",
        mode="markers",
        marker={"size": 7, "color": "white", "line": {"color": GREY, "width": 1}},
        hovertemplate="trial %{customdata[0]}: <b>%{y:.1f}</b><br>%{customdata[1]}<br>%{customdata[2]}<extra></extra>",
    )
    for name, of_stage, dash, symbol, colour in (
        ("best of the stage", best, "solid", "triangle-up", ORANGE),
        ("mean of the stage", fmean, "solid", "square", BLUE),
    ):
        figure.add_scatter(
            x=stages,
            y=[of_stage(scores[stage]) for stage in stages],
            name=name,
            mode="lines+markers",
            line={"dash": dash, "color": colour, "width": 2},
            marker={"size": 9, "symbol": symbol},
            hovertemplate=f"{name} %{{x}}: %{{y:.1f}}<extra></extra>",
        )
    ends = [stages[0] - 0.5, stages[-1] + 0.5] if stages else [0.5, 1.5]
    for position, (name, score) in enumerate(baselines):
        figure.add_scatter(
            x=ends,
            y=[score, score],
            name=escape(name),
            mode="lines",
            line={"dash": DASHES[position % len(DASHES)], "color": COLOURS[2 + position % 3], "width": 1.5},
            hovertemplate=f"{escape(name)}: %{{y:.1f}}<extra></extra>",
        )
    _style(figure, "Evolution of auxiliary losses", "Stage", SCORE)
    figure.update_xaxes(range=ends, tickmode="array", tickvals=stages, showgrid=False)
    return figure


def _spread(stage: int, number: int) -> float:
    """Where a trial stands in its stage: spread by the golden ratio, even, and the same in every picture of one study."""
    return round(stage + 0.56 * (number * 0.6180339887 % 1 - 0.5), 3)


def learning_curves_figure(trials: Iterable[FrozenTrial]) -> go.Figure:
    """
    The learning curves of some trials, with standard deviations as bars; those without a curve are passed over.

    :param trials: Trials, in the order of the legend
    """
    figure = go.Figure()
    drawn = [(trial, curve_of(trial)) for trial in trials if curve_of(trial)]
    for position, (trial, curve) in enumerate(drawn):
        steps, means, deviations = (list(column) for column in zip(*curve, strict=True))
        colour = COLOURS[position % len(COLOURS)]
        figure.add_scatter(
            x=steps,
            y=means,
            error_y={"array": deviations, "thickness": 1, "width": 3},
            name=f"trial {trial.number}",
            mode="lines+markers",
            line={"dash": ("solid", *DASHES)[position % 5], "color": colour, "width": 2},
            marker={"size": 8, "symbol": MARKERS[position % len(MARKERS)]},
            hovertemplate=f"trial {trial.number}, step %{{x}}: %{{y:.1f}}<extra></extra>",
        )
    _style(figure, "Learning curves of the best", "Environment steps", "Return (mean ± std of the episodes)")
    return figure


def _style(figure: go.Figure, title: str, x_label: str, y_label: str) -> None:
    figure.update_layout(
        template="none",
        title={"text": title, "font": {"size": 16}, "x": 0.01, "xanchor": "left"},
        font={"family": "system-ui, sans-serif", "size": 13, "color": "#222222"},
        paper_bgcolor="white",
        plot_bgcolor="white",
        showlegend=True,
        legend={"orientation": "h", "yanchor": "top", "y": -0.18, "x": 0},
        margin={"l": 70, "r": 20, "t": 50, "b": 60},
        hovermode="closest",
    )
    figure.update_xaxes(title={"text": x_label}, **AXIS)
    figure.update_yaxes(title={"text": y_label, "standoff": 12}, automargin=True, **AXIS)


def learning_curve_png(curve: Sequence[tuple[int, float, float]], title: str) -> bytes:
    """
    A learning curve as a picture.

    :param curve: Environment steps, mean return and standard deviation of every evaluation
    :param title: Title, in matplotlib's notation (``$...$`` is typeset)
    """
    steps, means, deviations = (list(column) for column in zip(*curve, strict=True))
    figure = Figure(figsize=(6.4, 3.8), dpi=100, layout="constrained")
    # Without pyplot: notes are also written from threads.
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.plot(steps, means, "o-", color=BLUE, label="mean of the episodes")
    low = [mean - deviation for mean, deviation in zip(means, deviations, strict=True)]
    high = [mean + deviation for mean, deviation in zip(means, deviations, strict=True)]
    axes.fill_between(steps, low, high, color=BLUE, alpha=0.2, linewidth=0, label="± standard deviation")
    axes.set_xlabel("Environment steps")
    axes.set_ylabel("Return")
    axes.set_title(title, fontsize=10)
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    file = io.BytesIO()
    figure.savefig(file, format="png")
    return file.getvalue()


def evolution_plot(
    tables: Mapping[str, pd.DataFrame],
    baselines: Mapping[str, Iterable[tuple[str, float]]] | None = None,
    direction: StudyDirection = StudyDirection.MAXIMIZE,
) -> Figure:
    """
    The score of every candidate by stage, beside baselines: the paper's figures 4 and 6, one panel a study.

    :param tables: Title and trials of each study, as ``analysis.trial_table`` gives them
    :param baselines: Names and scores of each study's baselines, under the study's title
    :param direction: The studies', for what is best
    """
    baselines = {title: list(lines) for title, lines in (baselines or {}).items()}
    names = list(dict.fromkeys(name for lines in baselines.values() for name, _ in lines))
    figure, panels = _panels(list(tables), columns=3, width=4.4, height=3.6)
    best = "max" if direction == StudyDirection.MAXIMIZE else "min"
    for axes, (title, table) in zip(panels, tables.items(), strict=True):
        trials = analysis.analysed(table)
        x = [_spread(stage, number) for stage, number in zip(trials["stage"], trials["number"], strict=True)]
        axes.plot(x, trials["score"], "o", mfc="white", mec="#888888", ms=4, mew=0.7, label="candidate")
        stages = trials.groupby("stage")["score"]
        for label, scores, symbol, colour in (
            ("best of the stage", stages.agg(best), "^", ORANGE),
            ("mean of the stage", stages.mean(), "s", BLUE),
        ):
            axes.plot(scores.index, scores, "-", marker=symbol, ms=6, color=colour, lw=1.5, label=label)
        for name, score in baselines.get(title, ()):
            position = names.index(name)
            look = {"ls": LINES[1:][position % 4], "color": COLOURS[2:][position % 3], "lw": 1.6}
            axes.axhline(score, label=name, **look)
        there = trials["stage"] if len(trials) else pd.Series([1])
        axes.set_xlim(there.min() - 0.5, there.max() + 0.5)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.set_xlabel("Stage")
        axes.set_title(f"{title}\n{textwrap.fill(_who(table), 60)}", fontsize=9)
    _label_rows(panels, SCORE)
    _legend(figure, panels)
    return figure


def histogram_plot(tables: Mapping[str, pd.DataFrame], bins: int = 25) -> Figure:
    """
    How the scores of two or three studies are distributed: the paper's figure 7, evolution with and without pruning of
    the search space.

    :param tables: Name and trials of each study, as ``analysis.trial_table`` gives them
    :param bins: Number of bins over all scores
    :raises ValueError: for more than three studies
    """
    if len(tables) > len(HISTOGRAMS):
        raise ValueError(f"a histogram shows at most {len(HISTOGRAMS)} studies, not {len(tables)}: {', '.join(tables)}")
    figure, (axes,) = _panels([""], columns=1, width=6.4, height=3.8)
    _histograms(axes, {name: analysis.analysed(table)["score"] for name, table in tables.items()}, bins)
    axes.set_title(_who_each(tables), fontsize=9)
    axes.set_xlabel(SCORE)
    axes.set_ylabel("Share of the candidates (%)")
    _legend(figure, [axes])
    return figure


def patterns_plot(
    tables: Mapping[str, pd.DataFrame],
    patterns: Mapping[str, str | AuxLoss] = analysis.PATTERNS,
    ties_without: bool = False,
    bins: int = 15,
) -> Figure:
    """
    Scores of the candidates with and without each pattern of table 5: the paper's figure 11. One column of panels a study;
    a single study's patterns stand beside each other.

    Each class is a population of its own: its bars sum to 100 %.

    :param tables: Title and trials of each study, as ``analysis.trial_table`` gives them
    :param patterns: As in ``analysis.table5``
    :param ties_without: As in ``analysis.table5``
    :param bins: Number of bins over all scores of a study
    :raises ValueError: for a pattern that cannot be read
    """
    names = [*patterns, *analysis.COUNTS]
    single = len(tables) == 1
    titles = names if single else [f"{name}\n{title}" for name in names for title in tables]
    figure_columns = 4 if single else len(tables)
    figure, panels = _panels(titles, figure_columns, width=3.1, height=2.3)
    for column, table in enumerate(tables.values()):
        scores = analysis.analysed(table)["score"]
        classes = analysis.table5_classes(table, patterns, ties_without)
        edges = np.histogram_bin_edges(scores, bins).tolist()
        for row, name in enumerate(names):
            axes = panels[row * len(tables) + column]
            groups = {"without": scores[~classes[name].fillna(True)], "with": scores[classes[name].fillna(False)]}
            _histograms(axes, groups, edges)
            counts = f"n = {len(groups['with'])} with, {len(groups['without'])} without"
            axes.set_title(f"{titles[row * len(tables) + column]}\n{counts}", fontsize=8)
    for axes in panels[-figure_columns:]:
        axes.set_xlabel(SCORE, fontsize=9)
    _label_rows(panels, "Share of the class (%)")
    figure.suptitle(_who_each(tables), fontsize=10)
    _legend(figure, panels)
    return figure


def rankings_plot(table: pd.DataFrame, top: int = 10) -> Figure:
    """
    Learning curves of the best candidates under three metrics (AULC, first and last checkpoint): the paper's figure 10.

    :param table: Trials of a study, as ``analysis.trial_table`` gives them
    :param top: Number of candidates in each panel
    :raises ValueError: when no trial has a learning curve, or they have different checkpoints
    """
    ranking = analysis.rankings(table)
    if ranking.empty:
        raise ValueError("no complete trial has a learning curve")
    agreement = analysis.rank_agreement(ranking, top)
    steps = [point[0] for point in ranking["curve"].iloc[0]]
    names = {
        "aulc": "AULC",
        "first": f"the return at {_short(steps[0])} steps",
        "last": f"the return at {_short(steps[-1])} steps",
    }
    figure, panels = _panels(list(names.values()), columns=3, width=4.2, height=3.6)
    by_aulc = set(analysis.leading(ranking, "aulc", top)["number"])
    for axes, (metric, name) in zip(panels, names.items(), strict=True):
        best = analysis.leading(ranking, metric, top)
        means = np.array([[mean for _, mean, _ in curve] for curve in best["curve"]])
        for number, curve in zip(best["number"], means, strict=True):
            shared = number in by_aulc
            look: dict[str, Any] = {"ls": "-", "color": "#8c8c8c"} if shared else {"ls": ":", "color": "#000000"}
            axes.plot(steps, curve, lw=1.1, label=f"in the top {top} by AULC" if shared else "not in it", **look)
        axes.plot(steps, means.mean(axis=0), "o-", color=BLUE, lw=2.4, ms=6, label="mean of the panel")
        title = f"Top {len(best)} by {name}"
        if metric != "aulc":
            spearman = agreement["spearman"]["aulc", metric]
            title += f"\nrank correlation with AULC {spearman:.2f} (Spearman)"
        axes.set_title(title, fontsize=9)
        _step_axis(axes)
    low, high = (f([axes.get_ylim()[place] for axes in panels]) for place, f in enumerate((min, max)))
    for axes in panels:
        axes.set_ylim(low, high)
    _label_rows(panels, "Mean return")
    figure.suptitle(_who(table), fontsize=10)
    _legend(figure, panels)
    return figure


def learning_curves_plot(curves: pd.DataFrame, smooth: int = 1) -> Figure:
    """
    Learning curves with their deviation over seeds, one panel a task: the paper's figure 9.

    A point is drawn where all seeds of its variant and task have one. The shade is the standard deviation over the seeds;
    where there is one seed only, over its episodes.

    :param curves: Columns ``variant``, ``env``, ``seed``, ``environment_steps``, ``mean`` and ``std`` (of the episodes'
        returns), one row an evaluation
    :param smooth: Evaluations over which each run is averaged, centred; the paper smooths too and does not say how much
    :raises ValueError: naming a column that is missing, or a run that has one checkpoint twice
    """
    columns = ["variant", "env", "seed", "environment_steps", "mean", "std"]
    if missing := [name for name in columns if name not in curves]:
        raise ValueError(f"learning curves need the columns {', '.join(columns)}; {missing[0]!r} is missing")
    twice = curves[curves.duplicated(columns[:4])]
    if len(twice):
        run = ", ".join(f"{name} {twice[name].iloc[0]}" for name in columns[:4])
        raise ValueError(f"learning curves have one evaluation twice: {run}")
    envs, variants = list(dict.fromkeys(curves["env"])), list(dict.fromkeys(curves["variant"]))
    curves = curves.sort_values("environment_steps")
    if smooth > 1:
        runs = curves.groupby(columns[:3])[["mean", "std"]]
        curves[["mean", "std"]] = runs.transform(lambda run: run.rolling(smooth, center=True, min_periods=1).mean())
    figure, panels = _panels(envs, columns=4, width=3.3, height=2.7)
    for axes, env in zip(panels, envs, strict=True):
        for position, variant in enumerate(variants):
            runs = curves[(curves["env"] == env) & (curves["variant"] == variant)]
            n_seeds = runs["seed"].nunique()
            if not n_seeds:
                continue
            points = runs.groupby("environment_steps").agg(
                n=("mean", "count"),
                mean=("mean", "mean"),
                over_seeds=("mean", "std"),
                episodes=("std", "mean"),
            )
            points = points[points["n"] == n_seeds]
            spread = points["over_seeds"] if n_seeds > 1 else points["episodes"]
            colour = COLOURS[position % len(COLOURS)]
            every = max(1, len(points) // 8)
            # Five lines and seven symbols: no two of 35 variants look alike.
            look = {"ls": LINES[position % len(LINES)], "marker": SYMBOLS[position % len(SYMBOLS)], "markevery": every}
            axes.plot(points.index, points["mean"], color=colour, lw=1.6, ms=4.5, label=str(variant), **look)
            axes.fill_between(
                points.index, points["mean"] - spread, points["mean"] + spread, color=colour, alpha=0.18, linewidth=0
            )
        axes.set_title(f"{env}\n{_seeds(curves[curves['env'] == env])}", fontsize=9)
        _step_axis(axes)
    _label_rows(panels, "Return (mean ± std)")
    _legend(figure, panels)
    return figure


def _panels(titles: Sequence[str], columns: int, width: float, height: float) -> tuple[Figure, list[Axes]]:
    """A figure with a panel for each title; width and height of a panel in inches."""
    columns = max(1, min(columns, len(titles)))
    rows = max(1, -(-len(titles) // columns))
    # Without pyplot, as above.
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
    return figure, panels


def _label_rows(panels: Sequence[Axes], label: str) -> None:
    """The label of the vertical axes, once a row."""
    for axes in panels:
        spec = axes.get_subplotspec()
        if spec is not None and spec.is_first_col():
            axes.set_ylabel(label, fontsize=9)


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


def _who(table: pd.DataFrame) -> str:
    """How many trials a picture shows, and which it leaves out."""
    counts = analysis.population(table)
    words = {
        "pruned": "pruned",
        "fail": "failed",
        "running": "running",
        "waiting": "waiting",
        "unusable": "without score or loss",
    }
    left_out = [f"{counts[state]} {word}" for state, word in words.items() if counts[state]]
    return f"{counts['analysed']} candidates" + (f" (left out: {', '.join(left_out)})" if left_out else "")


def _who_each(tables: Mapping[str, pd.DataFrame]) -> str:
    return "\n".join(f"{name}: {_who(table)}" for name, table in tables.items())


def _seeds(curves: pd.DataFrame) -> str:
    counts = curves.groupby("variant", sort=False)["seed"].nunique()
    words = {variant: "1 seed (shade: episodes)" if n == 1 else f"{n} seeds" for variant, n in counts.items()}
    if counts.nunique() == 1:
        return next(iter(words.values()))
    text = textwrap.fill(", ".join(f"{variant}: {word}" for variant, word in words.items()), 45)
    return text if text.count("\n") < 3 else f"{counts.min()} to {counts.max()} seeds"


def _step_axis(axes: Axes) -> None:
    axes.set_xlabel("Environment steps", fontsize=9)
    axes.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))


def _short(steps: int) -> str:
    return EngFormatter(sep="")(steps)
